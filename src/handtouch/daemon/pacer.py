"""What a scene doesn't need isn't done: pads outside it rest, untouched ones send when something moves.

Public names: `Pacer`, `select`.
"""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.lifecycle import NodeState
from handtouch.canbus.master import Master
from handtouch.config import Deployment
from handtouch.daemon.pipeline import Pipeline
from handtouch.wire import PadState

_LOOK_NS = 100_000_000  # between two looks at what may rest; waking doesn't wait for it


class Beat(Protocol):
    """What sets the period of SYNC: `canbus.sync.Sync`."""

    def set_period(self, period_ns: int, now_ns: int) -> None: ...


def select(patterns: Sequence[str], names: Sequence[tuple[str, str]]) -> NDArray[np.bool_]:
    """Which of the pads (hand, link) a scene's patterns name: "thumb_*", "left/index_distal".

    Raises ValueError for a pattern that names none.
    """
    chosen = np.zeros(len(names), dtype=np.bool_)
    for pattern in patterns:
        full = pattern if "/" in pattern else f"*/{pattern}"
        hits = [fnmatchcase(f"{hand}/{link}", full) for hand, link in names]
        if not any(hits):
            known = ", ".join(f"{hand}/{link}" for hand, link in names)
            raise ValueError(f'no pad is named "{pattern}"; there are {known}')
        chosen |= np.array(hits)
    return chosen


class Pacer:
    """Sets the pace of nodes and SYNC; `step` it after every tick. Times in ns.

    `needed` (n,) are the pads in the scene; `slow`: every one of them waits for something to move, so SYNC is
    slow and a sample that comes is worth a tick of its own.
    """

    def __init__(self, deployment: Deployment, pipeline: Pipeline, master: Master, sync: Beat) -> None:
        pads = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
        kinds = [deployment.nodes[pad.node] for _, pad in pads]
        scene = deployment.scene
        self.names = [(hand, pad.link) for hand, pad in pads]
        self.needed: NDArray[np.bool_] = select(scene.links, self.names)
        self.slow = False
        self._pipeline, self._master, self._sync = pipeline, master, sync
        self._delta = np.array([kind.idle.delta_counts if kind.idle else 0 for kind in kinds])
        self._idles = bool((self._delta > 0).any())
        self._idle_after_ns = round(scene.idle_after_s * 1e9)
        self._full_ns = round(deployment.daemon.sync_period_ms * 1e6)
        self._slow_ns = max(round(scene.idle_sync_period_ms * 1e6), self._full_ns)
        self._active_ns = np.zeros(len(pads), dtype=np.int64)
        self._quiet = np.zeros((len(pads), 4), dtype=np.int64)  # counts of event-driven pads when last seen
        self._look_ns = 0
        self._paces = 0

    def set_scene(self, needed: NDArray[np.bool_], now_ns: int) -> None:
        """Other pads are needed from now on, (n,)."""
        self._active_ns[needed & ~self.needed] = now_ns
        self.needed = needed.copy()
        self._look_ns = 0

    def step(self, now_ns: int) -> None:
        """Wake what moved, at once; let rest, now and then, what didn't."""
        if self._idles:
            self._wake(now_ns)
        if self._master.paces != self._paces:
            self._follow(now_ns)
        if self.slow and self._with_sync().any():  # a node that came back is settling
            self._set_slow(False, now_ns)
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + _LOOK_NS
            self._settle(now_ns)

    def _wake(self, now_ns: int) -> None:
        """Pads that are touched, or event-driven and moved, are wanted at full rate."""
        tick = self._pipeline.tick
        moved = np.abs(tick.counts - self._quiet).max(axis=1) >= self._delta
        active = np.where(tick.synchronous, tick.columns.state == PadState.TOUCHED, moved)
        if active.any():
            self._active_ns[active] = now_ns
            np.copyto(self._quiet, tick.counts, where=active[:, None])
            for slot in np.flatnonzero(active & ~tick.synchronous).tolist():
                self._master.pace(slot, False, now_ns)
            if self.slow:
                self._set_slow(False, now_ns)

    def _settle(self, now_ns: int) -> None:
        master, tick = self._master, self._pipeline.tick
        for slot in np.flatnonzero(self.needed == (master.states == NodeState.STOPPED)).tolist():
            master.rest(slot, not self.needed[slot], now_ns)
        if not self._idles:
            return
        untouched = now_ns - self._active_ns > self._idle_after_ns
        for slot in np.flatnonzero(self.needed & untouched & tick.synchronous).tolist():
            self._quiet[slot] = tick.counts[slot]
            master.pace(slot, True, now_ns)
        for slot in np.flatnonzero(self.needed & ~untouched & ~tick.synchronous).tolist():
            master.pace(slot, False, now_ns)
        waiting = self.needed & ~tick.synchronous & (master.states == NodeState.OPERATIONAL)
        self._set_slow(bool(waiting.any()) and not self._with_sync().any(), now_ns)

    def _with_sync(self) -> NDArray[np.bool_]:
        """Pads whose node is up and samples with SYNC."""
        states = self._master.states
        up = (states >= NodeState.SETTLING) & (states <= NodeState.STALE)
        return np.asarray(self.needed & up & self._pipeline.tick.synchronous)

    def _follow(self, now_ns: int) -> None:
        """Take over what the nodes are made to do; one that is new at full rate gets time to be touched."""
        tick, master = self._pipeline.tick, self._master
        self._paces = master.paces
        self._active_ns[tick.synchronous < ~master.idle] = now_ns
        np.logical_not(master.idle, out=tick.synchronous)
        np.copyto(tick.period_ns, master.period_ns)
        np.copyto(tick.paced_ns, master.paced_ns)

    def _set_slow(self, slow: bool, now_ns: int) -> None:
        if slow != self.slow:
            self.slow = slow
            self._sync.set_period(self._slow_ns if slow else self._full_ns, now_ns)
