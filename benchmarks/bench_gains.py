"""Measure the self-calibration of gains, with the daemon's settings: against the Fisher bound, also with
elongated contacts.

Prints its tables and writes docs/benchmarks/gains.{md,json,png}. On hands of the worlds see bench_worlds, and
bench_swap for errors by number of contacts.
"""

from __future__ import annotations

import copy
import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.page import made_by, options, output_folder, progress, table
from benchmarks.scores import Share
from handtouch.calibration.auto_calibration import new_gain_estimator
from handtouch.calibration.contact_scores import fisher_covariance, gain_deviation
from handtouch.calibration.gains import GainEstimator
from handtouch.field import Rectangle

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
PADS = {"1:1": Rectangle(1.0, 1.0), "1.8:1": Rectangle(1.8, 1.0)}
COUNTS = (100, 400, 1600)
TRIALS = 40
TRIALS_ELONGATED = 10
GAIN_STD = 0.02


def contacts(
    pad: Rectangle, count: int, elongated: float, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places (count,) 10 % of a side from the edges, fractions (4, count); some are two points apart."""
    x, y = generator.uniform(0.1, 0.9, (2, count)) * [[pad.a], [pad.b]]
    room = np.minimum(np.minimum(x, pad.a - x), np.minimum(y, pad.b - y))
    half = np.minimum(generator.uniform(0.03, 0.15, count), 0.95 * room)
    half = np.where(generator.uniform(size=count) < elongated, half, 0.0)
    angle = generator.uniform(0, np.pi, count)
    dx, dy = half * np.cos(angle), half * np.sin(angle)
    return x, y, (pad.fractions(x - dx, y - dy) + pad.fractions(x + dx, y + dy)) / 2


def exact_model_estimator(pad: Rectangle) -> GainEstimator:
    """Return an estimator that assumes no error of the pad's fractions besides noise, as the bound does."""
    return GainEstimator(pad, tolerance=0.05, model_error=0.0)


def trials(
    label: str,
    noise: float,
    elongated: float,
    seeds: int,
    new_estimator: Callable[[Rectangle], GainEstimator] = new_gain_estimator,
) -> list[dict[str, Any]]:
    """Errors against the bound at each of COUNTS."""
    pad = PADS[label]
    errors: dict[int, list[FloatArray]] = {count: [] for count in COUNTS}
    stated: dict[int, list[FloatArray]] = {count: [] for count in COUNTS}
    bounds: dict[int, list[float]] = {count: [] for count in COUNTS}
    distances: dict[int, list[float]] = {count: [] for count in COUNTS}
    for seed in range(seeds):
        generator = np.random.default_rng(
            (seed, round(10 * pad.a), round(1e5 * noise), round(10 * elongated))
        )
        x, y, fractions = contacts(pad, max(COUNTS), elongated, generator)
        truth = generator.normal(0, GAIN_STD, 4)
        truth -= truth.mean()
        currents = (fractions + noise * generator.normal(size=fractions.shape)) * np.exp(-truth)[:, None]
        running = new_estimator(pad)
        done = 0
        for count in COUNTS:
            running.add_contacts(currents[:, done:count], noise, 0)
            done, settled = count, copy.deepcopy(running)
            settled.process_pending()
            found = settled.estimate
            error = np.log(found.gains) - truth
            errors[count].append(error)
            bounds[count].append(fisher_covariance(pad, x[:count], y[:count], noise).trace())
            stated[count].append(np.diag(found.covariance))
            distances[count].append(float(error @ np.linalg.pinv(found.covariance) @ error))
    rows = []
    for count in COUNTS:
        error, variance = np.array(errors[count]), np.array(stated[count])
        bound = np.sqrt(np.mean(bounds[count]) / 4)
        rows.append(
            {
                "pad": label,
                "noise": f"{noise:.0e}",
                "elongated": f"{100 * elongated:.0f} %",
                "contacts": count,
                "bound, %": float(100 * bound),
                "error / bound": float(np.sqrt((error**2).mean()) / bound),
                "stated std / bound": float(np.sqrt(variance.mean()) / bound),
                "in 95 % ellipsoid, %": str(Share.of_mask(np.array(distances[count]) < chi2.ppf(0.95, 3))),
            }
        )
    return rows


def shapes() -> list[dict[str, Any]]:
    """Return the Fisher bound of gains by shape of pad."""
    rows = []
    for aspect in (1.0, 1.2, 1.5, 1.8, 2.0, 2.2, 2.5, 3.0):
        deviation = gain_deviation(Rectangle(aspect, 1.0))
        refused = "refused" if new_gain_estimator(Rectangle(aspect, 1.0)).estimate.status == "invalid" else ""
        rows.append({"pad": f"{aspect:g}:1", "std / noise, 400 contacts": deviation, "": refused})
    return rows


def draw(path: Path, fisher: list[dict[str, Any]]) -> None:
    figure, axes = plt.subplots(figsize=(7, 4.8), layout="constrained")
    for label in PADS:
        for elongated, style in (("0 %", "o-"), ("10 %", "s--"), ("30 %", "^:")):
            for noise, color in (("1e-04", "tab:blue"), ("1e-03", "tab:red")):
                rows = [
                    r for r in fisher if (r["pad"], r["elongated"], r["noise"]) == (label, elongated, noise)
                ]
                axes.plot(
                    [r["contacts"] for r in rows],
                    [r["error / bound"] * r["bound, %"] for r in rows],
                    style,
                    color=color,
                    alpha=1.0 if label == "1:1" else 0.5,
                    label=f"{label}, noise {noise}, {elongated} elongated",
                )
    axes.set(xscale="log", yscale="log", xlabel="contacts", ylabel="gain error, rms %")
    axes.set_title("Gain error (the bound is a line of slope -1/2)")
    axes.set_ylim(top=30)  # room for the legend
    axes.legend(fontsize=6, ncols=2, loc="upper center")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def points(quick: bool) -> tuple[str, list[dict[str, Any]]]:
    seeds = 2 if quick else TRIALS
    note = (
        f"{seeds} trials each; gains {100 * GAIN_STD:g} % off; root mean square over trials and "
        "channels; the ratio's own scatter is 5 %. Pads whose deployment states no tolerances of parts: the "
        "daemon assumes an error of the fractions at each position that neither gains nor noise explain. So "
        "further contacts add less than noise alone would allow, and the stated deviation is larger than "
        "the error on pads, as here, that have no such error."
    )
    return note, [row for label in PADS for noise in (1e-4, 1e-3) for row in trials(label, noise, 0.0, seeds)]


def exact(quick: bool) -> tuple[str, list[dict[str, Any]]]:
    seeds = 2 if quick else TRIALS
    note = (
        f"{seeds} trials each. The bound is that of pads whose fractions are exactly those of the model, "
        "and the same estimator reaches it if it is given that assumption (`model_error` 0). What the table "
        "above has beyond is the price of the daemon's."
    )
    return note, [row for label in PADS for row in trials(label, 1e-4, 0.0, seeds, exact_model_estimator)]


def edges(quick: bool) -> tuple[str, list[dict[str, Any]]]:
    seeds = 1 if quick else TRIALS_ELONGATED
    note = (
        f"{seeds} trials each. Some contacts are two points 0.06 to 0.3 of the shorter side "
        "apart, at any angle. The bound is that of as many points."
    )
    cases = [(label, noise, part) for label in PADS for noise in (1e-4, 1e-3) for part in (0.1, 0.3)]
    return note, [row for case in cases for row in trials(*case, seeds)]


TABLES: dict[str, Callable[[bool], tuple[str, list[dict[str, Any]]]]] = {
    "Error against the Fisher bound": points,
    "With an exact model": exact,
    "With elongated contacts among them": edges,
    "Shapes": lambda _: ("Fisher bound for the least certain gain.", shapes()),
}


def main() -> None:
    quick = options(__doc__).parse_args().quick
    out = output_folder(quick)
    page, found = [], {}
    for title, measure in TABLES.items():
        note, found[title] = measure(quick)
        page += table(title, note, found[title])
        progress(title)
    fisher, _, elongated, _ = found.values()
    draw(out / "gains.png", fisher + elongated)
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, "
        f"numpy {np.__version__}, scipy {scipy.__version__}"
    )
    head = ["# Gains from ordinary contacts", "", f"{made_by()}; {machine}.", ""]
    (out / "gains.md").write_text("\n".join([*head, *page, "![gains](gains.png)", ""]))
    (out / "gains.json").write_text(json.dumps({"machine": machine, "tables": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
