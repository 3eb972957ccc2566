"""What a scene doesn't need isn't done: pads outside it rest, untouched ones send when something moves.

Public names: `Pacer`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.nodes.life import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.config import Deployment
from handtouch.config.tables import Scene
from handtouch.daemon.pipeline import Pipeline
from handtouch.wire import PadState

_LOOK_NS = 100_000_000  # between two looks at what may rest; waking doesn't wait for it


class Beat(Protocol):
    """What sets the period of SYNC: `canbus.bus.sync.Sync`."""

    def set_period(self, period_ns: int, now_ns: int) -> None: ...


class Pacer:
    """Sets the pace of nodes and SYNC; `step` it after every tick. Times in ns.

    `needed` (n,) are the pads in the scene, `kept` (n,) those of them that follow SYNC also while untouched;
    `slow`: every one of them waits for something to move, so SYNC is slow and a sample that comes is worth a
    tick of its own.
    """

    def __init__(
        self,
        deployment: Deployment,
        needed: NDArray[np.bool_],
        pipeline: Pipeline,
        master: Master,
        sync: Beat,
    ) -> None:
        pads = [pad for hand in deployment.hands for pad in hand.pads]
        kinds = [deployment.nodes[pad.node] for pad in pads]
        self.needed: NDArray[np.bool_] = needed.copy()
        self.kept = np.zeros(len(pads), dtype=np.bool_)
        self.slow = False
        self._pipeline, self._master, self._sync = pipeline, master, sync
        self._delta = np.array([kind.idle.delta_counts if kind.idle else 0 for kind in kinds])
        self._idles = bool((self._delta > 0).any())
        self._full_ns = round(deployment.daemon.sync_period_ms * 1e6)
        self.set_idle(deployment.scene)
        self._active_ns = np.zeros(len(pads), dtype=np.int64)
        self._quiet = np.zeros((len(pads), 4), dtype=np.int64)  # counts of event-driven pads when last seen
        self._look_ns = 0
        self._paces = 0

    def set_idle(self, scene: Scene) -> None:
        """Other times after which pads are idle, and of SYNC then."""
        self._idle_after_ns = round(scene.idle_after_s * 1e9)
        self._slow_ns = max(round(scene.idle_sync_period_ms * 1e6), self._full_ns)

    def set_needs(self, needed: NDArray[np.bool_], kept: NDArray[np.bool_], now_ns: int) -> None:
        """Other pads are needed, and kept at full rate, from now on, (n,)."""
        self._active_ns[needed & ~self.needed] = now_ns
        self.needed, self.kept = needed.copy(), kept.copy()
        self._look_ns = 0

    def attend(self, pads: NDArray[np.bool_], now_ns: int) -> None:
        """Sample these pads (n,) with SYNC, as if something had moved."""
        self._active_ns[pads] = now_ns
        if (pads & ~self._pipeline.tick.synchronous).any():
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
        waiting = self.needed & ~tick.synchronous & (master.states == NodeState.OPERATIONAL)
        if self._idles:
            self._let_idle(now_ns)
        rests = bool(waiting.any()) or not self.needed.any()
        # one that is just being woken has yet to say that it follows SYNC
        woken = waiting & (now_ns - self._active_ns <= self._idle_after_ns)
        self._set_slow(rests and not (woken | self._with_sync()).any(), now_ns)

    def _let_idle(self, now_ns: int) -> None:
        """Pads untouched for long enough become event-driven, others follow SYNC."""
        master, tick = self._master, self._pipeline.tick
        self._active_ns[self.kept] = now_ns
        untouched = now_ns - self._active_ns > self._idle_after_ns
        for slot in np.flatnonzero(self.needed & untouched & tick.synchronous).tolist():
            self._quiet[slot] = tick.counts[slot]
            master.pace(slot, True, now_ns)
        for slot in np.flatnonzero(self.needed & ~untouched & ~tick.synchronous).tolist():
            master.pace(slot, False, now_ns)

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
