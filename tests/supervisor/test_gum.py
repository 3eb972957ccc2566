"""Gum on a simulated hand, from the counts of its nodes to the published diagnosis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtouch.calibration.store_client import StoreClient
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS
from handtouch.supervisor.deployment_diagnostics import DeploymentDiagnostics
from handtouch.supervisor.ipc import CalibrationAssessment, SampleBlock
from handtouch.supervisor.worker import SupervisorWorker

from .conftest import LINKS, NOW, Bench

PERIOD_NS, TOGETHER, SECONDS = 20_000_000, 5, 34.0
SCENARIO = """
repeat = false
pause_s = 60.0

[[fault]]
kind = "gum"
link = "square"
from_s = 3.0
place = [0.3, 0.6]
radius_mm = 2.5
force_n = 0.5

[[touch]]
link = "oblong"
from_s = 4.0
duration_s = 3.0
path = [[0.3, 0.4], [0.7, 0.6]]
force_n = [1.0]
""" + "".join(
    f"""
[[touch]]
link = "square"
from_s = {from_s}
duration_s = 1.0
path = [[0.7, 0.3]]
force_n = [1.5]
"""
    for from_s in range(10, 32, 4)
)


def block(counts: NDArray[np.int64], since: int) -> SampleBlock:
    k = len(counts)
    times = 10**9 + PERIOD_NS * np.arange(since, since + k, dtype=np.int64)
    return SampleBlock(
        times,
        np.repeat(times[:, None], 3, axis=1),
        counts.astype(np.int64),
        np.ones((k, 3), np.bool_),
        np.zeros((k, 3), np.uint8),
        np.zeros((k, 3), np.uint32),
        np.zeros((3, 4)),
        np.full(3, 0.5),
        np.ones((3, 4)),
        np.full(3, np.nan),
        np.full(3, np.nan),
    )


def test_gum_is_diagnosed_with_position_size_and_begin(bench: Bench, tmp_path: Path) -> None:
    hand = VirtualHand(
        bench.deployment, Scenario.parse(SCENARIO), WORLDS["default"].only("parts", "contacts").draw(8)
    )
    worker = SupervisorWorker(
        bench.deployment, StoreClient(tmp_path / "c.db"), DeploymentDiagnostics(bench.deployment)
    )
    messages = worker.process_message(bench.introduce([1, 2, 3]), NOW)
    ticks = round(SECONDS * 1e9 / PERIOD_NS)
    times = PERIOD_NS * 1e-9 * np.arange(ticks)
    counts = np.stack([hand.counts(row, times) for row in range(len(LINKS))], axis=1)
    for since in range(0, ticks, TOGETHER):
        messages += worker.process_message(block(counts[since : since + TOGETHER], since), NOW)
    worker.finish(NOW)
    reported = [
        message for message in messages if isinstance(message, CalibrationAssessment) and message.diagnoses
    ]
    assert {LINKS[message.pad] for message in reported} == {"square"}
    (gum,) = reported[-1].diagnoses
    assert gum.kind == "gum"
    assert "like gum" in gum.cause
    assert "clean the pad" in gum.remedy
    assert abs(gum.since_ns - 4e9) < 0.5e9
    assert gum.pad_m is not None
    assert np.abs(np.subtract(gum.pad_m, (0.3 * 20e-3, 0.6 * 20e-3))).max() < 1.5e-3
    assert gum.size_m is not None
    assert 2e-3 < gum.size_m < 12e-3
