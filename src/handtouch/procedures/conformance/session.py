"""The test of one node: what is tested, with which options, and restoring what it changes.

Public names: `NodeUnderTest`, `ConformanceOptions`, `NodeSession`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from handtouch.canbus import cia301
from handtouch.canbus.nodes.spec import NodeSpec
from handtouch.canbus.objects.mapping import DEFAULT_TPDO_NUMBERS, PdoMapping
from handtouch.canbus.objects.sdo import SDO_TIMEOUT_S, BootStepError, NodeSdoClient
from handtouch.procedures.conformance.node_link import MS, NodeLink
from handtouch.procedures.conformance.results import NodeReport
from handtouch.procedures.dialogue import Dialogue

BOOT_TIMEOUT_NS = 3000 * MS
_SETTLE_NS = 50 * MS
"""Time in which a node without heartbeat follows an NMT command."""
_GUARD_TIMEOUT_NS = 100 * MS
_HEARTBEAT_WAIT_NS = 1100 * MS


@dataclass(frozen=True, slots=True)
class NodeUnderTest(NodeSpec):
    """A node to test; without `name` where there is no deployment. `noise_counts`: expected noise of a
    channel."""

    slot: int = field(default=0, kw_only=True)
    name: str = field(default="", kw_only=True)
    tpdo_numbers: tuple[int, ...] = DEFAULT_TPDO_NUMBERS
    noise_counts: float | None = None


@dataclass(frozen=True, slots=True)
class ConformanceOptions:
    """Options of the procedure.

    `sync_period_ms`: shortest period of SYNC, also tested at two and four times that; `window_fraction`:
    part of it in which TPDOs must arrive; `resets`, `lss`: False leaves NMT resets or LSS out.
    """

    sync_period_ms: float = 5.0
    window_fraction: float = 0.6
    syncs: int = 100
    resets: bool = True
    lss: bool = True
    operator_timeout_s: float = 60.0


class RestoringSdoClient(NodeSdoClient):
    """SDO client that remembers the value that an object had before it was first written."""

    def __init__(self, transport: object) -> None:
        super().__init__(transport)  # type: ignore[arg-type]
        self.originals: dict[tuple[int, int], tuple[int, int | None]] = {}
        """value and size, None for objects of CiA 301"""

    def write_verified(self, index: int, sub: int, value: int, name: str, size: int | None = None) -> None:
        """Write an object and read it back."""
        if (index, sub) not in self.originals:
            self.originals[index, sub] = (self.read(index, sub, name), size)
        super().write_verified(index, sub, value, name, size)


class NodeSession:
    """State shared by the checks of one node. `mapping` is set once the PDO checks have found it."""

    def __init__(
        self,
        link: NodeLink,
        node: NodeUnderTest,
        options: ConformanceOptions,
        progress: Callable[[str], None],
        operator: Dialogue | None,
    ) -> None:
        self.link, self.node, self.options, self.operator = link, node, options, operator
        self.progress = progress
        self.sdo = RestoringSdoClient(link.client)
        self.report = NodeReport(node.bus, node.node_id, node.name)
        self.mapping: PdoMapping | None = None
        self.has_heartbeat = self.is_guarded = False
        self._initial_state: int | None = None

    @property
    def shows_state(self) -> bool:
        """True if the node's NMT state can be observed."""
        return self.has_heartbeat or self.is_guarded

    def enter(self, command: int, state: int) -> int | None:
        """Send an NMT command; return the NMT state that the node then reports, None if it reports none."""
        sent_ns = self.link.send_nmt(command)
        if not self.has_heartbeat:
            self.link.wait(_SETTLE_NS)
        return self.observe_state(sent_ns + MS // 10, state)

    def observe_state(self, since_ns: int, expected: int) -> int | None:
        """Wait for an NMT state by heartbeat or guarding; return the latest one since then, None for none."""
        if self.is_guarded:
            self.link.send_guard_request()
            return self.link.wait_for_state(since_ns, expected, _GUARD_TIMEOUT_NS)
        if not self.has_heartbeat:
            return None
        return self.link.wait_for_state(since_ns, expected, (4 * self.node.heartbeat_ms + 200) * MS)

    def enter_preoperational(self) -> None:
        """Put the node in pre-operational, in which it can be configured."""
        self.enter(cia301.ENTER_PREOPERATIONAL, cia301.PREOPERATIONAL)

    def leave_stopped(self) -> None:
        """Make a silent node pre-operational if it is stopped, in which it serves no SDO; `restore` stops it.

        A node whose heartbeat reports another state is left in it.
        """
        heartbeats = self.link.heartbeats
        self.link.wait(_HEARTBEAT_WAIT_NS, lambda: bool(heartbeats))
        if heartbeats and heartbeats[-1].state != cia301.STOPPED:
            return
        self.link.send_nmt(cia301.ENTER_PREOPERATIONAL)
        if self.link.answers_sdo(round(SDO_TIMEOUT_S * 1e9)):
            self._initial_state = cia301.STOPPED

    def start_heartbeat(self) -> None:
        """Have the node send heartbeats, from which its initial NMT state is known."""
        try:
            self.sdo.write_verified(
                cia301.HEARTBEAT_TIME, 0, self.node.heartbeat_ms, "producer heartbeat time"
            )
        except BootStepError:
            self.has_heartbeat = False
            return
        before = len(self.link.heartbeats)
        self.link.wait((4 * self.node.heartbeat_ms + 200) * MS, lambda: len(self.link.heartbeats) > before)
        self.has_heartbeat = len(self.link.heartbeats) > before
        if self.has_heartbeat and self._initial_state is None:
            self._initial_state = self.link.heartbeats[-1].state

    def restore(self) -> str:
        """Set back everything that was written, and the NMT state; return the problem, empty without any.

        A node without heartbeat is left in pre-operational.
        """
        if not self.sdo.originals:
            return ""
        self.enter_preoperational()
        try:
            self._restore_objects()
        except BootStepError as error:
            return str(error)
        final = {cia301.OPERATIONAL: cia301.START_NODE, cia301.STOPPED: cia301.STOP_NODE}
        if self._initial_state in final:
            self.link.send_nmt(final[self._initial_state])
        return ""

    def _restore_objects(self) -> None:
        """Write the original values; parameters of a PDO while it is disabled."""
        originals = dict(self.sdo.originals)
        cob_ids = {
            address: value
            for address, (value, _) in originals.items()
            if 0 <= address[0] - cia301.TPDO_COMMUNICATION < cia301.MAX_TPDOS and address[1] == 1
        }
        heartbeat = originals.pop((cia301.HEARTBEAT_TIME, 0), None)
        pdo_range = range(cia301.TPDO_COMMUNICATION, cia301.TPDO_MAPPING + cia301.MAX_TPDOS)
        changed = {
            address: value
            for address, value in originals.items()
            if address not in cob_ids and self.sdo.read(*address, "a setting") != value[0]
        }
        if any(index in pdo_range for index, _ in changed):
            for (index, sub), cob_id in cob_ids.items():
                self.sdo.write_if_different(index, sub, cob_id | cia301.INVALID_BIT, "COB-ID")
        for index, sub in changed:
            if index >= cia301.TPDO_MAPPING and index in pdo_range and sub:
                self.sdo.write_if_different(index, 0, 0, "number of mapped objects")
        for (index, sub), (value, size) in sorted(changed.items(), key=lambda item: not item[0][1]):
            self.sdo.write_if_different(index, sub, value, "a setting", size)  # sub 0 comes last
        for (index, sub), cob_id in cob_ids.items():
            self.sdo.write_if_different(index, sub, cob_id, "COB-ID")
        if heartbeat is not None:
            self.sdo.write_if_different(cia301.HEARTBEAT_TIME, 0, heartbeat[0], "producer heartbeat time")
