"""Ticks gathered into blocks for the slow half: columns are copied each tick, and sent together now and then.

Public name: `Blocks`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.daemon.pipeline import Pipeline
from handtouch.supervise.link import Block

_LONGEST_NS = 100_000_000
_LARGEST_BYTES = 60_000  # so that several fit into a socket's buffer
_BYTES = 30  # of a pad at a tick, about
_MOST_TICKS = 50


class Blocks:
    """Of n pads; `add` after every tick gives the block that is complete by then, at least ten a second."""

    def __init__(self, pads: int) -> None:
        self.ticks = int(np.clip(_LARGEST_BYTES // (_BYTES * pads), 1, _MOST_TICKS))
        k = self.ticks
        self._t_ns: NDArray[np.int64] = np.zeros(k, np.int64)
        self._sample_ns: NDArray[np.int64] = np.zeros((k, pads), np.int64)
        self._counts: NDArray[np.int32] = np.zeros((k, pads, 4), np.int32)
        self._fresh: NDArray[np.bool_] = np.zeros((k, pads), np.bool_)
        self._state: NDArray[np.uint8] = np.zeros((k, pads), np.uint8)
        self._contact: NDArray[np.uint32] = np.zeros((k, pads), np.uint32)
        self._count = 0

    def add(self, pipeline: Pipeline) -> Block | None:
        """Take in the tick that was just made."""
        k, tick = self._count, pipeline.tick
        self._t_ns[k] = pipeline.cycle.t_ns
        self._sample_ns[k] = tick.columns.sample_ns
        np.copyto(self._counts[k], tick.counts, casting="unsafe")
        self._fresh[k] = pipeline.slab.fresh
        self._state[k] = tick.columns.state
        self._contact[k] = tick.contacts.id
        self._count = k + 1
        if self._count < self.ticks and self._t_ns[k] - self._t_ns[0] < _LONGEST_NS:
            return None
        return self._take(pipeline)

    def clear(self) -> None:
        """Begin anew."""
        self._count = 0

    def _take(self, pipeline: Pipeline) -> Block:
        k, self._count = slice(0, self._count), 0
        baseline, back = pipeline.tick.baseline, pipeline.tick.strength.back
        return Block(
            self._t_ns[k],
            self._sample_ns[k],
            self._counts[k],
            self._fresh[k],
            self._state[k],
            self._contact[k],
            baseline.expected,
            np.where(baseline.fresh, np.nan, baseline.std),
            np.sqrt(baseline.noise_squared),
            back[0],
            back[1],
        )
