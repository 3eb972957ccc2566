"""Detect static loads and classify them: held object, gum, offset, moisture, or the tail of a press.

Public: `StaticLoadDetector`, `StaticLoad`. The lowest of a pad's short means in the last seconds is its
floor. While the floor is off zero, the pad has a static load, whatever contacts begin and end above it. Naive
Bayes classifies it by features of the floor since its begin; their probabilities under each cause are the
table below. A held object shows the hand's tremor in its position within the half second of a block; its
magnitude is no evidence, as the sheet relaxes after other presses. That a load is still is weak evidence
of a stuck object, as firm robots hold still too. Strong evidence is what a held object can't do: presses
elsewhere on the pad come and go while it stays, the hand's other pads are used meanwhile, it lasts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.supervisor.diagnose.features import GROUP_SAMPLES, approximate_position
from handtouch.wire.faults import FaultKind

MIN_LOAD_COUNTS = 12.0
"""Sum of the channels' magnitudes above which a pad has a static load."""
FLOOR_WINDOW_NS = 4_000_000_000  # longer than a press in use, so that the lowest reading is the load's
MIN_FAULT_PROBABILITY = 0.99
"""Probability at which a fault is reported; a held object at `_MIN_HELD_PROBABILITY`."""

_MIN_HELD_PROBABILITY = 0.8  # lower, as no fault is reported by it
_MAX_BLOCKS = 120  # a minute of floors
_MAX_ZERO_DRIFT_COUNTS_PER_S = 0.05  # rate at which the zero tracks the floor
_CAUSES = (
    FaultKind.HELD_OBJECT,
    FaultKind.GUM,
    FaultKind.HYSTERESIS_TAIL,
    FaultKind.OFFSET,
    FaultKind.MOISTURE,
    FaultKind.COMMON_DRIFT,
)
_MIN_PROBABLE_AGE_S = 60.0
"""Age of a load that isn't used again from which it is reported if gum is its most probable cause: chosen, as
objects are seldom held so long without tremor."""
_MIN_AGE_S = dict(zip(_CAUSES, (8.0, 15.0, 8.0, 6.0, 15.0, 15.0), strict=True))
"""Age at which each cause may be named: chosen, with 15 s where the search of slopes needs 14 s of floors."""
# The numbers below are degrees of belief, not counted frequencies. They were chosen by what each cause does
# (a feature that a cause can't have, such as one channel of a press, has 0.0005 to 0.003, for what isn't
# foreseen) and changed where episodes of benchmarks/diagnose_episodes.py with seeds below 1100 were named
# wrongly. docs/benchmarks/diagnose.md measures the result on other seeds.
#
# With half or double the odds of any row or prior, or of the evidence of presses, other pads and age below,
# 17 to 19 of 22 faults (gum, moisture, offsets, tails; 19 as it is) are named rightly in the world `default`,
# tuning family, after 15 to 20 s in the median (18 s); none of them, nor of 11 uses without a fault, wrongly.
_LOG_PRIOR = np.log([0.969, 0.008, 0.012, 0.005, 0.003, 0.003])
"""Causes of a load that lasts for seconds: an object in 97 of 100."""
# probability of each feature, by cause
_FEATURE_PROBABILITIES = {
    "one channel": (0.0005, 0.0005, 0.0005, 0.998, 0.0005, 0.01),
    "negative": (0.0005, 0.0005, 0.0005, 0.45, 0.0005, 0.2),
    "abrupt": (0.99, 0.99, 0.99, 0.99, 0.002, 0.02),
    "decays": (0.15, 0.05, 0.998, 0.002, 0.05, 0.2),
    "fades": (0.01, 0.003, 0.9, 0.001, 0.01, 0.05),
    "grows": (0.15, 0.005, 0.003, 0.005, 0.5, 0.3),
    "with others": (0.7, 0.01, 0.2, 0.01, 0.01, 0.5),
    "slowly with others": (0.003, 0.003, 0.003, 0.003, 0.003, 0.99),
    "after a press": (0.3, 0.5, 0.97, 0.4, 0.4, 0.4),
}
_TREMOR_CAUSES = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_TREMOR_POSITION_STDS = np.geomspace(4e-4, 3e-2, 10)  # standard deviations of a held object's fractions
_STILL_POSITION_STDS = np.array([0.0, 5e-5, 1.5e-4])
_MAX_FLOOR_RATIO = 1.25  # readings above that are another press on top
_MAX_FADED_PART = 0.67  # of a load that fades: what is left of it in its last third over its first
_MIN_ABRUPT_PART = 0.35
"""Part of a load that appears within 3 s: a leak that grows with a time constant of 10 s or more has at most
0.33 of what it has when it is classified, after 15 s; gum on a sheet that adapts, 0.4 and more."""
_MIN_TREMOR_NATS = 3.0  # odds of 20
_MAX_TREMOR_NATS, _MAX_STILL_NATS = 15.0, 3.0  # stillness says little: firm robots hold still
_LASTING_CAUSES = np.array([0.0, 1.0, 0.0, 1.0, 1.0, 0.0])
_PRESS_NATS, _MAX_PRESS_NATS = 1.5, 9.0
"""Evidence of a press elsewhere on the pad, after which the load is as before, and its greatest sum. Chosen:
four presses outweigh the prior odds of gum, 1 to 120; the sum is limited, as presses aren't independent."""
_OTHER_PAD_NATS, _MAX_OTHER_PAD_NATS = 0.2, 2.0
"""Evidence of a contact that begins on another pad, and its greatest sum: chosen, as a hand may hold with one
finger and work with others."""
_HOLD_TIME_S, _HOLD_EXPONENT = 30.0, 1.5
"""An object is held for longer than t with probability (1 + t / time)^-exponent: chosen, median 18 s, so that
a still load on a hand that does nothing else is named gum after ten minutes."""
_MIN_PRESS_COUNTS, _MIN_PRESS_AWAY, _MAX_FLOOR_MOVE = 100.0, 0.12, 0.06
"""A press elsewhere: counts above the load, its distance from it, and the load's change of position."""
_AFTER_PRESS_NS = 1_500_000_000
"""Time after a press in which the sheet relaxes too fast for the search of tremor."""
_SAME_BEGIN_NS = 1_000_000_000
"""From the begin of a load to a step that explains it."""
_BEGIN_COUNTS = 250.0  # sum of a contact, as in hand_diagnostics
_MIN_SCATTER_BLOCKS = 6  # three seconds without a press
_NOISE_GAIN = 0.05  # gain of the noise estimate per block without a load


@dataclass
class StaticLoad:
    """Static load of one pad: level_counts (c,) now; kind and its probability once classified; evidence as
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
    """channel of the highest reading, when the others' were least"""
    scatter: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_BLOCKS))
    """variance of the current fractions in each quiet block"""
    last_press_ns: int = 0
    pressed_from: FloatArray | None = None
    """position of the load before the present press elsewhere"""
    presses: int = 0
    """presses elsewhere on the pad, after which the load was as before"""
    contacts_before: int = 0
    """contacts of the hand's other pads before its begin"""


class StaticLoadDetector:
    """Floors and static loads of the n pads of a hand.

    noise_counts: (n,) of a reading. weights: of each pad's channels, as `electrode_weights`.
    """

    def __init__(self, noise_counts: FloatArray, weights: Sequence[FloatArray]) -> None:
        self._weights = weights
        n, c = len(noise_counts), max(one.shape[-1] for one in weights)
        self._variance = np.square(noise_counts) / GROUP_SAMPLES  # variance of a short mean, as measured
        self._zero = np.zeros((n, c))
        self._recent_floors: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._last_unloaded_ns = np.full(n, -1, dtype=np.int64)
        self._recent_peaks: deque[tuple[int, FloatArray]] = deque()
        self.floor_counts = np.zeros((n, c))
        self.loads: dict[int, StaticLoad] = {}
        self._touched = np.zeros(n, dtype=np.bool_)
        self._contacts = np.zeros(n, dtype=np.int64)  # begun
        self._last_ns = -1
        self._valid = np.ones((n, c))

    def process_block(self, sample_ns: int, counts: FloatArray, valid: FloatArray) -> None:
        """Update floors and loads by the short means (g, n, c) of a block that ended at sample_ns.

        counts: relative to the stored offsets. valid: (n, c), 0 for channels with a known fault, which are
        ignored.
        """
        self._leave_out(valid)
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
        if len(counts) > 3:
            for pad in np.flatnonzero(size.max(axis=0) <= MIN_LOAD_COUNTS).tolist():
                scatter = _scatter(counts[:, pad, : self._channels(pad)])
                self._variance[pad] += _NOISE_GAIN * (scatter - self._variance[pad])
        touched = size.max(axis=0) > np.abs(self.floor_counts).sum(axis=1) + _BEGIN_COUNTS
        self._contacts += touched & ~self._touched
        self._touched = touched
        for pad in np.flatnonzero(~quiet).tolist():
            self._track_load(pad, sample_ns, floor[pad], float(total[pad]))
            self._track_presses(pad, self.loads[pad], sample_ns, counts[:, pad])
        for pad, load in self.loads.items():
            age_s = (sample_ns - load.since_ns) * 1e-9
            if age_s - load.classified_age_s >= (1.0 if age_s < 60 else 5.0) and age_s >= 6.0:
                load.classified_age_s = age_s
                self._classify(pad, load, age_s)

    @property
    def zero_counts(self) -> FloatArray:
        """Tracked zeros (n, c) of the channels, relative to the stored offsets."""
        return self._zero

    def reset_zero(self, pads: FloatArray) -> None:
        """Reset the zero of some pads, (n,) bool, to their stored offsets."""
        self._zero[pads.astype(bool)] = 0.0

    def forget(self, pad: int) -> None:
        """Discard the load of a pad, whose zero has changed."""
        self.loads.pop(pad, None)
        for _, floor, total in self._recent_floors:
            floor[pad] = total[pad] = 0.0

    def subtract(self, pad: int, channel: int, since_ns: int, counts: float) -> None:
        """Subtract a step of one channel, known since a time, from what is remembered of a pad."""
        step = np.zeros(self._zero.shape[1])
        step[channel] = counts
        for at, floor, total in self._recent_floors:
            if at > since_ns:
                floor[pad] -= step
                total[pad] = np.abs(floor[pad]).sum()
            if total[pad] <= MIN_LOAD_COUNTS:
                self._last_unloaded_ns[pad] = max(self._last_unloaded_ns[pad], at)
        load = self.loads.get(pad)
        if load is None:
            return
        own = step[: self._channels(pad)]
        for number, (age_s, floor) in enumerate(zip(load.ages_s, load.floors_counts, strict=True)):
            if load.since_ns + age_s * 1e9 > since_ns:
                load.floors_counts[number] = floor[: len(own)] - own
        load.level_counts = load.level_counts - own
        if load.since_ns >= since_ns - _SAME_BEGIN_NS:  # that was the load, if nothing is left of it
            del self.loads[pad]
        elif np.isfinite(load.early_counts) and load.since_ns + 3_000_000_000 > since_ns:
            load.early_counts = float(np.abs(load.level_counts).sum())

    def _leave_out(self, valid: FloatArray) -> None:
        """Leave channels that became faulty out of what is remembered of their pads."""
        changed = (valid != self._valid).any(axis=1)
        self._valid = valid.copy()
        for pad in np.flatnonzero(changed).tolist():
            for _, floor, total in self._recent_floors:
                floor[pad] *= valid[pad]
                total[pad] = np.abs(floor[pad]).sum()
            load = self.loads.get(pad)
            if load is None:
                continue
            own = valid[pad, : self._channels(pad)]
            whole = max(float(np.abs(load.level_counts).sum()), 1e-9)
            load.level_counts = load.level_counts * own
            part = float(np.abs(load.level_counts).sum()) / whole
            load.peak_counts, load.early_counts = part * load.peak_counts, part * load.early_counts
            load.later_counts *= part
            for number, floor in enumerate(load.floors_counts):
                load.floors_counts[number] = floor[: len(own)] * own
            load.scatter.clear()

    def _track_load(self, pad: int, sample_ns: int, floor: FloatArray, total: float) -> None:
        load = self.loads.get(pad)
        if load is None:
            since = int(self._last_unloaded_ns[pad])
            peak = max(peaks[pad] for _, peaks in self._recent_peaks)
            load = self.loads[pad] = StaticLoad(since, floor[: self._channels(pad)], float(peak))
            load.contacts_before = int(self._contacts.sum() - self._contacts[pad])
            for at, older, size in self._recent_floors:  # its begin
                if at > since:
                    self._record_floor(load, (at - since) * 1e-9, older[pad], float(size[pad]))
            return
        load.level_counts = self.floor_counts[pad, : self._channels(pad)]
        self._record_floor(load, (sample_ns - load.since_ns) * 1e-9, floor, total)

    def _channels(self, pad: int) -> int:
        return int(self._weights[pad].shape[-1])

    def _track_presses(self, pad: int, load: StaticLoad, sample_ns: int, counts: FloatArray) -> None:
        """Count presses elsewhere on the pad that leave the load as it was; measure scatter in between."""
        level, weights = load.level_counts, self._weights[pad]
        counts = counts[:, : len(level)]
        size, totals = float(np.abs(level).sum()), counts.sum(axis=1)
        if totals.max() > _MAX_FLOOR_RATIO * size:
            load.last_press_ns = sample_ns
            excess, place = counts[totals.argmax()] - level, approximate_position(level, weights)
            away = np.abs(approximate_position(excess, weights) - place).max()
            if excess.sum() > max(_MIN_PRESS_COUNTS, 0.5 * size) and away > _MIN_PRESS_AWAY:
                load.pressed_from = place if load.pressed_from is None else load.pressed_from
            return
        if load.pressed_from is not None:
            moved = np.abs(approximate_position(counts.mean(axis=0), weights) - load.pressed_from).max()
            load.presses += int(moved < _MAX_FLOOR_MOVE)
            load.pressed_from = None
        if totals.min() > 0 and len(counts) > 3 and sample_ns - load.last_press_ns > _AFTER_PRESS_NS:
            load.scatter.append(_scatter(counts / totals[:, None]))

    def _record_floor(self, load: StaticLoad, age_s: float, floor: FloatArray, total: float) -> None:
        if 0.5 < age_s < 3.0:
            load.early_counts = min(load.early_counts, total)
        if age_s < 60.0:
            load.later_counts = float(np.abs(load.level_counts).sum())
        load.ages_s.append(age_s)
        load.floors_counts.append(floor)

    def _classify(self, pad: int, load: StaticLoad, age_s: float) -> None:
        features, tremor_nats = self._features(pad, load, age_s)
        lasting_nats = self._lasting_nats(pad, load, age_s)
        score = _LOG_PRIOR + np.clip(tremor_nats, -_MAX_STILL_NATS, _MAX_TREMOR_NATS) * _TREMOR_CAUSES
        score = score + lasting_nats * _LASTING_CAUSES
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
        load.evidence["presses"] = load.presses
        observable = (
            cause != FaultKind.HELD_OBJECT or tremor_nats > _MIN_TREMOR_NATS or features["with others"]
        )
        if share[best] >= known and age_s >= _MIN_AGE_S[cause] and observable:
            load.kind = cause
        elif load.kind in (None, FaultKind.STATIC_LOAD):
            load.kind = FaultKind.UNEXPLAINED if age_s > 300 else None
            if cause == FaultKind.GUM and age_s > _MIN_PROBABLE_AGE_S:
                load.kind = FaultKind.STATIC_LOAD
        named = FaultKind.GUM if load.kind == FaultKind.STATIC_LOAD else load.kind
        if named in _CAUSES:
            load.probability = float(share[_CAUSES.index(named)])

    def _features(self, pad: int, load: StaticLoad, age_s: float) -> tuple[dict[str, bool | None], float]:
        level = load.level_counts
        size = float(np.abs(level).sum())
        times, floors = np.array(load.ages_s), np.array(load.floors_counts)
        sizes = np.abs(floors).sum(axis=1)
        # when the sheet's rests of other presses were least
        rests = np.where(sizes > 0.5 * size, sizes - np.abs(floors).max(axis=1), np.inf)
        others = float(rests.min(initial=size))
        one_channel = others <= 3 + 0.02 * size
        if one_channel:
            load.channel = int(np.abs(floors[rests.argmin()]).argmax())
        totals = sizes
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
            "one channel": one_channel,
            "negative": bool(level.min() < -(4 + 0.03 * size)),
            "abrupt": abrupt,
            "decays": slope < -0.008 if steady else None,
            "fades": _fades(totals) if steady else None,
            "grows": slope > 0.004 if steady else None,
            "with others": together,
            "slowly with others": not abrupt and slow >= 2,
            "after a press": load.peak_counts > 4 * size,
        }
        return features, self._tremor_nats(pad, load)

    def _lasting_nats(self, pad: int, load: StaticLoad, age_s: float) -> float:
        """Return the evidence that the load isn't held: presses beside it, use of other pads, its age."""
        others = int(self._contacts.sum() - self._contacts[pad]) - load.contacts_before
        return float(
            min(_PRESS_NATS * load.presses, _MAX_PRESS_NATS)
            + min(_OTHER_PAD_NATS * others, _MAX_OTHER_PAD_NATS)
            + _HOLD_EXPONENT * np.log1p(age_s / _HOLD_TIME_S)
        )

    def _tremor_nats(self, pad: int, load: StaticLoad) -> float:
        """Return the log likelihood ratio of tremor against a still contact, by the scatter within blocks."""
        if len(load.scatter) < _MIN_SCATTER_BLOCKS:
            return 0.0
        noise = float(np.sqrt(self._variance[pad])) / max(float(np.abs(load.level_counts).sum()), 1.0)
        variance, blocks, free = float(np.median(load.scatter)), len(load.scatter), self._channels(pad) - 1
        noise *= np.sqrt(free / (free + 1))  # fractions sum to one
        return _log_bayes_factor(variance, free * blocks, noise, _TREMOR_POSITION_STDS, _STILL_POSITION_STDS)


def _scatter(values: FloatArray) -> float:
    """Return the mean variance of values (k, c) about straight lines in time."""
    times = np.arange(len(values)) - (len(values) - 1) / 2
    off = values - values.mean(axis=0)
    off = off - times[:, None] * (times @ off) / (times @ times)
    return float(np.square(off).sum() / (values.shape[1] * (len(values) - 2)))


def _log_bayes_factor(
    variance: float, freedom: int, noise: float, moving: FloatArray, still: FloatArray
) -> float:
    """Return the log Bayes factor of a standard deviation among `moving` against one among `still`.

    Both add to noise. Half of the degrees of freedom count, as values are correlated.
    """

    def level(std: FloatArray) -> float:
        expected = (1.2 * noise) ** 2 + std**2
        logs = -0.25 * freedom * (np.log(expected) + variance / expected)
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


def _fades(totals: FloatArray) -> bool:
    """Return whether the load falls steadily, from third to third, by a third or more."""
    if len(totals) < 24:
        return False
    first, middle, last = (float(np.quantile(part, 0.25)) for part in np.array_split(totals, 3))
    return last < _MAX_FADED_PART * first and last < 0.95 * middle and middle < 0.95 * first


def _is_abrupt(load: StaticLoad) -> bool:
    """Return whether it came within a second or so: early total against that within the first minute.

    Both above what no load has. A leak grows from nothing; a sheet that adapts to a contact reads more later,
    but not by several times.
    """
    grown = load.later_counts - MIN_LOAD_COUNTS
    return load.early_counts - MIN_LOAD_COUNTS > _MIN_ABRUPT_PART * grown
