"""Contacts of grasps against MuJoCo's truth: places in the palm and what errs in them, forces, begins, ends.

The shipped hand closes on a ball, a box, a pen and a cup, squeezes, and loses them; a world with tolerances
for every seed. Writes docs/benchmarks/grasp.{md,json,png}. Quick: --seeds 1 --things ball.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import numpy as np
from grasp_run import PARTS, Served, Setting, against, at_best, served
from numpy.typing import NDArray

from handtouch import shipped
from handtouch.config import Deployment, Touch, load
from handtouch.simulate.grasp.events import Events
from handtouch.simulate.grasp.things import THINGS

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
OUT = Path(__file__).parents[1] / "docs" / "benchmarks"
WINDOWS_S = (0.010, 0.020, 0.050, 0.100)
BREAKS_S = (0.010, 0.030, 0.100)
ONE_PATCH_M = 5.5e-3
STATED = {"mount_std_mm": 0.2, "mount_std_deg": 0.5}
_WITHIN_95 = {2: 5.991, 3: 7.815}  # chi squared
_COLOURS = ("#1f6fb4", "#2e8b57", "#e08214", "#8e44ad")
_INK = "#1a1a1a"


def length_mm(runs: Sequence[Served], of: Callable[[Served], FloatArray], wide: bool | None) -> FloatArray:
    """Lengths of error vectors of all samples, or of those whose force is spread `wide` or isn't."""
    return np.concatenate([1e3 * np.linalg.norm(of(run)[chosen(run, wide)], axis=1) for run in runs])


def total(run: Served) -> FloatArray:
    return np.asarray(run.palm_m - run.true_m)


def places(runs: Sequence[Served], wide: bool | None = None) -> dict[str, Any]:
    """Samples, and median and 95 % of the error [mm] by cause."""
    of: dict[str, Callable[[Served], FloatArray]] = {"all": total}
    of |= {part: lambda run, part=part: run.error_m[part] for part in PARTS}
    lengths = {name: length_mm(runs, take, wide) for name, take in of.items()}
    return {"samples": len(lengths["all"])} | {
        name: np.percentile(some, [50, 95]).tolist() if len(some) else [np.nan, np.nan]
        for name, some in lengths.items()
    }


def covered(runs: Sequence[Served], wide: bool | None = None, stated: bool = True) -> list[float]:
    """Samples, the share of them whose place lies within the told 95 % region, and the median of the told
    standard deviation [mm]; a region without mounts is flat: in its plane."""
    inside, size, dimensions = [], [], 3 if stated else 2
    for run in runs:
        taken = chosen(run, wide)
        values, axes = np.linalg.eigh(run.covariance_m2[taken])
        along = np.einsum("kji,kj->ki", axes, total(run)[taken])[:, -dimensions:]
        squared = (along**2 / np.maximum(values[:, -dimensions:], 1e-18)).sum(1)
        inside.append(squared < _WITHIN_95[dimensions])
        size.append(1e3 * np.sqrt(values.sum(1)))
    share, sizes = np.concatenate(inside), np.concatenate(size)
    return [
        len(share),
        *(float(of(some)) for of, some in ((np.mean, share), (np.median, sizes)) if len(some)),
    ]


def chosen(run: Served, wide: bool | None) -> NDArray[np.bool_]:
    """Samples (k,) whose force is spread wide, or isn't; or all."""
    spread = run.patches.spread_m[run.step, run.pad]
    is_wide = np.asarray(spread > ONE_PATCH_M)
    return np.ones(len(spread), np.bool_) if wide is None else is_wide == wide


def bound(run: Served) -> NDArray[np.bool_]:
    """Samples (k,) whose force is told as a lower bound."""
    return np.asarray(np.isnan(run.force_std_n))


def kinds(deployment: Deployment) -> dict[str, Callable[[Served], NDArray[np.bool_]]]:
    """Samples of contacts by what may err in their force."""
    sheet = [deployment.sheets[pad.sheet] for pad in deployment.hands[0].pads]
    radius = 1e-3 * np.array([of.contact_radius_mm for of in sheet])
    std = 1e-3 * np.array([of.contact_radius_std_mm for of in sheet])

    def off(run: Served) -> FloatArray:
        """How far the radius is from what was assumed, in standard deviations."""
        return np.asarray((run.patches.spread_m[run.step, run.pad] - radius[run.pad]) / std[run.pad])

    def rim(run: Served) -> NDArray[np.bool_]:
        centre = run.patches.centre[run.step, run.pad]
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


def forces(runs: Sequence[Served], of: Callable[[Served], NDArray[np.bool_]]) -> dict[str, float]:
    """Of some samples: errors [N], told over true, and the share that is as it should be: within the told
    95 %, or not below a lower bound."""
    rows = []
    for run in runs:
        on = of(run) & np.isfinite(run.force_n)
        rows.append(np.stack([run.force_n[on], run.true_n[on], run.force_std_n[on]]))
    told, true, std = np.concatenate(rows, axis=1)
    if not len(told):
        return {"samples": 0}
    error = told - true
    kept = np.where(np.isnan(std), error <= 0, np.abs(error) < 1.96 * std)
    return {
        "samples": len(told),
        "true_rms_n": float(np.sqrt(np.mean(true**2))),
        "rms_n": float(np.sqrt(np.mean(error**2))),
        "median_n": float(np.median(np.abs(error))),
        "ratio": float(np.median(told / true)),
        "kept": float(kept.mean()),
    }


def happened(runs: Sequence[Served], compared: Callable[[Served], Events]) -> dict[str, Any]:
    """Touches and contacts."""
    events = Events()
    for run in runs:
        events.add(compared(run))
    return {
        **{
            name: getattr(events, name)
            for name in ("touches", "short", "faint", "missed", "invented", "late")
        },
        "begin_ms": (1e3 * np.percentile(events.begin_s, [50, 95])).tolist(),
        "end_ms": (1e3 * np.percentile(events.end_s, [50, 95])).tolist(),
        "f1_begin": [events.f1(window) for window in WINDOWS_S],
        "f1_end": [events.f1(window, "ends") for window in WINDOWS_S],
    }


def pair(values: Sequence[float]) -> str:
    return " / ".join("-" if not np.isfinite(value) else f"{value:.2f}" for value in values)


def write(figures: dict[str, Any], seeds: int) -> str:
    def row(name: str, of: dict[str, Any]) -> str:
        return f"| {name} | {of['samples']} | " + " | ".join(pair(of[key]) for key in ("all", *PARTS)) + " |"

    def force_row(name: str, of: dict[str, Any]) -> str:
        if not of["samples"]:
            return f"| {name} | 0 | | | | | |"
        return (
            f"| {name} | {of['samples']} | {of['true_rms_n']:.2f} | {of['rms_n']:.2f} | {of['median_n']:.2f} "
            f"| {of['ratio']:.2f} | {of['kept']:.0%} |"
        )

    def event_row(name: str, of: dict[str, Any]) -> str:
        f1, f1_end = (" / ".join(f"{value:.2f}" for value in of[key]) for key in ("f1_begin", "f1_end"))
        return (
            f"| {name} | {of['touches']} | {of['short']} | {of['faint']} | {of['missed']} | {of['invented']} "
            f"| {of['late']} | {pair(of['begin_ms'])} | {pair(of['end_ms'])} | {f1} | {f1_end} |"
        )

    def region_row(name: str, of: list[float]) -> str:
        return f"| {name} | {of[0]} | {of[1]:.0%} | {of[2]:.3f} |" if of[0] else f"| {name} | 0 | | |"

    things = figures["things"]
    place_rows = "\n".join(
        [
            *(row(name, of["place"]) for name, of in things.items()),
            row("**all**", figures["all"]["place"]),
            row("one patch", figures["one_patch"]),
            row("a line or face, or several patches", figures["wide"]),
            row("joints moving faster than 0.5 rad/s", figures["moving"]),
            row("seed 1, nothing hidden but noise", figures["ideal"]["place"]),
        ]
    )
    region_rows = "\n".join(region_row(*of) for of in figures["covered"].items())
    force_rows = "\n".join(force_row(*of) for of in figures["forces"].items())
    even_rows = "\n".join(force_row(*of) for of in figures["forces_assumed_radius"].items())
    best_rows = "\n".join(
        event_row(name, of["events"]) for name, of in [*things.items(), ("**all**", figures["all"])]
    )
    real_rows = "\n".join(event_row(f"{name} ms", of) for name, of in figures["breaks"].items())
    windows = " / ".join(f"{1e3 * window:.0f}" for window in WINDOWS_S)
    beside = f"{100 * figures['beside']:.0f}"
    text = f"""# Grasps, against MuJoCo's truth

The shipped hand closes on a ball, a box, a pen and a cup, squeezes twice, and each is pulled off, slipping;
{seeds} seeds. MuJoCo {figures["mujoco"]} says where and how hard they touch; the simulator's own
sheets make counts of it, and the daemon's own pipeline contacts, at 200 Hz. Hidden from the daemon: 2 %
gain of each channel, 0.2 mm of gaps, 5 % of resistors, patches of whatever radius, 0.2 mm and 0.5 degrees
(std) of each pad's mount, 0.2 degrees of each joint's zero, 0.05 of a reading, joint states at 100 Hz that
are 3 ms older than their stamps and arrive 2 ms later. {platform.machine()}, Python
{platform.python_version()}.

![Places, forces, begins](grasp.png)

## Where: error of the place in the palm, mm, median / 95 %

| | samples | all | pad location | mount | kinematics | time |
| --- | --- | --- | --- | --- | --- | --- |
{place_rows}

The four causes add up, as vectors, to the whole error. *Pad location*: where on the pad; *kinematics*:
zeros and noise of the joints; *time*: joints that moved since they were told. Truth is the centre of
force. On a pad that is pressed along a line or in two places currents tell another centre, by the square
of how far those lie apart: four numbers can't tell more.

Of the true places, how many lie within the 95 % region of the covariance that is told, and how wide that
is:

| | samples | within | deviation told, mm |
| --- | --- | --- | --- |
{region_rows}

Stated are `mount_std_mm = 0.2` and `mount_std_deg = 0.5`, and joint states tell the deviation of joints.
Gains and patches nobody states: where the currents don't fit a point, the covariance is wider by as much.

## How hard: N

| | samples | true rms | rms error | median error | told / true | as told |
| --- | --- | --- | --- | --- | --- | --- |
{force_rows}

*As told*: within the 95 % interval of the deviation that is told, or not below a lower bound. Forces
assume one patch of 2.5 mm radius, give or take 0.5 (1 sigma). MuJoCo's have what Hertz gives a skin of 1
MPa, and that is where most of the error of values is from; force goes as the radius to the power of 2/3.
*At an edge*: nearer than that radius, where neither the law nor the simulator's sheet is more than a
guess. Two patches carry more current than one with the same force can, so that force and bound are too
high: `residual` shows them. The same grasps, each pad pressed by one disc of the radius assumed, which
leaves out what assumption and patches cost:

| | samples | true rms | rms error | median error | told / true | as told |
| --- | --- | --- | --- | --- | --- | --- |
{even_rows}

## When

Things that slip chatter in MuJoCo: a finger leaves and is back within milliseconds. A pad is sampled 200
times a second, and two samples below `off_n` end its contact. So first, contacts beside what a pad could
tell at best that feels MuJoCo's forces exactly whenever it is sampled, with the same thresholds and
debounce:

| | touches | short | faint | missed | invented | late | begin ms | end ms | F1 of begins | F1 of ends |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{best_rows}

And beside MuJoCo's own 1 kHz, where breaks shorter than so long, of touches and of contacts alike, are
none:

| break | touches | short | faint | missed | invented | late | begin ms | end ms | F1, begins | F1, ends |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{real_rows}

A touch is a pad's force above `on_n`, until below `off_n`. *Short*: less than 20 ms, which two samples
each for a begin and an end can't tell; they count neither for nor against. *Faint*: what pressed and never
reached `on_n`. *Late*: told more than 25 ms after it began. Delays are median / 95 %; F1 within {windows}
ms. Who wants no flicker joins contacts, or sets `end_samples`: with 20, breaks below 100 ms are none, and
ends come as much later. {figures["railed"]} samples of a pad had a channel at the end of its range: the
contact ends there, as `faulted`. {beside} % of the force on the hand pressed beside the pads, where
nothing feels it.

Made by `make bench ONLY=grasp`.
"""
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "grasp.md").write_text(text)
    (OUT / "grasp.json").write_text(json.dumps(figures, indent=1) + "\n")
    return text


def draw(runs: dict[str, list[Served]], figures: dict[str, Any], touch: Touch) -> None:
    """Four panels: error by cause, its distribution, told over true force, F1."""
    figure, panels = plt.subplots(2, 2, figsize=(10.5, 7.6), layout="constrained")
    every = [run for of in runs.values() for run in of]
    causes = ("all", *PARTS)
    at = np.arange(len(causes))
    median, high = np.array([figures["all"]["place"][cause] for cause in causes]).T
    panel = panels[0, 0]
    panel.bar(at - 0.2, median, 0.38, color=_COLOURS[0], label="median")
    panel.bar(at + 0.2, high, 0.38, color="#a9c9e6", label="95 %")
    for x, value in [*zip(at - 0.2, median, strict=True), *zip(at + 0.2, high, strict=True)]:
        panel.annotate(f"{value:.2f}", (x, value), ha="center", va="bottom", fontsize=8, color=_INK)
    panel.set_xticks(at, ["all", "pad location", *PARTS[1:]])
    panel.set(ylabel="error in the palm [mm]", title="Where: causes of the error")
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
    panels[0, 1].set(xlabel="error in the palm [mm]", ylabel="samples below [%]", title="Where: distribution")
    panels[0, 1].set_xlim(0.02, None)
    panels[0, 1].legend(frameon=False)
    panel = panels[1, 0]
    panel.plot([0.02, 30], [0.02, 30], color=_INK, linewidth=0.8)
    panel.set(xlim=(0.02, 30), ylim=(0.02, 30), xlabel="MuJoCo's force [N]", ylabel="force told [N]")
    panel.set_title("How hard")
    panel.legend(frameon=False, markerscale=4)
    windows = np.geomspace(0.003, 0.2, 40)
    panel = panels[1, 1]
    shown = [("what a pad could tell at best", partial(at_best, touch=touch))]
    shown += [
        (f"1 kHz, breaks below {1e3 * gap:.0f} ms none", partial(against, touch=touch, apart_s=gap))
        for gap in BREAKS_S
    ]
    for colour, (label, compared) in zip(_COLOURS, shown, strict=True):
        events = Events()
        for run in every:
            events.add(compared(run))
        panel.semilogx(1e3 * windows, [events.f1(w) for w in windows], color=colour, label=label)
        panel.semilogx(1e3 * windows, [events.f1(w, "ends") for w in windows], color=colour, linestyle=":")
    panel.set(
        xlabel="window [ms]",
        ylabel="F1",
        ylim=(0, 1.02),
        title="When: begins (ends dotted) told within a window",
    )
    panel.set_xticks([3, 5, 10, 20, 50, 100, 200], ["3", "5", "10", "20", "50", "100", "200"])
    panel.legend(frameon=False, loc="lower right")
    for panel in panels.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.2)
    figure.savefig(OUT / "grasp.png", dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--things", nargs="+", default=list(THINGS), choices=list(THINGS))
    asked = parser.parse_args()
    import mujoco

    deployment = load(shipped.path("utah_mit.toml"))
    stating = deployment.hands[0].model_copy(update=STATED)
    stated = deployment.model_copy(update={"hands": (stating, *deployment.hands[1:])})
    runs: dict[str, list[Served]] = {name: [] for name in asked.things}
    even: list[Served] = []
    ideal, unstated = [], []
    for seed in range(1, asked.seeds + 1):
        for name in asked.things:
            setting = Setting.usual(seed)
            run = served(stated, name, seed, setting)
            runs[name].append(run)
            even.append(served(stated, name, seed, setting, assumed_radius=True, done=run.grasp))
            if seed == 1:
                ideal.append(served(deployment, name, seed, Setting.ideal(seed)))
                unstated.append(served(deployment, name, seed, setting, done=run.grasp))
            print(f"seed {seed}: {name}, {len(run.step)} samples of contacts", flush=True)
    figures = {"mujoco": mujoco.__version__} | gathered(deployment, runs, even, ideal)
    figures["covered"] |= {"seed 1, mounts not stated": covered(unstated, stated=False)}
    print(write(figures, asked.seeds))
    draw(runs, figures, deployment.touch)


def gathered(
    deployment: Deployment, runs: dict[str, list[Served]], even: list[Served], ideal: list[Served]
) -> dict[str, Any]:
    """All figures."""
    every = [run for of in runs.values() for run in of]
    touch, of_force = deployment.touch, kinds(deployment)
    best = partial(at_best, touch=touch)

    def summed(some: list[Served]) -> dict[str, Any]:
        return {"place": places(some), "events": happened(some, best)}

    return {
        "things": {name: summed(of) for name, of in runs.items()},
        "all": summed(every),
        "one_patch": places(every, False),
        "wide": places(every, True),
        "moving": places([moving(run) for run in every]),
        "ideal": {"place": places(ideal), "events": happened(ideal, best)},
        "covered": {
            "all": covered(every),
            "one patch": covered(every, False),
            "a line or face, or several patches": covered(every, True),
        },
        "forces": {name: forces(every, of) for name, of in of_force.items()},
        "forces_assumed_radius": {
            name: forces(even, of)
            for name, of in of_force.items()
            if name.startswith(("all", "one patch, radius", "one patch at", "lower bounds, one"))
        },
        "breaks": {
            f"{1e3 * gap:.0f}": happened(every, partial(against, touch=touch, apart_s=gap))
            for gap in BREAKS_S
        },
        "railed": sum(run.railed for run in every),
        "beside": float(np.mean([run.patches.beside_share for run in every])),
    }


def moving(run: Served) -> Served:
    """Those samples at which a joint moves."""
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
