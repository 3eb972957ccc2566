"""Causes in the host or the bus for samples and heartbeats that are late from several nodes at once.

Public name: `BusCauses`. Time is an argument [ns].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.bus.port import Port
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.managed_node import ManagedNode

_MISSED_SYNC_PERIODS = 2
"""SYNC periods without a sample of any pad, or without a SYNC, that exclude a cause in one node."""
_TOGETHER_HEARTBEATS = 1.5
"""Heartbeat periods within which nodes fall silent for a common cause."""
_MIN_PAUSE_PART = 0.5
"""Part of a silence that the loop's pause must have to be its cause."""
_HOST_REMEDY = "reduce the host's load, or run handtouch with real-time priority"
_BUS_REMEDY = "check the host's load, then this bus's cable, termination, bit rate and adapter"
_SIMULATED_REMEDY = "check that the nodes' programs run, and the host's load"
"""For a bus without cables"""


class BusCauses:
    """Finds the cause of silence that isn't one node's own; every method returns "" if there is none."""

    def __init__(self, ports: Mapping[str, Port], nodes: Sequence[ManagedNode], sync_period_ns: int) -> None:
        self._nodes = {name: [node for node in nodes if node.port is port] for name, port in ports.items()}
        self._slots = {name: np.array([n.spec.slot for n in own]) for name, own in self._nodes.items()}
        self._sync_period_ns = sync_period_ns
        self._pause_end_ns = self._pause_ns = 0

    def record_pause(self, pause_ns: int, now_ns: int) -> None:
        """Record a pause of the receiving loop that ends now."""
        self._pause_end_ns, self._pause_ns = now_ns, pause_ns

    def of_missing_samples(
        self, node: ManagedNode, states: NDArray[np.uint8], ages_ns: NDArray[np.int64], now_ns: int
    ) -> str:
        """Return why a node's samples are missing; `states` and `ages_ns` (slots,) of all samples."""
        port, slots = node.port, self._slots[node.port.name]
        limit_ns = _MISSED_SYNC_PERIODS * self._sync_period_ns
        started = slots[(states[slots] == NodeState.OPERATIONAL) | (states[slots] == NodeState.STALE)]
        together = len(started) > 1 and int(ages_ns[started].min()) > limit_ns
        late = self._describe_pause(int(ages_ns[node.spec.slot]), now_ns) if together else ""
        if late and not port.problem:
            return f"as from every pad of bus {port.name}: {late}"
        return self._describe_bus(port, now_ns) or (
            f"as from every pad of bus {port.name}; {_remedy(port)}" if together else ""
        )

    def of_timeout(self, node: ManagedNode, now_ns: int) -> str:
        """Return why a node's first samples or its heartbeats are missing."""
        port, last_ns = node.port, node.lifecycle.last_frame_ns
        if port.problem or node.lifecycle.state is NodeState.SETTLING:
            return self._describe_bus(port, now_ns)
        others = [n.lifecycle.last_frame_ns for n in self._nodes[port.name] if n is not node]
        heard = [frame_ns for frame_ns in others if frame_ns is not None]
        slots = self._slots[port.name]
        newest_ns = max([int(port.slab.arrival_ns[slots].max()), *heard])
        limit_ns = _TOGETHER_HEARTBEATS * node.timing.heartbeat_period_ns
        if last_ns is None or newest_ns - last_ns > limit_ns:
            return ""
        if not any(last_ns - frame_ns <= limit_ns for frame_ns in heard):
            return ""
        late = self._describe_pause(now_ns - last_ns, now_ns)
        return f"as from every node of bus {port.name}" + (f": {late}" if late else f"; {_remedy(port)}")

    def _describe_bus(self, port: Port, now_ns: int) -> str:
        """Describe a problem of the bus, or a missing SYNC."""
        if port.problem:
            return f"bus {port.name}: {port.problem}"
        silent_ns = now_ns - port.last_sync_ns
        if not self._sync_period_ns or silent_ns <= _MISSED_SYNC_PERIODS * self._sync_period_ns:
            return ""
        since = f" for {silent_ns / 1e6:.0f} ms" if port.last_sync_ns else " yet"
        cable = "" if port.bus.is_cableless else " and cable"
        return f"no SYNC on bus {port.name}{since}; check its SYNC producer{cable}"

    def _describe_pause(self, silent_ns: int, now_ns: int) -> str:
        """Describe the loop's last pause if it ended within the silence and was a main part of it."""
        ended_within = now_ns - self._pause_end_ns <= silent_ns
        if not ended_within or self._pause_ns < _MIN_PAUSE_PART * silent_ns:
            return ""
        return f"the loop was late by {self._pause_ns / 1e6:.0f} ms; {_HOST_REMEDY}"


def _remedy(port: Port) -> str:
    return _SIMULATED_REMEDY if port.bus.is_cableless else _BUS_REMEDY
