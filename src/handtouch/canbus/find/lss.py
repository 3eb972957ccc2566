"""Layer setting services (CiA 305): find nodes that have no id yet, and give them one; both sides.

Public names: `LssMaster` (finds and names), `LssSlave` (a node's side, for simulation), `LssAddress`,
`LssError`, `REQUEST_ID`, `ANSWER_ID`.

A fast scan asks "is there a bit pattern of yours that begins like this?"; those it fits answer, all with the
same frame, and else nobody does. What takes time is waiting for answers that don't come, so the master waits
no longer than the nodes have shown to take, and tries values that it knows as a whole.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

REQUEST_ID, ANSWER_ID = 0x7E5, 0x7E4
LEAST_WAIT_S = 0.005
UNCONFIGURED = 0xFF
"""Node id of a node that has none."""

_SWITCH_GLOBAL, _SELECTED = 0x04, 0x44
_SELECT = (0x40, 0x41, 0x42, 0x43)
_CONFIGURE_ID, _BIT_TIMING, _STORE = 0x11, 0x13, 0x17
_IDENTIFY = (0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B)
_IDENTIFY_UNCONFIGURED, _IS_SLAVE, _IS_UNCONFIGURED = 0x4C, 0x4F, 0x50
_FAST_SCAN, _INQUIRE, _INQUIRE_ID = 0x51, (0x5A, 0x5B, 0x5C, 0x5D), 0x5E
_WAITING, _CONFIGURATION = 0, 1
_CONFIRM = 0x80  # in place of a bit: all without an id answer, and start from the first part

_FIRST_WAIT_S, _SELECT_WAIT_S, _STORE_WAIT_S = 0.1, 0.2, 1.0
_LEAST_SETTLE_S, _LONGEST_WAIT_S = 0.001, 0.5
_ATTEMPTS = 4
_MOST_ANSWERS = 256  # a bus that babbles them must not hold the scan up
_NO_ID = {1: "out of range"}
_NOT_STORED = {1: "it has no memory for it", 2: "its memory can't be written"}

Exchange = Callable[[bytes | None, float], bytes | None]
"""Send a request (None: none) and return the first answer, or None when it hasn't come after so many seconds.

With a request, answers that came before it are dropped.
"""


class LssError(Exception):
    """A node that doesn't do as CiA 305 says; `str` names it and what it did."""


@dataclass(frozen=True, order=True, slots=True)
class LssAddress:
    """The 128 bits that tell any two nodes apart: object 0x1018."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int

    @property
    def parts(self) -> tuple[int, int, int, int]:
        """In the order in which a fast scan goes through them."""
        return self.vendor_id, self.product_code, self.revision, self.serial

    def __str__(self) -> str:
        return (
            f"vendor 0x{self.vendor_id:X} product 0x{self.product_code:X} revision 0x{self.revision:X} "
            f"serial {self.serial}"
        )


class _Mismatch(Exception):  # noqa: N818 - an answer was lost or late; the search starts again, more patiently
    """Nobody has the value that was found bit by bit."""


class LssMaster:
    """The only LSS master of a bus. Every call ends with all nodes in the waiting state."""

    def __init__(
        self,
        exchange: Exchange,
        least_wait_s: float = LEAST_WAIT_S,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`least_wait_s`: silence is taken for "no" after this at the earliest, later on a slow bus."""
        self.requests = 0
        self.problem = ""
        self._exchange = exchange
        self._clock = clock
        self._pace = _Pace(least_wait_s)

    @property
    def wait_s(self) -> float:
        """How long an answer is waited for now."""
        return self._pace.wait_s

    def scan(
        self,
        vendor_ids: Iterable[int] = (),
        product_codes: Iterable[int] = (),
        revisions: Iterable[int] = (),
    ) -> list[LssAddress]:
        """Nodes without an id, in the order of their numbers; none of them is changed.

        Values given, and those found, are tried as a whole before bits are. `problem` tells what was in the
        way of finding all, empty if nothing was.
        """
        known = [list(dict.fromkeys(values)) for values in (vendor_ids, product_codes, revisions, ())]
        heard: set[LssAddress] = set()
        sure: set[LssAddress] = set()
        self._release()
        try:
            for _ in range(_ATTEMPTS):
                heard |= self._sweep(known)
                if heard <= sure and not self.problem:
                    break
                # Those that answer to their name are there, and out of the way of any that was missed.
                self._release()
                sure |= {address for address in heard if self._pick(address)}
        finally:
            self._release()
        return sorted(sure)

    def inquire(self, address: LssAddress) -> int | None:
        """Id that a node has now, None if it has none. Raises LssError if it doesn't answer."""
        self._select(address)
        try:
            answer = self._ask(struct.pack("<B7x", _INQUIRE_ID), _INQUIRE_ID, _SELECT_WAIT_S)
        finally:
            self._release()
        if answer is None:
            raise LssError(f"{address} doesn't tell its id")
        return None if answer[1] == UNCONFIGURED else answer[1]

    def assign(self, address: LssAddress, node_id: int) -> str:
        """Give a node an id, which it uses at once, and let it store that; bit timing stays.

        Returns why it isn't stored and will be lost with the power, empty when it is. Raises LssError if the
        node doesn't answer or refuses the id, ValueError for an id outside 1 to 127.
        """
        if not 1 <= node_id <= 127:
            raise ValueError(f"node id must be 1 to 127, got {node_id}")
        self._select(address)
        try:
            answer = self._ask(struct.pack("<BB6x", _CONFIGURE_ID, node_id), _CONFIGURE_ID, _SELECT_WAIT_S)
            if answer is None or answer[1]:
                why = "no answer" if answer is None else _NO_ID.get(answer[1], f"error {answer[1]}")
                raise LssError(f"{address} doesn't take id {node_id}: {why}")
            answer = self._ask(struct.pack("<B7x", _STORE), _STORE, _STORE_WAIT_S)
        finally:
            self._release()
        if answer is None:
            return f"no answer within {_STORE_WAIT_S:g} s"
        return _NOT_STORED.get(answer[1], f"error {answer[1]}") if answer[1] else ""

    def _sweep(self, known: list[list[int]]) -> set[LssAddress]:
        """One node after the other, until none is left that has no id and hasn't been found."""
        found: set[LssAddress] = set()
        self.problem = ""
        while self._open():
            address = self._search(known)
            if address is None or address in found:
                self.problem = (
                    f"{address} takes part in the search again after it was found"
                    if address
                    else "a node without an id answers, but not so that its identity can be told; is the bus "
                    "disturbed? try a longer --lss-wait-ms"
                )
                break
            found.add(
                address
            )  # in the configuration state now, where it doesn't take part in the next search
            for values, value in zip(known[:3], address.parts, strict=False):
                if value not in values:
                    values.insert(0, value)
        return found

    def _search(self, known: list[list[int]]) -> LssAddress | None:
        """The node with the least numbers; what nobody has once its last bit is known was misheard."""
        self._pace.calm()
        for _ in range(_ATTEMPTS):
            try:
                vendor_id, product_code, revision, serial = (
                    self._part(sub, values) for sub, values in enumerate(known)
                )
                return LssAddress(vendor_id, product_code, revision, serial)
            except _Mismatch:
                self._pace.back_off()
                self._open()
        return None

    def _open(self) -> bool:
        """Whether any node without an id is left; they all start from the first part."""
        for _ in range(2):  # an answer may be lost
            sent_ns = self._clock()
            if self._ask(_scan_request(0, _CONFIRM, 0, 0), _IS_SLAVE, self._pace.wait_s) is None:
                continue
            first_ns = last_ns = self._clock()
            widest_ns = 0
            for _ in range(_MOST_ANSWERS):  # of the slower ones
                if self._exchange(None, self._pace.wait_s) is None:
                    break
                now_ns = self._clock()
                widest_ns, last_ns = max(widest_ns, now_ns - last_ns), now_ns
            self._pace.opened((first_ns - sent_ns) * 1e-9, (last_ns - sent_ns) * 1e-9, widest_ns * 1e-9)
            return True
        return False

    def _part(self, sub: int, known: Iterable[int]) -> int:
        """The value of one of the four parts, least first. Raises _Mismatch."""
        following = (sub + 1) % 4  # 0 after the last: the node is found and enters the configuration state
        for value in known:
            if self._fits(_scan_request(value, 0, sub, following)):
                return value
        value = 0
        for bit in range(31, -1, -1):
            if not self._fits(_scan_request(value, bit, sub, sub)):
                value |= 1 << bit
        if not self._fits(_scan_request(value, 0, sub, following)):
            raise _Mismatch
        return value

    def _fits(self, request: bytes) -> bool:
        """Whether any node answers; those that answer later than the first are waited for."""
        sent_ns = self._clock()
        if self._ask(request, _IS_SLAVE, self._pace.wait_s) is None:
            return False
        self._pace.answered((self._clock() - sent_ns) * 1e-9)
        if self._pace.settle_s:
            for _ in range(_MOST_ANSWERS):
                if self._exchange(None, self._pace.settle_s) is None:
                    break
        return True

    def _select(self, address: LssAddress) -> None:
        """Bring one node into the configuration state, all others into the waiting state."""
        self._release()
        if not self._pick(address):
            raise LssError(f"{address} doesn't answer any more")

    def _pick(self, address: LssAddress) -> bool:
        """Bring a node from the waiting into the configuration state; False if it doesn't answer."""
        answer = None
        for command, value in zip(_SELECT, address.parts, strict=True):
            wait_s = _SELECT_WAIT_S if command == _SELECT[-1] else self._pace.least_wait_s
            answer = self._ask(struct.pack("<BI3x", command, value), _SELECTED, wait_s)
        return answer is not None

    def _release(self) -> None:
        """All nodes to the waiting state; they don't answer that, but some need time for it."""
        self._exchange(struct.pack("<BB6x", _SWITCH_GLOBAL, _WAITING), self._pace.least_wait_s)

    def _ask(self, request: bytes, command: int, wait_s: float) -> bytes | None:
        """The answer with this command; others are passed over."""
        self.requests += 1
        end_ns = self._clock() + round(wait_s * 1e9)
        answer = self._exchange(request, wait_s)
        while answer is not None and (len(answer) != 8 or answer[0] != command):
            answer = self._exchange(None, max(0.0, (end_ns - self._clock()) * 1e-9))
        return answer


def _scan_request(value: int, bit: int, sub: int, following: int) -> bytes:
    """Who has these bits, down to `bit`, in part `sub`? Those with all of them go on to part `following`."""
    return struct.pack("<BIBBB", _FAST_SCAN, value, bit, sub, following)


class _Pace:
    """How long to wait for an answer, and for those of slower nodes after it.

    The former is TCP's estimate of its retransmission time-out (RFC 6298): smoothed round trip plus four mean
    deviations, doubled when it proves too short.
    """

    def __init__(self, least_wait_s: float) -> None:
        self.least_wait_s = least_wait_s
        self.settle_s = 0.0
        self._smoothed_s: float | None = None
        self._deviation_s = 0.0
        self._slowest_s = 0.0
        self._factor = 1.0

    @property
    def wait_s(self) -> float:
        if self._smoothed_s is None:
            return max(_FIRST_WAIT_S, self.least_wait_s)
        told_s = self._smoothed_s + 4 * self._deviation_s
        return self._factor * min(max(told_s, 2 * self._slowest_s, self.least_wait_s), _LONGEST_WAIT_S)

    def opened(self, first_s: float, last_s: float, widest_s: float) -> None:
        """All nodes have answered, the last of them at `last_s`, with gaps up to `widest_s` between them."""
        self.answered(first_s)
        self._slowest_s = last_s
        several = last_s > first_s
        self.settle_s = max(_LEAST_SETTLE_S, 2 * widest_s) if several else 0.0
        if self._factor > 1:
            self.settle_s = self.wait_s

    def answered(self, took_s: float) -> None:
        """A node has answered after so long."""
        if self._smoothed_s is None:
            self._smoothed_s, self._deviation_s = took_s, took_s / 2
            return
        self._deviation_s += (abs(took_s - self._smoothed_s) - self._deviation_s) / 4
        self._smoothed_s += (took_s - self._smoothed_s) / 8

    def back_off(self) -> None:
        """An answer was lost or late."""
        self._factor *= 2

    def calm(self) -> None:
        """The next node is another one."""
        self._factor = 1.0


class LssSlave:
    """A node's side: requests in, answers out, as the state machine of CiA 305 has it.

    `node_id` : the id in use, None before it has one; `stored_id` : the one after the next `power_on`
    `can_store` : False makes a node that can't store its id; `rejected` counts malformed requests
    """

    def __init__(self, address: LssAddress, node_id: int | None = None, *, can_store: bool = True) -> None:
        self.address = address
        self.stored_id = node_id
        self.can_store = can_store
        self.rejected = 0
        self.power_on()

    def power_on(self) -> None:
        """Begin with the stored id, in the waiting state."""
        self.node_id = self._pending_id = self.stored_id
        self.configuring = False
        self._position = 0
        self._selecting: list[int] = []
        self._identifying: list[int] = []

    def reset(self) -> None:
        """NMT reset communication: an id that was configured is used from now on."""
        self.node_id = self._pending_id

    def handle(self, data: bytes) -> bytes | None:
        """The answer to a request (a frame on 0x7E5), None where there is none."""
        if len(data) != 8:
            self.rejected += 1
            return None
        command = data[0]
        if command == _SWITCH_GLOBAL:
            self._switch(data[1])
        elif command in _SELECT:
            return self._select(command, data)
        elif command in _IDENTIFY:
            return self._identify(command, data)
        elif command == _IDENTIFY_UNCONFIGURED:
            return struct.pack("<B7x", _IS_UNCONFIGURED) if self._unconfigured else None
        elif command == _FAST_SCAN:
            return self._fast_scan(data) if self._unconfigured and not self.configuring else None
        elif self.configuring:
            return self._configure(command, data)
        return None

    @property
    def _unconfigured(self) -> bool:
        return self.node_id is None and self._pending_id is None

    def _switch(self, state: int) -> None:
        if state not in (_WAITING, _CONFIGURATION):
            self.rejected += 1
            return
        self.configuring = state == _CONFIGURATION
        if not self.configuring and self.node_id is None:
            self.node_id = self._pending_id  # CiA 305: a first id is used at once, another after a reset

    def _select(self, command: int, data: bytes) -> bytes | None:
        """Four requests in a row, the last of which is answered by the node that they name."""
        if not self._gather(self._selecting, command - _SELECT[0], data, len(_SELECT)):
            return None
        if self.configuring or tuple(self._selecting) != self.address.parts:
            return None
        self.configuring = True
        return struct.pack("<B7x", _SELECTED)

    def _identify(self, command: int, data: bytes) -> bytes | None:
        """Six requests in a row: vendor, product, and ranges of revision and serial number."""
        if not self._gather(self._identifying, command - _IDENTIFY[0], data, len(_IDENTIFY)):
            return None
        vendor_id, product_code, *ranges = self._identifying
        own = self.address
        fits = (vendor_id, product_code) == (own.vendor_id, own.product_code)
        fits = fits and ranges[0] <= own.revision <= ranges[1] and ranges[2] <= own.serial <= ranges[3]
        return struct.pack("<B7x", _IS_SLAVE) if fits else None

    @staticmethod
    def _gather(values: list[int], number: int, data: bytes, count: int) -> bool:
        """Keep the value of a request that comes in its turn; whether all have come."""
        del values[number:]
        if len(values) == number:
            values.append(int.from_bytes(data[1:5], "little"))
        return len(values) == count

    def _fast_scan(self, data: bytes) -> bytes | None:
        _, value, bit, sub, following = struct.unpack("<BIBBB", data)
        if bit == _CONFIRM:
            self._position = 0
            return struct.pack("<B7x", _IS_SLAVE)
        if bit > 31 or sub > 3 or following > 3:
            self.rejected += 1
            return None
        if sub != self._position or (value ^ self.address.parts[sub]) >> bit:
            return None
        if bit == 0:
            self._position = following
            self.configuring = following < sub
        return struct.pack("<B7x", _IS_SLAVE)

    def _configure(self, command: int, data: bytes) -> bytes | None:
        """What only a node in the configuration state answers."""
        if command in _INQUIRE:
            return struct.pack("<BI3x", command, self.address.parts[command - _INQUIRE[0]])
        if command == _INQUIRE_ID:
            return struct.pack("<BB6x", command, self.node_id or UNCONFIGURED)
        if command == _CONFIGURE_ID:
            good = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED
            if good:
                self._pending_id = None if data[1] == UNCONFIGURED else data[1]
            return struct.pack("<BB6x", command, not good)
        if command == _BIT_TIMING:
            return struct.pack("<BB6x", command, 1)
        if command == _STORE:
            if self.can_store:
                self.stored_id = self._pending_id
            return struct.pack("<BB6x", command, not self.can_store)
        return None
