"""Baselines: counts of untouched pads, tracked while a pad is untouched and held while it is touched.

Public names: `Baseline`, `BaselineSettings`.

Ticks only collect samples (`stages.detect`, the `block_...` arrays of the state); a tenth of a second of them
is then processed at once (`update_baseline`), with its duration, so that tick rate and missing samples make
no difference. Rules:
* An untouched pad's baseline is tracked with a time constant, up to a maximum rate: a slower rise is drift.
* No contact lowers a channel. Where one falls slowly, the whole reading is drift and is tracked at any rate;
  a step is a fault, not drift.
* A quiet pad whose baseline was never known, or held while it was touched, has the zeros that it reads, if no
  contact could cause them.
* While a pad is touched, a channel that falls below its baseline slowly takes that along. What is left of a
  much firmer contact, and lies still, is the drift of the meantime, if it isn't more than that may be.
* Hum and noise move channels below the baseline as often as above it. Their amplitude raises thresholds.
* A touched pad's baseline is held, after release too, until the pad reads nearly its baseline again: leakage
  or creep neither triggers another contact nor becomes the baseline.
* The common drift of a hand's untouched pads (temperature, supply), a median without pads that a light
  contact may load, is applied to touched ones too.
* The initial baseline and its standard deviation decide whether a first reading is a contact.
* A sheet only sinks current. A reading below the baseline means that the pad was touched when that was
  learned, too lightly to be distinguished from an offset: the baseline is learned again.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch.arrays import BoolArray, FloatArray, IntArray
from handtouch.core.link_load import LinkLoad
from handtouch.core.state import TickState

# Constants without an origin beside them were chosen; docs/benchmarks/supervise.md measures what they yield.
BLOCK_DURATION_NS = 97_000_000  # no multiple of a period: rounding of stamps moves no sample to another block
_MAX_PAUSE_NS = 3600 * 10**9  # longer: another clock
TRACKING_TIME_S = 10.0  # time constant of offsets
_NOISE_TIME_S = 60.0  # time constant of the noise estimate
_NOISE_PERIOD_BLOCKS = 10  # blocks per update of the noise estimate
_MIN_VARIANCE_SAMPLES = 4  # in a block
_DRIFT_SPEED_PERIOD_S = 60.0  # untouched time per measurement of the drift speed
_DRIFT_SPEED_GAIN = 0.2  # gain of such a measurement
_INITIAL_DRIFT_SIGMA_PER_S = 0.02  # initial drift over the noise
_MAX_RETURN_FRACTION = 0.5  # distance of a released pad from its baseline over the end threshold
_CONFIDENCE_SIGMA = 3.0  # deviations of an untouched pad up to a threshold
_FOLLOWED_SIGMA = 5.0
"""Of a block's mean that is followed as a fall: at 3, noise lowers a channel's baseline 50 times an hour, and
the common drift, a median, rises: an object held for an hour read 3 % less"""
_MIN_COMMON_DRIFT_PADS = 3  # untouched pads of a hand
_FALLING_TIME_S = 2.0  # time constant of readings that no contact causes
_MAX_FALL_SIGMA = 10.0  # more is a step: such samples are implausible, see `stages.detect`
_MIN_FALL_FRACTION = 0.02  # of all channels: as much may be a wrong gain
_MIN_CONTACT_SPREAD = 0.3  # of the mean of a pad's channels; drift of temperature or supply moves them alike
_QUIET_SIGMA = 3.0  # of a channel's noise in a block: not held by a hand
_STILL_S = 10.0  # time after which what is left of a contact is drift
_MAX_LEFT_FRACTION, _MAX_LEFT_THRESHOLDS = 0.1, 2.0  # of the contact's largest current; of what begins one
_MIN_CROSSINGS = 6.0  # of the mean in a block: 31 Hz, a hand touches and trembles more slowly
_DISTURBANCE_TIME_S = 60.0  # time in which a disturbance that has gone is forgotten
_TURN_SIGMA = 2.0  # of what turns may do to a pad, all channels alike, over thresholds
_DISTURBANCE_MARGIN = 1.5  # of thresholds over the sum of the amplitudes


class BaselineSettings(NamedTuple):
    """Settings of n pads, all (n,)."""

    noise_counts: FloatArray
    """configured noise of a channel"""
    begin_counts: FloatArray
    """sum of channels at which a contact begins"""
    end_counts: FloatArray
    """sum of channels at which it ends"""
    max_rise_time_s: FloatArray
    """a reading that takes longer to rise to `end_counts` is drift"""
    magnetic: BoolArray | bool = False
    """zeros shift with the link's orientation, not with gravity on it"""


class Baseline:
    """Baselines of the channels of n pads [counts]; `hands` are the rows of each hand.

    electrode_counts: (n,) number of channels of each pad, those of `state` by default.

    Public state: `offset` (n, c); `std` (n,) of the sum of the channels; `noise_squared` (n, c) [counts^2] of
    untouched samples; `held` (n,): touched, or released and not back yet; `unverified` (n,): no reading has
    agreed with the baseline yet; `known` (n,): set, or measured untouched; `drift_speed` (n,): recent drift
    of the sum, without the common one [counts/s]; `link_load`: what gravity and acceleration add;
    `disturbance` (n, c): amplitude of hum and noise [counts], by which `threshold_factor` (n,) raises the
    thresholds of contacts.
    """

    def __init__(
        self,
        settings: BaselineSettings,
        hands: Iterable[slice],
        state: TickState | None = None,
        electrode_counts: IntArray | None = None,
    ) -> None:
        noise_counts, hands = settings.noise_counts, list(hands)
        n = len(noise_counts)
        self._hands = hands
        held = TickState.empty(n, len(hands)) if state is None else state
        self._channels = np.full(n, held.channels) if electrode_counts is None else electrode_counts
        self._used = (np.arange(held.channels) < self._channels[:, None]).astype(np.float64)
        self._ones, self._root_channels = np.ones(held.channels), np.sqrt(self._channels)
        self.link_load = LinkLoad(held)
        self._set_limits(settings)
        self.offset, self.std, self.noise_squared = held.offset, held.offset_std, held.noise_squared
        self.held, self.unverified, self.known = held.held, held.unverified, held.known
        self.touching, self.drift_speed = held.block_touching, held.drift_speed
        self.common_drift = held.common_drift
        """drift per channel common to each hand's pads"""
        self.std[:] = settings.begin_counts / _CONFIDENCE_SIGMA
        self.noise_squared[:] = np.square(noise_counts)[:, None] * self._used
        self._update_channel_noise()
        self.drift_speed[:] = _INITIAL_DRIFT_SIGMA_PER_S * noise_counts
        self.expected_counts = np.zeros((n, held.channels))
        """(n, c) counts to subtract from a reading"""
        self._hand_membership = np.zeros((len(hands), n))
        for row, pads in enumerate(hands):
            self._hand_membership[row, pads] = 1.0
        self._sum, self._squares, self._count = held.block_sum, held.block_squares, held.block_count
        self._blocks, self._block_begin_ns = held.blocks, held.block_begin_ns
        self._span_sum, self._span_squares = held.span_sum, held.span_squares
        self._span_low, self._span_count = held.span_low, held.span_count
        self._span_crossings, self._span_level = held.span_crossings, held.span_level
        self._earlier, self.disturbance = held.earlier_disturbance, held.disturbance
        self.threshold_factor = held.threshold_factor
        self._begin_ns, self._peak_level, self._still_s = held.begin_ns, held.peak_level, held.still_s
        self._drift_until_ns = held.drift_until_ns  # time of each pad's last offset update
        self._anchor, self._anchored_s = held.drift_anchor, held.drift_anchored_s

    def set_settings(self, settings: BaselineSettings) -> None:
        """Change the settings of all pads. Call it also after the state was loaded."""
        self._set_limits(settings)
        self._update_channel_noise()
        self._update_expected()

    def set_offset(self, pad: int, offset: npt.ArrayLike, std: npt.ArrayLike = 0.0) -> None:
        """Set offsets (k,) of a pad's k channels, and their standard deviations (k,) or () [counts], from a
        store or a tare. The next reading is a contact only if it differs by more than these explain."""
        count = self._channels[pad]
        self.offset[pad, :count] = offset
        if (load := self.link_load.expected_counts()) is not None:
            self.offset[pad] -= load[pad]
        self.std[pad] = np.sqrt(np.sum(np.square(np.broadcast_to(std, count))))
        self.unverified[pad] = self.known[pad] = True
        self.held[pad] = self.touching[pad]
        self._anchored_s[pad] = 0.0
        self._discard_samples(np.array([pad]))
        self._update_expected()

    def reset_pad(self, pad: int) -> None:
        """Forget what was learned of a pad, because its node was replaced."""
        self.link_load.reset_pad(pad)
        self.noise_squared[pad] = self._noise[pad] ** 2 * self._used[pad]
        self.disturbance[pad] = self._earlier[pad] = 0.0
        self._update_channel_noise()
        self.drift_speed[pad] = _INITIAL_DRIFT_SIGMA_PER_S * self._noise[pad]
        std = self._begin_threshold[pad] / (self._root_channels[pad] * _CONFIDENCE_SIGMA)
        self.set_offset(pad, np.zeros(self._channels[pad]), std)
        self.known[pad] = False

    def set_felt_gravity(self, felt: FloatArray) -> None:
        """Set gravity less acceleration in each link's frame (n, 3), in units of gravity; NaN where unknown:
        the last one holds."""
        self.link_load.set_felt(felt)
        self._update_expected()
        if np.count_nonzero(self.link_load.magnetic):
            self._update_thresholds()

    @property
    def noise_factor(self) -> FloatArray:
        """What hum and noise would raise thresholds by (n,); below 1, they don't."""
        return np.asarray(_DISTURBANCE_MARGIN * (self.disturbance @ self._ones) / self._begin_threshold)

    @property
    def noise_counts(self) -> FloatArray:
        """Standard deviation of each channel (n, c), measured while untouched."""
        return np.asarray(np.sqrt(self.noise_squared))

    def update_baseline(self, sync_ns: int, touching: BoolArray) -> bool:
        """Process the samples collected, once a block is complete; return True if it was. `touching` (n,):
        present contacts."""
        elapsed_ns = sync_ns - int(self._block_begin_ns[0])
        if 0 <= elapsed_ns < BLOCK_DURATION_NS:
            return False
        self._block_begin_ns[0] = sync_ns
        if not 0 <= elapsed_ns < _MAX_PAUSE_NS:  # the first block, or another clock
            self._drift_until_ns[:] = sync_ns
            return False
        np.copyto(self.touching, touching)
        self.held |= touching
        sampled = self._count > 0
        mean = self._sum / np.maximum(self._count, 1.0)[:, None]
        total = mean @ self._ones
        self._update_disturbance(elapsed_ns * 1e-9)
        mean_std = self._channel_noise / np.sqrt(np.maximum(self._count, 1.0))[:, None]
        # hum of which the samples above a threshold were left out
        whole = ~self._swings() | (self._count >= self._span_count)
        falls = whole & self._falls(mean, _CONFIDENCE_SIGMA * mean_std)
        self._follow_falls_in_touch()
        self._end_drifted_contacts(sync_ns, elapsed_ns * 1e-9)
        shifted = self.held & (mean < -_MAX_FALL_SIGMA * self._noise[:, None]).any(axis=1)
        if np.count_nonzero(unknown := falls & sampled & ~touching & (~self.known | shifted)):
            self._learn_zeros(unknown, mean, mean_std)
            sampled &= ~unknown
        self._release_returned(sampled & whole & ~touching, total)
        free = sampled & ~self.held
        dt_s = np.asarray((sync_ns - self._drift_until_ns) * 1e-9, np.float64)
        np.copyto(self._drift_until_ns, sync_ns, where=free | self.held)
        followed = falls & self._falls(mean, _FOLLOWED_SIGMA * mean_std)
        moved = self._track_offsets(mean, followed, free, dt_s)
        self._update_drift(moved, free & ~self._may_be_contact(mean, mean_std), free, elapsed_ns * 1e-9, dt_s)
        self._blocks[0] += 1
        if self._blocks[0] % _NOISE_PERIOD_BLOCKS == 0:
            self._update_noise(mean, free)
        limits = self._noise, self._begin_threshold, TRACKING_TIME_S
        if (explained := self.link_load.learn(mean, free, dt_s, *limits)) is not None:
            self.offset += explained
        self._update_expected()
        self._sum[:] = 0.0
        self._squares[:] = 0.0
        self._count[:] = 0.0
        self._span_level[:] = (self._span_sum @ self._ones) / np.maximum(self._span_count, 1.0)
        self._span_sum[:] = self._span_squares[:] = 0.0
        self._span_count[:] = self._span_crossings[:] = 0.0
        return True

    # Details: parts of `update_baseline` --------------------------------------------------------------------

    def _update_disturbance(self, elapsed_s: float) -> None:
        """Measure how far hum and noise move each channel, at the least in the last three blocks: faster than
        a hand touches, and down to where no contact is."""
        count = np.maximum(self._span_count, 1.0)[:, None]
        variance = np.maximum(self._span_squares / count - np.square(self._span_sum / count), 0.0)
        known = self._span_count >= _MIN_VARIANCE_SAMPLES
        moves = self._swings() & (self._span_low < self._end_threshold * self.threshold_factor)
        now = np.sqrt(2 * variance * moves[:, None])
        lasting = np.minimum(now, self._earlier.min(axis=1))
        kept = np.where(self.touching, 1.0, np.exp(-elapsed_s / _DISTURBANCE_TIME_S))[:, None]
        level = np.maximum(lasting, self.disturbance * kept)
        np.copyto(self.disturbance, level, where=known[:, None])
        self._earlier[known, 0] = self._earlier[known, 1]
        self._earlier[known, 1] = now[known]
        self._update_thresholds()

    def _update_thresholds(self) -> None:
        """Raise the thresholds over hum and noise, and over what turns may do to magnetic pads."""
        np.maximum(self.noise_factor, 1.0, out=self.threshold_factor)
        if np.count_nonzero(self.link_load.magnetic):
            self.threshold_factor += _TURN_SIGMA * self._turn_std() / self._begin_threshold

    def _swings(self) -> BoolArray:
        """Return the pads (n,) that cross their mean faster than a hand touches."""
        return np.asarray(self._span_crossings >= np.minimum(_MIN_CROSSINGS, self._span_count - 2))

    def _falls(self, mean: FloatArray, margin: FloatArray) -> BoolArray:
        """Return the pads (n,) with a channel so much below the baseline that no contact explains it.

        margin: (n, c), what its noise may be.
        """
        least = _MIN_FALL_FRACTION * (np.abs(mean) @ self._ones)[:, None] + margin
        return np.asarray((mean < -least).any(axis=1))

    def _learn_zeros(self, unknown: BoolArray, mean: FloatArray, mean_std: FloatArray) -> None:
        """Take the readings of quiet pads, which no contact causes, as their unknown baselines."""
        spare = np.maximum(self._count - 1, 1.0)[:, None]
        variance = (self._squares - self._sum * mean) / spare
        quiet = (variance <= np.square(_QUIET_SIGMA * self._channel_noise)).all(axis=1)
        learned = unknown & quiet & (self._count >= _MIN_VARIANCE_SAMPLES)
        self.offset += mean * learned[:, None]
        self.std[learned] = np.sqrt(np.square(mean_std[learned] * self._used[learned]).sum(axis=1))
        self.unverified[learned], self.known[learned] = False, True
        self.held[learned] = False

    def _follow_falls_in_touch(self) -> None:
        """Lower the baseline of channels of touched pads that read less, as no contact lowers a channel. A
        step isn't followed: see `stages.detect`."""
        count = np.maximum(self._span_count, 1.0)[:, None]
        mean, margin = self._span_sum / count, _CONFIDENCE_SIGMA * self._channel_noise / np.sqrt(count)
        slow = (mean < -margin) & (mean > -_MAX_FALL_SIGMA * self._noise[:, None])
        slow &= (self.touching & (self._span_count >= _MIN_VARIANCE_SAMPLES))[:, None]
        if np.count_nonzero(slow):
            step = (mean + margin) * slow
            self.offset += step
            self.std -= step @ self._ones

    def _end_drifted_contacts(self, sync_ns: int, elapsed_s: float) -> None:
        """Learn the zeros of touched pads that read what drift may have added since their contact began."""
        count = np.maximum(self._span_count, 1.0)[:, None]
        mean = self._span_sum / count
        level = mean @ self._ones
        np.copyto(self._peak_level, np.maximum(self._peak_level, level) * self.touching)
        left = np.minimum(
            self._max_rate * (sync_ns - self._begin_ns) * 1e-9, _MAX_LEFT_THRESHOLDS * self._begin_threshold
        )
        left = np.minimum(left, _MAX_LEFT_FRACTION * self._peak_level)
        small = self.touching & (level < left) & (self._span_count >= _MIN_VARIANCE_SAMPLES)
        if not np.count_nonzero(small):
            self._still_s[:] = 0.0
            return
        variance = self._span_squares / count - np.square(mean)
        still = (variance <= np.square(_QUIET_SIGMA * self._channel_noise)).all(axis=1)
        still &= np.abs(level - self._span_level) <= _QUIET_SIGMA * self._root_channels * self._noise
        self._still_s[:] = (self._still_s + elapsed_s) * (small & still)
        drifted = self._still_s > _STILL_S
        self.offset += mean * drifted[:, None]
        self.std[drifted] = self._noise[drifted]

    def _may_be_contact(self, mean: FloatArray, mean_std: FloatArray) -> BoolArray:
        """Return the pads (n,) that a contact below the threshold may load: no channel has fallen, and they
        rise by different amounts."""
        used = self._used > 0
        low = np.where(used, mean, np.inf).min(axis=1)
        high = np.where(used, mean, -np.inf).max(axis=1)
        noise = _CONFIDENCE_SIGMA * mean_std.max(axis=1)
        average = (mean @ self._ones) / self._channels
        return np.asarray((low > -noise) & (high - low > 2 * noise + _MIN_CONTACT_SPREAD * average))

    def _release_returned(self, sampled: BoolArray, total: FloatArray) -> None:
        """End the hold of pads that read nearly their baseline again."""
        sum_std = self._sum_std()
        near = _MAX_RETURN_FRACTION * self._end_threshold + _CONFIDENCE_SIGMA * sum_std
        less = sampled & (total < -near) & (total >= -self._begin_threshold)
        if np.count_nonzero(less):
            self.unverified |= less
            self.held |= less  # until the next block: only a part of this one may be without the touch
            self.std[less] = self._begin_threshold[less] / _CONFIDENCE_SIGMA
            sum_std = self._sum_std()
            sampled = sampled & ~less
        elif not np.count_nonzero(self.unverified) and not np.count_nonzero(self.held):
            return
        first_near = _CONFIDENCE_SIGMA * sum_std
        first_near = np.minimum(first_near, np.maximum(self._begin_threshold, _CONFIDENCE_SIGMA * self.std))
        near = np.where(self.unverified, first_near, near)
        back = sampled & (np.abs(total) <= near)
        first = np.flatnonzero(back & self.unverified)
        if len(first):
            count = self._count[first]
            variance = np.square(self._noise[first]) * self._channels[first] / count
            gain = np.square(self.std[first]) / (np.square(self.std[first]) + variance)
            jump = self._sum[first] * (gain / count)[:, None]
            self.offset[first] += jump
            self._sum[first] -= jump * count[:, None]
            self._squares[first] = 0.0
            self._count[first] = 0.0
            self.std[first] = np.sqrt(gain * variance)
            self.unverified[first], self.known[first] = False, True
        self.held &= ~back

    def _sum_std(self) -> FloatArray:
        """Return the standard deviation (n,) of the sum of an untouched pad's channels."""
        found = np.hypot(self.std, self._root_channels * self._noise)
        return np.hypot(found, self._turn_std()) if np.count_nonzero(self.link_load.magnetic) else found

    def _turn_std(self) -> FloatArray:
        """Return the standard deviation (n,) of what turns do to the sum of magnetic pads' channels."""
        return self.link_load.unknown_counts(self._begin_threshold) * self._channels

    def _track_offsets(
        self, mean: FloatArray, falls: BoolArray, free: BoolArray, dt_s: FloatArray
    ) -> FloatArray:
        """Move offsets towards the readings: do/dt = excess / time constant, up to the maximum rate unless
        they fall. Return the change (n, c). Exact for a constant reading, whatever the intervals."""
        excess = np.abs(mean) @ self._ones
        linear = self._max_rate * TRACKING_TIME_S
        bound_s = np.maximum(excess - linear, 0.0) / self._max_rate
        remaining = np.minimum(excess, linear) * np.exp(np.minimum(bound_s - dt_s, 0.0) / TRACKING_TIME_S)
        remaining = np.maximum(remaining, excess - self._max_rate * dt_s)
        fraction = (1 - remaining / np.maximum(excess, 1e-12)) * free
        if np.count_nonzero(falling := falls & free):
            falling &= (mean > -_MAX_FALL_SIGMA * self._noise[:, None]).all(axis=1)
            fraction[falling] = -np.expm1(-dt_s[falling] / _FALLING_TIME_S)
        moved = mean * fraction[:, None]
        self.offset += moved
        return np.asarray(moved)

    def _update_drift(
        self, moved: FloatArray, unloaded: BoolArray, free: BoolArray, elapsed_s: float, dt_s: FloatArray
    ) -> None:
        """Apply the drift common to the unloaded pads of a hand to held ones, and propagate the standard
        deviations."""
        shift = np.zeros(len(self._hands))
        per_channel = (moved @ self._ones) / self._channels
        for row, pads in enumerate(self._hands):
            counted = np.sort(per_channel[pads][unloaded[pads]])
            if len(counted) >= _MIN_COMMON_DRIFT_PADS:  # its median
                shift[row] = 0.5 * (counted[len(counted) // 2] + counted[(len(counted) - 1) // 2])
        self.common_drift += shift
        kept = shift @ self._hand_membership * self.held
        self.offset += kept[:, None] * self._used
        settled = (
            self.drift_speed * TRACKING_TIME_S + _MAX_RETURN_FRACTION * self._noise - self.std
        ) * -np.expm1(-dt_s / TRACKING_TIME_S)
        self.std += np.where(free, settled, self.drift_speed * elapsed_s)
        self._anchored_s += free * dt_s
        if np.count_nonzero(due := self._anchored_s >= _DRIFT_SPEED_PERIOD_S):
            common = self._channels * (self.common_drift @ self._hand_membership)
            own = self.offset @ self._ones - common
            speed = np.abs(own - self._anchor)[due] / self._anchored_s[due]
            self.drift_speed[due] += _DRIFT_SPEED_GAIN * (speed - self.drift_speed[due])
            self._anchor[due], self._anchored_s[due] = own[due], 0.0

    def _update_noise(self, mean: FloatArray, free: BoolArray) -> None:
        """Update the noise from the scatter about a block's mean; no baseline moves within a block."""
        enough = free & (self._count >= _MIN_VARIANCE_SAMPLES)
        spare = np.maximum(self._count - 1, 1.0)[:, None]
        variance = (self._squares - self._sum * mean) / spare
        part = -np.expm1(-_NOISE_PERIOD_BLOCKS * BLOCK_DURATION_NS * 1e-9 / _NOISE_TIME_S) * enough
        self.noise_squared += (variance - self.noise_squared) * part[:, None]
        self._update_channel_noise()

    def _update_channel_noise(self) -> None:
        stated = np.square(self._noise)[:, None]
        self._channel_noise = np.sqrt(np.maximum(self.noise_squared, stated))
        """(n, c) the larger of the stated and the measured standard deviation"""

    def _discard_samples(self, pads: IntArray) -> None:
        self._sum[pads] = self._squares[pads] = 0.0
        self._count[pads] = 0.0

    def _update_expected(self) -> None:
        np.copyto(self.expected_counts, self.offset)
        if (load := self.link_load.expected_counts()) is not None:
            self.expected_counts += load

    def _set_limits(self, settings: BaselineSettings) -> None:
        self._noise, self._begin_threshold, end, max_rise_time_s, magnetic = settings
        self.link_load.magnetic[:] = magnetic
        self._end_threshold = end
        self._max_rate = end / max_rise_time_s
