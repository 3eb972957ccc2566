"""Nodes of other vendors by EDS: wide channels, several PDOs, unusual wiring; positions are correct."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch.simulate.truth import read_records

from .conftest import PERIOD_MS

EDS = Path(__file__).parents[1] / "data" / "eds"
NODES = {
    "CiA 404, int32 in two PDOs": (
        "norsens-quad404.eds",
        'channels = ["0x9130:1", "0x9130:2", "0x9130:3", "0x9130:4"]\nfull_scale_counts = 8_000_000\n',
    ),
    "24 bits in two PDOs": (
        "hapt24.dcf",
        'channels = ["0x8130:1", "0x8130:2", "0x8130:3", "0x8130:4"]\nchannel_scale = [1.0, 1.1, 0.9, 1.0]\n',
    ),
    "unsigned between other objects, mapping fixed, guarded": (
        "tactor-q16.eds",
        'channels = ["0x2110:0", "0x2120:0", "0x2130:0", "0x2140:0"]\n',
    ),
}


@pytest.mark.parametrize("name", NODES)
def test_touch_is_detected_with_nodes_of_any_vendor(rig: Any, name: str) -> None:
    eds, keys = NODES[name]
    text = rig.config.read_text()
    text = text.replace("drive_v = 5.0", f'eds = "{EDS / eds}"\n{keys}drive_v = 5.0', 1)
    text = text.replace(
        'node = "four_channel"', 'node = "four_channel"\nelectrodes = ["yb", "x0", "xa", "y0"]'
    )
    rig.config.write_text(text)
    truth = rig.folder / "truth.jsonl"
    rig.simulate("--truth", str(truth))
    rig.start("run")
    rig.wait_operational()
    with rig.subscribe("contact/*/*") as messages:
        found = [messages.recv(30) for _ in range(60)]
    rig.end("simulate")
    places = {(true.link, true.t_ns): true.position_m for true in read_records(truth)}
    errors = [
        np.linalg.norm(np.subtract(contact.position_m, places[contact.link, stamp]))
        for contact in found
        if contact.event == "update" and contact.position_status == "valid"
        for stamp in [_nearest(places, contact)]
        if stamp is not None
    ]
    assert len(errors) > 20
    assert np.median(errors) < 0.3e-3


def test_guarded_nodes_are_polled_in_time_with_slow_sync(rig: Any) -> None:
    """Each would say so, and stop its samples, after 0.75 s without being asked."""
    eds, keys = NODES["unsigned between other objects, mapping fixed, guarded"]
    text = rig.config.read_text().replace("drive_v = 5.0", f'eds = "{EDS / eds}"\n{keys}drive_v = 5.0', 1)
    text = text.replace("heartbeat_ms = 100\n", "heartbeat_ms = 250\n")
    rig.config.write_text(text.replace(f"sync_period_ms = {PERIOD_MS}", "sync_period_ms = 1000.0"))
    rig.simulate()
    rig.start("run")
    before = rig.wait_operational()
    after = rig.wait("two more", lambda s: s["service"]["ticks"] >= before["service"]["ticks"] + 2)
    for pad in after["pads"]:
        assert pad["node_state"] == "operational", pad
        assert pad["reboots"] == 0
        assert not pad["emergencies"], pad


def _nearest(places: dict[tuple[str, int], Any], contact: Any) -> int | None:
    """Time of the true contact that a message is of: within a period."""
    times = [t_ns for link, t_ns in places if link == contact.link and abs(t_ns - contact.t_ns) < 20_000_000]
    return min(times, key=lambda t_ns: abs(t_ns - contact.t_ns), default=None)
