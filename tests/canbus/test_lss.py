"""LSS: all unconfigured nodes are found within seconds and get ids; on a bus with simulated time."""

from __future__ import annotations

import heapq
import random
import struct
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch.canbus.cia305 import LssAddress
from handtouch.canbus.find.lss import LssError, LssMaster
from handtouch.device.lss import LssSlave

VENDOR, PRODUCT, REVISION = 0x2F1, 0x401, 0x10000


class Bus:
    """Slaves that answer after a time of their own each, and a clock that only their answers move."""

    def __init__(
        self,
        slaves: Sequence[LssSlave],
        delays_s: Sequence[float] = (0.0005,),
        *,
        merging: bool = False,
        lost: float = 0.0,
        jitter: float = 1.0,
    ) -> None:
        self.slaves = slaves
        self.t_ns = 1_000_000_000
        self.sent: list[bytes] = []
        self._delays_s = delays_s
        self._merging = merging
        self._lost = lost
        self._jitter = jitter  # an answer takes so many times longer or shorter, by chance
        self._coming: list[tuple[int, bytes]] = []
        self.random = random.Random(7)

    def exchange(self, request: bytes | None, timeout_s: float) -> bytes | None:
        if request is not None:
            self._send(request)
        end_ns = self.t_ns + round(timeout_s * 1e9)
        if self._coming and self._coming[0][0] <= end_ns:
            at_ns, answer = heapq.heappop(self._coming)
            while self._merging and (at_ns, answer) in self._coming:  # the same bits at the same time are one
                self._coming.remove((at_ns, answer))
                heapq.heapify(self._coming)
            self.t_ns = max(self.t_ns, at_ns)
            return answer
        self.t_ns = end_ns
        return None

    def _send(self, request: bytes) -> None:
        self.sent.append(request)
        self._coming = [item for item in self._coming if item[0] > self.t_ns]
        heapq.heapify(self._coming)
        for number, slave in enumerate(self.slaves):
            answer = slave.handle_request(request)
            if answer is not None and self.random.random() >= self._lost:
                delay_s = self._delays_s[number % len(self._delays_s)]
                delay_s *= self._jitter ** self.random.uniform(-1, 1)
                heapq.heappush(self._coming, (self.t_ns + round(delay_s * 1e9), answer))

    def master(self, least_wait_s: float = 0.005) -> LssMaster:
        return LssMaster(self.exchange, least_wait_s, clock=lambda: self.t_ns)

    @property
    def seconds(self) -> float:
        return self.t_ns * 1e-9 - 1.0


def address(serial: int, revision: int = REVISION) -> LssAddress:
    return LssAddress(VENDOR, PRODUCT, revision, serial)


def pads(count: int, *, compares: bool = True) -> list[LssSlave]:
    """Return unconfigured slaves with random serial numbers of 32 bits."""
    numbers = random.Random(3)
    return [LssSlave(address(numbers.getrandbits(32)), compares=compares) for _ in range(count)]


def frame(*values: int) -> bytes:
    return bytes(values).ljust(8, b"\0")


words = st.one_of(
    st.integers(0, 0xFFFFFFFF),
    st.integers(1000, 1015),
    st.integers(0, 31).map(lambda bit: 1 << bit),
    st.sampled_from([0, 0xFFFFFFFF, 0xFFFFFFFE, 0x80000000]),
)
addresses = st.builds(
    LssAddress, st.sampled_from([VENDOR, VENDOR ^ 1, 0]), st.sampled_from([PRODUCT, 0]), words, words
)


@settings(max_examples=75, deadline=None)
@given(
    present=st.dictionaries(addresses, st.booleans(), min_size=1, max_size=12),
    delays_s=st.lists(st.floats(0.0001, 0.02), min_size=1, max_size=4),
    merging=st.booleans(),
)
def test_any_set_of_nodes_is_found_completely_and_gets_unique_ids(
    present: dict[LssAddress, bool], delays_s: list[float], merging: bool
) -> None:
    """Nodes that don't compare LSS requests in the configuration state are mixed with those that do."""
    slaves = [LssSlave(each, compares=present[each]) for each in sorted(present, key=hash)]
    bus = Bus(slaves, delays_s, merging=merging)
    master = bus.master()
    found = master.scan(vendor_ids=[VENDOR])
    assert found == sorted(present)
    assert master.problems == []
    for node_id, each in enumerate(found, 0x20):
        assert master.assign_node_id(each, node_id) == ""
    assert {slave.address: slave.node_id for slave in slaves} == {
        each: node_id for node_id, each in enumerate(found, 0x20)
    }
    assert all(slave.stored_id == slave.node_id and not slave.configuring for slave in slaves)
    assert master.scan() == []


@settings(max_examples=20, deadline=None)
@given(present=st.dictionaries(addresses, st.booleans(), min_size=1, max_size=6))
def test_a_scan_changes_no_node(present: dict[LssAddress, bool]) -> None:
    slaves = [LssSlave(each, compares=compares) for each, compares in present.items()]
    slaves.append(LssSlave(address(77), node_id=5))
    master = Bus(slaves).master()
    assert master.scan() == sorted(present)
    assert master.scan() == sorted(present)
    assert [slave.node_id for slave in slaves] == [None] * len(present) + [5]
    assert not any(slave.configuring for slave in slaves)


@pytest.mark.parametrize("compares", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_lost_responses_cost_time_but_no_node(seed: int, compares: bool) -> None:
    bus = Bus(pads(6, compares=compares), (0.0004, 0.0011), lost=0.01)
    bus.random.seed(seed)
    assert bus.master().scan() == sorted(slave.address for slave in bus.slaves)


@pytest.mark.parametrize("compares", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_responses_with_jitter_cost_time_but_no_node(seed: int, compares: bool) -> None:
    bus = Bus(pads(6, compares=compares), (0.002,), jitter=4.0)
    bus.random.seed(seed)
    assert bus.master().scan() == sorted(slave.address for slave in bus.slaves)


def test_the_slowest_node_is_awaited_where_those_between_do_not_match() -> None:
    """The gap between the fastest and the slowest is wider than any between two nodes that follow."""
    slaves = [LssSlave(address(1 << bit), compares=False) for bit in (13, 8, 12, 0, 6, 7)]
    master = Bus(slaves, (0.0005, 0.0035, 0.0065, 0.0095)).master()
    assert master.scan() == sorted(slave.address for slave in slaves)
    assert master.problems == []


@pytest.mark.parametrize("compares", [True, False])
@pytest.mark.parametrize("seed", [3, 14, 29, 41, 58])
def test_nodes_missed_after_late_responses_are_a_problem(seed: int, compares: bool) -> None:
    bus = Bus(pads(6, compares=compares), (0.002, 0.004), jitter=8.0)
    bus.random.seed(seed)
    master = bus.master()
    found = master.scan()
    assert master.problems or found == sorted(slave.address for slave in bus.slaves)


@pytest.mark.parametrize("compares", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_very_bad_bus_yields_a_problem_and_no_false_node(seed: int, compares: bool) -> None:
    bus = Bus(pads(6, compares=compares), lost=0.2)
    bus.random.seed(seed)
    master = bus.master()
    found = set(master.scan())
    present = {slave.address for slave in bus.slaves}
    assert found <= present
    assert found == present or master.problems


@pytest.mark.parametrize(("compares", "limit_s"), [(True, 3.5), (False, 6.0)])
def test_eight_nodes_are_found_within_seconds_on_a_bus_that_answers_in_half_a_millisecond(
    compares: bool, limit_s: float
) -> None:
    bus = Bus(pads(8, compares=compares), (0.0005, 0.0007, 0.0009))
    assert len(bus.master().scan()) == 8
    assert bus.seconds < limit_s


def test_known_values_are_tried_as_a_whole() -> None:
    blind, expected = Bus(pads(1)), Bus(pads(1))
    assert blind.master().scan() == expected.master().scan([9, VENDOR], [PRODUCT], [REVISION])
    assert len(expected.sent) < len(blind.sent) - 90  # three parts in four requests instead of 99


def test_bus_without_nodes_is_known_after_the_first_timeout() -> None:
    bus = Bus([])
    assert bus.master().scan() == []
    assert bus.seconds < 0.3


def test_timeout_adapts_to_slow_and_fast_nodes() -> None:
    fast, slow = Bus(pads(1), (0.0005,)), Bus(pads(1), (0.03,))
    for bus in (fast, slow):
        assert bus.master().scan() == [bus.slaves[0].address]
    assert slow.seconds > 4 * fast.seconds


def test_timeout_is_never_below_the_minimum() -> None:
    bus = Bus(pads(1))
    master = bus.master(least_wait_s=0.02)
    master.scan()
    assert master.wait_s >= 0.02


def test_a_node_that_cannot_store_is_reported_and_uses_its_id_until_power_off() -> None:
    slave = LssSlave(address(1), can_store=False)
    master = Bus([slave]).master()
    assert master.assign_node_id(slave.address, 9) == "it has no memory for it"
    assert slave.node_id == 9
    slave.power_on()
    assert slave.node_id is None


def test_a_node_keeps_a_stored_id() -> None:
    slave = LssSlave(address(1))
    assert Bus([slave]).master().assign_node_id(slave.address, 9) == ""
    slave.power_on()
    assert slave.node_id == 9


def test_a_node_reports_its_id_and_uses_a_changed_one_after_a_reset() -> None:
    slave = LssSlave(address(1), node_id=5)
    master = Bus([LssSlave(address(2)), slave]).master()
    assert master.inquire_node_id(slave.address) == 5
    assert master.inquire_node_id(address(2)) is None
    assert master.assign_node_id(slave.address, 6) == ""
    assert slave.node_id == 5
    slave.reset()
    assert slave.node_id == 6


def test_a_missing_node_is_named() -> None:
    master = Bus([LssSlave(address(1))]).master()
    with pytest.raises(LssError, match=r"serial 2: no response"):
        master.assign_node_id(address(2), 9)
    with pytest.raises(LssError, match=r"serial 2: no response"):
        master.inquire_node_id(address(2))


@pytest.mark.parametrize("node_id", [0, 128, 255])
def test_an_invalid_id_is_refused_before_anything_is_sent(node_id: int) -> None:
    bus = Bus([LssSlave(address(1))])
    with pytest.raises(ValueError, match="1 to 127"):
        bus.master().assign_node_id(address(1), node_id)
    assert bus.sent == []


def test_bit_timing_is_never_changed() -> None:
    bus = Bus(pads(3))
    master = bus.master()
    for each in master.scan():
        master.assign_node_id(each, 5)
    assert not {request[0] for request in bus.sent} & {0x13, 0x15}


class Restless(LssSlave):
    """Leaves the configuration state at any fast scan."""

    def handle_request(self, data: bytes) -> bytes | None:
        answer = super().handle_request(data)
        if data[0] == 0x51:
            self.configuring = False
        return answer


def test_a_node_that_does_not_stay_selected_is_found_once() -> None:
    master = Bus([Restless(address(1)), LssSlave(address(2))]).master()
    assert master.scan() == [address(1), address(2)]
    assert master.problems == []


class Eager(LssSlave):
    """Enters the configuration state at its serial number, though the master remains at that part."""

    def handle_request(self, data: bytes) -> bytes | None:
        answer = super().handle_request(data)
        if answer is not None and data[0] == 0x51 and data[5:7] == bytes((0, 3)):
            self.configuring = True
        return answer


@pytest.mark.parametrize("compares", [True, False])
def test_nodes_that_are_selected_by_their_serial_number_alone_are_found(compares: bool) -> None:
    slaves = [Eager(slave.address, compares=compares) for slave in pads(4)]
    bus = Bus(slaves)
    master = bus.master()
    assert master.scan() == sorted(slave.address for slave in slaves)
    assert master.problems == []
    assert bus.seconds < 6.0


class Deaf(LssSlave):
    """Misses some requests to return to the waiting state: its last response is still being sent."""

    missing = 0

    def handle_request(self, data: bytes) -> bytes | None:
        if data[0] == 0x04 and self.configuring and self.missing:
            self.missing -= 1
            return None
        return super().handle_request(data)


def test_a_node_left_in_the_configuration_state_is_switched_back_before_the_search() -> None:
    slaves: list[LssSlave] = [Deaf(address(5), compares=False), *pads(2, compares=False)]
    assert isinstance(slaves[0], Deaf)
    slaves[0].configuring, slaves[0].missing = True, 2
    master = Bus(slaves).master()
    assert master.scan() == sorted(slave.address for slave in slaves)
    assert master.problems == []


def test_a_node_left_in_the_configuration_state_gets_no_id_of_another() -> None:
    left, other = Deaf(address(5), compares=False), LssSlave(address(6), compares=False)
    left.configuring, left.missing = True, 2
    assert Bus([left, other]).master().assign_node_id(other.address, 9) == ""
    assert (left.node_id, other.node_id) == (None, 9)


def test_a_node_that_never_compares_is_reported_and_changes_nothing() -> None:
    left = Deaf(address(5), compares=False)
    left.configuring, left.missing = True, 1000
    master = Bus([left, LssSlave(address(6))]).master()
    assert master.scan() == []
    assert "responds to every LSS request" in master.problems[0]
    with pytest.raises(LssError, match="responds to every LSS request"):
        master.assign_node_id(address(6), 9)
    assert left.node_id is None


@pytest.mark.parametrize("compares", [True, False])
def test_nodes_with_one_address_are_reported_and_get_no_id(compares: bool) -> None:
    twins = [LssSlave(address(7), compares=compares) for _ in range(2)]
    bus = Bus([*twins, LssSlave(address(8))], (0.0004, 0.0006, 0.0005))
    master = bus.master()
    assert master.scan() == [address(7), address(8)]
    assert len(master.problems) == 1
    assert "serial 7: several nodes respond" in master.problems[0]
    with pytest.raises(LssError, match="serial 7: several nodes respond"):
        master.assign_node_id(address(7), 9)
    assert master.assign_node_id(address(8), 10) == ""
    assert [slave.node_id for slave in bus.slaves] == [None, None, 10]


class Mute(LssSlave):
    """Lacks the optional inquiry of its address."""

    def handle_request(self, data: bytes) -> bytes | None:
        return None if data[0] in (0x5A, 0x5B, 0x5C, 0x5D) else super().handle_request(data)


def test_a_node_without_the_inquiry_of_its_address_is_found_and_gets_an_id() -> None:
    slave = Mute(address(7))
    master = Bus([slave]).master()
    assert master.scan() == [address(7)]
    assert master.assign_node_id(address(7), 9) == ""
    assert slave.node_id == 9


class Impostor(LssSlave):
    """Responds to the selection of any node."""

    def handle_request(self, data: bytes) -> bytes | None:
        if data[0] == 0x43:
            self.configuring = True
            return frame(0x44)
        return super().handle_request(data)


def test_a_selected_node_with_another_identity_gets_no_id() -> None:
    slave = Impostor(address(7))
    master = Bus([slave]).master()
    assert master.scan() == [address(7)]
    with pytest.raises(LssError, match="serial 8: a node with another identity"):
        master.assign_node_id(address(8), 9)
    assert slave.node_id is None


class Contrary(LssSlave):
    """Says yes to every bit, and no to the value."""

    def handle_request(self, data: bytes) -> bytes | None:
        return frame(0x4F) if data[0] == 0x51 and data[5] else None


def test_a_node_that_contradicts_itself_ends_the_scan_with_a_reason() -> None:
    master = Bus([Contrary(address(1))]).master()
    assert master.scan() == []
    assert "its identity can't be determined" in master.problems[0]


# The slave alone: what CiA 305 says of each request.


def test_a_fast_scan_is_for_nodes_without_an_id_in_the_waiting_state() -> None:
    confirm = frame(0x51, 0, 0, 0, 0, 0x80)
    slave = LssSlave(address(1))
    assert slave.handle_request(confirm) == frame(0x4F)
    slave.handle_request(frame(0x04, 1))
    assert slave.handle_request(confirm) is None
    assert LssSlave(address(1), node_id=3).handle_request(confirm) is None


def test_a_fast_scan_goes_through_the_parts_in_their_order_only() -> None:
    slave = LssSlave(address(1))
    wrong = struct.pack("<BIBBB", 0x51, PRODUCT, 0, 1, 2)
    assert slave.handle_request(wrong) is None
    assert slave.handle_request(struct.pack("<BIBBB", 0x51, VENDOR, 0, 0, 1)) == frame(0x4F)
    assert slave.handle_request(wrong) == frame(0x4F)


def test_a_slave_that_does_not_compare_responds_to_everything_in_the_configuration_state_only() -> None:
    slave = LssSlave(address(1), compares=False)
    requests = (frame(0x51, 9, 9, 9, 9, 0, 2, 3), frame(0x43, 9, 9, 9, 9))
    assert [slave.handle_request(request) for request in requests] == [None, None]
    slave.handle_request(frame(0x04, 1))
    assert [slave.handle_request(request) for request in requests] == [frame(0x4F), frame(0x44)]
    slave.handle_request(frame(0x04, 0))
    assert [slave.handle_request(request) for request in requests] == [None, None]


def test_only_the_node_that_is_named_is_selected() -> None:
    slaves = [LssSlave(address(1)), LssSlave(address(2))]
    answers = [
        [slave.handle_request(struct.pack("<BI3x", command, value)) for slave in slaves]
        for command, value in zip((0x40, 0x41, 0x42, 0x43), address(2).parts, strict=True)
    ]
    assert answers == [[None, None]] * 3 + [[None, frame(0x44)]]
    assert [slave.configuring for slave in slaves] == [False, True]


def test_an_address_in_the_wrong_order_selects_no_node() -> None:
    slave = LssSlave(address(1))
    for command, value in zip((0x40, 0x42, 0x41, 0x43), address(1).parts, strict=True):
        assert slave.handle_request(struct.pack("<BI3x", command, value)) is None
    assert not slave.configuring


@pytest.mark.parametrize(
    ("serials", "expected"), [((1, 5), 0x4F), ((3, 3), 0x4F), ((4, 9), None), ((0, 2), None)]
)
def test_a_node_in_the_range_asked_for_answers(serials: tuple[int, int], expected: int | None) -> None:
    slave = LssSlave(address(3), node_id=8)
    values = (VENDOR, PRODUCT, 0, 0xFFFFFFFF, *serials)
    answers = [slave.handle_request(struct.pack("<BI3x", 0x46 + n, value)) for n, value in enumerate(values)]
    assert answers == [None] * 5 + [frame(expected) if expected else None]


def test_unconfigured_nodes_respond_to_their_inquiry() -> None:
    assert LssSlave(address(1)).handle_request(frame(0x4C)) == frame(0x50)
    assert LssSlave(address(1), node_id=1).handle_request(frame(0x4C)) is None


def test_identity_and_id_are_returned_in_the_configuration_state_only() -> None:
    slave = LssSlave(address(0x01020304), node_id=7)
    assert slave.handle_request(frame(0x5D)) is None
    slave.handle_request(frame(0x04, 1))
    assert slave.handle_request(frame(0x5D)) == frame(0x5D, 4, 3, 2, 1)
    assert slave.handle_request(frame(0x5A)) == frame(0x5A, 0xF1, 0x02)
    assert slave.handle_request(frame(0x5E)) == frame(0x5E, 7)


@pytest.mark.parametrize("node_id", [0, 128, 254])
def test_a_slave_refuses_an_id_out_of_range(node_id: int) -> None:
    slave = LssSlave(address(1))
    slave.handle_request(frame(0x04, 1))
    assert slave.handle_request(frame(0x11, node_id)) == frame(0x11, 1)
    slave.handle_request(frame(0x04, 0))
    assert slave.node_id is None


@given(st.binary(max_size=12), st.booleans())
def test_no_frame_raises_in_a_slave(data: bytes, configuring: bool) -> None:
    slave = LssSlave(address(1))
    slave.configuring = configuring
    answer = slave.handle_request(data)
    assert answer is None or len(answer) == 8
    assert len(data) == 8 or (answer is None and slave.rejected == 1)
