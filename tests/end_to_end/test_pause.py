"""SIGSTOP of the daemon: its nodes go on, and none of them is accused when it continues."""

from __future__ import annotations

import signal
import time
from typing import Any


def test_stopped_daemon_accuses_no_node_when_it_continues(working: Any) -> None:
    """2 s are twice the nodes' heartbeat timeout. A host too busy to run the nodes is named as the cause."""
    rig = working
    printed = len(rig.printed("run"))
    before = {pad["link"]: (pad["reboots"], pad["heartbeats_missed"]) for pad in rig.status()["pads"]}
    with rig.subscribe("health/*/*") as health:
        daemon, seen = rig.processes["run"], []
        for seconds in (0.3, 0.6, 2.0):
            daemon.send_signal(signal.SIGSTOP)
            time.sleep(seconds)
            daemon.send_signal(signal.SIGCONT)
            end_s = time.monotonic() + 1.2
            while time.monotonic() < end_s:
                if (message := health.recv(0.1)) is not None:
                    seen.append(message)
    log = rig.printed("run")[printed:]
    # the second cause: the nodes, which share a process, had no processor
    causes = "the loop was late by", "as from every pad of bus"
    accused = [m for m in seen if m.node_state != "operational" and not any(c in m.reason for c in causes)]
    assert not accused, log
    assert {message.state for message in seen} <= {"clear", "touched"}
    assert {message.node_state for message in seen} <= {"operational", "stale"}
    assert {pad["link"]: (pad["reboots"], pad["heartbeats_missed"]) for pad in rig.status()["pads"]} == before
    assert "another SYNC producer" not in log
    assert "the loop was late by" in log
    assert rig.status()["service"]["buses"]["can0"]["sync"]["other_syncs"] == 0
