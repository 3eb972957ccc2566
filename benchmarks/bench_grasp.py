"""Contacts of grasps, against MuJoCo's ground truth: positions in the palm, forces, begins and ends.

The shipped hand closes on a ball, a box, a pen and a cup, squeezes twice, and each is pulled out of the hand,
slipping. MuJoCo computes contact positions and forces; the simulator's sheets convert them to counts, and the
daemon's pipeline converts those to contacts, at 200 Hz. Unknown to the daemon is what the
[world](../worlds.md) `default` draws for seeds of the reporting family: parts, sheets, drift, mounting of
each pad, zeros and noise of joints; contact radii are MuJoCo's. The file describes sheets as their builder
would, and states the tolerances of parts as the world draws them, `mount_std_mm = 0.2` and `mount_std_deg =
0.5`. Joint states at 100 Hz are 3 ms (`default`) older than their time stamps and arrive 2 ms later. Quick:
--seeds 1 --objects ball.

*Position error*: the four components sum, as vectors, to the whole error. *Pad position*: error on the pad;
*kinematics*: zeros and noise of the joints; *time*: motion of the joints since their last state. Ground truth
is the centre of force; for a load along a line or on two points the currents give another centre. *Within the
95 % region*: one sample of each touch; touches of one pad share its mount and parts, so *mean of pads* counts
each pad of each hand once.

*Force*: *consistent* is within the 95 % interval of the reported standard deviation, or not below a lower
bound. The estimate assumes one patch of 2.5 mm radius, with a standard deviation of 0.5 mm; those of MuJoCo
follow Hertz's law for a skin of 1 MPa. *At an edge*: nearer than that radius. Then the same grasps with
`hertz_force_n = 1.0` stated for the sheets, so that the radius is 2.5 mm there and grows as force^(1/3).

*Begin and end*: objects chatter in MuJoCo as they slip. First, contacts against those of an ideal pad, with
exact samples of MuJoCo's forces and the same thresholds and debouncing; then against MuJoCo's own 1 kHz,
ignoring gaps of touches and contacts shorter than a limit. A touch is a pad's force above
`begin_threshold_n`, until below `end_threshold_n`. *Short*: less than 20 ms, too short for two samples each
for begin and end; they count neither as missed nor as false. *Too weak*: presses that never reached
`begin_threshold_n`. *Late*: reported more than 25 ms after the begin. Delays are median / 95 %; F1 within 10
/ 20 / 50 / 100 ms. *At the end of the range*: samples of a pad with such a channel, at which a contact ends,
as `faulted`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from benchmarks.page import Report, options, progress
from benchmarks.scores import Share

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.event_score import EventScore
from benchmarks.grasp_run import PARTS, Served, against, at_best, drawn_world, served
from handtouch.config import (
    Deployment,
    load,
    shipped,
)
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S

FloatArray = NDArray[np.float64]
WINDOWS_S = (0.010, 0.020, 0.050, 0.100)
GAPS_S = (0.010, 0.030, 0.100)
ONE_PATCH_M = 5.5e-3
STATED = {"mount_std_mm": 0.2, "mount_std_deg": 0.5}
HERTZ_FORCE_N = 1.0
"""At which objects of some centimetres have the sheets' 2.5 mm in a skin of 1 MPa."""
_WITHIN_95 = {2: 5.991, 3: 7.815}  # chi squared


def length_mm(runs: Sequence[Served], of: Callable[[Served], FloatArray], wide: bool | None) -> FloatArray:
    """Return lengths of the error vectors of all samples, or of those with `wide` patches, or without."""
    return np.concatenate([1e3 * np.linalg.norm(of(run)[chosen(run, wide)], axis=1) for run in runs])


def total(run: Served) -> FloatArray:
    return np.asarray(run.palm_m - run.true_m)


def error_part(run: Served, part: str) -> FloatArray:
    return run.error_m[part]


def position_row(case: str, runs: Sequence[Served], wide: bool | None = None) -> dict[str, Any]:
    """Return the number of samples, and median and 95 % of the error [mm] by cause."""
    errors: dict[str, Callable[[Served], FloatArray]] = {"all": total}
    errors |= {part: partial(error_part, part=part) for part in PARTS}
    lengths = {name: length_mm(runs, error, wide) for name, error in errors.items()}
    return {"case": case, "samples": len(lengths["all"])} | {
        "pad position" if name == "pad" else name: np.percentile(length, [50, 95]) if len(length) else None
        for name, length in lengths.items()
    }


def covered(
    case: str, runs: Sequence[Served], wide: bool | None = None, stated: bool = True
) -> dict[str, Any]:
    """Return touches, the share within the reported 95 % region, also as the mean over the pads of all hands,
    and median reported std [mm].

    One sample of each touch, as samples of one touch share its errors; touches of one pad share its mount and
    parts. Without stated mounts the region is flat, and errors count in its plane.
    """
    inside, size, dimensions = [], [], 3 if stated else 2
    of_pads: dict[tuple[int, int], list[bool]] = {}
    for run in runs:
        rows = chosen(run, wide) & one_of_each_touch(run)
        values, axes = np.linalg.eigh(run.covariance_m2[rows])
        along = np.einsum("kji,kj->ki", axes, total(run)[rows])[:, -dimensions:]
        squared = (along**2 / np.maximum(values[:, -dimensions:], 1e-18)).sum(1)
        inside.append(squared < _WITHIN_95[dimensions])
        for pad, within in zip(run.pad[rows].tolist(), inside[-1].tolist(), strict=True):
            of_pads.setdefault((run.seed, pad), []).append(within)
        size.append(1e3 * np.sqrt(values.sum(1)))
    all_inside, sizes = np.concatenate(inside), np.concatenate(size)
    return {
        "case": case,
        "touches": len(sizes),
        "within": Share.of_mask(all_inside),
        "pads": len(of_pads),
        "mean of pads": 100 * float(np.mean([np.mean(own) for own in of_pads.values()])) if of_pads else None,
        "reported std, mm": float(np.median(sizes)) if len(sizes) else None,
    }


def one_of_each_touch(run: Served) -> NDArray[np.bool_]:
    """Return the mask (k,) of the sample nearest the middle of each reported contact."""
    mask = np.zeros(len(run.step), np.bool_)
    for pad, spans in enumerate(run.spans):
        own = np.flatnonzero(run.pad == pad)
        for begin_s, end_s in spans if len(own) else []:
            middle = (begin_s + end_s) / 2
            nearest = own[np.argmin(np.abs(run.step[own] * TIME_STEP_S - middle))]
            mask[nearest] |= begin_s <= run.step[nearest] * TIME_STEP_S <= end_s
    return mask


def chosen(run: Served, wide: bool | None) -> NDArray[np.bool_]:
    """Return the mask (k,) of samples with wide patches, or without; None: all."""
    radius = run.patches.effective_radius_m[run.step, run.pad]
    is_wide = np.asarray(radius > ONE_PATCH_M)
    return np.ones(len(radius), np.bool_) if wide is None else is_wide == wide


def bound(run: Served) -> NDArray[np.bool_]:
    """Return the mask (k,) of samples whose force is a lower bound."""
    return np.asarray(np.isnan(run.force_std_n))


def kinds(deployment: Deployment) -> dict[str, Callable[[Served], NDArray[np.bool_]]]:
    """Return masks of samples by the cause of their force error."""
    sheets = [deployment.sheets[pad.sheet] for pad in deployment.hands[0].pads]
    radius = 1e-3 * np.array([it.contact_radius_mm for it in sheets])
    std = 1e-3 * np.array([it.contact_radius_std_mm for it in sheets])

    def off(run: Served) -> FloatArray:
        """Return the deviation of the radius from the assumed one, in standard deviations."""
        return np.asarray(
            (run.patches.effective_radius_m[run.step, run.pad] - radius[run.pad]) / std[run.pad]
        )

    def rim(run: Served) -> NDArray[np.bool_]:
        centre = run.patches.force_centre[run.step, run.pad]
        sides = np.array(
            [(p.shape.length_m, p.shape.arc * p.shape.radius(p.shape.length_m / 2)) for p in run.grasp.pads]
        )
        near_m = ((0.5 - np.abs(centre - 0.5)) * sides[run.pad]).min(axis=1)
        return np.asarray(near_m < radius[run.pad])

    def plain(run: Served) -> NDArray[np.bool_]:
        return ~bound(run) & chosen(run, False) & ~rim(run)

    return {
        "all values": lambda run: ~bound(run),
        "one patch, radius within 2 sigma": lambda run: plain(run) & (np.abs(off(run)) <= 2),
        "one patch, smaller": lambda run: plain(run) & (off(run) < -2),
        "one patch, larger": lambda run: plain(run) & (off(run) > 2),
        "one patch at an edge": lambda run: ~bound(run) & chosen(run, False) & rim(run),
        "a line or face, or several patches": lambda run: ~bound(run) & chosen(run, True),
        "lower bounds, one patch": lambda run: bound(run) & chosen(run, False),
        "lower bounds, the rest": lambda run: bound(run) & chosen(run, True),
    }


def forces(case: str, runs: Sequence[Served], mask: Callable[[Served], NDArray[np.bool_]]) -> dict[str, Any]:
    """Return errors [N] of some samples, reported over true force, and the fraction of consistent ones.

    Consistent is a true force within the reported 95 % interval, or not below a lower bound.
    """
    rows = []
    for run in runs:
        on = mask(run) & np.isfinite(run.force_n)
        rows.append(np.stack([run.force_n[on], run.true_n[on], run.force_std_n[on]]))
    reported, true, std = np.concatenate(rows, axis=1)
    if not len(reported):
        return {"case": case, "samples": 0}
    error = reported - true
    consistent = np.where(np.isnan(std), error <= 0, np.abs(error) < 1.96 * std)
    return {
        "case": case,
        "samples": len(reported),
        "true rms": float(np.sqrt(np.mean(true**2))),
        "rms error": float(np.sqrt(np.mean(error**2))),
        "median error": float(np.median(np.abs(error))),
        "reported / true": float(np.median(reported / true)),
        "consistent": f"{consistent.mean():.0%}",
    }


def event_row(
    case: dict[str, Any], runs: Sequence[Served], compare: Callable[[Served], EventScore]
) -> dict[str, Any]:
    """Return the scores of begins and ends."""
    events = EventScore()
    for run in runs:
        events.add(compare(run))
    return case | {
        "touches": events.touches,
        "short": events.short_touches,
        "too weak": events.below_threshold,
        "missed": events.missed,
        "false": events.false_positives,
        "late": events.late,
        "begin ms": 1e3 * np.percentile(events.begin_delays_s, [50, 95]),
        "end ms": 1e3 * np.percentile(events.end_delays_s, [50, 95]),
        "F1, begins": [events.f1(window) for window in WINDOWS_S],
        "F1, ends": [events.f1(window, "ends") for window in WINDOWS_S],
    }


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--objects", nargs="+", default=list(GRASP_OBJECTS), choices=list(GRASP_OBJECTS))
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.objects = 1, args.objects[:1]
    import mujoco

    deployment = load(shipped.path("utah_mit.toml"))
    stated_hand = deployment.hands[0].model_copy(update=STATED)
    stated = deployment.model_copy(update={"hands": (stated_hand, *deployment.hands[1:])})
    runs: dict[str, list[Served]] = {name: [] for name in args.objects}
    sheets = {
        name: sheet.model_copy(update={"hertz_force_n": HERTZ_FORCE_N})
        for name, sheet in stated.sheets.items()
    }
    growing = stated.model_copy(update={"sheets": sheets})
    hertz: list[Served] = []
    ideal, harsh, unstated = [], [], []
    for seed in range(1, args.seeds + 1):
        for name in args.objects:
            setting = drawn_world("default", seed)
            run = served(stated, name, seed, setting)
            runs[name].append(run)
            hertz.append(served(growing, name, seed, setting, done=run.grasp))
            if seed == 1:
                ideal.append(served(deployment, name, seed, drawn_world("ideal", seed)))
                harsh.append(served(stated, name, seed, drawn_world("harsh", seed)))
                unstated.append(served(deployment, name, seed, setting, done=run.grasp))
            progress(f"seed {seed}: {name}, {len(run.step)} contact samples")
    report = Report(args.quick, MuJoCo=mujoco.__version__, seeds=args.seeds)
    every, touch, masks = [run for of in runs.values() for run in of], deployment.touch, kinds(deployment)
    cases = {**runs, "all": every, "seed 1, world `ideal`": ideal, "seed 1, world `harsh`": harsh}
    rows = [position_row(name, of) for name, of in cases.items()]
    rows.append(position_row("one patch", every, False))
    rows.append(position_row("a line or face, or several patches", every, True))
    rows.append(position_row("joints moving faster than 0.5 rad/s", [moving(run) for run in every]))
    report.table("Position error in the palm, mm, median / 95 %", rows)
    rows = [covered("all", every), covered("one patch", every, False)]
    rows.append(covered("a line or face, or several patches", every, True))
    rows.append(covered("seed 1, world `harsh`", harsh))
    rows.append(covered("seed 1, mounts not stated", unstated, stated=False))
    report.table("True positions within the 95 % region", rows)
    report.table("Force, N", [forces(name, every, mask) for name, mask in masks.items()])
    rows = [forces(name, hertz, mask) for name, mask in masks.items()]
    report.table("Force, N, with hertz_force_n stated", rows)
    best = partial(at_best, touch=touch)
    rows = [event_row({"case": name}, of, best) for name, of in cases.items()]
    report.table("Begin and end, against an ideal pad", rows)
    rows = [
        event_row({"gap, ms": 1e3 * gap}, every, partial(against, touch=touch, min_gap_s=gap))
        for gap in GAPS_S
    ]
    report.table("Begin and end, against 1 kHz", rows)
    row = {
        "samples at the end of the range": sum(run.railed for run in every),
        "force beside the pads, %": 100 * np.mean([run.patches.force_fraction_off_pad for run in every]),
    }
    report.table("Not sensed", [row])
    report.keep()


def moving(run: Served) -> Served:
    """Return the samples at which a joint moves."""
    on = run.moving_rad_s > 0.5
    names = (
        "step",
        "pad",
        "palm_m",
        "covariance_m2",
        "true_m",
        "force_n",
        "force_std_n",
        "true_n",
        "moving_rad_s",
    )
    some: dict[str, Any] = {name: getattr(run, name)[on] for name in names}
    return replace(run, **some, error_m={part: error[on] for part, error in run.error_m.items()})


if __name__ == "__main__":
    main()
