"""A real sheet, forwards: load that presses -> apparent load that the contact's resistance tells.

Public names: `SheetModel`, `Temperature`, `SheetState`, `SheetStep`, `SheetTrack`.

The *apparent* load is that under which a fresh, ideal layer would conduct the same: put it in the place of
the force in sigma = k / pressure^alpha (`field.ContactLaw`). The layer's conductance is then
(apparent / true)^alpha times the ideal one. Parts act in one order, and `handtouch.sheet.Compensator` undoes
them in the other:

    load -> + thermal preload -> hysteresis -> adaptation -> creep -> thermal gain -> fluctuation -> apparent
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.sheet.adaptation import Adaptation, AdaptationState
from handtouch.sheet.creep import Creep
from handtouch.sheet.fluctuation import Fluctuation, FluctuationState
from handtouch.sheet.hysteresis import PrandtlIshlinskii

FloatArray = npt.NDArray[np.float64]

STEADY = Creep(1.0, (), ())
STRAIGHT = PrandtlIshlinskii(1.0, (), ())
CALM = Fluctuation()


@dataclass(frozen=True)
class Temperature:
    """gain_per_k: relative growth of the apparent load. preload_n_per_k: load that swelling layers add [N/K];
    beyond the threshold it looks like a touch."""

    gain_per_k: float = 0.0
    preload_n_per_k: float = 0.0


COLD = Temperature()


@dataclass(frozen=True)
class SheetModel:
    """A material: what a bank of pads has in common. Parts left at their defaults do nothing."""

    adaptation: Adaptation
    creep: Creep = STEADY
    hysteresis: PrandtlIshlinskii = STRAIGHT
    temperature: Temperature = COLD
    fluctuation: Fluctuation = CALM

    def start(self, pads: int, seed: int = 1) -> SheetState:
        """Fresh sheets at rest; the seed is that of what fluctuates."""
        return SheetState(
            self.hysteresis.start(pads),
            self.adaptation.start(pads),
            self.creep.start(pads),
            self.fluctuation.start(pads, seed),
        )

    def at(self, dt_s: float) -> SheetStep:
        """What one step of `dt_s` needs, computed once."""
        if not 0 <= dt_s < np.inf:
            raise ValueError(f"dt_s must be at least 0 and finite, got {dt_s}")
        return SheetStep(self, dt_s)


@dataclass
class SheetState:
    """Of n pads: what their history has left in them."""

    plays: FloatArray
    adaptation: AdaptationState
    elements: FloatArray
    fluctuation: FluctuationState

    def copy(self) -> SheetState:
        """One that goes its own way, with the same luck."""
        return copy.deepcopy(self)


class SheetStep:
    """A model over one interval."""

    def __init__(self, model: SheetModel, dt_s: float) -> None:
        self._model, self._dt_s = model, dt_s
        self._adaptation, self._creep = model.adaptation.at(dt_s), model.creep.at(dt_s)

    def forward(
        self,
        state: SheetState,
        load_n: npt.ArrayLike,
        powered: npt.ArrayLike = True,
        warmer_k: npt.ArrayLike = 0.0,
    ) -> FloatArray:
        """Apparent load (n,) [N] at the end of an interval; `state` is carried on in place.

        load_n: true load over the interval [N]. powered: whether the layer is under potential; without it
        nothing is felt. warmer_k: temperature above that at which the contact law holds. All broadcast to
        (n,). Raises ValueError for a load that is negative or not finite.
        """
        load = np.asarray(load_n, np.float64)
        if load.shape != state.adaptation.back_n.shape:
            load = np.broadcast_to(load, state.adaptation.back_n.shape)
        if not ((load >= 0) & np.isfinite(load)).all():
            raise ValueError(f"loads must be at least 0 and finite, got {load}")
        warmth = np.asarray(warmer_k, np.float64)
        swelling = self._model.temperature
        pressing = np.maximum(load + swelling.preload_n_per_k * warmth, 0.0)
        pressing = self._model.hysteresis.step(state.plays, pressing)
        felt = self._adaptation.forward(state.adaptation, pressing, np.asarray(powered, np.bool_))
        reading = self._creep.forward(state.elements, felt) * (1 + swelling.gain_per_k * warmth)
        return self._model.fluctuation.step(state.fluctuation, reading, self._dt_s)


class SheetTrack:
    """A sheet's history as a function of time, for a simulator that asks for samples.

    The sheet goes along a grid of `step_s` from time 0, whoever asks when, so a time has one answer:
    `apparent_n(t)` depends on `t_s` alone. Asking backwards is allowed and costs the history again.

    loads, powered, warmer_k: true loads (n,) [N], and what `SheetStep.forward` takes with them, at a time
    [s]. What they say of the past must not change. Raises ValueError for a step that isn't positive.
    """

    def __init__(
        self,
        model: SheetModel,
        pads: int,
        loads: Callable[[float], npt.ArrayLike],
        *,
        seed: int = 1,
        step_s: float = 2e-3,
        powered: Callable[[float], npt.ArrayLike] = lambda _: True,
        warmer_k: Callable[[float], npt.ArrayLike] = lambda _: 0.0,
    ) -> None:
        if not 0 < step_s < np.inf:
            raise ValueError(f"step_s must be positive and finite, got {step_s}")
        self._model, self._step_s = model, step_s
        self._loads, self._powered, self._warmer_k = loads, powered, warmer_k
        self._fresh = model.start(pads, seed)
        self._stride = model.at(step_s)
        self._restart()

    def apparent_n(self, t_s: float) -> FloatArray:
        """Apparent loads (n,) [N] at `t_s` >= 0."""
        count = int(t_s / self._step_s)
        if count < self._count:
            self._restart()
        while self._count < count:
            self._count += 1
            self._forward(self._stride, self._state, self._count * self._step_s)
        rest = self._model.at(max(t_s - count * self._step_s, 0.0))
        return self._forward(rest, self._state.copy(), t_s)

    def factor(self, t_s: float) -> FloatArray:
        """Apparent over true load (n,), 0 where nothing presses; its power alpha multiplies the layer's
        conductance."""
        load = np.asarray(self._loads(t_s), np.float64)
        apparent = self.apparent_n(t_s)
        return np.divide(apparent, load, out=np.zeros_like(apparent), where=load > 0)

    def _forward(self, step: SheetStep, state: SheetState, t_s: float) -> FloatArray:
        return step.forward(state, self._loads(t_s), self._powered(t_s), self._warmer_k(t_s))

    def _restart(self) -> None:
        self._state, self._count = self._fresh.copy(), 0
