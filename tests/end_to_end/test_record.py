"""A running daemon is recorded while people meddle with it; replay tells the same contacts, bit for bit."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from typing import Any

import pytest

from handtouch import Robot
from handtouch.client import request
from handtouch.record.read import Recording

LONGEST_S = 90.0


def test_a_daemon_that_is_meddled_with_is_replayed_bit_for_bit(rig: Any) -> None:
    pytest.importorskip("pinocchio")
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    out, report = rig.folder / "session.mcap", rig.folder / "report.json"
    recorder = subprocess.Popen(
        rig.command("record", str(rig.config), "-o", str(out)), stderr=subprocess.PIPE, text=True
    )

    def ask(command: str, **arguments: Any) -> None:
        request(command, endpoint=rig.endpoints["control"], timeout_s=LONGEST_S, **arguments)

    def begun() -> int:
        status = request("status", endpoint=rig.endpoints["control"], timeout_s=LONGEST_S)
        return int(status["service"]["contacts"])

    with Robot(rig.endpoints["inputs"]) as robot:
        assert robot.connected(LONGEST_S)

        def wait_for_contacts(count: int) -> None:
            first, end_s = begun(), time.monotonic() + LONGEST_S
            while begun() < first + count:
                assert time.monotonic() < end_s, rig.all_printed()
                robot.send_joints("right", {"index_mcp": 0.4, "index_pip": 0.5}, t_ns=time.monotonic_ns())
                time.sleep(0.01)

        rig.wait("recorded", lambda status: "tick" in status["service"]["subscriptions"])
        ask("scene", outputs=["location", "strength", "palm", "base"])
        wait_for_contacts(2)
        ask("calibrate", pad="palm_heel", name="other", gains=[1.1, 1.0, 1.0, 1.0])
        ask("tare", pads=["thumb_*"])
        ask("snapshot")
        wait_for_contacts(2)
        ask("disable", pads=["index_distal"])
        ask("reload")
        wait_for_contacts(1)
    assert rig.end("run") == 0
    recorder.send_signal(signal.SIGINT)
    _, told = recorder.communicate(timeout=LONGEST_S)
    replayed = subprocess.run(
        rig.command("replay", str(out), "--report", str(report)), capture_output=True, text=True, check=False
    )
    assert replayed.returncode == 0, replayed.stderr + told
    found = json.loads(report.read_text())
    assert found["same"] == found["compared"] > 20
    contacts = [entry.payload for entry in Recording(out).read("contact")]
    assert {"other"} < {contact["calibration"] for contact in contacts}
    assert any(contact.get("base") == "valid" or contact.get("palm") == "valid" for contact in contacts)
    assert {"off", "stopped"} & {contact["reason"] for contact in contacts}
