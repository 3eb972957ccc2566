"""`handtouch scan` finds all nodes, names what differs from the deployment, and changes no node."""

from __future__ import annotations

import itertools
import json
import random
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces import virtual
from hypothesis import given
from hypothesis import strategies as st

from handtouch import cli, config
from handtouch.canbus import cia301
from handtouch.canbus.find import survey
from handtouch.canbus.find.survey import (
    NodeFacts,
    TpdoFacts,
    find_channels_of_node,
    find_four_channels,
)
from handtouch.canbus.find.traffic import Traffic, describe_identifier
from handtouch.cli import scan as scan_command
from handtouch.config import shipped
from handtouch.device import DeviceBus
from handtouch.procedures.scan import (
    BusReport,
    ScanRequest,
    channel_names,
    compare_nodes,
    fragment,
    scan_buses,
)

_numbers = itertools.count()
QUICK = ScanRequest(listen_s=0.05)
SHEET = """
[sheet.firm]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20_000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5
"""
STANDARD = tuple(0x6401 << 16 | sub << 8 | 16 for sub in (1, 2, 3, 4))


class RequestQueue(Queue[can.Message]):
    """Queue of a bus on which requests are handled in their sender's thread.

    All responses have arrived when `send` returns, so no time limit of a scan depends on how busy the machine
    is. Other frames, which no node handles, are dropped: two nodes never wait for each other.
    """

    def __init__(self, handle: Callable[[can.Message], None]) -> None:
        super().__init__()
        self._handle = handle

    def put(self, item: can.Message, block: bool = True, timeout: float | None = None) -> None:  # noqa: ARG002
        can_id = item.arbitration_id
        if can_id in (cia301.NMT, cia301.LSS_REQUEST) or can_id - cia301.SDO_REQUEST in range(1, 128):
            self._handle(item)


def handle_at_once(bus: can.BusABC, handle: Callable[[can.Message], None]) -> None:
    """Have the requests on a virtual bus handled by a function, as `RequestQueue` does."""
    assert isinstance(bus, virtual.VirtualBus)
    with virtual.channels_lock:
        bus.channel.remove(bus.queue)
        bus.queue = RequestQueue(handle)
        bus.channel.append(bus.queue)


class VirtualBus:
    """A virtual bus with nodes, and a listener that receives all frames."""

    def __init__(self) -> None:
        self.channel = f"scan{next(_numbers)}"
        self.bus = config.Bus(name="can0", interface="virtual", channel=self.channel)
        self.option = f"can0=virtual:{self.channel}"
        self._buses: list[can.BusABC] = []
        self._hosts: list[DeviceBus] = []
        self.listener = self.open()

    def open(self) -> can.BusABC:
        self._buses.append(can.Bus(interface="virtual", channel=self.channel))
        return self._buses[-1]

    def nodes(self) -> DeviceBus:
        """A host of nodes, with samples for 128."""
        bus = self.open()
        host = DeviceBus(bus, lambda _: np.zeros((128, 4), np.int16))
        handle_at_once(bus, lambda frame: host.handle_frame(frame, time.monotonic_ns()))
        self._hosts.append(host)
        return host

    def received(self) -> list[can.Message]:
        return list(iter(lambda: self.listener.recv(0), None))

    def close(self) -> None:
        for host in self._hosts:
            host.stop()
        for bus in self._buses:
            bus.shutdown()


@pytest.fixture
def wire() -> Iterator[VirtualBus]:
    bus = VirtualBus()
    yield bus
    bus.close()


def started(wire: VirtualBus, count: int = 3, **kind: Any) -> DeviceBus:
    """Nodes 0x11 … with serial numbers 1001 … ."""
    nodes = wire.nodes()
    for number in range(count):
        nodes.add(0x11 + number, serial=1001 + number, **kind)
    nodes.start()
    return nodes


def deployment(wire: VirtualBus, pads: int = 3, *changes: tuple[str, str]) -> config.Deployment:
    """The shipped hand's first pads (nodes 0x11 …, serial numbers 1001 …), on the virtual bus."""
    text = shipped.path("utah_mit.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    whole = config.parse(text)
    hand = whole.hands[0].model_copy(update={"pads": whole.hands[0].pads[:pads]})
    return config.with_bus(whole.model_copy(update={"hands": (hand,)}), wire.option)


def problems(expected: config.Deployment | None, reports: list[BusReport]) -> dict[int, str]:
    return {node.node_id: node.problem for node in compare_nodes(expected, reports) if node.problem}


def completed(text: str) -> str:
    """A fragment with its FILL IN lines completed, and a sheet."""
    return re.sub(r"(?m)^# (.* # FILL IN)", r"\1", text) + SHEET


def on_thread(act: Callable[[threading.Event], None]) -> Callable[[], None]:
    """Run `act` in a thread; call the result to end it."""
    stop = threading.Event()
    thread = threading.Thread(target=act, args=(stop,))
    thread.start()

    def end() -> None:
        stop.set()
        thread.join()

    return end


def test_every_node_is_found_with_its_identity(wire: VirtualBus) -> None:
    started(wire, 15)
    (report,) = scan_buses([wire.bus], QUICK)
    assert [node.node_id for node in report.nodes] == list(range(0x11, 0x20))
    assert [node.serial for node in report.nodes] == list(range(1001, 1016))
    assert not report.problems
    for node in report.nodes:
        assert (node.vendor_id, node.product_code, node.revision) == (0, 0x401, 0x10000)
        assert node.answers
        assert node.name
        assert node.error == node.conflict == ""
        (tpdo,) = node.tpdos
        assert (tpdo.number, tpdo.cob_id, tpdo.mapping) == (2, 0x280 + node.node_id, STANDARD)
        assert channel_names(node) == ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4")


def test_lowest_and_highest_node_ids_are_found(wire: VirtualBus) -> None:
    nodes = wire.nodes()
    nodes.add(1)
    nodes.add(127)
    nodes.start()
    (report,) = scan_buses([wire.bus], QUICK)
    assert [node.node_id for node in report.nodes] == [1, 127]


def test_scan_queries_each_id_once_and_sends_only_sdo_uploads(wire: VirtualBus) -> None:
    started(wire, 2)
    wire.received()
    scan_buses([wire.bus], QUICK)
    received = wire.received()
    requests = [m for m in received if 0x600 < m.arbitration_id < 0x680]
    others = [m for m in received if m.arbitration_id < 0x580 or m.arbitration_id > 0x780]
    assert {m.arbitration_id - 0x600 for m in requests} == set(range(1, 128))
    assert {m.data[0] & 0xE0 for m in requests} <= {0x40, 0x60}
    silent = [m for m in requests if m.arbitration_id not in (0x611, 0x612)]
    assert len(silent) == 125
    assert others == []


def test_scan_does_not_change_nmt_states(wire: VirtualBus) -> None:
    nodes = started(wire, 2)
    wire.listener.send(can.Message(arbitration_id=0, data=[1, 0x11], is_extended_id=False))
    while nodes.devices[0x11].state != "OPERATIONAL":
        time.sleep(0.001)
    scan_buses([wire.bus], QUICK)
    assert [nodes.devices[i].state for i in (0x11, 0x12)] == ["OPERATIONAL", "PRE-OPERATIONAL"]


def test_listen_only_sends_no_frame(wire: VirtualBus) -> None:
    (report,) = scan_buses([wire.bus], ScanRequest(listen_only=True, listen_s=0.1))
    assert wire.received() == []
    assert report.nodes == []
    listener = wire.bus.model_copy(update={"role": "listener"})
    (report,) = scan_buses([listener], ScanRequest(lss=True, listen_s=0.1))
    assert wire.received() == []
    assert "listener" in report.problems[0]


def test_listen_only_detects_heartbeats_and_other_traffic_with_its_rate(wire: VirtualBus) -> None:
    def talk(stop: threading.Event) -> None:
        stranger = can.Bus(interface="virtual", channel=wire.channel)
        while not stop.wait(0.005):
            for can_id, data in ((0x705, [5]), (0x123, [1, 2, 3]), (0x80, [])):
                stranger.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            stranger.send(can.Message(arbitration_id=0x1234567, is_extended_id=True))
        stranger.shutdown()

    end = on_thread(talk)
    try:
        (report,) = scan_buses([wire.bus], ScanRequest(listen_only=True, listen_s=0.3))
    finally:
        end()
    assert [(node.node_id, node.state, node.answers) for node in report.nodes] == [(5, "operational", False)]
    assert report.streams.keys() == {0x705, 0x123, 0x80}
    assert report.streams[0x123].data_lengths == {3}
    assert 20 < report.streams[0x123].rate_hz(0.3) <= 210
    assert report.bus_load > 0
    assert report.other_frames > 0


def test_node_without_sdo_response_is_reported(wire: VirtualBus) -> None:
    bus = wire.open()
    end = on_thread(lambda stop: _send_heartbeats(bus, 0x711, stop))
    try:
        expected = deployment(wire, 1)
        reports = scan_buses(expected.buses, QUICK)
    finally:
        end()
    assert problems(expected, reports) == {0x11: "frames received, but no SDO response"}


def _send_heartbeats(bus: can.BusABC, can_id: int, stop: threading.Event) -> None:
    while not stop.wait(0.01):
        bus.send(can.Message(arbitration_id=can_id, data=[5], is_extended_id=False))


@pytest.mark.parametrize("answers", [False, True])
def test_another_program_that_asks_nodes_is_named_where_they_do_not_answer(
    wire: VirtualBus, answers: bool
) -> None:
    if answers:
        started(wire, 1)

    def ask(stop: threading.Event) -> None:
        other = wire.open()
        while not stop.wait(0.005):  # a heartbeat, and a request of an object that nobody has
            for can_id, data in ((0x711, [5]), (0x610, [0x40, 0, 0x99, 0, 0, 0, 0, 0])):
                other.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    end = on_thread(ask)
    try:
        (report,) = scan_buses([wire.bus], QUICK)
    finally:
        end()
    assert any("another program asks nodes" in problem for problem in report.problems) is not answers


def test_hand_as_configured_has_no_problems(wire: VirtualBus) -> None:
    started(wire)
    expected = deployment(wire)
    assert problems(expected, scan_buses(expected.buses, QUICK)) == {}


def test_missing_and_swapped_nodes_are_reported_with_their_location(wire: VirtualBus) -> None:
    nodes = wire.nodes()
    nodes.add(0x11, serial=1002)
    nodes.add(0x12, serial=1001)
    nodes.start()
    expected = deployment(wire)
    found = problems(expected, scan_buses(expected.buses, QUICK))
    assert found[0x11] == (
        "identity mismatch: serial number is 1002, configured is 1001; serial 1001 is that of node 18 on can0"
    )
    assert found[0x12].startswith("identity mismatch: serial number is 1001")
    assert found[0x13] == "missing: no frame received, no SDO response"


def test_node_of_another_kind_is_reported(wire: VirtualBus) -> None:
    started(wire, 1)
    expected = deployment(wire, 1, ("drive_v", "product_code = 7\ndrive_v"))
    assert problems(expected, scan_buses(expected.buses, QUICK)) == {
        0x11: "identity mismatch: product code is 1025, configured is 7"
    }


def test_unmapped_channels_are_a_problem_only_if_remapping_is_not_allowed(wire: VirtualBus) -> None:
    started(wire, 1)
    channels = 'channels = ["0x2000:1:i16", "0x6401:2", "0x6401:3", "0x6401:4"]\n'
    for remap, count in (("true", 0), ("false", 1)):
        expected = deployment(wire, 1, ("drive_v", f"{channels}allow_pdo_remapping = {remap}\ndrive_v"))
        assert len(problems(expected, scan_buses(expected.buses, QUICK))) == count


def test_additional_nodes_are_no_problem(wire: VirtualBus) -> None:
    started(wire, 3)
    expected = deployment(wire, 2)
    reports = scan_buses(expected.buses, QUICK)
    assert problems(expected, reports) == {}
    (other,) = [v for v in compare_nodes(expected, reports) if not v.pad]
    assert (other.node_id, other.remark) == (0x13, "not in the deployment")


def test_duplicate_node_ids_are_reported(wire: VirtualBus) -> None:
    nodes = wire.nodes()
    nodes.add(0x11, serial=1001)
    nodes.add_twin(0x11, serial=1999)
    nodes.start()
    found = problems(None, scan_buses([wire.bus], QUICK))
    assert found == {0x11: "duplicate node id: serial numbers 1001 and 1999"}


def test_several_buses_are_scanned_together() -> None:
    wires = [VirtualBus(), VirtualBus()]
    try:
        for wire in wires:
            started(wire, 2)
        reports = scan_buses([wire.bus for wire in wires], QUICK)
        assert [[node.node_id for node in report.nodes] for report in reports] == [[0x11, 0x12]] * 2
    finally:
        for wire in wires:
            wire.close()


def test_duplicate_cob_ids_are_reported(wire: VirtualBus) -> None:
    started(wire, 2)
    for data in ([0x23, 0x01, 0x18, 0x01, 0x91, 0x02, 0, 0x80], [0x23, 0x01, 0x18, 0x01, 0x91, 0x02, 0, 0]):
        wire.listener.send(can.Message(arbitration_id=0x612, data=data, is_extended_id=False))
    (report,) = scan_buses([wire.bus], QUICK)
    assert report.problems == ["can0: COB-ID 0x291 is used by TPDO2 of node 17 and TPDO2 of node 18"]


def test_reboots_and_emergencies_are_reported(wire: VirtualBus) -> None:
    nodes = started(wire, 1)

    def disturb(stop: threading.Event) -> None:
        while not stop.wait(0.02):
            nodes.devices[0x11].reboot()
            nodes.devices[0x11].send_emergency(0x3100, 1)

    end = on_thread(disturb)
    try:
        (report,) = scan_buses([wire.bus], ScanRequest(listen_only=True, listen_s=0.2))
    finally:
        end()
    (node,) = compare_nodes(None, [report])
    assert re.fullmatch(r"booted \d+ times", node.remark)
    assert report.nodes[0].emergency.startswith("0x3100 mains voltage")
    text = scan_command.to_text([report], [node], None, ok=True)
    lines = text.splitlines()
    heading, row = (next(line for line in lines if mark in line) for mark in ("NMT state", "0x3100"))
    assert heading.index("EMCY") == row.index("0x3100 mains voltage")


VENDORS = {  # file: number and subs of objects, first and last name
    "feldmann-ai4w.eds": ([(0x6401, sub) for sub in (1, 2, 3, 4)], ("0x6401:1", "0x6401:4")),
    "noname-4ch.eds": ([(0x6401, sub) for sub in (1, 2, 3, 4)], ("0x6401:1", "0x6401:4")),
    "norsens-quad404.eds": ([(0x9130, sub) for sub in (1, 2, 3, 4)], ("0x9130:1", "0x9130:4")),
    "tactor-q16.eds": ([(i, 0) for i in (0x2110, 0x2120, 0x2130, 0x2140)], ("0x2110:0:i16", "0x2140:0:i16")),
    "ambit-f401.eds": ([(0x6403, sub) for sub in (1, 2, 3, 4)], ("0x6403:1:f32/1000", "0x6403:4:f32/1000")),
}


def test_channels_of_other_vendors_nodes_are_found(wire: VirtualBus) -> None:
    nodes = wire.nodes()
    for node_id, (file, (objects, _)) in enumerate(VENDORS.items(), 9):
        nodes.add(node_id, eds=Path(__file__).parents[1] / "data/eds" / file, channels=tuple(objects))
    nodes.start()
    (report,) = scan_buses([wire.bus], QUICK)
    for node, (_, names) in zip(report.nodes, VENDORS.values(), strict=True):
        found = channel_names(node)
        assert (found[0], found[-1]) == names
        (kind,) = config.parse(completed(fragment([(report.bus, [node])]))).nodes.values()
        assert kind.channels == found


# Nodes that misbehave


def test_a_refused_identity_is_no_mismatch(wire: VirtualBus) -> None:
    nodes = started(wire, 1)
    nodes.devices[0x11].sdo.fail[0x1018, 4] = 0x06090011
    expected = deployment(wire, 1)
    reports = scan_buses(expected.buses, QUICK)
    (problem,) = problems(expected, reports).values()
    assert problem.startswith("identity unknown: serial number (0x1018:04): Code 0x06090011, ")
    assert problem.endswith("; configured is 1001")


def test_an_invalid_sdo_response_is_not_called_a_missing_one(wire: VirtualBus) -> None:
    """Neither to the probe, whatever its length, nor to a later request."""
    expected = deployment(wire, 3)
    add_answering(wire, 0x11, lambda _: bytes.fromhex("4310"))
    add_answering(wire, 0x12, lambda request: b"\x43\xff\xff" + request[3:])
    add_answering(wire, 0x13, lambda request: b"\x43\0\x10" + bytes(5) if request[1] == 0 else b"\x21" * 8)
    reports = scan_buses(expected.buses, QUICK)
    found = problems(expected, reports)
    probed = "invalid SDO response to the request for 0x1000:00: "
    assert found[0x11] == f"{probed}43 10"
    assert found[0x12] == f"{probed}43 ff ff 00 00 00 00 00"
    assert re.fullmatch(r"reading vendor_id, 0x1018:01: invalid SDO response: .*0x21.*", found[0x13])
    text = scan_command.to_text(reports, compare_nodes(expected, reports), expected, ok=False)
    assert text.count("invalid SDO response ") >= 2
    assert "no SDO response" not in text


def add_answering(wire: VirtualBus, node_id: int, answer: Callable[[bytes], bytes | None]) -> can.BusABC:
    """Add a node whose SDO server is `answer`; it ends with the bus returned."""
    bus = wire.open()

    def serve(request: can.Message) -> None:
        data = answer(bytes(request.data)) if request.arbitration_id == 0x600 + node_id else None
        if data is not None:
            bus.send(can.Message(arbitration_id=0x580 + node_id, data=data, is_extended_id=False))

    handle_at_once(bus, serve)
    return bus


def test_endless_sdo_transfer_does_not_block_the_scan(
    wire: VirtualBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(survey, "READ_TIMEOUT_S", 0.5)

    def endless(request: bytes) -> bytes | None:
        if request[0] == 0x40:
            return bytes((0x40,)) + request[1:4] + bytes(4)
        return bytes((request[0] & 0x10,)) + b"for ever"[:7] if request[0] & 0xE0 == 0x60 else None

    add_answering(wire, 9, endless)
    (report,) = scan_buses([wire.bus], QUICK)
    (node,) = report.nodes
    assert "no answer" in node.error


def test_scan_ends_whatever_nodes_answer(wire: VirtualBus) -> None:
    def babbling(chance: random.Random) -> Callable[[bytes], bytes | None]:
        def babble(request: bytes) -> bytes | None:
            command = chance.choice((0x40, 0x41, 0x43, 0x4F, 0x00, 0x01, 0x10, 0x80, chance.getrandbits(8)))
            return bytes((command,)) + request[1:4] + chance.randbytes(chance.choice((0, 4, 4, 4)))

        return babble

    buses = [add_answering(wire, 9 + seed, babbling(random.Random(seed))) for seed in range(4)]
    reports = scan_buses([wire.bus], QUICK)
    for bus in buses:
        bus.shutdown()
    assert len(compare_nodes(None, reports)) == len(reports[0].nodes) <= len(buses)
    assert cli.main(["scan", "--bus", wire.option, "--seconds", "0.05"]) == 1  # the nodes have stopped


# Nodes without a node id


def unconfigured(
    wire: VirtualBus, serials: list[int], compares: Callable[[int], bool] = lambda _: True
) -> tuple[DeviceBus, list[Any]]:
    nodes = wire.nodes()
    nodes.add(0x20, serial=77)
    made = [nodes.add_unconfigured(serial=serial, lss_compares=compares(serial)) for serial in serials]
    nodes.start()
    return nodes, made


def test_lss_lists_unconfigured_nodes_without_changing_them(wire: VirtualBus) -> None:
    _, made = unconfigured(wire, [3001, 9, 0xFFFFFFFF])
    (report,) = scan_buses([wire.bus], ScanRequest(lss=True, listen_s=0.05))
    assert [address.serial for address in report.unconfigured] == [9, 3001, 0xFFFFFFFF]
    assert not report.problems
    assert [each.lss.node_id for each in made] == [None] * 3
    assert [node.node_id for node in report.nodes] == [0x20]


def test_node_ids_are_assigned_upwards_in_the_order_of_serial_numbers(wire: VirtualBus) -> None:
    _, made = unconfigured(wire, [3001, 9, 2002])
    (report,) = scan_buses([wire.bus], ScanRequest(lss=True, first_assigned_id=0x1F, listen_s=0.05))
    assert [each.lss.stored_id for each in made] == [0x22, 0x1F, 0x21]  # 0x20 is in use
    assert not report.problems
    assert {node.node_id: node.serial for node in report.nodes} == {0x1F: 9, 0x20: 77, 0x21: 2002, 0x22: 3001}


def test_nodes_that_do_not_compare_lss_requests_all_get_ids_in_one_scan(wire: VirtualBus) -> None:
    """As test_lss.py has it of any nodes in simulated time; here the waits are real."""
    serials = [101, 102, 70104]
    _, made = unconfigured(wire, serials, lambda serial: serial % 2 == 1)
    (report,) = scan_buses([wire.bus], ScanRequest(lss=True, first_assigned_id=1, listen_s=0.05))
    assert not report.problems
    expected = {serial: node_id for node_id, serial in enumerate(sorted(serials), 1)}
    assert {each.lss.address.serial: each.lss.stored_id for each in made} == expected
    assert {node.serial: node.node_id for node in report.nodes} == {**expected, 77: 0x20}
    assert {address.serial for address in report.unconfigured} == set(serials)


def test_unconfigured_nodes_with_one_identity_get_no_id_and_are_reported_once(wire: VirtualBus) -> None:
    _, made = unconfigured(wire, [8, 9, 8])
    (report,) = scan_buses([wire.bus], ScanRequest(lss=True, first_assigned_id=1, listen_s=0.05))
    assert [each.lss.node_id for each in made] == [None, 1, None]
    (problem,) = report.problems
    assert "serial 8: several nodes respond" in problem


def test_an_unconfigured_node_with_the_identity_of_another_gets_no_id(wire: VirtualBus) -> None:
    nodes, made = unconfigured(wire, [77, 78])
    (report,) = scan_buses([wire.bus], ScanRequest(lss=True, first_assigned_id=1, listen_s=0.05))
    assert [each.lss.node_id for each in made] == [None, 1]
    assert 0x20 in nodes.devices
    (problem,) = report.problems
    assert "serial 77: node 32 has the same identity" in problem


def test_configured_serial_number_gets_its_configured_node_id(wire: VirtualBus) -> None:
    _, made = unconfigured(wire, [1002, 5])
    expected = deployment(wire)
    scan_buses(expected.buses, ScanRequest(lss=True, first_assigned_id=0x11, listen_s=0.05), expected)
    assert [each.lss.node_id for each in made] == [0x12, 0x14]  # 0x11 and 0x13 are reserved for their nodes


def test_node_that_cannot_store_its_id_is_reported(wire: VirtualBus) -> None:
    _, made = unconfigured(wire, [5])
    made[0].lss.can_store = False
    (report,) = scan_buses([wire.bus], ScanRequest(lss=True, first_assigned_id=9, listen_s=0.05))
    assert list(report.assigned.values()) == [9]
    assert "can't store its node id" in report.problems[0]


def test_node_that_leaves_before_it_gets_an_id_is_reported(wire: VirtualBus) -> None:
    _, made = unconfigured(wire, [5, 6])

    def unplug(progress: str) -> None:
        if "for serial 5" in progress:
            made[0].unplug()

    request = ScanRequest(lss=True, first_assigned_id=9, listen_s=0.05)
    (report,) = scan_buses([wire.bus], request, progress=unplug)
    assert [address.serial for address in report.assigned] == [6]
    (problem,) = report.problems
    assert "serial 5: no response" in problem


def test_exhausted_node_ids_are_reported(wire: VirtualBus) -> None:
    unconfigured(wire, [5, 6])
    (report,) = scan_buses([wire.bus], ScanRequest(lss=True, first_assigned_id=127, listen_s=0.05))
    assert list(report.assigned.values()) == [127]
    assert "no free node id from 127 upwards" in report.problems[0]


# The command


def test_fragment_of_an_unknown_bus_is_a_valid_deployment(
    wire: VirtualBus, capsys: pytest.CaptureFixture[str]
) -> None:
    started(wire, 3)
    assert cli.main(["scan", "--bus", wire.option, "--seconds", "0.05", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    made = config.parse(completed(report["fragment"]))
    assert made.buses == (wire.bus,)
    assert [(pad.node_id, pad.serial) for pad in made.hands[0].pads] == [
        (0x11 + n, 1001 + n) for n in range(3)
    ]
    (kind,) = made.nodes.values()
    assert (kind.vendor_id, kind.product_code) == (0, 0x401)
    assert problems(made, scan_buses(made.buses, QUICK)) == {}


def test_fragment_for_a_deployment_has_only_new_nodes(
    wire: VirtualBus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    started(wire, 2)
    nodes = wire.nodes()
    nodes.add(0x70, serial=7001)
    nodes.add(0x71, serial=1003)
    nodes.start()
    path = shipped.path("utah_mit.toml")
    assert cli.main(["scan", str(path), "--bus", wire.option, "--seconds", "0.05", "--json"]) == 1
    text = json.loads(capsys.readouterr().out)["fragment"]
    assert "[[bus]]" not in text
    assert "[node." not in text  # the deployment already has this kind
    assert 'node = "four_channel"' in text
    added = path.read_text() + completed(text).replace(SHEET, "")
    file = tmp_path / "hand.toml"
    file.write_text(added)
    assert [pad.serial for pad in config.load(file).hands[0].pads[15:]] == [7001]  # 1003 already has a pad


def test_zero_and_shared_serial_numbers_are_omitted(wire: VirtualBus) -> None:
    nodes = wire.nodes()
    for node_id, serial in ((1, 0), (2, 0), (3, 5), (4, 5), (5, 6)):
        nodes.add(node_id, serial=serial)
    nodes.start()
    (report,) = scan_buses([wire.bus], QUICK)
    made = config.parse(completed(fragment([(report.bus, report.nodes)])))
    assert [pad.serial for pad in made.hands[0].pads] == [None, None, None, None, 6]


def test_init_writes_a_deployment_to_start_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "hand.toml"
    assert cli.main(["init", str(file)]) == 0
    assert f"handtouch demo --config {file} --view" in capsys.readouterr().out
    assert cli.main(["check", str(file)]) == 1  # for the serial number that it can't know
    assert re.findall("warning: (.*)", capsys.readouterr().out) == [
        "hand: no serial for name_me_1: replaced sensors are not detected"
    ]
    assert file.read_text().count("# CHECK: ") > 8
    assert cli.main(["init", str(file)]) == 2
    assert "exists" in capsys.readouterr().err


def test_init_from_a_scan_has_a_pad_for_every_node(wire: VirtualBus, tmp_path: Path) -> None:
    started(wire, 2)
    file = tmp_path / "hand.toml"
    assert cli.main(["init", "--from-scan", "--bus", wire.option, str(file)]) == 0
    made = config.load(file)
    assert [(pad.node_id, pad.serial) for pad in made.hands[0].pads] == [(0x11, 1001), (0x12, 1002)]
    assert [bus.channel for bus in made.buses] == [wire.channel]


def test_init_from_a_scan_without_nodes_writes_nothing(
    wire: VirtualBus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "hand.toml"
    assert cli.main(["init", "--from-scan", "--bus", wire.option, str(file)]) == 1
    assert not file.exists()
    assert "check power, bit rate" in capsys.readouterr().err


def test_text_lists_nodes_traffic_and_problems(wire: VirtualBus, capsys: pytest.CaptureFixture[str]) -> None:
    started(wire, 1)
    assert cli.main(["scan", "--bus", wire.option, "--seconds", "0.3"]) == 0
    output = capsys.readouterr().out
    assert re.search(r"17 0x11 .*0x401 .*1001 .*0x6401:1 to 4 in TPDO2 \(transmission type 1\)", output)
    assert "heartbeat of node 17" in output
    assert "no problems" in output


def test_empty_bus_exits_with_status_1_and_a_remedy(
    wire: VirtualBus, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["scan", "--bus", wire.option, "--seconds", "0.05"]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "no node found; check power, bit rate (1000000 bit/s) and termination" in output


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "give a deployment file, or a bus such as --bus can0=socketcan:can0"),
        (["--bus", "can0"], "must be NAME=INTERFACE:CHANNEL"),
        (["--bus", "1x=virtual:a"], 'name = "1x"'),
        (["--bus", "a=nonsense:a"], "python-can knows"),
        (["--bus", "a=virtual:a", "--bus", "a=virtual:b"], "used twice"),
        (["--bus", "a=virtual:a", "--bus", "b=virtual:a"], 'is also the channel of bus "a"'),
        (["--bus", "a=virtual:a,bitrate=5"], "bitrate_bit_s = 5"),
        (["/nowhere/hand.toml"], "/nowhere/hand.toml"),
    ],
)
def test_wrong_usage_exits_with_status_2_and_is_named(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["scan", *arguments]) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [["--listen", "--lss"], ["--assign", "0"], ["--assign", "200"], ["--lss-wait-ms", "0"]]
)
def test_invalid_options_exit_with_status_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["scan", "--bus", "a=virtual:a", *arguments])
    assert ended.value.code == 2


def test_missing_bus_exits_with_status_1_and_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["scan", "--bus", "a=slcan:/dev/nowhere"]) == 1
    assert "/dev/nowhere" in capsys.readouterr().err


def test_device_names_cannot_inject_toml() -> None:
    evil = 'x"\n[daemon]\nlive = "y" [red]'
    node = NodeFacts(5, answers=True, name=evil.replace("\n", " "), tpdos=(tpdo(2, STANDARD),))
    bus = config.Bus(name="can0", interface="virtual", channel='a"b')
    made = config.parse(completed(fragment([(bus, [node])])))
    assert made.buses[0].channel == 'a"b'
    assert list(made.nodes) == ["x_daemon_live_y_red"]


# Which objects are the channels


def tpdo(number: int, mapping: tuple[int, ...]) -> TpdoFacts:
    return TpdoFacts(number, 0x180, True, 1, 0, 0, mapping)


def entries(*objects: tuple[int, int], bits: int = 16) -> tuple[int, ...]:
    return tuple(index << 16 | sub << 8 | bits for index, sub in objects)


@pytest.mark.parametrize(
    ("tpdos", "names"),
    [
        ([STANDARD], ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4")),
        # 32 bits in two TPDOs, after digital inputs
        (
            [
                (0x60000108,),
                entries((0x9130, 1), (0x9130, 2), bits=32),
                entries((0x9130, 3), (0x9130, 4), bits=32),
            ],
            ("0x9130:1", "0x9130:2", "0x9130:3", "0x9130:4"),
        ),
        # REAL32 of CiA 401
        (
            [
                entries((0x6403, 1), (0x6403, 2), bits=32),
                entries((0x6403, 3), (0x6403, 4), bits=32),
            ],
            ("0x6403:1:f32/1000", "0x6403:2:f32/1000", "0x6403:3:f32/1000", "0x6403:4:f32/1000"),
        ),
        # a vendor's own objects, each its own index, between gaps of dummies
        (
            [(0x00050008, *entries((0x2001, 0), (0x2002, 0), (0x2003, 0), (0x2004, 0), bits=8), 0x00050008)],
            ("0x2001:0:i8", "0x2002:0:i8", "0x2003:0:i8", "0x2004:0:i8"),
        ),
        # the first four of eight; process values go before the vendor's
        (
            [entries(*((0x2500, n) for n in range(1, 5))), entries(*((0x7130, n) for n in range(1, 5)))],
            ("0x7130:1", "0x7130:2", "0x7130:3", "0x7130:4"),
        ),
        ([entries((0x6401, 1), (0x6401, 2), (0x6401, 3))], ()),
        ([(0x00070020,) * 4], ()),
        ([], ()),
    ],
)
def test_four_channels_are_found_in_any_mapping(tpdos: list[tuple[int, ...]], names: tuple[str, ...]) -> None:
    node = NodeFacts(5, tpdos=tuple(tpdo(n, mapping) for n, mapping in enumerate(tpdos, 1)))
    assert channel_names(node) == names


def test_unmapped_analogue_inputs_are_named() -> None:
    assert channel_names(NodeFacts(5, inputs=4))[0] == "0x6401:1"
    assert channel_names(NodeFacts(5, inputs=3)) == ()


@given(st.lists(st.lists(st.integers(0, 0xFFFFFFFF), max_size=8), max_size=4))
def test_channels_are_four_of_the_mapped_objects(mappings: list[list[int]]) -> None:
    tpdos = [tpdo(n, tuple(mapping)) for n, mapping in enumerate(mappings, 1)]
    chosen = find_four_channels(tpdos)
    if chosen is not None:
        objects, numbers = chosen
        assert len(objects) == 4
        assert len({entry & 0xFF for entry in objects}) == 1
        assert all(any(entry in t.mapping for t in tpdos if t.number in numbers) for entry in objects)


# Conclusions from frames


def test_node_is_detected_only_by_frames_unique_to_it() -> None:
    traffic = Traffic()
    for can_id in (0x0, 0x80, 0x100, 0x185, 0x205, 0x606, 0x7E4, 0x123):
        traffic.handle_frame(can_id, b"", 1)
    assert traffic.detected_nodes() == set()
    for can_id in (0x707, 0x588, 0x89):
        traffic.handle_frame(can_id, b"\0", 2)
    assert traffic.detected_nodes() == {7, 8, 9}
    assert traffic.boot_up_counts == {7: 1}


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_every_frame_is_handled_and_described(can_id: int, data: bytes) -> None:
    traffic = Traffic()
    traffic.handle_frame(can_id, data, 1)
    assert traffic.frame_statistics[can_id].count == 1
    assert isinstance(describe_identifier(can_id, {}, {can_id & 0x7F}), str)
    assert describe_identifier(can_id, {can_id: "TPDO9 of node 3"}, set()) or can_id == 0


def test_channels_are_analogue_before_all_else_and_never_digital_or_of_a_drive() -> None:
    digital = TpdoFacts(1, 0x181, True, 1, 0, 0, tuple(0x6000_0008 | sub << 8 for sub in (1, 2, 3, 4)))
    own = TpdoFacts(2, 0x281, True, 1, 0, 0, tuple(0x2100_0010 | sub << 8 for sub in (1, 2, 3, 4)))
    analogue = TpdoFacts(3, 0x381, True, 1, 0, 0, tuple(0x6401_0010 | sub << 8 for sub in (1, 2, 3, 4)))
    assert find_four_channels([digital]) is None
    assert find_four_channels([digital, own]) == (own.mapping, (2,))
    assert find_four_channels([digital, own, analogue]) == (analogue.mapping, (3,))
    state = TpdoFacts(1, 0x181, True, 1, 0, 0, (0x6041_0010, 0x2200_0010))
    again = TpdoFacts(2, 0x281, True, 1, 0, 0, (0x6041_0010, 0x2200_0010))
    assert find_four_channels([state, again, state, again]) is None  # an object once
    drive = NodeFacts(5, answers=True, device_type=0x20192, tpdos=(own,))
    assert find_channels_of_node(drive) is None
    assert find_channels_of_node(NodeFacts(5, answers=True, device_type=401, tpdos=(own,))) is not None
