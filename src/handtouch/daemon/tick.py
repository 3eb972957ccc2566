"""The tick: one vectorised pass from the slab of counts to contacts of the whole hand.

counts -> currents -> which pads are touched -> locate and weigh only those -> place on the link -> follow
contacts. Pure but for the state it keeps; time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.canbus.bus.slab import Slab
from handtouch.daemon.contacts import BoolArray, Contacts, IntArray
from handtouch.daemon.cycle import Cycle
from handtouch.daemon.follow import FORCE, NEAR, NORMAL, PAD, POSITION, RESIDUAL, VALUES, XY, Follower, Solved
from handtouch.daemon.model import PadModel
from handtouch.supervise.baseline import Baseline
from handtouch.supervise.strength import ForceReference, SheetStrength, StrengthState
from handtouch.wire import PadState

FloatArray = NDArray[np.float64]
_STALE_PERIODS = 3
_SOURCE_STD, _SOURCE_PART = 10.0, 0.02
"""How far below zero a channel may be: standard deviations of noise, and part of all channels."""
# plain numbers: looking up members of an enumeration costs a microsecond each
_CLEAR, _TOUCHED, _STALE, _FAULTED = map(
    int, (PadState.CLEAR, PadState.TOUCHED, PadState.STALE, PadState.FAULTED)
)
_UNESTIMATED, _INVALID = int(StrengthState.UNESTIMATED), int(StrengthState.INVALID)
_FOREVER_NS = np.iinfo(np.int64).max
LOCATED = np.dtype(
    [
        ("pad_m", "<f4", 2),
        ("residual", "<f4"),
        ("position_m", "<f4", 3),
        ("normal", "<f4", 3),
        ("force_n", "<f4"),
        ("force_std_n", "<f4"),
        ("residual_std", "<f4"),
        ("covariance_m2", "<f4", 9),
    ]
)
_ALL_CHANNELS = np.ones(4)
_LEAVING = 0.7
"""Of a map's trust: beyond it, it is drawn anew before the contact leaves it."""
_ALONG = 0.3
"""Beyond this, it is drawn along with one that has to be: a further one costs a tenth of the first."""
_TREND = 4
"""Ticks of exponential smoothing, which lags behind a steady change by one less."""
_NOTHING_READ = np.zeros(0, dtype=np.intp), np.zeros((0, 4))


@dataclass(frozen=True)
class Columns:
    """What is known of each of n pads; a row keeps its last values while no newer ones are there."""

    state: NDArray[np.uint8]
    """PadState"""
    sample_ns: NDArray[np.int64]
    """SYNC that the newest sample belongs to, 0 before the first"""
    current_a: FloatArray
    """total current"""
    values: FloatArray
    """(n, VALUES) what follows from the currents of each tick; the six below are views of it"""
    xy: FloatArray
    """(n, 2) location on the pad's rectangle"""
    position_m: FloatArray
    """(n, 3) in the link frame; NaN where there is no valid location"""
    normal: FloatArray
    """(n, 3)"""
    pad_m: FloatArray
    """(n, 2) arc lengths from the electrodes x0 and y0"""
    residual: FloatArray
    force_n: FloatArray
    """NaN where there is no valid strength, a lower bound where it is saturated"""
    raw_force_n: FloatArray
    """as the contact law has it, before the sheet's behaviour is undone"""
    force_std_n: FloatArray
    covariance_m2: FloatArray
    """(n, 3, 3); this and the following are of the contact's last solution"""
    saturated: NDArray[np.bool_]
    residual_std: FloatArray
    """of a point contact, from the noise of the channels"""
    located: NDArray[np.void]
    """what is told of contacts, as LOCATED; all NaN without contact"""

    @classmethod
    def of(cls, n: int) -> Columns:
        """Columns of n pads of which nothing is known."""

        def unknown(*shape: int) -> FloatArray:
            return np.full((n, *shape), np.nan)

        values = unknown(VALUES)
        return cls(
            state=np.full(n, PadState.STARTING, dtype=np.uint8),
            sample_ns=np.zeros(n, dtype=np.int64),
            current_a=np.zeros(n),
            values=values,
            xy=values[:, XY],
            position_m=values[:, POSITION],
            normal=values[:, NORMAL],
            pad_m=values[:, PAD],
            residual=values[:, RESIDUAL],
            force_n=values[:, FORCE],
            raw_force_n=unknown(),
            force_std_n=unknown(),
            covariance_m2=unknown(3, 3),
            saturated=np.zeros(n, dtype=np.bool_),
            residual_std=unknown(),
            located=np.full((n, LOCATED.itemsize // 4), np.nan, dtype="<f4").view(LOCATED)[:, 0],
        )


class Ticked(NamedTuple):
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
        self.contacts = Contacts(model.on_a, model.off_a, model.begin_samples, model.end_samples)
        self.counts: NDArray[np.int64] = np.zeros((model.size, 4), dtype=np.int64)
        """of the last tick"""
        self.samples = np.zeros(model.size, dtype=np.int64)
        """samples taken in"""
        self.missed = np.zeros(model.size, dtype=np.int64)
        """ticks that an expected sample came too late for, or never"""
        self.period_ns = np.full(model.size, period_ns, dtype=np.int64)
        """longest time between two samples of each pad"""
        self.paced_ns = np.zeros(model.size, dtype=np.int64)
        """since when that is so"""
        self.synchronous = np.ones(model.size, dtype=np.bool_)
        """pads that sample with SYNC; the others when something moves, and are not waited for"""
        self.wanted = np.ones(model.size, dtype=np.bool_)
        """pads whose contacts are located; `want` sets it"""
        self.disturbed = False
        """something other than a step has changed what is kept; `Journal` takes notice"""
        self.baseline = Baseline(
            model.noise_counts,
            model.on_counts,
            model.off_counts,
            model.slow_touch_s,
            model.rows_of_hand.values(),
        )
        """what pads read untouched"""
        self.strength = SheetStrength(model.behaviours, period_ns)
        """what sheets do to forces, undone"""
        self.follower = Follower(model)
        self._read = _NOTHING_READ  # contacts of the last step: pads and currents
        self._behind = np.full((model.size, 4), np.nan)  # their currents, smoothed: as they were a while ago
        self._located = self.columns.located.view("<f4").reshape(model.size, -1)
        self._none = np.zeros(model.size, dtype=np.bool_)
        self._sampled, self._trusted = self._none.copy(), self._none.copy()  # of the last step
        self._gathered = True  # whether they are counted, and the baseline has seen them
        self._steps = 0
        self._every = np.ones(model.size, dtype=np.int64)  # steps from one update to the next
        self._sparse = False  # whether anything is not wanted at every step
        self._least_counts = -_SOURCE_STD * model.noise_counts[:, None]
        self._excess = np.zeros((model.size, 4))  # counts above the baseline
        self._currents = np.zeros((model.size, 4))
        self._law_std = np.full(model.size, np.nan)  # of forces, from noise and the contact's radius alone
        self._raw_std = np.full(model.size, np.nan)  # and from the baseline
        self._cycle_ns = 0
        self._taken_ns = np.zeros(model.size, dtype=np.int64)  # arrival of the samples that were used

    def expected(self) -> NDArray[np.bool_]:
        """Pads whose sample a tick should wait for: those that are alive."""
        return np.asarray((self.columns.state <= _TOUCHED) & self.synchronous)

    def want(
        self,
        located: BoolArray,
        weighed: BoolArray,
        tolerance_m: FloatArray,
        every: NDArray[np.int64],
    ) -> None:
        """Locate, weigh, and update every so many steps only what somebody wants; all (n,), copied."""
        if self.strength.any:  # what sheets remember has to be known of every contact
            located, weighed = located | self.strength.modelled, weighed | self.strength.modelled
        changed = np.flatnonzero((located != self.wanted) | (weighed != self.follower.weighed))
        self.forget(changed)
        self.follower.weighed[:], self.follower.tolerance_m[:] = weighed, tolerance_m
        self.wanted[:], self._every[:] = located, every
        self._sparse = not (located.all() and (every == 1).all())

    def unestimated(self, pads: slice | int) -> BoolArray:
        """Pads that are touched and whose force isn't to be relied on yet: too little is known of their
        baseline, or of what their sheet does."""
        unsure = self.baseline.unsure[pads] | (self.strength.state[pads] == _UNESTIMATED)
        return np.asarray(unsure & self.contacts.touching[pads])

    def place_noise(self, pads: IntArray) -> FloatArray:
        """Covariance (k, 2, 2) of arc lengths on the pads (k,) that is new with each of their samples."""
        return self.follower.place_noise(pads, self._currents.take(pads, axis=0))

    def solve_all(self) -> None:
        """Locate and weigh what is touched, wanted or not, as it is now; the next `want` forgets it."""
        everything = ~self._none
        self.want(everything, everything, self.follower.tolerance_m, self._every)
        touching = np.flatnonzero(self.contacts.touching)
        if len(touching):
            self._solve(touching)
            self._tell_forces(np.flatnonzero(self.contacts.touching & self.strength.modelled))

    def assume(self, pad: int, offset_counts: ArrayLike, std_counts: ArrayLike = 0.0) -> None:
        """What the channels (4,) of a pad read untouched, from a store or a tare, and how sure that is."""
        self.baseline.assume(pad, offset_counts, std_counts)
        self.disturbed = True

    def renew(self, pad: int) -> None:
        """Another unit, with another sheet, is in the place of a pad."""
        self.baseline.renew(pad)
        self.strength.recalibrated(pad, new_sheet=True)
        self.disturbed = True

    def turn(self, gravity: FloatArray) -> None:
        """Direction of gravity in each link's frame (n, 3), NaN where nobody knows; see `Told`."""
        self.baseline.turn(gravity)

    def refer(self, reference: ForceReference) -> int:
        """Compare forces with what something else measured, see `Told`; how many pads it tells of."""
        return self.strength.refer(reference, self.columns.sample_ns, self.contacts.touching)

    def adopt(self, model: PadModel, changed: IntArray) -> None:
        """Go on with another model of the same pads, of which some have changed; contacts go on."""
        self.strength = self.strength.adopt(self.model.behaviours, model.behaviours)
        self.baseline.adopt(model.noise_counts, model.on_counts, model.off_counts, model.slow_touch_s)
        for pad in changed.tolist():
            self.strength.recalibrated(pad)
        before, self.model = self.follower, model
        self.follower = Follower(model)
        self.follower.take_over(before)
        self._least_counts = -_SOURCE_STD * model.noise_counts[:, None]
        self.forget(changed)
        self.contacts.adopt(model.on_a, model.off_a, model.begin_samples, model.end_samples)

    def forget(self, pads: IntArray) -> None:
        """What was found on these pads holds no more."""
        columns = self.columns
        self.disturbed = True
        self.follower.forget(pads)
        columns.values[pads] = columns.force_std_n[pads] = self._located[pads] = np.nan
        columns.raw_force_n[pads] = np.nan

    def step(
        self,
        slab: Slab,
        node_state: NDArray[np.uint8],
        cycle: Cycle,
        now_ns: int,
        until_ns: int = _FOREVER_NS,
    ) -> Ticked:
        """Take in the samples of a cycle, and those of the one before that came too late for its tick.

        `now_ns` is the time of the tick; samples that arrived at `until_ns` or later are of the next cycle.
        `node_state` (n,): PadState.CLEAR where the node is up, else what its pad is instead.
        """
        model, columns, contacts = self.model, self.columns, self.contacts
        self._gather()
        operational = np.logical_not(node_state)  # CLEAR is 0
        sampled = self._take_in(slab, operational, cycle, until_ns)
        self.counts = counts = slab.read()
        excess = np.subtract(counts, self.baseline.expected, out=self._excess)
        absurd, stale = self._absurd(counts, slab), self._stale(now_ns, sampled)
        trusted = operational
        if not (absurd is self._none is stale):
            trusted = operational & ~(absurd | stale)
        np.multiply(excess, model.ampere_per_count, out=self._currents)
        np.copyto(columns.current_a, self._currents @ _ALL_CHANNELS, where=sampled)
        began, ended, telling = contacts.step(columns.current_a, sampled, trusted, columns.sample_ns)
        self._resolve_states(node_state, operational, absurd, stale)
        if len(began):
            columns.values[began] = np.nan  # no use to start from where the last contact was
            self.follower.forget(began)
            self._behind[began] = np.nan
            self.baseline.begin(began)
            self.strength.begin(began)
        self._sampled, self._trusted, self._gathered = sampled, trusted, False
        self._cycle_ns = cycle.t_ns
        self._steps += 1
        solved = telling
        if self._sparse:
            due = self._steps % self._every[telling] == 0
            telling = telling[due | np.isin(telling, began)]
            solved = telling[self.wanted[telling]]
        if len(solved):
            self._solve(solved)
        if self.strength.any:
            raw = self.columns.raw_force_n
            self._tell_forces(self.strength.step(raw, self._raw_std, contacts.touching, cycle.t_ns))
        if len(solved):
            np.fmax(contacts.peak_n, columns.force_n, out=contacts.peak_n, where=contacts.touching)
        if len(ended):
            self._located[ended] = np.nan
        updated = np.setdiff1d(telling, began) if len(began) else telling
        return Ticked(cycle.t_ns, began, updated, ended)

    # Details, for every tick: ufuncs of few elements cost what their calls cost, so what is rare is asked
    # about first, by `count_nonzero`, the quickest of numpy's calls ----------------------------------------

    def _take_in(self, slab: Slab, operational: BoolArray, cycle: Cycle, until_ns: int) -> BoolArray:
        """Note which samples are new and when they were taken; the pads (n,) that have one."""
        columns, size = self.columns, self.model.size
        sampled: BoolArray = (slab.t_ns != self._taken_ns) & operational
        in_time = slab.fresh.view(np.bool_)
        if until_ns == _FOREVER_NS:
            np.copyto(self._taken_ns, slab.t_ns)
        else:
            here = slab.t_ns < until_ns
            sampled &= here
            in_time = in_time & here
            np.copyto(self._taken_ns, slab.t_ns, where=here)
        np.copyto(columns.sample_ns, cycle.t_ns, where=sampled)
        if np.count_nonzero(in_time) < size:
            self.missed += self.expected() & operational & ~in_time
            np.copyto(columns.sample_ns, cycle.previous_ns, where=sampled & ~in_time)
        if np.count_nonzero(self.synchronous) < size:
            np.copyto(columns.sample_ns, slab.t_ns, where=sampled & ~self.synchronous)
        return sampled

    def _absurd(self, counts: NDArray[np.int64], slab: Slab) -> BoolArray:
        """Pads (n,) with a channel at the end of its range, or one that gives current: it can only take.

        Where all channels give, by no more than what begins a contact, the baseline is wrong and not the pad:
        it was learned during a light touch."""
        railed, least, read = slab.railed(counts), self._least_counts, self._excess
        if not np.count_nonzero(railed) and not np.count_nonzero(read < least):
            return self._none
        source = _SOURCE_PART * np.abs(read).sum(axis=1) - least[:, 0]
        gives = read.min(axis=1) < -source
        if np.count_nonzero(gives):
            amount_a = -(read * self.model.ampere_per_count).sum(axis=1)
            gives &= (read.max(axis=1) > -self._least_counts[:, 0]) | (amount_a > self.model.on_a)
        return np.asarray(railed.any(axis=1) | gives)

    def _stale(self, now_ns: int, sampled: BoolArray) -> BoolArray:
        """Pads (n,) that have been quiet for too long."""
        if np.count_nonzero(sampled) == self.model.size:
            return self._none
        since_ns = np.maximum(self.columns.sample_ns, self.paced_ns)
        return np.asarray((now_ns - since_ns > _STALE_PERIODS * self.period_ns) & ~sampled)

    def _resolve_states(
        self,
        node_state: NDArray[np.uint8],
        operational: BoolArray,
        absurd: BoolArray,
        stale: BoolArray,
    ) -> None:
        state = self.columns.state
        np.copyto(state, node_state)
        np.copyto(state, _TOUCHED, where=operational & self.contacts.touching)
        if not (absurd is self._none is stale):
            np.copyto(state, _FAULTED, where=operational & absurd)
            np.copyto(state, _STALE, where=operational & stale)

    def _solve(self, touched: IntArray) -> None:
        """Locate, place and weigh the contacts on the pads `touched`."""
        currents = self._currents.take(touched, axis=0)
        values, off = self.follower.read(touched, currents)
        if np.count_nonzero(off <= 1) < off.size:  # or NaN
            self._solve_anew(touched, currents, values, off)
        self._read = touched, currents
        self.columns.values[touched] = values
        self._located[touched, :10] = values[:, PAD.start :]
        if self.strength.any:
            self.columns.raw_force_n[touched] = values[:, FORCE]

    def _gather(self) -> None:
        """Count samples, and keep those of untouched pads for the baseline; what may be a contact in a moment
        is none of these. Nobody waits for that: it is done after the messages of a step have left."""
        if self._gathered:
            return
        self._gathered = True
        self.samples += self._sampled
        free = self._sampled & self._trusted
        free &= self.columns.current_a <= self.model.on_a
        free &= ~self.contacts.touching
        self.baseline.gather(self._excess, free)

    def _tell_forces(self, pads: IntArray) -> None:
        """Forces on sheets whose behaviour is undone, in the place of what the contact law alone says."""
        columns, strength = self.columns, self.strength
        force = np.where(strength.state[pads] == _INVALID, np.nan, strength.force_n[pads])
        std = np.where(columns.saturated[pads], np.inf, strength.std_n[pads])
        columns.force_n[pads], columns.force_std_n[pads] = force, std
        self._located[pads, 9] = force
        self._located[pads, 10] = np.where(np.isfinite(std), std, np.nan)

    def _doubt(self, pads: IntArray) -> None:
        """Standard deviations of forces, from the law's and the baseline's."""
        columns = self.columns
        with np.errstate(divide="ignore", invalid="ignore"):
            off = self.baseline.std[pads] * self.model.ampere_per_count[pads].mean(axis=1)
            by_baseline = self.follower.force_slopes(pads) * off / (self._currents[pads] @ _ALL_CHANNELS)
        std = np.hypot(self._law_std[pads], by_baseline)
        self._raw_std[pads] = std
        if self.strength.any:
            plain = ~self.strength.modelled[pads]
            pads, std = pads[plain], std[plain]
        columns.force_std_n[pads] = std
        self._located[pads, 10] = np.where(np.isfinite(std), std, np.nan)

    def _solve_anew(self, pads: IntArray, currents: FloatArray, values: FloatArray, off: FloatArray) -> None:
        """Put into `values` and `off` what holds of contacts whose maps don't."""
        far = off.max(axis=1)
        near = np.flatnonzero((far > 1) & (far <= NEAR))
        if len(near):
            self._draw(pads[near], currents[near], values[near, XY])
            values[near], off[near] = self.follower.read(pads[near], currents[near])
        lost = np.flatnonzero(~(off.max(axis=1) <= 1))
        if len(lost):
            some = pads[lost]
            self._keep(some, self.follower.solve(some, currents[lost], self.columns.xy[some]))
            values[lost], off[lost] = self.follower.read(some, currents[lost])

    def settle(self) -> None:
        """Carry the baseline on; draw anew the maps that contacts are about to leave, where they are heading.

        Call it between two steps, when nobody waits: it makes the next step cheap, and changes no contact.
        """
        self._gather()
        if self._cycle_ns and self.baseline.learn(self._cycle_ns, self.contacts.touching):
            touching = np.flatnonzero(self.contacts.touching)
            if len(touching):
                self._doubt(touching)
        pads, currents = self._read
        self._read = _NOTHING_READ
        if not len(pads):
            return
        behind = self._behind.take(pads, axis=0)
        behind = np.where(np.isnan(behind), currents, behind + (currents - behind) / _TREND)
        self._behind[pads] = behind
        ahead = currents + (currents - behind) / (_TREND - 1)
        values, off = self.follower.read(pads, ahead)
        if np.count_nonzero(off > _LEAVING) and np.count_nonzero((far := off.max(axis=1)) > _LEAVING):
            leaving = np.flatnonzero(far > _ALONG)
            self._draw(pads[leaving], ahead[leaving], values[leaving, XY])

    def _draw(self, pads: IntArray, currents: FloatArray, xy: FloatArray) -> None:
        self._keep(pads, self.follower.draw(pads, currents, xy))

    def _keep(self, pads: IntArray, solved: Solved) -> None:
        columns = self.columns
        columns.covariance_m2[pads] = solved.covariance_m2
        self._law_std[pads] = solved.force_std_n
        columns.saturated[pads] = solved.saturated
        columns.residual_std[pads] = solved.residual_std
        self._doubt(pads)
        self._located[pads, 11] = solved.residual_std
        self._located[pads, 12:] = solved.covariance_m2.reshape(-1, 9)
