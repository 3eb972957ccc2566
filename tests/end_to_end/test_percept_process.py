"""The percept process of a daemon is killed and stopped: contacts and slip continue, percepts return."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch.cli.demo import in_process_deployment
from handtouch.client import request
from handtouch.config import Deployment, parse
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.host.machine import process_statistics
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.simulated_hand import SimulatedHand
from handtouch.simulate.worlds import WORLDS
from tests.deployments import deployment_text, pad_text

from .conftest import run_in_threads
from .served_daemon import MAX_WAIT_S, ServedDaemon

PERIOD_MS = 5.0
MAX_GROWTH_BYTES = 32 << 20
SCENARIO = """
repeat = true
pause_s = 0.2

[[touch]]
link = "held"
from_s = 0.0
duration_s = 2.0
path = [[0.4, 0.5]]
force_n = [2.0]

[[touch]]
link = "tapped"
from_s = 0.1
duration_s = 0.4
path = [[0.4, 0.6]]
force_n = [1.5]
"""


class Bench(ServedDaemon):
    """The daemon with its percept process."""

    def __init__(self, daemon: HandtouchDaemon) -> None:
        super().__init__(daemon, "contact/*/*", "percept/*/motion", "percept/*/shape")

    @property
    def process(self) -> dict[str, Any]:
        """State of the percept process, as in `service`."""
        return dict(self.daemon.percepts.client.statistics())

    def wait_percepts(self, kind: str, count: int = 3) -> None:
        """Wait for percepts of a kind about samples from now on."""
        now_ns = time.monotonic_ns()
        self.wait(
            f"{count} x {kind}",
            lambda: sum(p.kind == kind and p.t_ns > now_ns for p in list(self.percepts)) >= count,
        )


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    text = deployment_text(
        pad_text("held", 1),
        pad_text("tapped", 2),
        daemon=f"sync_period_ms = {PERIOD_MS}\nsample_window_fraction = 0.9\nsupervise = false",
    )
    deployment = in_process_deployment(parse(text))
    folder: Path = tmp_path_factory.mktemp("percepts")
    hand = SimulatedHand.open(deployment, Scenario.parse(SCENARIO), WORLDS["ideal"].draw(1))
    with (
        hand,
        HandtouchDaemon.open(
            deployment, read=lambda: _with_thicker_sheet(deployment), folder=folder
        ) as daemon,
    ):
        hand.start()
        made = Bench(daemon)
        with run_in_threads(daemon.run, made.listen):
            yield made


def _with_thicker_sheet(deployment: Deployment) -> Deployment:
    sheet = deployment.sheets["s"].model_copy(update={"ohm_per_square": 2000.0})
    return deployment.model_copy(update={"sheets": {"s": sheet}})


class Undisturbed:
    """Checks that no contact message and no period is missing between its begin and its end."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def __enter__(self) -> None:
        daemon = self._bench.daemon
        self._seen, self._since_ns = len(self._bench.contacts), time.monotonic_ns()
        self._periods = daemon.pipeline.ticks + daemon.sync.overruns

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None:
            return
        daemon = self._bench.daemon
        elapsed = (time.monotonic_ns() - self._since_ns) // round(PERIOD_MS * 1e6)
        ticks = daemon.pipeline.ticks
        self._bench.wait("the next tick", lambda: daemon.pipeline.ticks > ticks)  # overruns are counted then
        # a busy machine overruns some anyway; nothing else is missing
        assert daemon.pipeline.ticks + daemon.sync.overruns - self._periods >= elapsed - 2
        seqs: dict[str, list[int]] = {}
        for contact in self._bench.contacts[self._seen :]:
            seqs.setdefault(contact.link, []).append(contact.seq)
        assert seqs
        for link, numbers in seqs.items():
            assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), link


def test_killed_percept_process_disturbs_no_contact_and_percepts_return(bench: Bench) -> None:
    bench.wait_percepts("shape")
    before = bench.process
    assert before["state"] == "running"
    with Undisturbed(bench):
        os.kill(before["pid"], signal.SIGKILL)
        bench.wait("restarted", lambda: bench.process["restarts"] > before["restarts"])
        bench.wait_percepts("motion")  # of the core
        bench.wait_percepts("shape")
    assert bench.process["exit_reason"] == "signal 9"
    assert bench.process["pid"] != before["pid"]
    assert bench.process["malformed"] == 0


def test_hung_percept_process_delays_no_contact_and_takes_no_memory(bench: Bench) -> None:
    bench.wait_percepts("shape")
    before = bench.process
    with Undisturbed(bench):
        os.kill(before["pid"], signal.SIGSTOP)
        try:
            bench.wait("full queue", lambda: bench.process["dropped"] > before["dropped"])
            memory = process_statistics()["memory_bytes"]
            bench.wait("many lost", lambda: bench.process["dropped"] > before["dropped"] + 100)
            assert process_statistics()["memory_bytes"] - memory < MAX_GROWTH_BYTES
            bench.wait_percepts("motion")
        finally:
            os.kill(before["pid"], signal.SIGCONT)
        bench.wait_percepts("shape")


def test_reload_that_changes_pads_restarts_the_percept_process(bench: Bench) -> None:
    bench.wait_percepts("shape")
    before = bench.process
    with Undisturbed(bench):
        reply = request("reload", endpoint=bench.daemon.control.endpoint, timeout_s=MAX_WAIT_S)
        assert reply["applied"]
        bench.wait("replaced", lambda: bench.process["pid"] not in (None, before["pid"]))
        assert bench.process["exit_reason"] == "deployment reloaded"
        bench.wait_percepts("shape")
