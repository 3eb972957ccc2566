"""Survey of a bus that changes nothing on it: listen, probe every node id, read the nodes found.

Public names: `BusSurvey`, `NodeFacts`, `TpdoFacts`, `find_four_channels`, `find_channels_of_node`.

All ids are probed at once, which takes one timeout in all; the nodes found are then read concurrently, by
threads, while the calling thread receives.
"""

from __future__ import annotations

import select
import struct
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from canopen.sdo import SdoAbortedError

from handtouch.canbus import cia301
from handtouch.canbus.bus.port import Port
from handtouch.canbus.find.traffic import Traffic
from handtouch.canbus.objects.sdo import BootStepError, NodeSdoClient, SdoTransport
from handtouch.config.channels import PROFILE_TYPES

RESPONSE_TIMEOUT_S = 0.2
"""Timeout of a probe."""
READ_TIMEOUT_S = 30.0
"""Timeout for reading all nodes, long enough for the slowest bus."""

MAX_READERS = 16
"""Nodes read at the same time; their frames take 35 ms at 125 kbit/s, far less than a transfer's timeout."""

_DRIVES = 402  # profile of drives and motion control, in the device type
_MAX_MISSING_TPDOS = 4  # consecutive missing TPDOs that end the search
_REQUEST_BITS = 135
_IDENTITY_OBJECTS = frozenset({(cia301.DEVICE_TYPE, 0), *((cia301.IDENTITY, sub) for sub in (1, 2, 3, 4))})
_SDO_FRAME = struct.Struct("<BHB4s")


@dataclass(frozen=True, slots=True)
class TpdoFacts:
    """A node's TPDO: objects 0x1800 + n and 0x1A00 + n; None where the node doesn't have them."""

    number: int
    cob_id: int | None
    enabled: bool
    transmission: int | None
    inhibit_us: int | None
    event_ms: int | None
    mapping: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class NodeFacts:
    """Data read from a node; None where it doesn't have the object.

    `state` : NMT state in its heartbeat, empty without a heartbeat
    `answers` : it responds to SDO requests
    `refused` : identity fields that it refuses to return, with the SDO abort
    `inputs` : number of analogue inputs (0x6401 sub 0)
    `boots` : number of boot-up messages
    `emergency` : text of its latest EMCY message
    `conflict` : evidence that two nodes have this id, empty without one
    `error` : reason why it couldn't be read, empty if it was
    """

    node_id: int
    state: str = ""
    answers: bool = False
    device_type: int | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None
    refused: Mapping[str, str] = field(default_factory=dict)
    name: str = ""
    hardware: str = ""
    software: str = ""
    heartbeat_ms: int | None = None
    tpdos: tuple[TpdoFacts, ...] = ()
    inputs: int | None = None
    boots: int = 0
    emergency: str = ""
    conflict: str = ""
    error: str = ""


class BusSurvey:
    """Survey of one bus, from one thread; only `probe_ids`, `read_nodes` and `exchange_lss` send frames."""

    def __init__(self, port: Port, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.port = port
        self.traffic = Traffic()
        self._clock = clock
        self._identity_values: dict[int, dict[tuple[int, int], set[bytes]]] = {}
        self._responding_ids: set[int] = set()
        self._probed_ids: set[int] = set()
        self._invalid_responses: dict[int, bytes] = {}  # invalid responses of probed nodes
        self._readers: dict[int, SdoTransport] = {}
        self._lss_responses: deque[bytes] = deque()

    def receive(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive for that long, or until a condition is met; return True if it was."""
        end_ns = self._clock() + round(seconds * 1e9)
        while True:
            for frame in self.port.drain():
                self._handle_frame(*frame)
            if until():
                return True
            left_s = (end_ns - self._clock()) * 1e-9
            if left_s <= 0:
                return False
            select.select([self.port.fileno()], [], [], min(left_s, 0.02))

    def probe_ids(self, ids: Iterable[int] = range(1, 128)) -> set[int]:
        """Return the ids that respond to a request for the device type, with its value or an abort.

        Nodes of which other frames were received are probed once more if they don't respond.
        """
        ids = list(ids)
        self._responding_ids -= set(ids)
        self._probed_ids |= set(ids)
        detected = self.traffic.detected_nodes()
        for probed in (ids, [node_id for node_id in ids if node_id in detected]):
            silent = [node_id for node_id in probed if node_id not in self._responding_ids]
            for node_id in silent:
                self.port.send_patiently(cia301.SDO_REQUEST + node_id, cia301.DEVICE_TYPE_REQUEST)
            queued_s = len(silent) * _REQUEST_BITS / self.port.bus.bitrate_bit_s
            if silent:
                self.receive(RESPONSE_TIMEOUT_S + queued_s, lambda: self._responding_ids >= set(ids))
        return self._responding_ids & set(ids)

    def read_nodes(
        self, ids: Collection[int], progress: Callable[[int], None] = lambda _: None
    ) -> list[NodeFacts]:
        """Read the nodes with these ids; `progress` is called with the number read so far."""
        if not ids:
            return []
        self._readers = {node_id: self._transport(node_id) for node_id in ids}
        with ThreadPoolExecutor(MAX_READERS, "sdo") as pool:
            jobs = [
                pool.submit(_read_node, node_id, NodeSdoClient(transport))
                for node_id, transport in self._readers.items()
            ]
            end_ns = self._clock() + round(READ_TIMEOUT_S * 1e9)
            while not self.receive(0.1, lambda: all(job.done() for job in jobs)):
                progress(sum(job.done() for job in jobs))
                if self._clock() > end_ns:
                    self._readers = {}  # a transfer that never ends is cut off here, and times out
        self.receive(0.01)  # for a second node's response to the last request
        self._readers = {}
        return [self._merge_traffic(job.result()) for job in jobs]

    def _transport(self, node_id: int) -> SdoTransport:
        """Return an SDO channel on which what arrived in time counts, however late it is read."""
        port = self.port
        return SdoTransport(node_id, port.send_patiently, received_until_ns=lambda: port.received_until_ns)

    def observed_facts(self, node_id: int) -> NodeFacts:
        """Return what is known of a node that was not probed, or doesn't respond."""
        return self._merge_traffic({"node_id": node_id})

    def exchange_lss(self, request: bytes | None, timeout_s: float) -> bytes | None:
        """Send an LSS request and wait for the response; the `Exchange` of an `LssMaster`."""
        if request is not None:
            self.receive(0.0)
            self._lss_responses.clear()
            self.port.send_patiently(cia301.LSS_REQUEST, request)
        self.receive(timeout_s, lambda: bool(self._lss_responses))
        return self._lss_responses.popleft() if self._lss_responses else None

    def _handle_frame(self, can_id: int, data: bytes, arrival_ns: int) -> None:
        self.traffic.handle_frame(can_id, data, arrival_ns)
        if can_id == cia301.LSS_RESPONSE:
            self._lss_responses.append(data)
        elif cia301.SDO_RESPONSE < can_id < cia301.SDO_REQUEST:
            self._handle_sdo_response(can_id - cia301.SDO_RESPONSE, data)

    def _handle_sdo_response(self, node_id: int, data: bytes) -> None:
        if node_id in self._probed_ids:
            self._invalid_responses[node_id] = data  # unless a valid one comes
        reader = self._readers.get(node_id)
        if reader is not None and reader.awaiting_response:
            reader.deliver_response(data)
        if len(data) != cia301.SDO_BYTES:
            return
        command, index, sub, value = _SDO_FRAME.unpack(data)
        if command & 0xE0 in (0x40, 0x80) and (index, sub) == (cia301.DEVICE_TYPE, 0):
            self._responding_ids.add(node_id)
        if command & 0xE0 == 0x40 and (index, sub) in _IDENTITY_OBJECTS:
            self._identity_values.setdefault(node_id, {}).setdefault((index, sub), set()).add(value)

    def _merge_traffic(self, facts: dict[str, object]) -> NodeFacts:
        """Add a node's observed traffic to the data read from it."""
        node_id = facts["node_id"]
        assert isinstance(node_id, int)
        state = self.traffic.nmt_states.get(node_id)
        name = "" if state is None else _state_name(state)
        if node_id in self._invalid_responses and node_id not in self._responding_ids:
            received = self._invalid_responses[node_id].hex(" ")
            facts["error"] = f"invalid SDO response to the request for 0x1000:00: {received or 'no data'}"
        return NodeFacts(
            **facts,  # type: ignore[arg-type]
            state=name,
            boots=self.traffic.boot_up_counts.get(node_id, 0),
            emergency=self.traffic.emergencies.get(node_id, ""),
            conflict=self._describe_conflict(node_id),
        )

    def _describe_conflict(self, node_id: int) -> str:
        """Return evidence of two nodes with this id: different responses for a constant object."""
        names = ("device type", *cia301.IDENTITY_NAMES.values())
        for (_, sub), values in sorted(self._identity_values.get(node_id, {}).items(), reverse=True):
            if len(values) > 1:
                numbers = sorted(int.from_bytes(value, "little") for value in values)
                return f"duplicate node id: {names[sub]}s {' and '.join(map(str, numbers))}"
        return ""


def find_channels_of_node(node: NodeFacts) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return what `find_four_channels` does for a node; None for a drive, which is never a pad."""
    is_drive = (node.device_type or 0) & 0xFFFF == _DRIVES
    return None if is_drive else find_four_channels(node.tpdos)


def find_four_channels(tpdos: Collection[TpdoFacts]) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return the mapping entries of the four channels, and the numbers of their TPDOs; None without any.

    Search order: analogue inputs and process values of the profiles before other objects; four or more
    entries of one object and width, in one TPDO or in several; exactly four of one width, of any objects, in
    one TPDO or in several. Entries have 8 to 32 bits, and each object counts once; digital inputs and what
    drives send are no channels.
    """
    by_object_once: dict[int, int] = {}
    for tpdo in tpdos:
        for entry in tpdo.mapping:
            if _is_channel_entry(entry):
                by_object_once.setdefault(entry, tpdo.number)
    carried = [(number, entry) for entry, number in by_object_once.items()]
    analogue = [pair for pair in carried if pair[1] >> 16 in PROFILE_TYPES]
    for pairs in (analogue, carried):
        numbers = sorted({number for number, _ in pairs})
        scopes = [[pair for pair in pairs if pair[0] == number] for number in numbers] + [pairs]
        for by_object in (True, False):
            for scope in scopes:
                for group in _group_entries(scope, by_object):
                    if len(group) == 4 or (by_object and len(group) > 4):
                        first = group[:4]
                        found = tuple(sorted({number for number, _ in first}))
                        return tuple(entry for _, entry in first), found
    return None


def _group_entries(pairs: list[tuple[int, int]], by_object: bool) -> Iterator[list[tuple[int, int]]]:
    """Group entries by width, and by object; analogue inputs and process values come first."""
    groups: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for number, entry in pairs:
        groups.setdefault((entry >> 16 if by_object else 0, entry & 0xFF), []).append((number, entry))
    yield from sorted(groups.values(), key=lambda group: not 0x6000 <= group[0][1] >> 16 <= 0x9FFF)


def _is_channel_entry(entry: int) -> bool:
    """Return True if a mapping entry may be a channel: a number's width, no dummy entry, and no object of
    digital inputs (0x6000 to 0x60FF, where CiA 402 has the state of drives, too)."""
    index = entry >> 16
    return 8 <= entry & 0xFF <= 32 and index >= 0x2000 and not 0x6000 <= index < 0x6100


def _state_name(state: int) -> str:
    return cia301.NMT_NAMES.get(state, f"state {state}")


def _read_node(node_id: int, sdo: NodeSdoClient) -> dict[str, object]:
    """Read a node; if it stops responding, return the data read so far and the reason as `error`."""
    facts: dict[str, object] = {"node_id": node_id, "answers": True}
    try:
        facts["device_type"] = _read_integer(sdo, cia301.DEVICE_TYPE, 0)
        _read_identity(sdo, facts)
        facts["heartbeat_ms"] = _read_integer(sdo, cia301.HEARTBEAT_TIME, 0)
        tpdos = facts["tpdos"] = tuple(_read_tpdos(sdo))
        if find_four_channels(tpdos) is None:
            facts["inputs"] = _read_integer(sdo, cia301.ANALOGUE_INPUTS, 0)
        for index, name in (
            (cia301.DEVICE_NAME, "name"),
            (cia301.HARDWARE_VERSION, "hardware"),
            (cia301.SOFTWARE_VERSION, "software"),
        ):
            facts[name] = _read_string(sdo, index)
    except BootStepError as error:
        facts["error"] = str(error)
    return facts


def _read_identity(sdo: NodeSdoClient, facts: dict[str, object]) -> None:
    """Read 0x1018 into `facts`; fields that the node refuses are in `refused`."""
    facts["refused"] = refused = dict[str, str]()
    for sub, name in enumerate(cia301.IDENTITY_NAMES, 1):
        try:
            facts[name] = sdo.read(cia301.IDENTITY, sub, name) & 0xFFFFFFFF
        except BootStepError as error:
            if not isinstance(error.__cause__, SdoAbortedError):
                raise
            refused[name] = str(error.__cause__)


def _read_tpdos(sdo: NodeSdoClient) -> Iterator[TpdoFacts]:
    missing = 0
    for number in range(1, cia301.MAX_TPDOS + 1):
        count = _read_integer(sdo, cia301.TPDO_MAPPING + number - 1, 0)
        missing = missing + 1 if count is None else 0
        if missing == _MAX_MISSING_TPDOS:
            return
        if count is None:
            continue
        subs = range(1, min(count, 64) + 1)
        entries = [_read_integer(sdo, cia301.TPDO_MAPPING + number - 1, sub) for sub in subs]
        index = cia301.TPDO_COMMUNICATION + number - 1
        cob_id, transmission, inhibit, event_ms = (_read_integer(sdo, index, sub) for sub in (1, 2, 3, 5))
        yield TpdoFacts(
            number,
            None if cob_id is None else cob_id & 0x1FFFFFFF,
            cob_id is not None and not cob_id >> 31,
            transmission,
            None if inhibit is None else 100 * inhibit,
            event_ms,
            tuple(entry for entry in entries if entry is not None),
        )


def _read_integer(sdo: NodeSdoClient, index: int, sub: int) -> int | None:
    """Read an object, limited to 32 bits; None if the node refuses."""
    value = sdo.read_or_none(index, sub, "an object")
    return None if value is None else value & 0xFFFFFFFF


def _read_string(sdo: NodeSdoClient, index: int) -> str:
    """Read a string object, made printable; empty if the node doesn't have it."""
    value = sdo.read_or_none(index, 0, "an object") or 0
    data = value.to_bytes((value.bit_length() + 7) // 8, "little")
    return "".join(c if c.isprintable() else " " for c in data.decode("utf-8", "replace")).strip()[:80]
