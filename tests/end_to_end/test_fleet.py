"""Several hands on several buses, several daemons, robots on a Zenoh network."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

from handtouch import wire
from tests.starter import Starter

from .conftest import START_S, Rig

pytest.importorskip("zenoh", reason="needs the extra zenoh")

REMOTE = """
import json, sys, threading, zenoh
lock = threading.Lock()
config = zenoh.Config()
for key, value in (("mode", '"peer"'), ("scouting/multicast/enabled", "false"),
                   ("listen/endpoints", json.dumps(sys.argv[1:]))):
    config.insert_json5(key, value)
def report(what, **values):
    with lock:
        print(json.dumps({"what": what, **values}), flush=True)
with zenoh.open(config) as session:
    session.declare_subscriber("lab/**", lambda sample: report("sample", key=str(sample.key_expr),
        encoding=str(sample.encoding), payload=bytes(sample.payload).hex()))
    session.liveliness().declare_subscriber("lab/**", lambda sample: report(
        "alive" if sample.kind == zenoh.SampleKind.PUT else "disconnected",
        key=str(sample.key_expr)), history=True)
    report("ready")
    for line in sys.stdin:
        query = json.loads(line)
        payload = bytes.fromhex(query["payload"]) if "payload" in query else None
        for reply in session.get(query["get"], payload=payload, timeout=10.0):
            if reply.ok is not None:
                report("reply", key=str(reply.ok.key_expr), payload=bytes(reply.ok.payload).hex())
        report("answered")
"""


def named(rig: Rig, hand: str) -> Rig:
    rig.config.write_text(rig.config.read_text().replace('name = "right"', f'name = "{hand}"'))
    return rig


class Remote:
    """A Zenoh subscriber in a process of its own, without handtouch."""

    def __init__(self, prefix: list[str], *listen: str) -> None:
        self.process = subprocess.Popen(
            [*prefix, sys.executable, "-c", REMOTE, *listen],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.samples: list[dict[str, Any]] = []
        self.alive: set[str] = set()
        self.next("ready")

    def next(self, what: str, key: str = "") -> dict[str, Any]:
        """Read up to the next line of a kind."""
        assert self.process.stdout is not None
        end_s = time.monotonic() + START_S
        while time.monotonic() < end_s:
            line: dict[str, Any] = json.loads(self.process.stdout.readline())
            if line["what"] == "sample":
                self.samples.append(line)
            elif line["what"] == "alive":
                self.alive.add(line["key"])
            elif line["what"] == "disconnected":
                self.alive.discard(line["key"])
            if line["what"] == what and line.get("key", "").startswith(key):
                return line
        raise AssertionError(f"no {what} {key}; {len(self.samples)} samples, alive: {self.alive}")

    def get(self, selector: str, payload: bytes | None = None) -> dict[str, bytes]:
        assert self.process.stdin is not None
        query = {"get": selector} | ({} if payload is None else {"payload": payload.hex()})
        self.process.stdin.write(json.dumps(query) + "\n")
        self.process.stdin.flush()
        replies = {}
        assert self.process.stdout is not None
        while (line := json.loads(self.process.stdout.readline()))["what"] != "answered":
            if line["what"] == "reply":
                replies[line["key"]] = bytes.fromhex(line["payload"])
            elif line["what"] == "sample":
                self.samples.append(line)
        return replies

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def networks() -> Iterator[tuple[list[str], list[list[str]]]]:
    """Prefixes of commands in three network namespaces: one in the middle (10.88.1.1, 10.88.2.1), two robots
    (10.88.1.2 and 10.88.2.2), which reach it alone.
    """
    rootless = [] if os.geteuid() == 0 else ["--map-root-user"]
    user = ["--user", "--preserve-credentials"] if rootless else []
    keepers: list[subprocess.Popen[str]] = []

    def keep(prefix: list[str], how: list[str]) -> list[str]:
        ready = "ip link set lo up && ip route add 239.0.0.0/8 dev lo && echo $$ && exec cat"
        keeper = subprocess.Popen(
            [*prefix, "unshare", "--net", *how, "sh", "-c", ready],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        keepers.append(keeper)
        assert keeper.stdout is not None
        answer = keeper.stdout.readline().strip()
        if not answer.isdigit():
            pytest.skip(f"no network namespace to be had: {answer}")
        return ["nsenter", "--target", answer, *user, "--net", "--"]

    try:
        if shutil.which("nsenter") is None or shutil.which("ip") is None:
            pytest.skip("nsenter (util-linux) or ip (iproute2) is missing")
        middle = keep([], rootless)
        robots = [keep(middle, []), keep(middle, [])]
        for number, robot in enumerate(robots, 1):
            near, far = f"near{number}", f"far{number}"
            pair = ["ip", "link", "add", near, "type", "veth", "peer", "name", far, "netns", robot[2]]
            done = subprocess.run([*middle, *pair], capture_output=True, text=True, check=False)
            if done.returncode != 0:
                pytest.skip(f"no virtual cable to be had: {done.stderr.strip()}")
            for prefix, end, host in ((middle, near, 1), (robot, far, 2)):
                address = ["ip", "address", "add", f"10.88.{number}.{host}/24", "dev", end]
                subprocess.run([*prefix, *address], check=True)
                subprocess.run([*prefix, "ip", "link", "set", end, "up"], check=True)
        yield middle, robots
    finally:
        for keeper in reversed(keepers):
            keeper.kill()
            keeper.communicate()


def rig_in(folder: Path, starter: Starter, prefix: list[str], port: int) -> Rig:
    """A deployment with ipc endpoints of its own; what it prints and binds is in the folder."""
    folder.mkdir()
    endpoints = {stream: f"ipc://{folder}/{stream}" for stream in ("live", "complete", "control", "inputs")}
    bus = f"can0=udp_multicast:239.74.163.2,port={port}"
    return Rig(folder, endpoints, prefix, [bus], starter=starter)


@pytest.fixture
def short_path(endpoints: dict[str, str]) -> Path:
    """A folder whose path is short enough for ipc endpoints below it."""
    return Path(endpoints["live"].removeprefix("ipc://")).parent


def test_two_hands_on_two_buses_are_served_by_one_daemon(rig: Rig, free_port: int) -> None:
    text = rig.config.read_text()
    bus = re.search(r"\[\[bus\]\]\n.*?\n(?=\n*\[)", text, re.DOTALL)
    assert bus is not None
    hand = text[text.index("[[hand]]") :]
    other = hand.replace('"right"', '"left"').replace("can0", "can1").replace("serial = 1", "serial = 2")
    second = bus[0].replace("can0", "can1") + "\n" + other
    rig.config.write_text(text.replace(bus[0], bus[0] + "\n") + "\n" + second)
    rig.bus.append(f"can1=udp_multicast:239.74.163.3,port={free_port + 1}")
    rig.simulate()
    rig.start("run")
    status = rig.wait_operational(30)
    assert {(pad["hand"], pad["bus"]) for pad in status["pads"]} == {("right", "can0"), ("left", "can1")}
    touched: set[str] = set()
    with rig.subscribe("contact/*/*", "hand/*") as messages:
        ticks: dict[str, set[int]] = {"right": set(), "left": set()}
        while len(touched) < 2 or len(ticks["right"] & ticks["left"]) < 20:
            message = messages.recv(START_S)
            assert message is not None, rig.all_printed()
            if isinstance(message, wire.Contact):
                touched.add(message.hand)
            else:
                ticks[message.hand].add(message.tick)
    assert all(bus["samples"] > 0 for bus in rig.status()["service"]["buses"].values())


def test_two_daemons_use_separate_endpoints_and_buses(
    short_path: Path, starter: Starter, network: list[str], free_port: int
) -> None:
    left = named(rig_in(short_path / "left", starter, network, free_port), "left")
    right = rig_in(short_path / "right", starter, network, free_port + 1)
    try:
        for rig in (left, right):
            rig.simulate()
            rig.start("run")
        for rig, hand in ((left, "left"), (right, "right")):
            pads = rig.wait_operational()["pads"]
            assert {pad["hand"] for pad in pads} == {hand}
        status, printed = left.call("run", str(left.config), "--bus", left.bus[0])
        assert status == 1
        assert "another daemon is using it" in printed
        assert left.end("run") == 0
        ticks = right.status()["service"]["ticks"]
        right.wait("ticking on", lambda status: status["service"]["ticks"] > ticks)
    finally:
        left.end_all()
        right.end_all()


def test_a_remote_subscriber_gets_the_topics_of_two_robots_and_tracks_restarts(
    short_path: Path,
    host_starter: Starter,
    networks: tuple[list[str], list[list[str]]],
    free_port: int,
) -> None:
    middle, prefixes = networks
    robots = [
        named(rig_in(short_path / f"r{number}", host_starter.inside(prefix), prefix, free_port), hand)
        for number, (prefix, hand) in enumerate(zip(prefixes, ("left", "right"), strict=True), 1)
    ]
    listen = [f"tcp/10.88.{number}.1:7447" for number in (1, 2)]
    remote = None
    try:
        for number, robot in enumerate(robots, 1):
            robot.simulate()
            robot.start("run")
            # before there is anybody to connect to
            robot.start_command(
                *("bridge", "zenoh", str(robot.config), "--prefix", f"lab/robot{number}", "--control"),
                *("--connect", listen[number - 1]),
            )
        for robot in robots:
            robot.wait_operational()
        remote = Remote(middle, *listen)
        for number, hand in ((1, "left"), (2, "right")):
            root = f"lab/robot{number}/hand"
            frame = remote.next("sample", f"{root}/hand/{hand}")
            assert frame["encoding"] == "application/msgpack"
            parts = [b"hand/" + hand.encode(), bytes.fromhex(frame["payload"])]
            message = wire.decode(parts)  # the very bytes of docs/wire.md
            assert isinstance(message, wire.HandFrame)
            begun = remote.next("sample", f"{root}/contact/{hand}/index_distal")
            decoded = wire.decode([f"contact/{hand}/index_distal".encode(), bytes.fromhex(begun["payload"])])
            assert isinstance(decoded, wire.Contact)
        assert remote.alive == {"lab/robot1/hand", "lab/robot2/hand"}

        latest = remote.get("lab/robot1/hand/health/**")  # as one that comes late asks
        assert len(latest) == 15
        assert set(remote.get("lab/*/hand/service")) == {f"lab/robot{n}/hand/service" for n in (1, 2)}
        for request, ok in ((msgpack.packb({"v": 1, "command": "status"}), True), (b"\xc1", False)):
            (answer,) = remote.get("lab/robot2/hand/control", request).values()
            assert msgpack.unpackb(answer)["ok"] is ok

        assert robots[0].end("run") == 0
        remote.next("disconnected", "lab/robot1/hand")
        assert remote.get("lab/robot1/hand/**") == {}
        robots[0].start("run")
        remote.next("alive", "lab/robot1/hand")

        remote.close()  # and the network's other end restarts too
        remote = Remote(middle, *listen)
        for number in (1, 2):
            remote.next("sample", f"lab/robot{number}/hand/service")
        for robot in robots:
            assert robot.end("bridge") == 0
            assert " 0 lost" in robot.printed("bridge")
    finally:
        for robot in robots:
            robot.end_all()
        if remote is not None:
            remote.close()


def test_control_is_not_forwarded_unless_enabled(rig: Rig, free_port: int) -> None:
    rig.start("run")
    rig.status()
    listen = f"tcp/127.0.0.1:{free_port}"
    remote = Remote(rig.command()[:-3], listen)
    try:
        rig.start_command("bridge", "zenoh", str(rig.config), "--prefix", "lab", "--connect", listen)
        remote.next("sample", "lab/hand/service")
        assert remote.get("lab/hand/control", msgpack.packb({"v": 1, "command": "status"})) == {}
    finally:
        remote.close()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--connect", "tcp/127.0.0.1:7447"], "no daemon to bridge"),
        (["--endpoint", "left=ipc:///tmp/x"], "no Zenoh network given"),
        (["--endpoint", "ipc:///tmp/x", "--connect", "tcp/127.0.0.1:1"], "NAME=ENDPOINT"),
        (
            ["--endpoint", "a=ipc:///x", "--endpoint", "a=ipc:///y", "--connect", "tcp/127.0.0.1:1"],
            "another name",
        ),
        (["--endpoint", "a=ipc:///x", "--control", "--connect", "tcp/127.0.0.1:1"], "deployment files"),
        (["--endpoint", "a=ipc:///x", "--connect", "nonsense"], "can't open Zenoh"),
        (["--endpoint", "a=nonsense", "--connect", "tcp/127.0.0.1:1"], "no ZeroMQ endpoint"),
    ],
)
def test_wrong_options_of_a_bridge_are_rejected_with_the_remedy(
    rig: Rig, arguments: list[str], error: str
) -> None:
    status, printed = rig.call("bridge", "zenoh", *arguments)
    assert status == 2
    assert error in printed
    assert "Traceback" not in printed
