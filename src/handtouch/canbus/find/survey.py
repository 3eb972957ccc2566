"""Look at a bus without changing anything on it: listen, ask every id who it is, read what it offers.

Public names: `Survey`, `NodeFacts`, `TpdoFacts`, `four_channels`.

All ids are asked at once and answer when they can, so that this takes as long as one time-out; the nodes
that are there are then read side by side, by threads, while this one receives.
"""

from __future__ import annotations

import select
import struct
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from handtouch.canbus.bus.port import Port
from handtouch.canbus.objects.sdo import Sdo, StepError

from .lss import ANSWER_ID, REQUEST_ID
from .traffic import NMT_STATES, Traffic

ANSWER_WAIT_S = 0.2
"""A node that is asked for an object answers within this."""
READ_S = 30.0
"""All that nodes tell is read within this, on the slowest bus."""

READERS = 16
"""Nodes read at the same time: their frames take 35 ms at 125 kbit/s, far less than a transfer's time-out."""

_ANSWER, _REQUEST = 0x580, 0x600
_DEVICE_TYPE, _IDENTITY, _HEARTBEAT, _INPUTS = 0x1000, 0x1018, 0x1017, 0x6401
_NAME, _HARDWARE, _SOFTWARE = 0x1008, 0x1009, 0x100A
_COMMUNICATION, _MAPPING = 0x1800, 0x1A00
_TPDOS, _GAP = 512, 4  # as many TPDOs missing in a row are the end of them
_REQUEST_BITS = 135
_SENDS, _SEND_PAUSE_S = 100, 0.002  # a full transmit queue is tried again
_CONSTANT = frozenset({(_DEVICE_TYPE, 0), *((_IDENTITY, sub) for sub in (1, 2, 3, 4))})
_OBJECT = struct.Struct("<BHB4s")


@dataclass(frozen=True, slots=True)
class TpdoFacts:
    """A TPDO as its node has it: objects 0x1800 + n and 0x1A00 + n; None where the node hasn't got them."""

    number: int
    cob_id: int | None
    enabled: bool
    transmission: int | None
    inhibit_us: int | None
    event_ms: int | None
    mapping: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class NodeFacts:
    """What a node tells of itself; None where it hasn't got the object.

    `state` is the NMT state of its heartbeat, empty where none was heard; `boots` its boot-up messages;
    `emergency` its latest EMCY message, `conflict` that two nodes have this id, `trouble` why it couldn't be
    read, all in words and empty when all is well. `inputs` is the number of analogue inputs (0x6401 sub 0).
    """

    node_id: int
    state: str = ""
    answers: bool = False
    device_type: int | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None
    name: str = ""
    hardware: str = ""
    software: str = ""
    heartbeat_ms: int | None = None
    tpdos: tuple[TpdoFacts, ...] = ()
    inputs: int | None = None
    boots: int = 0
    emergency: str = ""
    conflict: str = ""
    trouble: str = ""


class Survey:
    """One bus. All calls from one thread; nothing is sent but by `ask`, `read` and `exchange`."""

    def __init__(self, port: Port, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.port = port
        self.traffic = Traffic()
        self._clock = clock
        self._asked: dict[int, dict[tuple[int, int], set[bytes]]] = {}
        self._answered: set[int] = set()
        self._readers: dict[int, Sdo] = {}
        self._lss: deque[bytes] = deque()

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive for so long, or until something is so (True then)."""
        end_ns = self._clock() + round(seconds * 1e9)
        while True:
            for frame in self.port.drain():
                self._handle(*frame)
            if until():
                return True
            left_s = (end_ns - self._clock()) * 1e-9
            if left_s <= 0:
                return False
            select.select([self.port.fileno()], [], [], min(left_s, 0.02))

    def ask(self, ids: Iterable[int] = range(1, 128)) -> set[int]:
        """Ids that answer, to a request for the device type, with its value or with an abort.

        Those that were heard and stay silent are asked once more.
        """
        ids = list(ids)
        self._answered -= set(ids)
        heard = self.traffic.nodes()
        for asked in (ids, [node_id for node_id in ids if node_id in heard]):
            silent = [node_id for node_id in asked if node_id not in self._answered]
            for node_id in silent:
                self._send(_REQUEST + node_id, _OBJECT.pack(0x40, _DEVICE_TYPE, 0, bytes(4)))
            queued_s = len(silent) * _REQUEST_BITS / self.port.bus.bitrate_bit_s
            if silent:
                self.listen(ANSWER_WAIT_S + queued_s, lambda: self._answered >= set(ids))
        return self._answered & set(ids)

    def read(self, ids: Collection[int], told: Callable[[int], None] = lambda _: None) -> list[NodeFacts]:
        """What the nodes with these ids tell of themselves; `told` is called with the number read so far."""
        if not ids:
            return []
        self._readers = {node_id: Sdo(node_id, self._send) for node_id in ids}
        with ThreadPoolExecutor(READERS, "sdo") as pool:
            jobs = [pool.submit(_read_node, node_id, sdo) for node_id, sdo in self._readers.items()]
            end_ns = self._clock() + round(READ_S * 1e9)
            while not self.listen(0.1, lambda: all(job.done() for job in jobs)):
                told(sum(job.done() for job in jobs))
                if self._clock() > end_ns:
                    self._readers = {}  # a transfer that never ends is cut off here, and times out
        self.listen(0.01)  # for a second node's answer to the last request
        self._readers = {}
        return [self._complete(job.result()) for job in jobs]

    def silent(self, node_id: int) -> NodeFacts:
        """What is known of a node that was heard and wasn't asked, or doesn't answer."""
        return self._complete({"node_id": node_id})

    def exchange(self, request: bytes | None, timeout_s: float) -> bytes | None:
        """Send an LSS request and wait for an answer, as `LssMaster` wants it."""
        if request is not None:
            self.listen(0.0)
            self._lss.clear()
            self._send(REQUEST_ID, request)
        self.listen(timeout_s, lambda: bool(self._lss))
        return self._lss.popleft() if self._lss else None

    def _handle(self, can_id: int, data: bytes, t_ns: int) -> None:
        self.traffic.handle(can_id, data, t_ns)
        if can_id == ANSWER_ID:
            self._lss.append(data)
        elif _ANSWER < can_id < _REQUEST and len(data) == 8:
            self._hear_answer(can_id - _ANSWER, data)

    def _hear_answer(self, node_id: int, data: bytes) -> None:
        command, index, sub, value = _OBJECT.unpack(data)
        if command & 0xE0 in (0x40, 0x80) and (index, sub) == (_DEVICE_TYPE, 0):
            self._answered.add(node_id)
        if command & 0xE0 == 0x40 and (index, sub) in _CONSTANT:
            self._asked.setdefault(node_id, {}).setdefault((index, sub), set()).add(value)
        reader = self._readers.get(node_id)
        if reader is not None and reader.waiting:
            reader.deliver(data)

    def _send(self, can_id: int, data: bytes) -> bool:
        for _ in range(_SENDS):
            if self.port.send(can_id, data):
                return True
            time.sleep(_SEND_PAUSE_S)
        return False

    def _complete(self, facts: dict[str, object]) -> NodeFacts:
        """Add what was heard of a node to what it told."""
        node_id = facts["node_id"]
        assert isinstance(node_id, int)
        state = self.traffic.states.get(node_id)
        name = "" if state is None else _state_name(state)
        return NodeFacts(
            **facts,  # type: ignore[arg-type]
            state=name,
            boots=self.traffic.boots.get(node_id, 0),
            emergency=self.traffic.emergencies.get(node_id, ""),
            conflict=self._conflict(node_id),
        )

    def _conflict(self, node_id: int) -> str:
        """Two nodes with this id give themselves away by two answers to what is constant in a node."""
        names = {0: "device types", 1: "vendor ids", 2: "product codes", 3: "revisions", 4: "serial numbers"}
        for (_, sub), values in sorted(self._asked.get(node_id, {}).items(), reverse=True):
            if len(values) > 1:
                numbers = sorted(int.from_bytes(value, "little") for value in values)
                return f"two nodes with this id: {names[sub]} {' and '.join(map(str, numbers))}"
        return ""


def four_channels(tpdos: Collection[TpdoFacts]) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """The four channels among what the TPDOs carry: (their mapping entries, numbers of their TPDOs).

    Looked for in this order: four entries or more of one object and width, in one TPDO or in several; exactly
    four of one width, of any objects, in one TPDO or in several. None if there are no four of 8 to 32 bits.
    """
    carried = [(tpdo.number, entry) for tpdo in tpdos for entry in tpdo.mapping if _is_integer(entry)]
    numbers = sorted({number for number, _ in carried})
    scopes = [[pair for pair in carried if pair[0] == number] for number in numbers] + [carried]
    for by_object in (True, False):
        for scope in scopes:
            for group in _groups(scope, by_object):
                if len(group) == 4 or (by_object and len(group) > 4):
                    first = group[:4]
                    return tuple(entry for _, entry in first), tuple(sorted({number for number, _ in first}))
    return None


def _groups(pairs: list[tuple[int, int]], by_object: bool) -> Iterator[list[tuple[int, int]]]:
    """Entries of one width, and of one object; analogue inputs and process values before others."""
    groups: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for number, entry in pairs:
        groups.setdefault((entry >> 16 if by_object else 0, entry & 0xFF), []).append((number, entry))
    yield from sorted(groups.values(), key=lambda group: not 0x6000 <= group[0][1] >> 16 <= 0x9FFF)


def _is_integer(entry: int) -> bool:
    """Whether a mapping entry may be a channel: of an integer's width, and no dummy."""
    return entry & 0xFF in (8, 16, 24, 32) and entry >> 16 >= 0x2000


def _state_name(state: int) -> str:
    return NMT_STATES.get(state, f"state {state}")


def _read_node(node_id: int, sdo: Sdo) -> dict[str, object]:
    """All of a node; what was read until it fell silent, and `trouble` with the reason, where it does."""
    facts: dict[str, object] = {"node_id": node_id, "answers": True}
    try:
        facts["device_type"] = _number(sdo, _DEVICE_TYPE, 0)
        for sub, name in enumerate(("vendor_id", "product_code", "revision", "serial"), 1):
            facts[name] = _number(sdo, _IDENTITY, sub)
        facts["heartbeat_ms"] = _number(sdo, _HEARTBEAT, 0)
        tpdos = facts["tpdos"] = tuple(_tpdos(sdo))
        if four_channels(tpdos) is None:
            facts["inputs"] = _number(sdo, _INPUTS, 0)
        for index, name in ((_NAME, "name"), (_HARDWARE, "hardware"), (_SOFTWARE, "software")):
            facts[name] = _text(sdo, index)
    except StepError as error:
        facts["trouble"] = str(error)
    return facts


def _tpdos(sdo: Sdo) -> Iterator[TpdoFacts]:
    missing = 0
    for number in range(1, _TPDOS + 1):
        count = _number(sdo, _MAPPING + number - 1, 0)
        missing = missing + 1 if count is None else 0
        if missing == _GAP:
            return
        if count is None:
            continue
        subs = range(1, min(count, 64) + 1)
        entries = [_number(sdo, _MAPPING + number - 1, sub) for sub in subs]
        index = _COMMUNICATION + number - 1
        cob_id, transmission, inhibit, event_ms = (_number(sdo, index, sub) for sub in (1, 2, 3, 5))
        yield TpdoFacts(
            number,
            None if cob_id is None else cob_id & 0x1FFFFFFF,
            cob_id is not None and not cob_id >> 31,
            transmission,
            None if inhibit is None else 100 * inhibit,
            event_ms,
            tuple(entry for entry in entries if entry is not None),
        )


def _number(sdo: Sdo, index: int, sub: int) -> int | None:
    """As `_value`, 32 bits of it."""
    value = _value(sdo, index, sub)
    return None if value is None else value & 0xFFFFFFFF


def _value(sdo: Sdo, index: int, sub: int) -> int | None:
    """An object of any length, None if the node refuses to tell it. Raises StepError if it is silent."""
    try:
        return sdo.read(index, sub, "an object")
    except StepError as error:
        if error.silent:
            raise
        return None


def _text(sdo: Sdo, index: int) -> str:
    """A string object, printable; empty if the node hasn't got it. Raises StepError if it is silent."""
    value = _value(sdo, index, 0) or 0
    data = value.to_bytes((value.bit_length() + 7) // 8, "little")
    return "".join(c if c.isprintable() else " " for c in data.decode("utf-8", "replace")).strip()[:80]
