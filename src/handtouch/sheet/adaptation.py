"""Adaptation: under potential a sheet's response to a load decreases; a weak press resets it.

Public names: `Adaptation`, `AdaptationState`, `AdaptationStep`.

One *back force* per pad, like the back stress of kinematic hardening:
* the effective load is the load less the back force; below the threshold there is no useful response;
* while current flows, the back force creeps towards `share` of the load;
* without potential it decays;
* a press that stays well below the back force wipes it.
docs/theory.md states which of the paper's observations follow from these rules and which are only fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from handtouch.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class Adaptation:
    """Parameters of a material; each may be an array (n,), one element for each pad.

    share: limit of the back force over the load, 0 to 1. time_s: its time constant, counted while current
    flows. fatigue_s: time of current flow after which adaptation is twice as fast, three times after twice
    that; infinite: never. recovery_s: time constant without potential. wipe_fraction: a press whose peak is
    less than this fraction of the back force wipes it. threshold_n: least force with a useful response.
    Raises ValueError out of range.
    """

    share: npt.ArrayLike
    time_s: npt.ArrayLike
    recovery_s: npt.ArrayLike
    threshold_n: npt.ArrayLike
    fatigue_s: npt.ArrayLike = np.inf
    wipe_fraction: npt.ArrayLike = 0.9

    def __post_init__(self) -> None:
        for name in ("time_s", "recovery_s", "fatigue_s"):
            if not (np.asarray(getattr(self, name), np.float64) > 0).all():
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("share", "wipe_fraction"):
            value = np.asarray(getattr(self, name), np.float64)
            if not ((value >= 0) & (value <= 1)).all():
                raise ValueError(f"{name} must lie between 0 and 1, got {getattr(self, name)}")
        threshold = np.asarray(self.threshold_n, np.float64)
        if not ((threshold >= 0) & np.isfinite(threshold)).all():
            raise ValueError(f"threshold_n must be at least 0 and finite, got {threshold}")

    def initial_state(self, pads: int) -> AdaptationState:
        """Return the state of fresh sheets."""
        return AdaptationState(*(np.zeros(pads) for _ in fields(AdaptationState)))

    def discretise(self, dt_s: float | FloatArray) -> AdaptationStep:
        """Precompute one step of `dt_s`; (n,) for an interval per pad."""
        return AdaptationStep(self, dt_s)


@dataclass
class AdaptationState:
    """Adaptation state of n pads; arrays (n,)."""

    back_n: FloatArray
    peak_n: FloatArray
    """Greatest load of the present press; 0 between presses."""
    current_flow_s: FloatArray
    """Total time of current flow."""


class AdaptationStep:
    """Adaptation over one interval. n steps of dt under a constant load equal one of n dt, while there is a
    response throughout and potential doesn't change."""

    def __init__(self, adaptation: Adaptation, dt_s: float | FloatArray) -> None:
        share, time_s, recovery_s, threshold_n, fatigue_s, self._wipe_fraction = (
            np.asarray(getattr(adaptation, field.name), np.float64) for field in fields(adaptation)
        )
        self.share, self.threshold_n, self._dt_s = share, threshold_n, dt_s
        self._recovery_factor = np.exp(-dt_s / recovery_s)
        # d(back)/dt = (1 + flow / fatigue) (share load - back) / time, integrated over dt
        self._rate = -dt_s / time_s * (1 + dt_s / (2 * fatigue_s))
        self._fatigue_rate = -dt_s / (time_s * fatigue_s)
        self._remaining = np.exp(self._rate)
        self._has_fatigue = bool((self._fatigue_rate != 0).any())

    def remaining_fraction(self, state: AdaptationState) -> FloatArray:
        """Return the fraction of (share load - back force) that remains after the step, (n,) or ()."""
        if not self._has_fatigue:
            return self._remaining
        return np.asarray(np.exp(self._fatigue_rate * state.current_flow_s + self._rate))

    def forward(self, state: AdaptationState, load_n: FloatArray, powered: BoolArray) -> FloatArray:
        """Return the effective load (n,) [N] at the end of an interval under load (n,) >= 0, 0 where no
        current flows; update `state` in place."""
        flows = powered & (load_n - state.back_n > self.threshold_n)
        self.update_back_force(state, load_n, flows, self.remaining_fraction(state))
        self.recover(state, powered)
        self._wipe_back_force(state, load_n)
        return np.asarray(np.where(flows, load_n - state.back_n, 0.0))

    def inverse(self, state: AdaptationState, effective_n: FloatArray, remaining: FloatArray) -> FloatArray:
        """Return the load (n,) of an effective load, exact where that is positive and 0 elsewhere; update
        `state` in place. A load below the threshold leaves no trace, nor does the back force that it wipes.
        remaining: from `remaining_fraction`; recovery is left to `recover`."""
        flows = effective_n > 0
        load = (effective_n + state.back_n * remaining) / (1 - self.share * (1 - remaining))
        load *= flows
        self.update_back_force(state, load, flows, remaining)
        return np.asarray(load)

    def recover(self, state: AdaptationState, powered: BoolArray) -> None:
        """Let the back force decay where there is no potential."""
        if not powered.all():
            np.copyto(state.back_n, state.back_n * self._recovery_factor, where=~powered)

    def update_back_force(
        self, state: AdaptationState, load_n: FloatArray, flows: BoolArray, remaining: FloatArray
    ) -> None:
        """Move the back force towards its limit where current flows."""
        gap = self.share * load_n
        gap -= state.back_n
        gap *= 1 - remaining
        gap *= flows
        state.back_n += gap
        if self._has_fatigue:
            state.current_flow_s += self._dt_s * flows

    def _wipe_back_force(self, state: AdaptationState, load_n: FloatArray) -> None:
        pressed = load_n > self.threshold_n
        over = ~pressed & (state.peak_n > 0)
        state.back_n[over & (state.peak_n < self._wipe_fraction * state.back_n)] = 0.0
        np.maximum(state.peak_n, load_n, out=state.peak_n)
        state.peak_n *= pressed
