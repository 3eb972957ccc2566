"""Position after a node replacement: by number of contacts since, in three worlds.

The supervisor worker receives blocks of ticks as from the daemon, of nodes of each shape (20 x 20 and 36 x 20
mm), each a replacement without a stored calibration, in each [world](../worlds.md) for a seed of the
reporting family. What a world draws is hidden from the worker: gains, gaps, resistors, sizes of contacts,
sheets, drift; pads are mounted as stated. Contacts of 0.5 to 5 N anywhere, 12 samples each; 100 others a pad,
single samples, measure the error. A node is calibrated once its least certain log gain is known to 2 %, after
32 contacts at least.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, options, progress
from benchmarks.scores import Share
from handtouch import config
from handtouch.calibration.store_client import StoreClient
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pad_model import PadModel
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family, MountSpread
from handtouch.supervisor.ipc import (
    CalibrationAssessment,
    CalibrationUpdate,
    NodeSerials,
    SampleBlock,
)
from handtouch.supervisor.worker import SupervisorWorker
from tests.deployments import deployment_text, pad_text
from tests.exact_pads import ExactPads

FloatArray = NDArray[np.float64]

SHAPES = {"1:1": 20.0, "1.8:1": 36.0}
WIDTH_MM = 20.0
UNITS = 6
"""Nodes of each shape in each world."""
COUNTS = (0, 16, 32, 64, 96, 128, 192, 256)
TICKS = 12
"""Samples of a contact."""
PERIOD_NS = 5_000_000
STEP_S = (TICKS + 1) * PERIOD_NS * 1e-9
NOW = datetime(2026, 1, 1, tzinfo=UTC)


def deployment_of(units: int) -> config.Deployment:
    """Return a deployment with this many pads of each shape."""
    rows = [(shape, unit) for shape in SHAPES for unit in range(units)]
    pads = [
        pad_text(f"p{k}", k + 1, f'{{ kind = "plane", length_mm = {SHAPES[shape]}, width_mm = {WIDTH_MM} }}')
        for k, (shape, _) in enumerate(rows)
    ]
    text = deployment_text(
        *pads, daemon="", noise_counts=2.0, contact_radius_mm=2.0, contact_radius_std_mm=0.4, touch=""
    )
    return config.parse(text)


def touches(model: PadModel, count: int, seed: int, step_s: float = STEP_S, first_s: float = 0.0) -> Scenario:
    """`count` contacts anywhere on every pad, 8 % of a side from its edges, of 0.5 to 5 N, `step_s` apart."""
    generator = np.random.default_rng(seed)
    made = []
    for number in range(count):
        at = generator.uniform(0.08, 0.92, (model.size, 2))
        force = np.exp(generator.uniform(np.log(0.5), np.log(5.0), model.size))
        made += [
            ScenarioTouch(
                link=link,
                from_s=first_s + number * step_s,
                duration_s=TICKS * PERIOD_NS * 1e-9,
                ramp_s=0.005,
                path=((float(x), float(y)),),
                force_n=(float(newton),),
            )
            for link, (x, y), newton in zip(model.links, at, force, strict=True)
        ]
    return Scenario(touch=tuple(made))


def block_of(hand: VirtualHand, number: int, pads: int) -> SampleBlock:
    """The ticks of a contact and one without, as the daemon sends them."""
    first_s = number * STEP_S
    counts = np.array([hand.sample(first_s + (k + 0.5) * PERIOD_NS * 1e-9) for k in range(TICKS + 1)])
    contact = np.full((TICKS + 1, pads), number + 1, np.uint32)
    contact[-1] = 0
    times = round(first_s * 1e9) + PERIOD_NS * np.arange(TICKS + 1, dtype=np.int64)
    return SampleBlock(
        times,
        np.repeat(times[:, None], pads, axis=1),
        counts.astype(np.int32),
        np.ones((TICKS + 1, pads), np.bool_),
        (contact > 0).astype(np.uint8),
        contact,
        np.zeros((pads, 4)),
        np.full(pads, np.nan),
        np.ones((pads, 4)),
        np.full(pads, np.nan),
        np.full(pads, np.nan),
    )


def test_set(
    deployment: config.Deployment, model: PadModel, world: DrawnWorld
) -> tuple[FloatArray, FloatArray]:
    """Counts (100, pads, 4) of other contacts, as single samples, and where they are (100, pads, 3) [m]."""
    hand = VirtualHand(deployment, touches(model, 100, 77), world)
    times = [number * STEP_S + 0.5 * STEP_S for number in range(100)]
    counts = np.array([hand.sample(t_s) for t_s in times])
    places = np.zeros((100, model.size, 3))
    for number, t_s in enumerate(times):
        for truth in hand.truth(t_s):
            places[number, model.links.index(truth.link)] = truth.position_m
    return counts.astype(np.float64), places


def errors_mm(exact: ExactPads, model: PadModel, counts: FloatArray, places: FloatArray) -> FloatArray:
    """Location errors (pads, 100) with the gains that the model has now."""
    found = []
    for pad in range(model.size):
        index = np.full(len(counts), pad)
        currents = (counts[:, pad] * model.ampere_per_count[pad]).T
        at = exact.estimate(index, currents, model.noise_a[pad][:, None])
        position_m = exact.position_m(index, at.x, at.y)
        found.append(1e3 * np.linalg.norm(position_m - places[:, pad], axis=1))
    return np.array(found)


def run(name: str, units: int, counts: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the rows of a world. Pads are mounted as stated: mounts are the grasp's subject."""
    world = replace(WORLDS[name], mounts=MountSpread()).draw(Family.REPORTING.seed(5))
    deployment = world.describe(deployment_of(units))
    model = PadModel(deployment)
    exact = ExactPads(deployment, model)
    hand = VirtualHand(deployment, touches(model, max(counts), 3), world)
    readings, places = test_set(deployment, model, world)
    trust = ["default"] * model.size
    deviation = np.full(model.size, np.nan)
    taken: dict[int, tuple[FloatArray, list[str], FloatArray]] = {}
    with tempfile.TemporaryDirectory() as folder:
        slow = SupervisorWorker(deployment, StoreClient(Path(folder) / "calibrations.db"))
        new, old = [1000 + k for k in range(model.size)], [k + 1 for k in range(model.size)]
        words = slow.process_message(NodeSerials(now=tuple(new), before=tuple(old), sync_ns=0), NOW)
        for number in range(max(counts) + 1):
            for word in words:
                if isinstance(word, CalibrationAssessment):
                    trust[word.pad] = word.calibration_state
                elif isinstance(word, CalibrationUpdate):
                    model.set_calibration(word.pad, ActiveCalibration(word.calibration_id, word.gains))
                    covariance = np.reshape(word.covariance or (0.0,) * 16, (4, 4))
                    deviation[word.pad] = np.sqrt(np.diag(covariance).max())
            if number in counts:
                taken[number] = errors_mm(exact, model, readings, places), list(trust), deviation.copy()
            if number < max(counts):
                words = slow.process_message(block_of(hand, number, model.size), NOW)
        slow.finish(NOW)
    for pad, (hand_name, entry) in enumerate(hand.pads):
        exact_gains = tuple((1 / np.array(world.pad(hand_name, entry).gain_ratio)).tolist())
        model.set_calibration(pad, ActiveCalibration("true", exact_gains))
    least = errors_mm(exact, model, readings, places)
    rows = []
    for first, shape in enumerate(SHAPES):
        own = slice(first * units, (first + 1) * units)
        for number in counts:
            error, state, std = taken[number]
            rows.append(
                {
                    "world": name,
                    "pad": shape,
                    "contacts since": number,
                    "position error, rms mm": float(np.sqrt(np.mean(error[own] ** 2))),
                    "95 % below, mm": float(np.quantile(error[own], 0.95)),
                    "with the true gains, rms mm": float(np.sqrt(np.mean(least[own] ** 2))),
                    "calibrated, %": Share(state[own].count("calibrated"), units),
                    "stated std of the gains, %": 100 * float(np.mean(std[own])),
                }
            )
    return rows


def main() -> None:
    quick = options(__doc__).parse_args().quick
    units, counts = (1, COUNTS[:3]) if quick else (UNITS, COUNTS)
    rows = []
    for name in WORLDS:
        rows += run(name, units, counts)
        progress(f"world {name}: {units} nodes of each shape")
    report = Report(quick, nodes_of_a_shape=units)
    report.table("Errors", rows)
    report.keep()


if __name__ == "__main__":
    main()
