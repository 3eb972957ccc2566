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
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import numpy as np
from hand_touches import FORCES_N, REST_S, SAMPLE_S, STEP_S, compare, draw_touches, sampled
from numpy.typing import NDArray
from oracle import PadOracle
from page import made_by, options, output_folder, table
from scores import Estimates, EstimateScore, concatenate, draw_calibration, slices

from handtouch.calibration.auto_calibration import AutoCalibrator
from handtouch.calibration.stationary_contacts import StationaryContact
from handtouch.config import Deployment, load, shipped
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pad_model import PadModel
from handtouch.hand import electrode_network, models_with_other_parts, part_stds
from handtouch.simulate.scenario import Scenario
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
WARM_UP = 12
"""Touches before those that are compared: as many as compensation of sheets needs for evidence."""
LEARNT_SAMPLES = 12
STATES = ("as configured", "calibrated")
SLICES = ("edge distance", "force", "sheet", "sheet kind", "surface", "aspect")


def drawn_world(name: str, number: int) -> DrawnWorld:
    """Return a world of the reporting family. Pads are mounted as stated: mounts are the grasp's subject."""
    world = WORLDS[name] if name in WORLDS else SINGLE[name]
    return replace(world, mounts=MountSpread()).draw(Family.REPORTING.seed(number))


def with_stated_radius(deployment: Deployment, drawn: DrawnWorld) -> Deployment:
    """Return the deployment with the spread of contact radii in this world as its builder states it."""
    spread = drawn.world.contacts.radius_sigma.std
    sheets = {
        name: sheet.model_copy(update={"contact_radius_std_mm": spread * sheet.contact_radius_std_mm})
        for name, sheet in deployment.sheets.items()
    }
    return deployment.model_copy(update={"sheets": sheets})


def learnt_gains(hand: VirtualHand, deployment: Deployment, model: PadModel, numbers: range) -> None:
    """Calibrate the model's gains by touches of these numbers, as the supervisor does."""
    period_s = deployment.daemon.sync_period_ms * 1e-3
    held = SAMPLE_S - period_s * np.arange(LEARNT_SAMPLES)[::-1]
    times_s = (REST_S + np.array(numbers)[:, None] * STEP_S + held).ravel()
    for row, (_, pad) in enumerate(deployment.pads):
        node, sheet = deployment.nodes[pad.node], deployment.sheets[pad.sheet]
        network = electrode_network(pad, sheet)
        others = models_with_other_parts(network, pad, node, sheet)
        calibrator = AutoCalibrator(network, others, part_stds(pad, node, sheet))
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
                learnt = calibrator.gains
        if calibrator.calibration_state == "calibrated":
            covariance = tuple(np.ravel(learnt.covariance).tolist())
            calibration = ActiveCalibration(
                f"{row + 1}-1", learnt.factors, gain_covariance=covariance, parts=learnt.parts
            )
            model.set_calibration(row, calibration)


def play(task: tuple[str, int, int, int]) -> dict[str, Estimates]:
    """Return estimates of position and force of a hand: name of the world, number, touches, learnt ones."""
    name, number, touches, learnt = task
    drawn = drawn_world(name, number)
    deployment = drawn.describe(load(shipped.path("utah_mit.toml")))
    model = PadModel(with_stated_radius(deployment, drawn))
    stimulus = Scenario(touch=draw_touches(model.links, WARM_UP + touches + learnt, drawn.seed))
    hand = VirtualHand(deployment, stimulus, drawn)
    numbers = range(WARM_UP, WARM_UP + touches)
    parts: dict[str, list[Estimates]] = {"position": [], "force": []}
    for state in STATES if name in NAMED and learnt else STATES[:1]:
        if state == "calibrated":
            learnt_gains(hand, deployment, model, range(numbers.stop, numbers.stop + learnt))
        contacts, truths = sampled(hand, model, deployment, numbers)
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
                    "pad": f"{number}/{pad.link}",
                    "sheet": pad.sheet,
                    "sheet kind": kind.name if (kind := drawn.sheet_kind(pad.sheet)) else "ideal",
                },
            )
            parts["position"].append(position)
            parts["force"].append(force)
    return {quantity: concatenate(some) for quantity, some in parts.items()}


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
files describe sheets as their builder would, and state the standard deviations of the parts and contacts of
their world, also those of uneven sheets and elongated contacts. Pads are mounted as stated; for mounts and
joints see [grasp](grasp.md). *Calibrated*: with the gains and parts that automatic calibration learned from
{learnt} other touches of each pad, where it reached that state.

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
