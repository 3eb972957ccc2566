"""The simulated node conforms to CiA 301, seen from the bus frame by frame."""

from __future__ import annotations

import struct
import time
from typing import Any

import can
import canopen
import numpy as np
import pytest

from handtouch.config import shipped
from handtouch.device import DeviceBus

MS = 1_000_000
ROWS = [[10 * node + channel for channel in range(4)] for node in (1, 2, 5)]


@pytest.fixture
def three(bench: Any) -> Any:
    """Nodes 1, 2 and 5, plugged in; node n has serial number 1000 + n and counts 10 n, 10 n + 1, ..."""
    bench.counts = np.array(ROWS)
    for node_id in (1, 2, 5):
        bench.bus.add(node_id, serial=1000 + node_id).plug()
    bench.take()
    return bench


def tpdo(row: int, node_id: int) -> tuple[int, bytes]:
    return 0x280 + node_id, struct.pack("<4h", *ROWS[row])


def test_a_node_boots_up_once_and_waits_in_pre_operational(bench: Any) -> None:
    node = bench.bus.add(1)
    assert node.state == "UNPLUGGED"
    node.plug()
    node.plug()
    assert bench.take() == [(0x701, b"\0")]
    assert node.state == "PRE-OPERATIONAL"
    assert bench.sync() == []


def test_every_operational_node_answers_each_sync_with_its_own_channels(three: Any) -> None:
    three.nmt(1, 1)
    three.nmt(1, 5)
    for _ in range(3):
        assert three.sync() == [tpdo(0, 1), tpdo(2, 5)]
    assert three.bus.sync_count == 3


@pytest.mark.parametrize("command", [128, 2])
def test_pdos_end_when_the_node_leaves_operational(three: Any, command: int) -> None:
    three.nmt(1, 1)
    three.nmt(command, 1)
    assert three.sync() == []


def test_a_broadcast_reaches_all_and_a_command_to_another_none(three: Any) -> None:
    assert three.nmt(1, 0) == []
    assert three.nmt(2, 9) == []
    assert {device.state for device in three.bus.devices.values()} == {"OPERATIONAL"}


@pytest.mark.parametrize("reset", [129, 130])
def test_after_a_reset_comes_a_boot_up_and_defaults(three: Any, reset: int) -> None:
    three.nmt(1, 2)
    assert three.write(2, 0x1017, 0, 50, 2) == 0
    assert three.write(2, 0x1801, 2, 3, 1) == 0
    assert three.nmt(reset, 2) == [(0x702, b"\0")]
    assert three.bus.devices[2].state == "PRE-OPERATIONAL"
    assert three.read(2, 0x1017, 0) == 200
    assert three.read(2, 0x1801, 2) == 1
    assert three.read(2, 0x1018, 4) == 1002


def test_heartbeats_come_at_their_period_with_the_state(bench: Any) -> None:
    bench.bus.add(1).plug()
    bench.take()
    assert bench.bus.advance(199 * MS) == 200 * MS
    assert bench.take() == []
    assert bench.bus.advance(200 * MS) == 400 * MS
    assert bench.take() == [(0x701, b"\x7f")]
    bench.nmt(1, 1)
    bench.bus.advance(1050 * MS)  # a long pause is not made good by a burst
    assert bench.take() == [(0x701, b"\x05")]
    assert bench.bus.advance(1050 * MS) == 1200 * MS


def test_the_heartbeat_time_is_set_and_cleared_over_sdo(bench: Any) -> None:
    bench.bus.add(1).plug()
    bench.take()
    bench.write(1, 0x1017, 0, 20, 2)
    assert [t_ms for t_ms, _ in bench.run(100)] == [20, 40, 60, 80, 100]
    bench.write(1, 0x1017, 0, 0, 2)
    assert bench.run(1000) == []


def test_identity_mapping_and_readings_are_read_over_sdo(three: Any) -> None:
    assert three.read(5, 0x1000, 0) == 0x00040191
    assert three.read(5, 0x1018, 2) == 0x401
    assert three.read(5, 0x1018, 4) == three.bus.devices[5].serial == 1005
    assert three.read(5, 0x1801, 1) == 0x285
    mapping = [three.read(5, 0x1A01, sub) for sub in range(1, 5)]
    assert mapping == [0x64010010 | sub << 8 for sub in range(1, 5)]
    assert three.read(5, 0x6401, 0) == 4
    assert three.read(5, 0x6401, 3) == 0  # nothing was measured yet
    three.sync()
    assert three.read(5, 0x6401, 3) == 52


def test_the_identity_that_is_given_outranks_the_eds(bench: Any) -> None:
    bench.bus.add(3, kind=(0x77, 0x88), serial=0x99).plug()
    bench.take()
    assert [bench.read(3, 0x1018, sub) for sub in (1, 2, 3, 4)] == [0x77, 0x88, 0x10000, 0x99]


def test_a_transmission_type_n_answers_every_nth_sync(three: Any) -> None:
    three.write(1, 0x1801, 2, 3, 1)
    three.nmt(1, 1)
    assert [len(three.sync()) for _ in range(9)] == [0, 0, 1] * 3


def test_a_pdo_is_moved_and_switched_off_by_its_cob_id(three: Any) -> None:
    three.nmt(1, 1)
    three.write(1, 0x1801, 1, 0x3A1, 4)
    assert three.sync() == [(0x3A1, tpdo(0, 1)[1])]
    three.write(1, 0x1801, 1, 0x800003A1, 4)
    assert three.sync() == []


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        (0x1801, 2, 0xF1, 1, 0x06090030),  # reserved
        (0x1801, 1, 0x601, 4, 0x06090030),  # an identifier that is SDO's
        (0x1801, 1, 0x20000281, 4, 0x06090030),  # a 29-bit identifier
        (0x1018, 4, 1, 4, 0x06010002),  # read only
        (0x1017, 0, 1, 4, 0x06070010),  # wrong length
        (0x2000, 0, 1, 1, 0x06020000),  # no such object
    ],
)
def test_a_refused_download_names_the_reason_and_changes_nothing(
    three: Any, index: int, sub: int, value: int, size: int, code: int
) -> None:
    before = three.read(1, index, sub)
    assert three.write(1, index, sub, value, size) == code
    assert three.read(1, index, sub) == before


def test_a_stopped_node_serves_no_sdo(three: Any) -> None:
    three.nmt(2, 1)
    assert three.request(1, b"\x40\x00\x10") == []


def test_malformed_frames_are_counted_and_dropped(three: Any) -> None:
    for identifier, data in ((0, b""), (0, b"\1"), (0, b"\x4d\1"), (0x601, b"\x40")):
        assert three.send(identifier, data) == []
    assert three.bus.rejected == 4
    ((_, data),) = three.request(1, b"\x60")  # a segment of no transfer
    assert data[0] == 0x80


def test_foreign_and_echoed_frames_are_ignored(three: Any) -> None:
    three.nmt(1, 0)
    extended = can.Message(arbitration_id=0x80, is_extended_id=True)
    error = can.Message(arbitration_id=0x80, is_extended_id=False, is_error_frame=True)
    for frame in (extended, error):
        three.bus.handle_frame(frame, 0)
    assert three.take() == three.send(0x80, remote=True) == []
    for identifier in (0x281, 0x701, 0x603, 0x7FF):
        assert three.send(identifier, bytes(8)) == []
    assert three.bus.rejected == three.bus.sync_count == 0


def test_an_unplugged_node_is_silent_and_restarts_when_plugged(three: Any) -> None:
    three.nmt(1, 0)
    node = three.bus.devices[1]
    node.unplug()
    assert three.sync() == [tpdo(1, 2), tpdo(2, 5)]
    assert three.nmt(129, 1) == three.request(1, b"\x40\x00\x10") == []
    assert {identifier for _, (identifier, _) in three.run(1000)} == {0x702, 0x705}
    node.plug()
    assert three.take() == [(0x701, b"\0")]
    assert node.state == "PRE-OPERATIONAL"


@pytest.mark.parametrize(
    ("switch", "value"),
    [("send_data", False), ("stuck_counts", {0: 7}), ("wiring", (1, 0, 2, 3)), ("frame_bytes", 2)],
)
def test_a_fault_affects_its_node_only_and_can_be_cleared(three: Any, switch: str, value: Any) -> None:
    three.nmt(1, 0)
    node = three.bus.devices[2]
    before = getattr(node, switch)
    setattr(node, switch, value)
    sent = three.sync()
    assert tpdo(1, 2) not in sent
    assert {tpdo(0, 1), tpdo(2, 5)} <= set(sent)
    setattr(node, switch, before)
    assert three.sync() == [tpdo(0, 1), tpdo(1, 2), tpdo(2, 5)]


def test_a_reboot_by_itself_leaves_operational(three: Any) -> None:
    three.nmt(1, 0)
    three.bus.devices[5].reboot()
    assert three.take() == [(0x705, b"\0")]
    assert three.bus.devices[5].state == "PRE-OPERATIONAL"


def test_an_emergency_is_sent_as_cia_301_packs_it(three: Any) -> None:
    three.bus.devices[1].send_emergency(0x3210, 5, b"\1\2")
    assert three.take() == [(0x81, b"\x10\x32\x05\x01\x02\0\0\0")]


def test_a_bus_that_takes_no_frame_costs_only_that_frame(three: Any) -> None:
    three.nmt(1, 0)
    three.wire.broken = True
    three.sync()
    assert three.bus.send_failures == 3
    three.wire.broken = False
    assert len(three.sync()) == 3


def test_a_bus_that_cannot_be_read_is_counted_and_served_when_it_can(bench: Any) -> None:
    bench.bus.add(1)
    bench.wire.broken = True
    bench.bus.start()
    assert bench.bus.bus_errors >= 1
    bench.wire.broken = False
    bench.wire.incoming = [can.Message(arbitration_id=0x80, is_extended_id=False)] * 3
    for _ in range(500):
        if bench.bus.sync_count == 3:
            break
        time.sleep(0.01)
    bench.bus.stop()
    assert bench.bus.sync_count == 3


def test_poll_serves_all_that_has_come(three: Any) -> None:
    start = can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False)
    sync = can.Message(arbitration_id=0x80, is_extended_id=False)
    three.wire.incoming = [start, sync, sync]
    three.bus.poll()
    assert len(three.take()) == 6
    assert three.bus.sync_count == 2


def test_nodes_slower_than_sync_answer_the_newest_and_everything_else(three: Any) -> None:
    def frame(identifier: int, *data: int) -> can.Message:
        return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)

    read_type = frame(0x601, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0)
    three.wire.incoming = [frame(0, 1, 0), *[frame(0x80)] * 50, read_type, *[frame(0x80)] * 50]
    three.bus.poll()
    assert (three.bus.sync_count, three.bus.skipped_syncs) == (8, 92)
    identifiers = [identifier for identifier, _ in three.take()]
    assert identifiers[0] == 0x581  # no SYNC before it is among the newest
    assert len(identifiers) == 1 + 8 * 3


def test_frames_from_before_power_on_are_not_answered_and_all_are_plugged_in(bench: Any) -> None:
    bench.bus.add(1)
    bench.bus.add_twin(1, serial=2)
    named = bench.bus.add_unconfigured(serial=3)
    bench.wire.incoming = [can.Message(arbitration_id=0x80, is_extended_id=False)] * 3
    bench.bus.start()
    with pytest.raises(RuntimeError, match="already"):
        bench.bus.start()
    bench.bus.stop()
    assert bench.bus.sync_count == 0
    assert bench.take() == [(0x701, b"\0")] * 2
    assert named.plugged


def test_a_node_id_is_used_once(three: Any) -> None:
    for node_id in (1, 0, 128):
        with pytest.raises(ValueError, match="node_id"):
            three.bus.add(node_id)


def test_nodes_on_a_real_bus_work_with_the_librarys_master() -> None:
    with can.Bus("device", interface="virtual") as side, can.Bus("device", interface="virtual") as other:
        nodes = DeviceBus(side, lambda _: np.array(ROWS))
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
            assert remote.sdo[0x1008].raw == "handtouch four-channel node"
            remote.tpdo.read()
            remote.nmt.state = "OPERATIONAL"
            for _ in range(50):
                network.sync.transmit()
                if remote.tpdo[2].wait_for_reception(0.1) is not None:
                    break
            assert [variable.raw for variable in remote.tpdo[2]] == ROWS[1]
            assert states[0] == 0
        finally:
            nodes.stop()
            network.notifier.stop()
    assert nodes.bus_errors == 0


def test_tpdos_of_a_schedule_are_sent_at_their_counts_of_sync_even_after_a_lost_one(bench: Any) -> None:
    channels = tuple((0x6401, sub) for sub in range(1, 9))
    bench.counts = np.arange(8)[None]
    node = bench.bus.add(1, channels=channels)
    node.plug()
    for index, sub, value in ((0x1019, 0, 2), (0x1801, 6, 1), (0x1801, 2, 2), (0x1802, 6, 2), (0x1802, 2, 2)):
        node.write_object(index, sub, value)
    for number in (2, 3):
        node.write_object(0x1800 + number - 1, 1, 0x81 + 0x100 * number)
    bench.nmt(1, 1)
    bench.take()
    sent = []
    for counter in (1, 2, 2, 1, 1, None):
        data = b"" if counter is None else bytes((counter,))
        bench.bus.handle_frame(can.Message(arbitration_id=0x80, data=data, is_extended_id=False), bench.t_ns)
        sent.append([identifier for identifier, _ in bench.take()])
    assert sent == [[0x281], [0x381], [0x381], [0x281], [0x281], []]
