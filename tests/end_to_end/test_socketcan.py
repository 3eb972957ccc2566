"""The same hand on real SocketCAN: what candump shows a CANopen engineer, and contacts that come through."""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

PERIOD_S = 0.05  # as vcan_rig has it
LONGEST_S = 60.0

pytestmark = [pytest.mark.socketcan, pytest.mark.timeout(240)]


def _record(rig: Any, seconds: float) -> list[can.Message]:
    """Return what candump sees on the bus."""
    log = Path(rig.folder) / "session.log"
    with log.open("w") as file:
        candump = subprocess.Popen([shutil.which("candump") or "candump", "-L", "vcan0"], stdout=file)
        time.sleep(seconds)
        candump.terminate()
        candump.wait()
    with can.LogReader(log) as reader:
        return list(reader)


def test_the_hand_works_and_the_bus_looks_as_a_canopen_engineer_expects(vcan_rig: Any) -> None:
    rig = vcan_rig
    log = Path(rig.folder) / "boot.log"
    with log.open("w") as file:
        candump = subprocess.Popen([shutil.which("candump") or "candump", "-L", "vcan0"], stdout=file)
        rig.simulate()
        rig.start("run")
        status = rig.wait_operational()
        candump.terminate()
        candump.wait()
    nodes = {pad["node_id"] for pad in status["pads"]}
    with can.LogReader(log) as reader:
        boot = list(reader)
    started = {bytes(m.data)[1] for m in boot if m.arbitration_id == 0 and m.data[0] == 1}
    assert started == nodes  # each by its id: no broadcast, whose second byte is 0
    assert {
        m.arbitration_id - 0x700 for m in boot if m.arbitration_id > 0x700 and bytes(m.data) == b"\0"
    } == nodes

    messages = _record(rig, 2.0)
    count = Counter(m.arbitration_id for m in messages)
    syncs = [m for m in messages if m.arbitration_id == 0x80]
    assert all(len(m.data) == 0 for m in syncs)
    periods = np.diff([m.timestamp for m in syncs])
    assert np.median(periods) == pytest.approx(PERIOD_S, rel=0.2)
    for node in nodes:
        assert abs(count[0x280 + node] - len(syncs)) <= 3
        assert count[0x700 + node] >= 2.0 / 0.1 * 0.5  # a heartbeat every 100 ms
    known = {0x80} | {base + node for node in nodes for base in (0x280, 0x700)}
    assert set(count) <= known
    assert {len(m.data) for m in messages if 0x280 < m.arbitration_id < 0x300} == {8}

    with rig.subscribe("contact/*/*") as contacts:
        events: Counter[str] = Counter()
        end_s = time.monotonic() + LONGEST_S
        while events["released"] < 2 or events["begin"] < 2 or events["update"] <= 20:
            assert time.monotonic() < end_s, rig.all_printed()
            contact = contacts.recv(0.5)
            if contact is not None:
                events[contact.end_reason or contact.event] += 1
    bus = rig.status()["service"]["buses"]["can0"]
    assert (bus["wrong_length"], bus["unknown_frames"], bus["overflow"], bus["error_frames"]) == (0, 0, 0, 0)


def test_sigterm_makes_each_node_pre_operational_by_its_id(vcan_rig: Any) -> None:
    rig = vcan_rig
    rig.simulate()
    rig.start("run")
    status = rig.wait_operational()
    log = Path(rig.folder) / "stop.log"
    with log.open("w") as file:
        candump = subprocess.Popen([shutil.which("candump") or "candump", "-L", "vcan0,000:7FF"], stdout=file)
        time.sleep(0.5)
        assert rig.end("run") == 0
        candump.terminate()
        candump.wait()
    with can.LogReader(log) as reader:
        commands = [tuple(m.data) for m in reader]
    assert sorted(commands) == sorted((128, pad["node_id"]) for pad in status["pads"])


def test_bus_states_and_lost_nodes_are_logged_with_the_bus_as_cause(vcan_rig: Any) -> None:
    rig = vcan_rig
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    _wait_for_line(rig, [], "settling -> operational")
    for frame, line in (
        ("20000004#0004000000000000", "WARNING handtouch.bus: bus can0: active -> warning: error-warning"),
        ("20000004#0020000000000000", "-> passive: error-passive"),
        ("20000040#0000000000000000", "ERROR handtouch.bus: bus can0: passive -> bus-off: bus-off"),
    ):
        _wait_for_line(rig, [["cansend", "vcan0", frame]], line)
    _wait_for_line(rig, [], "INFO handtouch.bus: bus can0: bus-off -> active after ")  # frames arrive
    down = [["ip", "link", "set", "vcan0", "down"]]
    _wait_for_line(rig, down, "ERROR handtouch.bus: bus can0: active -> down: [Errno 100] Network is down")
    printed = _wait_for_line(rig, [], "lost: no heartbeat for")
    lost = [line for line in printed.splitlines() if "lost: no heartbeat for" in line]
    assert all("bus can0: [Errno 100] Network is down: ip link set vcan0 up" in line for line in lost), lost
    assert "check its power" not in printed
    up = [["ip", "link", "set", "vcan0", "up"]]
    _wait_for_line(rig, up, "INFO handtouch.bus: bus can0: down -> active after ")
    rig.wait_operational()


def _wait_for_line(rig: Any, commands: list[list[str]], line: str) -> str:
    """Run commands, and wait until the daemon has logged a line; what it printed since."""
    before = len(rig.printed("run")) if commands else 0
    for command in commands:
        subprocess.run(command, check=True, timeout=30)
    end_s = time.monotonic() + LONGEST_S
    while line not in (printed := str(rig.printed("run")[before:])):
        assert time.monotonic() < end_s, f"never {line}:\n{rig.all_printed()}"
        time.sleep(0.05)
    return printed


def test_kernel_sync_that_waited_for_a_stopped_daemon_is_not_another_producers(vcan_rig: Any) -> None:
    rig = vcan_rig
    rig.simulate()
    daemon = rig.start("run")
    rig.wait_operational()
    printed = len(rig.printed("run"))
    for seconds in (0.3, 0.6, 2.0):
        daemon.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        daemon.send_signal(signal.SIGCONT)
        time.sleep(1.5)
    status = rig.status()
    log = rig.printed("run")[printed:]
    assert status["service"]["buses"]["can0"]["sync"]["by"] == "kernel", log
    assert status["service"]["buses"]["can0"]["sync"]["other_syncs"] == 0, log
    assert "another SYNC producer" not in log
    assert [pad["reboots"] for pad in status["pads"]] == [0] * 15, log
    assert " lost: " not in log
    stale = [line for line in log.splitlines() if "-> stale" in line]
    assert all("the loop was late" in line for line in stale), log  # the nodes share the guest's processor
