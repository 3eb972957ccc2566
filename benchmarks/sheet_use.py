"""Forces of sheets in hours of mixed use: the daemon's compensation against the worlds' sheets.

Public names: `Sheets`, `drawn_sheets`, `score_use`; `Use` and `Holds`, kinds of use. True loads go through
the simulator's sheet laws, apparent ones through the compensation; one reading of each contact is compared,
at a random age.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.scores import ClusterShare, Estimates, Share, bin_labels
from handtouch.config import Behaviour
from handtouch.core.sheet_force import (
    ForceReliability,
    SheetBehaviour,
    SheetForceCompensation,
    sheet_behaviour_of,
)
from handtouch.core.state import TickState
from handtouch.sheet import BankPrior
from handtouch.simulate.sheet_physics import SheetLaw, SheetStates
from handtouch.simulate.worlds import SHEET_KINDS, WORLDS, DrawnWorld, Family, SheetKind

FloatArray = NDArray[np.float64]
FULL_N = 5.0
CERTAIN = BankPrior(log_time_std=1e-12, not_adapting=1e-30, exponent_std=0.0)
"""Prior of a sheet of which nothing is to be learned."""
ALPHA = 1.5
"""Exponent of the contact law: a layer of r times the resistance reads r^(-1 / alpha) times the force."""
DT_S = 0.4
DETECTED_N = 0.05
HOUR_S = 3600.0


@dataclass(frozen=True)
class Sheets:
    """Pads (n,) with sheets of one kind."""

    name: str
    laws: tuple[SheetLaw, ...]
    gains: FloatArray
    """(n,), force that a fresh sheet reads over the true one."""
    behaviour: Behaviour
    """What the deployment file states of them."""
    law_std: float
    """Relative standard deviation of a force by the stated tolerance of the contact layer."""
    learns: bool = True
    """Whether creep and adaptation are learned from use, as by the daemon; else they are the file's."""


def drawn_sheets(drawn: DrawnWorld, kind: SheetKind, pads: int) -> Sheets:
    """Return pads of a kind with what the drawn world hides, as the builder describes them."""
    layer = drawn.world.sheets.contact_ohm_ratio
    ratios = layer.sample(np.random.default_rng((drawn.seed, 8, *kind.name.encode())), pads)
    laws = tuple(kind.varied(*drawn.sheet_factors(f"{kind.name}/{pad}")) for pad in range(pads))
    return Sheets(kind.name, laws, ratios ** (-1 / ALPHA), kind.behaviour, layer.std / ALPHA)


def stated_behaviour(sheets: Sheets) -> SheetBehaviour:
    """Return the behaviour that the daemon makes of the deployment file."""
    stated = sheet_behaviour_of(sheets.behaviour, sheets.name)
    return stated if sheets.learns else replace(stated, prior=CERTAIN)


class Use:
    """Use of a hand: grips of 2 to 40 s, some of minutes, of 0.1 to 5 N, half of them waxing and waning;
    pauses of 0.3 to 30 s; half of the grips of a pad are alike. Between spells of work, breaks."""

    def __init__(self, pads: int, rng: np.random.Generator) -> None:
        self._rng, self._usual = rng, rng.uniform(0.5, 4.0, pads)
        self._force, self._swing, self._turn_s = np.zeros(pads), np.zeros(pads), np.ones(pads)
        self._left_s, self.age_s = rng.uniform(0, 20, pads), np.zeros(pads)
        self.sample_s = np.full(pads, np.inf)
        """(n,), age at which a contact is compared."""

    def spells(self, hours: float) -> Iterator[tuple[float, bool]]:
        """Yield the length [s] of each spell and whether it is of work."""
        gone_s, is_work = 0.0, True
        while gone_s < hours * HOUR_S:
            long_s = 60 * float(self._rng.uniform(*((15, 40) if is_work else (5, 60))))
            long_s = DT_S * max(round(min(long_s, hours * HOUR_S - gone_s) / DT_S), 1)
            yield long_s, is_work
            gone_s, is_work = gone_s + long_s, not is_work

    def loads_n(self) -> FloatArray:
        """Return true loads (n,) of the next step."""
        rng = self._rng
        self._left_s -= DT_S
        self.age_s += DT_S
        if (turn := np.flatnonzero(self._left_s <= 0)).size:
            free, k = self._force[turn] == 0, len(turn)
            fresh = np.where(rng.random(k) < 0.5, self._usual[turn], rng.uniform(0.1, FULL_N, k))
            grip_s = np.where(rng.random(k) < 0.03, rng.uniform(120, 1200, k), rng.uniform(2, 40, k))
            self._force[turn] = np.where(free, fresh, 0.0)
            self._left_s[turn] = np.where(free, grip_s, 30 * rng.random(k) ** 3 + 0.3)
            self._swing[turn] = 0.3 * rng.random(k) * (rng.random(k) < 0.5)
            self._turn_s[turn], self.age_s[turn] = rng.uniform(2, 20, k), 0.0
            self.sample_s[turn] = np.where(free, rng.uniform(0, grip_s), np.inf)
        wave = 1 + self._swing * np.sin(2 * np.pi * self.age_s / self._turn_s)
        return np.asarray(np.minimum(self._force * wave, FULL_N))


class Holds(Use):
    """The same object held again and again, compared at the end of each hold."""

    HELD_N, HELD_S, PAUSE_S = 2.0, 300.0, 6.0

    def spells(self, hours: float) -> Iterator[tuple[float, bool]]:
        """Yield one spell of work."""
        yield DT_S * round(hours * HOUR_S / DT_S), True

    def loads_n(self) -> FloatArray:
        """Return true loads (n,) of the next step."""
        self.age_s += DT_S
        self.age_s[self.age_s > self.HELD_S + self.PAUSE_S] = DT_S
        self.sample_s[:] = self.HELD_S - 2 * DT_S
        return np.where(self.age_s <= self.HELD_S, self.HELD_N, 0.0)


def score_use(sheets: Sequence[Sheets], hours: float, seed: int, kind_of_use: type[Use] = Use) -> Estimates:
    """Return force errors [N] of one reading of each contact.

    Columns: `kind`, `pad`, `hour`, `age`, `load` [N], `uncompensated` (error without compensation). There is
    no bound.
    """
    rng = np.random.default_rng((seed, 9))
    laws = [law for some in sheets for law in some.laws]
    states, one = [SheetStates(law) for law in laws], np.zeros(1, np.intp)
    behaviours = [stated_behaviour(some) for some in sheets for _ in some.laws]
    held = TickState.empty(len(laws))
    compensation = SheetForceCompensation(behaviours, round(DT_S * 1e9), held)
    gains = np.concatenate([some.gains for some in sheets])
    law_std = np.repeat([some.law_std for some in sheets], [len(some.laws) for some in sheets])
    kind = np.repeat([some.name for some in sheets], [len(some.laws) for some in sheets])
    use = kind_of_use(len(laws), rng)
    compared, press = np.zeros(len(laws), np.bool_), np.ones(len(laws))
    press_std = np.array([law.press_std for law in laws])
    noise_std = np.array([law.noise_std for law in laws])
    touching, loaded = np.zeros((2, len(laws)), np.bool_)
    none, t_ns, gone_s = np.zeros(len(laws)), 10**9, 0.0
    held.uncompensated_force_n[:] = held.uncompensated_std_n[:] = 0.0
    compensation.compensate_forces(t_ns)
    rows: list[dict[str, Any]] = []
    for long_s, is_work in use.spells(hours):
        for dt_s in [DT_S] * round(long_s / DT_S) if is_work else [long_s]:
            load = use.loads_n() if is_work else none
            t_ns += round(dt_s * 1e9)
            gone_s += dt_s
            smooth = np.zeros(len(laws))
            for pad in np.flatnonzero((load > 0) | loaded).tolist():  # an unloaded sheet doesn't change
                smooth[pad] = states[pad].advance(one, dt_s, load[pad])[0]
            loaded = load > 0
            flicker = 1 + noise_std / np.sqrt(np.maximum(smooth, 1e-3)) * rng.normal(size=len(laws))
            apparent = np.maximum(gains * press * smooth * flicker, 0.0)
            now = apparent > DETECTED_N
            if (began := np.flatnonzero(now & ~touching)).size:
                press[began] = np.exp(press_std[began] * rng.normal(size=len(began)))
                apparent[began] = (gains * press * smooth)[began]
                compensation.begin_contacts(began)
                compared[began] = False
            touching = now
            held.touching[:], held.uncompensated_force_n[:] = touching, apparent
            held.uncompensated_std_n[:] = law_std * apparent
            compensation.compensate_forces(t_ns)
            compensation.complete_update()
            due = np.flatnonzero(touching & ~compared & (load > 0) & (use.age_s >= use.sample_s))
            compared[due] = True
            rows += [
                {
                    "error": compensation.force_n[pad] - load[pad], "std": compensation.std_n[pad],
                    "kind": kind[pad], "pad": f"{seed}/{pad}",
                    "hour": gone_s / HOUR_S, "age": use.age_s[pad], "force": load[pad],
                    "valid": compensation.state[pad] == ForceReliability.RELIABLE,
                    "uncompensated": apparent[pad] - load[pad],
                }
                for pad in due.tolist()
            ]  # fmt: skip
    return _estimates(rows)


def _estimates(rows: Sequence[dict[str, Any]]) -> Estimates:
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    unknown, n = np.full((len(rows), 1, 1), np.nan), len(rows)
    return Estimates(
        column["error"].reshape(n, 1),
        np.square(column["std"]).reshape(n, 1, 1),
        column["valid"],
        unknown[:, 0, 0],
        unknown,
        {
            "kind": column["kind"],
            "pad": column["pad"],
            "hour": column["hour"],
            "age": bin_labels(column["age"], (1.0, 10.0, 60.0), "s"),
            "force": bin_labels(column["force"], (0.5, 2.0), "N"),
            "uncompensated": column["uncompensated"],
            "load": column["force"],
        },
    )


PADS, SEEDS = 8, (31, 32)
"""Sheets of each kind, and seeds of worlds and use."""
CUTS: dict[str, dict[str, Any]] = {
    "no adaptation compensation": {"adaptation_share": 0.0},
    "no creep compensation": {"creep_share": 0.0},
    "no parameter uncertainty": {"parameter_std_fraction": 0.0},
}
"""Changes of what the deployment file states."""
COMPLETE, UNLEARNED = "", "nothing learned"
PAPER = ("S1", "S2")


def kinds_of(world: str) -> tuple[SheetKind, ...]:
    """Return the kinds of sheets that are measured in a world, those of the paper among them."""
    kinds = () if world == "harsh" else tuple(SHEET_KINDS[name] for name in PAPER)
    return (*WORLDS[world].sheets.kinds(Family.REPORTING), *kinds)


def used(
    world: str, part: str, hours: float, seeds: Sequence[int], pads: int, kinds: Sequence[SheetKind] = ()
) -> Estimates:
    """Return force errors of kinds of sheets of a world, by default all, without a part of the compensation.

    `pads` sheets of each kind and seed are used side by side, by the first seed.
    """
    drawn = [WORLDS[world].draw(Family.REPORTING.seed(seed)) for seed in seeds]
    sheets = [drawn_sheets(one, kind, pads) for one in drawn for kind in kinds or kinds_of(world)]
    if part in CUTS:
        sheets = [replace(some, behaviour=some.behaviour.model_copy(update=CUTS[part])) for some in sheets]
    return score_use([replace(some, learns=part != UNLEARNED) for some in sheets], hours, drawn[0].seed)


def of_kinds(world: str, every: Estimates) -> Estimates:
    """Return the rows of the world's own kinds."""
    own = [kind.name for kind in WORLDS[world].sheets.kinds(Family.REPORTING)]
    return every.where(np.isin(every.columns["kind"], own or PAPER))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def force_row(some: Estimates, **names: str) -> dict[str, Any]:
    """Return a row of a table: forces with and without compensation."""
    good = some.where(some.valid)
    inside = good.distances() <= 1.96
    raw, error = rms(good.columns["uncompensated"]), rms(good.error)
    pads = good.columns["pad"]
    return {
        **names,
        "touches": len(some),
        "pads": len(np.unique(some.columns["pad"])),
        "uncompensated, N": raw,
        "compensated, N": error,
        "ratio": error / raw,
        "in 95 %": Share.of_mask(inside),
        "by pad": ClusterShare.of_mask(inside, pads) if len(np.unique(pads)) > 1 else None,
        "median width, N": 2 * 1.96 * float(np.median(np.sqrt(good.covariance))) if len(good) else math.nan,
        "valid, %": 100 * float(some.valid.mean()) if len(some) else None,
    }
