"""Behaviour of a simulated sheet under load: hysteresis, adaptation, creep, temperature, fluctuation.

Public names: `SheetLaw` (parameters of one sheet) with its parts `ElementCreep`, `PowerCreep`, `BackForces`;
`SheetState`, `advance`.

It has more kinds than the compensation in `handtouch.sheet` and uses nothing of it. Parts act in one order:
load -> + thermal preload -> hysteresis -> adaptation -> creep -> thermal gain -> fluctuation -> apparent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gamma

from handtouch.simulate.preisach import Everett, PreisachState

FloatArray = NDArray[np.float64]

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
    hysteresis: Everett | None = None
    gain_per_k: float = 0.0
    preload_n_per_k: float = 0.0
    press_std: float = 0.0
    """Relative standard deviation between presses, log-normal."""
    noise_std: float = 0.0
    """Relative standard deviation of flicker at 1 N; it goes as force^(-1/2)."""
    noise_time_s: float = 0.05


@dataclass
class SheetState:
    """State of one sheet."""

    loops: PreisachState
    back_n: FloatArray
    creep_n: FloatArray
    peak_n: float = 0.0
    """Greatest load of the present press; 0 between presses."""
    flow_s: float = 0.0
    """Total time of current flow."""

    @classmethod
    def fresh(cls, law: SheetLaw) -> SheetState:
        """Return the state of a sheet that was never pressed."""
        return cls(
            PreisachState(), np.zeros(len(law.adaptation.shares)), np.zeros(len(law.creep.elements[0]))
        )

    def copy(self) -> SheetState:
        """Return an independent copy."""
        return SheetState(
            self.loops.copy(), self.back_n.copy(), self.creep_n.copy(), self.peak_n, self.flow_s
        )


def advance(
    law: SheetLaw, state: SheetState, dt_s: float, load_n: float, is_excited: bool, warmer_k: float
) -> float:
    """Return the apparent load [N] at the end of an interval under a constant load >= 0; update `state`.

    It has no fluctuation. The step is exact for any `dt_s` under which current either flows throughout or
    doesn't flow.
    """
    load = max(load_n + law.preload_n_per_k * warmer_k, 0.0)
    if law.hysteresis:
        load = state.loops.apply(law.hysteresis, load)
    effective = _adapt(law.adaptation, state, dt_s, load, is_excited)
    weights, times = law.creep.elements
    state.creep_n += (effective - state.creep_n) * -np.expm1(-dt_s / times)
    np.minimum(state.creep_n, effective, out=state.creep_n)  # a release is abrupt
    reading = law.creep.instant * effective + float(weights @ state.creep_n)
    return reading * (1 + law.gain_per_k * warmer_k)


def _adapt(law: BackForces, state: SheetState, dt_s: float, load_n: float, is_excited: bool) -> float:
    """Return the effective load [N] at the end of the interval."""
    back_n = sum(state.back_n.tolist())
    flows = is_excited and load_n - back_n > law.threshold_n
    shares, times = law.elements
    if flows:
        speed = 1 + (state.flow_s + dt_s / 2) / law.fatigue_s  # integrated over dt
        state.back_n += (shares * load_n - state.back_n) * -np.expm1(-dt_s * speed / times)
        state.flow_s += dt_s
        back_n = sum(state.back_n.tolist())
    if not is_excited:
        state.back_n *= math.exp(-dt_s / law.recovery_s)
        back_n = sum(state.back_n.tolist())
    is_pressed = load_n > law.threshold_n
    if not is_pressed and 0 < state.peak_n < law.wipe_fraction * back_n:
        state.back_n[:] = 0.0
    state.peak_n = max(state.peak_n, load_n) if is_pressed else 0.0
    return load_n - back_n if flows else 0.0
