"""Verdicts of soak_peers.py: which events of nodes break a promise, and which had no processor time.

In the guest an event is excused only if the nodes' process didn't run just before, by the kernel's stamps of
its frames, and the reason names the host, the bus, or silence without a cause.
Public names: `Verdicts`, `Starvation`.
"""

from __future__ import annotations

import os
import platform
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from typing import Any

import can

from handtouch.canbus.bus.receivers import grow_receive_buffer

ACCUSED = ("absent", "faulted")
COMMON_CAUSE = re.compile(
    "as from every|no SYNC on bus|bus can|no answer within|are being checked|settings can't be read"
)
"""Reasons that name the host or the bus, report silence without a cause, or wait for a check."""
MISSED_PERIODS, RECENT_S = 2.5, 2.0
SAMPLE_BYTES = 8


class Starvation(threading.Thread):
    """Times at which most nodes of vcan0 sent no sample, by the kernel's stamps: their process didn't run."""

    def __init__(self, ids: Sequence[int], period_s: float) -> None:
        super().__init__(daemon=True)
        self._limit_s = MISSED_PERIODS * period_s
        filters = [{"can_id": 0x280, "can_mask": 0x780}]
        self._bus = can.Bus(interface="socketcan", channel="vcan0", can_filters=filters)
        grow_receive_buffer(self._bus.socket)  # type: ignore[attr-defined]
        now_s = time.time()
        self._newest_s = dict.fromkeys(ids, now_s)
        self._gaps: deque[tuple[float, float, int]] = deque(maxlen=100_000)  # from, to, node id
        self._ended = threading.Event()

    def run(self) -> None:
        while not self._ended.is_set():
            try:
                message = self._bus.recv(0.1)
            except can.CanOperationError:  # the interface is down
                self._ended.wait(0.05)
                continue
            node_id = message.arbitration_id & 0x7F if message is not None else 0
            if message is None or node_id not in self._newest_s or message.dlc != SAMPLE_BYTES:
                continue
            before_s, self._newest_s[node_id] = self._newest_s[node_id], message.timestamp
            if message.timestamp - before_s > self._limit_s:
                self._gaps.append((before_s, message.timestamp, node_id))

    def was_recent(self, t_s: float) -> bool:
        """Return True if most nodes had a gap in the last seconds before a time (`time.time`)."""
        silent = {
            node for since_s, to_s, node in list(self._gaps) if since_s <= t_s and to_s >= t_s - RECENT_S
        }
        silent |= {node for node, newest_s in self._newest_s.items() if t_s - newest_s > self._limit_s}
        return 2 * len(silent) > len(self._newest_s)

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self.join()
        self._bus.shutdown()


class Verdicts:
    """Counts acts and node events, and keeps what must not happen."""

    def __init__(self) -> None:
        self.starved: Counter[str] = Counter()  # events of nodes without processor time, by act
        self.acts: Counter[str] = Counter()
        self.left: Counter[str] = Counter()  # nodes that left OPERATIONAL, by act
        self.broken: list[str] = []

    def judge(self, act: str, node: str, old: str, new: str, reason: str, was_starved: bool = False) -> None:
        """Judge a node's event during an act or its recovery."""
        left = old == "operational" != new
        self.left[act] += left
        if act == "down" and (new == "absent" or old == "absent") and "bus can" in reason:
            return
        if new in ACCUSED or (act not in ("nmt", "gateway", "down") and (left or new == "stale")):
            self.record(act, f"{node}: {old} -> {new}: {reason}", was_starved and COMMON_CAUSE.search(reason))

    def record(self, act: str, what: str, excused: object) -> None:
        """Record what may happen only for want of processor time."""
        if excused:
            self.starved[act] += 1
        else:
            self.broken.append(f"{act}: {what}")

    def figures(self, length: str, seconds: float) -> dict[str, Any]:
        """Return the figures of a run."""
        return {
            "length": length,
            "seconds": round(seconds),
            "acts": dict(self.acts),
            "left_operational": dict(self.left),
            "starved": dict(self.starved),
            "broken": self.broken[:20],
            "machine": f"{os.environ.get('VCAN_RUN', 'host')}, {platform.machine()}, {os.cpu_count()} cores",
        }
