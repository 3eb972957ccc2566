"""A real sheet, backwards: apparent load -> load, with what isn't known of it.

Public names: `Compensator`, `Doubt`.

Hysteresis, adaptation, creep and temperature are undone exactly as long as their numbers are right and the
load is felt; what fluctuates is not. The compensator never learns of a press that isn't felt, and such a
press may wipe the back force: so its doubt of the back force grows in silence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.sheet.behaviour import SheetModel

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Doubt:
    """How far the model's numbers may be off (1 sigma).

    creep, adaptation, hysteresis: fractions of what each of these corrects. silence_s: time constant with
    which an unfelt press becomes likely; infinite if the back force is sure. warmth_k: of the temperature
    that is given [K].
    """

    creep: float = 0.2
    adaptation: float = 0.2
    hysteresis: float = 0.2
    silence_s: float = 60.0
    warmth_k: float = 0.0

    @classmethod
    def none(cls) -> Doubt:
        """The model is known."""
        return cls(0.0, 0.0, 0.0, math.inf, 0.0)


class Compensator:
    """Of n pads with sheets of one model; starts with fresh sheets under potential, at the law's temperature.

    settle_s: how often the back force is carried on [s]. 0, at every step, makes the inverse exact; between,
    it is held, which is off by settle_s / time_s of the load at most and makes most steps cost a third.
    """

    def __init__(
        self, model: SheetModel, pads: int, doubt: Doubt | None = None, *, settle_s: float = 0.0
    ) -> None:
        self.model, self.doubt = model, Doubt() if doubt is None else doubt
        self._undo_plays = model.hysteresis.inverse
        self._plays = self._undo_plays.start(pads)
        self._adaptation = model.adaptation.start(pads)
        self._elements = model.creep.start(pads)
        self.back_std_n = np.zeros(pads)
        """Standard deviation of the back force (n,) [N], but for what the press in progress adds."""
        self._press_n = np.zeros(pads)  # that: error of the back force if this press reads a deviation more
        self._on, self._warmer_k = np.ones(pads, np.bool_), 0.0
        self._settle_s, self._waited_s = settle_s, 0.0
        self._flow_s, self._impulse = np.zeros(pads), np.zeros(pads)  # of load, since the back force settled
        self._ones = np.ones(pads)
        self._threshold_n = np.array(np.broadcast_to(model.adaptation.threshold_n, pads), np.float64)
        noise, swelling, warmth_k = model.fluctuation, model.temperature, self.doubt.warmth_k
        self._unknowable = (
            noise.press_std**2 + (swelling.gain_per_k * warmth_k) ** 2,
            noise.noise_std**2,
            (swelling.preload_n_per_k * warmth_k) ** 2,
        )
        """Variance that goes as the square of what is felt, as what is felt, and that is always there."""
        self._last = tuple(np.zeros(pads) for _ in range(4))  # four: a state is put into each
        self._resumed = False  # what presses then has pressed since ever, as far as creep is concerned
        self._prepare(0.0)

    @property
    def back_n(self) -> FloatArray:
        """The back force (n,) [N] as far as it is known; 0 of a fresh or rested sheet."""
        return self._adaptation.back_n

    def assume(self, back_n: npt.ArrayLike, std_n: npt.ArrayLike) -> None:
        """Take the back force [N] and its standard deviation from elsewhere, each (n,) or (): a store, or a
        load that was measured in another way. What presses at the next step is taken to have pressed for
        long, so a start while touched is no creep. Raises ValueError for what is negative or not finite."""
        for name, value in (("back_n", back_n), ("std_n", std_n)):
            checked = np.asarray(value, np.float64)
            if not ((checked >= 0) & np.isfinite(checked)).all():
                raise ValueError(f"{name} must be at least 0 and finite, got {checked}")
        self._settle()
        self.back_n[:] = back_n
        self.back_std_n[:] = std_n
        self._resumed = True

    def renew(self, pads: npt.NDArray[np.intp]) -> None:
        """Fresh sheets on some pads."""
        self._settle()
        state = self._adaptation
        doubts = self.back_std_n, self._press_n
        rows = (state.back_n, state.peak_n, state.flowed_s, *doubts, *self._plays, *self._elements)
        for row in rows:
            row[pads] = 0.0

    def set_powered(self, powered: npt.ArrayLike) -> None:
        """Potential from now on, (n,) or (); without it the back force fades."""
        self._settle()
        self._on[:] = powered

    def set_warmer(self, warmer_k: float) -> None:
        """Temperature from now on, above that at which the contact law holds [K]."""
        self._warmer_k = warmer_k

    def step(self, apparent_n: FloatArray, dt_s: float) -> FloatArray:
        """Load (n,) [N] at the end of an interval of `dt_s` >= 0 [s]; 0 where nothing is felt.

        apparent_n: (n,) as `ContactLaw.force` tells it [N]; below 0 is none. A reading that isn't finite is
        taken as none, and its load is NaN. Equal `dt_s` in a row cost least.
        """
        if dt_s != self._dt_s:
            self._prepare(dt_s)
        if not math.isfinite(self._ones @ apparent_n):
            broken = ~np.isfinite(apparent_n)
            return np.where(broken, np.nan, self._step(np.where(broken, 0.0, apparent_n)))
        return self._step(apparent_n)

    def std_n(self, pads: npt.NDArray[np.intp] | slice = slice(None)) -> FloatArray:
        """Standard deviation of the last load [N], of all pads or some. Where nothing is felt it is that of a
        load that may be anything which wouldn't be felt."""
        load, before, felt, reading = (column[pads] for column in self._last)
        press, flicker, fixed = self._unknowable
        variance = np.square(math.sqrt(press) * felt + self._press_n[pads]) + flicker * felt
        variance += np.square(self.back_std_n[pads])
        variance += np.square(self.doubt.creep * (felt - reading))
        if len(self._plays):
            variance += np.square(self.doubt.hysteresis * (load - before))
        variance += fixed
        unfelt = self._adaptation.back_n[pads] + self._threshold_n[pads]
        return np.sqrt(np.where(felt > 0, variance, np.square(unfelt) / 3))

    def _step(self, apparent_n: FloatArray) -> FloatArray:
        reading = np.maximum(apparent_n, 0.0)
        swelling = self.model.temperature
        if self._warmer_k:
            reading /= 1 + swelling.gain_per_k * self._warmer_k
        creep = self.model.creep.at(math.inf) if self._resumed else self._creep
        felt = creep.inverse(self._elements, reading)
        self._resumed = False
        flows = felt > 0
        before = self._hold(felt, flows) if self._settle_s else self._undo(felt, flows)
        load = self._undo_plays.step(self._plays, before) if len(self._plays) else before
        if self._warmer_k:
            load = np.maximum(load - swelling.preload_n_per_k * self._warmer_k, 0.0) * flows
        self._last = (load, before, felt, reading)
        return load

    def _prepare(self, dt_s: float) -> None:
        if not 0 <= dt_s < math.inf:
            raise ValueError(f"dt_s must be at least 0 and finite, got {dt_s}")
        self._dt_s = dt_s
        self._creep, self._back = self.model.creep.at(dt_s), self.model.adaptation.at(dt_s)

    def _undo(self, felt: FloatArray, flows: npt.NDArray[np.bool_]) -> FloatArray:
        """Load before adaptation, which goes along."""
        kept = self._back.kept(self._adaptation)
        load = self._back.inverse(self._adaptation, felt, kept)
        self._carry_doubt(load, np.where(flows, kept, 1.0), np.where(flows, 0.0, self._dt_s))
        self._back.fade(self._adaptation, self._on)
        return load

    def _hold(self, felt: FloatArray, flows: npt.NDArray[np.bool_]) -> FloatArray:
        """The same with the back force as it settled last."""
        load = felt + self._adaptation.back_n
        load *= flows
        self._impulse += self._dt_s * load
        self._flow_s += self._dt_s * flows
        self._waited_s += self._dt_s
        if self._waited_s >= self._settle_s:
            self._settle()
        return load

    def _settle(self) -> None:
        state, flow = self._adaptation, self._flow_s
        step = self.model.adaptation.at(flow)
        kept = step.kept(state)
        load = self._impulse / np.where(flow > 0, flow, 1.0)
        step.adapt(state, load, flow > 0, kept)
        self._carry_doubt(load, kept, self._waited_s - flow)
        if not self._on.all():
            self.model.adaptation.at(self._waited_s).fade(state, self._on)
        self._waited_s = 0.0
        flow[:] = self._impulse[:] = 0.0

    def _carry_doubt(self, load: FloatArray, kept: FloatArray, silent_s: FloatArray) -> None:
        """What is learned is doubted, in part because its press may read too much; silence may hide anything.

        An error of the back force goes into the load, and with that into what is learned next: so it isn't
        forgotten as the back force is, d(error)/dt = -(1 - share) error / time. Errors of one press add up;
        those of several presses are independent."""
        spread, back, share = self.back_std_n, self._adaptation.back_n, self._back.share
        learned = 1 - kept
        lasts = 1 - learned * (1 - share)
        felt = np.maximum(load - back, 0.0)
        spread *= lasts
        spread += self.doubt.adaptation * learned * (share * felt + (1 - share) * load)
        if press := math.sqrt(self._unknowable[0]):
            np.hypot(spread, self._press_n, out=spread, where=load <= 0)
            self._press_n *= lasts * (load > 0)
            self._press_n += press * learned * share * felt
        spread += np.maximum(back - spread, 0.0) * -np.expm1(-silent_s / self.doubt.silence_s)
        if not self._on.all():
            np.minimum(spread, back, out=spread, where=~self._on)
