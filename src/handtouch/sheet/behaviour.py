"""Forward model of a sheet: true load -> apparent load that follows from the contact's resistance.

Public names: `SheetModel`, `TemperatureResponse`, `SheetModelState`, `SheetStep`.

The *apparent* load is the load under which a fresh, ideal layer has the same conductance: it replaces the
force in sigma = k / pressure^alpha (`field.ContactLaw`). The layer's conductance is then
(apparent / true)^alpha times the ideal one. Parts act in one order, and `handtouch.sheet.SheetCompensator`
undoes them in reverse:

    load -> + thermal preload -> hysteresis -> adaptation -> creep -> thermal gain -> fluctuation -> apparent
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.sheet.adaptation import Adaptation, AdaptationState
from handtouch.sheet.creep import Creep
from handtouch.sheet.fluctuation import Fluctuation, FluctuationState
from handtouch.sheet.hysteresis import PrandtlIshlinskii

NO_CREEP = Creep(1.0, (), ())
NO_HYSTERESIS = PrandtlIshlinskii(1.0, (), ())
NO_FLUCTUATION = Fluctuation()


@dataclass(frozen=True)
class TemperatureResponse:
    """Effects of temperature. gain_per_k: relative increase of the apparent load. preload_n_per_k: load added
    by swelling layers [N/K]; beyond the threshold it looks like a contact."""

    gain_per_k: float = 0.0
    preload_n_per_k: float = 0.0


NO_TEMPERATURE_EFFECT = TemperatureResponse()


@dataclass(frozen=True)
class SheetModel:
    """Model of a material, shared by a bank of pads. Parts left at their defaults have no effect."""

    adaptation: Adaptation
    creep: Creep = NO_CREEP
    hysteresis: PrandtlIshlinskii = NO_HYSTERESIS
    temperature: TemperatureResponse = NO_TEMPERATURE_EFFECT
    fluctuation: Fluctuation = NO_FLUCTUATION

    def initial_state(self, pads: int, seed: int = 1) -> SheetModelState:
        """Return the state of fresh sheets without load; the seed is for fluctuations."""
        return SheetModelState(
            self.hysteresis.initial_state(pads),
            self.adaptation.initial_state(pads),
            self.creep.initial_state(pads),
            self.fluctuation.initial_state(pads, seed),
        )

    def discretise(self, dt_s: float) -> SheetStep:
        """Precompute one step of `dt_s`. Raises ValueError unless it is at least 0 and finite."""
        if not 0 <= dt_s < np.inf:
            raise ValueError(f"dt_s must be at least 0 and finite, got {dt_s}")
        return SheetStep(self, dt_s)


@dataclass
class SheetModelState:
    """State of n pads' sheets, left by their history."""

    plays: FloatArray
    adaptation: AdaptationState
    creep_elements: FloatArray
    fluctuation: FluctuationState

    def copy(self) -> SheetModelState:
        """Return an independent copy, including the state of the random generator."""
        return copy.deepcopy(self)


class SheetStep:
    """A model over one interval."""

    def __init__(self, model: SheetModel, dt_s: float) -> None:
        self._model, self._dt_s = model, dt_s
        self._adaptation, self._creep = model.adaptation.discretise(dt_s), model.creep.discretise(dt_s)

    def forward(
        self,
        state: SheetModelState,
        load_n: npt.ArrayLike,
        powered: npt.ArrayLike = True,
        warmer_k: npt.ArrayLike = 0.0,
    ) -> FloatArray:
        """Return the apparent load (n,) [N] at the end of an interval; update `state` in place.

        load_n: true load over the interval [N]. powered: the layer is under potential; without it there is no
        response. warmer_k: temperature above that at which the contact law holds. All broadcast to (n,).
        Raises ValueError for a load that is negative or not finite.
        """
        load = np.asarray(load_n, np.float64)
        if load.shape != state.adaptation.back_n.shape:
            load = np.broadcast_to(load, state.adaptation.back_n.shape)
        if not ((load >= 0) & np.isfinite(load)).all():
            raise ValueError(f"loads must be at least 0 and finite, got {load}")
        warmth = np.asarray(warmer_k, np.float64)
        swelling = self._model.temperature
        pressing = np.maximum(load + swelling.preload_n_per_k * warmth, 0.0)
        pressing = self._model.hysteresis.apply_to(state.plays, pressing)
        effective = self._adaptation.forward(state.adaptation, pressing, np.asarray(powered, np.bool_))
        reading = self._creep.forward(state.creep_elements, effective) * (1 + swelling.gain_per_k * warmth)
        return self._model.fluctuation.apply_to(state.fluctuation, reading, self._dt_s)
