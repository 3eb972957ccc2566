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
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import numpy as np
from grasp_run import PARTS, Served, Setting, served
from numpy.typing import NDArray

from handtouch import shipped
from handtouch.config import load
from handtouch.simulate.grasp.events import Events
from handtouch.simulate.grasp.things import THINGS

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
OUT = Path(__file__).parents[1] / "docs" / "benchmarks"
WINDOWS_S = (0.010, 0.020, 0.050, 0.100)
ONE_PATCH_M = 5.5e-3
_COLOURS = ("#1f6fb4", "#2e8b57", "#e08214", "#8e44ad")
_INK = "#1a1a1a"


def length_mm(runs: Sequence[Served], of: Callable[[Served], FloatArray], wide: bool | None) -> FloatArray:
    """Lengths of error vectors of all samples, or of those whose force is spread `wide` or isn't."""
    found = []
    for run in runs:
        spread = run.patches.spread_m[run.step, run.pad]
        taken = np.ones(len(spread), np.bool_) if wide is None else (spread > ONE_PATCH_M) == wide
        found.append(1e3 * np.linalg.norm(of(run)[taken], axis=1))
    return np.concatenate(found)


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


def covered(runs: Sequence[Served]) -> float:
    """Share of samples whose place lies within the 95 % region of the told covariance, in its plane."""
    inside = []
    for run in runs:
        values, axes = np.linalg.eigh(run.covariance_m2)
        along = np.einsum("kji,kj->ki", axes, total(run))[:, 1:]
        inside.append((along**2 / np.maximum(values[:, 1:], 1e-18)).sum(1) < 5.991)  # chi squared of two
    return float(np.concatenate(inside).mean())


def forces(runs: Sequence[Served]) -> dict[str, float]:
    """Root mean square of the error [N], and the median of told over true."""
    told, true = (np.concatenate([getattr(run, name) for run in runs]) for name in ("force_n", "true_n"))
    known = np.isfinite(told)
    error = told[known] - true[known]
    return {
        "rms_n": float(np.sqrt(np.mean(error**2))),
        "median_n": float(np.median(np.abs(error))),
        "true_rms_n": float(np.sqrt(np.mean(true[known] ** 2))),
        "ratio": float(np.median(told[known] / true[known])),
    }


def happened(runs: Sequence[Served]) -> dict[str, Any]:
    """Touches and contacts."""
    events = Events()
    for run in runs:
        events.add(run.events)
    return {
        "touches": events.touches,
        "short": events.short,
        "missed": events.missed,
        "invented": events.invented,
        "late": events.late,
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
        some, even = of["force"], of["force_assumed_radius"]
        return (
            f"| {name} | {some['true_rms_n']:.2f} | {some['rms_n']:.2f} | {some['median_n']:.2f} "
            f"| {some['ratio']:.2f} | {even['rms_n']:.2f} | {even['median_n']:.2f} | {even['ratio']:.2f} |"
        )

    def event_row(name: str, of: dict[str, Any]) -> str:
        f1 = " / ".join(f"{value:.2f}" for value in of["f1_begin"])
        f1_end = " / ".join(f"{value:.2f}" for value in of["f1_end"])
        return (
            f"| {name} | {of['touches']} | {of['missed']} | {of['invented']} | {of['late']} | {of['short']} "
            f"| {pair(of['begin_ms'])} | {pair(of['end_ms'])} | {f1} | {f1_end} |"
        )

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
    force_rows = "\n".join(force_row(n, of) for n, of in [*things.items(), ("**all**", figures["all"])])
    event_rows = "\n".join(
        event_row(n, of["events"]) for n, of in [*things.items(), ("**all**", figures["all"])]
    )
    windows = " / ".join(f"{1e3 * window:.0f}" for window in WINDOWS_S)
    text = f"""# Grasps, against MuJoCo's truth

The shipped hand closes on a ball, a box, a pen and a cup, squeezes twice, and each is pulled off, slipping;
{seeds} seeds each. MuJoCo {figures["mujoco"]} says where and how hard they touch; the simulator's own
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
zeros and noise of the joints; *time*: joints that moved since they were told. Truth is the centre of force;
on a pad that is pressed along a line or in two places currents tell another centre. {
        100
        * figures[
            "covered"
        ]:.0f} % of the samples lie within the 95 % region of the covariance that is told, which
knows of noise and joints, not of mounts.

## How hard: N

| | true rms | rms error | median error | told / true | rms with the radius assumed | median | told / true |
| --- | --- | --- | --- | --- | --- | --- | --- |
{force_rows}

Forces assume patches of 2.5 mm radius. *With the radius assumed*: the same grasps as if that were so, which
leaves out what the assumption costs; a
few samples still err much (its rms, beside its median), and why hasn't been looked into.

## When

| | touches | missed | invented | late | short | begin ms | end ms | F1 of begins | F1 of ends |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{event_rows}

A touch is a pad's force above `on_n`, until below `off_n` for 10 ms, in MuJoCo's 1 kHz. *Late*: told more
than 25 ms after it began. *Short*: less than 20 ms, which two samples each for a begin and an end can't
tell; they count neither for nor against. Delays are median / 95 %; F1 within {windows} ms. What spoils F1
are touches that flicker as things slip: one touch is told as several. {figures["railed"]} samples of a pad
had a channel at the end of its range, where no contact is told. {100 * figures["beside"]:.0f} % of the
force on the hand pressed beside the pads, where nothing feels it.

Made by `make bench ONLY=grasp`.
"""
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "grasp.md").write_text(text)
    (OUT / "grasp.json").write_text(json.dumps(figures, indent=1) + "\n")
    return text


def draw(runs: dict[str, list[Served]], figures: dict[str, Any]) -> None:
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
    events = Events()
    for run in every:
        events.add(run.events)
    panel = panels[1, 1]
    panel.semilogx(1e3 * windows, [events.f1(w) for w in windows], color=_COLOURS[0], label="begins")
    panel.semilogx(1e3 * windows, [events.f1(w, "ends") for w in windows], color=_COLOURS[2], label="ends")
    panel.set(xlabel="window [ms]", ylabel="F1", ylim=(0, 1.02), title="When: contacts told within a window")
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
    runs: dict[str, list[Served]] = {name: [] for name in asked.things}
    even: dict[str, list[Served]] = {name: [] for name in asked.things}
    ideal = []
    for seed in range(1, asked.seeds + 1):
        for name in asked.things:
            setting = Setting.usual(seed)
            run = served(deployment, name, seed, setting)
            runs[name].append(run)
            even[name].append(served(deployment, name, seed, setting, assumed_radius=True, done=run.grasp))
            if seed == 1:
                ideal.append(served(deployment, name, seed, Setting.ideal(seed)))
            print(f"seed {seed}: {name}, {len(run.step)} samples of contacts", flush=True)
    figures = {"mujoco": mujoco.__version__} | gathered(runs, even, ideal)
    print(write(figures, asked.seeds))
    draw(runs, figures)


def gathered(
    runs: dict[str, list[Served]], even: dict[str, list[Served]], ideal: list[Served]
) -> dict[str, Any]:
    """All figures."""
    every = [run for of in runs.values() for run in of]

    def summed(some: list[Served], assumed: list[Served]) -> dict[str, Any]:
        return {
            "place": places(some),
            "force": forces(some),
            "force_assumed_radius": forces(assumed),
            "events": happened(some),
        }

    return {
        "things": {name: summed(of, even[name]) for name, of in runs.items()},
        "all": summed(every, [run for of in even.values() for run in of]),
        "one_patch": places(every, False),
        "wide": places(every, True),
        "moving": places([moving(run) for run in every]),
        "ideal": {"place": places(ideal), "force": forces(ideal), "events": happened(ideal)},
        "covered": covered(every),
        "railed": sum(run.railed for run in every),
        "beside": float(np.mean([run.patches.beside_share for run in every])),
    }


def moving(run: Served) -> Served:
    """Those samples at which a joint moves."""
    on = run.moving_rad_s > 0.5
    names = ("step", "pad", "palm_m", "covariance_m2", "true_m", "force_n", "true_n", "moving_rad_s")
    some: dict[str, Any] = {name: getattr(run, name)[on] for name in names}
    return replace(run, **some, error_m={part: error[on] for part, error in run.error_m.items()})


if __name__ == "__main__":
    main()
