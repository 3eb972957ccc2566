"""Adaptation: a sheet under potential gets used to its load, and a press too small to be felt resets it.

Public names: `Adaptation`, `AdaptationState`, `AdaptationStep`.

One *back force* for each pad, as the back stress of kinematic hardening:
* what is felt is the load less the back force; nothing below the threshold of useful response;
* while current flows, the back force creeps towards `share` of the load;
* without potential it fades;
* a press that stays well below the back force wipes it.
docs/theory.md says which of the paper's observations follow from these rules and which are only fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Adaptation:
    """Numbers of a material; each may be an array (n,), one element for each pad.

    share: of the load that the back force tends to, 0 to 1. time_s: its time constant, counted while current
    flows. fatigue_s: that of flow after which it adapts twice as fast, three times after two of them;
    infinite: never. recovery_s: time constant without potential. wipe: a press whose peak is less than this
    fraction of the back force wipes it. threshold_n: least force of useful response. Raises ValueError out of
    range.
    """

    share: npt.ArrayLike
    time_s: npt.ArrayLike
    recovery_s: npt.ArrayLike
    threshold_n: npt.ArrayLike
    fatigue_s: npt.ArrayLike = np.inf
    wipe: npt.ArrayLike = 0.9

    def __post_init__(self) -> None:
        for name in ("time_s", "recovery_s", "fatigue_s"):
            if not (np.asarray(getattr(self, name), np.float64) > 0).all():
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("share", "wipe"):
            value = np.asarray(getattr(self, name), np.float64)
            if not ((value >= 0) & (value <= 1)).all():
                raise ValueError(f"{name} must lie between 0 and 1, got {getattr(self, name)}")
        threshold = np.asarray(self.threshold_n, np.float64)
        if not ((threshold >= 0) & np.isfinite(threshold)).all():
            raise ValueError(f"threshold_n must be at least 0 and finite, got {threshold}")

    def start(self, pads: int) -> AdaptationState:
        """Fresh sheets."""
        return AdaptationState(*(np.zeros(pads) for _ in fields(AdaptationState)))

    def at(self, dt_s: float | FloatArray) -> AdaptationStep:
        """What one step of `dt_s` needs, computed once; of (n,), each pad's own."""
        return AdaptationStep(self, dt_s)


@dataclass
class AdaptationState:
    """Of n pads; arrays (n,)."""

    back_n: FloatArray
    peak_n: FloatArray
    """Greatest load of the press in progress; 0 between presses."""
    flowed_s: FloatArray
    """How long current has flowed in the sheet's life."""


class AdaptationStep:
    """Adaptation over one interval; n steps of dt under a constant load are one of n dt, as long as the load
    is felt throughout and potential doesn't change."""

    def __init__(self, adaptation: Adaptation, dt_s: float | FloatArray) -> None:
        share, time_s, recovery_s, threshold_n, fatigue_s, self._wipe = (
            np.asarray(getattr(adaptation, field.name), np.float64) for field in fields(adaptation)
        )
        self.share, self.threshold_n, self._dt_s = share, threshold_n, dt_s
        self._fade = np.exp(-dt_s / recovery_s)
        # d(back)/dt = (1 + flowed / fatigue) (share load - back) / time, integrated over dt
        self._rate = -dt_s / time_s * (1 + dt_s / (2 * fatigue_s))
        self._tired = -dt_s / (time_s * fatigue_s)
        self._kept = np.exp(self._rate)
        self._tires = bool((self._tired != 0).any())

    def kept(self, state: AdaptationState) -> FloatArray:
        """Fraction of (share load - back force) that is left after the step, (n,) or ()."""
        if not self._tires:
            return self._kept
        return np.asarray(np.exp(self._tired * state.flowed_s + self._rate))

    def forward(self, state: AdaptationState, load_n: FloatArray, powered: BoolArray) -> FloatArray:
        """What is felt (n,) [N] at the end of an interval under load (n,) >= 0, 0 where no current flows;
        `state` is carried on in place."""
        flows = powered & (load_n - state.back_n > self.threshold_n)
        self.adapt(state, load_n, flows, self.kept(state))
        self.fade(state, powered)
        self._wipe_out(state, load_n)
        return np.asarray(np.where(flows, load_n - state.back_n, 0.0))

    def inverse(self, state: AdaptationState, felt_n: FloatArray, kept: FloatArray) -> FloatArray:
        """The load (n,) under which this is felt, exact where anything is felt and 0 elsewhere; `state` is
        carried on in place. A load that isn't felt leaves no trace, nor does what it wipes. kept: of `kept`;
        fading is left to `fade`."""
        flows = felt_n > 0
        load = (felt_n + state.back_n * kept) / (1 - self.share * (1 - kept))
        load *= flows
        self.adapt(state, load, flows, kept)
        return np.asarray(load)

    def fade(self, state: AdaptationState, powered: BoolArray) -> None:
        """Recover where there is no potential."""
        if not powered.all():
            np.copyto(state.back_n, state.back_n * self._fade, where=~powered)

    def adapt(self, state: AdaptationState, load_n: FloatArray, flows: BoolArray, kept: FloatArray) -> None:
        """Carry the back force on where current flows."""
        gap = self.share * load_n
        gap -= state.back_n
        gap *= 1 - kept
        gap *= flows
        state.back_n += gap
        if self._tires:
            state.flowed_s += self._dt_s * flows

    def _wipe_out(self, state: AdaptationState, load_n: FloatArray) -> None:
        pressed = load_n > self.threshold_n
        over = ~pressed & (state.peak_n > 0)
        state.back_n[over & (state.peak_n < self._wipe * state.back_n)] = 0.0
        np.maximum(state.peak_n, load_n, out=state.peak_n)
        state.peak_n *= pressed
