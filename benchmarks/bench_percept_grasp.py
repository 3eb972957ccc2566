"""Compare percepts of grasps with MuJoCo's ground truth: slip, shape.

The shipped hand closes on a ball, a box, a pen and a cup, squeezes twice, and each is pulled out of the hand,
slipping, in the world `default`. Writes
docs/benchmarks/percept_grasp.{md,json}. Quick: --seeds 1 --objects ball.
"""

from __future__ import annotations

import itertools
import json
import os
import platform
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.page import made_by, options, output_folder, progress

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.grasp_run import Served, drawn_world, served
from benchmarks.scores import Rate, Share
from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.core.slip import GripModel
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
MIN_JUMP_M = 0.1e-3
"""Way of the centre of force in a step of 1 ms, as of a load that shifts to another part of the pad."""
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
CAUSES = ("load shifts to another part of the pad", "contact rolls", "others")
SHAPES = {"ball": "sphere", "box": "flat", "pen": "cylinder", "cup": "cylinder"}
ALARMS = ("incipient", "sliding")
FALSE_PER_MINUTE = (20.0, 40.0)
"""False alarms per minute allowed to a threshold on the rate of force, besides those of the detector."""
RATES_HZ = np.geomspace(0.5, 200, 40)


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
    """Return delays [s] of alarms after onsets (inf: none), of the detector and of the rate of force.

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
    by_rate = [_rates(run, row) for row in range(len(links))]
    found: dict[str, Any] = {"delays": [], "firm_s": 0.0, "false": 0, "rolls": 0, "between": 0, "late": 0}
    found["standing"] = 0
    found |= {"rate_delays": [[] for _ in RATES_HZ], "rate_false": [0] * len(RATES_HZ), "short": 0}
    found |= {"kinds": [], "causes": Counter()}
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
            if kind == "false":
                found["causes"][_cause(run, row, pad, round(alarm_s / TIME_STEP_S))] += 1
        for number, rate in enumerate(RATES_HZ.tolist()):
            crossings = _crossings(by_rate[row], rate)
            found["rate_false"][number] += sum(
                _kind(time_s, firm, slipping) == "false" for time_s in crossings
            )
        for onset in onsets(np.where(in_contact, speed[:, row], np.nan)):
            lost = np.flatnonzero(~in_contact[onset:])
            until = (onset + int(lost[0]) if len(lost) else len(in_contact)) * TIME_STEP_S
            if until - onset * TIME_STEP_S < 0.02:
                found["short"] += 1
                continue
            found["delays"].append(_delay(onset * TIME_STEP_S, until, alarms[row], lead_s))
            stands = any(
                begin_s < onset * TIME_STEP_S - lead_s and end_s > onset * TIME_STEP_S
                for begin_s, end_s in itertools.zip_longest(alarms[row], ends[row], fillvalue=np.inf)
            )
            found["standing"] += stands and not np.isfinite(found["delays"][-1])
            found["kinds"].append(_slip_kind(run, row, pad, speed[:, row], onset, round(until / TIME_STEP_S)))
            for number, rate in enumerate(RATES_HZ.tolist()):
                found["rate_delays"][number].append(
                    _delay(onset * TIME_STEP_S, until, _crossings(by_rate[row], rate))
                )
    return found


def _rates(run: Served, row: int) -> tuple[FloatArray, FloatArray]:
    """Return times (k,) [s] of a pad's samples, and the relative rates of its force there [1/s]."""
    rows = np.flatnonzero((run.pad == row) & np.isfinite(run.force_n))
    order = rows[np.argsort(run.step[rows], kind="stable")]
    times_s, force = run.step[order] * TIME_STEP_S, run.force_n[order]
    dt_s = np.diff(times_s)
    rate = np.where(dt_s < 0.008, np.abs(np.diff(force)) / np.maximum(dt_s, 1e-3) / force[1:], 0.0)
    return np.asarray(times_s[1:]), np.asarray(rate)


def _crossings(series: tuple[FloatArray, FloatArray], rate: float) -> list[float]:
    """Return the times at which a rate of force rises above a threshold."""
    times_s, rates = series
    above = rates > rate
    first = above & ~np.concatenate([[False], above[:-1]]) if len(above) else above
    return list(times_s[first].tolist())


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


def _cause(run: Served, row: int, pad: MujocoPad, step: int) -> str:
    """Return what happened in the 0.1 s before a false alarm, one of CAUSES."""
    known = _path(run, row, pad, slice(max(step - 100, 0), step + 1))
    if len(known) > 1 and np.linalg.norm(np.diff(known, axis=0), axis=1).max() > MIN_JUMP_M:
        return CAUSES[0]
    return CAUSES[1] if _rolls(run, row, pad, step) else CAUSES[2]


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
    if last is None:
        return {"held_object": held_object.name, "state": "nothing", "true_mm": true_mm}
    return {
        "held_object": held_object.name,
        "state": last.state,
        "label": last.label or max(last.probabilities, key=last.probabilities.__getitem__, default="-"),
        "reason": last.reason,
        "probability": last.probabilities.get(SHAPES[held_object.name], 0.0),
        "radius_mm": 1e3 * _number(last, "radius_m"),
        "radius_std_mm": 1e3 * _number(last, "radius_m_std"),
        "true_mm": true_mm,
        "contacts": last.evidence.get("contacts", 0),
        "object": last.values.get("object", "-"),
    }


# The page ---------------------------------------------------------------------------------------------------


def collect(runs: Sequence[Served]) -> dict[str, Any]:
    """Return all figures."""
    by_run = [(run.grasp.grasped_object.name, slips(run)) for run in runs]
    names = list(dict.fromkeys(name for name, _ in by_run))
    figures: dict[str, Any] = {"slip": {}, "shape": [shaped(run) for run in runs]}
    for name in [*names, "**all**"]:
        some = [of for object_name, of in by_run if name in (object_name, "**all**")]
        figures["slip"][name] = together(some)
    figures["slip"]["all, `sliding` alone"] = together([slips(run, ALARMS[1:]) for run in runs])
    figures["kinds"] = [_of_kind(kind, [of for _, of in by_run]) for kind in KINDS]
    figures["causes"] = {cause: sum(of["causes"][cause] for _, of in by_run) for cause in CAUSES}
    figures["rate"] = _of_rate([of for _, of in by_run], figures["slip"]["**all**"])
    minutes = figures["slip"]["**all**"]["minutes"]
    figures["rates"] = [
        _of_rate([of for _, of in by_run], {"false": allowed * minutes, "minutes": minutes})
        for allowed in FALSE_PER_MINUTE
    ]
    return figures


def together(some: Sequence[dict[str, Any]]) -> dict[str, Any]:
    delays = np.array([delay for of in some for delay in of["delays"]])
    minutes = sum(of["firm_s"] for of in some) / 60
    false = sum(of["false"] for of in some)
    return _delays(delays) | {
        "short": sum(of["short"] for of in some),
        "minutes": minutes,
        "false": false,
        "rolls": sum(of["rolls"] for of in some),
        "false_per_minute": false / minutes if minutes else np.nan,
        "between": sum(of["between"] for of in some),
        "standing": sum(of["standing"] for of in some),
    }


def _of_kind(kind: str, some: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the slips of a kind, and how many are detected."""
    delays = [d for of in some for d, k in zip(of["delays"], of["kinds"], strict=True) if k == kind]
    return {"kind": kind} | _delays(np.array(delays))


def _delays(delays: FloatArray) -> dict[str, Any]:
    found = np.isfinite(delays)
    low, high = np.percentile(1e3 * delays[found], [50, 95]) if found.any() else (np.nan, np.nan)
    return {
        "slips": len(delays),
        "detected": int(found.sum()),
        "found": float(found.mean()) if len(delays) else np.nan,
        "ms": float(low),
        "ms_95": float(high),
    }


def _of_rate(some: Sequence[dict[str, Any]], detector: dict[str, Any]) -> dict[str, Any]:
    """Return figures of the threshold on the rate of force with no more false alarms than the detector."""
    false = np.sum([of["rate_false"] for of in some], axis=0)
    allowed = np.flatnonzero(false <= detector["false"])
    number = int(allowed[0]) if len(allowed) else len(RATES_HZ) - 1
    delays = np.array([delay for of in some for delay in of["rate_delays"][number]])
    minutes = detector["minutes"]
    return _delays(delays) | {
        "threshold_per_s": float(RATES_HZ[number]),
        "false_per_minute": float(false[number] / minutes) if minutes else np.nan,
    }


def write(figures: dict[str, Any], seeds: int, out: Path) -> str:
    """Write the page; return its text."""
    slip_rows = "\n".join(
        f"| {name} | {of['slips']} | {Share(of['detected'], of['slips'])} "
        f"| {Share(of['detected'], of['detected'] + of['false'])} | {of['ms']:.0f} / {of['ms_95']:.0f} "
        f"| {of['minutes']:.1f} | {of['false']} ({of['rolls']}) | {_per_minute(of)} | {of['between']} |"
        for name, of in figures["slip"].items()
    )
    rate = figures["rate"]
    grip, slip, after = f"{1e3 * MAX_GRIP_M_S:.0f}", f"{1e3 * MIN_SLIP_M_S:.0f}", f"{_MAX_DELAY_S:.1f}"
    threshold, rate_false = f"{rate['threshold_per_s']:.0f}", f"{rate['false_per_minute']:.1f}"
    if_more = " and ".join(f"{of['found']:.0%} (median {of['ms']:.0f} ms)" for of in figures["rates"])
    rate_found, rate_ms = f"{rate['found']:.0%}", f"{rate['ms']:.0f}"
    standing = figures["slip"]["**all**"]["standing"]
    on = f"MuJoCo {figures['mujoco']}, {platform.machine()}, Python {platform.python_version()}"
    kind_rows = "\n".join(
        f"| {of['kind']} | {of['slips']} | {Share(of['detected'], of['slips'])} |" for of in figures["kinds"]
    )
    causes = ", ".join(f"{cause}: {count}" for cause, count in figures["causes"].items())
    shape_rows = "\n".join(
        f"| {of['held_object']} | {SHAPES[of['held_object']]} | {of.get('contacts', 0)} | {of['state']} "
        f"| {of.get('label', '-')} | {of.get('probability', 0):.2f} | {of['true_mm']:.1f} "
        f"| {_size(of)} | {of.get('object', '-')} |"
        for of in figures["shape"]
    )
    text = f"""# Percepts of grasps, against MuJoCo's ground truth

The grasps of [grasp](grasp.md), {seeds} seeds of the reporting family, in the [world](../worlds.md)
`default` where no other is named; the daemon's pipeline computes all percepts at 200 Hz. {on}.

## Slip

Ground truth is the speed of the object's surface relative to a pad's, smoothed over 11 ms. Below {grip}
mm/s it is a grip (soft contacts creep), above {slip} mm/s a slip; its onset is the last time below the
first limit, after 0.1 s of grip. An alarm is `incipient` or `sliding`, published within {after} s and
before the contact ends.

| | slips | detected, % | precision, % | ms, 50 / 95 % | min of grip | false (rolling) | per min | others |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{slip_rows}

Intervals are 95 %; *ms*: delay of those detected, median and 95 %. *False*: during a grip, from 0.1 s
before to 50 ms after the alarm; in parentheses, those with the centre of force moving on the pad by more
than 0.2 mm in 0.1 s, as of a rolling finger. *Others*: during motion slower than a slip, or shortly before
its end. Of the slips in **all** that don't count as detected, {standing} began while an alarm, published more
than 10 ms before, still stood. A threshold on the rate of force, |dF/dt| / F > {threshold}
/s, set for at most as many false alarms ({rate_false} per minute), detects {rate_found}, median {rate_ms}
ms; with {FALSE_PER_MINUTE[0]:.0f} and {FALSE_PER_MINUTE[1]:.0f} per minute, {if_more}. Many of these
slips don't move the centroid: a ball or a rod pulled along under a fingertip keeps its contact position.
Only joints and other contacts can reveal them.

Slips by what makes them hard to detect, each in the first row that fits:

| slips | number | detected, % |
| --- | --- | --- |
{kind_rows}

A slip counts for the detector from {1e3 * DETECTED_M:g} mm, unless it is fast. False alarms by cause, in all
grasps: {causes}.

## Shape

The last percept before the object is pulled, 3.85 s after it was presented; the label is the most
probable class in any state. The box has no class of its own: pads touch its faces and edges, and
`invalid`, none of the shapes, is the correct answer. The cup is a cone with its mean radius. *Moves*: the
shape fits only if the object moved by about 2 mm between touches, which increases the standard deviation.

| | truth | touches | state | label | probability of the truth | radius mm | reported | object |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{shape_rows}

## Limitations

* Slip is detected by trees that were trained with grasps of these four objects, of the tuning family, in
  simulation. The figures are those of other seeds, sizes, poses, frictions and sheets, not of other kinds
  of objects or tasks. On a real hand they are a hypothesis.
* False alarms arise while fingers close on the object and roll on it, and where a load shifts between two
  points of a pad: the centroid moves as in a slip. Joints separate the two where their noise allows it;
  that of `harsh` hardly does.
* A relative velocity from joints is as accurate as their noise: 0.05 degrees leave some millimetres per
  second over 50 ms, and more if only one or two other contacts hold the object.
* Missed slips are short, last less than 0.1 s before the contact ends, or don't move the centroid: a flat
  side pulled along under flat pads. All pads slip simultaneously then, and none remains to measure the
  object's motion.
* An object that rotates by more than a few degrees in the hand, as a thin rod does, blurs its shape,
  though older touches have less weight. A fit with a moving object takes twice as long, the first time.

{made_by()}.
"""
    (out / "percept_grasp.md").write_text(text)
    (out / "percept_grasp.json").write_text(json.dumps(figures, indent=1) + "\n")
    return text


def _per_minute(of: dict[str, Any]) -> str:
    """Return the rate of false alarms with its interval."""
    if not of["minutes"]:
        return "-"
    rate = Rate(of["false"], of["minutes"] / 60)
    low, high = rate.interval
    return f"{rate.per_hour / 60:.1f} ({low / 60:.1f}-{high / 60:.1f})"


def _size(of: dict[str, Any]) -> str:
    radius, std = of.get("radius_mm", np.nan), of.get("radius_std_mm", np.nan)
    return f"{radius:.1f} +- {std:.1f}" if np.isfinite(radius) else "-"


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
    figures = {"mujoco": mujoco.__version__} | collect(runs)
    for world in ("ideal", "harsh"):
        others = [served(deployment, name, 1, drawn_world(world, 1), perceive=True) for name in args.objects]
        figures["slip"][f"seed 1, world `{world}`"] = together([slips(run, ALARMS) for run in others])
        progress(f"world {world}")
    print(write(figures, args.seeds, output_folder(args.quick)))


if __name__ == "__main__":
    main()
