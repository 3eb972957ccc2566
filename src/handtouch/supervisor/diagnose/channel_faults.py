"""Detect faults of single channels that show in every sample: stuck, saturated, shorted to the layer.

Public: `ChannelFaultDetector`, `ChannelFault`. A reading of a healthy channel repeats by chance with a
probability that follows from its noise; a run of repeats less likely than e^-ALARM_NATS is a fault.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from handtouch.arrays import FloatArray
from handtouch.supervisor.diagnose.features import BlockFeatures
from handtouch.supervisor.diagnose.model import DiagnosisModel
from handtouch.wire.faults import FaultKind

# Constants without an origin beside them were chosen; docs/benchmarks/diagnose.md measures what they yield.
ALARM_NATS = 40.0
"""Nats; 15 pads of 200 Hz make 7e9 readings per week: 7e9 e^-40 is one false alarm in 600 million weeks."""

_MIN_REPEATS = 200  # a second at 200 Hz, where noise would allow fewer
_MIN_RAILED_NS = 1_000_000_000  # beside resting channels, as no contact is
_MIN_RAILED_TOUCHED_NS = 20_000_000_000  # beside busy channels: longer than most firm presses
_TOUCHED_CONFIDENCE = 0.6
"""Confidence of saturation when the other channels never rested, beyond the range of any contact."""
_MAX_UNTOUCHED_FRACTION = 0.03
"""Part of the railed channel's current: less than the others get from a contact anywhere."""
# currents that the layer's potential on an electrode drives into the others: their sum over that
# of the nominal sheet (whose resistance isn't known better), and the deviation of each from the nominal share
_IDLE_RATIO_RANGE = (0.3, 3.0)
_MAX_IDLE_DEVIATION, _MAX_IDLE_DEVIATION_OF_SUM = 0.3, 0.03
_PLACES = 24  # along each side, of contacts that may explain a channel at its top
_MIN_FIRM_FRACTION, _MAX_FIRM_DEVIATION = 0.8, 0.15
"""Reading of a contact over the top of the range; part of its other currents left unexplained, by sheets that
differ from the nominal one and the lowest currents of a contact that moves."""
_MIN_SHORT_FRACTION = 0.75
"""Part of the current through an electrode's series resistor at which it may be shorted to the layer."""
_MIN_CHANNELS_OF_SHORT = 2  # one more could be that of a contact
_MAX_SILENT_SIGMA = 10.0
"""Lowest short mean of a channel without a current, of the noise of a reading."""
_OPEN_OHM = 1e12  # stands for no connection
_MIN_WINDOW_NS = 5_000_000_000
"""The lowest readings of the other channels are those of the last one to two such times."""
_FAULT_CLEAR_NS = 2_000_000_000


@dataclass(frozen=True)
class ChannelFault:
    """Fault of one channel of a pad."""

    kind: FaultKind
    since_ns: int
    evidence: dict[str, float]
    confidence: float = 1.0


class ChannelFaultDetector:
    """Detector of faults of the channels of n pads."""

    def __init__(self, model: DiagnosisModel) -> None:
        self._model = model
        n = len(model.links)
        chance = _repeat_probability(
            0.5 * np.hypot(model.noise_counts, 0.0)
        )  # half the noise, as a channel may be quieter
        self._max_repeats = np.maximum(np.ceil(ALARM_NATS / -np.log(chance)), _MIN_REPEATS)
        self._used = model.ampere_per_count > 0
        self._reads_zero_untouched = np.isneginf(model.limits[:, :, 0])  # unsigned: may clip there
        c = self._used.shape[1]
        self._repeats = np.zeros((n, c), dtype=np.int64)
        self._repeats_since_ns = np.zeros((n, c), dtype=np.int64)
        self._railed_since_ns = np.full((n, c), -1, dtype=np.int64)  # begin of saturation; -1: none
        self._healthy_since_ns = np.zeros((n, c), dtype=np.int64)  # since when it is healthy again
        self._min_counts = np.full(
            (n, c, c), np.inf
        )  # lowest reading of each channel while another was railed
        self._recent_min_counts = self._min_counts.copy()  # the same within the present part of a window
        self._last_ns = np.zeros((n, 1), dtype=np.int64)
        self._idle_counts = [_idle_counts(model, row) for row in range(n)]  # (shorted, channels) of each pad
        self._short_counts = np.full((n, c), np.inf)  # reading of a channel whose electrode is shorted
        for row, idle in enumerate(self._idle_counts):
            self._short_counts[row, : len(idle)] = np.diag(idle)
        self._fractions: dict[int, FloatArray] = {}  # fractions of a grid of contacts, by the network's id
        self.faults: dict[tuple[int, int], ChannelFault] = {}

    @property
    def faulty_channels(self) -> NDArray[np.bool_]:
        """Return the channels (n, c) with a fault."""
        bad = np.zeros(self._repeats.shape, dtype=np.bool_)
        for pad, channel in self.faults:
            bad[pad, channel] = True
        return bad

    @property
    def usable_channels(self) -> NDArray[np.bool_]:
        """Return the channels (n, c) that show static loads.

        None of a pad with a short circuit, also a possible one, whose current is in all of them.
        """
        usable = ~self.faulty_channels & (self._railed_since_ns < 0)
        for (pad, _), fault in self.faults.items():
            if fault.kind == FaultKind.SHORTED_ELECTRODE or fault.confidence < 1:
                usable[pad] = False
        return np.asarray(usable)

    def process_block(self, features: BlockFeatures) -> None:
        """Update faults by the features of a block."""
        t_ns = features.last_sample_ns[:, None]
        begins = features.varied | (self._repeats == 0)
        self._repeats_since_ns = np.where(begins, t_ns, self._repeats_since_ns)
        self._repeats = np.where(features.varied, 0, self._repeats) + features.trailing_repeats
        at_end = features.railed_fraction >= 1.0
        lowest_counts = features.mean_counts.min(axis=0)
        railed = at_end | (lowest_counts > _MIN_SHORT_FRACTION * self._short_counts)
        self._railed_since_ns = np.where(
            railed, np.where(self._railed_since_ns < 0, t_ns, self._railed_since_ns), -1
        )
        aged = (t_ns // _MIN_WINDOW_NS) != (self._last_ns // _MIN_WINDOW_NS)  # (n, 1)
        recent = np.where(aged[:, :, None], self._recent_min_counts, self._min_counts)
        self._recent_min_counts = np.where(
            railed[:, :, None],
            np.minimum(
                np.where(aged[:, :, None], np.inf, self._recent_min_counts), lowest_counts[:, None, :]
            ),
            np.inf,
        )
        self._min_counts = np.where(railed[:, :, None], np.minimum(recent, lowest_counts[:, None, :]), np.inf)
        self._last_ns = t_ns
        can_rest = self._reads_zero_untouched & (features.last_counts == 0)
        stuck = self._used & ~can_rest & (self._repeats >= self._max_repeats[:, None])
        for pad, channel in np.argwhere(railed | stuck).tolist():
            fault = self._classify(pad, channel, features)
            if fault is not None and (
                at_end[pad, channel] or stuck[pad, channel] or fault.kind == FaultKind.SHORTED_ELECTRODE
            ):
                self._healthy_since_ns[pad, channel] = -1
                before = self.faults.get((pad, channel))
                if before is not None and self._is_settled(pad, channel, before):
                    continue
                if before is None or (before.kind, before.confidence) != (fault.kind, fault.confidence):
                    self.faults[pad, channel] = fault
        for pad, channel in list(self.faults):
            if railed[pad, channel] or not features.varied[pad, channel]:
                self._healthy_since_ns[pad, channel] = -1
            elif self._healthy_since_ns[pad, channel] < 0:
                self._healthy_since_ns[pad, channel] = int(features.last_sample_ns[pad])
            elif features.last_sample_ns[pad] - self._healthy_since_ns[pad, channel] > _FAULT_CLEAR_NS:
                del self.faults[pad, channel]

    def _is_settled(self, pad: int, channel: int, before: ChannelFault) -> bool:
        """Return whether a fault keeps its kind: it does beside a short, whose current is in all channels."""
        if before.kind == FaultKind.SHORTED_ELECTRODE:
            return True
        unknown = (self._railed_since_ns[pad] >= 0) & ~self.faulty_channels[pad]
        return bool(unknown.any()) or any(
            fault.kind == FaultKind.SHORTED_ELECTRODE
            for (row, other), fault in self.faults.items()
            if row == pad and other != channel
        )

    def _classify(self, pad: int, channel: int, features: BlockFeatures) -> ChannelFault | None:
        count = int(features.last_counts[pad, channel])
        if self._railed_since_ns[pad, channel] < 0:
            evidence = {"count": float(count), "repeats": float(self._repeats[pad, channel])}
            return ChannelFault(FaultKind.STUCK_CHANNEL, int(self._repeats_since_ns[pad, channel]), evidence)
        since = int(self._railed_since_ns[pad, channel])
        lasted = int(features.last_sample_ns[pad]) - since
        if lasted < _MIN_RAILED_NS:
            return None
        own = slice(len(self._idle_counts[pad]))
        healthy = ~self.faulty_channels[pad, own] & (self._railed_since_ns[pad, own] < 0)
        healthy[channel] = False
        others = features.mean_counts[:, pad, own][:, healthy]
        lowest_counts = self._min_counts[pad, channel, own][healthy]
        evidence = {"count": float(count), "others_counts": float(others.sum(axis=1).min())}
        if count > 0 and self._is_short(pad, channel, healthy, lowest_counts, lasted):
            return ChannelFault(FaultKind.SHORTED_ELECTRODE, since, evidence)
        untouched = np.abs(lowest_counts).sum() < _MAX_UNTOUCHED_FRACTION * abs(count)
        if untouched or count < 0:
            return ChannelFault(FaultKind.SATURATED_CHANNEL, since, evidence)
        # beside a contact that is elsewhere, or a short of an unusual sheet
        if lasted > _MIN_RAILED_TOUCHED_NS and not self._is_firm_contact(
            pad, channel, lowest_counts, healthy
        ):
            return ChannelFault(FaultKind.SATURATED_CHANNEL, since, evidence, _TOUCHED_CONFIDENCE)
        return None

    def _is_firm_contact(
        self, pad: int, channel: int, counts: FloatArray, healthy: NDArray[np.bool_]
    ) -> bool:
        """Return whether a contact with a current beyond the range of `channel` explains the lowest counts
        (k,) of the healthy channels."""
        network = self._model.networks[pad]
        if id(network) not in self._fractions:
            along = (np.arange(_PLACES) + 0.5) / _PLACES
            x, y = (at.ravel() for at in np.meshgrid(network.a * along, network.b * along))
            self._fractions[id(network)] = network.fractions(x, y)
        scale = self._model.ampere_per_count[pad, : len(healthy)]
        fractions = self._fractions[id(network)]
        others, currents = fractions[healthy], np.maximum(counts, 0.0) * scale[healthy]
        total = currents.sum() / np.maximum(others.sum(axis=0), 1e-12)
        deviation = np.abs(others * total - currents[:, None]).sum(axis=0)
        top = self._model.limits[pad, channel, 1] * scale[channel]
        enough = total * fractions[channel] > _MIN_FIRM_FRACTION * top
        return bool((enough & (deviation < _MAX_FIRM_DEVIATION * currents.sum())).any())

    def _is_short(
        self, pad: int, channel: int, healthy: NDArray[np.bool_], lowest_counts: FloatArray, lasted_ns: int
    ) -> bool:
        """Return whether the lowest counts of healthy channels (c,) are those of a short of `channel`.

        Also of a pad with one dead electrode: its channel is silent, the others carry its part; after a time
        that contacts don't last, as one on a long pad may leave a far channel silent.
        """
        silent = np.abs(lowest_counts) < _MAX_SILENT_SIGMA * self._model.reading_noise_counts[pad]
        silent &= lasted_ns > _MIN_RAILED_TOUCHED_NS
        if len(lowest_counts) - silent.sum() < _MIN_CHANNELS_OF_SHORT or silent.sum() > 1:
            return False
        expected = self._idle_counts[pad][channel]
        if silent.any():
            expected = _idle_counts(self._model, pad, int(np.flatnonzero(healthy)[silent][0]))[channel]
        return _matches_short(lowest_counts[~silent], expected[healthy][~silent])


def _matches_short(lowest_counts: FloatArray, expected: FloatArray) -> bool:
    """Return whether the lowest counts (k,) of the other channels are those of a short to the layer.

    No contact drives them so: next to an electrode, that takes most of its current.
    """
    ratio = float(lowest_counts.sum() / expected.sum())
    if not _IDLE_RATIO_RANGE[0] < ratio < _IDLE_RATIO_RANGE[1]:
        return False
    share = ratio * expected
    allowed = _MAX_IDLE_DEVIATION * share + _MAX_IDLE_DEVIATION_OF_SUM * share.sum()
    return bool((np.abs(lowest_counts - share) < allowed).all())


def _repeat_probability(std: FloatArray) -> FloatArray:
    """Return the probability (n,) that two rounded normal readings of std (n,) counts are equal."""
    steps = np.arange(-40, 41)
    width = np.maximum(std, 0.05)[:, None]
    chance = ndtr((steps + 0.5) / width) - ndtr((steps - 0.5) / width)
    return np.asarray(np.clip((chance**2).sum(axis=1), 0.5, 1 - 1e-3))


def _idle_counts(model: DiagnosisModel, row: int, dead: int | None = None) -> FloatArray:
    """Return counts [shorted, channel] with an electrode at the layer's potential; infinite if unknown.

    dead: channel of an electrode that is open.
    Its own channel gets what its series resistor lets through, the others what flows through sheet and
    resistors.
    """
    network = model.networks[row]
    series, volts = np.array(network.series_ohm, np.float64), model.drive_v[row]
    if dead is not None:
        series[dead] = _OPEN_OHM
    scale = model.ampere_per_count[row, : len(series)]
    try:
        conductance = network.conductance / network.sheet_ohm_per_square
    except ValueError:
        return np.full((len(series),) * 2, np.inf)
    idle = np.empty((len(series),) * 2)
    for shorted in range(len(series)):
        others = np.arange(len(series)) != shorted
        loaded = np.eye(len(series) - 1) + conductance[np.ix_(others, others)] * series[others]
        idle[shorted, others] = np.linalg.solve(loaded, -volts * conductance[others, shorted])
        idle[shorted, shorted] = volts / series[shorted] if series[shorted] else np.inf
    return np.asarray(idle / scale)
