"""What is read from a node and written to it over SDO, and what is said when it isn't as it should be."""

from __future__ import annotations

import pytest

from handtouch.canbus.boot import (
    BootError,
    Expected,
    Identity,
    Outdated,
    Sdo,
    Tpdo,
    configure,
    identify,
    read_mapping,
)

CHANNELS = (0x64010110, 0x64010210, 0x64010310, 0x64010410)
ABORT_NO_OBJECT, ABORT_NO_SUB = 0x06020000, 0x06090011


class Node:
    """An SDO server of objects in a dictionary; answers at once. `deaf`: objects it never answers for."""

    def __init__(self, objects: dict[tuple[int, int], tuple[int, int]]) -> None:
        self.objects = objects  # (index, sub) -> (value, size)
        self.writes: list[tuple[int, int, int]] = []
        self.deaf: set[int] = set()
        self.forgets: set[int] = set()
        self.sdo = Sdo(5, self.answer)
        self.sdo._client.RESPONSE_TIMEOUT = 0.005

    def answer(self, can_id: int, data: bytes) -> bool:
        assert can_id == 0x605
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        if index in self.deaf or data[0] == 0x80:
            return True
        if (index, sub) not in self.objects:
            code = ABORT_NO_SUB if any(i == index for i, _ in self.objects) else ABORT_NO_OBJECT
            self.sdo.deliver(b"\x80" + data[1:4] + code.to_bytes(4, "little"))
        elif data[0] & 0xE0 == 0x40:
            value, size = self.objects[index, sub]
            head = bytes((0x43 | (4 - size) << 2,))
            self.sdo.deliver(head + data[1:4] + value.to_bytes(size, "little").ljust(4, b"\0"))
        else:
            size = 4 - (data[0] >> 2 & 3)
            value = int.from_bytes(data[4 : 4 + size], "little")
            assert size == self.objects[index, sub][1]
            if index not in self.forgets:
                self.objects[index, sub] = (value, size)
            self.writes.append((index, sub, value))
            self.sdo.deliver(b"\x60" + data[1:4] + bytes(4))
        return True


def tpdo(
    number: int, entries: tuple[int, ...], cob_id: int, transmission: int = 1
) -> dict[tuple[int, int], tuple[int, int]]:
    mapping = {(0x1A00 + number - 1, sub): (entry, 4) for sub, entry in enumerate(entries, 1)}
    communication = {(0x1800 + number - 1, 1): (cob_id, 4), (0x1800 + number - 1, 2): (transmission, 1)}
    return {(0x1A00 + number - 1, 0): (len(entries), 1)} | mapping | communication


def identity(*values: int) -> dict[tuple[int, int], tuple[int, int]]:
    return {(0x1018, sub): (value, 4) for sub, value in enumerate(values, 1)}


def test_identity_is_read_whole() -> None:
    assert identify(Node(identity(1, 2, 3, 4)).sdo, Expected(1, 2, 4)) == Identity(1, 2, 3, 4)


def test_only_the_vendor_id_is_mandatory() -> None:
    assert identify(Node(identity(9)).sdo, Expected()) == Identity(9)


def test_node_without_serial_number_is_not_the_one_with_the_configured_one() -> None:
    with pytest.raises(BootError, match="serial number is none, configured is 4") as caught:
        identify(Node(identity(1, 2, 3)).sdo, Expected(serial=4))
    assert caught.value.stranger


def test_mapping_is_found_in_whatever_tpdo_carries_it() -> None:
    node = Node(tpdo(1, (0x60000108,), 0x185) | tpdo(3, CHANNELS, 0x385, 255))
    assert read_mapping(node.sdo, (2, 1, 3, 4)) == Tpdo(3, 0x385, True, 255)


@pytest.mark.parametrize(
    ("objects", "told"),
    [
        ({}, "the node has no TPDO"),
        (tpdo(1, (), 0x185), "TPDO1 has nothing"),
        (
            tpdo(1, CHANNELS[:3], 0x185),
            r"TPDO1 has 0x6401:01 \(16 bit\), 0x6401:02 \(16 bit\), 0x6401:03 \(16 bit\); map",
        ),
        (tpdo(1, CHANNELS[::-1], 0x185), r"TPDO1 has 0x6401:04 \(16 bit\)"),
        (tpdo(1, (0x64010120, 0x64010220), 0x185), r"0x6401:01 \(32 bit\)"),
        (tpdo(2, CHANNELS, 0x20000285), "no 11-bit identifier"),
        (tpdo(2, CHANNELS, 0x80000000), "no 11-bit identifier"),
    ],
)
def test_unusable_mapping_is_told_as_it_is(
    objects: dict[tuple[int, int], tuple[int, int]], told: str
) -> None:
    with pytest.raises(BootError, match=told):
        read_mapping(Node(objects).sdo, (1, 2))


@pytest.mark.parametrize(
    ("found", "heartbeat", "writes", "halts"),
    [
        (Tpdo(2, 0x285, True, 1), 100, [], 0),
        (Tpdo(2, 0x285, True, 1), 0, [(0x1017, 0, 100)], 0),
        (Tpdo(2, 0x285, True, 255), 100, [(0x1801, 2, 1)], 1),
        (Tpdo(2, 0x285, False, 1), 100, [(0x1801, 1, 0x285)], 1),
        (Tpdo(2, 0x285, False, 0), 0, [(0x1801, 2, 1), (0x1801, 1, 0x285), (0x1017, 0, 100)], 1),
    ],
)
def test_only_what_differs_is_written_and_only_pdo_changes_halt(
    found: Tpdo, heartbeat: int, writes: list[tuple[int, int, int]], halts: int
) -> None:
    cob_id = found.cob_id | (0 if found.enabled else 1 << 31)
    node = Node(tpdo(2, CHANNELS, cob_id, found.transmission) | {(0x1017, 0): (heartbeat, 2)})
    halted: list[bool] = []
    configure(node.sdo, found, 100, lambda: halted.append(True))
    assert (node.writes, len(halted)) == (writes, halts)


def test_value_that_does_not_stick_is_an_error() -> None:
    node = Node({(0x1017, 0): (0, 2)})
    node.forgets.add(0x1017)
    with pytest.raises(BootError, match="heartbeat time, 0x1017:00, was set to 100 but reads 0"):
        configure(node.sdo, Tpdo(2, 0x285, True, 1), 100, lambda: None)


def test_silence_and_refusal_are_told_apart() -> None:
    node = Node(identity(1))
    node.deaf.add(0x1018)
    with pytest.raises(BootError, match="reading vendor id, 0x1018:01: no answer") as silence:
        identify(node.sdo, Expected())
    assert silence.value.silent
    with pytest.raises(
        BootError, match=r"refused by the node \(Code 0x06020000, Object does not exist\)"
    ) as refusal:
        Node({}).sdo.read(0x1017, 0, "heartbeat time")
    assert not refusal.value.silent


def test_answers_for_other_objects_are_not_taken_for_ours() -> None:
    """An answer to a probe, to another master or to an earlier request that came too late."""
    node = Node({(0x1017, 0): (100, 2)})
    plain = node.answer

    def with_noise(can_id: int, data: bytes) -> bool:
        node.sdo.deliver(bytes.fromhex("4300100091010f00"))
        node.sdo.deliver(bytes.fromhex("6018100400000000"))
        node.sdo.deliver(bytes.fromhex("8000100000000206"))
        return plain(can_id, data)

    node.sdo._client.network._send = with_noise
    assert node.sdo.read(0x1017, 0, "heartbeat time") == 100


def test_garbled_answer_is_an_error_not_a_value() -> None:
    node = Node({})

    def garbled(_id: int, _data: bytes) -> bool:
        node.sdo.deliver(bytes.fromhex("ff17100000000000"))
        return True

    node.sdo._client.network._send = garbled
    with pytest.raises(BootError, match="Unexpected response 0xFF") as caught:
        node.sdo.read(0x1017, 0, "heartbeat time")
    assert not caught.value.silent


def test_one_lost_answer_is_asked_for_again() -> None:
    node = Node(identity(7))
    plain, asked = node.answer, 0

    def lossy(can_id: int, data: bytes) -> bool:
        nonlocal asked
        asked += data[0] != 0x80  # the client aborts what it gave up
        return True if asked == 1 else plain(can_id, data)

    node.sdo._client.network._send = lossy
    assert node.sdo.read(0x1018, 1, "vendor id") == 7
    assert asked == 2


def test_attempt_that_is_outdated_meanwhile_does_not_ask_again() -> None:
    node = Node(identity(1))
    node.deaf.add(0x1018)
    turns = iter([False, True])
    node.sdo.outdated = lambda: next(turns)
    with pytest.raises(Outdated):
        node.sdo.read(0x1018, 1, "vendor id")


def test_outdated_attempt_asks_nothing_more() -> None:
    node = Node(identity(1))
    node.sdo.outdated = lambda: True
    with pytest.raises(Outdated):
        identify(node.sdo, Expected())
