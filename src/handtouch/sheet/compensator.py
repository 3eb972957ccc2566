"""Inverse model of a sheet: apparent load -> load, with its standard deviation.

Public names: `SheetCompensator`, `CompensatorState`, `ParameterUncertainty`.

Hysteresis, adaptation, creep and temperature are inverted exactly if their parameters are right and the load
is above the threshold of response; fluctuations are not. A press below the threshold isn't detected but may
wipe the back force, so the standard deviation of the back force grows in pauses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.sheet.adaptation import AdaptationState
from handtouch.sheet.bank import ModelBank
from handtouch.sheet.behaviour import SheetModel


@dataclass(frozen=True)
class ParameterUncertainty:
    """Standard deviations of a model's parameters.

    creep, adaptation, hysteresis: as fractions of the correction made by each. late_creep: of the load, that
    a reading reaches later than the creep's times. forget_time_s: time constant
    with which an undetected press becomes likely; infinite if the back force is known. temperature_k: of the
    temperature, about that at which the contact law holds [K].
    """

    creep: float = 0.2
    adaptation: float = 0.2
    hysteresis: float = 0.2
    forget_time_s: float = 60.0
    temperature_k: float = 0.0
    late_creep: float = 0.0

    @classmethod
    def exact(cls) -> ParameterUncertainty:
        """Return the uncertainty of a known model, 0."""
        return cls(creep=0.0, adaptation=0.0, hysteresis=0.0, forget_time_s=math.inf, temperature_k=0.0)


@dataclass(frozen=True)
class CompensatorState:
    """State of n pads' sheets, which a compensator updates in place."""

    elements: FloatArray
    """(1 + modes, n) of creep"""
    plays: FloatArray
    """(plays, n) of the inverse hysteresis"""
    back_n: FloatArray
    """(n,) back force [N]"""
    current_flow_s: FloatArray
    """(n,) total time of current flow"""
    back_std_n: FloatArray
    """(n,) standard deviation of the back force, without the present press's contribution"""
    press_n: FloatArray
    """(n,) that: error of the back force per standard deviation of this press"""
    flow_s: FloatArray
    """(n,) time of current flow since the last update of the back force"""
    impulse_ns: FloatArray
    """(n,) load times time since then"""
    powered: npt.NDArray[np.bool_]
    """(n,)"""
    waited_s: FloatArray
    """(1,) time since then"""
    load_is_old: npt.NDArray[np.bool_]
    """(1,) treat the present load as present for ever, as far as creep is concerned"""

    @classmethod
    def empty(cls, model: SheetModel, pads: int) -> CompensatorState:
        """Return the state of fresh sheets under potential."""
        plays = model.hysteresis.inverse.initial_state(pads)
        back_n, flow_total_s, back_std_n, press_n, flow_s, impulse_ns = np.zeros((6, pads))
        return cls(
            elements=model.creep.initial_state(pads),
            plays=plays,
            back_n=back_n,
            current_flow_s=flow_total_s,
            back_std_n=back_std_n,
            press_n=press_n,
            flow_s=flow_s,
            impulse_ns=impulse_ns,
            powered=np.ones(pads, np.bool_),
            waited_s=np.zeros(1),
            load_is_old=np.zeros(1, np.bool_),
        )


class SheetCompensator:
    """Inverse model of n pads' sheets; starts with fresh sheets under potential, at the law's temperature.

    state: arrays to use, of fresh sheets; None: own ones. update_period_s: period of updates of the back
    force [s]. 0, in every step, makes the inverse exact; otherwise the back force is held in between, an
    error of at most update_period_s / time_s of the load, and most steps cost a third.
    """

    def __init__(
        self,
        model: SheetModel,
        pads: int,
        uncertainty: ParameterUncertainty | None = None,
        *,
        update_period_s: float = 0.0,
        state: CompensatorState | None = None,
        bank: ModelBank | None = None,
    ) -> None:
        self.model, self.uncertainty = model, ParameterUncertainty() if uncertainty is None else uncertainty
        state = CompensatorState.empty(model, pads) if state is None else state
        self.bank = bank
        self._state, self._inverse_hysteresis = state, model.hysteresis.inverse
        self._plays, self._elements, self._powered = state.plays, state.elements, state.powered
        self._adaptation = AdaptationState(state.back_n, np.zeros(pads), state.current_flow_s)
        self.back_std_n = state.back_std_n
        """Standard deviation of the back force (n,) [N], without the present press's contribution."""
        self._press_n, self._flow_s, self._impulse = state.press_n, state.flow_s, state.impulse_ns
        self._update_period_s = update_period_s
        self._ones = np.ones(pads)
        self._threshold_n = np.array(np.broadcast_to(model.adaptation.threshold_n, pads), np.float64)
        noise, swelling, warmth_k = model.fluctuation, model.temperature, self.uncertainty.temperature_k
        self._irreducible_variance = (
            noise.press_std**2 + (swelling.gain_per_k * warmth_k) ** 2,
            noise.noise_std**2,
            (swelling.preload_n_per_k * warmth_k) ** 2,
        )
        """Variances proportional to the square of the effective load, to the effective load, and constant."""
        self.last_step = np.zeros((4, pads))
        """Load, load before hysteresis, effective load, and reading [N] of the last step."""
        self._set_interval(0.0)

    @property
    def back_n(self) -> FloatArray:
        """Estimated back force (n,) [N]; 0 for a fresh or recovered sheet."""
        return self._adaptation.back_n

    def set_back_force(self, back_n: npt.ArrayLike, std_n: npt.ArrayLike) -> None:
        """Set the back force [N] and its standard deviation, each (n,) or (), from a store or a measured
        load. The load of the next step is taken as long present, so that a start while touched shows no
        creep. Raises ValueError for values that are negative or not finite."""
        for name, value in (("back_n", back_n), ("std_n", std_n)):
            checked = np.asarray(value, np.float64)
            if not ((checked >= 0) & np.isfinite(checked)).all():
                raise ValueError(f"{name} must be at least 0 and finite, got {checked}")
        self.update_back_force()
        self.back_n[:] = back_n
        self.back_std_n[:] = std_n
        if self.bank is not None:
            self.bank.set_back_force(self.back_n)
        self._state.load_is_old[0] = True

    def reset_pads(self, pads: npt.NDArray[np.intp]) -> None:
        """Reset some pads to fresh sheets."""
        self.update_back_force()
        state = self._adaptation
        deviations = self.back_std_n, self._press_n
        rows = (state.back_n, state.peak_n, state.current_flow_s, *deviations, *self._plays, *self._elements)
        for row in rows:
            row[pads] = 0.0
        if self.bank is not None:
            self.bank.reset_pads(pads)

    def set_powered(self, powered: npt.ArrayLike) -> None:
        """Switch the potential, (n,) or (); without it the back force decays."""
        self.update_back_force()
        self._powered[:] = powered

    def compensate(self, apparent_n: FloatArray, dt_s: float) -> FloatArray:
        """Return the load (n,) [N] at the end of an interval of `dt_s` >= 0 [s]; 0 without response.

        apparent_n: (n,) from `ContactLaw.force` [N]; a negative one counts as 0. One that isn't finite counts
        as 0 too, and its load is NaN. Constant `dt_s` is cheapest.
        """
        if dt_s != self._dt_s:
            self._set_interval(dt_s)
        if not math.isfinite(self._ones @ apparent_n):
            broken = ~np.isfinite(apparent_n)
            return np.where(broken, np.nan, self._compensate(np.where(broken, 0.0, apparent_n)))
        return self._compensate(apparent_n)

    def std_n(self, pads: npt.NDArray[np.intp] | slice = slice(None)) -> FloatArray:
        """Return the standard deviation of the last load [N], of all pads or some. Without a response it is
        that of a load anywhere below the threshold of response."""
        load, before, effective, reading = self.last_step[:, pads]
        press, flicker, fixed = self._irreducible_variance
        variance = np.square(math.sqrt(press) * effective + self._press_n[pads]) + flicker * effective
        variance += np.square(self.back_std_n[pads])
        if self.bank is not None:
            back_std_n, growth_std = self.bank.spread(pads)
            variance += np.square(back_std_n) + np.square(growth_std * effective)
        variance += np.square(self.uncertainty.creep * (effective - reading))
        variance += np.square(self.uncertainty.late_creep * effective)
        if len(self._plays):
            variance += np.square(self.uncertainty.hysteresis * (load - before))
        variance += fixed
        without_response = self._adaptation.back_n[pads] + self._threshold_n[pads]
        return np.sqrt(np.where(effective > 0, variance, np.square(without_response) / 3))

    def _compensate(self, apparent_n: FloatArray) -> FloatArray:
        reading = np.maximum(apparent_n, 0.0)
        creep = self.model.creep.discretise(math.inf) if self._state.load_is_old[0] else self._creep_step
        effective = creep.inverse(self._elements, reading)
        self._state.load_is_old[0] = False
        flows = effective > 0
        before = (
            self._hold_back_force(effective, flows)
            if self._update_period_s
            else self._invert_adaptation(effective, flows)
        )
        load = self._inverse_hysteresis.apply_to(self._plays, before) if len(self._plays) else before
        self.last_step[:] = load, before, effective, reading
        return load

    def _set_interval(self, dt_s: float) -> None:
        if not 0 <= dt_s < math.inf:
            raise ValueError(f"dt_s must be at least 0 and finite, got {dt_s}")
        self._dt_s = dt_s
        self._creep_step, self._adaptation_step = (
            self.model.creep.discretise(dt_s),
            self.model.adaptation.discretise(dt_s),
        )

    def _invert_adaptation(self, effective: FloatArray, flows: npt.NDArray[np.bool_]) -> FloatArray:
        """Return the load before adaptation, updating its state."""
        remaining = self._adaptation_step.remaining_fraction(self._adaptation)
        load = self._adaptation_step.inverse(self._adaptation, effective, remaining)
        pause_s = np.where(flows, 0.0, self._dt_s)
        share = self._adaptation_step.share
        self._propagate_uncertainty(load, np.where(flows, remaining, 1.0), share, pause_s)
        self._adaptation_step.recover(self._adaptation, self._powered)
        return load

    def _hold_back_force(self, effective: FloatArray, flows: npt.NDArray[np.bool_]) -> FloatArray:
        """Return the load before adaptation, with the back force of its last update."""
        load = effective + self._adaptation.back_n
        load *= flows
        self._impulse += self._dt_s * load
        self._flow_s += self._dt_s * flows
        self._state.waited_s[0] += self._dt_s
        if self._state.waited_s[0] >= self._update_period_s:
            self.update_back_force()
        return load

    def update_back_force(self) -> None:
        """Update the back force from the loads since its last update."""
        state, flow = self._adaptation, self._flow_s
        step = self.model.adaptation.discretise(flow)
        load = self._impulse / np.where(flow > 0, flow, 1.0)
        pause_s = self._state.waited_s[0] - flow
        if self.bank is None:
            remaining, share = step.remaining_fraction(state), step.share
            step.update_back_force(state, load, flow > 0, remaining)
        else:
            remaining, share = self.bank.advance(load - state.back_n, flow, state.current_flow_s)
            state.current_flow_s += flow
            state.back_n[:] = self.bank.mean_back_n()
        self._propagate_uncertainty(load, remaining, share, pause_s)
        if not self._powered.all():
            self.model.adaptation.discretise(float(self._state.waited_s[0])).recover(state, self._powered)
            if self.bank is not None:
                self.bank.set_back_force(state.back_n)
        self._state.waited_s[0] = 0.0
        flow[:] = self._impulse[:] = 0.0

    def _propagate_uncertainty(
        self, load: FloatArray, remaining: FloatArray, share: FloatArray, pause_s: FloatArray
    ) -> None:
        """Update the back force's standard deviation: parameters, error of the press, and pauses.

        An error of the back force is in the load, and so in what is learned next: it decays slower than the
        back force, d(error)/dt = -(1 - share) error / time. Errors of one press add up linearly; those of
        several presses are independent. In a pause an undetected press may have wiped the back force."""
        spread, back = self.back_std_n, self._adaptation.back_n
        learned = 1 - remaining
        lasts = 1 - learned * (1 - share)
        effective = np.maximum(load - back, 0.0)
        spread *= lasts
        spread += self.uncertainty.adaptation * learned * (share * effective + (1 - share) * load)
        if press := math.sqrt(self._irreducible_variance[0]):
            np.hypot(spread, self._press_n, out=spread, where=load <= 0)
            self._press_n *= lasts * (load > 0)
            self._press_n += press * learned * share * effective
        spread += np.maximum(back - spread, 0.0) * -np.expm1(-pause_s / self.uncertainty.forget_time_s)
        if not self._powered.all():
            np.minimum(spread, back, out=spread, where=~self._powered)
