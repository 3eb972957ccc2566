"""Most likely contacts on pads of any outline: damped Gauss-Newton steps bounded by the outline.

Across a bare boundary currents don't change to first order, and near an electrode they change as the root of
the distance, so that plain Gauss-Newton steps overshoot there. Steps are damped (Levenberg-Marquardt), end at
the boundary, and run along it where the likelihood rises towards the outside. Every element starts from the
most likely points of a grid and of the boundary; the better result counts.
"""

from __future__ import annotations

import numpy as np

from handtouch.field.estimate import (
    MAX_SETTLED_DECREMENT,
    MAX_STEP,
    BoolArray,
    LikelihoodFit,
    WhitenedModel,
)
from handtouch.field.model import MIN_INSET, FloatArray, PadBoundary

_MAX_STEPS = 200
_MAX_SLOW_STEPS = 4  # steps in a row that gain less than is looked for
_GRID = 25  # points per side of the search for a start
_GRID_OFFSET = 0.4681  # of a grid cell: keeps the points off edges in simple ratios
_BOUNDARY_POINTS = 96
_INSETS = (0.003, 0.01, 0.03, 0.08)  # of the larger extent
_AT_BOUNDARY = 1.5  # of the least distance from it
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-7, 1e14


class OutlineFit(LikelihoodFit):
    """Fits on a model with `project_inside` and `boundary_points`, see `OutlineNetwork`."""

    def search(
        self, begin: FloatArray | None, known: BoolArray
    ) -> tuple[FloatArray, WhitenedModel, BoolArray]:
        if begin is not None:
            return self.climb(begin, known)
        result = self.climb(self.initial_positions(), known)
        boundary = np.stack(self.model.boundary_points(_BOUNDARY_POINTS)) / self.sides  # type: ignore[attr-defined]
        self._keep_better(result, self.most_likely_of(boundary), known)
        # across a bare boundary the slope is zero, whether the likelihood rises or falls farther inside
        self._keep_better(result, self._inward(result[0]), known)
        return result

    def _keep_better(
        self, result: tuple[FloatArray, WhitenedModel, BoolArray], begin: FloatArray, known: BoolArray
    ) -> None:
        """Climb from other points (2, n), and replace what is worse in `result`."""
        point, best, converged = result
        other, found, settled = self.climb(begin, known)
        better = (found.total > 0) & ((found.cost < best.cost) | (best.total <= 0)) & (settled | ~converged)
        point[:, better], converged[better] = other[:, better], settled[better]
        best.assign(better, found.select(better))

    def _inward(self, point: FloatArray) -> FloatArray:
        """Return the most likely of points (2, n) straight inwards from the boundary next to them."""
        boundary = self._project(point)
        normal = np.stack([boundary.normal_x, boundary.normal_y]) / self.sides * self.sides.max()
        best, cost = np.array(point), np.full(point.shape[1], np.inf)
        for inset in _INSETS:
            trial = self.move_inside(point + inset * normal)
            new = self.linearise(trial, slice(None))
            better = (new.cost < cost) & (new.total > 0)
            best[:, better], cost[better] = trial[:, better], new.cost[better]
        return best

    def initial_positions(self) -> FloatArray:
        side = (np.arange(_GRID) + _GRID_OFFSET) / _GRID
        return self.most_likely_of(np.stack([place.ravel() for place in np.meshgrid(side, side)]))

    def move_inside(self, point: FloatArray) -> FloatArray:
        found = self._project(point)
        return np.asarray(np.stack([found.x, found.y]) / self.sides)

    def climb(self, begin: FloatArray, known: BoolArray) -> tuple[FloatArray, WhitenedModel, BoolArray]:
        point = self.move_inside(np.where(np.isfinite(begin), begin, 0.5))
        lost = ~np.isfinite(point).all(axis=0)
        if lost.any():
            point[:, lost] = self.initial_positions()[:, lost]
        point = np.where(known, point, np.nan)
        best = self.linearise(point, slice(None))
        converged = np.zeros(point.shape[1], np.bool_)
        damping = np.full(point.shape[1], _FIRST_DAMPING)
        slow_steps = np.zeros(point.shape[1], np.intp)
        settled = MAX_SETTLED_DECREMENT * self.noise_unit**2
        active = np.flatnonzero(known)
        for _ in range(_MAX_STEPS):
            if not active.size:
                break
            here, at = point[:, active], best.select(active)
            step, gain = self._damped_step(at, here, damping[active])
            trial = self.move_inside(here + step)
            new = self.linearise(trial, active)
            accept = ((new.cost <= at.cost) & (new.total > 0)) | ((at.total <= 0) & np.isfinite(new.cost))
            slow = accept & (at.total > 0) & (at.cost - new.cost < settled[active])
            slow_steps[active] = np.where(
                slow, slow_steps[active] + 1, np.where(accept, 0, slow_steps[active])
            )
            point[:, active[accept]] = trial[:, accept]
            best.assign(active[accept], new.select(accept))
            damping[active] = np.clip(
                np.where(accept, damping[active] / 8, damping[active] * 6), _MIN_DAMPING, _MAX_DAMPING
            )
            # no step that is damped enough to be trusted promises more, or none brought more
            done = (gain < settled[active]) | (slow_steps[active] >= _MAX_SLOW_STEPS)
            converged[active[done]] = best.total[active[done]] > 0
            active = active[~done]
        return point, best, converged

    def _project(self, point: FloatArray) -> PadBoundary:
        found: PadBoundary = self.model.project_inside(*(point * self.sides))  # type: ignore[attr-defined]
        return found

    def _damped_step(
        self, at: WhitenedModel, point: FloatArray, damping: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the step (2, n), along the boundary if there, and the gain of likelihood expected of it."""
        slopes = at.slopes * at.total
        gradient = (slopes * at.misfit).sum(1)
        boundary = self._project(point)
        normal = np.stack([boundary.normal_x, boundary.normal_y]) / self.sides
        along = np.stack([-boundary.normal_y, boundary.normal_x]) / self.sides
        held = boundary.distance <= _AT_BOUNDARY * MIN_INSET * self.sides.max()
        held &= (gradient * normal).sum(0) < 0
        xx, yy = (slopes * slopes).sum(1) * (1 + damping)
        xy = (slopes[0] * slopes[1]).sum(0)
        with np.errstate(all="ignore"):
            determinant = xx * yy - xy * xy
            free = np.stack([yy * gradient[0] - xy * gradient[1], xx * gradient[1] - xy * gradient[0]])
            free /= determinant
            free = np.where(determinant > 1e-14 * xx * yy, free, gradient / np.maximum(xx, yy))
            tangent = (slopes * along[:, None]).sum(0)
            stiffness = (tangent * tangent).sum(0) * (1 + damping)
            bound = along * ((gradient * along).sum(0) / stiffness)
        step = np.where(held, bound, free)
        step = np.where(np.isfinite(step), step, 0.0)
        length = np.maximum((np.abs(step) * self.aspect).max(0), 1e-300)
        step = step * np.minimum(1.0, MAX_STEP / length)
        return step, (gradient * step).sum(0)
