"""A recording of a daemon with scenes, calibrations and reloads is replayed bit for bit."""

from __future__ import annotations

import time
from typing import Any

from handtouch import Robot
from handtouch.client import request
from handtouch.record.recording import Recording

LONGEST_S = 90.0


def test_a_recording_with_control_requests_is_replayed_bit_for_bit(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait_operational()

    def send_request(command: str, **arguments: Any) -> None:
        request(command, endpoint=rig.endpoints["control"], timeout_s=LONGEST_S, **arguments)

    def begun() -> int:
        status = request("status", endpoint=rig.endpoints["control"], timeout_s=LONGEST_S)
        return int(status["service"]["contacts"])

    with rig.recording() as out, Robot(rig.endpoints["inputs"]) as robot:
        assert robot.wait_connected(LONGEST_S)

        def wait_for_contacts(count: int) -> None:
            first, end_s = begun(), time.monotonic() + LONGEST_S
            while begun() < first + count:
                assert time.monotonic() < end_s, rig.all_printed()
                robot.send_joints("right", {"index_mcp": 0.4, "index_pip": 0.5}, t_ns=time.monotonic_ns())
                time.sleep(0.01)

        send_request("scene", outputs=["position", "force", "palm", "base"])
        wait_for_contacts(2)
        send_request("calibrate", pad="palm_heel", name="other", gains=[1.1, 1.0, 1.0, 1.0])
        send_request("tare", pads=["thumb_*"])
        send_request("snapshot")
        wait_for_contacts(2)
        send_request("disable", pads=["index_distal"])
        send_request("reload")
        wait_for_contacts(1)
    outcome = rig.replay(out)
    assert outcome["equal"] == outcome["compared"] > 20
    contacts = [entry.payload for entry in Recording(out).read("contact")]
    assert {"other"} < {contact["calibration_id"] for contact in contacts}
    frames = [(contact.get("palm_status"), contact.get("base_status")) for contact in contacts]
    assert any("valid" in statuses for statuses in frames)
    assert {"off", "stopped"} & {contact["end_reason"] for contact in contacts}
