"""Baseline and sheet force compensation: what a held object, slow presses and hours of use show.

Drift and sheets are those of the [worlds](../worlds.md), seeds of the reporting family; the daemon knows what
the deployment file states of them. Two processes share the work. Costs are in [tick](tick.md).

*Held object*: five pads of fifteen hold something while zeros, temperature and supply drift as in each world.
The error is that of the force at the end against the same grip at its start; below, without parts of the
compensation. *A hand that gets warm*: 8 K more within some minutes, and back 12 minutes later, with the same
grip held for 25. The other pads are touched lightly, with twice the current of the threshold, before and
while it is warm. Channels drift by 2 counts/K (rms), a part of it common to all. Errors are against the
grip's first seconds, and against the touch before. *Turned over*: four times a minute, untouched for ten
minutes and then with the same grip for ten; each channel reads 4 counts (rms) more for a unit of gravity
along each axis of its link. *Slow presses*: on a pad of the shipped hand, begin_threshold_n 0.06 N,
max_rise_time_s 20.

*Mixed use*: sheets of each [kind](../worlds.md#kinds-of-sheets) of the reporting family and of the paper's
two: grips of 2 to 40 s, some of minutes, half of them waxing and waning, and breaks. The deployment file
describes sheets as their builder would; contact layers differ as in the world. Contacts are given their load:
errors of position, currents and radius are in [worlds](worlds.md). In `ideal` sheets have no behaviour; the
paper's are there exactly as in the file, one seed. One reading of each contact, at a random age. Errors rms
of valid forces; *ratio*: compensated over uncompensated; *nothing learned*: same seeds, creep and adaptation
of the file instead of learned ones. *By pad*: with the interval of the scatter between pads, as readings of
one pad share gain and parameters. *Width* of the stated 95 % interval. *All* are the world's own kinds, also
by age of the contact. *Effect of the parts*: the first seed in `default`, its own kinds, a third of the time.
*Sheets that weren't measured*: the same with `preset = "unknown"`, which hold one object again and again,
compared at the end of each hold; `force_status` is `valid` after three contacts. A day of the same use is in
[soak_sheets](soak_sheets.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, Rows, options, progress
from benchmarks.scores import Estimates, Share, concatenate, slices
from benchmarks.sheet_use import (
    COMPLETE,
    CUTS,
    FULL_N,
    HOUR_S,
    PADS,
    SEEDS,
    UNLEARNED,
    Holds,
    drawn_sheets,
    force_row,
    kinds_of,
    of_kinds,
    rms,
    score_use,
    used,
)
from benchmarks.touched_pads import hands
from handtouch.config import Behaviour
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import Cycle, Slab
from handtouch.core.tick import TickProcessor
from handtouch.simulate.electronics_drift import ElectronicsDrift
from handtouch.simulate.worlds import WORLDS, Family
from tests.exact_pads import ExactNetworks

FloatArray = NDArray[np.float64]
PERIOD_NS = 100_000_000
DRIFTS = {name: world.only("electronics").draw(Family.REPORTING.seed(71)) for name, world in WORLDS.items()}
SPAN_S = 60.0  # of drift that is drawn at once
HELD = 5  # pads
HOLDS = (1, 2, 4, 8)
"""Numbers of the holds that are compared on sheets that weren't measured."""
DAY, PARTS = "Mixed use of sheets", "Effect of the parts"
UNKNOWN = "Sheets that weren't measured"
WARM, TURNED = "A hand that gets warm", "A hand that is turned over"


class Rig:
    """A hand whose channels drift; currents of contacts in the middle of its pads are given in counts."""

    def __init__(self, model: PadModel, seed: int, world: str = "ideal") -> None:
        self.model, self.tick, self.slab = model, TickProcessor(model, PERIOD_NS), Slab(model.size)
        self.cycle = Cycle(PERIOD_NS, 0.6)
        self._rng = np.random.default_rng(seed)
        names = list(zip(model.hands, model.links, strict=True))
        self._climate = ElectronicsDrift(DRIFTS[world], names)
        self._zeros = np.zeros((0, model.size, 4))
        self._at = 0
        exact = ExactNetworks(model)
        self.fractions = exact.fractions(np.arange(model.size), *(0.5 * exact.sides).T).T
        self._up = np.zeros(model.size, np.uint8)
        self.t_ns = 10**9

    def step(self, contact_counts: FloatArray, zero: FloatArray | float = 0.0) -> None:
        """A period under contacts of these sums of channels (n,), with zeros off by `zero` (n, 4)."""
        self.t_ns += PERIOD_NS
        if self._at == len(self._zeros):
            times_s = self.t_ns * 1e-9 - 1 + np.arange(0, SPAN_S, PERIOD_NS * 1e-9)
            self._zeros, self._at = self._climate.zero_counts(times_s), 0
        counts = self.fractions * contact_counts[:, None] + self._zeros[self._at] + zero
        self._at += 1
        counts += self._rng.standard_normal(counts.shape)
        self.tick.prepare_next_tick()
        self.slab.begin_cycle(self.t_ns)
        self.cycle.begin_cycle(self.t_ns)
        for slot, data in enumerate(np.rint(counts).astype("<i2")):
            self.slab.write_pdo(slot, data.tobytes(), self.t_ns + 1000)
        run_tick(self.tick, self.slab, self._up, self.cycle)


# Held object


def without_common(tick: TickProcessor) -> None:
    tick.baseline._hand_membership[:] = 0.0


def without_baseline(tick: TickProcessor) -> None:
    tick.baseline.update_baseline = lambda *_: False  # type: ignore[method-assign]


def without_following(tick: TickProcessor) -> None:
    """The first minute's baseline is the last."""
    baseline, learn, ends_ns = tick.baseline, tick.baseline.update_baseline, [0]

    def still(sync_ns: int, touching: NDArray[np.bool_]) -> bool:
        ends_ns[0] = ends_ns[0] or sync_ns + 50 * 10**9
        return sync_ns < ends_ns[0] and learn(sync_ns, touching)

    baseline.update_baseline = still  # type: ignore[method-assign]


HALVES: dict[str, Callable[[TickProcessor], None]] = {
    "all compensation": lambda _: None,
    "without the common mode": without_common,
    "followed for a minute only": without_following,
    "without any baseline": without_baseline,
}


def held(world: str, name: str, seconds: float) -> Rows:
    """An object held in five pads of fifteen: forces at the end against those at the start."""
    rig = Rig(hands(15), 71, world)
    HALVES[name](rig.tick)
    none = np.zeros(rig.model.size)
    grip = grips(rig.model)
    for _ in range(round(60e9 / PERIOD_NS)):
        rig.step(none)
    early, late, lost = [], [], set()
    total = round(seconds * 1e9 / PERIOD_NS)
    for number in range(total):
        rig.step(grip)
        if 20 <= number < 220:
            early.append(rig.tick.columns.force_n[:HELD].copy())
        elif number >= total - 200:
            late.append(rig.tick.columns.force_n[:HELD].copy())
        if number >= 20:
            lost |= set(np.flatnonzero(~rig.tick.state.touching[:HELD]).tolist())
    off = np.mean(late, axis=0) / np.mean(early, axis=0) - 1
    begun = rig.tick.contacts.begun_count
    for _ in range(round(60e9 / PERIOD_NS)):
        rig.step(none)
    return [
        {
            "world": world,
            "case": name,
            "force error, worst of five": f"{100 * float(np.abs(off).max()):.2f} %",
            "rms": f"{100 * float(np.sqrt(np.mean(off**2))):.2f} %",
            "contacts ever lost, of five": len(lost),
            "false contacts": int(begun - HELD),
            "not released after": int(np.count_nonzero(rig.tick.state.touching[:HELD])),
        }
    ]


# A hand that gets warm, and one that is turned over


def grips(model: PadModel) -> FloatArray:
    grip = np.zeros(model.size)
    grip[:HELD] = model.begin_threshold_counts[:HELD] * np.geomspace(5, 60, HELD)
    return grip


def follow(rig: Rig, seconds: float, zero: Callable[[float], FloatArray]) -> dict[str, Any]:
    """Five pads of fifteen hold on for so long while zeros move, and the others are touched lightly before
    and during that: force errors, and contacts that are none."""
    light = np.where(np.arange(rig.model.size) < HELD, 0.0, 2 * rig.model.begin_threshold_counts)
    again = 600 + round(seconds * 4)
    held, touches = [], []
    begun = rig.tick.contacts.begun_count
    for number in range(600 + round(seconds * 10)):
        touched = 300 <= number < 350 or again <= number < again + 50
        rig.step(grips(rig.model) * (number >= 600) + light * touched, zero(0.1 * number))
        if number >= 620:
            held.append(rig.tick.columns.force_n[:HELD].copy())
        if number in (349, again + 49):
            touches.append(rig.tick.columns.force_n[HELD:].copy())
    force = np.array(held)
    off = force / np.median(force[:50], axis=0) - 1
    return {
        "held, rms": f"{100 * float(np.sqrt(np.nanmean(off**2))):.2f} %",
        "held, worst": f"{100 * float(np.nanmax(np.abs(off))):.2f} %",
        "light touch, rms": f"{100 * float(np.sqrt(np.mean((touches[1] / touches[0] - 1) ** 2))):.1f} %",
        "contacts lost or false": int(
            abs(rig.tick.contacts.begun_count - begun - 2 * rig.model.size + HELD) + np.isnan(force).any()
        ),
    }


def warm(alike: float, name: str) -> Rows:
    """8 K more within minutes, and back; channels drift by 2 counts/K rms, `alike` of it in common."""
    rig, rng = Rig(hands(15), 74), np.random.default_rng(74)
    HALVES[name](rig.tick)
    own = rng.normal(size=(rig.model.size, 4))
    own *= np.sqrt((1 - alike**2) / np.mean(own**2))
    per_k = 2.0 * (alike + own)

    def zero(t_s: float) -> FloatArray:
        warmth = 8 * (-np.expm1(-max(t_s - 180, 0) / 180) + np.expm1(-max(t_s - 900, 0) / 180))
        return np.asarray(per_k * warmth)

    return [{"in common": f"{100 * alike:.0f} %", "case": name, **follow(rig, 1500, zero)}]


def turned(known: bool) -> Rows:
    """Turned over every quarter of a minute or so; gravity causes 4 counts rms along each axis."""
    rig, rng = Rig(hands(15), 75), np.random.default_rng(75)
    by_gravity = rng.normal(0, 4.0, (rig.model.size, 4, 3))
    ways, speeds = rng.normal(size=(2, 3)), np.array([0.21, 0.34, 0.55])

    def zero(t_s: float) -> FloatArray:
        way = ways[0] * np.sin(speeds * t_s) + ways[1] * np.cos(speeds[::-1] * t_s)
        way /= np.linalg.norm(way)
        if known:
            rig.tick.baseline.set_felt_gravity(np.tile(way, (rig.model.size, 1)))
        return np.asarray(by_gravity @ way)

    none = np.zeros(rig.model.size)
    for number in range(6000):
        rig.step(none, zero(0.1 * number))
    return [{"joint states": "known" if known else "unknown", **follow(rig, 600, zero)}]


# Slow presses


def slow(quick: bool) -> Rows:
    """A press that grows at a steady speed: where it is found, and what the baseline has taken of it."""
    rows = []
    for speed in (3e-3, 1e-2, 1e-1) if quick else (3e-4, 1e-3, 3e-3, 1e-2, 1e-1):
        rig = Rig(hands(15), 72)
        model = rig.model
        per_law = (
            model.begin_threshold_counts[0] / model.touch.begin_threshold_n[0] ** 1.5
        )  # light contacts: the layer dominates
        none = np.zeros(model.size)
        for _ in range(round(10e9 / PERIOD_NS)):
            rig.step(none)
        found, force = math.nan, 0.0
        while force < 0.3:
            force += speed * PERIOD_NS * 1e-9
            press = none.copy()
            press[0] = per_law * force**1.5
            rig.step(press)
            if math.isnan(found) and rig.tick.state.touching[0]:
                found = force
        taken = float(rig.tick.baseline.expected_counts[0].sum()) / press[0]
        rows.append(
            {
                "speed, N/s": speed,
                "found at, N": round(found, 3) if found == found else None,
                "part of its current taken for baseline, at 0.3 N": f"{100 * taken:.1f} %",
            }
        )
    return rows


# Hours on sheets


def unmeasured(seed: int, pads: int) -> Estimates:
    """Return force errors of one object held again and again; all sheets are stated as unknown."""
    drawn = WORLDS["default"].draw(Family.REPORTING.seed(seed))
    sheets = [drawn_sheets(drawn, kind, pads) for kind in kinds_of("default")]
    unknown = [replace(some, behaviour=Behaviour(preset="unknown")) for some in sheets]
    hours = (HOLDS[-1] + 0.5) * (Holds.HELD_S + Holds.PAUSE_S) / HOUR_S
    return score_use(unknown, hours, drawn.seed, Holds)


def unknown_rows(every: Estimates) -> Rows:
    """Return rows of holds on sheets that don't adapt and on those that do."""
    films = np.isin(every.columns["kind"], ("fsr", "flexiforce"))
    number = np.ceil(every.columns["hour"] * HOUR_S / (Holds.HELD_S + Holds.PAUSE_S)).astype(np.intp)
    rows: Rows = []
    for sheets, chosen in (("fsr, flexiforce: not adapting", films), ("conductive_film, S1, S2", ~films)):
        for hold in HOLDS:
            some = every.where(chosen & (number == hold))
            width = 2 * 1.96 * np.sqrt(some.covariance[:, 0, 0])
            rows.append(
                {
                    "sheets": sheets,
                    "hold": hold,
                    "pads": len(some),
                    "uncompensated, N": rms(some.columns["uncompensated"]),
                    "compensated, N": rms(some.error),
                    "in 95 %": Share.of_mask(some.distances() <= 1.96),
                    "median width, N": float(np.median(width)),
                    "valid, %": f"{100 * some.valid.mean():.0f}",
                }
            )
    return rows


# The page


def force_tables(found: dict[tuple[str, str], Estimates]) -> tuple[Rows, Rows]:
    """Return the rows of the whole and of its parts, from what was found by world and part."""
    whole: Rows = []
    for world in WORLDS:
        every, before = found[world, COMPLETE], found.get((world, UNLEARNED))
        own = of_kinds(world, every)
        chosen = [(kind, every.columns["kind"] == kind, some) for kind, some in slices(every, "kind")]
        in_own = np.isin(every.columns["kind"], own.columns["kind"])
        for age, some in slices(own, "age"):
            chosen.append((f"all, {age}", in_own & (every.columns["age"] == age), some))
        for name, rows, some in (*chosen, ("all", in_own, own)):
            row = force_row(some, world=world, sheet=name)
            row["nothing learned, N"] = rms(before.error[rows & before.valid]) if before else "-"
            whole.append(row)
    parts = [
        force_row(of_kinds(world, some), part=part) for (world, part), some in found.items() if part in CUTS
    ]
    return whole, parts


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="of mixed use (default: 2)")
    asked = parser.parse_args()
    quick = asked.quick
    hours, held_s, pads = (0.25, 120.0, 2) if quick else (asked.hours, 3600.0, PADS)
    names = list(HALVES)
    tasks: list[tuple[str, Callable[..., Any], tuple[Any, ...]]] = []
    tasks += [("Held object", held, (world, names[0], held_s)) for world in WORLDS]
    tasks += [("Held object", held, ("default", name, held_s)) for name in names[1:]]
    tasks += [(WARM, warm, (alike, name)) for alike in (0.0, 0.5, 0.9) for name in names[:3]]
    tasks += [(TURNED, turned, (known,)) for known in (True, False)]
    tasks += [("Slow presses", slow, (quick,))]
    with ProcessPoolExecutor(2) as pool:
        parts_of: dict[tuple[str, str], tuple[int, ...]] = {
            (world, COMPLETE): SEEDS[:1] if quick or world == "ideal" else SEEDS for world in WORLDS
        }
        parts_of["default", UNLEARNED] = parts_of["default", COMPLETE]
        parts_of |= {("default", part): SEEDS[:1] for part in CUTS}
        running = {
            (world, part): pool.submit(used, world, part, hours / (3 if part in CUTS else 1), seeds, pads)
            for (world, part), seeds in parts_of.items()
        }
        not_measured = [pool.submit(unmeasured, seed, pads) for seed in SEEDS]
        waiting = [(title, pool.submit(call, *given)) for title, call, given in tasks]
        found: dict[tuple[str, str], Estimates] = {}
        for key, future in running.items():
            found[key] = future.result()
            progress(f"sheets of {key[0]}, {key[1] or 'complete'}: {len(found[key])} contacts")
        parts: dict[str, Rows] = {title: [] for title in ("Held object", WARM, TURNED, "Slow presses")}
        for title, rows in waiting:
            parts[title].extend(rows.result())
            progress(f"{title}: {parts[title][-1]}")
    parts[DAY], parts[PARTS] = force_tables(found)
    parts[UNKNOWN] = unknown_rows(concatenate([future.result() for future in not_measured]))
    report = Report(
        quick, sheets_of_a_kind=pads, hours_of_mixed_use=hours, held_for_s=held_s, greatest_force_n=FULL_N
    )
    for title, found_rows in parts.items():
        report.table(title, found_rows)
    report.keep()


if __name__ == "__main__":
    main()
