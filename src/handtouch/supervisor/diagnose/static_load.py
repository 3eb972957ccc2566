"""Detect static loads and classify them: held object, gum, offset, moisture, or the tail of a press.

Public: `StaticLoadDetector`, `StaticLoad`. The lowest of a pad's short means in the last seconds is its
floor. While the floor is off zero, the pad has a static load, whatever contacts begin and end above it. Naive
Bayes classifies it by features of the floor since its begin; their probabilities under each cause are the
table below. A held object shows the hand's tremor, in position and magnitude; a stuck object doesn't.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from handtouch.supervisor.diagnose.features import GROUP_SAMPLES
from handtouch.supervisor.diagnose.model import FloatArray
from handtouch.wire.faults import FaultKind

MIN_LOAD_COUNTS = 12.0
"""Sum of the channels' magnitudes above which a pad has a static load."""
FLOOR_WINDOW_NS = 4_000_000_000
MIN_FAULT_PROBABILITY = 0.99
"""Probability at which a fault is reported; a held object at `_MIN_HELD_PROBABILITY`."""

_MIN_HELD_PROBABILITY = 0.8
_MAX_BLOCKS = 120
_MAX_ZERO_DRIFT_COUNTS_PER_S = 0.05  # rate at which the zero tracks the floor
_CAUSES = (
    FaultKind.HELD_OBJECT,
    FaultKind.GUM,
    FaultKind.HYSTERESIS_TAIL,
    FaultKind.OFFSET,
    FaultKind.MOISTURE,
    FaultKind.COMMON_DRIFT,
)
_MIN_AGE_S = dict(zip(_CAUSES, (8.0, 15.0, 8.0, 6.0, 15.0, 15.0), strict=True))
_LOG_PRIOR = np.log([0.969, 0.008, 0.012, 0.005, 0.003, 0.003])
# probability of each feature, by cause
_FEATURE_PROBABILITIES = {
    "one channel": (0.002, 0.002, 0.002, 0.998, 0.0005, 0.01),
    "negative": (0.0005, 0.0005, 0.0005, 0.45, 0.0005, 0.2),
    "abrupt": (0.99, 0.99, 0.99, 0.99, 0.002, 0.02),
    "decays": (0.15, 0.002, 0.998, 0.002, 0.05, 0.2),
    "grows": (0.15, 0.005, 0.003, 0.005, 0.5, 0.3),
    "with others": (0.7, 0.01, 0.2, 0.01, 0.01, 0.5),
    "slowly with others": (0.003, 0.003, 0.003, 0.003, 0.003, 0.99),
    "after a press": (0.3, 0.5, 0.97, 0.4, 0.4, 0.4),
}
_TREMOR_CAUSES = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_TREMOR_POSITION_STDS = np.geomspace(4e-4, 3e-2, 10)  # standard deviations of a held object's fractions
_STILL_POSITION_STDS = np.array([0.0, 5e-5, 1.5e-4])
_TREMOR_FORCE_STDS, _STILL_FORCE_STDS = np.geomspace(4e-3, 0.2, 10), np.array([0.0, 1e-3, 3e-3, 8e-3])
_MAX_FLOOR_RATIO = 1.25
_MIN_TREMOR_NATS = 3.0
_MAX_TREMOR_NATS = 15.0


@dataclass
class StaticLoad:
    """Static load of one pad: level_counts (4,) now; kind and its probability once classified; evidence as
    numbers by name."""

    since_ns: int
    level_counts: FloatArray
    peak_counts: float = 0.0
    kind: FaultKind | None = None
    probability: float = 0.0
    evidence: dict[str, float] = field(default_factory=dict)
    ages_s: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_BLOCKS))
    floors_counts: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=_MAX_BLOCKS))
    early_counts: float = np.inf
    """lowest total from half a second to 3 s after its begin"""
    later_counts: float = 0.0
    """total within the first minute"""
    classified_age_s: float = 0.0
    channel: int = 0
    """channel of the highest reading, when last classified"""


class StaticLoadDetector:
    """Floors and static loads of the n pads of a hand."""

    def __init__(self, noise_counts: FloatArray) -> None:
        n = len(noise_counts)
        self._noise = noise_counts
        self._zero = np.zeros((n, 4))
        self._recent_floors: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._last_unloaded_ns = np.full(n, -1, dtype=np.int64)
        self._recent_peaks: deque[tuple[int, FloatArray]] = deque()
        self.floor_counts = np.zeros((n, 4))
        self.loads: dict[int, StaticLoad] = {}
        self._last_ns = -1

    def process_block(self, sample_ns: int, counts: FloatArray, valid: FloatArray) -> None:
        """Update floors and loads by the short means (g, n, 4) of a block that ended at sample_ns.

        counts: relative to the stored offsets. valid: (n, 4), 0 for channels with a known fault, which are
        ignored.
        """
        counts = (counts - self._zero) * valid
        size = np.abs(counts).sum(axis=2)
        least = size.argmin(axis=0)
        pads = np.arange(size.shape[1])
        floor, total = counts[least, pads], size[least, pads]
        if self._last_ns < 0:
            self._last_unloaded_ns[:] = sample_ns
        dt_s = max(sample_ns - self._last_ns, 0) * 1e-9 if self._last_ns >= 0 else 0.0
        self._last_ns = sample_ns
        self._recent_floors.append((sample_ns, floor, total))
        self._recent_peaks.append((sample_ns, size.max(axis=0)))
        while self._recent_floors[0][0] < sample_ns - FLOOR_WINDOW_NS:
            self._recent_floors.popleft()
        while self._recent_peaks[0][0] < sample_ns - 2 * FLOOR_WINDOW_NS:
            self._recent_peaks.popleft()
        sizes = np.stack([total for _, _, total in self._recent_floors])
        lowest = sizes.argmin(axis=0)
        self.floor_counts = np.stack([floor for _, floor, _ in self._recent_floors])[lowest, pads]
        level = sizes[lowest, pads]
        self._last_unloaded_ns[total <= MIN_LOAD_COUNTS] = sample_ns
        quiet = level <= MIN_LOAD_COUNTS
        drift = np.clip(
            self.floor_counts, -_MAX_ZERO_DRIFT_COUNTS_PER_S * dt_s, _MAX_ZERO_DRIFT_COUNTS_PER_S * dt_s
        )
        self._zero += np.where(quiet[:, None], drift, 0.0)
        for pad in [pad for pad in self.loads if quiet[pad]]:
            del self.loads[pad]
        for pad in np.flatnonzero(~quiet).tolist():
            self._track_load(pad, sample_ns, floor[pad], float(total[pad]))
        for pad, load in self.loads.items():
            age_s = (sample_ns - load.since_ns) * 1e-9
            if age_s - load.classified_age_s >= (1.0 if age_s < 60 else 5.0) and age_s >= 6.0:
                load.classified_age_s = age_s
                self._classify(pad, load, age_s)

    def reset_zero(self, pads: FloatArray) -> None:
        """Reset the zero of some pads, (n,) bool, to their stored offsets."""
        self._zero[pads.astype(bool)] = 0.0

    def _track_load(self, pad: int, sample_ns: int, floor: FloatArray, total: float) -> None:
        load = self.loads.get(pad)
        if load is None:
            since = int(self._last_unloaded_ns[pad])
            peak = max(peaks[pad] for _, peaks in self._recent_peaks)
            load = self.loads[pad] = StaticLoad(since, floor, float(peak))
            for at, older, size in self._recent_floors:  # its begin
                if at > since:
                    self._record_floor(load, (at - since) * 1e-9, older[pad], float(size[pad]))
            return
        load.level_counts = self.floor_counts[pad]
        self._record_floor(load, (sample_ns - load.since_ns) * 1e-9, floor, total)

    def _record_floor(self, load: StaticLoad, age_s: float, floor: FloatArray, total: float) -> None:
        if 0.5 < age_s < 3.0:
            load.early_counts = min(load.early_counts, total)
        if age_s < 60.0:
            load.later_counts = float(np.abs(load.level_counts).sum())
        load.ages_s.append(age_s)
        load.floors_counts.append(floor)

    def _classify(self, pad: int, load: StaticLoad, age_s: float) -> None:
        features, tremor_nats = self._features(pad, load, age_s)
        score = _LOG_PRIOR + np.clip(tremor_nats, -_MAX_TREMOR_NATS, _MAX_TREMOR_NATS) * _TREMOR_CAUSES
        for name, there in features.items():
            if there is not None:
                chance = np.array(_FEATURE_PROBABILITIES[name])
                score = score + np.log(chance if there else 1 - chance)
        share = np.exp(score - score.max())
        share /= share.sum()
        best = int(share.argmax())
        cause = _CAUSES[best]
        known = _MIN_HELD_PROBABILITY if cause == FaultKind.HELD_OBJECT else MIN_FAULT_PROBABILITY
        load.evidence["tremor_nats"] = tremor_nats
        load.evidence["age_s"] = age_s
        observable = (
            cause != FaultKind.HELD_OBJECT or tremor_nats > _MIN_TREMOR_NATS or features["with others"]
        )
        if share[best] >= known and age_s >= _MIN_AGE_S[cause] and observable:
            load.kind = cause
        elif load.kind is None and age_s > 300:
            load.kind = FaultKind.UNEXPLAINED
        if features["one channel"]:
            load.channel = int(np.abs(load.level_counts).argmax())
        if load.kind in _CAUSES:
            load.probability = float(share[_CAUSES.index(load.kind)])

    def _features(self, pad: int, load: StaticLoad, age_s: float) -> tuple[dict[str, bool | None], float]:
        level = load.level_counts
        size = float(np.abs(level).sum())
        others = size - float(np.abs(level).max())
        times, floors = np.array(load.ages_s), np.array(load.floors_counts)
        totals = np.abs(floors).sum(axis=1)
        late = times > max(age_s - 30.0, 2.0)
        times, floors, totals = times[late], floors[late], totals[late]
        slope = _relative_slope(times, totals)
        if len(totals):  # leave out contacts on top
            parts = [
                part < _MAX_FLOOR_RATIO * np.quantile(part, 0.1)
                for part in np.array_split(totals, 3)
                if len(part)
            ]
            alone = np.concatenate(parts)
            times, floors = times[alone], floors[alone]
        other_loads = [s for p, s in self.loads.items() if p != pad]
        together = any(abs(s.since_ns - load.since_ns) < 2_000_000_000 for s in other_loads)
        abrupt = _is_abrupt(load)
        slow = sum(not _is_abrupt(s) for s in other_loads)
        load.evidence.update(counts=size, slope_per_s=slope)
        steady = age_s >= 14.0
        features: dict[str, bool | None] = {
            "one channel": others <= 3 + 0.02 * size,
            "negative": bool(level.min() < -(4 + 0.03 * size)),
            "abrupt": abrupt,
            "decays": slope < -0.008 if steady else None,
            "grows": slope > 0.004 if steady else None,
            "with others": together,
            "slowly with others": not abrupt and slow >= 2,
            "after a press": load.peak_counts > 4 * size,
        }
        return features, self._tremor_nats(pad, times, floors)

    def _tremor_nats(self, pad: int, times: FloatArray, floors: FloatArray) -> float:
        """Return the log likelihood ratio of tremor against a still contact for floors (k, 4)."""
        if len(times) < 12:
            return 0.0
        total = floors.sum(axis=1)
        if (total <= 0).any():
            return 0.0
        noise = self._noise[pad] / np.sqrt(GROUP_SAMPLES) / float(np.median(total))
        fractions = _roughness(times, floors / total[:, None])
        force = _roughness(times, np.log(total)[:, None])
        place = _log_bayes_factor(
            fractions, np.sqrt(0.75) * noise, _TREMOR_POSITION_STDS, _STILL_POSITION_STDS
        )
        return place + _log_bayes_factor(force, 2 * noise, _TREMOR_FORCE_STDS, _STILL_FORCE_STDS)


def _roughness(times: FloatArray, values: FloatArray) -> FloatArray:
    """Return deviations of values (k, c) from a line through their neighbours, scaled to one sigma: (l, c).

    Insensitive to trends; neighbours more than some seconds away are left out.
    """
    before, after = np.diff(times)[:-1], np.diff(times)[1:]
    part = (before / (before + after))[:, None]
    off = values[1:-1] - (1 - part) * values[:-2] - part * values[2:]
    off /= np.sqrt(1 + (1 - part) ** 2 + part**2)
    return np.asarray(off[before + after < 4.0])


def _log_bayes_factor(off: FloatArray, noise: float, moving: FloatArray, still: FloatArray) -> float:
    """Return the log Bayes factor of a standard deviation among `moving` against one among `still`.

    Both add to noise. By the median, which a few presses on top don't change; half of the values count, as
    they are correlated.
    """
    if len(off) < 8:
        return 0.0
    variance = 2.2 * float(np.mean(np.median(np.abs(off), axis=0) ** 2))
    freedom = min(off.shape[1], 3) * len(off) / 2

    def level(std: FloatArray) -> float:
        expected = (1.2 * noise) ** 2 + std**2
        logs = -0.5 * freedom * (np.log(expected) + variance / expected)
        return float(np.logaddexp.reduce(logs) - np.log(len(std)))

    return level(moving) - level(still)


def _relative_slope(times: FloatArray, totals: FloatArray) -> float:
    """Return the relative change per second by lower quartiles of first and last third; 0 if unknown."""
    if len(times) < 24 or times[-1] - times[0] < 8:
        return 0.0
    third = len(times) // 3
    before, after = np.quantile(totals[:third], 0.25), np.quantile(totals[-third:], 0.25)
    between = times[-third:].mean() - times[:third].mean()
    return float((after - before) / between / max(0.5 * (before + after), 1e-9))


def _is_abrupt(load: StaticLoad) -> bool:
    """Return whether it came within a second or so: early total against that within the first minute."""
    return load.early_counts > 0.5 * load.later_counts
