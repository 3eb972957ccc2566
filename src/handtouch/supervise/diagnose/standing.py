"""What a pad goes on reading: a held object, gum, an offset, moisture, or the tail of a press?

Public: `StandingWitness`, `Standing`. The least of a pad's short means in the last seconds is its floor.
While the floor stays off zero something stands on the pad, whatever comes and goes above it. What that is,
is told by naive Bayes from features of the floor since then; their probabilities under each cause are the
table below. A held object trembles with the hand, in place and in force; what sticks doesn't.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from handtouch.supervise.diagnose.features import GROUP
from handtouch.supervise.diagnose.findings import FloatArray, Kind

FLOOR_COUNTS = 12.0
"""Sum of the channels' magnitudes from which on something stands on a pad."""
WINDOW_NS = 4_000_000_000
KNOWN = 0.99
"""Probability at which a fault is told; a held object at `_HELD_KNOWN`."""

_HELD_KNOWN = 0.8
_KEPT = 120  # blocks
_DRIFT_COUNTS_PER_S = 0.05  # that the zero may follow
_CAUSES = (
    Kind.HELD_OBJECT, Kind.STUCK_CONTACT, Kind.HYSTERESIS_TAIL, Kind.OFFSET, Kind.MOISTURE, Kind.COMMON_DRIFT,
)  # fmt: skip
_LEAST_AGE_S = dict(zip(_CAUSES, (8.0, 15.0, 8.0, 6.0, 15.0, 15.0), strict=True))
_PRIOR = np.log([0.969, 0.008, 0.012, 0.005, 0.003, 0.003])
# probability that a feature is there, by cause
_FEATURES = {
    "one channel": (0.002, 0.002, 0.002, 0.998, 0.0005, 0.01),
    "negative": (0.0005, 0.0005, 0.0005, 0.45, 0.0005, 0.2),
    "abrupt": (0.99, 0.99, 0.99, 0.99, 0.002, 0.02),
    "decays": (0.15, 0.002, 0.998, 0.002, 0.05, 0.2),
    "grows": (0.15, 0.005, 0.003, 0.005, 0.5, 0.3),
    "with others": (0.7, 0.01, 0.2, 0.01, 0.01, 0.5),
    "slowly with others": (0.003, 0.003, 0.003, 0.003, 0.003, 0.99),
    "after a press": (0.3, 0.5, 0.97, 0.4, 0.4, 0.4),
}
_TREMBLES = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_TREMBLE_PLACE = np.geomspace(4e-4, 3e-2, 10)  # standard deviations of a held object's fractions
_STILL_PLACE = np.array([0.0, 5e-5, 1.5e-4])
_TREMBLE_FORCE, _STILL_FORCE = np.geomspace(4e-3, 0.2, 10), np.array([0.0, 1e-3, 3e-3, 8e-3])
_ALONE = 1.25
_TREMBLES_NATS = 3.0
_MOST_TREMBLE = 15.0  # nats


@dataclass
class Standing:
    """What stands on one pad. since_ns; level (4,) counts now; kind, once it is told, with its probability;
    evidence: features and numbers."""

    since_ns: int
    level: FloatArray
    peak: float = 0.0
    kind: Kind | None = None
    share: float = 0.0
    evidence: dict[str, float] = field(default_factory=dict)
    times: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    floors: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=_KEPT))
    early: float = np.inf
    """the least total from half a second to 3 s after it came"""
    later: float = 0.0
    """its total within the first minute"""
    judged_s: float = 0.0
    channel: int = 0
    """that reads most, when it was last told"""


class StandingWitness:
    """The floors of the n pads of a hand."""

    def __init__(self, noise_counts: FloatArray) -> None:
        n = len(noise_counts)
        self._noise = noise_counts
        self._zero = np.zeros((n, 4))
        self._recent: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._low_ns = np.full(n, -1, dtype=np.int64)
        self._peaks: deque[tuple[int, FloatArray]] = deque()
        self.floor = np.zeros((n, 4))
        self.now: dict[int, Standing] = {}
        self._last_ns = -1

    def take(self, t_ns: int, counts: FloatArray, alive: FloatArray) -> None:
        """Short means (g, n, 4) of a block that ended at t_ns, in counts off the stored offsets.

        alive: (n, 4), 0 for channels that are known to be wrong and count for nothing.
        """
        counts = (counts - self._zero) * alive
        size = np.abs(counts).sum(axis=2)
        least = size.argmin(axis=0)
        pads = np.arange(size.shape[1])
        floor, own = counts[least, pads], size[least, pads]
        if self._last_ns < 0:
            self._low_ns[:] = t_ns
        dt_s = max(t_ns - self._last_ns, 0) * 1e-9 if self._last_ns >= 0 else 0.0
        self._last_ns = t_ns
        self._recent.append((t_ns, floor, own))
        self._peaks.append((t_ns, size.max(axis=0)))
        while self._recent[0][0] < t_ns - WINDOW_NS:
            self._recent.popleft()
        while self._peaks[0][0] < t_ns - 2 * WINDOW_NS:
            self._peaks.popleft()
        sizes = np.stack([own for _, _, own in self._recent])
        lowest = sizes.argmin(axis=0)
        self.floor = np.stack([floor for _, floor, _ in self._recent])[lowest, pads]
        level = sizes[lowest, pads]
        self._low_ns[own <= FLOOR_COUNTS] = t_ns
        quiet = level <= FLOOR_COUNTS
        follow = np.clip(self.floor, -_DRIFT_COUNTS_PER_S * dt_s, _DRIFT_COUNTS_PER_S * dt_s)
        self._zero += np.where(quiet[:, None], follow, 0.0)
        for pad in [pad for pad in self.now if quiet[pad]]:
            del self.now[pad]
        for pad in np.flatnonzero(~quiet).tolist():
            self._follow(pad, t_ns, floor[pad], float(own[pad]))
        for pad, standing in self.now.items():
            age_s = (t_ns - standing.since_ns) * 1e-9
            if age_s - standing.judged_s >= (1.0 if age_s < 60 else 5.0) and age_s >= 6.0:
                standing.judged_s = age_s
                self._judge(pad, standing, age_s)

    def tare(self, pads: FloatArray) -> None:
        """The zero of some pads (n,) bool is where their stored offsets are."""
        self._zero[pads.astype(bool)] = 0.0

    def _follow(self, pad: int, t_ns: int, floor: FloatArray, own: float) -> None:
        standing = self.now.get(pad)
        if standing is None:
            since = int(self._low_ns[pad])
            peak = max(peaks[pad] for _, peaks in self._peaks)
            standing = self.now[pad] = Standing(since, floor, float(peak))
            for at, older, size in self._recent:  # the way it came
                if at > since:
                    self._note(standing, (at - since) * 1e-9, older[pad], float(size[pad]))
            return
        standing.level = self.floor[pad]
        self._note(standing, (t_ns - standing.since_ns) * 1e-9, floor, own)

    def _note(self, standing: Standing, age_s: float, floor: FloatArray, own: float) -> None:
        if 0.5 < age_s < 3.0:
            standing.early = min(standing.early, own)
        if age_s < 60.0:
            standing.later = float(np.abs(standing.level).sum())
        standing.times.append(age_s)
        standing.floors.append(floor)

    def _judge(self, pad: int, standing: Standing, age_s: float) -> None:
        features, tremble = self._features(pad, standing, age_s)
        score = _PRIOR + np.clip(tremble, -_MOST_TREMBLE, _MOST_TREMBLE) * _TREMBLES
        for name, there in features.items():
            if there is not None:
                chance = np.array(_FEATURES[name])
                score = score + np.log(chance if there else 1 - chance)
        share = np.exp(score - score.max())
        share /= share.sum()
        best = int(share.argmax())
        cause = _CAUSES[best]
        known = _HELD_KNOWN if cause == Kind.HELD_OBJECT else KNOWN
        standing.evidence["tremble_nats"] = tremble
        standing.evidence["age_s"] = age_s
        shown = cause != Kind.HELD_OBJECT or tremble > _TREMBLES_NATS or features["with others"]
        if share[best] >= known and age_s >= _LEAST_AGE_S[cause] and shown:
            standing.kind = cause
        elif standing.kind is None and age_s > 300:
            standing.kind = Kind.UNEXPLAINED
        if features["one channel"]:
            standing.channel = int(np.abs(standing.level).argmax())
        if standing.kind in _CAUSES:
            standing.share = float(share[_CAUSES.index(standing.kind)])

    def _features(self, pad: int, standing: Standing, age_s: float) -> tuple[dict[str, bool | None], float]:
        level = standing.level
        size = float(np.abs(level).sum())
        others = size - float(np.abs(level).max())
        times, floors = np.array(standing.times), np.array(standing.floors)
        totals = np.abs(floors).sum(axis=1)
        late = times > max(age_s - 30.0, 2.0)
        times, floors, totals = times[late], floors[late], totals[late]
        slope = _slope(times, totals)
        if len(totals):  # leave out what is pressed on top
            parts = [
                part < _ALONE * np.quantile(part, 0.1) for part in np.array_split(totals, 3) if len(part)
            ]
            alone = np.concatenate(parts)
            times, floors = times[alone], floors[alone]
        company = [s for p, s in self.now.items() if p != pad]
        together = any(abs(s.since_ns - standing.since_ns) < 2_000_000_000 for s in company)
        abrupt = _abrupt(standing)
        slow = sum(not _abrupt(s) for s in company)
        standing.evidence.update(counts=size, slope_per_s=slope)
        steady = age_s >= 14.0
        features: dict[str, bool | None] = {
            "one channel": others <= 3 + 0.02 * size,
            "negative": bool(level.min() < -(4 + 0.03 * size)),
            "abrupt": abrupt,
            "decays": slope < -0.008 if steady else None,
            "grows": slope > 0.004 if steady else None,
            "with others": together,
            "slowly with others": not abrupt and slow >= 2,
            "after a press": standing.peak > 4 * size,
        }
        return features, self._tremble(pad, times, floors)

    def _tremble(self, pad: int, times: FloatArray, floors: FloatArray) -> float:
        """Log of how much likelier the scatter of floors (k, 4) is under a trembling than a still contact."""
        if len(times) < 12:
            return 0.0
        total = floors.sum(axis=1)
        if (total <= 0).any():
            return 0.0
        noise = self._noise[pad] / np.sqrt(GROUP) / float(np.median(total))
        fractions = _roughness(times, floors / total[:, None])
        force = _roughness(times, np.log(total)[:, None])
        place = _evidence(fractions, np.sqrt(0.75) * noise, _TREMBLE_PLACE, _STILL_PLACE)
        return place + _evidence(force, 2 * noise, _TREMBLE_FORCE, _STILL_FORCE)


def _roughness(times: FloatArray, values: FloatArray) -> FloatArray:
    """How far values (k, c) are off a line through their neighbours, as standard deviations: (l, c).

    It knows no trend; neighbours more than some seconds away are left out.
    """
    before, after = np.diff(times)[:-1], np.diff(times)[1:]
    part = (before / (before + after))[:, None]
    off = values[1:-1] - (1 - part) * values[:-2] - part * values[2:]
    off /= np.sqrt(1 + (1 - part) ** 2 + part**2)
    return np.asarray(off[before + after < 4.0])


def _evidence(off: FloatArray, noise: float, moving: FloatArray, still: FloatArray) -> float:
    """Log Bayes factor for a standard deviation among `moving` against one among `still`, besides noise.

    Told by the median, which a few presses on top don't move; half of the values count, as they hang
    together.
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


def _slope(times: FloatArray, totals: FloatArray) -> float:
    """Relative change a second, by lower quartiles of the first and last third; 0 if too little is known."""
    if len(times) < 24 or times[-1] - times[0] < 8:
        return 0.0
    third = len(times) // 3
    before, after = np.quantile(totals[:third], 0.25), np.quantile(totals[-third:], 0.25)
    between = times[-third:].mean() - times[:third].mean()
    return float((after - before) / between / max(0.5 * (before + after), 1e-9))


def _abrupt(standing: Standing) -> bool:
    """Whether it came within a second or so: what it was then against what it became within a minute."""
    return standing.early > 0.5 * standing.later
