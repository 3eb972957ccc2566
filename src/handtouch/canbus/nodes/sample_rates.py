"""Samples per SYNC of each node, which show a babbling one and two devices that send as one.

Time is an argument [ns]. Public names: `SampleRates`, `MAX_EXTRA_SAMPLES_PER_SYNC`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.bus.port import Port
from handtouch.canbus.nodes.lifecycle_types import SampleRate
from handtouch.canbus.nodes.managed_node import ManagedNode
from handtouch.core.slab import Slab

MAX_EXTRA_SAMPLES_PER_SYNC = 2
"""Samples beyond one per SYNC from which a node counts as babbling; duplicated frames cause one at most."""
_MOST_CYCLES = 0.5
"""Part of the cycles with two different samples that is a fault; ones late by a period cause half."""
_FEW_CYCLES = 0.1
"""Part of them below which it has ended: a busy bus or host delays some of the samples."""
_WINDOW_NS = 500_000_000
_CONTRARY_WINDOWS, _LONE_CONTRARY_WINDOWS = 2, 4
"""Windows in a row before two devices are reported. SYNCs of another producer, which have the same effect on
a lone node, are counted once a second."""


@dataclass(slots=True, eq=False)
class _BusNodes:
    """Nodes of a bus; `alone`: one, whose SYNC is produced here. `other_syncs`: those counted before."""

    port: Port
    nodes: list[ManagedNode]
    slots: NDArray[np.int64]
    alone: bool
    other_syncs: int = 0


class SampleRates:
    """Detects nodes that send far more than one sample per SYNC, or different ones.

    Extra SYNCs, or SYNCs of another producer at any rate, show in most nodes of a bus and are subtracted.
    """

    def __init__(
        self, slab: Slab, ports: Mapping[str, Port], nodes: Sequence[ManagedNode], sync_period_ns: int
    ) -> None:
        self._slab, self._sync_period_ns = slab, sync_period_ns
        self._since_ns, self._counts = 0, self._read_counts()
        self._contrary_windows = np.zeros(slab.size, dtype=np.int64)
        self._reported: set[int] = set()
        self._buses = [
            _BusNodes(
                port,
                own,
                np.array([node.spec.slot for node in own]),
                len(own) == 1 and port.bus.sync == "producer",
            )
            for port in ports.values()
            if (own := [node for node in nodes if node.port is port])
        ]

    def check(self, now_ns: int) -> dict[int, SampleRate]:
        """Return the samples per SYNC of the slots that send more than their own, 0 for those that have
        ceased to.

        Empty until a window of half a second has passed, and without a SYNC period.
        """
        if now_ns - self._since_ns < _WINDOW_NS or not self._sync_period_ns:
            return {}
        counts = self._read_counts()
        extra, contrary = counts - self._counts
        periods = max((now_ns - self._since_ns) / self._sync_period_ns, 1.0)
        self._since_ns, self._counts = now_ns, counts
        found: dict[int, SampleRate] = {}
        for bus in self._buses:
            babbling = _beyond_others(extra, bus) > MAX_EXTRA_SAMPLES_PER_SYNC * periods
            two = self._are_contrary(_beyond_others(contrary, bus) / periods, bus)
            for slot in bus.slots[babbling | two].tolist():
                is_contrary = slot not in bus.slots[babbling]
                found[slot] = SampleRate(1 + round(extra[slot] / periods), is_contrary)
        ceased = self._reported - found.keys()
        self._reported = set(found)
        return found | dict.fromkeys(ceased, SampleRate(0))

    def _read_counts(self) -> NDArray[np.int64]:
        return np.stack((self._slab.repeat_counts, self._slab.contrary_counts))

    def _are_contrary(self, fractions: NDArray[np.float64], bus: _BusNodes) -> NDArray[np.bool_]:
        """Return which nodes of a bus had different samples for long enough; fractions: of the cycles in this
        window."""
        needed = _LONE_CONTRARY_WINDOWS if bus.alone else _CONTRARY_WINDOWS
        before = self._contrary_windows[bus.slots]
        contrary = fractions > np.where(before >= needed, _FEW_CYCLES, _MOST_CYCLES)
        has_other_producer = bus.port.other_syncs > bus.other_syncs
        bus.other_syncs = bus.port.other_syncs
        synchronous = [not (node.idle or node.transmission_pending or node.event_timed) for node in bus.nodes]
        counted = contrary & synchronous & (not (bus.alone and has_other_producer))
        windows = np.where(counted, before + 1, 0)
        self._contrary_windows[bus.slots] = windows
        return windows >= needed


def _beyond_others(counts: NDArray[np.int64], bus: _BusNodes) -> NDArray[np.int64]:
    """Return the counts of a bus's slots beyond what is common to them."""
    own = counts[bus.slots]
    return own if bus.alone else own - np.sort(own)[(len(own) - 1) // 2]
