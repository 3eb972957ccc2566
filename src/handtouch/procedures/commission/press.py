"""Channel statistics at rest and detection of presses, from counts.

Public names: `RestStatistics`, `ChannelProblem`, `find_rest_problems`, `PressDetector`, `Press`,
`find_reversed_channels`, `reacting_channels`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import BoolArray, FloatArray
from handtouch.core.least_threshold import level_scatter

PRESS_THRESHOLD_SIGMA = 100.0  # about 0.3 % of the usual range
RELEASE_THRESHOLD_SIGMA = 40.0  # far above noise, far below a press
MIN_REACTION_SIGMA = 8.0  # change of a channel: less is no response to a press
MIN_SECOND_PAD_FRACTION = 0.2  # current over the strongest pad's: a pad above this is pressed too
_MIN_PRESS_NS = 300_000_000  # least duration of a press; its first third isn't used
_MIN_QUIET_NS = 150_000_000
_BASELINE_UPDATE_FRACTION = 0.05  # correction of the baseline by each quiet sample
_MAX_OFFSET_SIGMA, _MAX_NOISE_RATIO, _MAX_UNTOUCHED_STD_RATIO = 5.0, 2.0, 20.0
_MIN_NOISE_COUNTS = 0.5  # with less noise, a working channel may show a constant count


@dataclass(frozen=True)
class RestStatistics:
    """Statistics of an untouched pad's c channels, in the node's order, over `samples` samples.

    Counts (c,): `mean`, `std`; `span`: peak to peak. `level_std`: standard deviation of the mean of as many
    sums of the channels as begin a contact, NaN if unknown.
    """

    samples: int
    mean: FloatArray
    std: FloatArray
    span: FloatArray
    level_std: float = math.nan

    @classmethod
    def from_counts(cls, counts: FloatArray, begin_samples: int = 2) -> RestStatistics:
        """Compute the statistics of samples (n, c); as many as `begin_samples` begin a contact."""
        if not len(counts):
            return cls(0, *np.zeros((3, counts.shape[1])))
        level_std = level_scatter(counts.sum(axis=1), begin_samples)
        return cls(len(counts), counts.mean(axis=0), counts.std(axis=0), np.ptp(counts, axis=0), level_std)

    def stuck_channels(self, noise_counts: float) -> BoolArray:
        """Return the channels (c,) that are constant though noise is expected."""
        sure = self.samples >= 20 and noise_counts >= _MIN_NOISE_COUNTS
        return np.asarray((self.span == 0) & sure)

    def was_touched(self, noise_counts: float) -> bool:
        """Check whether the pad was touched: its channels changed by far more than their noise."""
        return bool((self.std > _MAX_UNTOUCHED_STD_RATIO * max(noise_counts, _MIN_NOISE_COUNTS)).any())


@dataclass(frozen=True)
class ChannelProblem:
    """Problem of a channel (from 0, in the node's order)."""

    channel: int
    text: str

    def __str__(self) -> str:
        return f"channel {self.channel + 1} {self.text}"


def find_rest_problems(rest: RestStatistics, noise_counts: float) -> list[ChannelProblem]:
    """Return stuck and noisy channels, offsets and negative readings."""
    findings = []
    stuck = rest.stuck_channels(noise_counts)
    for channel in range(len(rest.mean)):
        mean, std = float(rest.mean[channel]), float(rest.std[channel])
        if stuck[channel]:
            findings.append(
                ChannelProblem(channel, f"is stuck at {mean:.0f} counts: broken input or amplifier")
            )
        elif std > _MAX_NOISE_RATIO * max(noise_counts, _MIN_NOISE_COUNTS):
            findings.append(
                ChannelProblem(
                    channel, f"is noisy: {std:.1f} counts, noise_counts = {noise_counts:g} is configured"
                )
            )
        if not stuck[channel] and abs(mean) > _MAX_OFFSET_SIGMA * max(noise_counts, _MIN_NOISE_COUNTS):
            problem = "an offset" if mean > 0 else "a negative reading"
            findings.append(ChannelProblem(channel, f"has {problem} of {mean:+.0f} counts at rest"))
    return findings


@dataclass(frozen=True)
class Press:
    """A press: the node of `slot` responded with mean counts (c,) above its baseline.

    `other_slots`: slots that responded as well.
    """

    slot: int
    counts: FloatArray
    other_slots: tuple[int, ...] = ()


@dataclass
class PressDetector:
    """Detects presses in samples of n pads; each lasts 0.3 s and begins with all pads released.

    `baseline` (n, c): counts at rest, NaN to take a pad's first sample; tracks drift while untouched.
    `noise_counts` (n,): standard deviation of a channel. `level_sigma` (n,): summed channel deviations of
    each pad in standard deviations; above PRESS_THRESHOLD_SIGMA it is pressed.
    """

    baseline: FloatArray
    noise_counts: FloatArray
    deltas: FloatArray = field(init=False)
    level_sigma: FloatArray = field(init=False)
    ready: bool = field(init=False, default=False)
    """All pads were released since the last press: the next one is detected."""

    def __post_init__(self) -> None:
        self.baseline = np.array(self.baseline, np.float64)
        self.deltas = np.zeros_like(self.baseline)
        self.level_sigma = np.zeros(len(self.baseline))
        self._quiet_since_ns: int | None = None
        self._press_begin_ns: int | None = None
        self._press_deltas: list[FloatArray] = []

    def wait_for_release(self) -> None:
        """Ignore presses until all pads are released."""
        self.ready = False
        self._quiet_since_ns = None
        self._discard_press()

    def reset_baseline(self) -> None:
        """Make the present counts the baseline."""
        self.baseline += self.deltas

    @property
    def pressed_slots(self) -> list[int]:
        """Slots that aren't released, the strongest first."""
        order = np.argsort(-self.level_sigma)
        return [int(slot) for slot in order if self.level_sigma[slot] > RELEASE_THRESHOLD_SIGMA]

    def detect_press(self, t_ns: int, counts: NDArray[np.signedinteger], fresh: BoolArray) -> Press | None:
        """Process a sample (n, c), valid for `fresh` pads (n,), and return a press when one is complete."""
        new = fresh & np.isnan(self.baseline[:, 0])
        self.baseline[new] = counts[new]
        self.deltas = np.where(fresh[:, None], counts - self.baseline, 0.0)
        self.level_sigma = np.abs(self.deltas).sum(axis=1) / self.noise_counts
        if not self.ready:
            self._update_ready(t_ns)
            return None
        if not (self.level_sigma > PRESS_THRESHOLD_SIGMA).any():
            self._discard_press()
            self._track_baseline(fresh)
            return None
        if self._press_begin_ns is None:
            self._press_begin_ns = t_ns
        since_ns = t_ns - self._press_begin_ns
        if since_ns >= _MIN_PRESS_NS // 3 or not self._press_deltas:
            self._press_deltas.append(self.deltas)
        if since_ns < _MIN_PRESS_NS:
            return None
        mean = np.mean(self._press_deltas, axis=0)
        self.wait_for_release()
        return self._make_press(mean)

    def _make_press(self, mean: FloatArray) -> Press:
        totals = np.abs(mean).sum(axis=1)
        strong = totals / self.noise_counts > PRESS_THRESHOLD_SIGMA
        slot = int(np.argmax(np.where(strong, totals, 0.0)))
        beside = strong & (totals > MIN_SECOND_PAD_FRACTION * totals[slot])
        others = tuple(int(other) for other in np.flatnonzero(beside) if other != slot)
        return Press(slot, mean[slot], others)

    def _update_ready(self, t_ns: int) -> None:
        if (self.level_sigma > RELEASE_THRESHOLD_SIGMA).any():
            self._quiet_since_ns = None
        elif self._quiet_since_ns is None:
            self._quiet_since_ns = t_ns
        elif t_ns - self._quiet_since_ns >= _MIN_QUIET_NS:
            self.ready = True

    def _track_baseline(self, fresh: BoolArray) -> None:
        quiet = fresh & (self.level_sigma < RELEASE_THRESHOLD_SIGMA)
        self.baseline[quiet] += _BASELINE_UPDATE_FRACTION * self.deltas[quiet]

    def _discard_press(self) -> None:
        self._press_begin_ns = None
        self._press_deltas = []


def find_reversed_channels(presses: Sequence[Press], noise: float) -> list[ChannelProblem]:
    """Return the channels whose counts decrease when pressed."""
    findings = []
    for channel in range(len(presses[0].counts) if presses else 0):
        down = [
            press.counts[channel] for press in presses if press.counts[channel] < -MIN_REACTION_SIGMA * noise
        ]
        if down:
            text = f"goes negative when pressed ({min(down):.0f} counts): its polarity is reversed"
            findings.append(ChannelProblem(channel, text))
    return findings


def reacting_channels(presses: Sequence[Press], noise: float) -> BoolArray:
    """Return the channels (c,) that respond to any of the presses."""
    peak = np.max([np.abs(press.counts) for press in presses], axis=0)
    return np.asarray(peak > MIN_REACTION_SIGMA * noise)
