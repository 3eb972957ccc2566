"""Measure incipient slip from friction ratios of shear pads in MuJoCo's grasps: delay and false alarms.

Prints its table and writes docs/benchmarks/shear_slip.md and shear_slip.json.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from bench_percept_grasp import onsets, speeds
from bench_shear import DRIVE_V, NORMAL_STD, PART_STD, REFERENCE_STD, REFERENCES_N, shear_table
from grasp_run import drawn_world
from numpy.typing import NDArray
from page import made_by, options, output_folder, progress, table
from scores import score_events

from handtouch.config import load, shipped
from handtouch.field.elastic_layer import calibrate_layer
from handtouch.field.shear import ShearPad
from handtouch.percept.friction import FrictionMonitor
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S
from handtouch.simulate.grasp.simulation import GraspRecord, simulate_grasp
from handtouch.simulate.grasp.tangential import PadForces, pad_forces
from handtouch.simulate.shear_pad import LayerHistory, SimulatedShearPad
from handtouch.simulate.worlds import DrawnWorld

FloatArray = NDArray[np.float64]
Row = dict[str, Any]
Event = tuple[tuple[str, int], float]

STEPS = 5
"""Steps of MuJoCo from one sample to the next: 200 Hz."""
MIN_NORMAL_N, NOISE_A = 0.1, 1e-6
EARLY_S, LATE_S = 0.2, 0.3
"""Alarms so long before and after the onset of a slip are of this slip."""
CONFIRMED_S = 0.1
"""Time after its onset at which a slip teaches the limit: about the 95 % delay of detection by position."""


def forces_on(grasp: GraspRecord, row: int) -> PadForces:
    """Return MuJoCo's forces on a pad, mean of the steps of each sample."""
    forces = pad_forces(grasp, row)
    total = np.vstack([forces.tangential_n, forces.normal_n])
    sampled = total.reshape(3, -1, STEPS).mean(axis=2)
    return PadForces(sampled[:2], sampled[2])


def measured(forces: PadForces, world: DrawnWorld, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return tangential forces (2, n), covariances (n, 2, 2) and normal forces (n,) of a calibrated pad."""
    rng = np.random.default_rng((world.seed, sum(map(ord, name))))
    nominal = shear_table("crossed bars")
    hidden = world.shear(name)
    history, moved = LayerHistory(nominal, hidden), [np.zeros(2)]
    for reference in REFERENCES_N.T:
        moved.append(history.advance(reference * (1 + REFERENCE_STD * rng.standard_normal()), 2.0))
        history.advance(np.zeros(2), 2.0)
    period_s = STEPS * TIME_STEP_S
    moved += [history.advance(force, period_s) for force in forces.tangential_n.T]
    path = np.array(moved).T
    normal = np.concatenate([[0.0], np.full(4, 3.0), np.maximum(forces.normal_n, 0.0)])
    amperes = SimulatedShearPad(nominal, DRIVE_V, hidden).currents(path, normal, np.zeros_like(path))
    amperes += NOISE_A * rng.standard_normal(amperes.shape)
    pad = ShearPad(nominal.build_pattern(), DRIVE_V, nominal.build_film(), PART_STD)
    found = pad.estimate(amperes, NOISE_A, normal_force_n=normal, centre_std_m=1e-3)
    displacement = found.motion - found.motion[:, :1]
    stated = world.world.shear.describe(nominal)
    layer = calibrate_layer(displacement[:, 1:5], REFERENCES_N, REFERENCE_STD, stated.hysteresis)
    force = layer.force(displacement[:, 5:], found.covariance[5:], 2.0)
    scale = 1 + NORMAL_STD * rng.standard_normal()
    return force.vector_n, force.covariance_n2, scale * forces.normal_n


def events_of(
    grasp: GraspRecord, world: DrawnWorld, *, learns: bool
) -> tuple[list[Event], list[Event], float]:
    """Return onsets of slips and alarms by pad, and the time in contact [h]."""
    speed, period_s = speeds(grasp), STEPS * TIME_STEP_S
    monitor = FrictionMonitor(len(grasp.pads))
    true: list[Event] = []
    alarms: list[Event] = []
    series: list[tuple[int, tuple[FloatArray, FloatArray, FloatArray], list[float]]] = []
    for row, pad in enumerate(grasp.pads):
        forces = forces_on(grasp, row)
        if forces.normal_n.max() < MIN_NORMAL_N:
            continue
        found = [step * TIME_STEP_S for step in onsets(speed[:, row])]
        true += [((grasp.grasped_object.name, row), time_s) for time_s in found]
        series.append((row, measured(forces, world, f"{grasp.hand}/{pad.link}"), found))
    labels = dict.fromkeys(range(len(grasp.pads)), "unknown")
    in_contact = 0
    for sample in range(len(grasp.times_s) // STEPS):
        t_s = sample * period_s
        for row, (force, covariance, normal), found in series:
            slips = any(0 <= t_s - onset_s < LATE_S for onset_s in found)
            state = monitor.update(
                row,
                t_s,
                force[:, sample],
                covariance[sample],
                float(normal[sample]),
                max(0.1 * float(normal[sample]), MIN_NORMAL_N / 3),
                slips=slips,
            )
            in_contact += state.label != "unknown"
            if state.label == "incipient" and labels[row] != "incipient":
                alarms.append(((grasp.grasped_object.name, row), t_s))
            labels[row] = state.label
            if learns and any(0 <= t_s - onset_s - CONFIRMED_S < period_s for onset_s in found):
                monitor.confirm_slip(row)
    return true, alarms, in_contact * period_s / 3600


def rows_of(world_name: str, seeds: int, objects: list[str]) -> list[Row]:
    """Return scores of one world: with the prior alone, and with limits learned from slips."""
    hand = load(shipped.path("utah_mit.toml")).hands[0]
    parts: dict[bool, list[tuple[list[Event], list[Event], float]]] = {False: [], True: []}
    for seed in range(1, seeds + 1):
        for name in objects:
            world = drawn_world(world_name, seed)
            grasp = simulate_grasp(hand, name, seed, world)
            for learns, found in parts.items():
                true, alarms, hours = events_of(grasp, world, learns=learns)
                keyed = ([((*key, seed), at) for key, at in events] for events in (true, alarms))
                found.append((*keyed, hours))  # type: ignore[arg-type]
            progress(f"{world_name}, seed {seed}: {name}")
    rows = []
    for learns, found in parts.items():
        true = [event for part in found for event in part[0]]
        alarms = [event for part in found for event in part[1]]
        hours = sum(part[2] for part in found)
        score = score_events(true, alarms, hours=hours, early_s=EARLY_S, late_s=LATE_S)
        ahead = np.mean(score.delays_s < 0) if len(score.delays_s) else np.nan
        rows.append(
            {"world": world_name, "limit": "learned from slips" if learns else "prior alone"}
            | score.row()
            | {
                "before the onset, %": float(100 * ahead),
                "false alarms per minute": score.false_alarms.per_hour / 60,
            }
        )
        del rows[-1]["false alarms per hour"]
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    objects = list(GRASP_OBJECTS)[: 1 if args.quick else None]
    seeds = 1 if args.quick else args.seeds
    rows: list[Row] = []
    for world in ("default", "harsh"):
        rows += rows_of(world, seeds, objects)
    page = [
        "# Incipient slip from friction ratios",
        "",
        f"{made_by()}.",
        "",
        *table(
            "Alarms",
            f"Grasps of {', '.join(objects)}; seeds: {seeds}; as in [percepts of "
            "grasps](percept_grasp.md), with the same onsets of slips. All pads carry calibrated shear pads "
            f"under MuJoCo's tangential forces, read at {1 / (STEPS * TIME_STEP_S):.0f} Hz; normal forces "
            f"have an error of {100 * NORMAL_STD:g} %. An alarm from {EARLY_S:g} s before an onset to "
            f"{LATE_S:g} s after it is of that slip, any other one is false; delays are negative before the "
            f"onset. *Learned*: a slip teaches its ratio {CONFIRMED_S:g} s after its onset, as if position "
            "had confirmed it, to all pads of the hand.",
            rows,
        ),
    ]
    folder = output_folder(args.quick)
    (folder / "shear_slip.md").write_text("\n".join(page))
    (folder / "shear_slip.json").write_text(json.dumps({"alarms": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
