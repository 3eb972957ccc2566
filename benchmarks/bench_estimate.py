"""Location from noisy currents: against the Cramer-Rao bound, and false alarms of the test for a point.

Contacts 5 % of a side and farther from the edges, each by its own bound; a ratio below one is possible, as
estimates stay on the pad and the bound does not. The limits are those of pads up to 1.77:1. False alarms:
counted over configured rate, with the scatter of counting, on a pad of 1.77:1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from benchmarks.page import Report, options, progress
from benchmarks.scores import Estimates, EstimateScore, laplace_covariance
from handtouch.field import ElectrodeNetwork, Rectangle
from handtouch.field.model import ForwardModel

FloatArray = NDArray[np.float64]

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
MAX_RATIO = {"1e-5": 1.05, "1e-4": 1.05, "1e-3": 1.05, "3e-3": 1.05, "1e-2": 1.15}
"""Aimed at, by noise."""


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
                "50 / 95 / 99 %": score.ratio_quantiles,
                "in 95 %": score.coverage[0.95],
                "no location": score.valid.total - score.valid.count,
                "not converged": float(1 - found.converged.mean()),
            }
            rows.append(row)
        progress(f"efficiency on a pad of {label}")
    return rows


def false_alarms(trials: int) -> list[dict[str, Any]]:
    """Rate at which the residual of a point is beyond a limit, against that of a normal number."""
    pad, rows = Rectangle(1.77, 1.0), []
    for part, noise in enumerate((1e-4, 1e-3, 1e-2)):
        sigma, scores, batches = np.full(4, noise), [], trials // BATCH
        for seed in range(part * batches, (part + 1) * batches):
            currents = noisy(pad, sigma, BATCH, 100 + seed)[2]
            scores.append(np.sqrt(pad.estimate(currents, noise).chi_squared))
        score = np.concatenate(scores)
        row: dict[str, Any] = {"noise": noise, "trials": trials}
        for rate in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
            count, expected = int((score > -ndtri(rate / 2)).sum()), rate * trials
            row[f"at {rate:.0e}"] = f"{count / expected:.2f} +- {expected**-0.5:.2f}"
        progress(f"false alarms with noise {noise:g}")
        rows.append(row)
    return rows


def main() -> None:
    quick = options(__doc__).parse_args().quick
    trials, alarm_trials = (500, BATCH) if quick else (TRIALS, ALARM_TRIALS)
    report = Report(quick, contacts=trials)
    rows = efficiency(trials)
    report.table("Error against the Cramer-Rao bound", rows)
    for noise, limit in MAX_RATIO.items():
        short = [row for row in rows if row["noise per total"] == noise and row["pad"] in ("1:1", "1.77:1")]
        report.limit(f"error / bound, rms, noise {noise}", max(r["error / bound, rms"] for r in short), limit)
    report.table("False alarms of the test for a point", false_alarms(alarm_trials))
    report.keep()


if __name__ == "__main__":
    main()
