"""`handtouch scan` as a process: on a bus with the nodes of a whole hand, and during a running daemon."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from handtouch import config

TIMEOUT_S = 90.0
SHEET = """
[sheet.firm]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20_000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5
"""

pytestmark = pytest.mark.timeout(240)


def _scan(rig: Any, *arguments: str) -> tuple[int, str]:
    buses = [argument for bus in rig.bus for argument in ("--bus", bus)]
    status, printed = rig.call("scan", *arguments, *buses)
    assert status in (0, 1), printed
    return status, printed


def _scan_until_ok(rig: Any, *arguments: str) -> str:
    """Scan again until the nodes have all started."""
    end_s = time.monotonic() + TIMEOUT_S
    while True:
        status, output = _scan(rig, *arguments)
        if status == 0:
            return output
        assert time.monotonic() < end_s, output


def test_scan_of_an_unknown_bus_makes_a_valid_deployment(rig: Any) -> None:
    rig.simulate()
    _scan_until_ok(rig, str(rig.config))
    text = json.loads(_scan_until_ok(rig, "--json"))["fragment"]
    path = Path(rig.folder) / "made.toml"
    path.write_text(re.sub(r"(?m)^# (.* # FILL IN)", r"\1", text) + SHEET)
    expected = {(pad.node_id, pad.serial) for pad in config.load(rig.config).hands[0].pads}
    assert {(pad.node_id, pad.serial) for pad in config.load(path).hands[0].pads} == expected
    status, printed = rig.call("check", str(path))
    assert status in (0, 1), printed  # the example geometry may cause warnings
    assert "15 pads" in printed


def test_scan_does_not_disturb_a_running_daemon(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    before = rig.wait_operational()
    status, output = _scan(rig, str(rig.config), "--seconds", "0.5", "--json")
    assert status == 0, output
    report = json.loads(output)["buses"][0]
    assert [node["state"] for node in report["nodes"]] == ["operational"] * 15
    sync = next(stream for stream in report["traffic"] if stream["identifier"] == 0x80)
    assert sync["rate_hz"] > 5
    assert {stream["source"] for stream in report["traffic"]} >= {"SYNC", "TPDO2 of node 17"}
    after = rig.status()
    for old, new in zip(before["pads"], after["pads"], strict=True):
        assert new["node_state"] == "operational"
        assert new["reboots"] == old["reboots"]


UNCONFIGURED_NODES = """
import sys, threading
import numpy as np
from handtouch.device import DeviceBus
from handtouch.canbus.bus.port import open_bus
from handtouch.config import Bus
bus = Bus(name="can0", interface="udp_multicast", channel="239.74.163.2", options={"port": int(sys.argv[1])})
nodes = DeviceBus(open_bus(bus), lambda t_ns: np.zeros((8, 4), np.int16))
for number in range(8):
    nodes.add_unconfigured(serial=0x9E3779B1 * (number + 1) % 2**32)
nodes.start()
print("ready", flush=True)
sys.stdin.read()
"""


def test_eight_unconfigured_nodes_get_node_ids(network: list[str], free_port: int) -> None:
    python = [*network, sys.executable]
    with subprocess.Popen(
        [*python, "-c", UNCONFIGURED_NODES, str(free_port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as host:
        assert host.stdin is not None
        assert host.stdout is not None
        try:
            assert host.stdout.readline() == "ready\n"
            bus = f"can0=udp_multicast:239.74.163.2,port={free_port}"
            scan = [*python, "-m", "handtouch", "scan", "--bus", bus, "--seconds", "0.1", "--json"]
            done = subprocess.run(
                [*scan, "--assign", "0x11"], capture_output=True, text=True, timeout=TIMEOUT_S, check=False
            )
            assert done.returncode == 0, done.stdout + done.stderr
            report = json.loads(done.stdout)["buses"][0]
        finally:
            host.stdin.close()
    serials = sorted(0x9E3779B1 * (number + 1) % 2**32 for number in range(8))
    assert [(node["node_id"], node["serial"]) for node in report["nodes"]] == list(
        zip(range(0x11, 0x19), serials, strict=True)
    )
    assert [node["assigned"] for node in report["unconfigured"]] == list(range(0x11, 0x19))


@pytest.mark.socketcan
def test_scan_on_socketcan_finds_the_hand(vcan_rig: Any) -> None:
    vcan_rig.simulate()
    _scan_until_ok(vcan_rig, str(vcan_rig.config))
