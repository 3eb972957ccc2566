"""Buffer that collects the columns of several ticks into one block for the supervisor process.

Public name: `BlockBuffer`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.core.pipeline import Pipeline
from handtouch.supervisor.ipc import SampleBlock

_MAX_BLOCK_NS = 100_000_000
_MAX_BLOCK_BYTES = 60_000  # several blocks fit into a socket buffer
_BYTES_PER_PAD_TICK, _BYTES_PER_CHANNEL = 14, 8
_MAX_BLOCK_TICKS = 50


class BlockBuffer:
    """Collects ticks of pads with up to `channels` each; `add_tick` returns complete blocks, at least every
    100 ms."""

    def __init__(self, pads: int, channels: int) -> None:
        bytes_per_tick = (_BYTES_PER_PAD_TICK + _BYTES_PER_CHANNEL * channels) * pads
        self.max_ticks = int(np.clip(_MAX_BLOCK_BYTES // bytes_per_tick, 1, _MAX_BLOCK_TICKS))
        k = self.max_ticks
        self._sync_ns: NDArray[np.int64] = np.zeros(k, np.int64)
        self._sample_ns: NDArray[np.int64] = np.zeros((k, pads), np.int64)
        self._counts: NDArray[np.int64] = np.zeros((k, pads, channels), np.int64)
        self._fresh: NDArray[np.bool_] = np.zeros((k, pads), np.bool_)
        self._state: NDArray[np.uint8] = np.zeros((k, pads), np.uint8)
        self._contact_id: NDArray[np.uint32] = np.zeros((k, pads), np.uint32)
        self._count = self._learned_pad = 0

    def add_tick(self, pipeline: Pipeline) -> SampleBlock | None:
        """Copy the columns of the newest tick; return the block if it is complete, else None."""
        k, tick = self._count, pipeline.tick
        self._sync_ns[k] = pipeline.cycle.sync_ns
        self._sample_ns[k] = tick.columns.sample_ns
        self._counts[k] = tick.counts
        # a sample that arrived after the next SYNC, before a late tick, isn't of this tick
        self._fresh[k] = pipeline.slab.fresh.view(np.bool_)
        self._fresh[k] &= pipeline.slab.arrival_ns == tick.state.arrival_ns
        self._state[k] = tick.columns.state
        self._contact_id[k] = tick.state.contact_id
        self._count = k + 1
        if self._count < self.max_ticks and self._sync_ns[k] - self._sync_ns[0] < _MAX_BLOCK_NS:
            return None
        return self._take_block(pipeline)

    def clear(self) -> None:
        """Discard the collected ticks."""
        self._count = 0

    def _take_block(self, pipeline: Pipeline) -> SampleBlock:
        k, self._count = slice(0, self._count), 0
        baseline, sheet_force = pipeline.tick.baseline, pipeline.tick.sheet_force
        back, pad = sheet_force.back_force, self._learned_pad
        self._learned_pad = (pad + 1) % len(back[0])
        return SampleBlock(
            sync_ns=self._sync_ns[k],
            sample_ns=self._sample_ns[k],
            counts=self._counts[k],
            fresh=self._fresh[k],
            pad_state=self._state[k],
            contact_id=self._contact_id[k],
            offset_counts=baseline.expected_counts,
            offset_std=np.where(baseline.unverified, np.nan, baseline.std),
            noise_counts=np.sqrt(baseline.noise_squared),
            back_n=back[0],
            back_std_n=back[1],
            learned_pad=np.array(pad, np.int32),
            learned=sheet_force.learned_of(pad),
        )
