"""Detect steps of one channel's zero, whatever else loads the pad: an amplifier's offset has jumped.

Public: `OffsetStepDetector`, `OffsetStep`. From one sample to the next, one channel jumps and no other
moves, which no contact does; some seconds later, the pad's lowest reading still differs by that jump in
that channel, while the rest of it has kept its proportions. The step is then subtracted, so that loads and
contacts are seen as without it. Offsets that `static_load` classifies are subtracted as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.supervisor.diagnose.model import DiagnosisModel, HandSamples
from handtouch.supervisor.diagnose.static_load import MIN_LOAD_COUNTS, StaticLoad
from handtouch.wire.faults import FaultKind

# Constants without an origin beside them were chosen; docs/benchmarks/diagnose.md and diagnose_cases.md
# measure what they yield.
CONFIRM_NS = 6_000_000_000
"""Time from a jump to its comparison; longer than the window of the lowest reading."""
_MIN_STEP_COUNTS, _MIN_STEP_SIGMA = 25.0, 12.0  # smaller steps are left to the baseline
_MAX_OTHER_FRACTION, _MAX_OTHER_SIGMA = 0.002, 7.0
"""Change of each other channel, of the jump and of its noise."""
_MAX_REST_FRACTION = 0.05
"""Change of any channel before and after, of the jump: a ramp is none."""
_SAMPLES_OF_JUMP = 4  # two before and two after it
_MAX_DIFFERENCE_COUNTS, _MAX_DIFFERENCE_FRACTION, _MAX_OTHER_DIFFERENCE_FRACTION = 5.0, 0.1, 0.03
"""Difference of the lowest reading from the former one plus the jump: counts, fraction of the jump in its
channel and in others."""
_CONFIDENCE = 0.998  # stated confidence of an offset: nothing else jumps in one channel and stays


@dataclass(frozen=True)
class OffsetStep:
    """Step of a channel [counts] since a time, with the classified load that describes it."""

    counts: float
    load: StaticLoad


@dataclass(frozen=True)
class _Candidate:
    at_ns: int
    counts: float
    floor_before: FloatArray


class OffsetStepDetector:
    """Detector of offsets of the n pads of a hand; `steps` by row of the pad and channel."""

    def __init__(self, model: DiagnosisModel) -> None:
        self._noise = model.reading_noise_counts
        self._candidates: dict[tuple[int, int], _Candidate] = {}
        self._last: tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64]] | None = None
        self._shape = model.ampere_per_count.shape
        self.steps: dict[tuple[int, int], OffsetStep] = {}

    @property
    def counts(self) -> FloatArray:
        """Steps (n, c) that are subtracted."""
        found = np.zeros(self._shape)
        for key, step in self.steps.items():
            found[key] = step.counts
        return found

    def find_jumps(self, block: HandSamples, floor_counts: FloatArray, usable: NDArray[np.bool_]) -> None:
        """Remember the jumps of a block; floor_counts (n, c): lowest reading before, usable (n, c)."""
        counts, fresh, stamps = block.counts, block.fresh, block.sample_ns
        if self._last is not None:  # the changes before and after a jump may be in other blocks
            counts, fresh, stamps = (
                np.concatenate(pair) for pair in zip(self._last, (counts, fresh, stamps), strict=True)
            )
        self._last = counts[-3:], fresh[-3:], stamps[-3:]
        if len(counts) < _SAMPLES_OF_JUMP:
            return
        change = np.diff(counts, axis=0) * usable
        size = np.abs(change)
        largest, noise = size.max(axis=2), self._noise[None, :]
        still = _MAX_OTHER_SIGMA * noise
        others = np.partition(size, -2, axis=2)[:, :, -2]
        jumps = largest > np.maximum(_MIN_STEP_COUNTS, _MIN_STEP_SIGMA * noise)
        jumps &= fresh[1:] & fresh[:-1] & (others < still + _MAX_OTHER_FRACTION * largest)
        beside = np.maximum(largest[:-2], largest[2:]) < still + _MAX_REST_FRACTION * largest[1:-1]
        for row, pad in np.argwhere(jumps[1:-1] & beside).tolist():
            channel = int(size[row + 1, pad].argmax())
            found = _Candidate(
                int(stamps[row + 2, pad]), float(change[row + 1, pad, channel]), floor_counts[pad].copy()
            )
            self._candidates[pad, channel] = found

    def confirm(self, sample_ns: int, floor_counts: FloatArray) -> list[tuple[int, int, int, float]]:
        """Return pad, channel, time and counts of the steps that last, by the lowest reading (n, c) now."""
        confirmed = []
        for (pad, channel), one in list(self._candidates.items()):
            if sample_ns < one.at_ns + CONFIRM_NS:
                continue
            del self._candidates[pad, channel]
            others = np.arange(self._shape[1]) != channel
            now, before = floor_counts[pad], one.floor_before
            square = float(before[others] @ before[others])
            grown = float(now[others] @ before[others]) / square if square > MIN_LOAD_COUNTS**2 else 1.0
            rest = np.abs(now - grown * before - np.where(others, 0.0, one.counts))
            allowed = _MAX_DIFFERENCE_COUNTS + np.where(
                others, _MAX_OTHER_DIFFERENCE_FRACTION, _MAX_DIFFERENCE_FRACTION
            ) * abs(one.counts)
            if (rest < allowed).all():
                confirmed.append((pad, channel, one.at_ns, one.counts))
        return confirmed

    def add_step(self, pad: int, channel: int, since_ns: int, counts: float, load: StaticLoad | None) -> None:
        """Add counts to the step of a channel; a step that is taken back ends."""
        before = self.steps.pop((pad, channel), None)
        total = counts + (before.counts if before else 0.0)
        if abs(total) < max(MIN_LOAD_COUNTS, _MAX_DIFFERENCE_FRACTION * abs(counts)):
            return
        if before is not None:
            load = before.load
        elif load is None:
            load = StaticLoad(since_ns, np.zeros(self._shape[1]), kind=FaultKind.OFFSET)
            load.probability, load.channel = _CONFIDENCE, channel
        load.evidence["counts"] = abs(total)
        self.steps[pad, channel] = OffsetStep(total, load)

    def end_steps(self, counts: FloatArray) -> NDArray[np.bool_]:
        """End the steps of pads whose readings (g, n, c) are at zero without them; return these (n,)."""
        ended = np.zeros(self._shape[0], dtype=np.bool_)
        for pad, _ in self.steps:
            ended[pad] = np.abs(counts[:, pad]).sum(axis=1).min() < MIN_LOAD_COUNTS
        for pad in np.flatnonzero(ended).tolist():
            self.reset(pad)
        return ended

    def reset(self, pad: int) -> None:
        """Discard the steps of a pad, which was tared."""
        for found in (self.steps, self._candidates):
            for key in [key for key in found if key[0] == pad]:
                del found[key]
