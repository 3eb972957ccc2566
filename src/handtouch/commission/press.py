"""What the channels tell at rest, and when a pad is pressed: counts in, findings and presses out.

Public names: `Rest`, `Finding`, `judge_rest`, `PressDetector`, `Press`, `polarity`, `reacted`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

PRESSED = 100.0  # standard deviations of a channel: some 0.3 % of the usual range
RELEASED = 40.0
REACTED = 8.0  # of a channel: less than this is no answer to a press
BESIDE = 0.2  # of the strongest pad's current: a pad that answers so much is pressed too
_HOLD_NS = 300_000_000  # a press lasts at least so long, and its first third isn't used
_QUIET_NS = 150_000_000
_SETTLE = 0.05  # of the way that a baseline follows with each quiet sample
_OFFSET, _NOISY, _MOVED = 5.0, 2.0, 20.0
_SURELY_NOISY = 0.5  # counts; with less, a channel may show one and the same count all the time


@dataclass(frozen=True)
class Rest:
    """A pad's four channels, in the node's order, while nothing touched it: `samples` of them.

    Counts (4,): `mean`, `std`; `span` from the least to the greatest.
    """

    samples: int
    mean: FloatArray
    std: FloatArray
    span: FloatArray

    @classmethod
    def of(cls, counts: FloatArray) -> Rest:
        """From samples (n, 4)."""
        if not len(counts):
            return cls(0, np.zeros(4), np.zeros(4), np.zeros(4))
        return cls(len(counts), counts.mean(axis=0), counts.std(axis=0), np.ptp(counts, axis=0))

    def stuck(self, noise_counts: float) -> BoolArray:
        """Channels (4,) that never moved though they should be noisy."""
        sure = self.samples >= 20 and noise_counts >= _SURELY_NOISY
        return np.asarray((self.span == 0) & sure)

    def touched(self, noise_counts: float) -> bool:
        """Whether it was no rest: the channels moved by far more than noise."""
        return bool((self.std > _MOVED * max(noise_counts, _SURELY_NOISY)).any())


@dataclass(frozen=True)
class Finding:
    """What is wrong with a channel (0 to 3 in the node's order), in words."""

    channel: int
    text: str

    def __str__(self) -> str:
        return f"channel {self.channel + 1} {self.text}"


def judge_rest(rest: Rest, noise_counts: float) -> list[Finding]:
    """Stuck and noisy channels, offsets and negative readings."""
    findings = []
    stuck = rest.stuck(noise_counts)
    for channel in range(4):
        mean, std = float(rest.mean[channel]), float(rest.std[channel])
        if stuck[channel]:
            findings.append(Finding(channel, f"is stuck at {mean:.0f} counts: broken input or amplifier"))
        elif std > _NOISY * max(noise_counts, _SURELY_NOISY):
            findings.append(
                Finding(channel, f"is noisy: {std:.1f} counts, noise_counts = {noise_counts:g} is configured")
            )
        if not stuck[channel] and abs(mean) > _OFFSET * max(noise_counts, _SURELY_NOISY):
            what = "an offset" if mean > 0 else "a negative reading"
            findings.append(Finding(channel, f"has {what} of {mean:+.0f} counts at rest"))
    return findings


@dataclass(frozen=True)
class Press:
    """A pad was pressed: the node in `slot` answered with mean counts (4,) above its baseline.

    `others`: slots that answered as well.
    """

    slot: int
    counts: FloatArray
    others: tuple[int, ...] = ()


@dataclass
class PressDetector:
    """Finds presses in samples of n pads; each lasts 0.3 s, and all pads are quiet before it.

    `baseline` (n, 4) counts at rest, NaN for a pad whose first sample is to be that; it follows while quiet.
    `noise` (n,) standard deviation of a channel. `level` (n,) is how hard each pad is pressed now, in those;
    above PRESSED it counts.
    """

    baseline: FloatArray
    noise: FloatArray
    deltas: FloatArray = field(init=False)
    level: FloatArray = field(init=False)
    ready: bool = field(init=False, default=False)
    """All pads were quiet since the last press: the next one counts."""

    def __post_init__(self) -> None:
        self.baseline = np.array(self.baseline, np.float64)
        self.deltas = np.zeros_like(self.baseline)
        self.level = np.zeros(len(self.baseline))
        self._quiet_ns: int | None = None
        self._begun_ns: int | None = None
        self._kept: list[FloatArray] = []

    def again(self) -> None:
        """Wait for quiet before the next press counts."""
        self.ready = False
        self._quiet_ns = None
        self._drop()

    def rebase(self) -> None:
        """What the pads show now is rest from here on."""
        self.baseline += self.deltas

    @property
    def pressed(self) -> list[int]:
        """Slots that aren't quiet, the strongest first."""
        order = np.argsort(-self.level)
        return [int(slot) for slot in order if self.level[slot] > RELEASED]

    def feed(self, t_ns: int, counts: NDArray[np.signedinteger], alive: BoolArray) -> Press | None:
        """Take a sample (n, 4) of the pads that are `alive` (n,); a press when one is complete."""
        new = alive & np.isnan(self.baseline[:, 0])
        self.baseline[new] = counts[new]
        self.deltas = np.where(alive[:, None], counts - self.baseline, 0.0)
        self.level = np.abs(self.deltas).sum(axis=1) / self.noise
        if not self.ready:
            self._wait_for_quiet(t_ns)
            return None
        if not (self.level > PRESSED).any():
            self._drop()
            self._follow(alive)
            return None
        if self._begun_ns is None:
            self._begun_ns = t_ns
        since_ns = t_ns - self._begun_ns
        if since_ns >= _HOLD_NS // 3 or not self._kept:
            self._kept.append(self.deltas)
        if since_ns < _HOLD_NS:
            return None
        mean = np.mean(self._kept, axis=0)
        self.again()
        return self._press(mean)

    def _press(self, mean: FloatArray) -> Press:
        totals = np.abs(mean).sum(axis=1)
        strong = totals / self.noise > PRESSED
        slot = int(np.argmax(np.where(strong, totals, 0.0)))
        beside = strong & (totals > BESIDE * totals[slot])
        others = tuple(int(other) for other in np.flatnonzero(beside) if other != slot)
        return Press(slot, mean[slot], others)

    def _wait_for_quiet(self, t_ns: int) -> None:
        if (self.level > RELEASED).any():
            self._quiet_ns = None
        elif self._quiet_ns is None:
            self._quiet_ns = t_ns
        elif t_ns - self._quiet_ns >= _QUIET_NS:
            self.ready = True

    def _follow(self, alive: BoolArray) -> None:
        quiet = alive & (self.level < RELEASED)
        self.baseline[quiet] += _SETTLE * self.deltas[quiet]

    def _drop(self) -> None:
        self._begun_ns = None
        self._kept = []


def polarity(presses: Sequence[Press], noise: float) -> list[Finding]:
    """Channels that went down when they should go up."""
    findings = []
    for channel in range(4):
        down = [press.counts[channel] for press in presses if press.counts[channel] < -REACTED * noise]
        if down:
            text = f"goes negative when pressed ({min(down):.0f} counts): its polarity is reversed"
            findings.append(Finding(channel, text))
    return findings


def reacted(presses: Sequence[Press], noise: float) -> BoolArray:
    """Channels (4,) that any of the presses moved."""
    peak = np.max([np.abs(press.counts) for press in presses], axis=0)
    return np.asarray(peak > REACTED * noise)
