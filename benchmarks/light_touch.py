"""Hands with light or no touches through the daemon's detection: for `bench_light_touch`.

Public names: `Thresholds`, `DetectionBench`, `QuietHand`, `touched_hand`, `measured_thresholds`.

Several hands, each with its own thresholds, share the ticks: their cost is spread. Everything from the counts
on is the daemon's: detection, baseline, least thresholds. Positions aren't solved.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.config import shipped
from handtouch.config.channels import node_channels
from handtouch.core.columns import TickResult
from handtouch.core.least_threshold import least_begin_counts
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import CountSlab, Cycle
from handtouch.core.tick import TickProcessor
from handtouch.simulate.electronics_drift import ChannelErrors, ElectronicsDrift
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family
from handtouch.supervisor.level_scatter import LevelScatter

FloatArray = NDArray[np.float64]
CountArray = NDArray[np.int64]
Thresholds = FloatArray
"""Begin and end threshold (pads, 2) of a hand [N]."""
FIRST_SEED = 9000
END_RATIO = 0.5
"""Of the end threshold to the begin threshold, as shipped."""
MEASURED_S, BLOCK_TICKS, CHUNK_TICKS = 600.0, 20, 2000
START_S = 10.0


@lru_cache(maxsize=1)
def deployment() -> config.Deployment:
    """The shipped hand of 15 pads."""
    return config.load(shipped.path("utah_mit.toml"))


def shipped_thresholds() -> Thresholds:
    """Return the thresholds in the file."""
    touches = [pad.touch or deployment().touch for _, pad in deployment().pads]
    return np.array([(touch.begin_threshold_n, touch.end_threshold_n) for touch in touches])


def drawn_world(world: str, seed: int) -> DrawnWorld:
    """Return a hand's hidden properties, seeds of the reporting family."""
    return WORLDS[world].draw(Family.REPORTING.seed(FIRST_SEED + seed))


def touched_hand(world: str, seed: int, touches: Sequence[ScenarioTouch]) -> VirtualHand:
    """Return the same hand with touches."""
    return VirtualHand(deployment(), Scenario(touch=tuple(touches)), drawn_world(world, seed))


class DetectionBench:
    """Detection of contacts on hands with these thresholds; rows are the pads of one after the other."""

    def __init__(self, thresholds: Sequence[Thresholds], period_ns: int) -> None:
        hands = [
            hand.model_copy(update={"name": f"hand{number}", "pads": _with_thresholds(hand.pads, pairs)})
            for number, pairs in enumerate(thresholds)
            for hand in deployment().hands
        ]
        self.period_ns = period_ns
        self.model = PadModel(deployment().model_copy(update={"hands": tuple(hands)}))
        size = self.model.size
        self.tick = TickProcessor(self.model, period_ns)
        nothing = np.zeros(size, np.bool_)
        self.tick.set_requested(nothing, nothing, np.ones(size, np.int64))
        self._slab = CountSlab(np.tile(np.array([-32768, 32767]), (size, self.model.channels, 1)))
        self._cycle, self._up = Cycle(period_ns, 0.6), np.zeros(size, np.uint8)

    def tare(self, counts: CountArray) -> None:
        """Set the baselines to the mean of samples (ticks, pads, channels) of all hands, as a tare does."""
        baseline = self.tick.baseline
        for pad, zeros in enumerate(counts.mean(axis=0)):
            baseline.set_offset(pad, zeros, baseline.noise_counts[pad] / np.sqrt(len(counts)))

    def run_tick(self, counts: CountArray, sync_ns: int) -> TickResult:
        """Process a sample (pads, channels) of all hands."""
        self.tick.prepare_next_tick()
        self._slab.begin_cycle(sync_ns)
        self._cycle.begin_cycle(sync_ns)
        self._slab.store_counts(counts, sync_ns + 1000)
        return run_tick(self.tick, self._slab, self._up, self._cycle)


def _with_thresholds(pads: Sequence[config.Pad], pairs: Thresholds) -> tuple[config.Pad, ...]:
    return tuple(
        pad.model_copy(
            update={
                "touch": (pad.touch or deployment().touch).model_copy(
                    update={"begin_threshold_n": float(begin_n), "end_threshold_n": float(end_n)}
                )
            }
        )
        for pad, (begin_n, end_n) in zip(pads, pairs, strict=True)
    )


class QuietHand:
    """A hand of a world that nothing touches, seeds of the reporting family: what moves its channels is the
    simulator's, but for the generator of white noise, which is faster."""

    def __init__(self, world: str, seed: int, part: int = 0) -> None:
        """`part`: of the noise, another one for each run of the hand."""
        drawn, entries = drawn_world(world, seed), deployment().pads
        names = [(hand, pad.link) for hand, pad in entries]
        nodes = [deployment().nodes[pad.node] for _, pad in entries]
        limits = np.array([[channel.limits for channel in node_channels(node)] for node in nodes])
        self._noise = np.array(
            [
                node.noise_counts * drawn.pad(hand, pad).noise_ratio
                for node, (hand, pad) in zip(nodes, entries, strict=True)
            ]
        )
        self._low, self._high = limits[:, :, 0], limits[:, :, 1]
        self._drift = ElectronicsDrift(drawn, names, [pad.electrode_names for _, pad in entries])
        tops = self._high.min(axis=1).tolist()
        self._errors = ChannelErrors(drawn, names, [limits.shape[1]] * len(entries), tops)
        self._rng = np.random.default_rng((FIRST_SEED, seed, part))

    def counts(self, times_s: FloatArray) -> CountArray:
        """Return the samples (ticks, pads, channels) at successive times."""
        shape = (len(times_s), *self._low.shape)
        counts = np.asarray(self._noise[:, None] * self._rng.standard_normal(shape, np.float32), np.float64)
        if not self._drift.is_constant:
            coarse = np.arange(np.floor(times_s[0]), times_s[-1] + 2)  # its periods are 30 s and more
            zeros, steps = self._drift.zero_counts(coarse), times_s - coarse[0]
            before = steps.astype(np.int64)
            part = (steps - before)[:, None, None]
            counts = counts + (1 - part) * zeros[before] + part * zeros[before + 1]
        if self._errors.disturbs:
            counts = counts + self._errors.disturbance(times_s)
        if self._errors.distorts:
            counts = self._errors.distorted(counts)
        return np.clip(np.rint(counts), self._low, self._high).astype(np.int64)


def tick_times(from_s: float, length_s: float, period_ns: int) -> list[FloatArray]:
    """Return the times of ticks [s], chunk by chunk."""
    ticks = np.arange(round(length_s / (period_ns * 1e-9)))
    return [
        np.asarray(from_s + part * (period_ns * 1e-9), np.float64)
        for part in np.split(ticks, range(CHUNK_TICKS, len(ticks), CHUNK_TICKS))
    ]


def measured_thresholds(hands: Sequence[QuietHand], period_ns: int) -> list[Thresholds]:
    """Return the least thresholds of hands, as `health` publishes them after ten untouched minutes."""
    bench = DetectionBench([shipped_thresholds()] * len(hands), period_ns)
    scatter = LevelScatter(bench.model.touch.begin_ms.tolist())
    for times_s in tick_times(START_S, MEASURED_S, period_ns):
        counts = np.concatenate([hand.counts(times_s) for hand in hands], axis=1)
        stamps = np.rint(times_s * 1e9).astype(np.int64)
        for first in range(0, len(times_s), BLOCK_TICKS):
            part = slice(first, first + BLOCK_TICKS)
            for row, sync_ns in zip(counts[part], stamps[part].tolist(), strict=True):
                bench.run_tick(row, sync_ns)
            levels = (counts[part] - bench.tick.baseline.expected_counts).sum(axis=2)
            touched = np.broadcast_to(bench.tick.state.touching, levels.shape)
            scatter.add_block(stamps[part], levels, ~touched, touched)
    least = [least_begin_counts(std, scatter.samples_per_s) for std in scatter.counts.tolist()]
    begin_n = [bench.model.centre_force(pad, counts) for pad, counts in enumerate(least)]
    pairs = np.array(begin_n)[:, None] * (1.0, END_RATIO)
    return list(pairs.reshape(len(hands), -1, 2))
