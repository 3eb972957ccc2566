"""LSS master (CiA 305): find unconfigured nodes and assign ids to them.

Public names: `LssMaster`, `LssError`, `MIN_WAIT_S`.

A fast scan asks "does a part of a node's address begin with these bits?"; all matching nodes respond with the
same frame, and there is no negative response. The master asks for both values of each bit, so all nodes are
found in the waiting state, without one of them being selected. In the configuration state many slaves respond
to every fast scan and to every selection whatever its data, and would look like any address; so two
contradictory requests confirm that all nodes are waiting before a search and before a selection, and the
identity of a selected node is inquired.

Most of the time is spent waiting for responses that don't come, so the master waits no longer than the nodes'
measured response times require, and tries known values as a whole first.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Collection, Iterable, Sequence

from handtouch.canbus import cia305
from handtouch.canbus.cia305 import LssAddress

MIN_WAIT_S = 0.005

_FIRST_WAIT_S, _SELECT_WAIT_S, _STORE_WAIT_S = 0.1, 0.2, 1.0
_MIN_SETTLE_S, _MAX_WAIT_S = 0.001, 0.5
_MAX_ATTEMPTS = 4
_MAX_PASSES = 5
_MAX_MISMATCHES = 6  # in a row, without finding a node
_MAX_VALUES = 127  # values of one part of the addresses; no bus has more nodes
_MAX_RESPONSES = 256  # responses of a babbling node must not delay the scan
_SERIAL_PART = 3
_CONTRADICTION = (0xB6D24F19, 0x492DB0E6)
"""Two serial numbers; a node that responds to both doesn't compare them."""
_ID_ERRORS = {1: "out of range"}
_STORE_ERRORS = {1: "it has no memory for it", 2: "its memory can't be written"}
_UNDETERMINED = (
    "a node without an id responds, but its identity can't be determined; is the bus disturbed? try a longer "
    "--lss-wait-ms"
)
_NOT_COMPARING = (
    "a node responds to every LSS request, whatever its data, also after LSS switch state global (waiting); "
    "nodes without an id can't be found while it is on the bus"
)

Exchange = Callable[[bytes | None, float], bytes | None]
"""Send a request (None: none) and return the first response, or None after that many seconds.

With a request, responses received before it are dropped.
"""


class LssError(Exception):
    """A node violates CiA 305; `str` names the node and the violation."""


class _ScanMismatch(Exception):  # noqa: N818 - responses were lost or late; the search is repeated
    """Responses contradict each other."""


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
        self.problems: list[str] = []
        self._exchange = exchange
        self._clock = clock
        self._response_timer = _ResponseTimer(min_wait_s)
        self._mismatches, self._is_incomplete = 0, False  # results of the present search

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

        Values given are tried as a whole before single bits. `problems` are the reasons why some nodes may be
        missing, and addresses that several nodes share.
        """
        known: list[list[int]] | None = [
            list(dict.fromkeys(values)) for values in (vendor_ids, product_codes, revisions)
        ]
        compares: dict[LssAddress, bool] = {}  # confirmed nodes; True: silent in the configuration state
        self.problems = []
        problem = ""
        try:
            for _ in range(_MAX_PASSES):
                responding, problem = self._search(known, [each for each in compares if compares[each]])
                known = None
                if not problem and responding <= compares.keys():
                    break
                for address in sorted(responding - compares.keys()):
                    try:
                        count = self._select(address)
                    except LssError:
                        problem = _UNDETERMINED
                        continue
                    compares[address] = not self.answers_contradiction()
                    if count > 1:
                        self.problems.append(_describe_duplicate(address))
        except LssError as error:
            problem = str(error)
        finally:
            self.deselect_all()
        if problem:
            self.problems.append(problem)
        return sorted(compares)

    def inquire_node_id(self, address: LssAddress) -> int | None:
        """Return the present id of a node, None if it has none. Raises LssError if it doesn't respond."""
        try:
            self._select(address)
            answer = self._request(struct.pack("<B7x", cia305.INQUIRE_ID), cia305.INQUIRE_ID, _SELECT_WAIT_S)
        finally:
            self.deselect_all()
        if answer is None:
            raise LssError(f"{address}: no response to the inquiry of its id")
        return None if answer[1] == cia305.UNCONFIGURED else answer[1]

    def assign_node_id(self, address: LssAddress, node_id: int) -> str:
        """Assign an id to a node, which uses it at once, and have it stored; bit timing is unchanged.

        Returns the reason if it isn't stored and will be lost at power-off, else "". Raises LssError if the
        node doesn't respond, refuses the id or shares its address with another, ValueError for an id outside
        1 to 127.
        """
        if not 1 <= node_id <= 127:
            raise ValueError(f"node id must be 1 to 127, got {node_id}")
        try:
            if self._select(address) > 1:
                raise LssError(_describe_duplicate(address))
            answer = self._request(
                struct.pack("<BB6x", cia305.CONFIGURE_ID, node_id), cia305.CONFIGURE_ID, _SELECT_WAIT_S
            )
            if answer is None or answer[1]:
                reason = "no answer" if answer is None else _ID_ERRORS.get(answer[1], f"error {answer[1]}")
                raise LssError(f"{address}: id {node_id} not accepted: {reason}")
            answer = self._request(struct.pack("<B7x", cia305.STORE), cia305.STORE, _STORE_WAIT_S)
        finally:
            self.deselect_all()
        self._confirm_waiting()  # the node uses its id from the waiting state on
        if answer is None:
            return f"no answer within {_STORE_WAIT_S:g} s"
        return _STORE_ERRORS.get(answer[1], f"error {answer[1]}") if answer[1] else ""

    def _search(
        self, known: Sequence[Collection[int]] | None, excluded: Collection[LssAddress]
    ) -> tuple[set[LssAddress], str]:
        """Return the unconfigured nodes but excluded ones, and the reason why some may be missing.

        `known` : vendor ids, product codes, revisions to search, or if none of them is present the smallest;
        None: search all
        """
        found: set[LssAddress] = set()
        self.deselect_all()
        if not self._start_search():
            return found, ""
        self._confirm_waiting()
        for address in excluded:
            self.request_selection(address)
        if excluded and self.answers_contradiction():
            self._confirm_waiting()
        self._mismatches, self._is_incomplete = 0, False
        self._response_timer.reset_backoff()
        try:
            if self._start_search():
                self._search_below((), known, found)
        except _ScanMismatch:
            self._is_incomplete = True
        return found, _UNDETERMINED if self._is_incomplete else ""

    def _search_below(
        self, path: tuple[int, ...], known: Sequence[Collection[int]] | None, found: set[LssAddress]
    ) -> None:
        """Find the nodes whose addresses begin with these parts. Raises _ScanMismatch."""
        part = len(path)
        self._enter(path)
        values: list[int] = []
        first_only = known is not None and part < _SERIAL_PART
        if known is not None and first_only:
            values = [value for value in known[part] if self._has_match(_scan_request(value, 0, part, part))]
        values = values or self._find_values(path, first_only)
        if not values:
            self._is_incomplete = True
            self._record_mismatch()
        for value in values:
            if part < _SERIAL_PART:
                self._search_below((*path, value), known, found)
            else:
                vendor_id, product_code, revision = path
                found.add(LssAddress(vendor_id, product_code, revision, value))

    def _enter(self, path: Sequence[int]) -> None:
        """Have the nodes whose addresses begin with these parts continue with the next part, and no others.

        Raises _ScanMismatch if there is none.
        """
        while not (
            self._start_search()
            and all(
                self._has_match(_scan_request(value, 0, part, part + 1)) for part, value in enumerate(path)
            )
        ):
            self._record_mismatch()

    def _find_values(
        self, path: tuple[int, ...], first_only: bool, prefix: int = 0, bit: int = 31
    ) -> list[int]:
        """Return the values of the part after `path` that begin with these bits, or the smallest one.

        Raises _ScanMismatch.
        """
        part = len(path)
        for _ in range(2):
            values: list[int] = []
            for value in (prefix, prefix | 1 << bit):
                if not self._has_match(_scan_request(value, bit, part, part)):
                    continue
                values += self._find_values(path, first_only, value, bit - 1) if bit else [value]
                if first_only and values:
                    break
                if not bit and part == _SERIAL_PART and self.answers_contradiction():
                    self._confirm_waiting()  # some nodes are selected by their serial number already
                    self._enter(path)
            if len(values) > _MAX_VALUES:
                raise _ScanMismatch
            if values:
                self._mismatches = 0
                self._response_timer.reset_backoff()
                return values
            self._record_mismatch()
        return []  # the response to these bits was a late one to other bits

    def _record_mismatch(self) -> None:
        """Wait longer for responses from now on. Raises _ScanMismatch after many mismatches in a row."""
        self._mismatches += 1
        if self._mismatches == _MAX_MISMATCHES:
            raise _ScanMismatch
        self._response_timer.back_off()

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
            for _ in range(_MAX_RESPONSES):  # responses of the slower ones
                if self._exchange(None, self._response_timer.wait_s) is None:
                    break
                last_ns = self._clock()
            self._response_timer.record_round((first_ns - sent_ns) * 1e-9, (last_ns - sent_ns) * 1e-9)
            return True
        return False

    def _has_match(self, request: bytes, patience: float = 1.0) -> bool:
        """Return True if a node responds in so many timeouts, after waiting for slower ones."""
        sent_ns = self._clock()
        if self._request(request, cia305.IS_SLAVE, patience * self._response_timer.wait_s) is None:
            return False
        response_s = (self._clock() - sent_ns) * 1e-9
        self._response_timer.record_response(response_s)
        settle_s = self._response_timer.settle_s(response_s)
        for _ in range(_MAX_RESPONSES if settle_s else 0):
            if self._exchange(None, settle_s) is None:
                break
        return True

    def _select(self, address: LssAddress) -> int:
        """Switch a node to the configuration state, all others to waiting, and confirm its identity.

        Returns the number of nodes that respond: 2 means two or more with one address, whose responses may
        also coincide. Raises LssError.
        """
        problem = ""
        for _ in range(2):
            self._confirm_waiting()
            if not self.request_selection(address):
                problem = problem or f"{address}: no response any more"
                continue
            responses = [self._inquire(command) for command in cia305.INQUIRE]
            if all(values <= {part} for (values, _), part in zip(responses, address.parts, strict=True)):
                return 2 if sum(count > 1 for _, count in responses) > 1 else 1
            problem = f"{address}: a node with another identity responds to its selection"
        raise LssError(problem)

    def request_selection(self, address: LssAddress) -> bool:
        """Switch a waiting node to the configuration state; return False if it doesn't respond."""
        answer = None
        for command, value in zip(cia305.SELECT, address.parts, strict=True):
            wait_s = _SELECT_WAIT_S if command == cia305.SELECT[-1] else self._response_timer.min_wait_s
            answer = self._request(struct.pack("<BI3x", command, value), cia305.SELECTED, wait_s)
        return answer is not None

    def _inquire(self, command: int) -> tuple[set[int], int]:
        """Return the values of a part of the selected nodes' addresses, and the number of responses.

        Nodes without the service, which CiA 305 leaves optional, don't respond.
        """
        values: set[int] = set()
        count = 0
        answer = self._request(struct.pack("<B7x", command), command, _SELECT_WAIT_S)
        while answer is not None and count < _MAX_RESPONSES:
            if len(answer) == 8 and answer[0] == command:
                values.add(int.from_bytes(answer[1:5], "little"))
                count += 1
            answer = self._exchange(None, self._response_timer.min_wait_s)
        return values, count

    def _confirm_waiting(self) -> None:
        """Switch all nodes to the waiting state until none responds to a contradiction. Raises LssError."""
        for attempt in range(_MAX_ATTEMPTS):
            self.deselect_all()
            if not self.answers_contradiction():
                return
            self._exchange(None, self._response_timer.min_wait_s * 2**attempt)
        raise LssError(_NOT_COMPARING)

    def answers_contradiction(self) -> bool:
        """Return True if a node responds to fast scans whatever their data."""
        return all(
            self._has_match(_scan_request(serial, 0, _SERIAL_PART, _SERIAL_PART), patience=2.0)
            for serial in _CONTRADICTION
        )

    def deselect_all(self) -> None:
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


def _describe_duplicate(address: LssAddress) -> str:
    return (
        f"{address}: several nodes respond; LSS can't distinguish them: give each its own serial number "
        "(0x1018 sub 4), or connect one at a time"
    )


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
        self._fastest_s = 0.0
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

    def settle_s(self, response_s: float) -> float:
        """Return the time to wait for slower nodes after a response; 0 if all respond at once.

        Which of the nodes respond isn't known, so the next one may be the slowest.
        """
        if self._factor > 1:
            return self.wait_s
        if self._slowest_s <= self._fastest_s:
            return 0.0
        return max(_MIN_SETTLE_S, 2 * self._slowest_s - response_s)

    def record_round(self, fastest_s: float, slowest_s: float) -> None:
        """Record the first and the last response time of a request to all nodes."""
        self.record_response(fastest_s)
        self._fastest_s, self._slowest_s = fastest_s, slowest_s

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
