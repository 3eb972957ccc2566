"""One node under test: commands to it, and a record of everything that it sends.

Public names: `NodeLink`, `Heartbeat`, `SyncCycle`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from handtouch.canbus import cia301
from handtouch.canbus.objects.emergency import decode_emergency
from handtouch.canbus.objects.sdo import SDO_TIMEOUT_S
from handtouch.procedures.conformance.direct_sdo import DirectSdoClient
from handtouch.procedures.conformance.line import Line
from handtouch.wire.health import Emergency

MS = 1_000_000
_STRAY_WAIT_NS = 5 * MS
"""Time after a response in which a second one to the same request is recognised."""
_PROBE_NS = 100 * MS
_LATE_NS = 100 * MS
"""Time for TPDOs that a node sends late, after the last SYNC."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A frame with the heartbeat's identifier."""

    arrival_ns: int
    data: bytes

    @property
    def state(self) -> int:
        """NMT state without the toggle bit of node guarding; -1 for a malformed frame."""
        return self.data[0] & 0x7F if len(self.data) == 1 else -1


@dataclass(slots=True)
class SyncCycle:
    """A SYNC and the TPDOs that arrived before the next one: (COB-ID, data, arrival)."""

    sync_ns: int
    pdos: list[tuple[int, bytes, int]] = field(default_factory=list)


class NodeLink:
    """A node under test on a line.

    `heartbeats`, `boot_ups` (arrivals), `emergencies`, `malformed_emergencies`, `pdos` : frames received
    `pdo_ids` : COB-IDs that are recorded in `pdos`
    `commanded_boots` : boot-ups that were caused on purpose
    `stray_responses` : SDO responses without a request
    `other_nodes` : ids of other nodes that sent a heartbeat or an SDO response
    `foreign` : identifiers of frames that only another master sends
    """

    def __init__(self, line: Line, node_id: int) -> None:
        self.node_id = node_id
        self.heartbeats: list[Heartbeat] = []
        self.boot_ups: list[int] = []
        self.commanded_boots = 0
        self.emergencies: list[Emergency] = []
        self.malformed_emergencies = 0
        self.pdos: list[tuple[int, bytes, int]] = []
        self.pdo_ids: set[int] = set()
        self.stray_responses = 0
        self.slowest_sdo_ns = 0
        self.foreign: set[int] = set()
        self.other_nodes: set[int] = set()
        self.client = DirectSdoClient(self.exchange_sdo)
        self._line = line
        self._responses: deque[bytes] = deque()
        self._lss_responses: deque[bytes] = deque()
        self._exchange_end_ns = 0

    def now_ns(self) -> int:
        """Return the present time."""
        return self._line.now_ns()

    def wait(self, duration_ns: int, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive for that long, or until a condition is met; return True if it was."""
        end_ns = self.now_ns() + duration_ns
        while not until():
            frame = self._line.receive(end_ns)
            if frame is None:
                return until()
            self._record(*frame)
            if frame[2] > end_ns:  # a flood of frames must not delay the end
                return until()
        return True

    def send_nmt(self, command: int, node_id: int | None = None) -> int:
        """Send an NMT command, by default to this node; return the time."""
        sent_ns = self.now_ns()
        self._line.send(cia301.NMT, bytes((command, self.node_id if node_id is None else node_id)))
        return sent_ns

    def send_guard_request(self) -> None:
        """Send a node guarding request."""
        self._line.send(cia301.NMT_ERROR_CONTROL + self.node_id, b"\0", remote=True)

    def reset(self, command: int, timeout_ns: int) -> bool:
        """Reset the node; return True if its boot-up message came in time."""
        before = len(self.boot_ups)
        self.commanded_boots += 1
        self.send_nmt(command)
        booted = self.wait(timeout_ns, lambda: len(self.boot_ups) > before)
        if not booted:
            self.commanded_boots -= 1
        return booted

    def wait_for_state(self, since_ns: int, state: int, timeout_ns: int) -> int | None:
        """Wait for a heartbeat with a state; return the last state received since then, None without any."""

        def latest() -> int | None:
            beats = [
                beat for beat in self.heartbeats[-8:] if beat.arrival_ns >= since_ns and beat.data != b"\0"
            ]
            return beats[-1].state if beats else None

        self.wait(timeout_ns, lambda: latest() == state)
        return latest()

    def exchange_sdo(self, request: bytes) -> bytes | None:
        """Send an SDO request; return the response, None without one."""
        self._drain()
        self._responses.clear()
        sent_ns = self.now_ns()
        self._line.send(cia301.SDO_REQUEST + self.node_id, request)
        if request[0] == 0x80:
            return None  # an abort has no response
        if not self.wait(round(SDO_TIMEOUT_S * 1e9), lambda: bool(self._responses)):
            return None
        response = self._responses.popleft()
        self._exchange_end_ns = self.now_ns()
        self.slowest_sdo_ns = max(self.slowest_sdo_ns, self._exchange_end_ns - sent_ns)
        return response

    def exchange_lss(self, request: bytes | None, timeout_s: float) -> bytes | None:
        """Send an LSS request, None for none; return the response, None without one."""
        if request is not None:
            self._drain()
            self._lss_responses.clear()
            self._line.send(cia301.LSS_REQUEST, request)
        self.wait(round(timeout_s * 1e9), lambda: bool(self._lss_responses))
        return self._lss_responses.popleft() if self._lss_responses else None

    def find_unused_id(self) -> int:
        """Return the highest node id that no node responds to."""
        for node_id in range(127, 0, -1):
            if node_id != self.node_id:
                self._line.send(cia301.SDO_REQUEST + node_id, cia301.DEVICE_TYPE_REQUEST)
                self.wait(_PROBE_NS, lambda node_id=node_id: node_id in self.other_nodes)  # type: ignore[misc]
                if node_id not in self.other_nodes:
                    return node_id
        raise ValueError("all 127 node ids are in use")

    def answers_sdo(self, timeout_ns: int) -> bool:
        """Request the device type once; return True if there is any response."""
        self._drain()
        self._responses.clear()
        self._line.send(cia301.SDO_REQUEST + self.node_id, cia301.DEVICE_TYPE_REQUEST)
        answered = self.wait(timeout_ns, lambda: bool(self._responses))
        self._responses.clear()
        return answered

    def settle(self) -> None:
        """Wait for second responses to the last request."""
        self.wait(_STRAY_WAIT_NS)
        self._drain()

    def send_syncs(self, period_ns: int, count: int) -> list[SyncCycle]:
        """Send SYNCs with a period and return what followed each; TPDOs after the last one belong to it.

        A SYNC that this computer sends late is followed by at least half a period.
        """
        cycles = []
        due_ns = self.now_ns()
        for _ in range(count):
            self.wait(max(0, due_ns - self.now_ns()))
            self.pdos.clear()
            cycle = SyncCycle(self.now_ns())
            self._line.send(cia301.SYNC)
            due_ns = max(due_ns, cycle.sync_ns - period_ns // 2) + period_ns
            self.wait(due_ns - self.now_ns())
            cycle.pdos += self.pdos
            cycles.append(cycle)
        self.pdos.clear()
        self.wait(_LATE_NS)
        cycles[-1].pdos += self.pdos
        self.pdos.clear()
        return cycles

    def _drain(self) -> None:
        """Record the frames that have arrived; SDO responses among them have no request."""
        self.wait(0)
        self.stray_responses += len(self._responses)
        self._responses.clear()

    def _record(self, can_id: int, data: bytes, arrival_ns: int) -> None:
        if can_id in self.pdo_ids:
            self.pdos.append((can_id, data, arrival_ns))
        elif can_id == cia301.SDO_RESPONSE + self.node_id:
            self._responses.append(data)
        elif can_id == cia301.NMT_ERROR_CONTROL + self.node_id:
            self.heartbeats.append(Heartbeat(arrival_ns, data))
            if data == b"\0":
                self.boot_ups.append(arrival_ns)
        elif can_id == cia301.EMCY + self.node_id:
            emergency = decode_emergency(data, arrival_ns)
            if emergency is None:
                self.malformed_emergencies += 1
            else:
                self.emergencies.append(emergency)
        elif can_id == cia301.LSS_RESPONSE:
            self._lss_responses.append(data)
        elif can_id & 0x780 in (cia301.SDO_RESPONSE, cia301.NMT_ERROR_CONTROL):
            self.other_nodes.add(can_id & 0x7F)
        elif is_from_master(can_id) and not self._line.echoes:
            self.foreign.add(can_id)


def is_from_master(can_id: int) -> bool:
    """Return True for identifiers that only a master sends: NMT, SYNC, SDO and LSS requests."""
    return can_id in (cia301.NMT, cia301.SYNC, cia301.LSS_REQUEST) or 0x600 < can_id < 0x680
