"""Compare contacts of grasps with MuJoCo's ground truth: positions in the palm, forces, begins, ends.

The shipped hand closes on a ball, a box, a pen and a cup, squeezes, and loses them, in the world `default`;
for the first seed also in `ideal` and `harsh`. Writes docs/benchmarks/grasp.{md,json,png}. Quick: --seeds 1
--objects ball.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.page import made_by, options, output_folder, progress
from benchmarks.scores import Share

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import numpy as np
from numpy.typing import NDArray

from benchmarks.grasp_run import PARTS, Served, against, at_best, drawn_world, served
from handtouch.config import (
    Deployment,
    Touch,
    load,
    shipped,
)
from handtouch.simulate.grasp.event_score import EventScore
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
WINDOWS_S = (0.010, 0.020, 0.050, 0.100)
GAPS_S = (0.010, 0.030, 0.100)
ONE_PATCH_M = 5.5e-3
STATED = {"mount_std_mm": 0.2, "mount_std_deg": 0.5}
HERTZ_FORCE_N = 1.0
"""At which objects of some centimetres have the sheets' 2.5 mm in a skin of 1 MPa."""
_WITHIN_95 = {2: 5.991, 3: 7.815}  # chi squared
_COLOURS = ("#1f6fb4", "#2e8b57", "#e08214", "#8e44ad")
_INK = "#1a1a1a"


def length_mm(runs: Sequence[Served], of: Callable[[Served], FloatArray], wide: bool | None) -> FloatArray:
    """Return lengths of the error vectors of all samples, or of those with `wide` patches, or without."""
    return np.concatenate([1e3 * np.linalg.norm(of(run)[chosen(run, wide)], axis=1) for run in runs])


def total(run: Served) -> FloatArray:
    return np.asarray(run.palm_m - run.true_m)


def error_part(run: Served, part: str) -> FloatArray:
    return run.error_m[part]


def position_errors(runs: Sequence[Served], wide: bool | None = None) -> dict[str, Any]:
    """Return the number of samples, and median and 95 % of the error [mm] by cause."""
    errors: dict[str, Callable[[Served], FloatArray]] = {"all": total}
    errors |= {part: partial(error_part, part=part) for part in PARTS}
    lengths = {name: length_mm(runs, error, wide) for name, error in errors.items()}
    return {"samples": len(lengths["all"])} | {
        name: np.percentile(length, [50, 95]).tolist() if len(length) else [np.nan, np.nan]
        for name, length in lengths.items()
    }


def covered(runs: Sequence[Served], wide: bool | None = None, stated: bool = True) -> dict[str, Any]:
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
        "touches": len(sizes),
        "within": str(Share.of_mask(all_inside)),
        "pads": len(of_pads),
        "mean_of_pads": 100 * float(np.mean([np.mean(own) for own in of_pads.values()])) if of_pads else None,
        "std_mm": float(np.median(sizes)) if len(sizes) else None,
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


def forces(runs: Sequence[Served], mask: Callable[[Served], NDArray[np.bool_]]) -> dict[str, float]:
    """Return errors [N] of some samples, reported over true force, and the fraction of consistent ones.

    Consistent is a true force within the reported 95 % interval, or not below a lower bound.
    """
    rows = []
    for run in runs:
        on = mask(run) & np.isfinite(run.force_n)
        rows.append(np.stack([run.force_n[on], run.true_n[on], run.force_std_n[on]]))
    reported, true, std = np.concatenate(rows, axis=1)
    if not len(reported):
        return {"samples": 0}
    error = reported - true
    consistent = np.where(np.isnan(std), error <= 0, np.abs(error) < 1.96 * std)
    return {
        "samples": len(reported),
        "true_rms_n": float(np.sqrt(np.mean(true**2))),
        "rms_n": float(np.sqrt(np.mean(error**2))),
        "median_n": float(np.median(np.abs(error))),
        "ratio": float(np.median(reported / true)),
        "consistent": float(consistent.mean()),
    }


def event_figures(runs: Sequence[Served], compare: Callable[[Served], EventScore]) -> dict[str, Any]:
    """Return the scores of begins and ends."""
    events = EventScore()
    for run in runs:
        events.add(compare(run))
    return {
        **{
            name: getattr(events, name)
            for name in ("touches", "short_touches", "below_threshold", "missed", "false_positives", "late")
        },
        "begin_ms": (1e3 * np.percentile(events.begin_delays_s, [50, 95])).tolist(),
        "end_ms": (1e3 * np.percentile(events.end_delays_s, [50, 95])).tolist(),
        "f1_begin": [events.f1(window) for window in WINDOWS_S],
        "f1_end": [events.f1(window, "ends") for window in WINDOWS_S],
    }


def pair(values: Sequence[float]) -> str:
    return " / ".join("-" if not np.isfinite(value) else f"{value:.2f}" for value in values)


def write(figures: dict[str, Any], seeds: int, out: Path) -> str:
    def row(name: str, of: dict[str, Any]) -> str:
        return f"| {name} | {of['samples']} | " + " | ".join(pair(of[key]) for key in ("all", *PARTS)) + " |"

    def force_row(name: str, of: dict[str, Any]) -> str:
        if not of["samples"]:
            return f"| {name} | 0 | | | | | |"
        return (
            f"| {name} | {of['samples']} | {of['true_rms_n']:.2f} | {of['rms_n']:.2f} | {of['median_n']:.2f} "
            f"| {of['ratio']:.2f} | {of['consistent']:.0%} |"
        )

    def event_row(name: str, of: dict[str, Any]) -> str:
        f1, f1_end = (" / ".join(f"{value:.2f}" for value in of[key]) for key in ("f1_begin", "f1_end"))
        return (
            f"| {name} | {of['touches']} | {of['short_touches']} | {of['below_threshold']} | {of['missed']} "
            f"| {of['false_positives']} "
            f"| {of['late']} | {pair(of['begin_ms'])} | {pair(of['end_ms'])} | {f1} | {f1_end} |"
        )

    def region_row(name: str, of: dict[str, Any]) -> str:
        size = "" if of["std_mm"] is None else f"{of['std_mm']:.3f}"
        mean = "" if of["mean_of_pads"] is None else f"{of['mean_of_pads']:.1f}"
        return f"| {name} | {of['touches']} | {of['within']} | {of['pads']} | {mean} | {size} |"

    objects = figures["objects"]
    position_rows = "\n".join(
        [
            *(row(name, of["position"]) for name, of in objects.items()),
            row("**all**", figures["all"]["position"]),
            row("one patch", figures["one_patch"]),
            row("a line or face, or several patches", figures["wide"]),
            row("joints moving faster than 0.5 rad/s", figures["moving"]),
            row("seed 1, world `ideal`", figures["ideal"]["position"]),
            row("seed 1, world `harsh`", figures["harsh"]["position"]),
        ]
    )
    region_rows = "\n".join(region_row(*of) for of in figures["covered"].items())
    force_rows = "\n".join(force_row(*of) for of in figures["forces"].items())
    assumed_rows = "\n".join(force_row(*of) for of in figures["forces_assumed_radius"].items())
    hertz_rows = "\n".join(force_row(*of) for of in figures["forces_hertz"].items())
    best_rows = "\n".join(
        event_row(name, of["events"])
        for name, of in [
            *objects.items(),
            ("**all**", figures["all"]),
            ("seed 1, world `ideal`", figures["ideal"]),
            ("seed 1, world `harsh`", figures["harsh"]),
        ]
    )
    mujoco_rows = "\n".join(event_row(f"{name} ms", of) for name, of in figures["gaps"].items())
    windows = " / ".join(f"{1e3 * window:.0f}" for window in WINDOWS_S)
    off_pad = f"{100 * figures['force_off_pad']:.0f}"
    text = f"""# Contacts of grasps, against MuJoCo's ground truth

The shipped hand closes on a ball, a box, a pen and a cup, squeezes twice, and each is pulled out of the
hand, slipping; {seeds} seeds. MuJoCo {figures["mujoco"]} computes contact positions and forces; the
simulator's sheets convert them to counts, and the daemon's pipeline converts those to contacts, at 200
Hz. Unknown to the daemon is what the [world](../worlds.md) `default` draws for seeds of the reporting family:
parts, sheets, drift, mounting of each pad, zeros and noise of joints; contact radii are MuJoCo's. The file
describes sheets as their builder would. Rows of `ideal` and `harsh` are of the first seed. Joint states at
100 Hz are 3 ms (`default`) older than their time stamps and arrive 2 ms later. {platform.machine()}, Python
{platform.python_version()}.

![Positions, forces, begins](grasp.png)

## Position error in the palm: mm, median / 95 %

| | samples | all | pad position | mount | kinematics | time |
| --- | --- | --- | --- | --- | --- | --- |
{position_rows}

The four components sum, as vectors, to the whole error. *Pad position*: error on the pad; *kinematics*:
zeros and noise of the joints; *time*: motion of the joints since their last state. Ground truth is the
centre of force. For a load along a line or on two points the currents give another centre, which differs
by the square of their distance: four currents can't resolve it.

True positions within the 95 % region of the reported covariance, in % with 95 % intervals, and its size; one
sample of each touch. Touches of one pad share its mount and parts, and those of a pad on which an object
chatters are many: *mean of pads* counts each pad of each hand once.

| | touches | within | pads | mean of pads | reported std, mm |
| --- | --- | --- | --- | --- | --- |
{region_rows}

The deployment states `mount_std_mm = 0.2` and `mount_std_deg = 0.5`, and joint states carry the standard
deviation of the joints. The tolerances of parts are stated as the world draws them. Patches are not: where
the currents don't fit a point, the covariance is widened by the misfit.

## Force: N

| | samples | true rms | rms error | median error | reported / true | consistent |
| --- | --- | --- | --- | --- | --- | --- |
{force_rows}

*Consistent*: within the 95 % interval of the reported standard deviation, or not below a lower bound. The
force estimate assumes one patch of 2.5 mm radius, with a standard deviation of 0.5 mm. Those of MuJoCo
follow Hertz's law for a skin of 1 MPa, which causes most of the error of values: force depends on the
radius to the power of 2/3. *At an edge*: nearer than that radius, where neither the contact law nor the
simulated sheet is accurate. Two patches carry more current than one with the same force: where the currents
fit no point, force and standard deviation span one patch and two. Samples of a touch share its errors. The
same grasps with `hertz_force_n = {HERTZ_FORCE_N}` stated for the sheets, so that the radius is 2.5 mm there
and grows as force^(1/3):

| | samples | true rms | rms error | median error | reported / true | consistent |
| --- | --- | --- | --- | --- | --- | --- |
{hertz_rows}

And as first, with each pad pressed by one disc of the assumed radius, without the errors of assumption and
patches:

| | samples | true rms | rms error | median error | reported / true | consistent |
| --- | --- | --- | --- | --- | --- | --- |
{assumed_rows}

## Begin and end

Slipping objects chatter in MuJoCo: a finger loses contact and regains it within milliseconds. A pad is
sampled at 200 Hz, and two samples below `end_threshold_n` end its contact. First, contacts against those
of an ideal pad, with exact samples of MuJoCo's forces and the same thresholds and debouncing:

| | touches | short | too weak | missed | false | late | begin ms | end ms | F1, begins | F1, ends |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{best_rows}

And against MuJoCo's own 1 kHz, ignoring gaps of touches and contacts shorter than a limit:

| gap | touches | short | too weak | missed | false | late | begin ms | end ms | F1, begins | F1, ends |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{mujoco_rows}

A touch is a pad's force above `begin_threshold_n`, until below `end_threshold_n`. *Short*: less than 20
ms, too short for two samples each for begin and end; they count neither as missed nor as false. *Too
weak*: presses that never reached `begin_threshold_n`. *Late*: reported more than 25 ms after the begin.
Delays are median / 95 %; F1 within {windows} ms. To suppress flicker, merge contacts or set
`end_samples`: 20 ignores gaps below 100 ms, and delays ends by as much. {figures["railed"]} samples of a
pad had a channel at the end of its range: the contact ends there, as `faulted`. {off_pad} % of the force
on the hand acted beside the pads and is not sensed.

{made_by()}.
"""
    (out / "grasp.md").write_text(text)
    (out / "grasp.json").write_text(json.dumps(figures, indent=1) + "\n")
    return text


def draw(runs: dict[str, list[Served]], figures: dict[str, Any], touch: Touch, path: Path) -> None:
    """Draw error by cause, its distribution, reported over true force, and F1."""
    figure, panels = plt.subplots(2, 2, figsize=(10.5, 7.6), layout="constrained")
    every = [run for of in runs.values() for run in of]
    causes = ("all", *PARTS)
    at = np.arange(len(causes))
    median, high = np.array([figures["all"]["position"][cause] for cause in causes]).T
    panel = panels[0, 0]
    panel.bar(at - 0.2, median, 0.38, color=_COLOURS[0], label="median")
    panel.bar(at + 0.2, high, 0.38, color="#a9c9e6", label="95 %")
    for x, value in [*zip(at - 0.2, median, strict=True), *zip(at + 0.2, high, strict=True)]:
        panel.annotate(f"{value:.2f}", (x, value), ha="center", va="bottom", fontsize=8, color=_INK)
    panel.set_xticks(at, ["all", "pad position", *PARTS[1:]])
    panel.set(ylabel="error in the palm [mm]", title="Position: causes of the error")
    panel.legend(frameon=False)
    for colour, (name, of) in zip(_COLOURS, runs.items(), strict=False):
        length = np.sort(length_mm(of, total, None))
        panels[0, 1].plot(length, np.linspace(0, 100, len(length)), color=colour, label=name)
        panels[1, 0].loglog(
            np.concatenate([run.true_n[::7] for run in of]),
            np.concatenate([run.force_n[::7] for run in of]),
            ".",
            markersize=2.5,
            alpha=0.5,
            color=colour,
            label=name,
        )
    panels[0, 1].set_xscale("log")
    panels[0, 1].set(
        xlabel="error in the palm [mm]", ylabel="samples below [%]", title="Position: distribution"
    )
    panels[0, 1].set_xlim(0.02, None)
    panels[0, 1].legend(frameon=False)
    panel = panels[1, 0]
    panel.plot([0.02, 30], [0.02, 30], color=_INK, linewidth=0.8)
    panel.set(xlim=(0.02, 30), ylim=(0.02, 30), xlabel="MuJoCo's force [N]", ylabel="reported force [N]")
    panel.set_title("Force")
    panel.legend(frameon=False, markerscale=4)
    windows = np.geomspace(0.003, 0.2, 40)
    panel = panels[1, 1]
    shown = [("against an ideal pad", partial(at_best, touch=touch))]
    shown += [
        (f"1 kHz, gaps below {1e3 * gap:.0f} ms ignored", partial(against, touch=touch, min_gap_s=gap))
        for gap in GAPS_S
    ]
    for colour, (label, compared) in zip(_COLOURS, shown, strict=True):
        events = EventScore()
        for run in every:
            events.add(compared(run))
        panel.semilogx(1e3 * windows, [events.f1(w) for w in windows], color=colour, label=label)
        panel.semilogx(1e3 * windows, [events.f1(w, "ends") for w in windows], color=colour, linestyle=":")
    panel.set(
        xlabel="window [ms]",
        ylabel="F1",
        ylim=(0, 1.02),
        title="Begins (ends dotted) within a window",
    )
    panel.set_xticks([3, 5, 10, 20, 50, 100, 200], ["3", "5", "10", "20", "50", "100", "200"])
    panel.legend(frameon=False, loc="lower right")
    for panel in panels.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.2)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--objects", nargs="+", default=list(GRASP_OBJECTS), choices=list(GRASP_OBJECTS))
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.objects = 1, args.objects[:1]
    out = output_folder(args.quick)
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
    assumed: list[Served] = []
    hertz: list[Served] = []
    ideal, harsh, unstated = [], [], []
    for seed in range(1, args.seeds + 1):
        for name in args.objects:
            setting = drawn_world("default", seed)
            run = served(stated, name, seed, setting)
            runs[name].append(run)
            assumed.append(served(stated, name, seed, setting, assumed_radius=True, done=run.grasp))
            hertz.append(served(growing, name, seed, setting, done=run.grasp))
            if seed == 1:
                ideal.append(served(deployment, name, seed, drawn_world("ideal", seed)))
                harsh.append(served(stated, name, seed, drawn_world("harsh", seed)))
                unstated.append(served(deployment, name, seed, setting, done=run.grasp))
            progress(f"seed {seed}: {name}, {len(run.step)} contact samples")
    figures = {"mujoco": mujoco.__version__} | collect(deployment, runs, assumed, hertz, ideal, harsh)
    figures["covered"] |= {"seed 1, world `harsh`": covered(harsh)}
    figures["covered"] |= {"seed 1, mounts not stated": covered(unstated, stated=False)}
    print(write(figures, args.seeds, out))
    draw(runs, figures, deployment.touch, out / "grasp.png")


def collect(
    deployment: Deployment,
    runs: dict[str, list[Served]],
    assumed: list[Served],
    hertz: list[Served],
    ideal: list[Served],
    harsh: list[Served],
) -> dict[str, Any]:
    """Return all figures."""
    every = [run for of in runs.values() for run in of]
    touch, masks = deployment.touch, kinds(deployment)
    best = partial(at_best, touch=touch)

    def summed(some: list[Served]) -> dict[str, Any]:
        return {"position": position_errors(some), "events": event_figures(some, best)}

    return {
        "objects": {name: summed(of) for name, of in runs.items()},
        "all": summed(every),
        "one_patch": position_errors(every, False),
        "wide": position_errors(every, True),
        "moving": position_errors([moving(run) for run in every]),
        "ideal": {"position": position_errors(ideal), "events": event_figures(ideal, best)},
        "harsh": {"position": position_errors(harsh), "events": event_figures(harsh, best)},
        "covered": {
            "all": covered(every),
            "one patch": covered(every, False),
            "a line or face, or several patches": covered(every, True),
        },
        "forces": {name: forces(every, mask) for name, mask in masks.items()},
        "forces_hertz": {name: forces(hertz, mask) for name, mask in masks.items()},
        "forces_assumed_radius": {
            name: forces(assumed, mask)
            for name, mask in masks.items()
            if name.startswith(("all", "one patch, radius", "one patch at", "lower bounds, one"))
        },
        "gaps": {
            f"{1e3 * gap:.0f}": event_figures(every, partial(against, touch=touch, min_gap_s=gap))
            for gap in GAPS_S
        },
        "railed": sum(run.railed for run in every),
        "force_off_pad": float(np.mean([run.patches.force_fraction_off_pad for run in every])),
    }


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
