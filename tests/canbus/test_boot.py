"""Boot steps over SDO: values read from and written to a node, and error texts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from handtouch.canbus.nodes.boot import (
    check_identity,
    check_settings,
    configure_node,
    read_identity,
)
from handtouch.canbus.nodes.spec import Identity, NodeSpec
from handtouch.canbus.objects.mapping import NodeTpdo, PdoMapping, read_mapping
from handtouch.canbus.objects.sdo import BootStepCancelled, BootStepError, NodeSdoClient, SdoTransport
from handtouch.config.channels import (
    STANDARD_CHANNELS,
    Channel,
    Channels,
)
from handtouch.core.slab import STANDARD_LAYOUT, ChannelField

CHANNELS = (0x64010110, 0x64010210, 0x64010310, 0x64010410)
ABORT_NO_OBJECT, ABORT_NO_SUB = 0x06020000, 0x06090011


class Node:
    """An SDO server of objects in a dictionary; answers at once. `deaf`: objects it never answers for."""

    def __init__(self, objects: dict[tuple[int, int], tuple[int, int]]) -> None:
        self.objects = objects  # (index, sub) -> (value, size)
        self.writes: list[tuple[int, int, int]] = []
        self.halts: list[bool] = []
        self.deaf: set[int] = set()
        self.forgets: set[int] = set()
        self._respond: Callable[[int, bytes], bool] = self.answer
        self.transport = SdoTransport(5, self._send, timeout_s=0.005)
        self.sdo = NodeSdoClient(self.transport)

    def intercept(self, respond: Callable[[int, bytes], bool]) -> None:
        """Have another function answer instead of `answer`."""
        self._respond = respond

    def _send(self, can_id: int, data: bytes) -> bool:
        return self._respond(can_id, data)

    def answer(self, can_id: int, data: bytes) -> bool:
        assert can_id == 0x605
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        if index in self.deaf or data[0] == 0x80:
            return True
        if (index, sub) not in self.objects:
            code = ABORT_NO_SUB if any(i == index for i, _ in self.objects) else ABORT_NO_OBJECT
            self.transport.deliver_response(b"\x80" + data[1:4] + code.to_bytes(4, "little"))
        elif data[0] & 0xE0 == 0x40:
            value, size = self.objects[index, sub]
            head = bytes((0x43 | (4 - size) << 2,))
            self.transport.deliver_response(head + data[1:4] + value.to_bytes(size, "little").ljust(4, b"\0"))
        else:
            size = 4 - (data[0] >> 2 & 3)
            value = int.from_bytes(data[4 : 4 + size], "little")
            assert size == self.objects[index, sub][1]
            if index not in self.forgets:
                self.objects[index, sub] = (value, size)
            self.writes.append((index, sub, value))
            self.transport.deliver_response(b"\x60" + data[1:4] + bytes(4))
        return True


def tpdo(
    number: int, entries: tuple[int, ...], cob_id: int, transmission: int = 1
) -> dict[tuple[int, int], tuple[int, int]]:
    mapping = {(0x1A00 + number - 1, sub): (entry, 4) for sub, entry in enumerate(entries, 1)}
    communication = {(0x1800 + number - 1, 1): (cob_id, 4), (0x1800 + number - 1, 2): (transmission, 1)}
    return {(0x1A00 + number - 1, 0): (len(entries), 1)} | mapping | communication


def spec(**changes: Any) -> NodeSpec:
    """Return what the deployment states of the node."""
    return NodeSpec(0, "can0", 5, "hand/pad", **changes)


def found(enabled: bool = True, transmission: int = 1) -> NodeTpdo:
    return NodeTpdo(2, 0x285, enabled, transmission, CHANNELS)


def identity(*values: int) -> dict[tuple[int, int], tuple[int, int]]:
    return {(0x1018, sub): (value, 4) for sub, value in enumerate(values, 1)}


def test_all_parts_of_the_identity_are_read() -> None:
    found = read_identity(Node(identity(1, 2, 3, 4)).sdo)
    assert found == Identity(1, 2, 3, 4)
    check_identity(found, spec(vendor_id=1, product_code=2, revision=3, serial=4))


def test_only_the_vendor_id_is_mandatory() -> None:
    assert read_identity(Node(identity(9)).sdo) == Identity(9)


def test_node_without_serial_number_is_not_the_one_with_the_configured_one() -> None:
    with pytest.raises(BootStepError, match=r"serial number is none, as 0x1018:04 .* is 4") as caught:
        check_identity(Identity(1, 2, 3), spec(serial=4))
    assert caught.value.wrong_device


@pytest.mark.parametrize("configured", [None, 6])
def test_node_of_another_pad_is_refused_and_named(configured: int | None) -> None:
    """Also without a configured serial number, as where nodes may be replaced."""
    others = {4: "h/thumb on can0", 5: "h/index on can1"}
    check_identity(Identity(1, 2, 3, 6), spec(serial=configured, serials_of_other_pads=others))
    with pytest.raises(
        BootStepError, match=r"is 5 \(0x5\), which is configured for h/index on can1; .*swapped"
    ) as caught:
        check_identity(Identity(1, 2, 3, 5), spec(serial=configured, serials_of_other_pads=others))
    assert caught.value.wrong_device
    expected = spec(vendor_id=8, serial=configured, serials_of_other_pads=others)
    with pytest.raises(BootStepError, match="vendor id is 1"):  # makers number their nodes alike
        check_identity(Identity(1, 2, 3, 5), expected)


WIDE: Channels = (
    Channel(0x9130, 1, 32),
    Channel(0x9130, 2, 32),
    Channel(0x9130, 3, 32),
    Channel(0x9130, 4, 32),
)


def mapping_of(node: Node, channels: Channels = STANDARD_CHANNELS, remap: bool = False) -> PdoMapping:
    halt = (lambda: node.halts.append(True)) if remap else None
    return read_mapping(node.sdo, 5, (2, 1, 3, 4), channels, halt)


def test_mapping_is_found_in_whatever_tpdo_carries_it() -> None:
    node = Node(tpdo(1, (0x60000108,), 0x185) | tpdo(3, CHANNELS, 0x385, 255))
    assert mapping_of(node) == PdoMapping((NodeTpdo(3, 0x385, True, 255, CHANNELS),), STANDARD_LAYOUT)


def test_channels_are_found_in_any_order_between_other_objects() -> None:
    """A status byte, a dummy of 8 bits, and the channels backwards."""
    entries = (0x20000108, 0x64010410, 0x64010310, 0x00050008, 0x64010210)
    node = Node(tpdo(1, (0x64010110, 0x20000208), 0x185) | tpdo(2, entries, 0x285))
    found = mapping_of(node)
    assert [(t.number, t.size_bytes) for t in found.tpdos] == [(2, 8), (1, 3)]
    assert found.layout == (
        ChannelField(1, 0, 16, True),
        ChannelField(0, 48, 16, True),
        ChannelField(0, 24, 16, True),
        ChannelField(0, 8, 16, True),
    )


def test_one_tpdo_with_all_channels_goes_before_several() -> None:
    node = Node(tpdo(2, CHANNELS[:2], 0x285) | tpdo(1, CHANNELS, 0x185))
    assert [t.number for t in mapping_of(node).tpdos] == [1]


@pytest.mark.parametrize(
    ("objects", "expected"),
    [
        ({}, "the node has no TPDO"),
        (tpdo(1, (), 0x185), "TPDO1 has nothing"),
        (
            tpdo(1, CHANNELS[:3], 0x185),
            r"TPDO1 has 0x6401:01 \(16 bit\), 0x6401:02 \(16 bit\), 0x6401:03 \(16 bit\); map",
        ),
        (tpdo(1, (0x64010120, 0x64010220), 0x185), r"TPDO1 carries 0x6401:01 \(16 bit\) with 32 bits"),
        (tpdo(2, CHANNELS, 0x20000285), "no 11-bit COB-ID"),
        (tpdo(2, CHANNELS, 0x80000000), "no 11-bit COB-ID"),
        ({(0x1A01, 0): (255, 1)}, "TPDO2 has nothing"),
    ],
)
def test_unusable_mapping_is_reported_with_its_entries(
    objects: dict[tuple[int, int], tuple[int, int]], expected: str
) -> None:
    with pytest.raises(BootStepError, match=expected):
        mapping_of(Node(objects))


def test_channels_in_no_tpdo_are_mapped_to_one_that_carries_nothing_else() -> None:
    """The order of CiA 301, disable, clear, write, count, and only in pre-operational."""
    node = Node(tpdo(2, (0x60000108,), 0x285) | tpdo(3, (), 0x80000385, 255))
    node.objects |= {(0x1A02, sub): (0, 4) for sub in (1, 2, 3, 4)}
    found = mapping_of(node, remap=True)
    assert found == PdoMapping((NodeTpdo(3, 0x385, False, 255, CHANNELS),), STANDARD_LAYOUT)
    assert node.halts == [True]
    assert node.writes == [*((0x1A02, sub, entry) for sub, entry in enumerate(CHANNELS, 1)), (0x1A02, 0, 4)]
    assert node.objects[0x1A01, 1] == (0x60000108, 4)


def test_channels_too_wide_for_one_tpdo_are_mapped_to_two() -> None:
    node = Node(tpdo(1, (), 0x80000185) | tpdo(2, (0x91300120,), 0x285) | tpdo(4, (0x60000108,), 0x485))
    node.objects |= {(index, sub): (0, 4) for index in (0x1A00, 0x1A01) for sub in (1, 2)}
    found = mapping_of(node, WIDE, remap=True)
    assert [(t.number, t.cob_id, t.size_bytes, t.enabled) for t in found.tpdos] == [
        (2, 0x285, 8, False),
        (1, 0x185, 8, False),
    ]
    assert [(field.pdo, field.first_bit) for field in found.layout] == [(0, 0), (0, 32), (1, 0), (1, 32)]


def test_tpdos_with_other_objects_are_never_remapped() -> None:
    node = Node(tpdo(1, (0x60000108,), 0x185) | tpdo(2, (0x64010110, 0x20000108), 0x285))
    with pytest.raises(BootStepError, match="without other objects: 0, needed to map them: 1"):
        mapping_of(node, remap=True)
    assert node.writes == []
    assert node.halts == []


@pytest.mark.parametrize(
    ("found", "heartbeat", "writes", "halts"),
    [
        (found(), 100, [], 0),
        (found(), 0, [(0x1017, 0, 100)], 0),
        (
            found(transmission=255),
            100,
            [(0x1801, 1, 0x80000285), (0x1801, 2, 1), (0x1801, 1, 0x285)],  # taken over at enabling
            1,
        ),
        (found(enabled=False), 100, [(0x1801, 1, 0x285)], 1),
        (found(enabled=False, transmission=0), 0, [(0x1801, 2, 1), (0x1801, 1, 0x285), (0x1017, 0, 100)], 1),
    ],
)
def test_only_differences_are_written_and_only_pdo_changes_need_pre_operational(
    found: NodeTpdo, heartbeat: int, writes: list[tuple[int, int, int]], halts: int
) -> None:
    cob_id = found.cob_id | (0 if found.enabled else 1 << 31)
    node = Node(tpdo(2, CHANNELS, cob_id, found.transmission_type) | {(0x1017, 0): (heartbeat, 2)})
    halted: list[bool] = []
    made = configure_node(
        node.sdo, PdoMapping((found,), STANDARD_LAYOUT), spec(heartbeat_ms=100), lambda: halted.append(True)
    )
    assert not made.guarded
    assert (node.writes, len(halted)) == (writes, halts)


def test_node_without_heartbeat_gets_it_as_guard_time() -> None:
    node = Node(tpdo(2, CHANNELS, 0x285) | {(0x100C, 0): (0, 2), (0x100D, 0): (0, 1)})
    assert configure_node(
        node.sdo, PdoMapping((found(),), STANDARD_LAYOUT), spec(heartbeat_ms=150), lambda: None
    ).guarded
    assert node.writes == [(0x100C, 0, 150), (0x100D, 0, 30)]


def test_node_without_heartbeat_and_guard_time_is_guarded_all_the_same() -> None:
    assert configure_node(
        Node({}).sdo, PdoMapping((found(),), STANDARD_LAYOUT), spec(heartbeat_ms=150), lambda: None
    ).guarded


def test_transmission_type_of_a_strict_node_is_changed_with_its_pdo_disabled() -> None:
    node = Node(tpdo(2, CHANNELS, 0x285, 255) | {(0x1017, 0): (100, 2)})
    plain = node.answer

    def strict(can_id: int, data: bytes) -> bool:
        valid = not node.objects[0x1801, 1][0] >> 31
        if data[0] & 0xE0 == 0x20 and data[1:4] == b"\x01\x18\x02" and valid:
            node.transport.deliver_response(b"\x80\x01\x18\x02" + (0x08000022).to_bytes(4, "little"))
            return True
        return plain(can_id, data)

    node.intercept(strict)
    configure_node(
        node.sdo,
        PdoMapping((found(transmission=255),), STANDARD_LAYOUT),
        spec(heartbeat_ms=100),
        lambda: None,
    )
    assert node.writes == [(0x1801, 1, 0x80000285), (0x1801, 2, 1), (0x1801, 1, 0x285)]


def test_value_that_is_not_kept_is_an_error() -> None:
    node = Node({(0x1017, 0): (0, 2)})
    node.forgets.add(0x1017)
    with pytest.raises(BootStepError, match="heartbeat time, 0x1017:00, was set to 100 but reads 0"):
        configure_node(
            node.sdo, PdoMapping((found(),), STANDARD_LAYOUT), spec(heartbeat_ms=100), lambda: None
        )


def test_timeout_and_refusal_are_distinguished() -> None:
    node = Node(identity(1))
    node.deaf.add(0x1018)
    with pytest.raises(BootStepError, match="reading vendor id, 0x1018:01: no answer") as silence:
        read_identity(node.sdo)
    assert silence.value.timed_out
    with pytest.raises(
        BootStepError, match=r"refused by the node \(Code 0x06020000, Object does not exist\)"
    ) as refusal:
        Node({}).sdo.read(0x1017, 0, "heartbeat time")
    assert not refusal.value.timed_out


def test_responses_for_other_objects_are_ignored() -> None:
    """An answer to a probe, to another master or to an earlier request that came too late."""
    node = Node({(0x1017, 0): (100, 2)})
    plain = node.answer

    def with_noise(can_id: int, data: bytes) -> bool:
        node.transport.deliver_response(bytes.fromhex("4300100091010f00"))
        node.transport.deliver_response(bytes.fromhex("6018100400000000"))
        node.transport.deliver_response(bytes.fromhex("8000100000000206"))
        return plain(can_id, data)

    node.intercept(with_noise)
    assert node.sdo.read(0x1017, 0, "heartbeat time") == 100


@pytest.mark.parametrize(
    ("response", "received"),
    [
        ("4310", "43 10, 2 bytes instead of 8"),
        ("", "no data, 0 bytes instead of 8"),
        ("43001000 91010f00", "43 00 10 00 91 01 0f 00"),
    ],
)
def test_timeout_after_invalid_responses_names_the_last_one(response: str, received: str) -> None:
    node = Node({(0x1017, 0): (100, 2)})

    def invalid(_id: int, _data: bytes) -> bool:
        node.transport.deliver_response(bytes.fromhex(response))
        return True

    node.intercept(invalid)
    with pytest.raises(BootStepError) as error:
        node.sdo.read(0x1017, 0, "heartbeat time")
    assert str(error.value).endswith(f"no valid SDO response within 5 ms in 2 attempts; received: {received}")
    node.intercept(lambda _id, _data: True)
    with pytest.raises(BootStepError, match="no answer within 5 ms in 2 attempts"):
        node.sdo.read(0x1017, 0, "heartbeat time")


def test_late_responses_to_earlier_requests_are_reported_as_late() -> None:
    node = Node(identity(7))
    assert node.sdo.read(0x1018, 1, "vendor id")

    def late(_id: int, _data: bytes) -> bool:
        node.transport.deliver_response(bytes.fromhex("4318100107000000"))
        return True

    node.intercept(late)
    with pytest.raises(
        BootStepError, match="attempts, but a late one to an earlier request, 0x1018:01;"
    ) as e:
        node.sdo.read(0x1018, 2, "product code")
    assert e.value.timed_out


def test_answers_of_a_server_one_request_behind_are_taken_for_the_requests_they_answer() -> None:
    """Each request is repeated before its answer comes, so each is answered twice, in their order."""
    node = Node({(0x1017, 0): (0, 2)})
    plain, waiting = node.answer, list[bytes]()

    def behind(can_id: int, data: bytes) -> bool:
        if data[0] != 0x80:
            waiting.append(data)
        return len(waiting) < 2 or data[0] == 0x80 or plain(can_id, waiting.pop(0))

    node.intercept(behind)
    node.sdo.write_if_different(0x1017, 0, 100, "heartbeat time")
    assert node.objects[0x1017, 0] == (100, 2)
    assert node.sdo.read(0x1017, 0, "heartbeat time") == 100


def test_second_answer_of_two_nodes_with_one_id_is_no_answer_to_the_next_request() -> None:
    """It is passed on when its request has ended but the next one hasn't begun, or just as that begins."""
    node = Node(identity(7) | {(0x1017, 0): (100, 2)})
    plain = node.answer
    second = b""

    def twice(can_id: int, data: bytes) -> bool:
        nonlocal second
        if second:
            node.transport._client.on_response(0, second, 0.0)
        second = bytes.fromhex("4318100107000000")
        return plain(can_id, data)

    node.intercept(twice)
    assert node.sdo.read(0x1018, 1, "vendor id") == 7
    assert node.sdo.read(0x1017, 0, "heartbeat time") == 100


def test_a_late_answer_to_an_earlier_request_starts_the_timeout_again() -> None:
    requests: list[bytes] = []
    answers = [bytes.fromhex("4318100107000000"), bytes.fromhex("4b17100064000000")]

    def at_timeout() -> int:
        transport.deliver_response(answers.pop(0))
        return 1 << 62

    def send(_: int, data: bytes) -> bool:
        requests.append(data)
        return True

    transport = SdoTransport(5, send, 0.005, at_timeout)
    sdo = NodeSdoClient(transport)
    answers.insert(0, answers[0])
    assert sdo.read(0x1018, 1, "vendor id") == 7
    assert sdo.read(0x1017, 0, "heartbeat time") == 100
    assert [data[1:4].hex() for data in requests] == ["181001", "171000"]


def test_garbled_response_is_an_error_not_a_value() -> None:
    node = Node({})

    def garbled(_id: int, _data: bytes) -> bool:
        node.transport.deliver_response(bytes.fromhex("ff17100000000000"))
        return True

    node.intercept(garbled)
    with pytest.raises(BootStepError, match="Unexpected response 0xFF") as caught:
        node.sdo.read(0x1017, 0, "heartbeat time")
    assert not caught.value.timed_out


def test_request_is_repeated_after_a_lost_response() -> None:
    node = Node(identity(7))
    plain, asked = node.answer, 0

    def lossy(can_id: int, data: bytes) -> bool:
        nonlocal asked
        asked += data[0] != 0x80  # the client aborts what it gave up
        return True if asked == 1 else plain(can_id, data)

    node.intercept(lossy)
    assert node.sdo.read(0x1018, 1, "vendor id") == 7
    assert asked == 2


def test_step_cancelled_during_a_transfer_does_not_retry() -> None:
    node = Node(identity(1))
    node.deaf.add(0x1018)
    turns = iter([False, True])
    node.sdo.is_cancelled = lambda: next(turns)
    with pytest.raises(BootStepCancelled):
        node.sdo.read(0x1018, 1, "vendor id")


def test_cancelled_step_sends_no_more_requests() -> None:
    node = Node(identity(1))
    node.sdo.is_cancelled = lambda: True
    with pytest.raises(BootStepCancelled):
        read_identity(node.sdo)


def test_a_schedule_is_written_to_the_tpdos_of_its_states_while_they_are_disabled() -> None:
    objects = {(0x1017, 0): (100, 2), (0x1019, 0): (0, 1)}
    tpdos = []
    for number in (2, 3):
        index, cob_id = 0x1800 + number - 1, 0x85 + 0x100 * number
        objects |= {
            (index, 1): (cob_id, 4),
            (index, 2): (1, 1),
            (index, 6): (0, 1),
            (index + 0x200, 0): (0, 1),
        }
        tpdos.append(NodeTpdo(number, cob_id, True, 1, ()))
    node = Node(objects)
    mapping = PdoMapping(tuple(tpdos), STANDARD_LAYOUT, (0, 1))
    configure_node(node.sdo, mapping, spec(heartbeat_ms=100, sync_overflow=2), lambda: None)
    assert node.objects[0x1019, 0][0] == 2
    for number, state in ((2, 0), (3, 1)):
        index = 0x1800 + number - 1
        assert (node.objects[index, 2][0], node.objects[index, 6][0]) == (2, state + 1)
        writes = [(sub, value) for at, sub, value in node.writes if at == index]
        start = writes.index((6, state + 1))
        assert writes[start - 1] == (1, 0x80000085 + 0x100 * number)
        assert writes[start + 1] == (1, 0x85 + 0x100 * number)
    check_settings(node.sdo, mapping, 100, event_driven=False)
    node.objects[0x1802, 6] = (1, 1)  # as of another state
    with pytest.raises(BootStepError, match="SYNC start value of TPDO3, is 1 instead of 2"):
        check_settings(node.sdo, mapping, 100, event_driven=False)


def test_a_node_that_does_not_count_syncs_has_no_schedule() -> None:
    node = Node({(0x1017, 0): (100, 2)})
    mapping = PdoMapping((found(),), STANDARD_LAYOUT, (0,))
    with pytest.raises(BootStepError, match="no 0x1019, SYNC counter overflow"):
        configure_node(node.sdo, mapping, spec(heartbeat_ms=100, sync_overflow=2), lambda: None)


def test_others_on_the_bus_of_a_schedule_may_lack_the_counter() -> None:
    node = Node({(0x1017, 0): (100, 2)})
    mapping = PdoMapping((found(),), STANDARD_LAYOUT)
    assert not configure_node(
        node.sdo, mapping, spec(heartbeat_ms=100, sync_overflow=2), lambda: None
    ).refusal


@pytest.mark.parametrize("refuses", [False, True])
def test_another_identifier_of_sync_is_named_and_replaced(refuses: bool) -> None:
    nothing = PdoMapping((), ())
    for right in (0x80, 0x40000080):
        check_settings(Node({(0x1005, 0): (right, 4)}).sdo, nothing, None, False)
    node = Node({(0x1005, 0): (0x81, 4)})
    node.forgets = {0x1005} if refuses else set()
    check_settings(node.sdo, nothing, None, True)  # event-driven: not by SYNC
    with pytest.raises(BootStepError, match=r"COB-ID of SYNC, is 0x81, and SYNC is sent with 0x80") as caught:
        check_settings(node.sdo, nothing, None, False)
    assert ("refuses" in str(caught.value)) == refuses
    assert node.objects[0x1005, 0] == (0x81 if refuses else 0x80, 4)
