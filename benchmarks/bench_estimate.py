"""Measure location from noisy currents: against the Cramer-Rao bound, false alarms, and resolution.

Prints its tables and writes docs/benchmarks/estimate.md, estimate.json and estimate.png.
"""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import ndtri

from benchmarks.page import made_by, options, output_folder, progress, table
from benchmarks.scores import Estimates, EstimateScore, laplace_covariance
from handtouch.field import (
    ElectrodeNetwork,
    Rectangle,
    point_test,
    resolvable_separation,
)
from handtouch.field.model import ForwardModel

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
TRIALS = 40_000
MARGIN = 0.05
PADS: dict[str, Rectangle | ElectrodeNetwork] = {
    "1:1": Rectangle(1.0, 1.0),
    "1.77:1": Rectangle(1.77, 1.0),
    "3:1": Rectangle(3.0, 1.0),
    "1.77:1, gaps 2 %, 4 x 0.05 of the sheet": ElectrodeNetwork(1.77, 1.0, 0.02, 1.0, (0.05,) * 4),
}
NOISES: dict[str, float | tuple[float, float, float, float]] = {
    "1e-5": 1e-5,
    "1e-4": 1e-4,
    "1e-3": 1e-3,
    "3e-3": 3e-3,
    "1e-2": 1e-2,
    "(3, 10, 1, 5)e-4": (3e-4, 1e-3, 1e-4, 5e-4),
}
ALARM_TRIALS = 4_000_000
BATCH = 100_000


def noisy(
    pad: ForwardModel, sigma: FloatArray, count: int, seed: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(MARGIN, 1 - MARGIN, (2, count)) * np.array([[pad.a], [pad.b]])
    return x, y, pad.fractions(x, y) + sigma[:, None] * generator.normal(size=(4, count))


def bound(pad: ForwardModel, x: FloatArray, y: FloatArray, sigma: FloatArray) -> FloatArray:
    """Least possible covariance (n, 2, 2) of a position, from the public Jacobian."""
    fractions, jacobian = pad.fractions_with_jacobian(x, y)
    design = np.moveaxis(np.concatenate([jacobian, fractions[:, None]], axis=1), 2, 0)
    return laplace_covariance(design, sigma, np.full(3, np.inf))[:, :2, :2]


def efficiency(trials: int) -> list[dict[str, Any]]:
    """Error of each contact in units of its own bound, and coverage."""
    rows = []
    for label, pad in PADS.items():
        for name, level in NOISES.items():
            sigma = np.broadcast_to(np.asarray(level, dtype=np.float64), (4,))
            x, y, currents = noisy(pad, sigma, trials, 1)
            least = bound(pad, x, y, sigma)
            bound_rms = np.sqrt(np.trace(least, axis1=1, axis2=2))
            found = pad.estimate(currents, sigma[:, None])
            row: dict[str, Any] = {
                "pad": label,
                "noise per total": name,
                "bound, median of the shorter side": float(np.median(bound_rms) / min(pad.a, pad.b)),
            }
            error = np.stack([found.x - x, found.y - y], axis=1)
            score = EstimateScore.of_estimates(
                Estimates(error, found.covariance[:, :2, :2], ~np.isnan(found.x), bound_rms, least)
            )
            row |= {
                "error / bound, rms": score.ratio_rms,
                "50 / 95 / 99 %": " / ".join(f"{q:.3g}" for q in score.ratio_quantiles),
                "in 95 %": str(score.coverage[0.95]),
                "no location": score.valid.total - score.valid.count,
                "not converged": float(1 - found.converged.mean()),
            }
            rows.append(row)
        progress(f"efficiency on a pad of {label}")
    return rows


def false_alarms(trials: int) -> list[dict[str, Any]]:
    """Rate at which a point fails the test, against the configured rate."""
    pad, rows = Rectangle(1.77, 1.0), []
    for part, noise in enumerate((1e-4, 1e-3, 1e-2)):
        sigma, scores, batches = np.full(4, noise), [], trials // BATCH
        for seed in range(part * batches, (part + 1) * batches):
            currents = noisy(pad, sigma, BATCH, 100 + seed)[2]
            scores.append(np.abs(point_test(pad, currents, noise).score))
        score = np.concatenate(scores)
        row: dict[str, Any] = {"noise": noise, "trials": trials}
        for rate in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
            count, expected = int((score > -ndtri(rate / 2)).sum()), rate * trials
            row[f"at {rate:.0e}"] = f"{count / expected:.2f} +- {expected**-0.5:.2f}"
        progress(f"false alarms with noise {noise:g}")
        rows.append(row)
    return rows


def draw_resolution(path: Path, cells: int) -> None:
    """Resolvable distance of two equal contacts over the pad, for three noises."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 8), layout="constrained")
    pad = Rectangle(1.0, 1.0)
    side = np.linspace(0.06, 0.94, cells)
    x, y = np.meshgrid(side, side)
    for row, (angle, words) in enumerate(((0.0, "along x"), (np.pi / 4, "at 45 degrees"))):
        for axis, noise in zip(axes[row], (1e-4, 1e-3, 5e-3), strict=True):
            apart = resolvable_separation(pad, x, y, noise, angle=angle)
            shown = axis.contourf(
                x, y, np.where(np.isinf(apart), np.nan, apart), levels=np.linspace(0, 0.6, 13)
            )
            axis.set(title=f"{words}, noise {100 * noise:g} % of the total", aspect="equal", facecolor="0.85")
    figure.colorbar(shown, ax=axes, label="distance of two contacts distinguished from one, sides")
    figure.suptitle(
        "Two equal contacts distinguished from one (false alarms 1e-3, detection 0.9); grey: never on the pad"
    )
    figure.savefig(path, dpi=100)


def main() -> None:
    quick = options(__doc__).parse_args().quick
    trials, alarm_trials = (500, BATCH) if quick else (TRIALS, ALARM_TRIALS)
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, "
        f"numpy {np.__version__}, scipy {scipy.__version__}"
    )
    tables = {
        "Error against the Cramer-Rao bound": (
            f"{trials} contacts each, 5 % of a side and farther from the edges. Aim: 1.05 up to 3e-3, 1.15 "
            "at 1e-2, up to 1.77:1. Each contact by its own bound; below one is possible: estimates stay on "
            "the pad, the bound does not.",
            efficiency(trials),
        ),
        "False alarms of the test for a point": (
            "Counted over configured rate, with the scatter of counting. Pad 1.77:1, 5 % margin.",
            false_alarms(alarm_trials),
        ),
    }
    page = ["# Location from noisy currents", "", f"{made_by()}; {machine}.", ""]
    for title, (note, rows) in tables.items():
        page += table(title, note, rows)
    page += ["## Two contacts or one", "", "![resolution](estimate.png)", ""]
    out = output_folder(quick)
    (out / "estimate.md").write_text("\n".join(page))
    record = {"machine": machine, "tables": {title: rows for title, (_, rows) in tables.items()}}
    (out / "estimate.json").write_text(json.dumps(record, indent=1) + "\n")
    draw_resolution(out / "estimate.png", 6 if quick else 34)


if __name__ == "__main__":
    main()
