"""Percepts of grasps, against MuJoCo's ground truth: slip and shape.

The grasps of [grasp](grasp.md), seeds of the reporting family, in the [world](../worlds.md) `default` where
no other is named; the daemon's pipeline computes all percepts at 200 Hz. Slip is detected by trees that were
trained with grasps of these four objects, of the tuning family: the figures are those of other seeds, sizes,
poses, frictions and sheets, not of other kinds of objects or tasks.

*Slip*: ground truth is the speed of the object's surface relative to a pad's, smoothed over 11 ms. Below 2
mm/s it is a grip (soft contacts creep), above 10 mm/s a slip; its onset is the last time below the first
limit, after 0.1 s of grip. An alarm is `incipient` or `sliding`, published within 0.3 s and before the
contact ends. *ms*: delay of those detected, median and 95 %. *False*: during a grip, from 0.1 s before to 50
ms after the alarm; *rolling*: those with the centre of force moving on the pad by more than 0.2 mm in 0.1 s.
*Others*: during motion slower than a slip, or shortly before its end. *Standing*: slips not detected that
began while an alarm, published more than 10 ms before, still stood. *What makes slips hard*: each in the
first row that fits; a slip counts for the detector from 0.35 mm, unless it is fast.

*Shape*: the last percept before the object is pulled, 3.85 s after it was presented; the label is the most
probable class in any state. The box has no class of its own: pads touch its faces and edges, and `invalid`,
none of the shapes, is the correct answer. The cup is a cone with its mean radius. *Moves*: the shape fits
only if the object moved by about 2 mm between touches, which increases the standard deviation. Quick: --seeds
1 --objects ball.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from typing import Any

from benchmarks.page import Report, options, progress

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.grasp_run import Served, drawn_world, served
from benchmarks.scores import Rate, Share
from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.core.stages.slip import GripModel
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S, MujocoPad
from handtouch.simulate.grasp.simulation import GraspRecord

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
STATED = {"mount_std_mm": 0.2, "mount_std_deg": 0.5, "joint_std_deg": 0.2}
_START_NS = 1_000_000_000
MAX_GRIP_M_S, MIN_SLIP_M_S = 2e-3, 10e-3
"""Slower motion is a grip with creeping contacts, faster motion a slip."""
MIN_ROLL_M = 0.2e-3
MIN_SLIP_M, MIN_LASTING_S = 0.5e-3, 0.1
"""Way of a slip that matters to a controller, beyond the 0.4 mm of a position in the palm frame
(bench_grasp), whatever the detector requires; and time that a contact lasts after an onset, so that an alarm
can be of use."""
DETECTED_M = GripModel().chatter_m
"""Way from which a slip counts for the detector at moderate speed."""
_SMOOTHING_STEPS, _FIRM_STEPS, _MAX_DELAY_S = 11, 100, 0.3
_MAX_LEAD_S = 0.010
PULLED_S = 3.85
"""Time at which the object is pulled."""
KINDS = (
    f"shorter than {1e3 * MIN_SLIP_M:g} mm", f"contact ends within {MIN_LASTING_S:g} s",
    f"centre of force moves less than {1e3 * DETECTED_M:g} mm", "others",
)  # fmt: skip
"""Slips; one is of the first kind that fits."""
SHAPES = {"ball": "sphere", "box": "flat", "pen": "cylinder", "cup": "cylinder"}
ALARMS = ("incipient", "sliding")


# Slip -------------------------------------------------------------------------------------------------------


def speeds(grasp: GraspRecord) -> FloatArray:
    """Return the object's surface speed relative to each pad's (n, p) [m/s], force-weighted and smoothed.

    It is NaN without contact.
    """
    n, p = grasp.link_m.shape[:2]
    on_pads = (grasp.pad_row >= 0) & (grasp.step_index > 0) & (grasp.step_index < n - 1)
    step, pad, point = grasp.step_index[on_pads], grasp.pad_row[on_pads], grasp.point_m[on_pads]
    on_link = np.einsum("kji,kj->ki", grasp.link_rotation[step, pad], point - grasp.link_m[step, pad])

    def positions(steps: NDArray[np.intp]) -> FloatArray:
        return np.asarray(
            np.einsum("kij,kj->ki", grasp.link_rotation[steps, pad], on_link) + grasp.link_m[steps, pad]
        )

    link = (positions(step + 1) - positions(step - 1)) / (2 * TIME_STEP_S)
    object_velocity = grasp.object_velocity_m_s[step] + np.cross(
        grasp.object_angular_velocity_rad_s[step], point - grasp.object_m[step]
    )
    normal = np.empty_like(point)
    for row, model_pad in enumerate(grasp.pads):
        at_pad = pad == row
        foot = model_pad.shape.project((on_link[at_pad] - model_pad.translation_m) @ model_pad.rotation)
        on_pad = foot.normal @ model_pad.rotation.T
        normal[at_pad] = np.einsum("kij,kj->ki", grasp.link_rotation[step[at_pad], row], on_pad)
    force = np.maximum(-np.einsum("ki,ki->k", grasp.force_n[on_pads], normal), 0.0)
    relative = object_velocity - link
    relative -= normal * np.einsum("ki,ki->k", relative, normal)[:, None]
    total, moved = np.zeros((n, p)), np.zeros((n, p, 3))
    np.add.at(total, (step, pad), force)
    np.add.at(moved, (step, pad), force[:, None] * relative)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.linalg.norm(moved, axis=2) / total
    return np.stack([_smooth(speed[:, row]) for row in range(p)], axis=1)


def _smooth(speed: FloatArray) -> FloatArray:
    """Return the mean of the known values over `_SMOOTHING_STEPS`; NaN where the value itself is unknown."""
    known = np.isfinite(speed)
    ones = np.ones(_SMOOTHING_STEPS)
    weight = np.convolve(known, ones, "same")
    mean = np.convolve(np.where(known, speed, 0.0), ones, "same") / np.maximum(weight, 1)
    return np.asarray(np.where(known, mean, np.nan))


def onsets(speed: FloatArray) -> list[int]:
    """Return the steps at which a contact, gripped for 100 ms, begins to slip."""
    found = []
    firm = 0
    for step, now in enumerate(speed.tolist()):
        if now > MIN_SLIP_M_S and firm >= _FIRM_STEPS:
            still = np.flatnonzero(speed[:step] < MAX_GRIP_M_S)
            onset = int(still[-1]) + 1 if len(still) else step
            if onset not in found:  # slower for a while, but not gripped: the same slip
                found.append(onset)
        firm = firm + 1 if now < MIN_SLIP_M_S else 0
    return found


def slips(
    run: Served,
    labels: Sequence[str] = ALARMS,
    kinds: Sequence[str] = ("motion",),
    lead_s: float = _MAX_LEAD_S,
    on: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Return delays [s] of alarms after onsets (inf: none), of the detector.

    Also the seconds of firm grip, and the alarms in them; and the undetected slips that began while an alarm
    stood. An alarm has one of `labels` in a percept of one of
    `kinds`, and is of an onset from `lead_s` before it on. on: links that count, by default all.
    """
    speed, links = speeds(run.grasp), [pad.link for pad in run.grasp.pads]
    alarms: list[list[float]] = [[] for _ in links]
    alarmed: list[set[str]] = [set() for _ in links]
    ends: list[list[float]] = [[] for _ in links]
    for percept in run.percepts:
        if percept.kind not in kinds:
            continue
        row = links.index(percept.link)
        if percept.label not in labels:
            if alarmed[row] == {percept.kind}:
                ends[row].append((percept.t_ns - _START_NS) * 1e-9)
            alarmed[row].discard(percept.kind)
            continue
        if not alarmed[row]:
            alarms[row].append((percept.t_ns - _START_NS) * 1e-9)
        alarmed[row].add(percept.kind)
    found: dict[str, Any] = {"delays": [], "firm_s": 0.0, "false": 0, "rolls": 0, "between": 0, "late": 0}
    found["standing"] = 0
    found["kinds"] = []
    for row, pad in enumerate(run.grasp.pads):
        if on is not None and pad.link not in on:
            continue
        in_contact = np.zeros(len(speed), np.bool_)
        for begin, end in run.spans[row]:
            in_contact[round(begin / TIME_STEP_S) : round(end / TIME_STEP_S)] = True
        firm = _lasting(in_contact & (speed[:, row] < MAX_GRIP_M_S), _FIRM_STEPS)
        slipping = speed[:, row] > MIN_SLIP_M_S
        found["firm_s"] += firm.sum() * TIME_STEP_S
        for alarm_s in alarms[row]:
            kind = _kind(alarm_s, firm, slipping)
            found[kind] += 1
            found["rolls"] += kind == "false" and _rolls(run, row, pad, round(alarm_s / TIME_STEP_S))
        for onset in onsets(np.where(in_contact, speed[:, row], np.nan)):
            lost = np.flatnonzero(~in_contact[onset:])
            until = (onset + int(lost[0]) if len(lost) else len(in_contact)) * TIME_STEP_S
            if until - onset * TIME_STEP_S < 0.02:
                continue
            found["delays"].append(_delay(onset * TIME_STEP_S, until, alarms[row], lead_s))
            stands = any(
                begin_s < onset * TIME_STEP_S - lead_s and end_s > onset * TIME_STEP_S
                for begin_s, end_s in itertools.zip_longest(alarms[row], ends[row], fillvalue=np.inf)
            )
            found["standing"] += stands and not np.isfinite(found["delays"][-1])
            found["kinds"].append(_slip_kind(run, row, pad, speed[:, row], onset, round(until / TIME_STEP_S)))
    return found


def _delay(onset_s: float, until_s: float, alarms: Sequence[float], lead_s: float = _MAX_LEAD_S) -> float:
    return min(
        (
            alarm_s - onset_s
            for alarm_s in alarms
            if onset_s - lead_s <= alarm_s <= min(until_s, onset_s + _MAX_DELAY_S)
        ),
        default=np.inf,
    )


def _lasting(on: BoolArray, min_steps: int) -> BoolArray:
    """Return where `on` has been true for `min_steps`, and remains true for 50 more."""
    count, found = 0, np.zeros_like(on)
    for step, now in enumerate(on.tolist()):
        count = count + 1 if now else 0
        found[step] = count > min_steps
    ahead = np.concatenate([on[50:], np.zeros(50, np.bool_)])
    return np.asarray(found & ahead)


def _path(run: Served, row: int, pad: MujocoPad, steps: slice) -> FloatArray:
    """Return the known positions (k, 2) [m] of the centre of force on a pad."""
    sides = np.array([pad.shape.length_m, pad.shape.arc * float(pad.shape.radius(pad.shape.length_m / 2))])
    path = run.patches.force_centre[steps, row] * sides
    return np.asarray(path[np.isfinite(path).all(axis=1)])


def _rolls(run: Served, row: int, pad: MujocoPad, step: int) -> bool:
    """Return whether the centre of force moves on the pad by more than 0.2 mm in the last 0.1 s."""
    known = _path(run, row, pad, slice(max(step - 100, 0), step + 1))
    return bool(len(known) and np.linalg.norm(known[-1] - known[0]) > MIN_ROLL_M)


def _slip_kind(run: Served, row: int, pad: MujocoPad, speed: FloatArray, onset: int, until: int) -> str:
    """Return what makes a slip hard to detect, one of KINDS."""
    last = min(until, onset + round(_MAX_DELAY_S / TIME_STEP_S))
    fast = np.flatnonzero(speed[onset:last] > MIN_SLIP_M_S)
    stop = onset + int(fast[0]) if len(fast) else onset
    while stop < last and speed[stop] > MAX_GRIP_M_S:
        stop += 1
    if float(np.nansum(speed[onset:stop])) * TIME_STEP_S < MIN_SLIP_M:
        return KINDS[0]
    if (until - onset) * TIME_STEP_S < MIN_LASTING_S:
        return KINDS[1]
    known = _path(run, row, pad, slice(onset, last))
    moved = np.linalg.norm(known - known[:1], axis=1).max() if len(known) else 0.0
    return KINDS[2] if moved < DETECTED_M else KINDS[3]


def _kind(alarm_s: float, firm: BoolArray, slipping: BoolArray) -> str:
    """Classify an alarm: false, late (of a slip), or between."""
    step = min(round(alarm_s / TIME_STEP_S), len(firm) - 1)
    if firm[step]:
        return "false"
    return "late" if slipping[max(step - 50, 0) : step + 10].any() else "between"


def _number(percept: wire.Percept, name: str) -> float:
    value = percept.values.get(name)
    return float(value) if isinstance(value, int | float) else float("nan")


# Shape ------------------------------------------------------------------------------------------------------


def shaped(run: Served) -> dict[str, Any]:
    """Return the last shape percept before the object is pulled."""
    last = None
    for percept in run.percepts:
        held = (percept.t_ns - _START_NS) * 1e-9 < PULLED_S
        if percept.kind == "shape" and not percept.link and held:
            last = percept
    held_object = run.grasp.grasped_object
    factor = 1 if held_object.kind == "sphere" else 2
    true_mm = 0.0 if held_object.kind == "box" else 1e3 / held_object.curvature / factor
    row = {"case": held_object.name, "truth": SHAPES[held_object.name], "radius mm": true_mm}
    if last is None:
        return row | {"state": "nothing"}
    return row | {
        "touches": last.evidence.get("contacts", 0),
        "state": last.state,
        "label": last.label or max(last.probabilities, key=last.probabilities.__getitem__, default="-"),
        "probability of the truth": last.probabilities.get(SHAPES[held_object.name], 0.0),
        "reported mm": 1e3 * _number(last, "radius_m"),
        "its std": 1e3 * _number(last, "radius_m_std"),
        "object": last.values.get("object", "-"),
    }


# Tables -----------------------------------------------------------------------------------------------------


def together(some: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of several runs."""
    delays = np.array([delay for of in some for delay in of["delays"]])
    return _delays(delays) | {
        "minutes": sum(of["firm_s"] for of in some) / 60,
        **{key: sum(of[key] for of in some) for key in ("false", "rolls", "between", "standing")},
    }


def slip_row(case: str, some: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return a row of the table of slips."""
    of = together(some)
    return {
        "case": case,
        "slips": of["slips"],
        "detected, %": Share(of["detected"], of["slips"]),
        "precision, %": Share(of["detected"], of["detected"] + of["false"]),
        "ms, 50 / 95 %": [of["ms"], of["ms_95"]],
        "min of grip": of["minutes"],
        "false": of["false"],
        "rolling": of["rolls"],
        "false per hour of grip": Rate(of["false"], of["minutes"] / 60) if of["minutes"] else None,
        "others": of["between"],
        "standing": of["standing"],
    }


def _of_kind(kind: str, some: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the slips of a kind, and how many are detected."""
    delays = [d for of in some for d, k in zip(of["delays"], of["kinds"], strict=True) if k == kind]
    found = _delays(np.array(delays))
    return {"slips": kind, "number": found["slips"], "detected, %": Share(found["detected"], found["slips"])}


def _delays(delays: FloatArray) -> dict[str, Any]:
    found = np.isfinite(delays)
    low, high = np.percentile(1e3 * delays[found], [50, 95]) if found.any() else (np.nan, np.nan)
    return {
        "slips": len(delays),
        "detected": int(found.sum()),
        "ms": float(low),
        "ms_95": float(high),
    }


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--objects", nargs="+", default=list(GRASP_OBJECTS), choices=list(GRASP_OBJECTS))
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.objects = 1, args.objects[:1]
    import mujoco

    plain: Deployment = load(shipped.path("utah_mit.toml"))
    hand = plain.hands[0].model_copy(update=STATED)
    deployment = plain.model_copy(update={"hands": (hand, *plain.hands[1:])})
    runs = []
    for seed in range(1, args.seeds + 1):
        for name in args.objects:
            runs.append(served(deployment, name, seed, drawn_world("default", seed), perceive=True))
            progress(f"seed {seed}: {name}, {len(runs[-1].percepts)} percepts")
    runs.sort(key=lambda run: args.objects.index(run.grasp.grasped_object.name))
    by_run = [(run.grasp.grasped_object.name, slips(run)) for run in runs]
    every = [of for _, of in by_run]
    rows = [slip_row(name, [of for own, of in by_run if own == name]) for name in args.objects]
    rows.append(slip_row("all", every))
    rows.append(slip_row("all, `sliding` alone", [slips(run, ALARMS[1:]) for run in runs]))
    for world in ("ideal", "harsh"):
        others = [served(deployment, name, 1, drawn_world(world, 1), perceive=True) for name in args.objects]
        rows.append(slip_row(f"seed 1, world `{world}`", [slips(run, ALARMS) for run in others]))
        progress(f"world {world}")
    report = Report(args.quick, MuJoCo=mujoco.__version__, seeds=args.seeds)
    report.table("Slip", rows)
    report.table("What makes slips hard", [_of_kind(kind, every) for kind in KINDS])
    report.table("Shape", [shaped(run) for run in runs])
    report.keep()


if __name__ == "__main__":
    main()
