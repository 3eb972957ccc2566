"""Forces on sheets that creep, adapt and remember: compensated, with what isn't known of them, and whether to
be relied on. Locations need none of this: they are ratios.

Public names: `SheetStrength`, `SheetBehaviour`, `behaviour_of`, `StrengthState`, `ForceReference`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch import sheet
from handtouch.config import Behaviour

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.intp]

SETTLE_S = 0.1
_LEAST_CONTACTS, _LEAST_S = 3, 5.0  # of evidence
_LEAST_N = 1e-6
_LEFT_ALONE = 0.3  # chance that nobody pressed at all in a silence, however long
_VAGUE = 0.5  # of a force: less certain than this, it is none
_HOUR_S = 3600.0
_GAIN_WANDERS = 0.05  # of the logarithm, in an hour
_GAIN_MOVES = 0.02  # a second, at most
_OUTLIER = 4.0  # standard deviations
_REFERENCE_NS = 50_000_000  # how far a reference may be from the sample it is compared with
_STEADY_S = 1.0  # a contact is compared that is at least so old
_INDEPENDENT_S = 1.0  # references follow one another too closely to be independent


class StrengthState(IntEnum):
    """What a pad's force is worth."""

    UNESTIMATED = 0  # too little evidence since it was calibrated, or its baseline isn't known
    ESTIMATED = 1
    INVALID = 2  # its sheet's state says nothing of the force any more


class ForceReference(NamedTuple):
    """Forces on pads (k,) rows, as something else than the sheet measured them (k,) [N], at a time."""

    pads: IntArray
    force_n: FloatArray
    std_n: FloatArray
    t_ns: int


@dataclass(frozen=True)
class SheetBehaviour:
    """A `[sheet.NAME.behaviour]` as models: how the sheet behaves, and how far that may be off."""

    model: sheet.SheetModel
    doubt: sheet.Doubt
    gain_std: float
    history_std_n: float
    silence_s: float
    slow_creep: float


class SheetStrength:
    """Strength of n pads; `behaviours` says of each how its sheet behaves, None where that isn't modelled.

    Public state: `force_n`, `std_n` (n,) compensated, of the pads that are touched; `state` (n,) of
    `StrengthState`; the evidence since the last calibration, `contacts` (n,) and `touched_s` (n,);
    `log_gain`, `log_gain_std` (n,): ln of what compensated forces are multiplied by, from references.
    """

    def __init__(self, behaviours: Sequence[SheetBehaviour | None], period_ns: int) -> None:
        n = len(behaviours)
        self.modelled = np.array([behaviour is not None for behaviour in behaviours], np.bool_)
        self.any = bool(self.modelled.any())
        self.force_n, self.std_n = np.full(n, np.nan), np.full(n, np.nan)
        self.state = np.where(self.modelled, StrengthState.UNESTIMATED, StrengthState.ESTIMATED).astype(
            np.uint8
        )
        self.contacts, self.touched_s = np.zeros(n, np.int64), np.zeros(n)
        self.log_gain = np.zeros(n)
        self.log_gain_std = np.array([0.0 if b is None else b.gain_std for b in behaviours])
        self._first_gain_std = self.log_gain_std.copy()
        self._slow_creep = np.array([0.0 if b is None else b.slow_creep for b in behaviours])
        self._felt_ns = np.zeros(n, np.int64)  # when each pad was touched last
        self._gain = np.ones(n)
        self._vouched = np.zeros(n, np.bool_)
        self._begin_s = np.zeros(n)  # of evidence when the contact began
        self._compared_ns = np.zeros(n, np.int64)
        self._period_ns = period_ns
        self._until_ns = np.zeros(1, np.int64)  # until when the sheets were carried on
        self._apparent = np.zeros(n)
        self._waited_s = np.zeros(1)  # since uncertainty was judged
        self._news = np.zeros(n, np.bool_)  # contacts that began since
        self._doubt = np.full(n, np.nan)  # standard deviation over force
        self.groups = _Groups(behaviours)

    def adopt(
        self, before: Sequence[SheetBehaviour | None], behaviours: Sequence[SheetBehaviour | None]
    ) -> SheetStrength:
        """This, or another one if sheets behave differently now; what is known of the others goes on."""
        if behaviours == before:
            return self
        fresh = SheetStrength(behaviours, self._period_ns)
        kept = np.array([old == new for old, new in zip(before, behaviours, strict=True)])
        for name in ("force_n", "std_n", "state", "contacts", "touched_s", "log_gain", "log_gain_std"):
            getattr(fresh, name)[kept] = getattr(self, name)[kept]
        fresh._gain[:] = np.exp(fresh.log_gain)
        fresh._until_ns[:] = self._until_ns
        for pad in np.flatnonzero(kept & self.modelled).tolist():
            group, row = self.groups.find(pad)
            fresh.assume(pad, group.compensator.back_n[row], group.compensator.back_std_n[row], vouched=False)
        fresh._vouched[kept] = self._vouched[kept]
        return fresh

    def assume(self, pad: int, back_n: float, std_n: float, *, vouched: bool = True) -> None:
        """Take what a pad's sheet has got used to [N] from elsewhere, e.g. a store; `vouched`: no more
        evidence is wanted before its forces count. A pad whose sheet isn't modelled is left alone."""
        if not self.modelled[pad]:
            return
        group, row = self.groups.find(pad)
        back, spread = group.compensator.back_n.copy(), group.compensator.back_std_n.copy()
        back[row], spread[row] = back_n, std_n
        group.compensator.assume(back, spread)
        self._vouched[pad] |= vouched

    def recalibrated(self, pad: int, *, new_sheet: bool = False) -> None:
        """Evidence counts from here: the pad's calibration is another, and perhaps its sheet."""
        self.contacts[pad], self.touched_s[pad], self._begin_s[pad] = 0, 0.0, 0.0
        self._vouched[pad] = False
        self.log_gain[pad], self._gain[pad] = 0.0, 1.0
        self.log_gain_std[pad] = self._first_gain_std[pad]
        if self.modelled[pad]:
            self.state[pad] = StrengthState.UNESTIMATED
            if new_sheet:
                group, row = self.groups.find(pad)
                group.compensator.renew(np.array([row]))

    @property
    def back(self) -> tuple[FloatArray, FloatArray]:
        """What sheets have got used to, and its standard deviation (n,) [N]; NaN where not modelled."""
        back, std = np.full(len(self.force_n), np.nan), np.full(len(self.force_n), np.nan)
        for group in self.groups.all:
            back[group.rows], std[group.rows] = group.compensator.back_n, group.compensator.back_std_n
        return back, std

    def begin(self, began: IntArray) -> None:
        """Contacts began on these pads. While nothing was felt, a press too light to be felt may have wiped
        what a sheet had got used to: it is taken for the mean of both, and as uncertain as they differ."""
        silent_s = (self._until_ns[0] - self._felt_ns[began]) * 1e-9
        for group in self.groups.all:
            rows = np.searchsorted(group.pads, began)
            here = np.flatnonzero(group.pads[np.minimum(rows, len(group.pads) - 1)] == began)
            group.forget(rows[here], silent_s[here])
        self.contacts[began] += 1
        self._begin_s[began] = self.touched_s[began]
        self._news[began] = True

    def step(self, raw_n: FloatArray, raw_std_n: FloatArray, touching: BoolArray, t_ns: int) -> IntArray:
        """Carry all sheets on to `t_ns`, and weigh what touches modelled ones now, whose pads (k,) are the
        answer.

        raw_n, raw_std_n: (n,) as the contact law has them [N]; what isn't touched is taken for 0.
        """
        dt_s = self._interval_s(t_ns)
        apparent = self._apparent
        apparent.fill(0.0)
        np.copyto(apparent, raw_n, where=touching)
        for group in self.groups.all:
            load = group.compensator.step(apparent[group.rows], dt_s)
            self.force_n[group.rows] = load
        self._waited_s[0] += dt_s
        pressed: IntArray = (touching & self.modelled).nonzero()[0]
        if not len(pressed):
            self._waited_s[0] = 0.0
            return pressed
        self._felt_ns[pressed] = self._until_ns
        force = self.force_n.take(pressed) * self._gain.take(pressed)
        if self._waited_s[0] >= SETTLE_S or np.count_nonzero(self._news):
            self._judge(pressed, force, raw_std_n, touching)
        self.force_n[pressed] = force
        self.std_n[pressed] = force * self._doubt.take(pressed)
        return pressed

    def refer(self, reference: ForceReference, sample_ns: npt.NDArray[np.int64], touching: BoolArray) -> int:
        """Compare forces with those of a reference: a scalar Kalman filter on each pad's log gain, which
        moves no faster than 2 % a second. `sample_ns` (n,) are the times of the pads' samples. The number of
        pads that it told anything of; what is late, unsteady, not above 0 or far off doesn't count."""
        pads = np.asarray(reference.pads)
        force, found = np.asarray(reference.force_n, np.float64), self.force_n[pads]
        since_s = (reference.t_ns - self._compared_ns[pads]) * 1e-9
        with np.errstate(all="ignore"):
            usable = self.modelled[pads] & touching[pads] & (force > 0) & (found > 0)
            usable &= np.abs(sample_ns[pads] - reference.t_ns) <= _REFERENCE_NS
            usable &= self.touched_s[pads] - self._begin_s[pads] >= _STEADY_S
            usable &= since_s >= _INDEPENDENT_S
            pads, force, found, since_s = pads[usable], force[usable], found[usable], since_s[usable]
            excess = np.log(force / found)
            spread = np.square(self.log_gain_std[pads])
            sheets = np.maximum(np.square(self.std_n[pads] / found) - spread, 0.0)
            noise = np.square(np.asarray(reference.std_n, np.float64)[usable] / force) + sheets
        since_s = np.minimum(since_s, _HOUR_S)
        spread = spread + np.square(_GAIN_WANDERS) * since_s / _HOUR_S
        told = np.isfinite(excess) & (np.square(excess) <= _OUTLIER**2 * (spread + noise))
        pads, excess, since_s = pads[told], excess[told], since_s[told]
        spread, noise = spread[told], noise[told]
        gain = spread / (spread + noise)
        most = _GAIN_MOVES * np.minimum(since_s, 60.0)
        move = np.clip(gain * excess, -most, most)
        self.log_gain[pads] += move
        clipped = np.abs(gain * excess - move)
        self.log_gain_std[pads] = np.sqrt((1 - gain) * spread + np.square(clipped))
        self._gain[pads] = np.exp(self.log_gain[pads])
        self._compared_ns[pads] = reference.t_ns
        self._vouched[pads] = True
        return len(pads)

    def _judge(
        self, pressed: IntArray, force: FloatArray, raw_std_n: FloatArray, touching: BoolArray
    ) -> None:
        """Uncertainty and state of the pads that are touched: now and then, and when a contact begins."""
        self.touched_s += self._waited_s * touching
        self._waited_s[0] = 0.0
        self._news[:] = False
        for group in self.groups.all:
            self.std_n[group.rows] = group.compensator.std_n()
        variance = np.square(self.std_n[pressed]) + np.square(raw_std_n[pressed])
        held_s = self.touched_s[pressed] - self._begin_s[pressed]
        wander = self._slow_creep[pressed] * np.log1p(held_s / _STEADY_S)
        variance += np.square(force) * (np.square(self.log_gain_std[pressed]) + np.square(wander))
        std = np.sqrt(variance)
        self._doubt[pressed] = std / np.maximum(force, _LEAST_N)
        enough = (self.contacts[pressed] >= _LEAST_CONTACTS) & (self.touched_s[pressed] >= _LEAST_S)
        known = enough | self._vouched[pressed]
        sane = std < _VAGUE * force  # False for what isn't finite
        self.state[pressed] = np.where(sane, known, StrengthState.INVALID)

    def _interval_s(self, t_ns: int) -> float:
        """Whole periods since the last step, as equal intervals cost least; the rest is kept for the next."""
        gone_ns = t_ns - int(self._until_ns[0])
        if gone_ns > 10**9 * _HOUR_S or gone_ns < 0:
            self._until_ns[0] = t_ns
            return 0.0
        periods = (gone_ns + self._period_ns // 2) // self._period_ns
        self._until_ns[0] += periods * self._period_ns
        return periods * self._period_ns * 1e-9


class _Groups:
    """Pads by how their sheets behave; attributes, as what is kept between ticks is found by these."""

    def __init__(self, behaviours: Sequence[SheetBehaviour | None]) -> None:
        kinds = dict.fromkeys(b for b in behaviours if b is not None)
        for number, kind in enumerate(kinds):
            setattr(self, f"group{number}", _Group(kind, np.flatnonzero([b == kind for b in behaviours])))

    @property
    def all(self) -> Iterable[_Group]:
        return vars(self).values()

    def find(self, pad: int) -> tuple[_Group, int]:
        """The group of a pad, and its row there."""
        return next((g, int(g.pads.searchsorted(pad))) for g in self.all if pad in g.pads)


class _Group:
    """Pads whose sheets behave alike."""

    def __init__(self, behaviour: SheetBehaviour, pads: IntArray) -> None:
        self.pads = pads
        whole = len(pads) == pads[-1] - pads[0] + 1
        self.rows: slice | IntArray = slice(int(pads[0]), int(pads[-1]) + 1) if whole else pads
        self._silence_s = behaviour.silence_s
        self.compensator = sheet.Compensator(behaviour.model, len(pads), behaviour.doubt, settle_s=SETTLE_S)
        if behaviour.history_std_n:
            self.compensator.assume(0.0, behaviour.history_std_n)

    def forget(self, rows: IntArray, silent_s: FloatArray) -> None:
        """Back forces of rows after a silence: wiped with a chance that grows with it and the back force, as
        more presses are lighter than that; else as they were. Mean and variance are those of both.
        How often such presses come isn't known (exponential prior), and in a break there are none: no
        chance is ever a certainty, and both possibilities stay within 1.96 deviations."""
        back, std = self.compensator.back_n, self.compensator.back_std_n
        kept = _LEFT_ALONE + (1 - _LEFT_ALONE) / (1 + silent_s / self._silence_s * back[rows])
        std[rows] = np.sqrt(kept * (np.square(std[rows]) + (1 - kept) * np.square(back[rows])))
        back[rows] *= kept


def behaviour_of(behaviour: Behaviour) -> SheetBehaviour:
    """The preset with what the deployment changes of it, and how far that may be off."""
    preset = {"S1": sheet.S1, "S2": sheet.S2}[behaviour.preset]
    adaptation, creep, noise = preset.adaptation, preset.creep, preset.fluctuation
    share, time_s = 1 - creep.instant, creep.times_s[0]
    share = share if behaviour.creep_share is None else behaviour.creep_share
    time_s = time_s if behaviour.creep_time_s is None else behaviour.creep_time_s
    changed = {
        "share": behaviour.adaptation_share,
        "time_s": behaviour.adaptation_time_s,
        "recovery_s": behaviour.recovery_time_s,
        "fatigue_s": behaviour.fatigue_s,
        "threshold_n": behaviour.threshold_n,
    }
    model = replace(
        preset,
        adaptation=replace(adaptation, **{key: value for key, value in changed.items() if value is not None}),
        creep=sheet.Creep.first_order(1 - share, time_s) if share else sheet.Creep(1.0, (), ()),
        fluctuation=noise if behaviour.press_std is None else replace(noise, press_std=behaviour.press_std),
    )
    if behaviour.loop:
        loop = sheet.PrandtlIshlinskii.of_loop(behaviour.loop, behaviour.loop_full_n)
        model = replace(model, hysteresis=loop)
    doubt = sheet.Doubt(behaviour.doubt, behaviour.doubt, behaviour.doubt, math.inf)
    return SheetBehaviour(
        model,
        doubt,
        behaviour.gain_std,
        behaviour.history_std_n,
        behaviour.silence_s,
        behaviour.slow_creep,
    )
