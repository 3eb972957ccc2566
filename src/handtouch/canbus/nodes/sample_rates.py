"""Samples per SYNC of each node, which show a babbling one. Time is an argument [ns].

Public names: `SampleRates`, `MAX_EXTRA_SAMPLES_PER_SYNC`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from handtouch.canbus.bus.port import Port
from handtouch.canbus.nodes.managed_node import ManagedNode
from handtouch.core.slab import Slab

MAX_EXTRA_SAMPLES_PER_SYNC = 2
"""Samples beyond one per SYNC from which a node counts as babbling; duplicated frames cause one at most."""
_WINDOW_NS = 500_000_000


class SampleRates:
    """Detects nodes that send far more than one sample per SYNC.

    Extra SYNCs, or SYNCs of another producer at any rate, show in most nodes of a bus and are subtracted.
    """

    def __init__(
        self, slab: Slab, ports: Mapping[str, Port], nodes: Sequence[ManagedNode], sync_period_ns: int
    ) -> None:
        self._slab, self._sync_period_ns = slab, sync_period_ns
        self._since_ns, self._counts = 0, slab.repeat_counts.copy()
        self._babbling: set[int] = set()
        self._slots_by_bus = [  # slots of each bus's nodes, and if its SYNC is produced here
            (np.array(slots), port.bus.sync == "producer")
            for port in ports.values()
            if (slots := [node.spec.slot for node in nodes if node.port is port])
        ]

    def check(self, now_ns: int) -> dict[int, int]:
        """Return the samples per SYNC of the slots that babble, 0 for those that have ceased to.

        Empty until a window of half a second has passed, and without a SYNC period.
        """
        if now_ns - self._since_ns < _WINDOW_NS or not self._sync_period_ns:
            return {}
        counts = self._slab.repeat_counts.copy()
        extra, periods = counts - self._counts, max((now_ns - self._since_ns) / self._sync_period_ns, 1.0)
        self._since_ns, self._counts = now_ns, counts
        babbling: set[int] = set()
        for slots, is_producer in self._slots_by_bus:
            alone = len(slots) == 1 and is_producer
            median = 0 if alone else np.sort(extra[slots])[(len(slots) - 1) // 2]
            babbling.update(slots[extra[slots] - median > MAX_EXTRA_SAMPLES_PER_SYNC * periods].tolist())
        changed = babbling | self._babbling
        self._babbling = babbling
        return {slot: 1 + round(extra[slot] / periods) if slot in babbling else 0 for slot in changed}
