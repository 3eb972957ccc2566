"""Benchmarks measure the pipeline that the daemon runs, with its settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.daemon_settings import pipeline_of
from benchmarks.hand_touches import serve
from handtouch import wire
from handtouch.calibration.auto_calibration import AutoCalibrator, new_gain_estimator
from handtouch.calibration.gains import BATCH_CONTACTS
from handtouch.calibration.stationary_contacts import StationaryContact
from handtouch.config import load, shipped
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import RequestedOutputs
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field import Rectangle
from handtouch.wire import PadState

TICKS = 60


class NoSubscriber:
    """Sink that requests and takes nothing."""

    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return False

    def send(self, message: wire.OutgoingMessage) -> None:
        raise AssertionError(message)


def press(pipeline: Pipeline) -> list[tuple[NDArray[np.float64], ...]]:
    """Return forces, deviations, positions and covariances of all pads by tick, of a growing press."""
    rng, columns = np.random.default_rng(1), pipeline.tick.columns
    counts = rng.uniform(20, 400, (pipeline.model.size, 4))
    found = []
    for number in range(TICKS):
        t_ns = 10**9 + number * pipeline.cycle.period_ns
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate((counts * min(max(number - 10, 0), 20) / 20).astype("<i2")):
            pipeline.slab.write_pdo(pad, row.tobytes(), t_ns + 1)
        pipeline.tick_if_due(t_ns + pipeline.cycle.period_ns)
        pipeline.prepare_next_tick()
        found.append(
            tuple(
                np.array(values)
                for values in (
                    columns.force_n,
                    columns.force_std_n,
                    columns.position_m,
                    columns.covariance_m2,
                )
            )
        )
    return found


def test_a_benchmarks_pipeline_computes_what_the_daemons_does(tmp_path: Path) -> None:
    whole = load(shipped.path("utah_mit.toml"))
    local = {name: f"ipc://{tmp_path}/{name}" for name in ("live", "complete", "control", "inputs")}
    buses = tuple(bus.model_copy(update={"interface": "virtual"}) for bus in whole.buses)
    deployment = whole.model_copy(update={"daemon": whole.daemon.model_copy(update=local), "buses": buses})
    daemon = HandtouchDaemon.open(deployment, build_pad_model(deployment))
    try:
        own, theirs = daemon.pipeline, pipeline_of(deployment, NoSubscriber())
        cycles = [(p.cycle.period_ns, p.cycle.window_ns) for p in (own, theirs)]
        own.node_state[:] = PadState.CLEAR
        every = np.ones(own.model.size, np.bool_)
        outputs = RequestedOutputs(every, every, np.ones(every.size, np.int64), ~every, ~every)
        own.apply_demand(outputs)
        results = press(own), press(theirs)
    finally:
        daemon.close()
    assert cycles[0] == cycles[1]
    assert np.isfinite(results[1][-1][0]).any()
    for mine, other in zip(*results, strict=True):
        for a, b in zip(mine, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_benchmark_of_touches_has_the_contact_of_every_touched_pad() -> None:
    deployment = load(shipped.path("utah_mit.toml"))
    model = build_pad_model(deployment)
    counts = np.zeros((TICKS, model.size, 4), np.int64)
    counts[10:, :2] = 200
    contacts = serve(model, deployment, counts, {TICKS - 1: 7})
    assert {key: contact.link for key, contact in contacts.items()} == {
        (7, link): link for link in model.links[:2]
    }


def test_automatic_calibration_begins_with_the_same_estimator() -> None:
    pad, rng = Rectangle(1.3, 1.0), np.random.default_rng(2)
    calibrator, estimator = AutoCalibrator(pad), new_gain_estimator(pad)
    calibrator.assign_node(7, None, None, "", 0)
    currents = pad.fractions(*(rng.uniform(0.1, 0.9, (2, 64)) * [[1.3], [1.0]])) * [
        [1.02],
        [0.99],
        [1.0],
        [0.98],
    ]
    noise = np.full(4, 1e-4)
    for number, row in enumerate(currents.T):
        calibrator.add_contact(StationaryContact(row, noise, 8, number, number))
    for first in range(0, 64, BATCH_CONTACTS // 2):
        part = currents[:, first : first + BATCH_CONTACTS // 2]
        estimator.add_contacts(part, np.repeat(noise[:, None], part.shape[1], axis=1), first)
    assert calibrator.estimate.contacts == estimator.estimate.contacts > 0
    np.testing.assert_allclose(calibrator.estimate.gains, estimator.estimate.gains, rtol=1e-6)
    np.testing.assert_allclose(calibrator.estimate.covariance, estimator.estimate.covariance, rtol=1e-3)
