"""Scenes switch unneeded work off, with the real daemon and nodes on a real bus."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import pytest

from handtouch import wire

IDLE = 'excitation_object = "0x2100:0:u8"\nidle = { delta_counts = 12 }\n'


def deploy(rig: Any, scene: str, node: str = "") -> None:
    """Write a scene and the nodes' capabilities into the deployment."""
    text = rig.config.read_text()
    text, changed = re.subn(r"heartbeat_ms = 100\n", f"heartbeat_ms = 100\n{node}", text)
    assert changed == 1
    rig.config.write_text(text.replace("[touch]", f"[scene]\n{scene}\n\n[touch]", 1))


def paces(status: dict[str, Any]) -> dict[str, str]:
    return {pad["link"]: pad["sampling"] for pad in status["pads"]}


@pytest.mark.parametrize("node", ["", IDLE], ids=["stopped", "excitation off"])
def test_pads_outside_the_scene_are_off_and_their_touches_cost_nothing(rig: Any, node: str) -> None:
    deploy(rig, 'links = ["index_*"]', node)
    rig.simulate()
    rig.start("run")
    off = rig.wait("12 pads off", lambda s: [p["state"] for p in s["pads"]].count("off") == 12)
    assert {link for link, pace in paces(off).items() if pace == "off"} == {
        pad["link"] for pad in off["pads"] if not pad["link"].startswith("index_")
    }
    assert all(
        pad["node_state"] == "stopped" and "scene" in pad["reason"]
        for pad in off["pads"]
        if pad["sampling"] == "off"
    )
    with rig.subscribe("contact/*/*") as contacts:
        links = {contacts.recv(30).link for _ in range(40)}
    assert links == {"index_distal"}  # the scenario presses palm_heel too
    later = rig.status()
    # their heartbeats have come all the while, or they would be lost
    assert [pad["node_state"] for pad in later["pads"]].count("stopped") == 12
    assert later["service"]["buses"]["can0"]["wrong_length"] == 0


def test_untouched_pads_transmit_on_change_and_touched_ones_with_sync(rig: Any) -> None:
    deploy(rig, "idle_after_s = 0.3", IDLE)
    rig.simulate()
    rig.start("run")
    rig.wait(
        "13 pads event-driven, which the scenario never touches, and all operational",
        lambda s: (
            all(
                pace == "event"
                for link, pace in paces(s).items()
                if link not in ("index_distal", "palm_heel")
            )
            and all(pad["node_state"] == "operational" for pad in s["pads"])
        ),
    )
    with rig.subscribe("contact/*/index_distal", "health/*/index_distal") as messages:
        begun, at_full_rate = 0, 0
        while not (begun >= 3 and at_full_rate):
            message = messages.recv(60)
            assert message is not None, rig.all_printed()
            if isinstance(message, wire.Contact):
                begun += message.event == "begin"
                assert message.end_reason in ("", "released")
            elif message.state == "touched":
                at_full_rate += message.sampling == "sync"
    idle = [pad for pad in rig.status()["pads"] if pad["sampling"] == "event"]
    assert all(pad["state"] in ("clear", "touched") for pad in idle)  # rare samples are no stale ones


def test_without_a_subscriber_one_wake_up_reads_all_samples_of_a_tick(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait(
        "15 nodes operational", lambda s: [p["node_state"] for p in s["pads"]].count("operational") == 15
    )
    time.sleep(1.0)
    before, waits = rig.status(), waits_of(rig.status()["service"]["pid"])
    time.sleep(3.0)
    waits = waits_of(before["service"]["pid"]) - waits
    after = rig.status()
    service, loop = after["service"], after["service"]["loop"]
    ticks = service["ticks"] - before["service"]["ticks"]
    assert waits < 1.5 * ticks  # its frames come at several times
    late = sum(loop["late"].values()) - sum(before["service"]["loop"]["late"].values())
    assert late <= 0.02 * ticks
    assert 0 < service["tick_us"]["p50"] < 5000
    samples = [
        new["samples"] - old["samples"] for new, old in zip(after["pads"], before["pads"], strict=True)
    ]
    assert min(samples) >= 0.98 * ticks
    with rig.subscribe("contact/*/*") as contacts:
        first = next(message for message in iter(lambda: contacts.recv(30), None) if not message.retained)
    assert first.age_s < 0.05
    assert first.begin_ns <= first.t_ns


def waits_of(pid: int) -> int:
    """Return how often a process's first thread has waited."""
    lines = Path(f"/proc/{pid}/task/{pid}/status").read_text().splitlines()
    (count,) = (line.split()[1] for line in lines if line.startswith("voluntary_ctxt_switches"))
    return int(count)
