"""Behaviour of a simulated sheet under load: hysteresis, adaptation, creep, temperature, fluctuation.

Public names: `SheetLaw` (parameters of one sheet) with its parts `ElementCreep`, `PowerCreep`, `BackForces`;
`SheetStates`; `CALIBRATION_S`.

It has more kinds than the compensation in `handtouch.sheet` and uses nothing of it. Parts act in one order:
load -> + thermal preload -> hysteresis -> adaptation -> creep -> thermal gain -> fluctuation -> apparent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gamma

from handtouch.arrays import FloatArray, IntArray
from handtouch.simulate.preisach import HomogeneousLoops, Loops, PlayLoops
from handtouch.simulate.stages.histories import HistoryStage

_MAX_TURNS: Final = 128
"""Turning points of its load that a sheet remembers, of 64 nested cycles; the smallest are forgotten first"""
CALIBRATION_S: Final = 1.0
"""For how long a weight is held by which a sensor is calibrated: docs/responses.md"""
_SHORTEST_S, _LONGEST_S = 1e-5, 1e9
_ELEMENTS_PER_DECADE = 3


class CreepLaw(Protocol):
    """Response to a unit step of load: instant + sum of weights (1 - exp(-t / times_s))."""

    @property
    def instant(self) -> float: ...
    @property
    def elements(self) -> tuple[FloatArray, FloatArray]:
        """Weights and times [s], each (elements,)."""


@dataclass(frozen=True)
class ElementCreep:
    """A few Kelvin-Voigt elements."""

    instant: float = 1.0
    weights: tuple[float, ...] = ()
    times_s: tuple[float, ...] = ()

    @cached_property
    def elements(self) -> tuple[FloatArray, FloatArray]:
        """Weights and times [s], each (elements,)."""
        return np.array(self.weights), np.array(self.times_s)


@dataclass(frozen=True)
class PowerCreep:
    """Power law: a step of load reads (t / 1 s)^exponent times the load, from 1 ms to a day.

    Its spectrum is exact, t^n = n / Gamma(1 - n) times the integral of (1 - exp(-t / T)) T^(n - 1) dT; the
    integral over ln T is a sum, and faster elements are instant. Raises ValueError for an exponent that isn't
    above 0 and up to 0.5.
    """

    exponent: float

    def __post_init__(self) -> None:
        if not 0 < self.exponent <= 0.5:
            raise ValueError(f"exponent must lie above 0 and up to 0.5, got {self.exponent}")

    @property
    def instant(self) -> float:
        """Part of the response that is settled at once."""
        return float(self._shortest_s**self.exponent / gamma(1 - self.exponent))

    @cached_property
    def elements(self) -> tuple[FloatArray, FloatArray]:
        """Weights and times [s], each (elements,)."""
        n, step = self.exponent, math.log(10) / _ELEMENTS_PER_DECADE
        decades = math.log10(_LONGEST_S / _SHORTEST_S)
        times = np.geomspace(_SHORTEST_S, _LONGEST_S, round(_ELEMENTS_PER_DECADE * decades) + 1)
        return n / gamma(1 - n) * times**n * step, times

    @property
    def _shortest_s(self) -> float:
        """Lower end of the first element's interval of ln T."""
        return _SHORTEST_S * 10 ** (-0.5 / _ELEMENTS_PER_DECADE)


@dataclass(frozen=True)
class BackForces:
    """Adaptation: back forces creep towards their shares of the load while current flows.

    The effective load is the load less their sum; up to `threshold_n` there is no response. Current speeds
    adaptation up, twice as fast after `fatigue_s`. Without excitation back forces decay; a press whose peak
    stays below `wipe_fraction` of them wipes them. Under a constant load from time 0 the effective load is
    load (1 - sum of shares (1 - exp(-t / times_s))).
    """

    shares: tuple[float, ...] = ()
    times_s: tuple[float, ...] = ()
    recovery_s: float = 5400.0
    threshold_n: float = 0.0
    fatigue_s: float = math.inf
    wipe_fraction: float = 0.9

    @cached_property
    def elements(self) -> tuple[FloatArray, FloatArray]:
        """Shares and times [s], each (speeds,)."""
        return np.array(self.shares), np.array(self.times_s)


@dataclass(frozen=True)
class SheetLaw:
    """True behaviour of one sheet; parts left at their defaults have no effect."""

    adaptation: BackForces = BackForces()
    creep: CreepLaw = ElementCreep()
    hysteresis: Loops | None = None
    gain_per_k: float = 0.0
    preload_n_per_k: float = 0.0
    press_std: float = 0.0
    """Relative standard deviation between presses, log-normal."""
    noise_std: float = 0.0
    """Relative standard deviation of flicker at 1 N; it goes as force^(-1/2)."""
    noise_time_s: float = 0.05
    calibration_n: float | None = None
    """Force that a new sheet reads as it is after `CALIBRATION_S`; None: as loops and creep make it."""


class SheetStates:
    """States of `count` sheets of one law, that were never pressed."""

    def __init__(self, law: SheetLaw, count: int = 1) -> None:
        self._law, self._count, self._gain = law, count, 1.0
        if law.calibration_n is not None:
            weighed = SheetStates(replace(law, calibration_n=None))
            reading_n = weighed.advance(np.zeros(1, np.intp), CALIBRATION_S, law.calibration_n)
            self._gain = law.calibration_n / float(reading_n[0])
        self._arrays = {
            "turning_n": np.zeros((count, _MAX_TURNS)),  # of the load: 0, maximum, minimum, ... and present
            "turns": np.ones(count, np.intp),  # of these points that still count
            "back_n": np.zeros((count, len(law.adaptation.shares))),
            "creep_n": np.zeros((count, len(law.creep.elements[0]))),
            "peak_n": np.zeros(count),  # greatest load of the present press; 0 between presses
            "flow_s": np.zeros(count),  # total time of current flow
        }
        self._stage = HistoryStage(
            _law_numbers(law), {name: array.reshape(-1).data for name, array in self._arrays.items()}
        )

    def reset(self, sheet: int) -> None:
        """Replace a sheet by one that was never pressed."""
        for name, array in self._arrays.items():
            array[sheet] = name == "turns"

    def copy(self) -> SheetStates:
        """Return an independent copy."""
        copied = SheetStates(self._law, self._count)
        for name, array in self._arrays.items():
            copied._arrays[name][:] = array
        return copied

    def __deepcopy__(self, memo: object) -> SheetStates:
        """Return an independent copy."""
        return self.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return _states_of, (self._law, self._count, self._arrays)

    def advance(
        self,
        sheets: IntArray,
        dt_s: ArrayLike,
        load_n: ArrayLike,
        is_excited: ArrayLike = True,
        warmer_k: ArrayLike = 0.0,
    ) -> FloatArray:
        """Return the apparent loads (k,) [N] at the ends of intervals (k,), one after another, under constant
        loads >= 0, each of one of the `sheets` (k,); update their states.

        They have no fluctuation. An interval is exact for any `dt_s` under which current either flows
        throughout or doesn't flow.
        """
        count = len(sheets)
        columns = np.empty((3, count))
        columns[0], columns[1], columns[2] = dt_s, load_n, warmer_k
        excited, apparent_n = np.empty(count, np.uint8), np.empty(count)
        excited[:] = is_excited
        memory: list[Any] = [array.data for array in (sheets, *columns[:2], excited, columns[2], apparent_n)]
        self._stage.advance(*memory)
        return apparent_n * self._gain


def _states_of(law: SheetLaw, count: int, arrays: dict[str, NDArray[Any]]) -> SheetStates:
    states = SheetStates(law, count)
    for name, array in arrays.items():
        states._arrays[name][:] = array
    return states


def _law_numbers(law: SheetLaw) -> dict[str, Any]:
    """Return the law as `HistoryStage` takes it."""
    loops, back = law.hysteresis, law.adaptation
    plays = loops if isinstance(loops, PlayLoops) else None
    weights, times_s = law.creep.elements
    shares, back_times_s = back.elements
    return {
        "preload_n_per_k": law.preload_n_per_k,
        "gain_per_k": law.gain_per_k,
        "instant": law.creep.instant,
        "threshold_n": back.threshold_n,
        "recovery_s": back.recovery_s,
        "fatigue_s": back.fatigue_s,
        "wipe_fraction": back.wipe_fraction,
        "has_loops": loops is not None,
        "exponent": loops.exponent if isinstance(loops, HomogeneousLoops) else 0.0,
        "linear": plays.linear if plays else 1.0,
        "play_weight": plays.weight if plays else 0.0,
        "plays_n": np.array(plays.thresholds_n if plays else []).data,
        "weights": weights.data,
        "times_s": times_s.data,
        "shares": shares.data,
        "back_times_s": back_times_s.data,
    }
