"""Errors of nodes, from a scenario to the messages, the status and the log of the daemon."""

from __future__ import annotations

import re
from typing import Any

from handtouch.client import connect
from tests.end_to_end.conftest import SCENARIO

NODE_FAULTS = """
[[node_fault]]
kind = "emcy"
link = "thumb_distal"
code = 0x3210
register_bits = 0x05
from_s = 2.0
until_s = 5.0

[[node_fault]]
kind = "refuses_operational"
link = "index_middle"
from_s = 2.0
until_s = 5.0
"""


def _pad(status: dict[str, Any], link: str) -> dict[str, Any]:
    found: dict[str, Any] = next(pad for pad in status["pads"] if pad["link"] == link)
    return found


def test_emcy_is_published_logged_and_cleared_and_a_refusal_names_it(rig: Any) -> None:
    rig.scenario.write_text(SCENARIO + NODE_FAULTS)
    rig.simulate()
    rig.start("run")
    health = "health/*/thumb_distal"
    with connect(health, endpoint=rig.endpoints["complete"], queue=10_000) as messages:
        status = rig.wait(
            "a refusal with its EMCY",
            lambda status: (
                _pad(status, "index_middle")["reason"].startswith("refuses OPERATIONAL")
                and _pad(status, "index_middle")["state"] == "faulted"  # from the next tick on
                and _pad(status, "thumb_distal")["emergencies"]
            ),
        )
        refusing, thumb = _pad(status, "index_middle"), _pad(status, "thumb_distal")
        assert refusing["node_state"] == "faulted"
        assert "error register 0x01 (generic), EMCY 0x5000 device hardware" in refusing["reason"]
        assert refusing["error_register"] == 1
        (error,) = thumb["emergencies"]
        assert error["arrival_ns"] < status["service"]["t_ns"]
        expected = {
            "code": 0x3210,
            "register": 5,
            "manufacturer": "0000000000",
            "cleared_ns": None,
            "count": 1,
        }
        assert expected.items() <= error.items()
        assert error["text"] == "0x3210 voltage inside the device (register: voltage)"
        assert (thumb["reason"], thumb["state"]) == ("", "clear")
        status = rig.wait(
            "all well again",
            lambda status: (
                _pad(status, "index_middle")["node_state"] == "operational"
                and _pad(status, "thumb_distal")["emergencies"][0]["cleared_ns"]
            ),
        )
        assert _pad(status, "thumb_distal")["error_register"] == 0
        assert _pad(status, "index_middle")["reason"] == ""
        published = []
        while (message := messages.recv(0)) is not None:
            published += [error["cleared_ns"] for error in message.emergencies]
    assert published[0] is None
    assert published[-1] == _pad(status, "thumb_distal")["emergencies"][0]["cleared_ns"]
    log = rig.printed("run")
    assert re.search(r"WARNING .*right/thumb_distal\): EMCY 0x3210 voltage inside the device", log)
    assert re.search(r"INFO .*right/thumb_distal\): EMCY 0x3210 .*: cleared after \d\.\d s", log)
    assert re.search(r"ERROR .*right/index_middle\): .*refuses OPERATIONAL, error register 0x01", log)
