"""Maximum-likelihood contact, with its covariance, from all the noisy currents of any forward model."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.arrays import BoolArray, FloatArray
from handtouch.field.model import ForwardModel, channel_noise

_MAX_STEPS = 40
MAX_SETTLED_DECREMENT = 1e-6  # squared Newton decrement, in variances: the last step leaves far less
_MIN_STEP = 1e-14  # step over a side
_MIN_EDGE_DISTANCE = 1e-9  # distance of an estimate from an edge, over a side
MAX_STEP = 0.5  # step over the shorter side: the range over which the currents are nearly exponential
MAX_STD_SIDES = 1e3  # a coordinate with a larger deviation is reported as unknown
CORNER_RADIUS_FACTOR = 0.7
"""Radius about a corner within which currents carry no information, in shorter sides times the root of the
relative noise."""
_ARC_ITERATIONS = 6  # steps of the search for the direction from a corner
_MIN_CORNER_ANGLE_RAD = 0.02  # angle between a side and an estimate near a corner
_GUESS_BATCH = 8192  # contacts at once, to bound memory
_GUESS_GRID = 9  # points per side of the search for a start


@dataclass(frozen=True)
class PointEstimate:
    """Most likely point contact; arrays of one shape (...), or scalars.

    x, y: position in the unit of the pad, on the pad; NaN, with infinite variance and no covariances, where
    the currents don't determine it: a standard deviation beyond a thousand sides, or no positive total.

    total: the current injected, in the unit of the currents; where no position makes it positive, that of a
    contact at the centre.

    residual: signed excess of (x0 + xa) over that of this point, divided by the total; NaN for a model with
    other channels than x0, xa, y0, yb, where one of the two is excluded, and without a position.

    chi_squared: sum of squared residuals in standard deviations; channels - 3 degrees of freedom for a point.

    covariance: of (x, y, total), shape (..., 3, 3): the Cramer-Rao bound at the estimate. Within a few
    standard deviations of an edge it is too small.

    converged: False where the iteration stopped before the maximum, or found no positive total.
    """

    x: FloatArray
    y: FloatArray
    total: FloatArray
    residual: FloatArray
    chi_squared: FloatArray
    covariance: FloatArray
    converged: BoolArray


def estimate(
    model: ForwardModel, currents: ArrayLike, noise: ArrayLike, start: ArrayLike | None = None
) -> PointEstimate:
    """Return the point contact that makes `currents` most likely under independent normal noise.

    currents: shape (channels, ...), any unit; negative and zero readings are ordinary noise.
    noise: standard deviation of each current, same unit, one for each channel or broadcastable against
        `currents`. An infinite one leaves its channel out; one that is not positive gives NaN.
    start: (x, y), shape (2, ...), where to begin; found from the currents if absent.

    Gauss-Newton on (x, y) with the total eliminated (variable projection), halved until the likelihood rises.
    Raises ValueError if the first axis of `currents` is not the model's channels.
    """
    currents = np.asarray(currents, dtype=np.float64)
    channels = len(model.fractions(model.a / 2, model.b / 2))
    if currents.shape[:1] != (channels,):
        raise ValueError(f"currents have shape {currents.shape}: the first axis is the {channels} channels")
    shape = currents.shape[1:]
    flat = currents.reshape(channels, -1)
    sigma = channel_noise(noise, currents.shape).reshape(channels, -1)
    with np.errstate(all="ignore"):
        sigma = np.where(sigma > 0, sigma, np.nan)
        flat = np.where(np.isinf(sigma), 0.0, flat)  # readings of excluded channels
        # Currents and noise each in a unit of their own, so that squares stay in range.
        unit = np.ldexp(1.0, np.frexp(np.abs(flat).max(axis=0, initial=0.0))[1])
        exponent = np.frexp(sigma.min(axis=0, initial=np.inf))[1]
        fit = LikelihoodFit(model, flat / unit, np.ldexp(sigma, -exponent), np.ldexp(1.0, exponent) / unit)
        if start is None:
            begin = None
        else:
            begin = (
                np.broadcast_to(np.asarray(start, dtype=np.float64), (2, *shape)).reshape(2, -1) / fit.sides
            )
        result = fit.maximise(begin, unit)
    return PointEstimate(
        x=result.x.reshape(shape)[()],
        y=result.y.reshape(shape)[()],
        total=result.total.reshape(shape)[()],
        residual=result.residual.reshape(shape)[()],
        chi_squared=result.chi_squared.reshape(shape)[()],
        covariance=result.covariance.reshape(*shape, 3, 3),
        converged=result.converged.reshape(shape)[()],
    )


@dataclass(frozen=True)
class WhitenedModel:
    """The model at one point of each element, whitened; total eliminated.

    total: its best value, (n,). misfit: whitened residuals, (channels, n). fractions: whitened. slopes: their
    derivatives by x and y, (2, channels, n), less `mixing` times the fractions, which the total absorbs.
    cost: sum of squared residuals.
    """

    total: FloatArray
    misfit: FloatArray
    fractions: FloatArray
    slopes: FloatArray
    mixing: FloatArray
    cost: FloatArray

    def select(self, index: NDArray[np.intp] | BoolArray) -> WhitenedModel:
        """Return some of the elements."""
        return WhitenedModel(*(getattr(self, k)[..., index] for k in self.__dataclass_fields__))

    def assign(self, index: NDArray[np.intp] | BoolArray, other: WhitenedModel) -> None:
        """Overwrite some of the elements."""
        for k in self.__dataclass_fields__:
            getattr(self, k)[..., index] = getattr(other, k)


class LikelihoodFit:
    """Many independent fits of one model at once; arrays are (..., n), positions in sides of the pad.

    noise: standard deviations of the currents (channels, n), in units of `noise_unit` (n,).
    """

    def __init__(
        self, model: ForwardModel, currents: FloatArray, noise: FloatArray, noise_unit: FloatArray
    ) -> None:
        self.model, self.currents, self.noise_unit = model, currents, noise_unit
        self.weight = 1 / noise
        self.data = currents * self.weight
        self.sides = np.array([[model.a], [model.b]])
        self.aspect = self.sides / self.sides.min()

    def initial_positions(self) -> FloatArray:
        """Return a start from the currents alone, shape (2, n): the most likely of a grid of points."""
        side = (np.arange(_GUESS_GRID) + 0.5) / _GUESS_GRID
        return self.most_likely_of(np.stack([place.ravel() for place in np.meshgrid(side, side)]))

    def most_likely_of(self, points: FloatArray) -> FloatArray:
        """Return the most likely of points (2, k) for each element, (2, n)."""
        table = self.model.fractions(*(points * self.sides)).T
        on_pad = np.isfinite(table).all(axis=1)
        points, table = points[:, on_pad], table[on_pad]
        begin = np.empty((2, self.data.shape[1]))
        for first in range(0, self.data.shape[1], _GUESS_BATCH):
            some = slice(first, first + _GUESS_BATCH)
            weight, data = self.weight[:, some], self.data[:, some]
            along, norm = table @ (weight * data), (table * table) @ (weight * weight)
            best = np.argmax(np.maximum(along, 0.0) ** 2 / norm, axis=0)
            begin[:, some] = points[:, best]
        return begin

    def move_inside(self, point: FloatArray) -> FloatArray:
        """Return points (2, n), where off the pad replaced by nearby points on it."""
        return np.clip(point, _MIN_EDGE_DISTANCE, 1 - _MIN_EDGE_DISTANCE)

    def linearise(self, point: FloatArray, index: NDArray[np.intp] | slice) -> WhitenedModel:
        """Evaluate the model at `point`, shape (2, n), for the elements `index`."""
        f, jacobian = self.model.fractions_with_jacobian(*(point * self.sides))
        weight, data = self.weight[:, index], self.data[:, index]
        f = f * weight
        slopes = np.moveaxis(jacobian, 1, 0) * self.sides[:, :, None] * weight
        norm = (f * f).sum(0)
        total = (f * data).sum(0) / norm
        misfit = data - total * f
        mixing = (slopes * f).sum(1) / norm
        slopes = slopes - mixing[:, None] * f
        return WhitenedModel(
            total=total,
            misfit=misfit,
            fractions=f,
            slopes=slopes,
            mixing=mixing,
            cost=(misfit * misfit).sum(0),
        )

    def gauss_newton_step(self, at: WhitenedModel, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the Gauss-Newton step (2, n) and squared decrement (n,); coordinates at an edge are
        fixed.
        """
        slopes = at.slopes * at.total
        gradient = (slopes * at.misfit).sum(1)
        held = ((point <= _MIN_EDGE_DISTANCE) & (gradient < 0)) | (
            (point >= 1 - _MIN_EDGE_DISTANCE) & (gradient > 0)
        )
        slopes = np.where(held[:, None], 0.0, slopes)
        sx, sy = slopes
        xx = (sx * sx).sum(0)
        overlap = np.where(xx > 0, (sx * sy).sum(0) / xx, 0.0)
        sy = sy - overlap * sx
        yy = (sy * sy).sum(0)
        along_x, along_y = (sx * at.misfit).sum(0), (sy * at.misfit).sum(0)
        dy = np.where(yy > 0, along_y / yy, 0.0)
        dx = np.where(xx > 0, along_x / xx, 0.0) - overlap * dy
        decrement = np.where(xx > 0, along_x**2 / xx, 0.0) + np.where(yy > 0, along_y**2 / yy, 0.0)
        step = np.stack([dx, dy])
        length = np.maximum((np.abs(step) * self.aspect).max(0), 1e-300)
        return step * np.minimum(1.0, MAX_STEP / length), decrement

    def maximise(self, begin: FloatArray | None, unit: FloatArray) -> PointEstimate:
        """Iterate every element to its maximum, from `begin` (2, n) or a start of its own."""
        known = np.asarray(np.isfinite(self.data).all(0) & np.isfinite(self.weight).all(0))
        point, best, converged = self.search(begin, known)
        moved_out = np.concatenate(
            [self.move_out_of_corners(point, best, converged), self.centre_invalid_points(point, best)]
        )
        if moved_out.size:
            best.assign(moved_out, self.linearise(point[:, moved_out], moved_out))
        return self.build_estimate(point, best, converged, unit)

    def search(
        self, begin: FloatArray | None, known: BoolArray
    ) -> tuple[FloatArray, WhitenedModel, BoolArray]:
        """Return the maxima (2, n) of the elements `known`, the model there, and whether they converged."""
        return self.climb(self.initial_positions() if begin is None else begin, known)

    def climb(self, begin: FloatArray, known: BoolArray) -> tuple[FloatArray, WhitenedModel, BoolArray]:
        """Return the maxima (2, n) next to `begin`; converged elements are left alone."""
        point = self.move_inside(np.where(np.isfinite(begin), begin, 0.5))
        point = np.where(known, point, np.nan)
        best = self.linearise(point, slice(None))
        converged = np.zeros(point.shape[1], dtype=np.bool_)
        damping = np.ones(point.shape[1])
        settled = MAX_SETTLED_DECREMENT * self.noise_unit**2
        active = np.flatnonzero(known)
        for _ in range(_MAX_STEPS):
            if not active.size:
                break
            here, at = point[:, active], best.select(active)
            step, decrement = self.gauss_newton_step(at, here)
            trial = self.move_inside(here + damping[active] * step)
            new = self.linearise(trial, active)
            accept = (new.cost <= at.cost) & (new.total > 0) | (at.total <= 0)
            point[:, active[accept]] = trial[:, accept]
            best.assign(active[accept], new.select(accept))
            damping[active] = np.where(accept, np.minimum(1.0, 4 * damping[active]), damping[active] / 4)
            moved = (np.abs(trial - here) > _MIN_STEP).any(0)
            done = (accept & (decrement < settled[active])) | ~moved
            converged[active[done]] = best.total[active[done]] > 0
            active = active[~done]
        return point, best, converged

    def move_out_of_corners(
        self, point: FloatArray, at: WhitenedModel, converged: BoolArray
    ) -> NDArray[np.intp]:
        """Move points out of corners, in place, to where currents carry information; return their indices.

        Near a corner the two far currents vanish with the square of its distance r, so that all r up to
        sqrt(noise) sides are equally likely, and only the direction from the corner is known.
        """
        noise = self.noise_unit / np.sqrt((self.weight * self.weight).mean(0))
        radius = np.minimum(
            CORNER_RADIUS_FACTOR * np.sqrt(noise / at.total), 0.25
        )  # in shorter sides; NaN for no contact
        far = point > 0.5
        offset = np.where(far, 1 - point, point) * self.aspect
        index = np.flatnonzero(np.hypot(*offset) < radius)
        if index.size:
            corner = np.where(far, 1.0, 0.0)[:, index]
            inward = np.where(far, -1.0, 1.0)[:, index] * radius[index] / self.aspect

            def linearised(place: FloatArray) -> tuple[FloatArray, FloatArray]:
                new = self.linearise(place, index)
                return new.misfit, new.slopes * new.total

            angle = most_likely_direction(linearised, corner, inward, np.arctan2(*offset[::-1, index]))
            point[:, index] = corner + inward * np.stack([np.cos(angle), np.sin(angle)])
            converged[index] = at.total[index] > 0
        return index

    def centre_invalid_points(self, point: FloatArray, at: WhitenedModel) -> NDArray[np.intp]:
        """Move points without a positive total to the centre, in place; return their indices."""
        index = np.flatnonzero(at.total <= 0)
        point[:, index] = self.move_inside(np.full((2, index.size), 0.5))
        return index

    def build_estimate(
        self, point: FloatArray, at: WhitenedModel, converged: BoolArray, unit: FloatArray
    ) -> PointEstimate:
        """Return covariance and residual at the points reached, in the units of the pad and the currents."""
        found = at.total > 0
        if len(self.currents) == 4:
            residual = (at.misfit[:2] / self.weight[:2]).sum(0) / at.total
            residual[~found] = np.nan
        else:
            residual = np.full_like(at.total, math.nan)
        least = (self.noise_unit / MAX_STD_SIDES) ** 2
        slopes = np.where(found, at.slopes * at.total, 0.0)
        covariance = estimate_covariance(slopes, at.mixing * at.total, at.fractions, least)
        held = np.isfinite(np.diagonal(covariance, axis1=1, axis2=2)[:, :2]).T
        x, y = np.where(held, point * self.sides, np.nan)
        units = np.stack([*np.broadcast_to(self.sides, point.shape), unit], axis=1) * self.noise_unit[:, None]
        covariance = np.where(covariance == 0, 0.0, covariance * units[:, :, None] * units[:, None, :])
        chi_squared = np.where(at.cost == 0, 0.0, (np.sqrt(at.cost) / self.noise_unit) ** 2)
        return PointEstimate(
            x=x,
            y=y,
            total=at.total * unit,
            residual=residual,
            chi_squared=chi_squared,
            covariance=covariance,
            converged=converged,
        )


def most_likely_direction(
    linearised: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    corner: FloatArray,
    inward: FloatArray,
    angle: FloatArray,
) -> FloatArray:
    """Return the most likely direction (n,) from a corner, at a given distance from it.

    linearised: function of points (2, n) that returns whitened residuals (channels, n) and slopes (2,
    channels, n). corner: points. inward: (2, n), the distance, signed into the pad. angle: start value, 0
    along x to pi / 2 along y.
    """
    for _ in range(_ARC_ITERATIONS):
        angle = np.clip(angle, _MIN_CORNER_ANGLE_RAD, math.pi / 2 - _MIN_CORNER_ANGLE_RAD)
        cosine, sine = np.cos(angle), np.sin(angle)
        misfit, slopes = linearised(corner + inward * np.stack([cosine, sine]))
        tangent = slopes[1] * (inward[1] * cosine) - slopes[0] * (inward[0] * sine)
        angle = angle + np.clip((tangent * misfit).sum(0) / (tangent * tangent).sum(0), -0.3, 0.3)
    return np.clip(angle, _MIN_CORNER_ANGLE_RAD, math.pi / 2 - _MIN_CORNER_ANGLE_RAD)


def estimate_covariance(
    slopes: FloatArray, mixing: FloatArray, fractions: FloatArray, least: FloatArray
) -> FloatArray:
    """Return the inverse Fisher information of (x, y, total), shape (n, 3, 3), x and y in sides.

    slopes, mixing: as in `WhitenedModel`, times the total. fractions: whitened. least: information per
    side^2 (n,) that a coordinate needs; with less, it has infinite variance and no covariances.

    A factor F of the covariance is computed first, and the covariance is F F^T: positive semidefinite despite
    cancellation.
    """
    sx, sy = slopes
    xx, yy, xy = (sx * sx).sum(0), (sy * sy).sum(0), (sx * sy).sum(0)
    # Each variance from the part that the other coordinate can't explain: no difference of products.
    free_x, free_y = ((sx - (xy / yy) * sy) ** 2).sum(0), ((sy - (xy / xx) * sx) ** 2).sum(0)
    free_x, free_y = np.where(yy > least, free_x, xx), np.where(xx > least, free_y, yy)
    held_x, held_y = free_x > least, free_y > least
    both = held_x & held_y
    factor = np.zeros((len(xx), 3, 3))
    factor[:, 0, 0] = np.where(held_x, 1 / np.sqrt(np.where(both, xx, free_x)), 0.0)
    factor[:, 1, 1] = np.where(held_y, 1 / np.sqrt(free_y), 0.0)
    factor[:, 0, 1] = np.where(both, -(xy / xx) * factor[:, 1, 1], 0.0)
    factor[:, 2, :2] = -(np.where(factor[:, :2] == 0, 0.0, factor[:, :2] * mixing.T[:, :, None])).sum(1)[
        :, :2
    ]
    factor[:, 2, 2] = 1 / np.sqrt((fractions * fractions).sum(0))
    covariance: FloatArray = factor @ factor.swapaxes(1, 2)
    covariance[~held_x, 0, 0] = covariance[~held_y, 1, 1] = np.inf
    covariance[np.isnan(covariance[:, 2, 2])] = np.nan
    return covariance
