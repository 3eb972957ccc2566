"""A robot in ROS 2: a DDS program that knows no handtouch receives touch and sends joint states."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from .conftest import START_S, Rig

pytest.importorskip("cyclonedds", reason="needs the extra ros2")

CYCLONE = """
<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""
REMOTE = """
import json, sys, time
from dataclasses import dataclass
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32
@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str
@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64
@dataclass
class Wrench(IdlStruct, typename="geometry_msgs::msg::dds_::Wrench_"):
    force: Vector3
    torque: Vector3
@dataclass
class WrenchStamped(IdlStruct, typename="geometry_msgs::msg::dds_::WrenchStamped_"):
    header: Header
    wrench: Wrench
@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]
@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str
@dataclass
class Status(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: uint8  # so rmw_cyclonedds declares a byte of ROS
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]
@dataclass
class Diagnostics(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: sequence[Status]
xcdr1 = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
sensor = Qos(xcdr1, Policy.Reliability.BestEffort)
retained = Qos(xcdr1, Policy.Reliability.Reliable(10**9), Policy.Durability.TransientLocal)
node = DomainParticipant(int(sys.argv[1]))
def reader(topic, kind, qos):
    return DataReader(node, Topic(node, topic, kind), qos=qos)
readers = {
    "link": reader("rt/handtouch/right/index_distal/wrench", WrenchStamped, sensor),
    "palm": reader("rt/handtouch/right/wrench", WrenchStamped, sensor),
}
diagnostics = reader("rt/diagnostics", Diagnostics, retained)
endpoints = BuiltinDataReader(node, BuiltinTopicDcpsPublication)
joints = DataWriter(node, Topic(node, "rt/joint_states", JointState), qos=sensor)
names = sys.argv[2:]
def show(**values):
    print(json.dumps(values), flush=True)
while True:
    sec, nanosec = divmod(time.time_ns(), 10**9)
    joints.write(JointState(Header(Time(sec, nanosec), ""), names, [0.3] * len(names), [], []))
    for what, one in readers.items():
        for m in one.take(50):
            f = m.wrench.force
            show(what=what, frame=m.header.frame_id, stamp=m.header.stamp.sec, force=[f.x, f.y, f.z])
    for m in diagnostics.take(10):
        show(what="diagnostics", status={s.name: [int(s.level), s.message] for s in m.status})
    for m in endpoints.take(50):
        data = m.qos[Policy.Userdata].data.decode() if Policy.Userdata in m.qos else ""
        show(what="endpoint", topic=m.topic_name, type=m.type_name, data=data)
    time.sleep(0.01)
"""
JOINTS = ["index_mcp", "index_pip", "index_dip", "index_abduction"]


@pytest.fixture
def domain(free_port: int) -> int:
    """A DDS domain that no other program uses, most likely, with ports below those of other sockets."""
    return 1 + free_port % 100


@pytest.fixture
def remote(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    """A DDS program, on the same machine; the bridge inherits the environment, too."""
    monkeypatch.setenv("CYCLONEDDS_URI", CYCLONE)
    with subprocess.Popen(
        [sys.executable, "-c", REMOTE, str(domain), *JOINTS], stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        process.kill()


def next_line(remote: subprocess.Popen[str], what: str, met: Any = lambda _: True) -> dict[str, Any]:
    """Read up to the next line of a kind that meets a condition."""
    assert remote.stdout is not None
    end_s = time.monotonic() + START_S
    for text in remote.stdout:
        line: dict[str, Any] = json.loads(text)
        if line["what"] == what and met(line):
            return line
        assert time.monotonic() < end_s, f"no such {what}; last: {line}"
    raise AssertionError("the DDS program ended")


def test_a_ros_program_receives_wrenches_and_moves_the_palm_frame(
    rig: Rig, domain: int, remote: subprocess.Popen[str]
) -> None:
    scene = '[scene]\noutputs = ["position", "force", "palm"]\n\n[touch]'
    rig.config.write_text(rig.config.read_text().replace("[touch]", scene, 1))
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    bridge = subprocess.Popen(
        [sys.executable, "-m", "handtouch", "bridge", "ros2", str(rig.config), "--domain", str(domain)]
    )
    try:
        endpoint = next_line(
            remote, "endpoint", lambda line: line["topic"] == "rt/handtouch/right/index_distal/wrench"
        )
        assert endpoint["type"] == "geometry_msgs::msg::dds_::WrenchStamped_"
        assert endpoint["data"].startswith("typehash=RIHS01_8dc3deaf06b2ab28")  # as of Iron and later
        pressed = next_line(remote, "link", lambda line: line["force"][2] < -0.5)
        assert pressed["frame"] == "index_distal"
        assert abs(pressed["stamp"] - time.time()) < START_S
        next_line(remote, "link", lambda line: line["force"] == [0.0, 0.0, 0.0])  # at its end
        total = next_line(remote, "palm", lambda line: any(line["force"]))  # needs the joint states
        assert total["frame"] == "palm"
        with rig.subscribe("service") as services:
            assert any("joints" in topic for topic in services.recv().inputs["received"])
        fine = next_line(remote, "diagnostics", lambda line: len(line["status"]) >= 17)["status"]
        assert fine["handtouch: right/index_distal"][0] == 0
        assert fine["handtouch: bus can0"] == [0, "active"]
        assert rig.end("run") == 0
        ended = next_line(
            remote, "diagnostics", lambda line: line["status"].get("handtouch: daemon") == [2, "disconnected"]
        )
        assert ended["status"] == {"handtouch: daemon": [2, "disconnected"]}
        bridge.terminate()
        assert bridge.wait(START_S) == 0
    finally:
        bridge.kill()
        bridge.wait()
