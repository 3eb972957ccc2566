"""Goals of a design: each a map over the pad, and one number of it to minimise.

Public names: `Goal`, `GOALS`, `Statistic`, `goal_map`, `goal_value`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.design.layout import ElectrodeLayout
from handtouch.design.pad_task import PadTask
from handtouch.design.response import ContactResponse, contact_response

Statistic = Literal["worst", "mean"]

SMOOTH_POWER = 24
"""The worst value is approached by this norm, which has derivatives everywhere."""
_MIN_FRACTION = 1e-12
PAIR_SCORE = NormalDist().inv_cdf(1 - 0.5e-3) + NormalDist().inv_cdf(0.9)
"""Residual, in standard deviations, that shows a pair with probability 0.9, at a false-alarm rate of 1e-3."""
_SIDES = {"y0": 0, "xa": 1, "yb": 2, "x0": 3}  # channels of a layout with one electrode on each side


@dataclass(frozen=True)
class Goal:
    """A goal: `compute` returns its values (k,) on the task's grid, which `factor` converts to `unit`."""

    name: str
    description: str
    unit: str
    factor: float
    compute: Callable[[PadTask, ElectrodeLayout], FloatArray]
    needs_sides: bool = False
    """True if it is defined for one electrode on each side only."""


def goal_map(goal: Goal, task: PadTask, layout: ElectrodeLayout) -> FloatArray:
    """Return the values of a goal (points, points) in its unit, y slowest.

    Raises ValueError for an impossible layout.
    """
    values = goal.factor * goal.compute(task, layout)
    return values.reshape(task.points, task.points)


def goal_value(values: FloatArray, statistic: Statistic) -> float:
    """Return the greatest value, or the root mean square."""
    return float(values.max() if statistic == "worst" else np.sqrt((values**2).mean()))


def smooth_value(values: FloatArray, statistic: Statistic) -> float:
    """Return `goal_value` or, for the worst, a norm close to it with derivatives."""
    if statistic == "mean":
        return goal_value(values, statistic)
    largest = values.max()
    return float(largest * ((values / largest) ** SMOOTH_POWER).mean() ** (1 / SMOOTH_POWER))


def position_std(task: PadTask, layout: ElectrodeLayout) -> FloatArray:
    """Return the root of the sum of both coordinates' variances [m]."""
    return contact_response(task, layout).position_std


def force_std(task: PadTask, layout: ElectrodeLayout) -> FloatArray:
    """Return the relative standard deviation of the force."""
    covariance = contact_response(task, layout, with_force=True).estimate_covariance
    return np.asarray(np.sqrt(covariance[:, 2, 2]))


def pair_separation(task: PadTask, layout: ElectrodeLayout) -> FloatArray:
    """Return the distance [m] of two equal contacts from which they are distinguished from one.

    For the root mean square of the score over all directions of the pair.
    """
    found = contact_response(task, layout, with_bends=True)
    scores = np.einsum("kib,kij,kjb->k", found.bends, misfit_weights(found), found.bends)
    return np.asarray(np.sqrt(8 * PAIR_SCORE / np.sqrt(scores / 2)))


def misfit_weights(found: ContactResponse) -> FloatArray:
    """Return the weights W (k, m, m) of a misfit d: d' W d is its squared score, less what another position
    or total of one contact explains."""
    inverse = np.linalg.inv(found.covariance)
    weighted = inverse @ found.slopes
    return np.asarray(inverse - weighted @ found.estimate_covariance @ np.swapaxes(weighted, 1, 2))


def log_ratio_error(task: PadTask, layout: ElectrodeLayout) -> FloatArray:
    """Return the root mean square error [m] of positions read off the plain log-ratios of opposite currents.

    Each log-ratio is scaled by its least-squares line over the grid, as in the paper's fig. 6. What remains
    is added to the standard deviation from noise and parts.
    """
    found = contact_response(task, layout)
    fractions = np.maximum(found.fractions, _MIN_FRACTION)
    squares = line_errors(task, fractions, fractions)
    for near, far, slope in _log_ratio_lines(task, fractions):
        weights = np.zeros_like(fractions)
        weights[:, near], weights[:, far] = -1 / fractions[:, near], 1 / fractions[:, far]
        squares += np.einsum("ki,kij,kj->k", weights, found.covariance, weights) / slope[1] ** 2
    return np.asarray(np.sqrt(squares))


def line_errors(task: PadTask, nominal: FloatArray, currents: FloatArray) -> FloatArray:
    """Return squared errors [m^2] (k,) of positions read off the log-ratios of `currents` (k, 4), by the
    lines that fit those of the `nominal` pad."""
    squares = np.zeros(len(currents))
    currents = np.maximum(currents, _MIN_FRACTION)
    for truth, (near, far, line) in zip(_coordinates(task), _log_ratio_lines(task, nominal), strict=True):
        ratio = np.log(currents[:, far] / currents[:, near])
        squares += ((ratio - line[0]) / line[1] - truth) ** 2
    return squares


def _log_ratio_lines(task: PadTask, fractions: FloatArray) -> list[tuple[int, int, FloatArray]]:
    """Return, along u and along v, both channels and the line (offset, slope) through their log-ratio."""
    lines = []
    for truth, near, far in zip(_coordinates(task), ("x0", "y0"), ("xa", "yb"), strict=True):
        i, j = _SIDES[near], _SIDES[far]
        ratio = np.log(
            np.maximum(fractions[:, j], _MIN_FRACTION) / np.maximum(fractions[:, i], _MIN_FRACTION)
        )
        line = np.linalg.lstsq(np.column_stack([np.ones_like(truth), truth]), ratio, rcond=None)[0]
        lines.append((i, j, np.asarray(line)))
    return lines


def _coordinates(task: PadTask) -> tuple[FloatArray, FloatArray]:
    """Return arc lengths u from x0 and v from the centre line [m], of the grid."""
    x, y = task.grid
    u, v = task.surface.from_rectangle(x, y)
    return u, v - task.surface.from_rectangle(x, np.full_like(x, task.surface.b / 2))[1]


GOALS = {
    goal.name: goal
    for goal in (
        Goal("position", "standard deviation of position", "mm", 1e3, position_std),
        Goal("force", "standard deviation of force", "%", 100.0, force_std),
        Goal("two-contacts", "least separation of two equal contacts", "mm", 1e3, pair_separation),
        Goal("linearity", "error of position from plain log-ratios", "mm", 1e3, log_ratio_error, True),
    )
}
"""By name."""
