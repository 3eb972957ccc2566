"""Fits of one shape class (flat, edge, cylinder or sphere) to contact points and normals.

A contact measures a point of the surface and, as pads lie flat on what they touch, its normal. Each class is
a model with few parameters, fitted by maximum a posteriori; its evidence is Laplace's approximation (D.
MacKay, Information Theory, 2003, ch. 27), which penalises every parameter. The priors are in `ShapePrior`.
The positions of touches along a surface are taken as given: touches in a row alone are no evidence of an
edge, only normals that turn about the row are.

Public names: `fit_primitive`, a generator, `run_to_completion`, `PrimitiveFit`, `ShapePrior`, `Touches`,
`SHAPE_CLASSES`, `SIZE_PARAMETERS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray

T = TypeVar("T")

# Constants without an origin beside them were chosen; docs/benchmarks/shape.md measures what they yield.
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
    normal to the surface's, per axis; pad_turn_std_rad: of that, the same in all touches of a pad, by its
    mount and joints. min_probability: probability from which a class counts as known.
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
    pad_turn_std_rad: float = 0.02
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


class Touches(NamedTuple):
    """Contacts (n,) with an object, in one frame: what a shape is fitted to.

    points_m, normals: (n, 3), normals outward from the pads. covariances_m2: (n, 3, 3) of the points, errors
    of their pad's mount and joints: those of one pad are the same error in all its touches. pads: (n,)
    numbers. moved_m2: (n,) variance of the object's place along each axis since a touch.
    """

    points_m: FloatArray
    normals: FloatArray
    covariances_m2: FloatArray
    pads: NDArray[np.intp]
    moved_m2: FloatArray


def fit_primitive(name: str, touches: Touches, prior: ShapePrior) -> Generator[None, None, PrimitiveFit]:
    """Fit one class to contacts.

    Yields between small steps, so that a caller can bound its time.
    """
    middle = touches.points_m.mean(axis=0)
    task = _PrimitiveProblem(name, touches.points_m - middle, -touches.normals, touches, prior)
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


class _SharedErrors:
    """Covariance K of residuals (n, 3) with errors of each touch, and errors shared by the touches of a pad.

    independent: (n, 3) variances. shared: (n, 3, k), derivatives by k standard normal errors of the pad; pad:
    (n,) numbers of the pads, from 0.
    """

    def __init__(self, independent: FloatArray, shared: FloatArray, pad: NDArray[np.intp]) -> None:
        self._weight, self._pad = 1 / independent, pad
        self._weighted = shared * self._weight[:, :, None]
        self._sums = np.asarray(pad == np.arange(pad.max() + 1)[:, None], np.float64)
        inner = np.eye(shared.shape[2]) + self._by_pad(shared.swapaxes(1, 2) @ self._weighted)
        self._inverse = np.linalg.inv(inner)
        self.log_det = float(np.log(independent).sum() + np.linalg.slogdet(inner)[1].sum())

    def solve(self, r: FloatArray) -> FloatArray:
        """Return K^-1 r of residuals (b, n, 3), by the formula of Sherman, Morrison and Woodbury."""
        common = self._inverse @ self._by_pad(self._weighted.swapaxes(1, 2) @ r.transpose(1, 2, 0))
        return np.asarray(r * self._weight - (self._weighted @ common[self._pad]).transpose(2, 0, 1))

    def _by_pad(self, values: FloatArray) -> FloatArray:
        """Return the sums (p, k, m) of values (n, k, m) of the touches of each pad."""
        return (self._sums @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])


Residuals = tuple[FloatArray, Callable[[], _SharedErrors]]
"""Residuals r (b, n, 3), and a function that returns the covariance of the first."""


@dataclass(frozen=True)
class _PrimitiveProblem:
    """Contacts relative to their mean, with the object's outward normals, and one class."""

    name: str
    points: FloatArray
    outward: FloatArray
    touches: Touches
    prior: ShapePrior

    @cached_property
    def tangents(self) -> tuple[FloatArray, FloatArray]:
        """Two directions (n, 3) perpendicular to each normal."""
        return _perpendicular_directions(self.outward)

    @cached_property
    def roots(self) -> FloatArray:
        """Symmetric roots (n, 3, 3) of the touches' covariances."""
        values, vectors = np.linalg.eigh(self.touches.covariances_m2)
        return np.asarray(np.einsum("nij,nj,nkj->nik", vectors, np.sqrt(np.maximum(values, 0.0)), vectors))

    @cached_property
    def pad(self) -> NDArray[np.intp]:
        """Numbers of the pads of the touches (n,), from 0."""
        return np.unique(self.touches.pads, return_inverse=True)[1]

    @property
    def place_variance_m2(self) -> FloatArray:
        """Variance (n,) of a point along any direction that is the touch's own."""
        return self.touches.moved_m2 + self.prior.surface_std_m**2

    def errors(self, by_place: FloatArray, by_turn: FloatArray, places: int) -> _SharedErrors:
        """Return the covariance of residuals by their derivatives (n, 3, 3) by place and rotation of a pad.

        The first `places` of a touch are distances, the others angles of normals.
        """
        turned = self.prior.pad_turn_std_rad * by_turn
        shared = np.concatenate([by_place @ self.roots, turned], axis=2)
        independent = np.full(by_place.shape[:2], self.prior.normal_std_rad**2)
        independent += self.touches.moved_m2[:, None] * (by_place * by_place).sum(axis=2)
        independent[:, :places] = self.place_variance_m2[:, None]
        return _SharedErrors(independent, shared, self.pad)

    def log_tangential_variance(self) -> float:
        """Return ln of the determinant of the covariance of all points along one tangent."""
        across = np.eye(3) - self.outward[:, :, None] * self.outward[:, None]
        shared = (across @ self.roots).reshape(len(across), 1, 9) / math.sqrt(2)
        return _SharedErrors(self.place_variance_m2[:, None], shared, self.pad).log_det

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

    def cost(self, frame: _AxisFrame, theta: FloatArray) -> tuple[float, FloatArray, _SharedErrors]:
        """Return -2 ln (likelihood x prior) of the first of parameters (b, d), up to a constant; residuals of
        all, and the covariance of the first.
        """
        r, covariance = self.residuals(frame, theta)
        errors, off = covariance(), theta[0] - self._prior_mean()
        total = float((r[:1] * errors.solve(r[:1])).sum()) + errors.log_det
        return total + float((off * off) @ self.prior_precision()), r, errors

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
        best, r, errors = self.cost(frame, theta + steps)
        curvature = np.eye(d)
        for _ in range(_MAX_ITERATIONS):
            yield
            slope = (r[1:] - r[0]) / _DIFFERENCE_STEP
            solved = errors.solve(slope).reshape(d, -1)
            curvature = slope.reshape(d, -1) @ solved.T + np.diag(self.prior_precision())
            downhill = solved @ r[0].ravel() + self.prior_precision() * (theta - self._prior_mean())
            damped = curvature + damping * np.diag(np.diagonal(curvature))
            new = theta - np.linalg.solve(damped, downhill)
            if SIZE_PARAMETERS[self.name]:
                new[-1] = min(
                    max(new[-1], math.log(_MIN_START_RADIUS_M) - 2), math.log(_MAX_START_RADIUS_M) + 3
                )
            cost, new_r, new_errors = self.cost(frame, new + steps)
            gained = best - cost
            if gained > 0:
                theta, best, r, errors, damping = new, cost, new_r, new_errors, damping * 0.1
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
        r, covariance = self.residuals(frame, theta[None])
        priors = self.prior_precision()
        log_evidence = -cost / 2 + 0.5 * float(np.log(priors).sum())
        log_evidence -= 0.5 * float(np.linalg.slogdet(curvature)[1])
        if self.name == "edge":  # normals may point anywhere within a right angle
            log_evidence += n * (0.5 * math.log(2 * math.pi) - math.log(math.pi / 2))
        else:  # touches in a row are no evidence: peak density of the position across the row
            log_evidence -= 0.5 * self.log_tangential_variance()
        chi2 = float((r * covariance().solve(r)).sum())
        posterior = np.linalg.inv(curvature)
        beyond = math.exp(theta[-1]) if SIZE_PARAMETERS[self.name] else 0.0
        direction, point, names = self._direction_and_point(frame, theta)
        return PrimitiveFit(
            log_evidence=log_evidence,
            chi2=chi2,
            degrees_of_freedom=3 * n - d,
            direction=direction,
            point=middle + point,
            radius_m=self.prior.min_radius_m + beyond if SIZE_PARAMETERS[self.name] else 0.0,
            radius_std_m=beyond * math.sqrt(posterior[-1, -1]) if SIZE_PARAMETERS[self.name] else 0.0,
            covariance=np.asarray(posterior, np.float64),
            parameter_names=names,
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
    return _surface_residuals(task, distance, surface, np.zeros((len(task.points), 3, 3)))


def _sphere_residuals(task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray) -> Residuals:  # noqa: ARG001
    away = task.points - theta[:, None, :3]
    length = np.sqrt((away * away).sum(axis=2)) + 1e-12
    radius = task.prior.min_radius_m + np.exp(theta[:, 3:])
    normal = away / length[:, :, None]
    bend = (np.eye(3) - normal[0, :, :, None] * normal[0, :, None]) / radius[0]
    return _surface_residuals(task, length - radius, normal, bend)


def _cylinder_residuals(task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray) -> Residuals:
    axis, away = _offset_from_axis(task, frame, theta)
    length = np.sqrt((away * away).sum(axis=2)) + 1e-12
    radius = task.prior.min_radius_m + np.exp(theta[:, 4:])
    normal = away / length[:, :, None]
    bend = np.eye(3) - np.outer(axis[0], axis[0]) - normal[0, :, :, None] * normal[0, :, None]
    return _surface_residuals(task, length - radius, normal, bend / radius[0])


def _edge_residuals(task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray) -> Residuals:
    axis, away = _offset_from_axis(task, frame, theta)
    r = np.stack([away @ frame.first, away @ frame.second, axis @ task.outward.T], axis=2)

    def covariance() -> _SharedErrors:
        by_place, by_turn = np.zeros((2, len(task.points), 3, 3))
        by_place[:, 0], by_place[:, 1] = frame.first, frame.second
        by_turn[:, 2] = np.cross(task.outward, axis[0])
        return task.errors(by_place, by_turn, 2)

    return r, covariance


def _offset_from_axis(
    task: _PrimitiveProblem, frame: _AxisFrame, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    axis = frame.rotated(theta[:, :2])
    foot = theta[:, 2:3] * frame.first + theta[:, 3:4] * frame.second
    away = task.points - foot[:, None]
    return axis, away - np.einsum("bni,bi->bn", away, axis)[:, :, None] * axis[:, None]


def _surface_residuals(
    task: _PrimitiveProblem, distance: FloatArray, normal: FloatArray, bend: FloatArray
) -> Residuals:
    """Return the distance from a surface, and the difference of its normal from the contact's per tangent.

    bend: (n, 3, 3) derivatives of the surface's normal by the place, for the first parameters.
    """
    off = task.outward - normal
    # along two tangents of the contact's own normal, the same for all parameters
    r = np.stack(
        [distance, (off * task.tangents[0]).sum(axis=2), (off * task.tangents[1]).sum(axis=2)], axis=2
    )

    def covariance() -> _SharedErrors:
        by_place, by_turn = np.zeros((2, len(task.points), 3, 3))
        by_place[:, 0] = normal[0]
        for row, tangent in enumerate(task.tangents, 1):
            by_place[:, row] = -np.einsum("nij,ni->nj", bend, tangent)
            by_turn[:, row] = np.cross(task.outward, tangent)
        return task.errors(by_place, by_turn, 1)

    return r, covariance


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
