"""Fingertips with two sheets on a bus: a subscriber sees force, radius and hardness of touches.

The thumb's node has channels of 16 bits in two TPDOs, the finger's, of 12 bits in one.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from handtouch import client, wire
from handtouch.config import shipped
from handtouch.procedures.calibrate.daemon_pad import DaemonEndpoints, ServedPad
from handtouch.simulate.truth import read_records

MAX_COUNTS = {"thumb_tip": (1 << 15) - 1, "index_tip": (1 << 11) - 1}
MIN_SAMPLES = 25
"""Valid radii of each fingertip to wait for."""
PRESSED = """
repeat = true
pause_s = 0.3

[[touch]]
link = "thumb_tip"
from_s = 1.6
duration_s = 0.8
path = [[0.45, 0.6]]
force_n = [0.8]

[[touch]]
link = "index_tip"
from_s = 1.5
duration_s = 0.9
path = [[0.5, 0.4]]
force_n = [0.5, 2.0]
radius_mm = 3.0
hertz_force_n = 1.0
"""


def _check_laws_and_currents(pressed: Any, link: str) -> None:
    """Check what `calibrate` reads and sets of a second sheet."""
    ends = DaemonEndpoints(pressed.endpoints["live"], pressed.endpoints["control"], None)
    with ServedPad(ends, "gripper", link, second_ampere_per_count=10e-3 / MAX_COUNTS[link]) as pad:
        currents = [sample.second_current_a for sample, _ in zip(pad.samples(), range(400), strict=False)]
    assert 1e-4 < np.nanmax(currents) < 5e-3
    law = {"contact_ohm_mm2": 41_000.0, "alpha": 1.01, "ohm_per_square": 610.0}
    answer = client.request("calibrate", endpoint=ends.control, pad=link, name="measured", second_law=law)
    assert answer["second_law"]["alpha"] == law["alpha"]
    assert answer["law"]["alpha"] == 1.5


@pytest.fixture
def pressed(rig: Any) -> Any:
    """A daemon, and the nodes of two fingertips that are pressed again and again."""
    settings = "\n".join(f'{stream} = "{endpoint}"' for stream, endpoint in rig.endpoints.items())
    text = shipped.path("two_sheets.toml").read_text()
    text = text.replace("[daemon]\n", f"[daemon]\n{settings}\nsupervise = false\n", 1)
    text = text.replace("sync_period_ms = 10.0", "sync_period_ms = 20.0", 1)
    text = text.replace("noise_counts", "heartbeat_timeout_ms = 1000\nnoise_counts", 1)
    begin, end = text.index("[node."), text.index("[sheet.")
    narrow = re.sub(r'"(0x6401:\d)"', r'"\1:i12"', text[begin:end].replace("five_channel", "narrow"))
    eds = shipped.path("handtouch-node-12bit.eds")
    narrow = narrow.replace("noise_counts = 1.0", f'eds = "{eds}"\nnoise_counts = 0.3', 1)
    thumb, index = text[end:].split('link = "index_tip"')
    index = index.replace('"five_channel"', '"narrow"', 1)
    rig.config.write_text(f'{text[:end]}{narrow}{thumb}link = "index_tip"{index}')
    rig.scenario.write_text(PRESSED)
    rig.simulate("--world", "ideal", "--truth", str(rig.folder / "truth"))
    rig.start("run")
    return rig


def test_a_subscriber_sees_force_radius_and_hardness_of_touches(pressed: Any) -> None:
    found: dict[str, list[wire.Contact]] = {"thumb_tip": [], "index_tip": []}
    with pressed.subscribe("contact/*/*", "health/*/*", "percept/*/stiffness") as messages:
        health: dict[str, str] = {}
        felt: wire.Percept | None = None
        while min(map(len, found.values())) < MIN_SAMPLES or len(health) < len(found) or felt is None:
            message = messages.recv(90)
            assert message is not None, pressed.all_printed()
            if isinstance(message, wire.Health):
                health[message.link] = message.second_sheet_status
            elif isinstance(message, wire.Percept):
                if message.link == "index_tip" and message.state == "estimated":
                    felt = message
            elif message.contact_radius_status == "valid" and message.event == "update" and message.fresh:
                found[message.link].append(message)
    for link in found:
        _check_laws_and_currents(pressed, link)
    assert pressed.end("simulate") == 0, pressed.all_printed()
    assert set(health.values()) <= {"operational", "no_zero"}
    # 3 F / (4 a^3), at 1 N and 3 mm
    error = math.log(felt.values["modulus_per_radius_pa_per_m"] / (0.75 / 3e-3**3))
    assert abs(error) < 1.96 * felt.values["modulus_per_radius_log_std"]
    truth = list(read_records(pressed.folder / "truth"))
    for link, contacts in found.items():
        errors = []
        for contact in contacts:
            # a node of a busy machine may have answered one SYNC late
            near = [one for one in truth if one.link == link and abs(one.t_ns - contact.t_ns) < 25_000_000]
            if not near:
                continue
            assert contact.force_n is not None
            assert contact.contact_radius_m is not None
            assert contact.contact_radius_std_m is not None
            pairs = [
                (contact.force_n / one.force_n - 1, contact.contact_radius_m / one.radius_m - 1)
                for one in near
            ]
            errors.append(min(pairs, key=lambda pair: abs(pair[0])))
        assert len(errors) > MIN_SAMPLES / 2
        force, radius = np.median(np.abs(errors), axis=0)
        assert force < 0.05
        assert radius < 0.1
