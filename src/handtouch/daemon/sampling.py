"""Sampling modes: pads outside the scenes are stopped, untouched ones transmit on change only.

Public names: `SamplingController`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.bus.sync import Sync
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.config import Deployment
from handtouch.config.tables import Scene
from handtouch.core.events import SamplingEvent
from handtouch.core.pipeline import Pipeline
from handtouch.wire import PadState

_IDLE_CHECK_PERIOD_NS = 100_000_000  # wake-up is checked at every tick


class SamplingController:
    """Sets transmission modes of nodes and the SYNC period; call `update_sampling` after every tick.

    `needed` (n,) are the pads in a scene, `full_rate` (n,) those of them that follow SYNC even while
    untouched. `slow_sync`: all needed pads transmit on change, so SYNC is slow and each sample gets a tick
    of its own. Times in ns.
    """

    def __init__(
        self,
        deployment: Deployment,
        needed: NDArray[np.bool_],
        pipeline: Pipeline,
        master: Master,
        sync: Sync,
    ) -> None:
        pads = [entry.pad for entry in deployment.pads]
        kinds = [deployment.nodes[pad.node] for pad in pads]
        self.needed: NDArray[np.bool_] = needed.copy()
        self.full_rate = np.zeros(len(pads), dtype=np.bool_)
        self.slow_sync = False
        self._pipeline, self._master, self._sync = pipeline, master, sync
        self._delta_counts = np.array([kind.idle.delta_counts if kind.idle else 0 for kind in kinds])
        self._can_idle = bool((self._delta_counts > 0).any())
        self._full_rate_period_ns = round(deployment.daemon.sync_period_ms * 1e6)
        self.set_idle_settings(deployment.scene)
        self._last_active_ns = np.zeros(len(pads), dtype=np.int64)
        # counts of event-driven pads when they were last active
        self._idle_counts = np.zeros_like(pipeline.tick.counts)
        self._next_idle_check_ns = 0
        self._sampling_changes = 0
        self._synchronous = np.ones(len(pads), dtype=np.bool_)  # as the tick has it, or will have
        self._transmission_since_ns = np.zeros(len(pads), dtype=np.int64)  # as reported to it

    def set_idle_settings(self, scene: Scene) -> None:
        """Apply the scene table's idle time and idle SYNC period."""
        self._idle_after_ns = round(scene.idle_after_s * 1e9)
        self._idle_period_ns = max(round(scene.idle_sync_period_ms * 1e6), self._full_rate_period_ns)

    def set_needed_pads(self, needed: NDArray[np.bool_], full_rate: NDArray[np.bool_], now_ns: int) -> None:
        """Set the pads (n,) that are needed, and those kept at full rate."""
        self._last_active_ns[needed & ~self.needed] = now_ns
        self.needed, self.full_rate = needed.copy(), full_rate.copy()
        self._next_idle_check_ns = 0

    def request_full_rate(self, pads: NDArray[np.bool_], now_ns: int) -> None:
        """Sample these pads (n,) at every SYNC, as if they had been touched."""
        self._last_active_ns[pads] = now_ns
        if (pads & ~self._synchronous).any():
            self._next_idle_check_ns = 0

    def update_sampling(self, now_ns: int) -> None:
        """Switch active pads to full rate at once, and idle ones to transmission on change every 100 ms."""
        if self._can_idle:
            self._wake_active_pads(now_ns)
        if self._master.transmission_changes != self._sampling_changes:
            self._copy_node_modes(now_ns)
        if self.slow_sync and self._sync_driven_pads().any():  # a node that restarted is settling
            self._set_slow_sync(False, now_ns)
        if now_ns >= self._next_idle_check_ns:
            self._next_idle_check_ns = now_ns + _IDLE_CHECK_PERIOD_NS
            self._update_node_modes(now_ns)

    def _wake_active_pads(self, now_ns: int) -> None:
        """Switch pads to full rate that are touched, or event-driven with changed counts."""
        tick = self._pipeline.tick
        moved = np.abs(tick.counts - self._idle_counts).max(axis=1) >= self._delta_counts
        active = np.where(self._synchronous, tick.columns.state == PadState.TOUCHED, moved)
        if active.any():
            self._last_active_ns[active] = now_ns
            np.copyto(self._idle_counts, tick.counts, where=active[:, None])
            for slot in np.flatnonzero(active & ~self._synchronous).tolist():
                self._master.set_transmission(slot, False, now_ns)
            if self.slow_sync:
                self._set_slow_sync(False, now_ns)

    def _update_node_modes(self, now_ns: int) -> None:
        master = self._master
        for slot in np.flatnonzero(self.needed == (master.states == NodeState.STOPPED)).tolist():
            master.set_standby(slot, not self.needed[slot], now_ns)
        waiting = self.needed & ~self._synchronous & (master.states == NodeState.OPERATIONAL)
        if self._can_idle:
            self._update_idle_pads(now_ns)
        idle = bool(waiting.any()) or not self.needed.any()
        # a node just switched to full rate hasn't confirmed it yet
        woken = waiting & (now_ns - self._last_active_ns <= self._idle_after_ns)
        self._set_slow_sync(idle and not (woken | self._sync_driven_pads()).any(), now_ns)

    def _update_idle_pads(self, now_ns: int) -> None:
        """Make pads event-driven that are untouched for long enough; the others follow SYNC."""
        master, tick = self._master, self._pipeline.tick
        self._last_active_ns[self.full_rate] = now_ns
        untouched = now_ns - self._last_active_ns > self._idle_after_ns
        for slot in np.flatnonzero(self.needed & untouched & self._synchronous).tolist():
            self._idle_counts[slot] = tick.counts[slot]
            master.set_transmission(slot, True, now_ns)
        for slot in np.flatnonzero(self.needed & ~untouched & ~self._synchronous).tolist():
            master.set_transmission(slot, False, now_ns)

    def _sync_driven_pads(self) -> NDArray[np.bool_]:
        """Return the pads (n,) whose node is up and sampled at every SYNC."""
        states = self._master.states
        up = (states >= NodeState.SETTLING) & (states <= NodeState.STALE)
        return np.asarray(self.needed & up & self._synchronous)

    def _copy_node_modes(self, now_ns: int) -> None:
        """Copy the nodes' transmission modes to the tick; a node new at full rate restarts its idle time."""
        master = self._master
        self._sampling_changes = master.transmission_changes
        self._last_active_ns[self._synchronous < ~master.idle] = now_ns
        np.logical_not(master.idle, out=self._synchronous)
        changed = np.flatnonzero(master.transmission_since_ns != self._transmission_since_ns)
        self._transmission_since_ns[:] = master.transmission_since_ns
        self._pipeline.add_event(
            SamplingEvent(
                tuple(self._synchronous.tolist()),
                tuple(master.sample_period_ns.tolist()),
                tuple(changed.tolist()),
            )
        )

    def _set_slow_sync(self, slow: bool, now_ns: int) -> None:
        if slow != self.slow_sync:
            self.slow_sync = slow
            self._sync.set_period(self._idle_period_ns if slow else self._full_rate_period_ns, now_ns)
