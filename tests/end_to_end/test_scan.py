"""`handtouch scan` as a process: on a bus with the nodes of a whole hand, and beside the daemon."""

from __future__ import annotations

import json
import re
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from handtouch import config

LONGEST_S = 90.0
SHEET = """
[sheet.firm]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20_000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5
"""

pytestmark = pytest.mark.timeout(240)


def _scan(rig: Any, *words: str) -> tuple[int, str]:
    buses = [word for bus in rig.bus for word in ("--bus", bus)]
    done = subprocess.run(
        rig.command("scan", *words, *buses), capture_output=True, text=True, timeout=LONGEST_S, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    return done.returncode, done.stdout


def _until_well(rig: Any, *words: str) -> str:
    """Scan again until the nodes have all started."""
    end_s = time.monotonic() + LONGEST_S
    while True:
        status, said = _scan(rig, *words)
        if status == 0:
            return said
        assert time.monotonic() < end_s, said


def test_an_unknown_bus_becomes_a_deployment_that_check_accepts(rig: Any) -> None:
    rig.simulate()
    _until_well(rig, str(rig.config))
    text = json.loads(_until_well(rig, "--json"))["fragment"]
    path = Path(rig.folder) / "made.toml"
    path.write_text(re.sub(r"(?m)^# (.* # FILL IN)", r"\1", text) + SHEET)
    wanted = {(pad.node_id, pad.serial) for pad in config.load(rig.config).hands[0].pads}
    assert {(pad.node_id, pad.serial) for pad in config.load(path).hands[0].pads} == wanted
    check = subprocess.run(rig.command("check", str(path)), capture_output=True, text=True, check=False)
    assert check.returncode in (0, 1), check.stderr  # the made-up geometry may be doubted
    assert "15 pads" in check.stdout


def test_a_scan_beside_the_daemon_disturbs_nothing(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    before = rig.wait_operational()
    status, said = _scan(rig, str(rig.config), "--seconds", "0.5", "--json")
    assert status == 0, said
    report = json.loads(said)["buses"][0]
    assert [node["state"] for node in report["nodes"]] == ["operational"] * 15
    sync = next(stream for stream in report["traffic"] if stream["identifier"] == 0x80)
    assert sync["rate_hz"] > 5
    assert {stream["what"] for stream in report["traffic"]} >= {"SYNC", "TPDO2 of node 17"}
    after = rig.status()
    for old, new in zip(before["pads"], after["pads"], strict=True):
        assert new["node"] == "operational"
        assert new["reboots"] == old["reboots"]


@pytest.mark.socketcan
def test_scan_on_socketcan_finds_the_hand(vcan_rig: Any) -> None:
    vcan_rig.simulate()
    _until_well(vcan_rig, str(vcan_rig.config))
