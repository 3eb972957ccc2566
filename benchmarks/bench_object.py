"""Pose of a known object in the hand, against MuJoCo's ground truth.

Percept `object` in the grasps of [grasp](grasp.md), seeds of the reporting family, [world](../worlds.md)
`default`; the daemon's pipeline computes it from simulated samples at 200 Hz and late joint states with
encoder errors. The constants were chosen on grasps of the box, the ball, the bolt and the pen of the tuning
family, seeds 101 to 106. Held out are these seeds, and three objects: the rod, a thicker cylinder than the
pen; the stud, a bolt of another size; the block, a box of other sides. The bolt has a shank of 16 x 80 mm and
a head of 26 x 12 mm, the stud 20 x 60 mm and 30 x 10 mm. Sizes vary by 3 % with the seed, and are stated.

Rows are poses, 20 a second, by the number of pads that touch; all but the last of a table while the hand
closes, holds and squeezes, before the object is pulled out at 3.9 s. *Determined*: published as `estimated`.
Position is that of the object's centre, the angle that of its z axis, for the box of the whole rotation;
both of determined poses, median and 90 %. *Covered*: determined poses whose truth is inside of the 95 %
ellipsoid; poses of one grasp share its errors, so that grasps, not poses, count as trials. *In a hypothesis*:
all poses, also undetermined ones, of which some published hypothesis covers the truth. *Averaged*: distance
from the mean of the touched positions to the object's centre, the baseline; *its angle*: of the principal
axis of three and more of them from z. *Sharpness*: median of the stated standard deviation of the position,
in its worst direction. *Of grasps*: in how many some pose was
determined. The grasps of this page are replayed from inputs of the percept process that were recorded at
commit 0c9a1d6. Quick: --part ball --seeds 1.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from benchmarks.page import Report, options, progress

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks.bench_percept_grasp import STATED
from benchmarks.grasp_run import Served, drawn_world, served
from handtouch import wire
from handtouch.config import Deployment, ObjectTable, load, shipped
from handtouch.percept.object_shapes import KnownShape, build_shape
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS, GraspObject
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S

FloatArray = NDArray[np.float64]
_START_NS = 1_000_000_000
_PULLED_S, _DURATION_S = 3.9, 4.4
_LEVEL = 0.95
MANY_CONTACTS = 4
_PEN = GRASP_OBJECTS["pen"]
OBJECTS = {
    **{name: GRASP_OBJECTS[name] for name in ("ball", "box", "pen")},
    "rod": replace(_PEN, name="rod", size_m=(0.011, 0.055), mass_kg=0.06, position_m=(0.072, 0, 0.027)),
    "block": replace(
        GRASP_OBJECTS["box"], name="block", size_m=(0.016, 0.040, 0.022), position_m=(0.073, 0, 0.036)
    ),
    "stud": replace(
        _PEN,
        name="stud",
        kind="bolt",
        size_m=(0.010, 0.030, 0.015, 0.005),
        mass_kg=0.09,
        position_m=(0.073, 0, 0.028),
    ),
    "bolt": replace(
        _PEN,
        name="bolt",
        kind="bolt",
        size_m=(0.008, 0.040, 0.013, 0.006),
        mass_kg=0.10,
        position_m=(0.073, 0, 0.026),
    ),
}
_KEYS = {
    "sphere": ("diameter_mm",),
    "cylinder": ("diameter_mm", "length_mm"),
    "bolt": ("diameter_mm", "length_mm", "head_diameter_mm", "head_length_mm"),
}


def stated(held: GraspObject) -> ObjectTable:
    """Return the table of an object as a deployment has it."""
    sizes_mm = [2e3 * size for size in held.size_m]
    keys = {"size_mm": sizes_mm} if held.kind == "box" else dict(zip(_KEYS[held.kind], sizes_mm, strict=True))
    return ObjectTable.model_validate({"shape": {"kind": held.kind, **keys}})


def grasped(plain: Deployment, held: GraspObject, seed: int) -> tuple[Served, KnownShape]:
    """Let the hand grasp an object whose size its deployment states."""
    table = stated(held.randomised(seed))
    hand = plain.hands[0].model_copy(update={**STATED, "object": held.name})
    deployment = plain.model_copy(update={"objects": {held.name: table}, "hands": (hand, *plain.hands[1:])})
    world = drawn_world("default", seed)
    kinds = ("motion", "object")
    return served(deployment, held, seed, world, perceive=kinds, duration_s=_DURATION_S), build_shape(table)


def rotation_error(shape: KnownShape, found: Rotation, true: Rotation) -> FloatArray:
    """Return the smallest rotation vector (3,) from a true orientation to the found one, in the palm."""
    if shape.free_axes == 3:
        return np.zeros(3)
    if shape.free_axes == 1:
        axis, true_axis = found.apply([0.0, 0.0, 1.0]), true.apply([0.0, 0.0, 1.0])
        if len(shape.symmetries) > 1 and axis @ true_axis < 0:
            axis = -axis
        across = np.cross(true_axis, axis)
        sine = float(np.linalg.norm(across))
        return np.asarray(across * (np.arctan2(sine, axis @ true_axis) / max(sine, 1e-12)))
    turns = [(found * (true * Rotation.from_quat(s)).inv()).as_rotvec() for s in shape.symmetries]
    return np.asarray(min(turns, key=lambda turn: float(np.linalg.norm(turn))))


def compared(run: Served, shape: KnownShape) -> list[dict[str, Any]]:
    """Return a row for each pose: errors of the likeliest hypothesis, and which cover the truth."""
    rows = []
    limit = chi2.ppf(_LEVEL, 6 - shape.free_axes)
    for percept in run.percepts:
        since_s = (percept.t_ns - _START_NS) * 1e-9
        step = round(since_s / TIME_STEP_S)
        if percept.kind != "object" or not percept.poses or step >= len(run.grasp.object_m):
            continue
        true = Rotation.from_matrix(run.grasp.object_rotation[step])
        errors = [_pose_errors(pose, shape, run.grasp.object_m[step], true) for pose in percept.poses]
        touched_m = run.palm_m[run.step == 5 * (step // 5)]
        centre, axis_deg = _averaged(touched_m, true)
        rows.append(
            {
                "seed": run.seed,
                "pulled": since_s >= _PULLED_S,
                "contacts": int(percept.evidence["contacts"]),
                "determined": percept.state == "estimated",
                "mm": 1e3 * errors[0][0],
                "deg": np.degrees(errors[0][1]),
                "covered": errors[0][2] <= limit,
                "any": any(distance2 <= limit for *_, distance2 in errors),
                "std_mm": 1e3 * float(percept.values["position_std_m"]),
                "averaged_mm": 1e3 * float(np.linalg.norm(centre - run.grasp.object_m[step])),
                "averaged_deg": axis_deg,
            }
        )
    return rows


def _pose_errors(
    pose: wire.ObjectPose, shape: KnownShape, true_m: FloatArray, true: Rotation
) -> tuple[float, float, float]:
    """Return errors of position [m] and rotation [rad], and the squared Mahalanobis distance of both."""
    turn = rotation_error(shape, Rotation.from_quat(pose["palm_quaternion"]), true)
    apart = np.append(true_m - np.array(pose["palm_position_m"]), -turn)
    covariance = np.array(pose["palm_covariance"]).reshape(6, 6)
    return (
        float(np.linalg.norm(apart[:3])),
        float(np.linalg.norm(turn)),
        float(apart @ np.linalg.solve(covariance, apart)),
    )


def _averaged(touched_m: FloatArray, true: Rotation) -> tuple[FloatArray, float]:
    """Return the mean of touched positions (k, 3), and the angle [deg] of their principal axis from z."""
    if not len(touched_m):
        return np.full(3, np.nan), np.nan
    centre = touched_m.mean(axis=0)
    if len(touched_m) < 3:
        return centre, np.nan
    axis = np.linalg.svd(touched_m - centre)[2][0]
    return centre, float(np.degrees(np.arccos(min(abs(axis @ true.apply([0.0, 0.0, 1.0])), 1.0))))


def summary(case: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return a row of the table."""
    known = [row for row in rows if row["determined"]]

    def spread(name: str, some: Sequence[dict[str, Any]], *levels: float) -> list[float]:
        values = np.array([row[name] for row in some], np.float64)
        values = values[np.isfinite(values)]
        return [float(np.quantile(values, level)) if len(values) else np.nan for level in levels]

    seeds = sorted({row["seed"] for row in known})
    covered = [np.mean([row["covered"] for row in known if row["seed"] == seed]) for seed in seeds]
    return {
        "pads that touch": case,
        "poses": len(rows),
        "grasps": len({row["seed"] for row in rows}),
        "determined, %": 100 * len(known) / len(rows) if rows else None,
        "of grasps": len(seeds),
        "mm, 50 / 90 %": spread("mm", known, 0.5, 0.9),
        "deg, 50 / 90 %": spread("deg", known, 0.5, 0.9),
        "sharpness, mm": spread("std_mm", known, 0.5)[0],
        "covered, %": 100 * float(np.mean([row["covered"] for row in known])) if known else None,
        "worst grasp, %": 100 * float(min(covered)) if covered else None,
        "in a hypothesis, %": 100 * float(np.mean([row["any"] for row in rows])) if rows else None,
        "averaged, mm": spread("averaged_mm", rows, 0.5)[0],
        "its angle, deg": spread("averaged_deg", rows, 0.5)[0],
    }


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--part", choices=list(OBJECTS), required=True, help="object")
    parser.add_argument("--seeds", type=int, default=20)
    args = parser.parse_args()
    plain: Deployment = load(shipped.path("utah_mit.toml"))
    rows: list[dict[str, Any]] = []
    busy_s, updates = 0.0, 0
    for seed in range(1, args.seeds + 1):
        run, shape = grasped(plain, OBJECTS[args.part], seed)
        rows += compared(run, shape)
        busy_s += run.percepts_s
        updates += sum(percept.kind == "object" and bool(percept.poses) for percept in run.percepts)
        progress(f"{args.part}, seed {seed}")
    held = [row for row in rows if not row["pulled"]]
    report = Report(args.quick, args.part, seeds=args.seeds)
    table = [summary(str(n), [row for row in held if row["contacts"] == n]) for n in range(1, MANY_CONTACTS)]
    table.append(
        summary(f"{MANY_CONTACTS} and more", [row for row in held if row["contacts"] >= MANY_CONTACTS])
    )
    table.append(summary("any", held))
    table.append(summary("any, while it is pulled", [row for row in rows if row["pulled"]]))
    report.table("Poses", [row for row in table if row["poses"]])
    cost = {"updates": updates, "ms of processor time each": 1e3 * busy_s / max(updates, 1)}
    report.table("Cost of the percept process, all of its work", [cost])
    report.limit("cores at 20 poses a second", 20 * busy_s / max(updates, 1), 0.5)
    report.keep()


if __name__ == "__main__":
    main()
