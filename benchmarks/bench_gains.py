"""Gains from ordinary contacts: self-calibration with the daemon's settings, beside the Fisher bound.

Root mean square over trials and channels, gains 2 % off. Pads whose deployment states no tolerances of parts:
the daemon assumes an error of the fractions at each position that neither gains nor noise explain, so the
stated deviation is larger than the error on pads, as here, that have no such error. *With an exact model*:
the same estimator told that there is none (`model_error` 0), as the bound assumes. *Elongated*: some contacts
are two points 0.06 to 0.3 of the shorter side apart, at any angle; the bound is that of as many points. On
hands of the worlds see [worlds](worlds.md), and [swap](swap.md) for errors by number of contacts.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.page import Report, options, progress
from benchmarks.scores import Share
from handtouch.calibration.auto_calibration import new_gain_estimator
from handtouch.calibration.contact_scores import fisher_covariance
from handtouch.calibration.gains import GainEstimator
from handtouch.field import Rectangle

FloatArray = NDArray[np.float64]

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
                "in 95 % ellipsoid, %": Share.of_mask(np.array(distances[count]) < chi2.ppf(0.95, 3)),
            }
        )
    return rows


def main() -> None:
    quick = options(__doc__).parse_args().quick
    seeds, elongated_seeds = (2, 1) if quick else (TRIALS, TRIALS_ELONGATED)
    report = Report(quick, trials=seeds, trials_elongated=elongated_seeds)
    noises = (1e-4, 1e-3)
    points = [row for label in PADS for noise in noises for row in trials(label, noise, 0.0, seeds)]
    report.table("Error against the Fisher bound", points)
    progress("points")
    exact = [row for label in PADS for row in trials(label, 1e-4, 0.0, seeds, exact_model_estimator)]
    report.table("With an exact model", exact)
    cases = [(label, noise, part) for label in PADS for noise in noises for part in (0.1, 0.3)]
    rows = [row for case in cases for row in trials(*case, elongated_seeds)]
    report.table("With elongated contacts among them", rows)
    report.keep()


if __name__ == "__main__":
    main()
