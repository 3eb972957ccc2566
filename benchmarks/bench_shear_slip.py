"""Shear pads in grasps: force vectors, and slip by friction and by position.

Grasps as in [percepts of grasps](percept_grasp.md): the hand of `config/utah_mit_shear.toml` closes, squeezes
twice, and the object is pulled out of it; seeds of the reporting family. The daemon's pipeline computes force
vectors and percepts of the four fingertips, spherical pads above shear pads, at 200 Hz; MuJoCo's forces are
the truth. Nothing is calibrated, no pad is tared. Onsets, firm grips and false alarms are defined as there,
but alarms from 50 ms before an onset on are of it. Delays are those of detected slips, negative before the
onset; joints are known to 0.2 degrees. *Others*: alarms during motion slower than a slip, or while a grip
closes. *Force vectors*: tangential forces of contacts with 0.1 N and more, in newton, along and across the
pad's x, every 0.1 s; those of one grasp are of the same drawn pads.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from benchmarks.page import Report, Row, options, progress

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_percept_grasp import ALARMS, STATED, slips, together
from benchmarks.grasp_run import Served, drawn_world, served
from benchmarks.scores import Estimates, EstimateScore, Rate, Share, bin_labels, concatenate, slices
from handtouch.config import Deployment, load, shipped
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.grasp_stimulus import pad_forces
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S

FloatArray = NDArray[np.float64]
KINDS: dict[str, tuple[str, ...]] = {
    "position alone": ("motion",),
    "friction alone": ("friction",),
    "the first of both": ("motion", "friction"),
}
WORLDS = ("default", "harsh")
LEAD_S = 0.05
"""Alarms so long before the onset of a slip are of it."""
SCORED_S = 0.1
"""From one scored force vector of a pad to the next."""
MIN_NORMAL_N = 0.1
_START_NS = 1_000_000_000


def force_estimates(run: Served, deployment: Deployment) -> Estimates | None:
    """Return errors of the tangential forces of fingertips, every 0.1 s, along and across the pads' x."""
    errors, covariances, labels = [], [], []
    for row, pad in enumerate(run.grasp.pads):
        if deployment.hands[0].pads[row].shear is None:
            continue
        true, last_ns = pad_forces(run.grasp, row), 0
        for contact in run.contacts:
            step = round((contact.t_ns - _START_NS) * 1e-9 / TIME_STEP_S)
            if contact.link != pad.link or contact.force_vector_n is None or contact.normal is None:
                continue
            if contact.t_ns - last_ns < SCORED_S * 1e9 or true.normal_n[step] < MIN_NORMAL_N:
                continue
            last_ns = contact.t_ns
            normal = np.array(contact.normal)
            across = np.cross(normal, pad.rotation[:, 0])
            across /= np.linalg.norm(across)
            axes = np.stack([np.cross(across, normal), across])
            covariance = np.reshape(contact.force_vector_covariance_n2 or [np.nan] * 9, (3, 3))
            errors.append(axes @ contact.force_vector_n - true.tangential_n[:, step])
            covariances.append(axes @ covariance @ axes.T)
            labels.append(float(np.hypot(*true.tangential_n[:, step])))
    if not errors:
        return None
    covariance = np.array(covariances)
    return Estimates(
        np.array(errors),
        covariance,
        np.isfinite(covariance).all(axis=(1, 2)),
        np.ones(len(errors)),
        covariance,
        {"force": bin_labels(labels, (0.3, 1.0), "N")},
    )


def slip_row(world: str, name: str, runs: Sequence[Served], on: Sequence[str]) -> Row:
    """Return the scores of one way to detect slip."""
    scored = [slips(run, ALARMS, KINDS[name], LEAD_S, on) for run in runs]
    found = together(scored)
    delays = np.array([delay for of in scored for delay in of["delays"]])
    before = delays[np.isfinite(delays)] < 0
    return {
        "world": world,
        "alarms by": name,
        "slips": found["slips"],
        "detected, %": Share(found["detected"], found["slips"]),
        "delay, ms, 50 %": found["ms"],
        "delay, ms, 95 %": found["ms_95"],
        "before the onset, %": float(100 * before.mean()) if len(before) else np.nan,
        "grip, min": found["minutes"],
        "false": found["false"],
        "false per min": str(Rate(found["false"], found["minutes"])),
        "others": found["between"],
    }


def main() -> None:
    args = options(__doc__).parse_args()
    objects = list(GRASP_OBJECTS)[: 1 if args.quick else None]
    seeds = 1 if args.quick else 3
    plain = load(shipped.path("utah_mit_shear.toml"))
    hand = plain.hands[0].model_copy(update=STATED)
    deployment = plain.model_copy(update={"hands": (hand,)})
    fingertips = [pad.link for pad in hand.pads if pad.shear]
    slip_rows: list[Row] = []
    force_rows: list[Row] = []
    for world in WORLDS[: 1 if args.quick else None]:
        runs, forces = [], []
        for seed in range(1, seeds + 1):
            for name in objects:
                run = served(deployment, name, seed, drawn_world(world, seed), perceive=True)
                if (found := force_estimates(run, deployment)) is not None:
                    forces.append(found)
                runs.append(run)
                progress(f"{world}, seed {seed}: {name}")
        slip_rows += [slip_row(world, name, runs, fingertips) for name in KINDS]
        every = concatenate(forces)
        force_rows += [
            {"world": world, "force": label} | EstimateScore.of_estimates(some).row(bounds=False)
            for label, some in [("all", every), *slices(every, "force")]
        ]
    report = Report(args.quick, objects=len(objects), seeds=seeds)
    report.table("Slip", slip_rows)
    report.table("Force vectors", force_rows)
    report.keep()


if __name__ == "__main__":
    main()
