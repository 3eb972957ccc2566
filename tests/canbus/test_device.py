"""The simulated node keeps CiA 301's promises, seen from the bus frame by frame."""

from __future__ import annotations

import struct
from collections.abc import Callable

import can
import canopen
import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import shipped
from handtouch.canbus.device import DeviceBus

SYNC = can.Message(arbitration_id=0x80, is_extended_id=False)
MS = 1_000_000


class Wire:
    """A bus that remembers what was sent on it and gives what was put in `incoming`."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.incoming: list[can.Message] = []
        self.broken = False

    def send(self, message: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        if self.broken:
            raise can.CanOperationError("no buffer space")
        self.sent.append((message.arbitration_id, bytes(message.data)))

    def recv(self, timeout: float | None = None) -> can.Message | None:  # noqa: ARG002
        return self.incoming.pop(0) if self.incoming else None

    def take(self) -> list[tuple[int, bytes]]:
        sent, self.sent = self.sent, []
        return sent


def ramp(t_ns: int) -> NDArray[np.int16]:
    """Rows 100, 200, ...; columns +0..3; all rise by one a millisecond."""
    row = 100 * np.arange(1, 4)[:, None] + np.arange(4)
    return (row + t_ns // MS).astype(np.int16)


def message(identifier: int, *data: int) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def bus(wire: Wire) -> DeviceBus:
    bus = DeviceBus(wire, ramp, clock=lambda: 0)  # type: ignore[arg-type]  # the two methods it uses
    for node_id in (1, 2, 5):
        bus.add(node_id, serial=1000 + node_id)
    return bus


@pytest.fixture
def nmt(bus: DeviceBus) -> Callable[[int, int], None]:
    return lambda command, node_id: bus.handle(message(0, command, node_id), 0)


def plug_all(bus: DeviceBus, wire: Wire) -> None:
    for device in bus.devices.values():
        device.plug()
    wire.take()


def upload(bus: DeviceBus, wire: Wire, node_id: int, index: int, sub: int) -> bytes:
    """An expedited SDO upload: the eight bytes of the answer."""
    bus.handle(message(0x600 + node_id, *struct.pack("<BHB4x", 0x40, index, sub)), 0)
    (identifier, data) = wire.take()[-1]
    assert identifier == 0x580 + node_id
    assert struct.unpack_from("<HB", data, 1) == (index, sub)
    return data


def download(bus: DeviceBus, wire: Wire, node_id: int, index: int, sub: int, value: bytes) -> tuple[int, int]:
    """An expedited SDO download: command byte and abort code of the answer."""
    command = 0x23 | (4 - len(value)) << 2
    bus.handle(message(0x600 + node_id, *struct.pack("<BHB", command, index, sub), *value.ljust(4, b"\0")), 0)
    data = wire.take()[-1][1]
    return data[0], struct.unpack_from("<I", data, 4)[0]


def test_a_node_boots_up_once_and_waits_in_pre_operational(bus: DeviceBus, wire: Wire) -> None:
    bus.devices[1].plug()
    bus.devices[1].plug()
    assert wire.take() == [(0x701, b"\0")]
    assert bus.devices[1].state == "PRE-OPERATIONAL"
    bus.handle(SYNC, 0)
    assert wire.take() == []


def test_every_operational_node_answers_each_sync_with_its_own_channels(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 1)
    nmt(1, 5)
    bus.handle(SYNC, 7 * MS)
    assert wire.take() == [
        (0x281, struct.pack("<4h", 107, 108, 109, 110)),
        (0x285, struct.pack("<4h", 307, 308, 309, 310)),
    ]


@pytest.mark.parametrize("command", [128, 2])
def test_pdos_end_when_the_node_leaves_operational(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None], command: int
) -> None:
    plug_all(bus, wire)
    nmt(1, 1)
    nmt(command, 1)
    bus.handle(SYNC, 0)
    assert wire.take() == []


def test_a_broadcast_reaches_all_and_a_command_to_another_none(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 0)
    nmt(2, 9)
    assert {device.state for device in bus.devices.values()} == {"OPERATIONAL"}
    assert wire.take() == []


@pytest.mark.parametrize("reset", [129, 130])
def test_after_a_reset_comes_a_boot_up_and_defaults(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None], reset: int
) -> None:
    plug_all(bus, wire)
    nmt(1, 2)
    assert download(bus, wire, 2, 0x1017, 0, struct.pack("<H", 50))[0] == 0x60
    assert download(bus, wire, 2, 0x1801, 2, b"\x03")[0] == 0x60
    nmt(reset, 2)
    assert wire.take() == [(0x702, b"\0")]
    assert bus.devices[2].state == "PRE-OPERATIONAL"
    assert upload(bus, wire, 2, 0x1017, 0)[4:6] == struct.pack("<H", 200)
    assert upload(bus, wire, 2, 0x1801, 2)[4] == 1
    assert upload(bus, wire, 2, 0x1018, 4)[4:] == struct.pack("<I", 1002)


def test_heartbeats_come_at_their_period_and_tell_the_state(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    bus.devices[1].plug()
    wire.take()
    assert bus.advance(199 * MS) == 200 * MS
    assert wire.take() == []
    assert bus.advance(200 * MS) == 400 * MS
    assert wire.take() == [(0x701, b"\x7f")]
    nmt(1, 1)
    bus.advance(1050 * MS)  # a long pause is not made good by a burst
    assert wire.take() == [(0x701, b"\x05")]
    assert bus.advance(1050 * MS) == 1200 * MS


def test_the_heartbeat_time_is_set_and_taken_away_over_sdo(bus: DeviceBus, wire: Wire) -> None:
    bus.devices[1].plug()
    download(bus, wire, 1, 0x1017, 0, struct.pack("<H", 20))
    bus.advance(20 * MS)
    assert wire.take() == [(0x701, b"\x7f")]
    download(bus, wire, 1, 0x1017, 0, struct.pack("<H", 0))
    bus.advance(10_000 * MS)
    assert wire.take() == []


def test_identity_mapping_and_readings_are_read_over_sdo(bus: DeviceBus, wire: Wire) -> None:
    plug_all(bus, wire)
    assert upload(bus, wire, 5, 0x1000, 0)[4:] == struct.pack("<I", 0x00040191)
    assert upload(bus, wire, 5, 0x1018, 2)[4:] == struct.pack("<I", 0x401)
    assert upload(bus, wire, 5, 0x1018, 4)[4:] == struct.pack("<I", 1005)
    assert upload(bus, wire, 5, 0x1801, 1)[4:] == struct.pack("<I", 0x285)
    assert [upload(bus, wire, 5, 0x1A01, sub)[4:] for sub in range(1, 5)] == [
        struct.pack("<I", 0x64010010 | sub << 8) for sub in range(1, 5)
    ]
    assert upload(bus, wire, 5, 0x6401, 0)[4] == 4
    assert upload(bus, wire, 5, 0x6401, 3)[4:6] == struct.pack("<h", 0)
    bus.handle(SYNC, 9 * MS)
    assert upload(bus, wire, 5, 0x6401, 3)[4:6] == struct.pack("<h", 311)


def test_a_transmission_type_n_answers_every_nth_sync(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    download(bus, wire, 1, 0x1801, 2, b"\x03")
    nmt(1, 1)
    answered = []
    for number in range(9):
        bus.handle(SYNC, 0)
        answered += [number] * len(wire.take())
    assert answered == [2, 5, 8]


def test_a_pdo_is_moved_and_switched_off_by_its_cob_id(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 1)
    download(bus, wire, 1, 0x1801, 1, struct.pack("<I", 0x3A1))
    bus.handle(SYNC, 0)
    assert wire.take()[0][0] == 0x3A1
    download(bus, wire, 1, 0x1801, 1, struct.pack("<I", 0x800003A1))
    bus.handle(SYNC, 0)
    assert wire.take() == []


@pytest.mark.parametrize(
    ("index", "sub", "value", "code"),
    [
        (0x1801, 2, b"\xf1", 0x06090030),  # reserved
        (0x1801, 1, b"\x01\x06\0\0", 0x06090030),  # an identifier that is SDO's
        (0x1801, 1, b"\x81\x02\x00\x20", 0x06090030),  # a 29-bit identifier
        (0x1018, 4, b"\1\0\0\0", 0x06010002),  # read only
        (0x1017, 0, b"\1\0\0\0", 0x06070010),  # wrong length
        (0x2000, 0, b"\1", 0x06020000),  # no such object
    ],
)
def test_a_refused_download_names_the_reason_and_changes_nothing(
    bus: DeviceBus, wire: Wire, index: int, sub: int, value: bytes, code: int
) -> None:
    plug_all(bus, wire)
    assert download(bus, wire, 1, index, sub, value) == (0x80, code)
    assert upload(bus, wire, 1, 0x1801, 2)[4] == 1
    assert upload(bus, wire, 1, 0x1017, 0)[4:6] == struct.pack("<H", 200)


def test_a_stopped_node_serves_no_sdo(bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]) -> None:
    plug_all(bus, wire)
    nmt(2, 1)
    bus.handle(message(0x601, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0), 0)
    assert wire.take() == []


def test_malformed_frames_are_counted_and_dropped(bus: DeviceBus, wire: Wire) -> None:
    plug_all(bus, wire)
    for frame in (message(0), message(0, 1), message(0, 77, 1), message(0x601, 0x40)):
        bus.handle(frame, 0)
    assert bus.rejected == 4
    bus.handle(message(0x601, 0x60, 0, 0, 0, 0, 0, 0, 0), 0)  # a segment of no transfer
    assert wire.take()[-1][1][0] == 0x80


def test_foreign_and_echoed_frames_are_ignored(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 0)
    extended = can.Message(arbitration_id=0x80, is_extended_id=True)
    error = can.Message(arbitration_id=0x80, is_extended_id=False, is_error_frame=True)
    remote = can.Message(arbitration_id=0x80, is_extended_id=False, is_remote_frame=True)
    for frame in (extended, error, remote, message(0x281, *range(8)), message(0x701, 0), message(0x603, 1)):
        bus.handle(frame, 0)
    assert wire.take() == []
    assert bus.rejected == 0


def test_an_unplugged_node_is_silent_and_a_plugged_one_starts_anew(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 0)
    bus.devices[1].unplug()
    bus.handle(SYNC, 0)
    nmt(129, 1)
    bus.handle(message(0x601, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0), 0)
    bus.advance(1000 * MS)
    assert {identifier for identifier, _ in wire.take()} == {0x282, 0x285, 0x702, 0x705}
    bus.devices[1].plug()
    assert wire.take() == [(0x701, b"\0")]
    assert bus.devices[1].state == "PRE-OPERATIONAL"


def test_a_swapped_unit_boots_with_its_own_serial_number(bus: DeviceBus, wire: Wire) -> None:
    plug_all(bus, wire)
    bus.devices[2].swap(77)
    assert wire.take() == [(0x702, b"\0")]
    assert upload(bus, wire, 2, 0x1018, 4)[4:] == struct.pack("<I", 77)


def test_fault_switches_act_on_one_node_and_are_taken_back(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 0)
    node = bus.devices[1]

    def reading(t_ms: int) -> bytes | None:
        bus.handle(SYNC, t_ms * MS)
        sent = dict(wire.take())
        assert sent[0x282] == struct.pack("<4h", *(200 + t_ms + np.arange(4)))
        return sent.get(0x281)

    reading(4)
    node.stick(2)
    assert reading(9) == struct.pack("<4h", 109, 110, 106, 112)
    assert upload(bus, wire, 1, 0x6401, 3)[4:6] == struct.pack("<h", 106)
    node.saturate()
    assert reading(10) == struct.pack("<4h", *[32767] * 4)
    node.release()
    node.frame_bytes = 6
    assert reading(11) == struct.pack("<3h", 111, 112, 113)
    node.frame_bytes = 8
    node.send_data = False
    assert reading(12) is None
    bus.advance(400 * MS)
    assert (0x701, b"\x05") in wire.take()
    node.send_data, node.send_heartbeat = True, False
    assert reading(13) == struct.pack("<4h", 113, 114, 115, 116)
    bus.advance(800 * MS)
    assert {identifier for identifier, _ in wire.take()} == {0x702, 0x705}


def test_a_reboot_by_itself_leaves_operational(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 0)
    bus.devices[5].reboot()
    assert wire.take() == [(0x705, b"\0")]
    assert bus.devices[5].state == "PRE-OPERATIONAL"


def test_an_emergency_is_sent_as_cia_301_packs_it(bus: DeviceBus, wire: Wire) -> None:
    plug_all(bus, wire)
    bus.devices[1].emergency(0x3210, 5, b"\1\2")
    assert wire.take() == [(0x81, b"\x10\x32\x05\x01\x02\0\0\0")]


def test_a_bus_that_takes_no_frame_costs_only_that_frame(
    bus: DeviceBus, wire: Wire, nmt: Callable[[int, int], None]
) -> None:
    plug_all(bus, wire)
    nmt(1, 0)
    wire.broken = True
    bus.handle(SYNC, 0)
    assert bus.send_failures == 3
    wire.broken = False
    bus.handle(SYNC, 0)
    assert len(wire.take()) == 3


def test_poll_serves_all_that_has_come(bus: DeviceBus, wire: Wire) -> None:
    plug_all(bus, wire)
    wire.incoming = [message(0, 1, 0), SYNC, SYNC]
    bus.poll()
    assert len(wire.take()) == 6
    assert bus.syncs == 2


def test_a_node_id_is_used_once(bus: DeviceBus) -> None:
    with pytest.raises(ValueError, match="node_id"):
        bus.add(1)
    with pytest.raises(ValueError, match="node_id"):
        bus.add(128)


def test_nodes_live_on_a_real_bus_and_speak_with_the_librarys_own_master() -> None:

    with can.Bus("device", interface="virtual") as side, can.Bus("device", interface="virtual") as other:
        nodes = DeviceBus(side, ramp)
        for node_id in (1, 2, 5):
            nodes.add(node_id, serial=node_id)
        network = canopen.Network(other)
        network.connect()
        try:
            remote = network.add_node(2, str(shipped.path("handtouch-node.eds")))
            states: list[int] = []
            remote.nmt.add_heartbeat_callback(states.append)
            nodes.start()
            assert remote.sdo[0x1018][4].raw == 2
            remote.tpdo.read()
            remote.nmt.state = "OPERATIONAL"
            for _ in range(50):
                network.sync.transmit()
                if remote.tpdo[2].wait_for_reception(0.1) is not None:
                    break
            assert [variable.raw - remote.tpdo[2][0].raw for variable in remote.tpdo[2]] == [0, 1, 2, 3]
            assert states[0] == 0
        finally:
            nodes.stop()
            network.notifier.stop()
    assert nodes.bus_errors == 0


def test_frames_from_before_power_on_are_not_answered(wire: Wire, bus: DeviceBus) -> None:
    probe = message(0x601, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0)
    wire.incoming = [message(0, 1, 0), SYNC, probe]
    bus.start()
    bus.stop()
    assert bus.syncs == 0
    assert wire.sent == [(0x700 + node_id, b"\x00") for node_id in (1, 2, 5)]
