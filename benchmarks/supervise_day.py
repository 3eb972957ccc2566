"""A day of mixed use of sheets of which the estimator knows the preset only, for bench_supervise.

Some sheets are the preset with other parameters, others creep, adapt or have hysteresis by laws that the
estimator doesn't have. Periods without contact are one step each, exact whatever their length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch import sheet
from handtouch.config import Behaviour
from handtouch.core.sheet_force import ForceReliability, SheetForceCompensation, sheet_behaviour_of

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
FULL_N = 5.0
DT_S = 0.4
PADS = 40
"""of each kind"""
DETECTED_N = 0.05
EVERY = 5
"""steps between evaluated readings"""
HOUR_S = 3600.0
NIGHT_H = 16.0
"""when it begins"""
PRESETS = {"S1": sheet.S1, "S2": sheet.S2}
POWER = 0.04
LOOP = 0.06


class Preisach:
    """Hysteresis as sum of q_j(play_j) with curved q_j, as any Preisach operator is one (Brokate and Sprekels
    1996, 2.3): no sum of straight plays undoes it. As `PrandtlIshlinskii` it reads `full_n` right."""

    def __init__(self, loop: float, full_n: float, plays: int = 8) -> None:
        share = np.arange(1, plays + 1)[:, None] / (plays + 1)
        self._widths, self._full = full_n * share, full_n
        self._bend = np.linspace(0.7, 1.6, plays)[:, None]
        self._weight, self._base = 1.0, 0.0
        up = self._curved(np.maximum(full_n / 2 - self._widths, 0.0))
        down = self._curved(np.minimum(full_n - self._widths, full_n / 2))
        self._weight = loop * full_n / float((down - up).sum())
        self._base = 1 - float(self._curved(full_n - self._widths).sum()) * self._weight / full_n

    def initial_state(self, pads: int) -> FloatArray:
        return np.zeros((len(self._widths), pads))

    def apply_to(self, state: FloatArray, load_n: FloatArray) -> FloatArray:
        np.minimum(state, load_n, out=state)
        np.maximum(state, load_n - self._widths, out=state)
        return np.asarray(self._base * load_n + self._weight * self._curved(state).sum(axis=0))

    def _curved(self, play: FloatArray) -> FloatArray:
        return np.asarray(self._full * (play / self._full) ** self._bend)


class TwoTimes:
    """Adaptation of two parts, one quick and one slow, that are wiped alike; as `Adaptation` has one."""

    def __init__(self, one: sheet.Adaptation, quick: float = 0.3, ratio: float = 6.0) -> None:
        share, time_s = np.asarray(one.share), np.asarray(one.time_s)
        middle = time_s * ratio ** (quick - 0.5)
        self.parts = (
            replace(one, share=quick * share, time_s=middle / ratio**0.5),
            replace(one, share=(1 - quick) * share, time_s=middle * ratio**0.5),
        )

    def initial_state(self, pads: int) -> TwoStates:
        return TwoStates(*(part.initial_state(pads) for part in self.parts))

    def discretise(self, dt_s: float) -> TwoTimesStep:
        return TwoTimesStep(self.parts, dt_s)


class TwoStates(NamedTuple):
    """States of the two parts."""

    one: sheet.AdaptationState
    two: sheet.AdaptationState

    @property
    def back_n(self) -> FloatArray:
        return self.one.back_n + self.two.back_n


class TwoTimesStep:
    """Over one interval."""

    def __init__(self, parts: tuple[sheet.Adaptation, ...], dt_s: float) -> None:
        self._steps = [part.discretise(dt_s) for part in parts]
        self._threshold_n, self._wipe = np.asarray(parts[0].threshold_n), np.asarray(parts[0].wipe_fraction)

    def forward(self, states: TwoStates, load_n: FloatArray, powered: BoolArray) -> FloatArray:
        one, two = states
        flows = powered & (load_n - one.back_n - two.back_n > self._threshold_n)
        for state, step in zip(states, self._steps, strict=True):
            step.update_back_force(state, load_n, flows, step.remaining_fraction(state))
            step.recover(state, powered)
        pressed, back = load_n > self._threshold_n, states.back_n
        wiped = ~pressed & (one.peak_n > 0) & (one.peak_n < self._wipe * back)
        one.back_n[wiped] = two.back_n[wiped] = 0.0
        np.maximum(one.peak_n, load_n, out=one.peak_n)
        one.peak_n *= pressed
        return np.asarray(np.where(flows, load_n - one.back_n - two.back_n, 0.0))


def near(preset: sheet.SheetModel, rng: np.random.Generator, spread: float = 0.2) -> sheet.SheetModel:
    """The preset with other numbers."""
    factors = np.exp(rng.normal(0, spread, (3, PADS)))
    was = preset.adaptation
    adaptation = replace(
        was,
        time_s=np.asarray(was.time_s) * factors[0],
        fatigue_s=np.asarray(was.fatigue_s) * factors[1],
        share=np.maximum(1 - (1 - np.asarray(was.share)) * factors[2], 0.0),
    )
    late = (1 - preset.creep.instant) * float(np.exp(rng.normal(0, spread)))
    creep = sheet.Creep.first_order(1 - min(late, 0.9), 0.25 * float(np.exp(rng.normal(0, spread))))
    return replace(preset, adaptation=adaptation, creep=creep)


def far(preset: sheet.SheetModel, rng: np.random.Generator) -> sheet.SheetModel:
    return near(preset, rng, 0.5)


def power_law(preset: sheet.SheetModel, rng: np.random.Generator) -> sheet.SheetModel:
    return replace(near(preset, rng), creep=sheet.Creep.power_law(POWER, 0.1, 1e4))


def preisach(preset: sheet.SheetModel, rng: np.random.Generator) -> sheet.SheetModel:
    return replace(near(preset, rng), hysteresis=Preisach(LOOP, FULL_N))  # type: ignore[arg-type]


def two_times(preset: sheet.SheetModel, rng: np.random.Generator) -> sheet.SheetModel:
    made = near(preset, rng)
    return replace(made, adaptation=TwoTimes(made.adaptation))  # type: ignore[arg-type]


KINDS = {
    "parameters off by 20 %": near,
    "parameters off by 50 %": far,
    "creep by a power law": power_law,
    "Preisach hysteresis": preisach,
    "adaptation of two speeds": two_times,
}


class Use:
    """Use of a hand: grips of 2 to 40 s, some of minutes, of 0.1 to 5 N, half of them waxing and
    waning; pauses of 0.3 to 30 s; half of the grips of a pad are alike. Breaks, and a night from hour 16."""

    def __init__(self, pads: int, rng: np.random.Generator) -> None:
        self._rng, self._usual = rng, rng.uniform(0.5, 4.0, pads)
        self._force, self._swing, self._turn_s = np.zeros(pads), np.zeros(pads), np.ones(pads)
        self._left_s, self.age_s = rng.uniform(0, 20, pads), np.zeros(pads)

    def hours(self, hours: float) -> Iterator[tuple[float, bool]]:
        """Length [s] of each stretch and whether it is of work."""
        gone_s, work = 0.0, True
        while gone_s < hours * HOUR_S:
            at_night = gone_s >= NIGHT_H * HOUR_S
            long_s = HOUR_S if at_night else 60 * self._rng.uniform(*((15, 40) if work else (5, 60)))
            long_s = min(long_s, hours * HOUR_S - gone_s)
            yield DT_S * max(round(long_s / DT_S), 1), work and not at_night
            gone_s, work = gone_s + long_s, not work

    def load(self) -> FloatArray:
        """True loads (n,) of the next step."""
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
        wave = 1 + self._swing * np.sin(2 * np.pi * self.age_s / self._turn_s)
        return np.asarray(np.minimum(self._force * wave, FULL_N))


def day(preset: str, behaviour: Behaviour, hours: float, seed: int) -> dict[str, Any]:
    """Return the force errors of a hand with sheets of all kinds, as `summary`."""
    rng = np.random.default_rng([seed, preset == "S2"])
    models = [draw(PRESETS[preset], rng) for draw in KINDS.values()]
    states = [model.initial_state(PADS, seed + number) for number, model in enumerate(models)]
    steps = [model.discretise(DT_S) for model in models]
    pads = PADS * len(models)
    gain = np.exp(rng.normal(0, behaviour.gain_std, pads))
    strength = SheetForceCompensation([sheet_behaviour_of(behaviour)] * pads, round(DT_S * 1e9))
    use, kind = Use(pads, rng), np.repeat(np.arange(len(models)), PADS)
    touching, none, t_ns = np.zeros(pads, np.bool_), np.zeros(pads), 10**9
    strength.compensate_forces(none, none, touching, t_ns)
    readings: list[FloatArray] = []
    gone_s = 0.0
    for long_s, work in use.hours(hours):
        for number in range(round(long_s / DT_S) if work else 2):
            load, dt_s = use.load() if work else none, DT_S if work or number == 0 else long_s - DT_S
            if dt_s != DT_S:
                steps = [model.discretise(dt_s) for model in models]
            t_ns += round(dt_s * 1e9)
            gone_s += dt_s
            parts = zip(steps, states, load.reshape(len(models), -1), strict=True)
            apparent = gain * np.concatenate([step.forward(state, own) for step, state, own in parts])
            now = apparent > DETECTED_N
            if (began := np.flatnonzero(now & ~touching)).size:
                strength.begin_contacts(began)
            touching = now
            strength.compensate_forces(apparent, none, touching, t_ns)
            if dt_s != DT_S:
                steps = [model.discretise(DT_S) for model in models]
            if number % EVERY == 0 and work:
                valid = strength.state == ForceReliability.RELIABLE
                columns = (kind, use.age_s, apparent - load, strength.force_n - load, strength.std_n, valid)
                readings.append(np.stack([np.full(pads, gone_s / HOUR_S), *columns])[:, touching])
    return summary(np.concatenate(readings, axis=1), hours)


def summary(readings: FloatArray, hours: float) -> dict[str, Any]:
    """Errors in % of full scale: of each kind, of all, and by the hour."""
    hour, kind, age_s, raw, off, std, valid = readings

    def figures(some: BoolArray) -> dict[str, float]:
        good = some & (valid > 0)
        return {
            "uncompensated": rms(raw[good]),
            "compensated": rms(off[good]),
            "stated": rms(std[good]),
            "first second": rms(off[good & (age_s < 1)]),
            "inside 95 %": float((np.abs(off) < 1.96 * std)[good].mean()),
            "valid": float((valid > 0)[some].mean()),
        }

    edges = np.linspace(0, hours, 25)
    bins = [(valid > 0) & (hour >= low) & (hour < high) for low, high in pairwise(edges)]
    return {
        "kinds": {name: figures(kind == number) for number, name in enumerate(KINDS)},
        "all": figures(np.ones(len(kind), np.bool_)),
        "curve": [
            [float(edges[k]), rms(raw[b]), rms(off[b]), rms(std[b])] for k, b in enumerate(bins) if b.any()
        ],
    }


def rms(value: FloatArray) -> float:
    return 100 * float(np.sqrt(np.mean(np.square(value)))) / FULL_N if len(value) else 0.0
