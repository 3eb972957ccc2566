"""Measure shape on simulated contacts with hidden parameters.

Touches of objects that lie anyhow, with noise, and pads that sit a little askew. Writes
docs/benchmarks/percept.{md,json,png}; --quick tries it out.
"""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.page import made_by, options, output_folder
from handtouch.percept.classify import classify_shape
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.primitives import SHAPE_CLASSES, fit_primitive, run_to_completion
from handtouch.percept.primitives import ShapePrior as ShapePrior
from handtouch.percept.samples import ContactBuffer, ContactSamples
from handtouch.wire import PERCEPT_KINDS

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
Rows = list[dict[str, Any]]

PERIOD_NS, RATE_HZ = 5_000_000, 200.0
CONTACTS = (1, 5, 20, 100)


# Shape ------------------------------------------------------------------------------------------------------

TILT, NORMAL, SKIN_M = 0.03, 0.06, 0.3e-3


def touched(
    kind: str, n: int, chance: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Touches by five pads of an object that lies anyhow; its radius."""
    radius = float(chance.uniform(6e-3, 45e-3))
    along, angle = chance.uniform(-0.03, 0.03, (n, 2)), chance.uniform(-1.2, 1.2, n)
    if kind == "flat":
        outward, points = np.tile([0, 0, 1.0], (n, 1)), np.c_[along, np.zeros(n)]
    elif kind == "sphere":
        z, turn = chance.uniform(math.cos(1.2), 1, n), chance.uniform(0, 2 * np.pi, n)
        outward = np.c_[np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
        points = radius * outward
    else:
        angle = angle if kind == "cylinder" else angle * 0.6
        outward = np.c_[np.zeros(n), np.sin(angle), np.cos(angle)]
        points = (radius if kind == "cylinder" else 0.0) * outward
        points[:, 0] = along[:, 0]
    std = chance.uniform(0.2e-3, 1e-3, n)[:, None]
    across = np.eye(3) - outward[:, :, None] * outward[:, None]
    points = points + std * np.einsum("nij,nj->ni", across, chance.normal(size=(n, 3)))
    points += SKIN_M * chance.normal(size=(n, 1)) * outward
    askew = TILT * chance.normal(size=(5, 3))[chance.integers(0, 5, n)]
    normal = outward + askew + NORMAL * chance.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn3, _ = np.linalg.qr(chance.normal(size=(3, 3)))
    return (
        points @ turn3.T + 0.05 * chance.normal(size=3),
        -normal @ turn3.T,
        std[:, :, None] ** 2 * (turn3 @ across @ turn3.T),
        radius,
    )


def plain(points: FloatArray) -> dict[str, tuple[float, float]]:
    """Root mean square distance and radius of each class by least squares of the points alone."""
    away = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(away)
    if len(points) < 3:
        return dict.fromkeys(SHAPE_CLASSES, (0.0, math.nan))

    def sphere(v: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(away - v[:3], axis=1) - v[3])

    def cylinder(v: FloatArray) -> FloatArray:
        axis = axes[0] + v[0] * axes[1] + v[1] * axes[2]
        axis = axis / np.linalg.norm(axis)
        off = away - v[2] * axes[1] - v[3] * axes[2]
        return np.asarray(np.linalg.norm(off - np.outer(off @ axis, axis), axis=1) - v[4])

    size = 0.02
    ball = least_squares(sphere, [*(-size * axes[2]), size], x_scale=0.01)
    rod = least_squares(cylinder, [0, 0, 0, -size, size], x_scale=[0.1, 0.1, 0.01, 0.01, 0.01])
    line = away - np.outer(away @ axes[0], axes[0])
    return {
        "flat": (float(np.std(away @ axes[2])), math.nan),
        "edge": (float(np.sqrt(np.mean((line**2).sum(axis=1)))), math.nan),
        "cylinder": (float(np.sqrt(np.mean(rod.fun**2))), abs(float(rod.x[4]))),
        "sphere": (float(np.sqrt(np.mean(ball.fun**2))), abs(float(ball.x[3]))),
    }


def shapes(objects: int) -> dict[str, Any]:
    """Confusion by contacts, and errors of radii, of the classifier and of plain least squares."""
    found: dict[str, Any] = {}
    for n in CONTACTS:
        table = {kind: dict.fromkeys((*SHAPE_CLASSES, "not enough yet", "none"), 0) for kind in SHAPE_CLASSES}
        by_points = {kind: dict.fromkeys(SHAPE_CLASSES, 0) for kind in SHAPE_CLASSES}
        sizes: dict[str, list[float]] = {"cylinder": [], "sphere": []}
        scores: list[float] = []
        others: dict[str, list[float]] = {"cylinder": [], "sphere": []}
        for kind in SHAPE_CLASSES:
            chance = np.random.default_rng((n, *kind.encode()))
            for _ in range(objects):
                points, normals, covariances, radius = touched(kind, n, chance)
                estimates = classify_shape(points, normals, covariances)
                answer = {"undetermined": "not enough yet", "invalid": "none"}.get(
                    estimates.state, estimates.label
                )
                table[kind][answer] += 1
                fits = plain(points)
                by_points[kind][min(fits, key=lambda name: fits[name][0]) if n > 2 else "flat"] += 1
                if kind in sizes:
                    own = estimates.fits[kind]
                    others[kind].append(abs(fits[kind][1] / radius - 1))
                    if estimates.label == kind:
                        sizes[kind].append(abs(own.radius_m / radius - 1))
                        scores.append((own.radius_m - radius) / own.radius_std_m)
        found[str(n)] = {
            "table": table,
            "plain": by_points,
            "radius_error": {k: float(np.median(v)) if v else None for k, v in sizes.items()},
            "plain_radius_error": {k: float(np.nanmedian(v)) if n > 2 else None for k, v in others.items()},
            "within_95": float(np.mean(np.abs(scores) < 1.96)) if scores else None,
        }
        print(n, {k: v[k] for k, v in table.items()}, {k: v[k] for k, v in by_points.items()}, flush=True)
    return found


# Cost -------------------------------------------------------------------------------------------------------


def fit_all(name: str, *rows: FloatArray) -> None:
    """Make all steps of a fit."""
    run_to_completion(fit_primitive(name, *rows, ShapePrior()))


def costs(repeats: int) -> dict[str, float]:
    """Microseconds of a call, median."""
    chance = np.random.default_rng(1)
    contacts = {n: touched("cylinder", n, chance)[:3] for n in (20, 100)}
    return {
        f"{name}, {n} contacts, all steps": each(partial(fit_all, name, *rows), repeats)
        for n, rows in contacts.items()
        for name in SHAPE_CLASSES
    }


def ticks(kind: str, seconds: float) -> dict[str, float]:
    """Microseconds a tick of one part with 15 contacts at 200 Hz, with a slow fit and without."""
    pads, chance = np.arange(15), np.random.default_rng(2)
    perceiver = PerceptPipeline.build(ContactBuffer(15))
    requested = np.zeros((len(PERCEPT_KINDS), 15), dtype=np.bool_)
    requested[PERCEPT_KINDS.index(kind)] = True
    perceiver.set_requested(requested, np.zeros(15, dtype=np.bool_))
    angle = np.linspace(0, 2 * np.pi, 15, endpoint=False)
    facing = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    none, took, fitted = np.zeros(0, np.intp), [], []
    for number in range(round(seconds * RATE_HZ)):
        t_ns, t_s = 10**9 + number * PERIOD_NS, number / RATE_HZ
        sample = ContactSamples(pads, np.full(15, t_ns), np.full(15, 5, np.uint32))
        place = 1e-5 * chance.normal(size=(15, 2))
        on_link = np.concatenate([place, np.zeros((15, 1))], axis=1)
        force = 1.5 + math.sin(3 * t_s) + 0.01 * chance.normal(size=15)
        sample["pad_m"], sample["position_m"], sample["force_n"] = place, on_link, force
        sample["pad_noise_m2"] = np.tile(1e-10 * np.eye(2), (15, 1, 1))
        sample["covariance_m2"] = sample["palm_covariance_m2"] = np.tile(1e-8 * np.eye(3), (15, 1, 1))
        sample["force_std_n"], sample["total_current_a"] = 0.1 * force, 1e-3 * force
        sample["residual"], sample["residual_std"] = 1e-3 * chance.normal(size=15), np.full(15, 1e-3)
        sample["palm_rotation"] = np.tile(np.eye(3), (15, 1, 1))
        spread = 0.02 * facing - 2e-3 * math.sin(3 * t_s) * facing
        sample["palm_position_m"] = spread + on_link + 1e-2 * t_s * (kind == "shape") * np.array([0, 0, 1.0])
        sample["palm_normal"], sample["normal"] = -facing, -facing
        fits, begun_s = perceiver.fit_count, time.perf_counter()
        perceiver.process_tick(sample, none, t_ns)
        fitted.append(perceiver.fit_count > fits)
        took.append(1e6 * (time.perf_counter() - begun_s))
    late = np.array(took[len(took) // 3 :])
    with_fit = np.array(fitted[len(took) // 3 :])
    return {
        "without": float(np.quantile(late[~with_fit], 0.1)),
        "with": float(np.quantile(late[with_fit], 0.1)) if with_fit.any() else math.nan,
        "share": float(with_fit.mean()),
    }


def each(call: Callable[[], Any], repeats: int) -> float:
    spent = []
    for _ in range(repeats):
        begin_ns = time.thread_time_ns()
        call()
        spent.append((time.thread_time_ns() - begin_ns) * 1e-3)
    return float(np.median(spent))


# Report -----------------------------------------------------------------------------------------------------


def drawn(found: dict[str, Any], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    shape = found["shape"]
    at = np.arange(len(CONTACTS))
    for offset, key, colour, label in (
        (-0.2, "table", "#1f6fb4", "by evidence: right"),
        (0.2, "plain", "#8a8a8a", "least squares of points: right"),
    ):
        total = [sum(sum(row.values()) for row in shape[str(n)][key].values()) for n in CONTACTS]
        right = [sum(shape[str(n)][key][k][k] for k in SHAPE_CLASSES) for n in CONTACTS]
        axes.bar(at + offset, np.divide(right, total), 0.38, color=colour, label=label)
    yet = [sum(shape[str(n)]["table"][k]["not enough yet"] for k in SHAPE_CLASSES) for n in CONTACTS]
    right = [sum(shape[str(n)]["table"][k][k] for k in SHAPE_CLASSES) for n in CONTACTS]
    total = [sum(sum(row.values()) for row in shape[str(n)]["table"].values()) for n in CONTACTS]
    axes.bar(
        at - 0.2,
        np.divide(yet, total),
        0.38,
        bottom=np.divide(right, total),
        color="#cfe2f3",
        label="by evidence: not enough yet",
    )
    axes.set_xticks(at, [str(n) for n in CONTACTS])
    axes.set(xlabel="contacts", ylabel="part of objects", title="Shape", ylim=(0, 1.35))
    axes.legend(fontsize=8, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def report(found: dict[str, Any]) -> str:
    """The page."""
    parts = []
    for n in CONTACTS:
        one = found["shape"][str(n)]
        columns = [*SHAPE_CLASSES, "not enough yet", "none"]
        rows = [
            [kind, *(str(one["table"][kind][c]) for c in columns), str(one["plain"][kind][kind])]
            for kind in SHAPE_CLASSES
        ]
        sizes = ", ".join(
            f"{k} {100 * v:.1f} %"
            for k, v in one["radius_error"].items()
            if v is not None and math.isfinite(v)
        )
        plain_sizes = ", ".join(
            f"{k} {100 * v:.1f} %" for k, v in one["plain_radius_error"].items() if v is not None
        )
        inside = f"; {100 * one['within_95']:.0f} % within 1.96 deviations" if one["within_95"] else ""
        parts.append(
            f"{n} contacts. Median error of radii: {sizes or 'none'}{inside}; least squares:"
            f" {plain_sizes or 'none'}.\n\n" + table(["is", *columns, "right by least squares"], rows)
        )
    cost = table(["call", "us"], [[name, f"{us:.0f}"] for name, us in found["cost_us"].items()])
    head = HEAD.format(made_by=made_by(), **found["machine"])
    turns = table(
        ["part", "us without a fit", "us with one", "ticks with one"],
        [
            [
                kind,
                f"{us['without']:.0f}",
                f"{us['with']:.0f}" if us["share"] else "",
                f"{100 * us['share']:.0f} %",
            ]
            for kind, us in found["ticks_us"].items()
        ],
    )
    pages = [head, "## Shape", SHAPE, *parts, "## Cost", TICKS, turns, COST, cost]
    return "\n\n".join(pages) + "\n"


HEAD = """\
# Shape

{made_by}: seeded simulation; the estimators don't know noise, tolerances, contact radii,
sheets. On {system}, Python {python}, numpy {numpy}.

![Shape](percept.png)"""
SHAPE = """\
40 objects of each class. Touches spread over the object (cylinder and sphere over 140 degrees), radii 6
to 45 mm, position errors of 0.2 to 1 mm, pads tilted by 0.03 rad per axis, normals by 0.06. A label needs a
probability of 0.9. Least squares: each class fitted to the points alone from one start each, the class of
least root mean square; with fewer than three contacts it returns flat."""
TICKS = """\
One estimator at a time, 15 contacts at 200 Hz with joint states: wall time of a tick's percepts, with a slow
fit and without; 10 % quantiles, because the cores were shared and full. Percepts without
subscriber aren't called and cost nothing, as a test shows."""
COST = """\
Processor time, median of calls by themselves. At most one of these runs in 10 ms, and of a
shape's fit two steps at a time (a class takes 6 to 26); none of it without a subscriber."""


def main() -> None:
    quick = options(__doc__).parse_args().quick
    out = output_folder(quick)
    machine = {"system": platform.platform(), "python": platform.python_version(), "numpy": np.__version__}
    found: dict[str, Any] = {
        "machine": machine | {"cpus": os.cpu_count()},
        "shape": shapes(10 if quick else 40),
        "ticks_us": {kind: ticks(kind, 2.0 if quick else 10.0) for kind in PERCEPT_KINDS[1:]},
        "cost_us": costs(10 if quick else 50),
    }
    (out / "percept.json").write_text(json.dumps(found, indent=1).replace("NaN", "null") + "\n")
    (out / "percept.md").write_text(report(found))
    drawn(found, out / "percept.png")
    print(report(found))


if __name__ == "__main__":
    main()
