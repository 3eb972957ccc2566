"""The tick: one vectorised pass from the slab of counts to contacts of the whole hand.

counts -> currents -> which pads are touched -> locate and weigh only those -> place on the link -> follow
contacts. Pure but for the state it keeps; time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.slab import Slab
from handtouch.daemon.contacts import BoolArray, Contacts, IntArray
from handtouch.daemon.cycle import Cycle
from handtouch.daemon.model import PadModel
from handtouch.field.strength import Status
from handtouch.wire import PadState

FloatArray = NDArray[np.float64]
_STALE_PERIODS = 3
_SOURCE_STD, _SOURCE_PART = 10.0, 0.02
"""How far below zero a channel may be: standard deviations of noise, and part of all channels."""
# plain numbers: looking up members of an enumeration costs a microsecond each
_CLEAR, _TOUCHED, _STALE, _FAULTED = map(
    int, (PadState.CLEAR, PadState.TOUCHED, PadState.STALE, PadState.FAULTED)
)
_VALID, _SATURATED = int(Status.VALID), int(Status.SATURATED)


@dataclass(frozen=True)
class Columns:
    """What is known of each of n pads; a row keeps its last values while no newer ones are there."""

    state: NDArray[np.uint8]
    """PadState"""
    sample_ns: NDArray[np.int64]
    """SYNC that the newest sample belongs to, 0 before the first"""
    current_a: FloatArray
    """total current"""
    xy: FloatArray
    """(n, 2) location on the pad's rectangle"""
    position_m: FloatArray
    """(n, 3) in the link frame; NaN where there is no valid location"""
    normal: FloatArray
    """(n, 3)"""
    covariance_m2: FloatArray
    """(n, 3, 3)"""
    pad_m: FloatArray
    """(n, 2) arc lengths from the electrodes x0 and y0"""
    force_n: FloatArray
    """NaN where there is no valid strength, a lower bound where it is saturated"""
    force_std_n: FloatArray
    saturated: NDArray[np.bool_]
    residual: FloatArray
    residual_std: FloatArray
    """of a point contact, from the noise of the channels"""

    @classmethod
    def of(cls, n: int) -> Columns:
        """Columns of n pads of which nothing is known."""

        def unknown(*shape: int) -> FloatArray:
            return np.full((n, *shape), np.nan)

        return cls(
            state=np.full(n, PadState.STARTING, dtype=np.uint8),
            sample_ns=np.zeros(n, dtype=np.int64),
            current_a=np.zeros(n),
            xy=unknown(2),
            position_m=unknown(3),
            normal=unknown(3),
            covariance_m2=unknown(3, 3),
            pad_m=unknown(2),
            force_n=unknown(),
            force_std_n=unknown(),
            saturated=np.zeros(n, dtype=np.bool_),
            residual=unknown(),
            residual_std=unknown(),
        )


@dataclass(frozen=True)
class Ticked:
    """What one tick changed: rows of the columns."""

    t_ns: int
    began: IntArray
    updated: IntArray
    """contacts with a new sample that didn't just begin"""
    ended: IntArray


class Tick:
    """State of all pads of a daemon from tick to tick."""

    def __init__(self, model: PadModel, period_ns: int) -> None:
        self.model = model
        self.columns = Columns.of(model.size)
        self.contacts = Contacts(model.begin_samples, model.end_samples)
        self.counts: NDArray[np.int64] = np.zeros((model.size, 4), dtype=np.int64)
        """of the last tick"""
        self.samples = np.zeros(model.size, dtype=np.int64)
        """samples taken in"""
        self.missed = np.zeros(model.size, dtype=np.int64)
        """ticks that an expected sample came too late for, or never"""
        self._stale_ns = _STALE_PERIODS * period_ns
        self._currents = np.zeros((model.size, 4))
        self._taken_ns = np.zeros(model.size, dtype=np.int64)  # arrival of the samples that were used

    def expected(self) -> NDArray[np.bool_]:
        """Pads whose sample a tick should wait for: those that are alive."""
        return self.columns.state <= _TOUCHED

    def step(
        self,
        slab: Slab,
        node_state: NDArray[np.uint8],
        cycle: Cycle,
        now_ns: int,
        until_ns: int = np.iinfo(np.int64).max,
    ) -> Ticked:
        """Take in the samples of a cycle, and those of the one before that came too late for its tick.

        `now_ns` is the time of the tick; samples that arrived at `until_ns` or later are of the next cycle.
        `node_state` (n,): PadState.CLEAR where the node is up, else what its pad is instead.
        """
        model, columns, contacts = self.model, self.columns, self.contacts
        operational: BoolArray = np.equal(node_state, _CLEAR)
        here = slab.t_ns < until_ns
        sampled: BoolArray = here & (slab.t_ns != self._taken_ns) & operational
        np.copyto(self._taken_ns, slab.t_ns, where=here)
        in_time = here & (slab.fresh != 0)
        self.missed += self.expected() & operational & ~in_time
        self.samples += sampled
        np.copyto(columns.sample_ns, np.where(in_time, cycle.t_ns, cycle.previous_ns), where=sampled)
        self.counts = counts = slab.read()
        absurd = self._absurd(counts, slab)
        stale: BoolArray = np.subtract(now_ns, columns.sample_ns) > self._stale_ns
        trusted: BoolArray = operational & ~absurd & ~stale
        np.multiply(counts, model.ampere_per_count, out=self._currents)
        np.copyto(columns.current_a, self._currents.sum(axis=1), where=sampled)
        below_off = columns.current_a < model.off_a
        above_on = columns.current_a > model.on_a
        changes = contacts.step(sampled, above_on, below_off, trusted, columns.sample_ns)
        self._resolve_states(node_state, operational, absurd, stale)
        # a sample below the threshold tells no place: until it is known whether more follow, the last holds
        touched = contacts.touching & sampled & ~below_off
        if len(changes.began):
            columns.xy[changes.began] = np.nan  # no use to start from where the last contact was
        if touched.any():
            self._solve(np.flatnonzero(touched))
            touched[changes.began] = False
        return Ticked(cycle.t_ns, changes.began, np.flatnonzero(touched), changes.ended)

    def _absurd(self, counts: NDArray[np.int64], slab: Slab) -> BoolArray:
        """Pads (n,) with a channel at the end of its range, or one that gives current: it can only take."""
        source = _SOURCE_STD * self.model.noise_counts + _SOURCE_PART * np.abs(counts).sum(axis=1)
        return np.asarray(slab.railed(counts).any(axis=1) | (counts.min(axis=1) < -source))

    def _resolve_states(
        self,
        node_state: NDArray[np.uint8],
        operational: BoolArray,
        absurd: BoolArray,
        stale: BoolArray,
    ) -> None:
        state = self.columns.state
        np.copyto(state, node_state)
        state[operational & self.contacts.touching] = _TOUCHED
        state[operational & absurd] = _FAULTED
        state[operational & stale] = _STALE

    def _solve(self, touched: IntArray) -> None:
        """Locate, place and weigh the contacts on the pads `touched`."""
        model, columns = self.model, self.columns
        currents = self._currents[touched].T
        found = model.locator.estimate(touched, currents, model.noise_a[touched].T, columns.xy[touched].T)
        columns.xy[touched, 0], columns.xy[touched, 1] = found.x, found.y
        columns.residual[touched] = found.residual
        with np.errstate(
            divide="ignore", invalid="ignore"
        ):  # counts that fit a point exactly tell nothing of it
            columns.residual_std[touched] = np.abs(found.residual) / np.sqrt(found.chi_squared)
        placed = model.placement.place(touched, found.x, found.y, found.covariance[:, :2, :2])
        columns.position_m[touched] = placed.position_m
        columns.normal[touched] = placed.normal
        columns.covariance_m2[touched] = placed.covariance_m2
        columns.pad_m[touched] = placed.pad_m
        strength = model.force(touched, currents, found, placed)
        known = (strength.status == _VALID) | (strength.status == _SATURATED)
        columns.force_n[touched] = np.where(known, strength.force_n, np.nan)
        columns.force_std_n[touched] = strength.std_n
        columns.saturated[touched] = strength.status == _SATURATED
        peak = self.contacts.peak_n
        peak[touched] = np.fmax(peak[touched], columns.force_n[touched])
