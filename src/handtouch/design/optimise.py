"""The best layout for a goal within limits of manufacture.

Public names: `optimise_layout`, `DesignResult`.

Logarithms of the smooth goal are minimised by L-BFGS-B from several starts, with derivatives by differences.
Variables are scaled so that their box holds every limit: bare lengths of electrodes on sides, or the shares
that electrodes and gaps anywhere have in what is left of the boundary after all least lengths.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.design.goals import Goal, Statistic, goal_map, goal_value, smooth_value
from handtouch.design.layout import ElectrodeLayout, FabricationLimits
from handtouch.design.pad_task import PadTask
from handtouch.field import Surface

_STARTS_ANYWHERE = 3
_ITERATIONS = 60
_STEP = 1e-5  # step of differences, in variables of order 1
_LAST_STEP = 1e-4
"""Of the best start, continued until it converges: above the rounding of any processor's arithmetic. Where
starts stop at the limit of iterations differs by it, 0.757 to 0.828 mm in the example of docs/design.md; from
there they reach one layout, 0.740 mm."""
_ENOUGH = 1e-6  # gain in the logarithm of the goal: an iteration that gains less is the last
_FAILED = 20.0  # logarithm of the goal of an impossible layout
_FINE_POINTS = 17  # points of a side, for values that are reported
_MAX_LOG_SHARE = 3.0


@dataclass(frozen=True)
class DesignResult:
    """Layouts before and after, with maps (points, points) and values of the goal in its unit."""

    goal: Goal
    statistic: Statistic
    before: ElectrodeLayout
    after: ElectrodeLayout
    map_before: FloatArray
    map_after: FloatArray

    @property
    def value_before(self) -> float:
        """Value of the deployment's layout."""
        return goal_value(self.map_before, self.statistic)

    @property
    def value_after(self) -> float:
        """Value of the best layout."""
        return goal_value(self.map_after, self.statistic)


class SideLayouts:
    """One electrode on each side, over its middle; variables: roots of the bare lengths [mm] above the least
    one, and resistors in units of the largest. On a pad that is its own mirror image, so are the layouts."""

    def __init__(self, task: PadTask, limits: FabricationLimits) -> None:
        self._limits, self._corners = limits, task.boundary.corners_m
        lengths = np.diff(self._corners)
        longest_m = (lengths - 1e-3 * limits.min_electrode_mm) / 2
        if not (longest_m >= 1e-3 * limits.min_gap_mm).all():
            raise ValueError("min_gap_mm and min_electrode_mm leave no electrode on the shortest side")
        most = np.append(np.repeat(np.sqrt(1e3 * longest_m - limits.min_gap_mm), 2), np.ones(4))
        if limits.max_series_ohm == 0:
            most = most[:8]
        mirrored = [image[: len(most)] for image in _mirror_images(task.surface)]
        first = np.arange(len(most))  # lowest number among the images of each length and resistor
        for _ in mirrored:
            for image in mirrored:
                first = np.minimum(first, first[image])
        self._free, self._variable_of = np.unique(first, return_inverse=True)
        self.bounds = [(0.0, float(most[number])) for number in self._free]
        self._most = most
        self._configured = task.configured

    def layout(self, variables: FloatArray) -> ElectrodeLayout:
        """Return the layout of variables."""
        values = variables[self._variable_of]
        gaps_m = 1e-3 * (self._limits.min_gap_mm + values[:8].reshape(4, 2) ** 2)
        stretches = np.column_stack([self._corners[:-1] + gaps_m[:, 0], self._corners[1:] - gaps_m[:, 1]])
        ohm = self._limits.max_series_ohm * values[8:] if len(values) > 8 else np.zeros(4)
        return ElectrodeLayout(stretches, ohm)

    def starts(self) -> list[FloatArray]:
        """Return the configured layout, and others with longer gaps and with resistors."""
        ends = np.column_stack([self._corners[:-1], self._corners[1:]])
        gaps_mm = 1e3 * np.abs(self._configured.stretches_m - ends).ravel()
        own = np.sqrt(np.maximum(gaps_mm - self._limits.min_gap_mm, 0.01))
        starts = [(own, 0.02), (np.ones(8), 0.2), (0.5 * self._most[:8], 0.1)]
        return [np.append(gaps, np.full(4, ohm))[self._free] for gaps, ohm in starts]


def _mirror_images(surface: Surface) -> list[NDArray[np.intp]]:
    """Return, for each mirror image of the rectangle that leaves the surface as it is, the numbers (12,) of
    the ends and resistors that those of y0, xa, yb and x0 go to."""
    steps = np.linspace(0.05, 0.95, 7)
    x, y = np.meshgrid(steps * surface.a, steps * surface.b)
    scale = surface.scale(x, y)
    images = []
    if np.allclose(scale, scale[::-1], rtol=1e-6):
        images.append(np.array([5, 4, 3, 2, 1, 0, 7, 6, 10, 9, 8, 11]))
    if np.allclose(scale, scale[:, ::-1], rtol=1e-6):
        images.append(np.array([1, 0, 7, 6, 5, 4, 3, 2, 8, 11, 10, 9]))
    return images


class RingLayouts:
    """Electrodes anywhere on the boundary; variables: logarithms of shares of electrodes and of gaps in what
    is left after least lengths, and the begin of the first in pitches."""

    def __init__(self, task: PadTask, limits: FabricationLimits, count: int) -> None:
        self._count, self._perimeter_m = count, task.boundary.perimeter_m
        self._least_m = 1e-3 * np.array([limits.min_electrode_mm, 2 * limits.min_gap_mm])
        self._free_m = self._perimeter_m - count * float(self._least_m.sum())
        if self._free_m <= 0:
            raise ValueError(f"min_gap_mm and min_electrode_mm leave no room for {count} electrodes")
        shares = [(-_MAX_LOG_SHARE, _MAX_LOG_SHARE)] * count
        self.bounds = [*shares, *[(low - 4.0, high - 2.0) for low, high in shares], (-1.0, 1.0)]

    def layout(self, variables: FloatArray) -> ElectrodeLayout:
        """Return the layout of variables (2 n + 1,)."""
        shares = np.exp(variables[:-1]).reshape(2, self._count)
        electrodes_m, gaps_m = self._free_m * shares / shares.sum() + self._least_m[:, None]
        pitches = electrodes_m + gaps_m
        first = variables[-1] * self._perimeter_m / self._count
        begin = first + np.append(0.0, np.cumsum(pitches[:-1]))
        return ElectrodeLayout(np.column_stack([begin, begin + electrodes_m]), np.zeros(self._count))

    def starts(self) -> list[FloatArray]:
        """Return even and uneven layouts at different begins, always the same."""
        rng = np.random.default_rng(self._count)
        even = np.append(np.zeros(self._count), np.full(self._count, -3.0))
        return [
            np.append(even + (0.3 * rng.standard_normal(even.size) if number > 0 else 0.0), number / 3 - 0.3)
            for number in range(_STARTS_ANYWHERE)
        ]


def optimise_layout(
    task: PadTask,
    goal: Goal,
    statistic: Statistic = "worst",
    limits: FabricationLimits | None = None,
    electrodes: int | None = None,
    on_progress: Callable[[str], None] = lambda _: None,
    starts: int | None = None,
) -> DesignResult:
    """Return the best layout of a pad for a goal.

    electrodes: number of electrodes anywhere on the boundary; None: one on each side, over its middle, with
    resistors. on_progress is called with a line about each better layout. starts: their number, if fewer
    than usual. Raises ValueError for limits that
    no layout meets, and for a goal that needs one electrode on each side.
    """
    limits = limits or FabricationLimits()
    if electrodes is not None and goal.needs_sides:
        raise ValueError(
            f"goal {goal.name} needs one electrode on each side; leave out the number of electrodes"
        )
    space = SideLayouts(task, limits) if electrodes is None else RingLayouts(task, limits, electrodes)
    search = _Search(task, goal, statistic, space, on_progress)
    best = _rounded(search.run(starts), task, limits)
    fine = task.with_points(_FINE_POINTS)
    before, after = (goal_map(goal, fine, layout) for layout in (task.configured, best))
    if goal_value(before, statistic) <= goal_value(after, statistic) and electrodes is None:
        best, after = task.configured, before  # nothing better was found
    return DesignResult(goal, statistic, task.configured, best, before, after)


class _Search:
    """Minimisation from several starts."""

    def __init__(
        self,
        task: PadTask,
        goal: Goal,
        statistic: Statistic,
        space: SideLayouts | RingLayouts,
        on_progress: Callable[[str], None],
    ) -> None:
        self._task, self._goal, self._statistic, self._space = task, goal, statistic, space
        self._on_progress = on_progress
        self._best = math.inf
        self._start = 0
        self.evaluations = 0

    def run(self, most_starts: int | None) -> ElectrodeLayout:
        """Return the best layout of all starts."""
        from scipy.optimize import minimize

        found = []

        def minimised(start: FloatArray, step: float) -> Any:
            return minimize(
                self._cost,
                start,
                method="L-BFGS-B",
                bounds=self._space.bounds,
                options={"maxiter": _ITERATIONS, "eps": step, "ftol": _ENOUGH, "maxfun": 10_000},
            )

        starts = self._space.starts()[:most_starts]
        for number, start in enumerate(starts, 1):
            self._start = number
            lower, upper = np.array(self._space.bounds).T
            result = minimised(np.clip(start, lower, upper), _STEP)
            found.append((float(result.fun), number, result.x))
        last = minimised(min(found)[2], _LAST_STEP)
        return self._space.layout(min((float(last.fun), 0, last.x), min(found))[2])

    def _cost(self, variables: FloatArray) -> float:
        self.evaluations += 1
        try:
            values = goal_map(self._goal, self._task, self._space.layout(variables))
        except (ValueError, np.linalg.LinAlgError):
            return _FAILED
        if not np.isfinite(values).all():
            return _FAILED
        value = goal_value(values, self._statistic)
        if value < self._best * (1 - 1e-4):
            self._best = value
            self._on_progress(
                f"start {self._start}, evaluation {self.evaluations}: {self._statistic} {value:.4g} "
                f"{self._goal.unit}"
            )
        return math.log(smooth_value(values, self._statistic))


def _rounded(layout: ElectrodeLayout, task: PadTask, limits: FabricationLimits) -> ElectrodeLayout:
    """Return the layout with lengths in multiples of a step, and resistors of the E24 series."""
    step_m, ohm = 1e-3 * limits.step_mm, [limits.standard_resistor(r) for r in layout.series_ohm.tolist()]
    if not layout.is_on_sides(task.boundary):
        return ElectrodeLayout(np.round(layout.stretches_m / step_m) * step_m, np.array(ohm))
    corners = task.boundary.corners_m
    ends = np.column_stack([corners[:-1], corners[1:]])
    least_m = 1e-3 * limits.min_gap_mm
    gaps = np.maximum(np.round(np.abs(layout.stretches_m - ends) / step_m) * step_m, least_m)
    return ElectrodeLayout(ends + gaps * [1, -1], np.array(ohm))
