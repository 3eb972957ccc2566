"""LSS master (CiA 305): find unconfigured nodes and assign ids to them.

Public names: `LssMaster`, `LssError`, `MIN_WAIT_S`.

A fast scan asks "does a node's address begin with these bits?"; all matching nodes respond with the same
frame, and there is no negative response. Most of the time is spent waiting for responses that don't come, so
the master waits no longer than the nodes' measured response times require, and tries known values as a whole
first.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable

from handtouch.canbus import cia305
from handtouch.canbus.cia305 import LssAddress

MIN_WAIT_S = 0.005

_FIRST_WAIT_S, _SELECT_WAIT_S, _STORE_WAIT_S = 0.1, 0.2, 1.0
_MIN_SETTLE_S, _MAX_WAIT_S = 0.001, 0.5
_MAX_ATTEMPTS = 4
_MAX_RESPONSES = 256  # responses of a babbling node must not delay the scan
_ID_ERRORS = {1: "out of range"}
_STORE_ERRORS = {1: "it has no memory for it", 2: "its memory can't be written"}

Exchange = Callable[[bytes | None, float], bytes | None]
"""Send a request (None: none) and return the first response, or None after that many seconds.

With a request, responses received before it are dropped.
"""


class LssError(Exception):
    """A node violates CiA 305; `str` names the node and the violation."""


class _ScanMismatch(Exception):  # noqa: N818 - a response was lost or late; the search is repeated
    """No node has the value that was found bit by bit."""


class LssMaster:
    """The only LSS master of a bus. Every method leaves all nodes in the waiting state."""

    def __init__(
        self,
        exchange: Exchange,
        min_wait_s: float = MIN_WAIT_S,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`min_wait_s`: shortest time without a response that means "no"; longer on a slow bus."""
        self.requests = 0
        self.problem = ""
        self._exchange = exchange
        self._clock = clock
        self._response_timer = _ResponseTimer(min_wait_s)

    @property
    def wait_s(self) -> float:
        """Present response timeout."""
        return self._response_timer.wait_s

    def scan(
        self,
        vendor_ids: Iterable[int] = (),
        product_codes: Iterable[int] = (),
        revisions: Iterable[int] = (),
    ) -> list[LssAddress]:
        """Return the unconfigured nodes in the order of their addresses; none of them is changed.

        Values given, and those found, are tried as a whole before single bits. `problem` is the reason why
        some nodes may be missing, empty if there is none.
        """
        known = [list(dict.fromkeys(values)) for values in (vendor_ids, product_codes, revisions, ())]
        responding: set[LssAddress] = set()
        confirmed: set[LssAddress] = set()
        self._deselect_all()
        try:
            for _ in range(_MAX_ATTEMPTS):
                responding |= self._scan_once(known)
                if responding <= confirmed and not self.problem:
                    break
                # Nodes that can be selected are confirmed, and no longer mask one that was missed.
                self._deselect_all()
                confirmed |= {address for address in responding if self._select_waiting(address)}
        finally:
            self._deselect_all()
        return sorted(confirmed)

    def inquire_node_id(self, address: LssAddress) -> int | None:
        """Return the present id of a node, None if it has none. Raises LssError if it doesn't respond."""
        self._select(address)
        try:
            answer = self._request(struct.pack("<B7x", cia305.INQUIRE_ID), cia305.INQUIRE_ID, _SELECT_WAIT_S)
        finally:
            self._deselect_all()
        if answer is None:
            raise LssError(f"{address}: no response to the inquiry of its id")
        return None if answer[1] == cia305.UNCONFIGURED else answer[1]

    def assign_node_id(self, address: LssAddress, node_id: int) -> str:
        """Assign an id to a node, which uses it at once, and have it stored; bit timing is unchanged.

        Returns the reason if it isn't stored and will be lost at power-off, else "". Raises LssError if the
        node doesn't respond or refuses the id, ValueError for an id outside 1 to 127.
        """
        if not 1 <= node_id <= 127:
            raise ValueError(f"node id must be 1 to 127, got {node_id}")
        self._select(address)
        try:
            answer = self._request(
                struct.pack("<BB6x", cia305.CONFIGURE_ID, node_id), cia305.CONFIGURE_ID, _SELECT_WAIT_S
            )
            if answer is None or answer[1]:
                reason = "no answer" if answer is None else _ID_ERRORS.get(answer[1], f"error {answer[1]}")
                raise LssError(f"{address}: id {node_id} not accepted: {reason}")
            answer = self._request(struct.pack("<B7x", cia305.STORE), cia305.STORE, _STORE_WAIT_S)
        finally:
            self._deselect_all()
        if answer is None:
            return f"no answer within {_STORE_WAIT_S:g} s"
        return _STORE_ERRORS.get(answer[1], f"error {answer[1]}") if answer[1] else ""

    def _scan_once(self, known: list[list[int]]) -> set[LssAddress]:
        """Find the unconfigured nodes one after the other."""
        found: set[LssAddress] = set()
        self.problem = ""
        while self._start_search():
            address = self._find_next(known)
            if address is None or address in found:
                self.problem = (
                    f"{address} responds to the search again after it was found"
                    if address
                    else "a node without an id responds, but its identity can't be determined; is the bus "
                    "disturbed? try a longer --lss-wait-ms"
                )
                break
            found.add(address)  # in the configuration state now, in which it ignores the next search
            for values, value in zip(known[:3], address.parts, strict=False):
                if value not in values:
                    values.insert(0, value)
        return found

    def _find_next(self, known: list[list[int]]) -> LssAddress | None:
        """Return the unconfigured node with the smallest address; repeat the search after lost responses."""
        self._response_timer.reset_backoff()
        for _ in range(_MAX_ATTEMPTS):
            try:
                vendor_id, product_code, revision, serial = (
                    self._find_part(sub, values) for sub, values in enumerate(known)
                )
                return LssAddress(vendor_id, product_code, revision, serial)
            except _ScanMismatch:
                self._response_timer.back_off()
                self._start_search()
        return None

    def _start_search(self) -> bool:
        """Return True if an unconfigured node is left; all of them return to the first part."""
        for _ in range(2):  # a response may be lost
            sent_ns = self._clock()
            if (
                self._request(
                    _scan_request(0, cia305.CONFIRM_BIT, 0, 0), cia305.IS_SLAVE, self._response_timer.wait_s
                )
                is None
            ):
                continue
            first_ns = last_ns = self._clock()
            widest_ns = 0
            for _ in range(_MAX_RESPONSES):  # of the slower ones
                if self._exchange(None, self._response_timer.wait_s) is None:
                    break
                now_ns = self._clock()
                widest_ns, last_ns = max(widest_ns, now_ns - last_ns), now_ns
            self._response_timer.record_round(
                (first_ns - sent_ns) * 1e-9, (last_ns - sent_ns) * 1e-9, widest_ns * 1e-9
            )
            return True
        return False

    def _find_part(self, sub: int, known: Iterable[int]) -> int:
        """Return the smallest value of one of the four parts. Raises _ScanMismatch."""
        following = (sub + 1) % 4  # 0 after the last: the node is found and enters the configuration state
        for value in known:
            if self._has_match(_scan_request(value, 0, sub, following)):
                return value
        value = 0
        for bit in range(31, -1, -1):
            if not self._has_match(_scan_request(value, bit, sub, sub)):
                value |= 1 << bit
        if not self._has_match(_scan_request(value, 0, sub, following)):
            raise _ScanMismatch
        return value

    def _has_match(self, request: bytes) -> bool:
        """Return True if a node responds, after waiting for slower ones."""
        sent_ns = self._clock()
        if self._request(request, cia305.IS_SLAVE, self._response_timer.wait_s) is None:
            return False
        self._response_timer.record_response((self._clock() - sent_ns) * 1e-9)
        if self._response_timer.settle_s:
            for _ in range(_MAX_RESPONSES):
                if self._exchange(None, self._response_timer.settle_s) is None:
                    break
        return True

    def _select(self, address: LssAddress) -> None:
        """Switch one node to the configuration state, all others to the waiting state."""
        self._deselect_all()
        if not self._select_waiting(address):
            raise LssError(f"{address}: no response any more")

    def _select_waiting(self, address: LssAddress) -> bool:
        """Switch a waiting node to the configuration state; return False if it doesn't respond."""
        answer = None
        for command, value in zip(cia305.SELECT, address.parts, strict=True):
            wait_s = _SELECT_WAIT_S if command == cia305.SELECT[-1] else self._response_timer.min_wait_s
            answer = self._request(struct.pack("<BI3x", command, value), cia305.SELECTED, wait_s)
        return answer is not None

    def _deselect_all(self) -> None:
        """Switch all nodes to the waiting state; they don't respond, but some need time for it."""
        self._exchange(
            struct.pack("<BB6x", cia305.SWITCH_GLOBAL, cia305.WAITING_STATE), self._response_timer.min_wait_s
        )

    def _request(self, request: bytes, command: int, wait_s: float) -> bytes | None:
        """Send a request and return the response with this command; others are ignored."""
        self.requests += 1
        end_ns = self._clock() + round(wait_s * 1e9)
        answer = self._exchange(request, wait_s)
        while answer is not None and (len(answer) != 8 or answer[0] != command):
            answer = self._exchange(None, max(0.0, (end_ns - self._clock()) * 1e-9))
        return answer


def _scan_request(value: int, bit: int, sub: int, following: int) -> bytes:
    """Return the request to nodes with these bits, down to `bit`, in part `sub`.

    Nodes with all of its bits continue with part `following`.
    """
    return struct.pack("<BIBBB", cia305.FAST_SCAN, value, bit, sub, following)


class _ResponseTimer:
    """Timeouts for a response, and for those of slower nodes after it.

    The former is TCP's retransmission timeout (RFC 6298): smoothed round-trip time plus four mean deviations,
    doubled after a lost response.
    """

    def __init__(self, min_wait_s: float) -> None:
        self.min_wait_s = min_wait_s
        self.settle_s = 0.0
        self._smoothed_s: float | None = None
        self._deviation_s = 0.0
        self._slowest_s = 0.0
        self._factor = 1.0

    @property
    def wait_s(self) -> float:
        if self._smoothed_s is None:
            return max(_FIRST_WAIT_S, self.min_wait_s)
        estimate_s = self._smoothed_s + 4 * self._deviation_s
        return self._factor * min(max(estimate_s, 2 * self._slowest_s, self.min_wait_s), _MAX_WAIT_S)

    def record_round(self, first_s: float, last_s: float, widest_s: float) -> None:
        """Record a request to all nodes: first and last response, and the widest gap between responses."""
        self.record_response(first_s)
        self._slowest_s = last_s
        several = last_s > first_s
        self.settle_s = max(_MIN_SETTLE_S, 2 * widest_s) if several else 0.0
        if self._factor > 1:
            self.settle_s = self.wait_s

    def record_response(self, response_s: float) -> None:
        """Record a response time."""
        if self._smoothed_s is None:
            self._smoothed_s, self._deviation_s = response_s, response_s / 2
            return
        self._deviation_s += (abs(response_s - self._smoothed_s) - self._deviation_s) / 4
        self._smoothed_s += (response_s - self._smoothed_s) / 8

    def back_off(self) -> None:
        """Double the timeout after a lost or late response."""
        self._factor *= 2

    def reset_backoff(self) -> None:
        """Reset the timeout for the next node."""
        self._factor = 1.0
