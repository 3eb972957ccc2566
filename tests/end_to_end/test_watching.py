"""Prometheus metrics of a running daemon, from first tick to last."""

from __future__ import annotations

import subprocess
import sys
import time
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from .conftest import START_S

SCRAPE = "import sys, urllib.request; print(urllib.request.urlopen(sys.argv[1], timeout=60).read().decode())"
STAGES = ("wait", "receive", "tick", "send")


def scrape(rig: Any, port: int) -> dict[str, list[Any]]:
    """Return samples by name, read in the daemon's network."""
    url = f"http://127.0.0.1:{port}/metrics"
    command = [*rig.command()[:-3], sys.executable, "-c", SCRAPE, url]
    done = subprocess.run(command, capture_output=True, text=True, timeout=START_S, check=False)
    found: dict[str, list[Any]] = {}
    for family in text_string_to_metric_families(done.stdout):
        for sample in family.samples:
            found.setdefault(sample.name.removeprefix("handtouch_"), []).append(sample)
    return found


def is_up_with(operational: int, found: dict[str, list[Any]]) -> bool:
    states = [
        sample.value for sample in found.get("node_state", []) if sample.labels["state"] == "operational"
    ]
    return sum(states) == operational and bool(found["up"][0].value == 1)


def stage_sum(found: dict[str, list[Any]], stage: str) -> float:
    """Return the time that the loop has spent in a stage, by a page of metrics."""
    (total,) = [float(s.value) for s in found["stage_seconds_sum"] if s.labels["stage"] == stage]
    return total


def test_metrics_of_pads_ticks_and_stages(rig: Any, free_port: int) -> None:
    text = rig.config.read_text()
    rig.config.write_text(text.replace("[daemon]\n", f'[daemon]\nmetrics = "127.0.0.1:{free_port}"\n', 1))
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    end_s = time.monotonic() + START_S
    found = scrape(rig, free_port)
    while not (
        is_up_with(15, found)
        and found["tick_latency_seconds_count"][0].value
        and all(stage_sum(found, stage) for stage in STAGES)  # a period's count when the next begins
    ):  # on a busy machine a page may be late, and says that it isn't up
        assert time.monotonic() < end_s, rig.all_printed()
        found = scrape(rig, free_port)
    ticks = found["ticks_total"][0].value
    assert ticks > 0
    assert 0 < found["tick_latency_seconds_count"][0].value <= ticks
    # a status may be a little older than its request
    newer = rig.wait("a status newer than the page", lambda status: status["service"]["ticks"] > ticks)
    status = newer["service"]
    for stage in STAGES:
        assert 0 < stage_sum(found, stage) <= status["loop"]["stages"][stage]["sum_s"]
    assert sum(histogram["sum_s"] for histogram in status["loop"]["stages"].values()) <= status["uptime_s"]
    assert rig.end("run") == 0
    assert scrape(rig, free_port) == {}  # the server process ends with the daemon
