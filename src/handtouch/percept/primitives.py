"""Fits of one shape class (flat, edge, cylinder or sphere) to contact points and normals.

A contact measures a point of the surface and, as pads lie flat on what they touch, its normal. Each class is
a model with few parameters, fitted by maximum a posteriori; its evidence is Laplace's approximation (D.
MacKay, Information Theory, 2003, ch. 27), which penalises every parameter. The priors are in `ShapePrior`.
The positions of touches along a surface are taken as given: touches in a row alone are no evidence of an
edge, only normals that turn about the row are.

Public names: `fit_primitive`, a generator, `run_to_completion`, `PrimitiveFit`, `ShapePrior`,
`SHAPE_CLASSES`, `SIZE_PARAMETERS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
T = TypeVar("T")

# Constants without an origin beside them were chosen; docs/benchmarks/percept_grasp.md measures what they
# yield.
SHAPE_CLASSES = ("flat", "edge", "cylinder", "sphere")
SIZE_PARAMETERS = {"flat": (), "edge": (), "cylinder": ("radius",), "sphere": ("radius",)}

_MAX_ITERATIONS = 12
_COST_TOLERANCE = 1e-3  # change of twice the logarithm of the posterior
_DIFFERENCE_STEP = 1e-6  # step of numerical derivatives, in metres, radians, and logarithms
_MIN_START_RADIUS_M, _MAX_START_RADIUS_M = 1e-3, 0.3


@dataclass(frozen=True)
class ShapePrior:
    """Prior of object shapes.

    classes: probabilities of SHAPE_CLASSES. min_radius_m: thinner cylinders count as edges. radius_m,
    radius_log_std: median radius, and deviation of the logarithm of a radius's excess over the minimum.
    centre_std_m: distance of a centre or an axis from the contacts' mean (1 sigma). surface_std_m: distance
    of a contact from the surface (skin is compliant), on top of its covariance. normal_std_rad: angle of its
    normal to the surface's, per axis. min_probability: probability from which a class counts as known.
    moving_surface_std_m, moving_normal_std_rad: both deviations for an object that is handled and doesn't
    rest between touches; see `for_moving_object`.
    """

    classes: tuple[float, float, float, float] = (0.25, 0.25, 0.25, 0.25)
    min_radius_m: float = 0.0025
    radius_m: float = 0.02
    radius_log_std: float = 0.8
    centre_std_m: float = 0.1
    surface_std_m: float = 0.5e-3
    normal_std_rad: float = 0.1
    min_probability: float = 0.9
    moving_surface_std_m: float = 2e-3
    moving_normal_std_rad: float = 0.2

    def for_moving_object(self) -> ShapePrior:
        """Return the prior of an object that moves slightly between touches."""
        return replace(
            self, surface_std_m=self.moving_surface_std_m, normal_std_rad=self.moving_normal_std_rad
        )


@dataclass(frozen=True)
class PrimitiveFit:
    """Best fit of one class: ln evidence, chi^2, its degrees of freedom, and the parameters.

    direction: normal of a plane, axis of an edge or cylinder; NaN for a sphere. point: point of the plane or
    axis nearest to the contacts' mean; centre of a sphere. covariance: of `parameter_names`: rotations of the
    direction about two perpendicular axes [rad], point perpendicular to the direction [m], ln of the radius's
    excess over the minimum.
    """

    log_evidence: float
    chi2: float
    degrees_of_freedom: int
    direction: FloatArray
    point: FloatArray
    radius_m: float
    radius_std_m: float
    covariance: FloatArray
    parameter_names: tuple[str, ...]

    @property
    def misfit_sigma(self) -> float:
        """chi^2 as standard deviations (Wilson and Hilferty, 1931)."""
        k = self.degrees_of_freedom
        if k <= 0:
            return 0.0
        return float((np.cbrt(self.chi2 / k) - (1 - 2 / (9 * k))) / math.sqrt(2 / (9 * k)))


def run_to_completion(steps: Generator[None, None, T]) -> T:
    """Run a stepwise computation to its end and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as done:
            found: T = done.value
            return found


def fit_primitive(
    name: str, points_m: FloatArray, normals: FloatArray, covariances_m2: FloatArray, prior: ShapePrior
) -> Generator[None, None, PrimitiveFit]:
    """Fit one class to contacts, arguments as for `classify_shape`.

    Yields between small steps, so that a caller can bound its time.
    """
    middle = points_m.mean(axis=0)
    task = _PrimitiveProblem(name, points_m - middle, -normals, covariances_m2, prior)
    found = []
    for start in task.starts():
        yield
        found.append((yield from task.solve(start)))
    return task.build_fit(*min(found, key=lambda one: one[1]), middle)


@dataclass(frozen=True)
class _AxisFrame:
    """A direction and two perpendicular ones; the parameters rotate it by small angles."""

    axis: FloatArray
    first: FloatArray
    second: FloatArray

    @classmethod
    def from_axis(cls, axis: FloatArray) -> _AxisFrame:
        axis = axis / np.linalg.norm(axis)
        return cls(axis, *(one[0] for one in _perpendicular_directions(axis[None])))

    def rotated(self, by: FloatArray) -> FloatArray:
        """Return directions (b, 3) for rotations (b, 2)."""
        found = self.axis + by[:, :1] * self.first + by[:, 1:2] * self.second
        return np.asarray(found / np.sqrt((found * found).sum(axis=1, keepdims=True)))


Residuals = tuple[FloatArray, FloatArray]
"""Residuals r (b, n, 3) and their variances (b, n, 3)."""


@dataclass(frozen=True)
class _PrimitiveProblem:
    """Contacts relative to their mean, with the object's outward normals, and one class."""

    name: str
    points: FloatArray
    outward: FloatArray
    covariances: FloatArray
    prior: ShapePrior

    @cached_property
    def tangents(self) -> tuple[FloatArray, FloatArray]:
        """Two directions (n, 3) perpendicular to each normal."""
        return _perpendicular_directions(self.outward)

    @cached_property
    def tangential_variance_m2(self) -> FloatArray:
        """Variance (n,) of points along one tangent."""
        along = np.einsum("ni,nij,nj->n", self.outward, self.covariances, self.outward)
        return np.asarray((np.trace(self.covariances, axis1=1, axis2=2) - along) / 2)

    def starts(self) -> list[tuple[_AxisFrame, FloatArray]]:
        """Return start values, from the normals and from the distribution of the points."""
        mean = self.outward.mean(axis=0)
        mean = mean if np.linalg.norm(mean) > 1e-3 else self.outward[0]
        if self.name == "flat":
            return [(_AxisFrame.from_axis(mean), np.zeros(3))]
        if self.name == "sphere":
            centre, radius = self._fit_ball(np.eye(3))
            return [(_AxisFrame.from_axis(mean), np.array([*centre, self._log_radius(radius)]))]
        by_normals = np.linalg.eigh(self.outward.T @ self.outward)[1][:, 0]
        by_points = np.linalg.eigh(self.points.T @ self.points)[1][:, 2]
        found = []
        for axis in (by_normals, by_points) if len(self.points) > 1 else (by_normals,):
            frame = _AxisFrame.from_axis(axis)
            across = np.stack([frame.first, frame.second])
            if self.name == "edge":
                found.append((frame, np.zeros(4)))
            else:
                centre, radius = self._fit_ball(across)
                found.append((frame, np.array([0.0, 0.0, *centre, self._log_radius(radius)])))
        return found

    def _fit_ball(self, across: FloatArray) -> tuple[FloatArray, float]:
        """Return centre and radius of p = c + R n by least squares, in the directions `across` (k, 3)."""
        p, n = self.points @ across.T, self.outward @ across.T
        n0 = n.mean(axis=0)
        spread = float(((n - n0) ** 2).sum())
        radius = float(((p - p.mean(axis=0)) * (n - n0)).sum()) / spread if spread > 1e-4 else -1.0
        radius = (
            min(max(radius, _MIN_START_RADIUS_M), _MAX_START_RADIUS_M) if radius > 0 else self.prior.radius_m
        )
        return p.mean(axis=0) - radius * n0, radius

    def _log_radius(self, radius: float) -> float:
        return math.log(max(radius - self.prior.min_radius_m, _MIN_START_RADIUS_M))

    def prior_precision(self) -> FloatArray:
        """Return the prior precisions of the parameters (d,); means are 0, and ln of the median radius."""
        turn, place, size = 1.0, self.prior.centre_std_m**-2, self.prior.radius_log_std**-2
        return np.array(
            {
                "flat": [turn, turn, place],
                "edge": [turn, turn, place, place],
                "cylinder": [turn, turn, place, place, size],
                "sphere": [place, place, place, size],
            }[self.name]
        )

    def residuals(self, frame: _AxisFrame, theta: FloatArray) -> Residuals:
        """Return the residuals for parameters (b, d), which rotate and move `frame`."""
        return _RESIDUALS[self.name](self, frame, theta)

    def cost(self, frame: _AxisFrame, theta: FloatArray) -> tuple[FloatArray, Residuals]:
        """Return -2 ln (likelihood x prior) (b,) up to a constant, and the residuals."""
        r, variance = self.residuals(frame, theta)
        off = theta - self._prior_mean()
        total = (r * r / variance + np.log(variance)).sum(axis=(1, 2)) + (off * off) @ self.prior_precision()
        return np.asarray(total), (r, variance)

    def _prior_mean(self) -> FloatArray:
        centre = np.zeros(len(self.prior_precision()))
        if SIZE_PARAMETERS[self.name]:
            centre[-1] = math.log(self.prior.radius_m - self.prior.min_radius_m)
        return centre

    def solve(
        self, start: tuple[_AxisFrame, FloatArray]
    ) -> Generator[None, None, tuple[tuple[_AxisFrame, FloatArray], float, FloatArray]]:
        """Minimise by Levenberg-Marquardt; return parameters, cost, and half the curvature there."""
        frame, theta = start
        d, damping = len(theta), 1e-3
        steps = np.concatenate([np.zeros((1, d)), _DIFFERENCE_STEP * np.eye(d)])
        cost, (r, variance) = self.cost(frame, theta + steps)
        best, curvature = float(cost[0]), np.eye(d)
        for _ in range(_MAX_ITERATIONS):
            yield
            weight = 1 / np.sqrt(variance[0])
            slope = ((r[1:] - r[0]) / _DIFFERENCE_STEP * weight).reshape(d, -1)
            curvature = slope @ slope.T + np.diag(self.prior_precision())
            downhill = slope @ (r[0] * weight).ravel() + self.prior_precision() * (theta - self._prior_mean())
            damped = curvature + damping * np.diag(np.diagonal(curvature))
            new = theta - np.linalg.solve(damped, downhill)
            if SIZE_PARAMETERS[self.name]:
                new[-1] = min(
                    max(new[-1], math.log(_MIN_START_RADIUS_M) - 2), math.log(_MAX_START_RADIUS_M) + 3
                )
            cost, found = self.cost(frame, new + steps)
            gained = best - float(cost[0])
            if gained > 0:
                theta, best, (r, variance), damping = new, float(cost[0]), found, damping * 0.1
            else:
                damping *= 10
            if abs(gained) < _COST_TOLERANCE:
                break
        return (frame, theta), best, curvature

    def build_fit(
        self, at: tuple[_AxisFrame, FloatArray], cost: float, curvature: FloatArray, middle: FloatArray
    ) -> PrimitiveFit:
        """Return the fit at these parameters with its evidence."""
        frame, theta = at
        n, d = len(self.points), len(theta)
        r, variance = self.residuals(frame, theta[None])
        priors = self.prior_precision()
        log_evidence = -cost / 2 + 0.5 * float(np.log(priors).sum())
        log_evidence -= 0.5 * float(np.linalg.slogdet(curvature)[1])
        if self.name == "edge":  # normals may point anywhere within a right angle
            log_evidence += n * (0.5 * math.log(2 * math.pi) - math.log(math.pi / 2))
        else:  # touches in a row are no evidence: peak density of the position across the row
            log_evidence -= 0.5 * float(
                np.log(self.tangential_variance_m2 + self.prior.surface_std_m**2).sum()
            )
        covariance = np.linalg.inv(curvature)
        beyond = math.exp(theta[-1]) if SIZE_PARAMETERS[self.name] else 0.0
        direction, point, names = self._direction_and_point(frame, theta)
        return PrimitiveFit(
            log_evidence,
            float((r * r / variance).sum()),
            3 * n - d,
            direction,
            middle + point,
            self.prior.min_radius_m + beyond if SIZE_PARAMETERS[self.name] else 0.0,
            beyond * math.sqrt(covariance[-1, -1]) if SIZE_PARAMETERS[self.name] else 0.0,
            np.asarray(covariance, np.float64),
            names,
        )

    def _direction_and_point(
        self, frame: _AxisFrame, theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
        if self.name == "sphere":
            return np.full(3, np.nan), theta[:3], ("x", "y", "z", "ln_radius_above_least")
        direction = frame.rotated(theta[None, :2])[0]
        if self.name == "flat":
            return direction, theta[2] * direction, ("turn_1", "turn_2", "off")
        point = theta[2] * frame.first + theta[3] * frame.second
        names = ("turn_1", "turn_2", "across_1", "across_2", "ln_radius_above_least")
        return direction, point - (point @ direction) * direction, names[: len(theta)]


def _flat_residuals(task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray) -> Residuals:
    normal = frame.rotated(theta[:, :2])
    distance = normal @ task.points.T - theta[:, 2:3]
    surface = np.broadcast_to(normal[:, None], (len(theta), *task.points.shape))
    return _surface_residuals(task, distance, surface, np.zeros((len(theta), 1)))


def _sphere_residuals(task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray) -> Residuals:  # noqa: ARG001
    away = task.points - theta[:, None, :3]
    length = np.sqrt((away * away).sum(axis=2)) + 1e-12
    radius = task.prior.min_radius_m + np.exp(theta[:, 3:])
    return _surface_residuals(task, length - radius, away / length[:, :, None], 1 / radius)


def _cylinder_residuals(task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray) -> Residuals:
    away = _offset_from_axis(task, frame, theta)[1]
    length = np.sqrt((away * away).sum(axis=2)) + 1e-12
    radius = task.prior.min_radius_m + np.exp(theta[:, 4:])
    return _surface_residuals(task, length - radius, away / length[:, :, None], 1 / radius)


def _edge_residuals(task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray) -> Residuals:
    axis, away = _offset_from_axis(task, frame, theta)
    r = np.stack([away @ frame.first, away @ frame.second, axis @ task.outward.T], axis=2)
    variance = np.empty_like(r)
    for column, direction in enumerate((frame.first, frame.second)):
        variance[:, :, column] = np.einsum("i,nij,j->n", direction, task.covariances, direction)
    variance[:, :, :2] += task.prior.surface_std_m**2
    variance[:, :, 2] = task.prior.normal_std_rad**2
    return r, variance


def _offset_from_axis(
    task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    axis = frame.rotated(theta[:, :2])
    foot = theta[:, 2:3] * frame.first + theta[:, 3:4] * frame.second
    away = task.points - foot[:, None]
    return axis, away - np.einsum("bni,bi->bn", away, axis)[:, :, None] * axis[:, None]


def _surface_residuals(
    task: _PrimitiveProblem, distance: FloatArray, normal: FloatArray, curvature: FloatArray
) -> Residuals:
    """Return the distance from a surface, and the difference of its normal from the contact's per tangent."""
    prior = task.prior
    off = task.outward - normal
    # along two tangents of the contact's own normal, the same for all parameters
    r = np.stack(
        [distance, (off * task.tangents[0]).sum(axis=2), (off * task.tangents[1]).sum(axis=2)], axis=2
    )
    spread = np.einsum("bni,nij->bnj", normal, task.covariances)
    along = np.einsum("bnj,bnj->bn", spread, normal)
    variance = np.empty_like(r)
    variance[:, :, 0] = along + prior.surface_std_m**2
    variance[:, :, 1:] = (prior.normal_std_rad**2 + curvature**2 * task.tangential_variance_m2)[:, :, None]
    return r, variance


_RESIDUALS: dict[str, Callable[[_PrimitiveProblem, _AxisFrame, FloatArray], Residuals]] = {
    "flat": _flat_residuals,
    "edge": _edge_residuals,
    "cylinder": _cylinder_residuals,
    "sphere": _sphere_residuals,
}


def _perpendicular_directions(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two directions (n, 3) perpendicular to each unit vector (n, 3) and to each other."""
    first = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(directions, first)
