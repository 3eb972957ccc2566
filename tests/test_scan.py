"""`handtouch scan`: finds all that is there, says what doesn't fit, and leaves every node as it was."""

from __future__ import annotations

import itertools
import json
import random
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch import cli, config, scan, shipped
from handtouch.canbus.device import DeviceBus
from handtouch.canbus.find import survey
from handtouch.canbus.find.survey import NodeFacts, TpdoFacts, four_channels
from handtouch.canbus.find.traffic import Traffic, meaning
from handtouch.scan.fragment import channel_names, fragment
from handtouch.scan.judge import judge
from handtouch.scan.look import BusReport, Request
from handtouch.scan.look import scan as look_at

_numbers = itertools.count()
QUICK = Request(seconds=0.05)
SHEET = """
[sheet.firm]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20_000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5
"""
STANDARD = tuple(0x6401 << 16 | sub << 8 | 16 for sub in (1, 2, 3, 4))


class Wire:
    """A virtual bus with nodes on it, and an ear that hears what others send."""

    def __init__(self) -> None:
        self.channel = f"scan{next(_numbers)}"
        self.bus = config.Bus(name="can0", interface="virtual", channel=self.channel)
        self.option = f"can0=virtual:{self.channel}"
        self._buses: list[can.BusABC] = []
        self._hosts: list[DeviceBus] = []
        self.ear = self.open()

    def open(self) -> can.BusABC:
        self._buses.append(can.Bus(interface="virtual", channel=self.channel))
        return self._buses[-1]

    def nodes(self) -> DeviceBus:
        """Nodes to add to; their sampler has rows for 128."""
        host = DeviceBus(self.open(), lambda _: np.zeros((128, 4), np.int16))
        self._hosts.append(host)
        return host

    def heard(self) -> list[can.Message]:
        return list(iter(lambda: self.ear.recv(0), None))

    def close(self) -> None:
        for host in self._hosts:
            host.stop()
        for bus in self._buses:
            bus.shutdown()


@pytest.fixture
def wire() -> Iterator[Wire]:
    made = Wire()
    yield made
    made.close()


def started(wire: Wire, count: int = 3, **kind: Any) -> DeviceBus:
    """Nodes 0x11 … with serial numbers 1001 … ."""
    nodes = wire.nodes()
    for number in range(count):
        nodes.add(0x11 + number, serial=1001 + number, **kind)
    nodes.start()
    return nodes


def deployment(wire: Wire, pads: int = 3, *changes: tuple[str, str]) -> config.Deployment:
    """The shipped hand's first pads (nodes 0x11 …, serial numbers 1001 …), on the wire."""
    text = shipped.path("utah_mit.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    whole = config.parse(text)
    hand = whole.hands[0].model_copy(update={"pads": whole.hands[0].pads[:pads]})
    return config.with_bus(whole.model_copy(update={"hands": (hand,)}), wire.option)


def wrongs(wanted: config.Deployment | None, reports: list[BusReport]) -> dict[int, str]:
    return {verdict.node_id: verdict.wrong for verdict in judge(wanted, reports) if verdict.wrong}


def completed(text: str) -> str:
    """A fragment whose lines to fill in are, with the rest that a deployment needs."""
    return re.sub(r"(?m)^# (.* # FILL IN)", r"\1", text) + SHEET


def on_thread(act: Callable[[threading.Event], None]) -> Callable[[], None]:
    """Let something happen on the bus meanwhile; call the result to end it."""
    over = threading.Event()
    thread = threading.Thread(target=act, args=(over,))
    thread.start()

    def end() -> None:
        over.set()
        thread.join()

    return end


def test_every_node_is_found_with_all_that_it_tells(wire: Wire) -> None:
    started(wire, 15)
    (report,) = look_at([wire.bus], QUICK)
    assert [node.node_id for node in report.nodes] == list(range(0x11, 0x20))
    assert [node.serial for node in report.nodes] == list(range(1001, 1016))
    assert not report.problems
    for node in report.nodes:
        assert (node.vendor_id, node.product_code, node.revision) == (0, 0x401, 0x10000)
        assert node.answers
        assert node.name
        assert node.trouble == node.conflict == ""
        (tpdo,) = node.tpdos
        assert (tpdo.number, tpdo.cob_id, tpdo.mapping) == (2, 0x280 + node.node_id, STANDARD)
        assert channel_names(node) == ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4")


def test_nodes_at_both_ends_of_the_ids_are_found(wire: Wire) -> None:
    nodes = wire.nodes()
    nodes.add(1)
    nodes.add(127)
    nodes.start()
    (report,) = look_at([wire.bus], QUICK)
    assert [node.node_id for node in report.nodes] == [1, 127]


def test_a_scan_asks_each_id_once_and_sends_nothing_but_sdo_uploads(wire: Wire) -> None:
    started(wire, 2)
    wire.heard()
    look_at([wire.bus], QUICK)
    heard = wire.heard()
    requests = [m for m in heard if 0x600 < m.arbitration_id < 0x680]
    others = [m for m in heard if m.arbitration_id < 0x580 or m.arbitration_id > 0x780]
    assert {m.arbitration_id - 0x600 for m in requests} == set(range(1, 128))
    assert {m.data[0] & 0xE0 for m in requests} <= {0x40, 0x60}
    silent = [m for m in requests if m.arbitration_id not in (0x611, 0x612)]
    assert len(silent) == 125
    assert others == []


def test_a_scan_leaves_running_nodes_running(wire: Wire) -> None:
    nodes = started(wire, 2)
    wire.ear.send(can.Message(arbitration_id=0, data=[1, 0x11], is_extended_id=False))
    while nodes.devices[0x11].state != "OPERATIONAL":
        time.sleep(0.001)
    look_at([wire.bus], QUICK)
    assert [nodes.devices[i].state for i in (0x11, 0x12)] == ["OPERATIONAL", "PRE-OPERATIONAL"]


def test_listening_sends_nothing_at_all(wire: Wire) -> None:
    (report,) = look_at([wire.bus], Request(listen_only=True, seconds=0.1))
    assert wire.heard() == []
    assert report.nodes == []
    listener = wire.bus.model_copy(update={"role": "listener"})
    (report,) = look_at([listener], Request(lss=True, seconds=0.1))
    assert wire.heard() == []
    assert "listener" in report.problems[0]


def test_listening_hears_nodes_by_their_heartbeats_and_foreign_traffic_with_its_rate(wire: Wire) -> None:
    def talk(over: threading.Event) -> None:
        stranger = can.Bus(interface="virtual", channel=wire.channel)
        while not over.wait(0.005):
            for can_id, data in ((0x705, [5]), (0x123, [1, 2, 3]), (0x80, [])):
                stranger.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            stranger.send(can.Message(arbitration_id=0x1234567, is_extended_id=True))
        stranger.shutdown()

    end = on_thread(talk)
    try:
        (report,) = look_at([wire.bus], Request(listen_only=True, seconds=0.3))
    finally:
        end()
    assert [(node.node_id, node.state, node.answers) for node in report.nodes] == [(5, "operational", False)]
    assert report.streams.keys() == {0x705, 0x123, 0x80}
    assert report.streams[0x123].sizes == {3}
    assert 20 < report.streams[0x123].rate_hz(0.3) <= 210
    assert report.load > 0
    assert report.others > 0


def test_a_node_that_is_heard_and_does_not_answer_is_told(wire: Wire) -> None:
    ear = wire.open()
    end = on_thread(lambda over: _beat(ear, 0x711, over))
    try:
        wanted = deployment(wire, 1)
        reports = look_at(wanted.buses, QUICK)
    finally:
        end()
    assert wrongs(wanted, reports) == {0x11: "heard, but its SDO server doesn't answer"}


def _beat(bus: can.BusABC, can_id: int, over: threading.Event) -> None:
    while not over.wait(0.01):
        bus.send(can.Message(arbitration_id=can_id, data=[5], is_extended_id=False))


def test_a_hand_as_configured_is_well(wire: Wire) -> None:
    started(wire)
    wanted = deployment(wire)
    assert wrongs(wanted, look_at(wanted.buses, QUICK)) == {}


def test_missing_and_swapped_nodes_are_told_with_where_they_are(wire: Wire) -> None:
    nodes = wire.nodes()
    nodes.add(0x11, serial=1002)
    nodes.add(0x12, serial=1001)
    nodes.start()
    wanted = deployment(wire)
    said = wrongs(wanted, look_at(wanted.buses, QUICK))
    assert said[0x11] == (
        "another device: serial number is 1002, configured is 1001; serial 1001 is that of node 18 on can0"
    )
    assert said[0x12].startswith("another device: serial number is 1001")
    assert said[0x13] == "missing: not heard, and no answer"


def test_a_node_of_another_kind_is_told(wire: Wire) -> None:
    started(wire, 1)
    wanted = deployment(wire, 1, ("drive_v", "product_code = 7\ndrive_v"))
    assert wrongs(wanted, look_at(wanted.buses, QUICK)) == {
        0x11: "another device: product code is 1025, configured is 7"
    }


def test_channels_that_no_tpdo_carries_are_wrong_only_if_they_may_not_be_mapped(wire: Wire) -> None:
    started(wire, 1)
    channels = 'channels = ["0x2000:1:i16", "0x6401:2", "0x6401:3", "0x6401:4"]\n'
    for remap, count in (("true", 0), ("false", 1)):
        wanted = deployment(wire, 1, ("drive_v", f"{channels}remap = {remap}\ndrive_v"))
        assert len(wrongs(wanted, look_at(wanted.buses, QUICK))) == count


def test_nodes_that_are_not_configured_are_no_fault(wire: Wire) -> None:
    started(wire, 3)
    wanted = deployment(wire, 2)
    reports = look_at(wanted.buses, QUICK)
    assert wrongs(wanted, reports) == {}
    (other,) = [v for v in judge(wanted, reports) if not v.pad]
    assert (other.node_id, other.remark) == (0x13, "not in the deployment")


def test_two_nodes_with_one_id_are_told(wire: Wire) -> None:
    nodes = wire.nodes()
    nodes.add(0x11, serial=1001)
    nodes.add_twin(0x11, serial=1999)
    nodes.start()
    said = wrongs(None, look_at([wire.bus], QUICK))
    assert said == {0x11: "two nodes with this id: serial numbers 1001 and 1999"}


def test_several_buses_are_looked_at_together() -> None:
    wires = [Wire(), Wire()]
    try:
        for wire in wires:
            started(wire, 2)
        reports = look_at([wire.bus for wire in wires], QUICK)
        assert [[node.node_id for node in report.nodes] for report in reports] == [[0x11, 0x12]] * 2
    finally:
        for wire in wires:
            wire.close()


def test_two_tpdos_with_one_identifier_are_told(wire: Wire) -> None:
    started(wire, 2)
    for data in ([0x23, 0x01, 0x18, 0x01, 0x91, 0x02, 0, 0x80], [0x23, 0x01, 0x18, 0x01, 0x91, 0x02, 0, 0]):
        wire.ear.send(can.Message(arbitration_id=0x612, data=data, is_extended_id=False))
    (report,) = look_at([wire.bus], QUICK)
    assert report.problems == ["can0: identifier 0x291 is used by TPDO2 of node 17 and TPDO2 of node 18"]


def test_reboots_and_emergencies_are_told(wire: Wire) -> None:
    nodes = started(wire, 1)

    def suffer(over: threading.Event) -> None:
        while not over.wait(0.02):
            nodes.devices[0x11].reboot()
            nodes.devices[0x11].emergency(0x3100, 1)

    end = on_thread(suffer)
    try:
        (report,) = look_at([wire.bus], Request(listen_only=True, seconds=0.2))
    finally:
        end()
    (verdict,) = judge(None, [report])
    assert re.search(r"booted \d+ times; EMCY 0x3100 mains voltage", verdict.remark)


@pytest.mark.parametrize(
    ("file", "objects", "names"),
    [
        ("feldmann-ai4w.eds", [(0x6401, sub) for sub in (1, 2, 3, 4)], ("0x6401:1", "0x6401:4")),
        ("noname-4ch.eds", [(0x6401, sub) for sub in (1, 2, 3, 4)], ("0x6401:1", "0x6401:4")),
        ("norsens-quad404.eds", [(0x9130, sub) for sub in (1, 2, 3, 4)], ("0x9130:1", "0x9130:4")),
        (
            "tactor-q16.eds",
            [(i, 0) for i in (0x2110, 0x2120, 0x2130, 0x2140)],
            ("0x2110:0:i16", "0x2140:0:i16"),
        ),
    ],
)
def test_the_channels_of_other_makers_nodes_are_found(
    wire: Wire, file: str, objects: list[tuple[int, int]], names: tuple[str, str]
) -> None:
    nodes = wire.nodes()
    nodes.add(9, eds=Path(__file__).parent / "data/eds" / file, channels=tuple(objects))
    nodes.start()
    (report,) = look_at([wire.bus], QUICK)
    (node,) = report.nodes
    found = channel_names(node)
    assert (found[0], found[-1]) == names
    (kind,) = config.parse(completed(fragment([(report.bus, report.nodes)]))).nodes.values()
    assert kind.channels == found


# Nodes that misbehave


def answering(wire: Wire, node_id: int, answer: Callable[[bytes], bytes | None]) -> Callable[[], None]:
    """A node whose SDO server does as `answer` says."""
    bus = wire.open()

    def serve(over: threading.Event) -> None:
        while not over.is_set():
            request = bus.recv(0.05)
            data = (
                answer(bytes(request.data)) if request and request.arbitration_id == 0x600 + node_id else None
            )
            if data is not None:
                bus.send(can.Message(arbitration_id=0x580 + node_id, data=data, is_extended_id=False))

    return on_thread(serve)


def test_a_transfer_that_never_ends_does_not_hold_the_scan_up(
    wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(survey, "READ_S", 0.5)

    def endless(request: bytes) -> bytes | None:
        if request[0] == 0x40:
            return bytes((0x40,)) + request[1:4] + bytes(4)
        return bytes((request[0] & 0x10,)) + b"for ever"[:7] if request[0] & 0xE0 == 0x60 else None

    end = answering(wire, 9, endless)
    try:
        (report,) = look_at([wire.bus], QUICK)
    finally:
        end()
    (node,) = report.nodes
    assert "no answer" in node.trouble


@pytest.mark.parametrize("seed", range(4))
def test_whatever_a_node_answers_the_scan_ends_and_tells_what_it_could_read(wire: Wire, seed: int) -> None:
    chance = random.Random(seed)

    def babble(request: bytes) -> bytes | None:
        command = chance.choice((0x40, 0x41, 0x43, 0x4F, 0x00, 0x01, 0x10, 0x80, chance.getrandbits(8)))
        return bytes((command,)) + request[1:4] + chance.randbytes(chance.choice((0, 4, 4, 4)))

    end = answering(wire, 9, babble)
    try:
        reports = look_at([wire.bus], QUICK)
    finally:
        end()
    assert len(judge(None, reports)) == len(reports[0].nodes) <= 1
    assert cli.main(["scan", "--bus", wire.option, "--seconds", "0.05"]) == 1  # nobody there any more


# Nodes without an id


def unnamed(wire: Wire, serials: list[int]) -> tuple[DeviceBus, list[Any]]:
    nodes = wire.nodes()
    nodes.add(0x20, serial=77)
    made = [nodes.add_unconfigured(serial=serial) for serial in serials]
    nodes.start()
    return nodes, made


def test_nodes_without_an_id_are_listed_and_not_changed(wire: Wire) -> None:
    _, made = unnamed(wire, [3001, 9, 0xFFFFFFFF])
    (report,) = look_at([wire.bus], Request(lss=True, seconds=0.05))
    assert [address.serial for address in report.unconfigured] == [9, 3001, 0xFFFFFFFF]
    assert not report.problems
    assert [each.lss.node_id for each in made] == [None] * 3
    assert [node.node_id for node in report.nodes] == [0x20]


def test_ids_are_given_upwards_from_the_first_free_one_by_serial_number(wire: Wire) -> None:
    _, made = unnamed(wire, [3001, 9, 2002])
    (report,) = look_at([wire.bus], Request(lss=True, assign=0x1F, seconds=0.05))
    assert [each.lss.stored_id for each in made] == [0x22, 0x1F, 0x21]  # 0x20 is another's
    assert not report.problems
    assert {node.node_id: node.serial for node in report.nodes} == {0x1F: 9, 0x20: 77, 0x21: 2002, 0x22: 3001}


def test_a_configured_serial_number_gets_its_configured_id(wire: Wire) -> None:
    _, made = unnamed(wire, [1002, 5])
    wanted = deployment(wire)
    look_at(wanted.buses, Request(lss=True, assign=0x11, seconds=0.05), wanted)
    assert [each.lss.node_id for each in made] == [0x12, 0x14]  # 0x11 and 0x13 wait for their own


def test_a_node_that_cannot_store_its_id_is_told(wire: Wire) -> None:
    _, made = unnamed(wire, [5])
    made[0].lss.can_store = False
    (report,) = look_at([wire.bus], Request(lss=True, assign=9, seconds=0.05))
    assert list(report.assigned.values()) == [9]
    assert "can't store its id" in report.problems[0]


def test_ids_that_run_out_are_told(wire: Wire) -> None:
    unnamed(wire, [5, 6])
    (report,) = look_at([wire.bus], Request(lss=True, assign=127, seconds=0.05))
    assert list(report.assigned.values()) == [127]
    assert "no id from 127 upwards is free" in report.problems[0]


# The command


def test_the_fragment_of_a_strange_bus_becomes_a_deployment(
    wire: Wire, capsys: pytest.CaptureFixture[str]
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
    assert wrongs(made, look_at(made.buses, QUICK)) == {}


def test_the_fragment_beside_a_deployment_has_only_what_is_new(
    wire: Wire, tmp_path: Path, capsys: pytest.CaptureFixture[str]
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
    assert "[node." not in text  # of the kind that the deployment has already
    assert 'node = "four_channel"' in text
    added = path.read_text() + completed(text).replace(SHEET, "")
    file = tmp_path / "hand.toml"
    file.write_text(added)
    assert [pad.serial for pad in config.load(file).hands[0].pads[15:]] == [7001]  # 1003 has its pad already


def test_serial_numbers_that_tell_nothing_are_left_out(wire: Wire) -> None:
    nodes = wire.nodes()
    for node_id, serial in ((1, 0), (2, 0), (3, 5), (4, 5), (5, 6)):
        nodes.add(node_id, serial=serial)
    nodes.start()
    (report,) = look_at([wire.bus], QUICK)
    made = config.parse(completed(fragment([(report.bus, report.nodes)])))
    assert [pad.serial for pad in made.hands[0].pads] == [None, None, None, None, 6]


def test_text_names_nodes_traffic_and_what_is_wrong(wire: Wire, capsys: pytest.CaptureFixture[str]) -> None:
    started(wire, 1)
    assert cli.main(["scan", "--bus", wire.option, "--seconds", "0.3"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"17 0x11 .*0x401 .*1001 .*0x6401:1 to 4 in TPDO2 \(every SYNC\)", said)
    assert "heartbeat of node 17" in said
    assert "all is well" in said


def test_an_empty_bus_is_status_1_with_what_to_look_at(
    wire: Wire, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["scan", "--bus", wire.option, "--seconds", "0.05"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "no node was found; are they powered, is the bit rate 1000000, is the bus terminated?" in said


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "give a deployment file, or a bus such as --bus can0=socketcan:can0"),
        (["--bus", "can0"], "must be NAME=INTERFACE:CHANNEL"),
        (["--bus", "1x=virtual:a"], "name = 1x"),
        (["--bus", "a=nonsense:a"], "python-can knows"),
        (["--bus", "a=virtual:a", "--bus", "a=virtual:b"], "used twice"),
        (["--bus", "a=virtual:a", "--bus", "b=virtual:a"], 'is the wire of bus "a" too'),
        (["--bus", "a=virtual:a,bitrate=5"], "bitrate_bit_s = 5"),
        (["/nowhere/hand.toml"], "/nowhere/hand.toml"),
    ],
)
def test_wrong_use_is_status_2_and_named(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["scan", *words]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["--listen", "--lss"], ["--assign", "0"], ["--assign", "200"], ["--lss-wait-ms", "0"]]
)
def test_options_that_contradict_or_cannot_be_are_status_2(words: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["scan", "--bus", "a=virtual:a", *words])
    assert ended.value.code == 2


def test_a_bus_that_is_not_there_is_status_1_and_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert scan.run(None, ["a=slcan:/dev/nowhere"], QUICK) == 1
    assert "/dev/nowhere" in capsys.readouterr().err


def test_names_from_the_bus_are_only_ever_text() -> None:
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
        # a vendor's own objects, each its own index, between gaps of dummies
        (
            [(0x00050008, *entries((0x2001, 0), (0x2002, 0), (0x2003, 0), (0x2004, 0), bits=8), 0x00050008)],
            ("0x2001:0:i8", "0x2002:0:i8", "0x2003:0:i8", "0x2004:0:i8"),
        ),
        # the first four of eight; process values go before the vendor's
        (
            [entries(*((0x2500, n) for n in range(1, 5))), entries(*((0x7130, n) for n in range(1, 5)))],
            ("0x2500:1:i16", "0x2500:2:i16", "0x2500:3:i16", "0x2500:4:i16"),
        ),
        ([entries((0x6401, 1), (0x6401, 2), (0x6401, 3))], ()),
        ([(0x00070020,) * 4], ()),
        ([], ()),
    ],
)
def test_four_channels_are_found_where_the_node_has_them(
    tpdos: list[tuple[int, ...]], names: tuple[str, ...]
) -> None:
    node = NodeFacts(5, tpdos=tuple(tpdo(n, mapping) for n, mapping in enumerate(tpdos, 1)))
    assert channel_names(node) == names


def test_analogue_inputs_that_are_in_no_tpdo_are_named_since_they_can_be_mapped() -> None:
    assert channel_names(NodeFacts(5, inputs=4))[0] == "0x6401:1"
    assert channel_names(NodeFacts(5, inputs=3)) == ()


@given(st.lists(st.lists(st.integers(0, 0xFFFFFFFF), max_size=8), max_size=4))
def test_whatever_is_mapped_the_channels_are_four_of_it(mappings: list[list[int]]) -> None:
    tpdos = [tpdo(n, tuple(mapping)) for n, mapping in enumerate(mappings, 1)]
    chosen = four_channels(tpdos)
    if chosen is not None:
        objects, numbers = chosen
        assert len(objects) == 4
        assert len({entry & 0xFF for entry in objects}) == 1
        assert all(any(entry in t.mapping for t in tpdos if t.number in numbers) for entry in objects)


# What frames tell


def test_an_id_is_proved_only_by_frames_that_nobody_else_sends() -> None:
    traffic = Traffic()
    for can_id in (0x0, 0x80, 0x100, 0x185, 0x205, 0x606, 0x7E4, 0x123):
        traffic.handle(can_id, b"", 1)
    assert traffic.nodes() == set()
    for can_id in (0x707, 0x588, 0x89):
        traffic.handle(can_id, b"\0", 2)
    assert traffic.nodes() == {7, 8, 9}
    assert traffic.boots == {7: 1}


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_every_frame_has_a_meaning_or_none_and_upsets_nothing(can_id: int, data: bytes) -> None:
    traffic = Traffic()
    traffic.handle(can_id, data, 1)
    assert traffic.streams[can_id].count == 1
    assert isinstance(meaning(can_id, {}, {can_id & 0x7F}), str)
    assert meaning(can_id, {can_id: "TPDO9 of node 3"}, set()) or can_id == 0
