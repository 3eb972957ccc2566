"""Position and force in the worlds `ideal`, `default` and `harsh`: coverage, sharpness and validity.

Every hand is the shipped one with hidden quantities drawn for a seed of the reporting family. Touches of any
force anywhere on its 15 pads go through the daemon's own pipeline, once as configured and once with the gains
that its automatic calibration found from other touches; one sample of each touch is compared. Writes
docs/benchmarks/worlds.{md,json,png}.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import numpy as np
from daemon_settings import pipeline_of
from numpy.typing import NDArray
from oracle import PadOracle
from page import made_by, options, output_folder, table
from scores import Estimates, EstimateScore, bin_labels, concatenate, draw_calibration, slices

from handtouch import wire
from handtouch.calibration.auto_calibration import AutoCalibrator
from handtouch.calibration.stationary_contacts import StationaryContact
from handtouch.config import Deployment, load, shipped
from handtouch.core.pad_model import PadModel, networks_of
from handtouch.hand import networks_with_other_parts
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import (
    WORLDS,
    ContactSpread,
    DrawnWorld,
    Family,
    MountSpread,
    Normal,
    PartSpread,
    Uniform,
    World,
)

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
NAMED = ("ideal", "default", "harsh")
SINGLE = {
    "gaps 0.2 mm": World("gaps 0.2 mm", PartSpread(gap_offset_mm=Uniform(-0.2, 0.2))),
    "gains 0.5 %, gaps 0.05 mm": World(
        "gains 0.5 %, gaps 0.05 mm",
        PartSpread(gain_ratio=Uniform(0.995, 1.005), gap_offset_mm=Uniform(-0.05, 0.05)),
    ),
    "gains 2 %, gaps 0.2 mm": World(
        "gains 2 %, gaps 0.2 mm",
        PartSpread(gain_ratio=Uniform(0.98, 1.02), gap_offset_mm=Uniform(-0.2, 0.2)),
    ),
    "radius": World("radius", contacts=ContactSpread(radius_sigma=Normal(0.0, 1.0))),
}
"""Worlds in which only some quantities are hidden, as those of earlier claims; contact patches as stated."""
FORCES_N = (0.2, 12.0)
REST_S, STEP_S, TOUCH_S, SAMPLE_S = 2.0, 0.65, 0.5, 0.32
"""Time before the first touch, from touch to touch of a pad, of a touch, and from its begin to its sample."""
WARM_UP = 12
"""Touches before those that are compared: as many as compensation of sheets needs for evidence."""
LEARNT_SAMPLES = 12
STATES = ("as configured", "calibrated")
SLICES = ("edge distance", "force", "sheet", "sheet kind", "surface", "aspect")
_FIRST_NS = 1_000_000_000


class Collector:
    """Subscriber to all contacts that keeps those of the sampled ticks, by link."""

    def __init__(self) -> None:
        self.contacts: dict[tuple[int, str], wire.Contact] = {}
        self.sampled: int | None = None

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("contact/")

    def send(self, message: wire.OutgoingMessage) -> None:
        if self.sampled is not None and isinstance(message, wire.Contact) and message.event != "end":
            self.contacts[self.sampled, message.link] = message


def drawn_world(name: str, number: int) -> DrawnWorld:
    """Return a world of the reporting family. Pads are mounted as stated: mounts are the grasp's subject."""
    world = WORLDS[name] if name in WORLDS else SINGLE[name]
    return replace(world, mounts=MountSpread()).draw(Family.REPORTING.seed(number))


def draw_touches(links: Sequence[str], count: int, seed: int) -> tuple[ScenarioTouch, ...]:
    """Return `count` touches of each pad, one after the other: places uniform, forces log-uniform."""
    rng = np.random.default_rng((seed, 5))
    low, high = np.log(FORCES_N)
    return tuple(
        ScenarioTouch(
            link=link,
            from_s=REST_S + number * STEP_S,
            duration_s=TOUCH_S,
            path=((float(x), float(y)),),
            force_n=(float(np.exp(force)),),
        )
        for number in range(count)
        for link, (x, y), force in zip(
            links, rng.uniform(0.02, 0.98, (len(links), 2)), rng.uniform(low, high, len(links)), strict=True
        )
    )


def learnt_gains(hand: VirtualHand, deployment: Deployment, model: PadModel, numbers: range) -> None:
    """Calibrate the model's gains by touches of these numbers, as the supervisor does."""
    period_s = deployment.daemon.sync_period_ms * 1e-3
    held = SAMPLE_S - period_s * np.arange(LEARNT_SAMPLES)[::-1]
    times_s = (REST_S + np.array(numbers)[:, None] * STEP_S + held).ravel()
    for row, (network, (_, pad)) in enumerate(zip(networks_of(deployment), deployment.pads, strict=True)):
        node, sheet = deployment.nodes[pad.node], deployment.sheets[pad.sheet]
        calibrator = AutoCalibrator(network, networks_with_other_parts(pad, node, sheet))
        calibrator.assign_node(row + 1, None, None, "", 0)
        readings = hand.counts(row, times_s).reshape(len(numbers), LEARNT_SAMPLES, 4).mean(axis=1)
        noise_a = model.noise_a[row] / np.sqrt(LEARNT_SAMPLES)
        for number, reading in zip(numbers, readings, strict=True):
            sync_ns = round((REST_S + number * STEP_S + SAMPLE_S) * 1e9)
            contact = StationaryContact(
                reading * model.ampere_per_count[row], noise_a, LEARNT_SAMPLES, sync_ns
            )
            update = calibrator.add_contact(contact)
            if update.apply:
                gains = calibrator.gains
                learnt = gains.factors, gains.covariance
        if calibrator.calibration_state == "calibrated":
            model.set_gains_and_law(row, learnt[0], f"{row + 1}-1")
            model.set_uncertainty(row, learnt[1], False)


def serve(
    model: PadModel, deployment: Deployment, counts: NDArray[np.int64], sampled: Mapping[int, int]
) -> dict[tuple[int, str], wire.Contact]:
    """Return the contacts in the `sampled` ticks by touch number and link; counts (ticks, pads, 4)."""
    period_ns = round(deployment.daemon.sync_period_ms * 1e6)
    collector = Collector()
    pipeline = pipeline_of(deployment, collector, model=model)
    for tick, rows in enumerate(counts.astype("<i2")):
        t_ns = _FIRST_NS + tick * period_ns
        collector.sampled = sampled.get(tick)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate(rows):
            pipeline.slab.write_pdo(pad, row.tobytes(), t_ns + 1)
        pipeline.tick_if_due(t_ns + period_ns)
        pipeline.prepare_next_tick()
    return collector.contacts


def play(task: tuple[str, int, int, int]) -> dict[str, Estimates]:
    """Return estimates of position and force of a hand: name of the world, number, touches, learnt ones."""
    name, number, touches, learnt = task
    drawn = drawn_world(name, number)
    deployment = drawn.describe(load(shipped.path("utah_mit.toml")))
    model = PadModel(deployment)
    stimulus = Scenario(touch=draw_touches(model.links, WARM_UP + touches + learnt, drawn.seed))
    hand = VirtualHand(deployment, stimulus, drawn)
    period_s = deployment.daemon.sync_period_ms * 1e-3
    times_s = period_s * np.arange(round((REST_S + (WARM_UP + touches) * STEP_S) / period_s))
    counts = np.stack([hand.counts(row, times_s) for row in range(model.size)], axis=1)
    sampled = {
        round((REST_S + k * STEP_S + SAMPLE_S) / period_s): k for k in range(WARM_UP, WARM_UP + touches)
    }
    truths = {
        (k, truth.link): truth for tick, k in sampled.items() for truth in hand.truth(float(times_s[tick]))
    }
    parts: dict[str, list[Estimates]] = {"position": [], "force": []}
    for state in STATES if name in NAMED else STATES[:1]:
        if state == "calibrated":
            learnt_gains(hand, deployment, model, range(WARM_UP + touches, WARM_UP + touches + learnt))
        contacts = serve(model, deployment, counts, sampled)
        for row, (hand_name, pad) in enumerate(deployment.pads):
            oracle = PadOracle.build(
                drawn, deployment, hand_name, pad, model.noise_a[row], gains_known=state == "calibrated"
            )
            found = [(contacts.get(key), truth) for key, truth in truths.items() if key[1] == pad.link]
            position, force = compare(
                found,
                oracle,
                {
                    "world": name,
                    "state": state,
                    "sheet": pad.sheet,
                    "sheet kind": kind.name if (kind := drawn.sheet_kind(pad.sheet)) else "ideal",
                },
            )
            parts["position"].append(position)
            parts["force"].append(force)
    return {quantity: concatenate(some) for quantity, some in parts.items()}


def compare(
    found: Sequence[tuple[wire.Contact | None, GroundTruth]], oracle: PadOracle, labels: Mapping[str, str]
) -> tuple[Estimates, Estimates]:
    """Return position and force of one pad's touches; a touch without a contact isn't valid."""
    u, v, true_n = np.array([(truth.u_m, truth.v_m, truth.force_n) for _, truth in found]).T
    stated = oracle.covariances(u, v, true_n)
    columns = {name: np.full(len(found), label) for name, label in labels.items()}
    columns |= {
        "surface": np.full(len(found), oracle.surface_name),
        "aspect": bin_labels(np.full(len(found), oracle.aspect), (1.3, 1.8)),
        "force": bin_labels(true_n, (0.5, 2.0, 5.0), "N"),
        "edge distance": bin_labels(100 * oracle.edge_distance(u, v), (5.0, 15.0), "%"),
    }
    bound_m = np.array([truth.bound_m for _, truth in found])
    return (
        estimates([position_error(*pair) for pair in found], bound_m, stated.position_m2, columns),
        estimates([force_error(*pair) for pair in found], stated.force_bound_n, stated.force_n2, columns),
    )


def estimates(
    found: Sequence[tuple[FloatArray, FloatArray]],
    bound: FloatArray,
    oracle_covariance: FloatArray,
    columns: Mapping[str, NDArray[Any]],
) -> Estimates:
    """Return a table of errors with covariances; valid are those that aren't NaN."""
    error, covariance = (np.array(values) for values in zip(*found, strict=True))
    return Estimates(error, covariance, ~np.isnan(error[:, 0]), bound, oracle_covariance, columns)


def position_error(contact: wire.Contact | None, truth: GroundTruth) -> tuple[FloatArray, FloatArray]:
    """Return error (2,) [m] and covariance (2, 2) along the surface; NaN without a valid position."""
    if not contact or not contact.position_m or not contact.normal or not contact.covariance_m2:
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    if contact.position_status != "valid":
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    across = tangent_basis(np.array(contact.normal))
    covariance = across @ np.reshape(contact.covariance_m2, (3, 3)) @ across.T
    return across @ np.subtract(contact.position_m, truth.position_m), covariance


def force_error(contact: wire.Contact | None, truth: GroundTruth) -> tuple[FloatArray, FloatArray]:
    """Return error (1,) [N] and variance (1, 1) of the force; NaN without a valid force."""
    if not contact or contact.force_n is None or contact.force_std_n is None:
        return np.full(1, np.nan), np.full((1, 1), np.nan)
    if contact.force_status != "valid":
        return np.full(1, np.nan), np.full((1, 1), np.nan)
    return np.array([contact.force_n - truth.force_n]), np.array([[contact.force_std_n**2]])


def tangent_basis(normal: FloatArray) -> FloatArray:
    """Return two orthonormal rows (2, 3) at right angles to a unit vector."""
    along = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    along /= np.linalg.norm(along)
    return np.stack([along, np.cross(normal, along)])


UNITS = {"position": ("mm", 1e3), "force": ("N", 1.0)}


def rows_of(parts: Mapping[str, Estimates], quantity: str) -> list[dict[str, Any]]:
    return [
        {"": name, **EstimateScore.of_estimates(part).row(UNITS[quantity][1])} for name, part in parts.items()
    ]


def sections(found: Mapping[str, Mapping[str, Estimates]]) -> list[str]:
    """Return the lines of all tables, which are printed too."""
    page: list[str] = []
    for quantity, (unit, _) in UNITS.items():
        every = {name: found[name][quantity] for name in found}
        parts = {
            f"{name}, {state}": part for name, both in every.items() for state, part in slices(both, "state")
        }
        page += table(quantity.capitalize(), f"Errors and deviations in {unit}.", rows_of(parts, quantity))
        for by in SLICES:
            cut = {
                f"{name}, {value}": part
                for name in NAMED
                for value, part in slices(dict(slices(every[name], "state"))[STATES[0]], by)
            }
            page += table(f"{quantity.capitalize()} by {by}", "As configured.", rows_of(cut, quantity))
    radius = dict(slices(found["radius"]["force"], "state"))[STATES[0]]
    cut = {
        f"{sheet}, {value}": part
        for sheet, own in slices(radius, "sheet")
        for value, part in slices(own, "force")
    }
    page += table(
        "Force with hidden radius alone", "As configured, all else as stated.", rows_of(cut, "force")
    )
    return page


def draw(found: Mapping[str, Mapping[str, Estimates]], path: Path) -> None:
    """Draw stated against observed probability, as configured and calibrated."""
    figure, panels = plt.subplots(2, 2, figsize=(9, 9), layout="constrained")
    for axes, quantity in zip(panels, UNITS, strict=True):
        for panel, state in zip(axes, STATES, strict=True):
            draw_calibration(
                panel, {name: dict(slices(found[name][quantity], "state"))[state] for name in NAMED}
            )
            panel.set_title(f"{quantity}, {state}")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument(
        "--hands", type=int, default=8, help="of each named world; half as many of the others"
    )
    parser.add_argument("--touches", type=int, default=20, help="of each pad")
    parser.add_argument("--learnt", type=int, default=160, help="touches of each pad for its calibration")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    asked = parser.parse_args()
    if asked.quick:
        asked.hands, asked.touches, asked.learnt = 1, 2, 40
    names, few = (*NAMED, *SINGLE), (asked.hands + 1) // 2
    tasks = [
        (name, number, asked.touches, asked.learnt)
        for name in names
        for number in range(asked.hands if name in NAMED else few)
    ]
    made: dict[str, list[dict[str, Estimates]]] = {name: [] for name in names}
    with ProcessPoolExecutor(asked.workers) as pool:
        for task, result in zip(tasks, pool.map(play, tasks), strict=True):
            made[task[0]].append(result)
            print(f"{task[0]}: hand {task[1] + 1}", flush=True)
    found = {
        name: {quantity: concatenate([part[quantity] for part in parts]) for quantity in UNITS}
        for name, parts in made.items()
    }
    out = output_folder(asked.quick)
    head = [
        "# Position and force by world", "",
        f"{made_by()}; {platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}.", "",
        HEAD.format(
            hands=asked.hands, few=few, touches=asked.touches, learnt=asked.learnt,
            low=FORCES_N[0], high=FORCES_N[1],
        ), "", "![stated and observed probability](worlds.png)", "",
    ]  # fmt: skip
    (out / "worlds.md").write_text("\n".join([*head, *sections(found)]))
    record = {
        f"{name}, {state}, {quantity}": asdict(EstimateScore.of_estimates(part))
        for name, both in found.items()
        for quantity, every in both.items()
        for state, part in slices(every, "state")
    }
    (out / "worlds.json").write_text(json.dumps(record, indent=1).replace("NaN", "null") + "\n")
    draw(found, out / "worlds.png")


HEAD = """\
{hands} hands of each of the [worlds](../worlds.md) `ideal`, `default` and `harsh`, and {few} of each world
with few hidden quantities; 15 pads each, of four surfaces; seeds of the reporting family. {touches} touches
of each pad, {low:g} to {high:g} N (log-uniform), anywhere from 2 % of a side inside the edges; one sample of
each, 0.32 s after it began. 12 touches come first, as evidence for the compensation of sheets. Deployment
files describe sheets as their builder would. Pads are mounted as stated; for mounts and joints see
[grasp](grasp.md). *Calibrated*: with the gains of automatic calibration after {learnt} other touches of each
pad, where it reached that state.

* Shares are in % of valid estimates, with 95 % intervals (Clopper and Pearson); those of *valid* are of all
  touches, also missed ones. Touches of one pad share its parts: the intervals are of touches on these pads.
* *> 5 sigma*: Mahalanobis distance of the truth from the estimate.
* *Oracle*: the standard deviation that an estimator could honestly state that knows the distributions of
  gains, gaps, sizes, sheets and patches (calibrated: and the gains), but not their values: Laplace's
  approximation about the true values. It knows the history of the sheet.
* *CRPS*: of normal distributions in closed form; of positions, in two dimensions, the energy score.
* *Error / bound*: of each touch by its own bound from noise alone (Cramer-Rao): rms, and quantiles."""


if __name__ == "__main__":
    main()
