"""Simulated nodes on buses answer SYNC with the virtual hand's samples, and the ground truth is recorded."""

from __future__ import annotations

import re
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import can
import pytest

from handtouch import config
from handtouch.canbus.bus.port import BusError
from handtouch.cli import main
from handtouch.cli.simulate import run, run_command
from handtouch.config.problems import ConfigError
from handtouch.simulate import simulated_hand
from handtouch.simulate import truth as truth_file
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.simulated_hand import SimulatedHand
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import SHEET_KINDS, WORLDS, Fixed, world_with

IDEAL = WORLDS["ideal"].draw(2)
SESSION = """
[[touch]]
link = "tip"
from_s = 0.001
duration_s = 60.0
path = [[0.4, 0.6]]
force_n = [1.0]
ramp_s = 0.002

[[touch]]
link = "flat"
from_s = 0.001
duration_s = 60.0
path = [[0.7, 0.3]]
force_n = [2.0]
ramp_s = 0.002
"""


class Master:
    """Minimal CANopen master: starts all nodes, sends SYNC, collects TPDOs."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send(self, identifier: int, *data: int) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def sync(self, answers: int) -> dict[int, tuple[int, ...]]:
        """Samples by node id."""
        self.send(0x80)
        found: dict[int, tuple[int, ...]] = {}
        deadline = time.monotonic() + 5
        while len(found) < answers and time.monotonic() < deadline:
            frame = self._bus.recv(0.5)
            if frame is not None and 0x280 < frame.arbitration_id < 0x300:
                found[frame.arbitration_id - 0x280] = struct.unpack("<4h", frame.data)
        return found


@contextmanager
def master(deployment: config.Deployment, number: int) -> Iterator[Master]:
    bus = deployment.buses[number]
    with can.Bus(interface="virtual", channel=bus.channel) as wire:
        yield Master(wire)


def test_every_bus_answers_sync_with_samples_of_its_pads(deployment: config.Deployment) -> None:
    scenario = Scenario.parse(SESSION)
    with (
        master(deployment, 0) as near,
        master(deployment, 1) as far,
        SimulatedHand.open(deployment, scenario, IDEAL) as hand,
    ):
        hand.start()
        for side in (near, far):
            side.send(0, 1, 0)
        assert set(near.sync(2)) == {3, 4}
        time.sleep(0.01)
        samples = {"near": near.sync(2), "far": far.sync(2)}
        truth = {record.link: record for record in hand.truth}
        start_ns = min(hand.sync_times_ns)
    for bus, links in (("near", {3: "flat"}), ("far", {5: "tip"})):
        virtual = VirtualHand(deployment, scenario, IDEAL, bus)
        for node_id, link in links.items():
            row = [pad.link for _, pad in virtual.pads].index(link)
            t_ns = truth[link].t_ns
            expected = virtual.sample((t_ns - start_ns) * 1e-9)[row]
            assert samples[bus][node_id] == tuple(expected.tolist())
    assert {device.serial for device in hand.devices.values()} == {30, 0}


def test_popped_truth_is_not_returned_again_and_recording_is_optional(deployment: config.Deployment) -> None:
    scenario = Scenario.parse(SESSION)
    with master(deployment, 0) as near, SimulatedHand.open(deployment, scenario, IDEAL) as hand:
        hand.start()
        near.send(0, 1, 0)
        near.sync(2)
        time.sleep(0.01)
        near.sync(2)
        assert [record.link for record in hand.truth] == ["flat"]
        assert [record.link for record in hand.pop_truth()] == ["flat"]
        assert hand.truth == []
    with master(deployment, 0) as near, SimulatedHand.open(deployment, scenario, IDEAL, record=False) as hand:
        hand.start()
        near.send(0, 1, 0)
        near.sync(2)
        near.sync(2)
        assert hand.sync_count == 2
        assert hand.sync_times_ns == []


def test_nodes_are_accessible_by_link(deployment: config.Deployment) -> None:
    with (
        master(deployment, 0) as near,
        SimulatedHand.open(deployment, Scenario.tour(deployment), IDEAL) as hand,
    ):
        hand.start()
        near.send(0, 1, 0)
        assert set(near.sync(2)) == {3, 4}
        hand.devices["right/flat"].unplug()
        assert set(near.sync(1)) == {4}


def test_hand_is_built_before_its_buses_are_opened(
    deployment: config.Deployment, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []

    def building(*arguments: object) -> VirtualHand:
        order.append("hand")
        return VirtualHand(*arguments)  # type: ignore[arg-type]

    def opening(bus: config.Bus) -> can.BusABC:
        order.append("bus")
        return can.Bus(interface="virtual", channel=bus.channel)

    monkeypatch.setattr(simulated_hand, "VirtualHand", building)
    monkeypatch.setattr(simulated_hand, "open_bus", opening)
    SimulatedHand.open(deployment, Scenario.tour(deployment), IDEAL).stop()
    assert order == ["hand", "hand", "bus", "bus"]


def test_unsupported_deployment_is_rejected_before_any_node_starts(
    deployment: config.Deployment, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="carries no pad"):
        SimulatedHand.open(deployment, Scenario.parse(SESSION.replace("tip", "toe")), IDEAL)
    missing = deployment.buses[0].model_copy(update={"interface": "socketcan", "channel": "no-such0"})
    with pytest.raises(BusError, match=r"near.*no-such0"):
        SimulatedHand.open(
            deployment.model_copy(update={"buses": (missing, deployment.buses[1])}),
            Scenario.tour(deployment),
            IDEAL,
        )
    eds = tmp_path / "other.eds"
    eds.write_text("[FileInfo]\nFileName=other.eds\n[DeviceInfo]\nVendorName=x\n")
    node = deployment.nodes["n"].model_copy(update={"eds": str(eds)})
    with pytest.raises(ValueError, match="has no objects"):
        SimulatedHand.open(
            deployment.model_copy(update={"nodes": {"n": node}}), Scenario.tour(deployment), IDEAL
        )


@pytest.fixture
def files(tmp_path: Path, deployment_text: str) -> Path:
    (tmp_path / "hand.toml").write_text(deployment_text)
    (tmp_path / "session.toml").write_text(SESSION)
    return tmp_path


def test_simulate_runs_until_stopped_and_writes_truth(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stop = threading.Event()
    status: list[int] = []
    arguments = {
        "scenario": files / "session.toml",
        "truth": files / "truth.jsonl",
        "world": IDEAL,
        "stop": stop,
    }
    thread = threading.Thread(target=lambda: status.append(run(files / "hand.toml", **arguments)))  # type: ignore[arg-type]
    with master(config.load(files / "hand.toml"), 0) as near:
        thread.start()
        deadline = time.monotonic() + 20
        found: dict[int, tuple[int, ...]] = {}
        while len(found) < 2 and time.monotonic() < deadline:
            near.send(0, 1, 0)
            found = near.sync(0) or near.sync(2) if thread.is_alive() else {}
        for _ in range(20):
            time.sleep(0.002)  # the touch begins 1 ms after the first SYNC
            near.sync(2)
        stop.set()
        thread.join(10)
    assert status == [0]
    records = truth_file.read_records(files / "truth.jsonl")
    assert {record.link for record in records} == {"flat"}
    assert len(records) >= 15
    assert [record.t_ns for record in records] == sorted(record.t_ns for record in records)
    assert "4 nodes on near" in capsys.readouterr().out


def test_simulate_ends_after_its_seconds(files: Path) -> None:
    begin = time.monotonic()
    assert run(files / "hand.toml", seconds=0.2, stop=threading.Event()) == 0
    assert time.monotonic() - begin < 10


def test_status_reports_buses_without_sync_and_remedy(
    files: Path, deployment_text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    consumer = deployment_text.replace('name = "far"', 'name = "far"\nsync = "consumer"')
    (files / "hand.toml").write_text(consumer)
    assert run(files / "hand.toml", seconds=0.2, stop=threading.Event(), status_period_s=0.01) == 0
    output = capsys.readouterr().out
    assert 'near: no SYNC received; start the daemon with `handtouch run` (sync = "producer")' in output
    assert 'far: no SYNC received; start the SYNC producer of the bus (sync = "consumer")' in output


def test_buses_without_sync_are_listed_until_their_first_sync(deployment: config.Deployment) -> None:
    with (
        master(deployment, 0) as near,
        master(deployment, 1) as far,
        SimulatedHand.open(deployment, Scenario.tour(deployment), IDEAL) as hand,
    ):
        hand.start()
        near.send(0, 1, 0)
        near.sync(2)
        assert hand.buses_without_sync == ["far"]
        far.send(0, 1, 0)
        far.sync(2)
        assert hand.buses_without_sync == []


def test_negative_seed_is_rejected() -> None:
    with pytest.raises(ValueError, match="seed = -1: must lie between 0 and 1999999"):
        WORLDS["ideal"].draw(-1)


@pytest.mark.parametrize(
    ("change", "status", "expected"),
    [
        ({"config_path": "none.toml"}, 2, "none.toml"),
        ({"scenario": "none.toml"}, 2, "none.toml"),
        ({"buses": ("near=socketcan:no-such0",)}, 1, "no-such0"),
        ({"buses": ("wrong",)}, 2, "wrong"),
        ({"truth": "no/folder/truth.jsonl"}, 1, "truth.jsonl"),
    ],
)
def test_simulate_exit_status_for_each_mistake(
    files: Path, change: dict[str, object], status: int, expected: str
) -> None:
    arguments = {"config_path": "hand.toml", "scenario": "session.toml", "truth": None, **change}
    paths = {key: files / value if isinstance(value, str) else value for key, value in arguments.items()}
    with pytest.raises(Exception, match=re.escape(expected)) as ended:
        run(**paths, stop=threading.Event(), seconds=0.05)  # type: ignore[arg-type]
    assert getattr(ended.value, "exit_status", None) == status


@pytest.mark.parametrize("world", ["ideal", "default", "harsh"])
def test_simulate_runs_in_every_world(files: Path, world: str) -> None:
    config_path, scenario = files / "hand.toml", files / "session.toml"
    options = {"sheet": None, "drift": False, "seconds": 0.05, "stop": threading.Event()}
    assert run_command(config_path, scenario=scenario, world=world, seed=3, **options) == 0  # type: ignore[arg-type]


def test_gripper_has_no_sheet_behaviour(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gripper = ["--gripper", "tcp://127.0.0.1:*"]
    assert main(["simulate", str(files / "hand.toml"), "--sheet", "S1", *gripper]) == 2
    assert "--gripper excludes --sheet" in capsys.readouterr().err


def test_sheet_and_drift_act_on_an_ideal_world_as_in_the_default_one() -> None:
    ideal, default = WORLDS["ideal"], WORLDS["default"]
    assert world_with(ideal) == ideal
    world = world_with(ideal, sheet="S2", drift=True)
    assert world.parts == ideal.parts
    assert world.sheets.tuning_kinds == world.sheets.reporting_kinds == (SHEET_KINDS["S2"],)
    assert world.sheets.parameter_ratio == default.sheets.parameter_ratio
    assert world.electronics == replace(default.electronics, noise_ratio=Fixed(1.0))
    assert world_with(default, drift=True) == default


def test_replaced_node_has_new_serial_number_and_boots_once(deployment: config.Deployment) -> None:
    swap = '[[swap]]\nlink = "round"\nat_s = 0.0\nserial = 4711\n'
    with (
        master(deployment, 0) as near,
        SimulatedHand.open(deployment, Scenario.parse(SESSION + swap), IDEAL) as hand,
    ):
        hand.start()
        near.send(0, 1, 0)
        near.sync(1)
        assert hand.devices["right/round"].serial == 4711
        assert hand.devices["right/round"].state == "PRE-OPERATIONAL"
        near.send(0, 1, 0)
        assert set(near.sync(2)) == {3, 4}


def test_replacement_and_fault_on_link_without_pad_are_reported(deployment: config.Deployment) -> None:
    wrong = '[[swap]]\nlink = "toe"\nat_s = 0.0\nserial = 1\n'
    wrong += '[[fault]]\nkind = "gum"\nlink = "nose"\nfrom_s = 0.0\n'
    with pytest.raises(
        ConfigError, match=r'(?s)\[\[fault\]\] 1: link = "nose".*\[\[swap\]\] 1: link = "toe"'
    ):
        SimulatedHand.open(deployment, Scenario.parse(SESSION + wrong + "place = [0.5, 0.5]\n"), IDEAL)


def test_switched_excitation_reaches_the_sheet(
    deployment: config.Deployment, monkeypatch: pytest.MonkeyPatch
) -> None:
    switches: list[tuple[int, bool]] = []
    monkeypatch.setattr(VirtualHand, "switch_excitation", lambda _, row, __, on: switches.append((row, on)))
    with (
        master(deployment, 0) as near,
        SimulatedHand.open(deployment, Scenario.parse(SESSION), IDEAL) as hand,
    ):
        hand.start()
        near.send(0, 1, 0)
        near.sync(2)
        assert switches == []
        hand.devices["right/round"].write_object(0x2100, 0, 0)
        near.sync(2)
        hand.devices["right/round"].write_object(0x2100, 0, 1)
        near.sync(2)
    assert switches == [(1, False), (1, True)]
