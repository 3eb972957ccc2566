"""Zero of static loads: drifted amplifiers aren't taken for gum, gum isn't taken for drift."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.calibration.calibration import Calibration, Offsets, Provenance
from handtouch.calibration.store import Store
from handtouch.calibration.store_client import StoreClient
from handtouch.supervisor.deployment_diagnostics import DeploymentDiagnostics
from handtouch.supervisor.ipc import CalibrationAssessment, SampleBlock
from handtouch.supervisor.worker import SupervisorWorker

from .conftest import LINKS, NOW, Bench

PERIOD_NS, TOGETHER, SECONDS = 20_000_000, 5, 60.0
DRIFTED = np.array([9.0, 7.0, 8.0, 10.0])
Counts = NDArray[np.float64]


def fractions(x: float, y: float) -> Counts:
    return np.array([1 - x, x, 1 - y, y]) / 2


def diagnosed(bench: Bench, path: Path, load: Counts, baseline: Counts, age_h: float = 0.0) -> set[str]:
    """Return the kinds of diagnoses of a pad that reads load (4,), pressed elsewhere every fourth second.

    baseline: the daemon's, (4,). age_h: of the stored calibrations.
    """
    worker = SupervisorWorker(bench.deployment, StoreClient(path), DeploymentDiagnostics(bench.deployment))
    now = NOW + timedelta(hours=age_h)
    messages = worker.process_message(bench.introduce([11, 2, 3], [1, 2, 3]), now)
    rng = np.random.default_rng(5)
    ticks = round(SECONDS * 1e9 / PERIOD_NS)
    times = 10**9 + PERIOD_NS * np.arange(ticks, dtype=np.int64)
    counts = rng.normal(0, 1, (ticks, 3, 4))
    pressed = (times * 1e-9 % 4 > 3)[:, None]
    counts[:, 0] += load + pressed * fractions(0.8, 0.2) * 1500
    empty = np.full(3, np.nan)
    offsets = np.zeros((3, 4))
    offsets[0] = baseline
    for since in range(0, ticks, TOGETHER):
        at = slice(since, since + TOGETHER)
        block = SampleBlock(
            times[at], np.repeat(times[at, None], 3, axis=1), np.rint(counts[at]).astype(np.int64),
            np.ones((TOGETHER, 3), np.bool_), np.zeros((TOGETHER, 3), np.uint8),
            np.zeros((TOGETHER, 3), np.uint32), offsets, np.full(3, 0.5), np.ones((3, 4)), empty, empty,
        )  # fmt: skip
        messages += worker.process_message(block, now)
    worker.finish(now)
    return {
        diagnosis.kind.value
        for message in messages
        if isinstance(message, CalibrationAssessment) and message.pad == 0
        for diagnosis in message.diagnoses
    } - {"node_replaced"}


def store_zero(bench: Bench, path: Path) -> None:
    """Store offsets of zero of the node at the first pad."""
    offsets = Offsets((0.0,) * 4, (0.01,) * 4, (1.0,) * 4)
    with Store(path) as store:
        origin = Provenance("baseline and sheet state tracked", hand="h", link=LINKS[0])
        store.write(11, bench.ids[LINKS[0]], Calibration(offsets=offsets), origin, NOW)


def test_zeros_of_a_replaced_node_are_no_load(bench: Bench, tmp_path: Path) -> None:
    assert diagnosed(bench, tmp_path / "c.db", DRIFTED, DRIFTED) == set()


def test_zeros_that_drifted_since_they_were_stored_are_no_load(bench: Bench, tmp_path: Path) -> None:
    store_zero(bench, tmp_path / "c.db")
    assert diagnosed(bench, tmp_path / "c.db", DRIFTED, DRIFTED, age_h=2.0) == set()


@pytest.mark.parametrize("tracked", [False, True])
def test_gum_is_found_though_a_baseline_has_tracked_it(bench: Bench, tmp_path: Path, tracked: bool) -> None:
    gum = fractions(0.3, 0.6) * 120
    store_zero(bench, tmp_path / "c.db")
    found = diagnosed(bench, tmp_path / "c.db", gum, gum if tracked else np.zeros(4), age_h=2.0)
    assert found == {"gum"}


def test_gum_on_a_replaced_node_is_found_once_its_baseline_is_known(bench: Bench, tmp_path: Path) -> None:
    gum = fractions(0.3, 0.6) * 120
    assert diagnosed(bench, tmp_path / "c.db", DRIFTED + gum, DRIFTED) == {"gum"}
