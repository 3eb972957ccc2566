"""Samples of a tick to contacts: currents, validity, two thresholds and a debounce; one pass over the pads.

Public names: `ContactDetector`, `DetectionSettings`, `ContactChanges`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handtouch.core.memory import view_memory
from handtouch.core.stages.receive import SampleMemory
from handtouch.core.stages.rows import VALUE_COUNT
from handtouch.wire.status import MAX_SILENT_PERIODS, PadState

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from handtouch.arrays import FloatArray, IntArray
    from handtouch.core.memory import RowArray
    from handtouch.core.pad_model import PadModel
    from handtouch.core.slab import Cycle, Slab
    from handtouch.core.state import TickState

_VALUES = VALUE_COUNT
_CLEAR, _TOUCHED, _STALE, _, _FAULTED, _STARTING, _ = map(int, PadState)
_MAX_SILENT = MAX_SILENT_PERIODS
_MAX_NEGATIVE_SIGMA, _MAX_NEGATIVE_FRACTION = 10.0, 0.02  # of a channel's noise, and of all channels
_MAX_NEGATIVE_AMPLITUDES = 2.0  # of hum and noise
_MAX_ZERO_FRACTION = 0.02  # of a channel's range: an amplifier's offset is less, if it isn't broken
_NAN = float("nan")
_NO_LIMIT_NS = (1 << 63) - 1
_NO_PADS = np.zeros(0, dtype=np.intp)


class DetectionSettings(NamedTuple):
    """Settings of n pads, read in place in every tick."""

    ampere_per_count: FloatArray
    """(n, channels)"""
    mean_ampere_per_count: FloatArray
    """(n,)"""
    noise_counts: FloatArray
    """(n,) of a channel"""
    begin_threshold_a: FloatArray
    """(n,) a contact begins above it"""
    end_threshold_a: FloatArray
    """(n,) a contact ends below it"""
    touch: RowArray
    """(n,) TOUCH_ROWs"""
    sample_delay_ns: NDArray[np.int64]
    """(n,) from a sample to its SYNC, or to its arrival where it is event-driven"""

    @classmethod
    def of_model(cls, model: PadModel) -> DetectionSettings:
        """Return those of a model, which has them by the same names."""
        return cls(*(getattr(model, name) for name in cls._fields))


class ContactChanges(NamedTuple):
    """Pads whose contact began or ended in one tick, continues with a new sample (`updated`) or without the
    expected one (`silent`), those whose contact is to be solved, and those whose new sample only a hand frame
    needs (`framed`)."""

    began: IntArray
    ended: IntArray
    updated: IntArray
    silent: IntArray
    solved: IntArray
    framed: IntArray


_NO_CHANGES = ContactChanges(*[_NO_PADS] * len(ContactChanges._fields))


class ContactDetector:
    """Detection of contacts on n pads, at most one each, in a tick's state.

    expected_counts: (n, c) of untouched pads, read in place.
    Written for the solver: `currents_a` (n, c), `saturated_channels` (n, c), those at the top of their range,
    and `offset_std_a` (n,), the standard deviation of the sums of the currents from the baseline [A].
    c is the number of electrodes of the pad that has most; those that a pad lacks have no current. Further
    channels of the slab are those of shear pads, whose currents never end: they are no part of a contact.
    """

    def __init__(self, settings: DetectionSettings, expected_counts: FloatArray, state: TickState) -> None:
        arrays, self.pads, self.channels = state.memory, state.pads, expected_counts.shape[1]
        # of a tick
        self.lists = [np.zeros(state.pads, np.intp) for _ in ContactChanges._fields]
        self.began_pads, self.ended_pads, self.updated_pads = map(view_memory, self.lists[:3])
        self.silent_pads, self.solved_pads, self.framed_pads = map(view_memory, self.lists[3:])
        self.began = self.ended = self.updated = self.silent = self.solved = self.framed = 0
        self.currents_a, self.offset_std_a = np.zeros_like(expected_counts), np.zeros(state.pads)
        self.saturated_channels = np.zeros(expected_counts.shape, dtype=np.bool_)
        self.currents, self.sum_std_a = view_memory(self.currents_a), view_memory(self.offset_std_a)
        self.saturated = view_memory(self.saturated_channels)
        # model
        self.expected_counts = view_memory(expected_counts)
        self.set_settings(settings)
        # samples
        self.ticks = arrays["ticks"]
        self.pad_state, self.sample_ns = arrays["pad_state"], arrays["sample_ns"]
        self.arrival_ns, self.sample_counts = arrays["arrival_ns"], arrays["sample_counts"]
        self.missed_sample_counts, self.silent_ns = arrays["missed_sample_counts"], arrays["silent_ns"]
        self.synchronous = arrays["synchronous"]
        self.max_sample_period_ns = arrays["max_sample_period_ns"]
        self.total_current_a = arrays["total_current_a"]
        # contacts
        self.touching, self.contact_id = arrays["touching"], arrays["contact_id"]
        self.next_contact_id, self.begin_ns = arrays["next_contact_id"], arrays["begin_ns"]
        self.first_sample_ns = arrays["first_sample_ns"]
        self.contradicting_samples = arrays["contradicting_samples"]
        self.peak_force_n, self.is_solved = arrays["peak_force_n"], arrays["solved"]
        self.values = arrays["values"]
        self.position_requested = arrays["position_requested"]
        self.update_interval_ticks = arrays["update_interval_ticks"]
        self.ticks_per_hand_frame = arrays["ticks_per_hand_frame"]
        # baseline
        self.offset_std = arrays["offset_std"]
        self.held, self.block_sum = arrays["held"], arrays["block_sum"]
        self.block_squares, self.block_count = arrays["block_squares"], arrays["block_count"]
        self.span_sum, self.span_squares = arrays["span_sum"], arrays["span_squares"]
        self.span_low, self.span_count = arrays["span_low"], arrays["span_count"]
        self.span_crossings, self.span_above = arrays["span_crossings"], arrays["span_above"]
        self.span_level = arrays["span_level"]
        self.disturbance, self.threshold_factor = arrays["disturbance"], arrays["threshold_factor"]
        self.known = arrays["known"]
        # of one pad
        self.sampled = self.implausible = self.trusted = self.stale = self.zeroing = self.railed = False
        self.excess = view_memory(np.zeros(state.channels))

    def set_settings(self, settings: DetectionSettings) -> None:
        """Change the settings; they apply to present contacts too."""
        self.ampere_per_count = view_memory(settings.ampere_per_count)
        self.mean_ampere_per_count = view_memory(settings.mean_ampere_per_count)
        self.noise_counts = view_memory(settings.noise_counts)
        self.begin_threshold_a = view_memory(settings.begin_threshold_a)
        self.end_threshold_a = view_memory(settings.end_threshold_a)
        self.touch, self.sample_delay_ns = settings.touch, view_memory(settings.sample_delay_ns)

    @property
    def begun_count(self) -> int:
        """Number of contacts begun so far."""
        return int(self.next_contact_id[0]) - 1

    def detect_contacts(
        self, slab: Slab, node_state: NDArray[np.uint8], cycle: Cycle, until_ns: int = _NO_LIMIT_NS
    ) -> ContactChanges:
        """Compute the currents of samples that arrived before `until_ns`, and detect contacts on pads whose
        `node_state` (n,) is 0.

        A contact on a pad without valid samples ends at once; one that misses a sample keeps its state.
        """
        _detect_contacts(
            self,
            slab.memory,
            node_state.data,
            cycle.sync_ns,
            cycle.previous_sync_ns,
            cycle.period_ns // 2,
            until_ns,
        )
        counts = self.began, self.ended, self.updated, self.silent, self.solved, self.framed
        if not any(counts):
            return _NO_CHANGES
        return ContactChanges(
            *[pads[:k].copy() if k else _NO_PADS for pads, k in zip(self.lists, counts, strict=True)]
        )


def _detect_contacts(
    stage: ContactDetector,
    memory: SampleMemory,
    node_state: memoryview[int],
    sync_ns: int,
    previous_sync_ns: int,
    half_period_ns: int,
    until_ns: int,
) -> None:
    """Process the samples that arrived before `until_ns`. node_state: (n,), 0 where the node is up."""
    stage.began = stage.ended = stage.updated = stage.silent = stage.solved = stage.framed = 0
    stage.ticks[0] += 1
    for pad in range(stage.pads):
        _take_sample(stage, memory, pad, node_state[pad] == 0, sync_ns, previous_sync_ns, until_ns)
        _check_sample(stage, memory, pad)
        _check_silence(stage, pad, sync_ns - previous_sync_ns, half_period_ns)
        if node_state[pad] != 0:
            stage.trusted = False
        _detect_contact(stage, pad, half_period_ns)
        if node_state[pad] != 0:
            stage.pad_state[pad] = node_state[pad]
        elif stage.stale:
            stage.pad_state[pad] = _STALE
        elif stage.implausible:
            stage.pad_state[pad] = _FAULTED
        elif stage.touching[pad]:
            stage.pad_state[pad] = _TOUCHED
        elif stage.zeroing and stage.known[pad] == 0:
            stage.pad_state[pad] = _STARTING
        elif stage.pad_state[pad] <= _TOUCHED or stage.contradicting_samples[pad] == 0:
            stage.pad_state[pad] = _CLEAR
        else:  # back with a current that may begin a contact
            stage.pad_state[pad] = _STARTING
        if stage.sampled:
            _count_sample(stage, pad)


def _take_sample(
    stage: ContactDetector,
    memory: SampleMemory,
    pad: int,
    operational: bool,
    sync_ns: int,
    previous_sync_ns: int,
    until_ns: int,
) -> None:
    """Note a pad's new sample and its time: its SYNC, or its arrival where it is event-driven, less the delay
    of a node that samples by itself."""
    arrival_ns = memory.arrival_ns[pad]
    here = arrival_ns < until_ns
    stage.sampled = here and operational and arrival_ns != stage.arrival_ns[pad]
    if here:
        stage.arrival_ns[pad] = arrival_ns
    in_time = here and memory.fresh[pad] != 0
    if stage.sampled:
        stage.sample_ns[pad] = sync_ns if in_time else previous_sync_ns
        if not stage.synchronous[pad]:
            stage.sample_ns[pad] = arrival_ns
        stage.sample_ns[pad] -= stage.sample_delay_ns[pad]
    watched = stage.pad_state[pad] <= _TOUCHED or stage.contradicting_samples[pad] > 0
    if not in_time and operational and stage.synchronous[pad] and watched:
        stage.missed_sample_counts[pad] += 1


def _check_sample(stage: ContactDetector, memory: SampleMemory, pad: int) -> None:
    """Compute a pad's currents. Its sample is implausible with a channel at the bottom of its range, sourcing
    current, or at the top while the others are at rest.

    A firm contact near an electrode exceeds what its channel measures: the others then carry a contact's
    current, too. A pad that had a channel at the top at rest has a broken channel, also while it is touched.
    """
    railed, at_top, total, magnitude, others = False, False, 0.0, 0.0, 0.0
    near_zero = True
    for c in range(stage.channels):
        i, k = pad * stage.channels + c, pad * memory.channels + c
        count = memory.counts[k]
        if count <= memory.low_limits[k]:
            railed = True
        excess = count - stage.expected_counts[i]
        stage.excess[c] = excess
        stage.currents[i] = excess * stage.ampere_per_count[i]
        total += stage.currents[i]
        stage.saturated[i] = 0
        if count >= memory.high_limits[k]:
            stage.saturated[i], at_top = 1, True
        else:
            others += stage.currents[i]
        magnitude += abs(excess)
        if abs(excess) > _MAX_ZERO_FRACTION * memory.high_limits[k]:
            near_zero = False
    if at_top:
        touching = stage.touching[pad] != 0
        began = touching or stage.pad_state[pad] != _FAULTED
        if not (began and _is_above(stage, pad, others, touching)):
            railed = True
    stage.railed, stage.zeroing = railed, False
    stage.implausible = railed
    if not railed and _sources(stage, pad, total, magnitude):
        stage.zeroing = near_zero and (stage.known[pad] == 0 or stage.held[pad] != 0)
        stage.implausible = not stage.zeroing
    stage.trusted = not stage.implausible
    if stage.sampled:
        stage.total_current_a[pad] = total


def _sources(stage: ContactDetector, pad: int, total: float, magnitude: float) -> bool:
    """Return True if channels source current beyond noise, hum, and what a contact's own gains may do.

    A sheet only sinks current. If all channels source, by no more than begins a contact, the baseline is
    wrong, not the pad: it was learned during a light touch.
    """
    sources, drains = False, False
    for c in range(stage.channels):
        excess = stage.excess[c]
        limit = _MAX_NEGATIVE_SIGMA * stage.noise_counts[pad]
        limit = max(limit, _MAX_NEGATIVE_AMPLITUDES * stage.disturbance[pad * stage.channels + c])
        drains |= excess > limit
        sources |= excess < -(_MAX_NEGATIVE_FRACTION * magnitude + limit)
    return sources and (drains or -total > stage.begin_threshold_a[pad] * stage.threshold_factor[pad])


def _check_silence(stage: ContactDetector, pad: int, cycle_ns: int, half_period_ns: int) -> None:
    """Add the cycle to the silence of a pad without a sample: it is stale after three periods."""
    stage.stale = False
    if stage.sampled:
        stage.silent_ns[pad] = 0
        return
    period_ns = stage.max_sample_period_ns[pad]
    stage.silent_ns[pad] += max(0, min(cycle_ns, period_ns))
    # times of SYNCs vary
    stage.stale = stage.silent_ns[pad] > _MAX_SILENT * period_ns - half_period_ns
    if stage.silent_ns[pad] > stage.touch[pad].max_gap_periods * period_ns + half_period_ns:
        stage.trusted = False


def _detect_contact(stage: ContactDetector, pad: int, half_period_ns: int) -> None:
    """Begin, continue or end a pad's contact; one on a pad that isn't trusted ends at once.

    Times of SYNCs vary, so half a period less than the debounce is enough; one sample is not.
    """
    level, touching = stage.total_current_a[pad], stage.touching[pad] != 0
    above = _is_above(stage, pad, level, touching) and not stage.zeroing
    if touching and not stage.trusted:
        _end_contact(stage, pad)
    elif stage.sampled and stage.trusted and above != touching:
        if stage.contradicting_samples[pad] == 0:
            stage.first_sample_ns[pad] = stage.sample_ns[pad]
        stage.contradicting_samples[pad] += 1
        debounce_ns = 1e6 * (stage.touch[pad].end_ms if touching else stage.touch[pad].begin_ms)
        elapsed_ns = stage.sample_ns[pad] - stage.first_sample_ns[pad]
        if stage.contradicting_samples[pad] > 1:
            elapsed_ns += half_period_ns
        if elapsed_ns >= debounce_ns and touching:
            _end_contact(stage, pad)
        elif elapsed_ns >= debounce_ns:
            _begin_contact(stage, pad)
    elif stage.sampled or not stage.trusted:
        stage.contradicting_samples[pad] = 0
    if stage.touching[pad]:
        _select(stage, pad, touching, _is_above(stage, pad, level, True))


def _is_above(stage: ContactDetector, pad: int, level: float, touching: bool) -> bool:
    """Return True if a current is above the threshold that applies."""
    factor: float = stage.threshold_factor[pad]
    begin_a: float = stage.begin_threshold_a[pad]
    end_a: float = stage.end_threshold_a[pad]
    return level >= factor * end_a if touching else level > factor * begin_a


def _begin_contact(stage: ContactDetector, pad: int) -> None:
    """Begin a contact. The samples that its baseline collected last may be its approach."""
    stage.touching[pad] = stage.held[pad] = 1
    if stage.next_contact_id[0] & 0xFFFFFFFF == 0:  # 0 is no contact
        stage.next_contact_id[0] += 1
    stage.contact_id[pad] = stage.next_contact_id[0] & 0xFFFFFFFF
    stage.next_contact_id[0] += 1
    stage.begin_ns[pad] = stage.first_sample_ns[pad]
    stage.contradicting_samples[pad] = stage.is_solved[pad] = 0
    stage.peak_force_n[pad] = _NAN
    for i in range(pad * _VALUES, (pad + 1) * _VALUES):
        stage.values[i] = _NAN  # not a starting point: it is of the contact before
    for i in range(pad * stage.channels, (pad + 1) * stage.channels):
        stage.block_sum[i] = stage.block_squares[i] = 0.0
    stage.block_count[pad] = 0.0
    stage.began_pads[stage.began] = pad
    stage.began += 1


def _end_contact(stage: ContactDetector, pad: int) -> None:
    stage.touching[pad] = stage.contradicting_samples[pad] = 0
    stage.ended_pads[stage.ended] = pad
    stage.ended += 1


def _select(stage: ContactDetector, pad: int, continued: bool, above: bool) -> None:
    """List a pad's contact if it is to be updated or solved, or its sample is missing.

    A hand frame has the values of its samples, also of pads that are updated less often. A sample below the
    threshold has no position: the last one holds until the debounce decides.
    """
    due = stage.ticks[0] % stage.update_interval_ticks[pad] == 0
    framed = stage.ticks[0] % stage.ticks_per_hand_frame[0] == 0
    if not stage.sampled:
        if due and stage.synchronous[pad]:
            stage.silent_pads[stage.silent] = pad
            stage.silent += 1
    elif above and (due or framed or not continued):
        if continued and due:
            stage.updated_pads[stage.updated] = pad
            stage.updated += 1
        elif continued:
            stage.framed_pads[stage.framed] = pad
            stage.framed += 1
        if stage.position_requested[pad]:
            stage.sum_std_a[pad] = stage.offset_std[pad] * stage.mean_ampere_per_count[pad]
            stage.solved_pads[stage.solved] = pad
            stage.solved += 1


def _count_sample(stage: ContactDetector, pad: int) -> None:
    """Count a sample, and collect that of an untouched pad for its baseline, unless a contact may begin."""
    stage.sample_counts[pad] += 1
    free = stage.trusted and not stage.touching[pad]
    free = free and (stage.zeroing or not _is_above(stage, pad, stage.total_current_a[pad], False))
    total = 0.0
    for c in range(stage.channels):
        i, excess = pad * stage.channels + c, stage.excess[c]
        total += excess
        if free:
            stage.block_sum[i] += excess
            stage.block_squares[i] += excess * excess
        if not stage.railed:
            stage.span_sum[i] += excess
            stage.span_squares[i] += excess * excess
    stage.block_count[pad] += 1.0 if free else 0.0
    if not stage.railed:
        if stage.span_count[pad] == 0.0 or total < stage.span_low[pad]:
            stage.span_low[pad] = total
        stage.span_count[pad] += 1.0
        above = total > stage.span_level[pad]
        if above != (stage.span_above[pad] != 0):
            stage.span_crossings[pad] += 1.0
            stage.span_above[pad] = above
