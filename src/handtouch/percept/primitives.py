"""Flat, edge, cylinder or sphere: one class at a time, fitted to contact points and normals.

A contact tells a point of the surface and, as pads lie on what they touch, its normal. Each class is a model
with few parameters, fitted by maximum a posteriori; its evidence follows after Laplace (D. MacKay,
Information Theory, 2003, ch. 27), which charges for every parameter. The priors are in `Prior`. Where along
a surface it is touched is taken as given, and so is that touches lie in a row: that alone makes no edge,
only normals that turn about the row do.

Public names: `fit`, `fitting` (the same in pieces), `finished`, `Fit`, `Prior`, `CLASSES`, `SIZES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.directions import across

FloatArray = NDArray[np.float64]
T = TypeVar("T")

CLASSES = ("flat", "edge", "cylinder", "sphere")
SIZES = {"flat": (), "edge": (), "cylinder": ("radius",), "sphere": ("radius",)}

_STEPS = 12
_SETTLED = 1e-3  # of the logarithm of the posterior
_H = 1e-6  # step of the slopes, in metres, radians, and logarithms
_SMALL_M, _LARGE_M = 1e-3, 0.3  # starts


@dataclass(frozen=True)
class Prior:
    """What is taken for granted.

    classes: probabilities of CLASSES. least_radius_m: what is thinner counts as an edge. radius_m,
    radius_log_std: median, and deviation of the logarithm of what a radius has above the least. reach_m: how
    far off the contacts' middle a centre or an axis may be (1 sigma). surface_std_m: how far a contact is off
    the surface (skin gives way), on top of its covariance. normal_std_rad: how far its normal is from the
    surface's, each way. sure: probability from which a class counts as known. moves_m, turns_rad: both
    deviations where an object is handled, which doesn't quite rest between touches; see `freely`.
    """

    classes: tuple[float, float, float, float] = (0.25, 0.25, 0.25, 0.25)
    least_radius_m: float = 0.0025
    radius_m: float = 0.02
    radius_log_std: float = 0.8
    reach_m: float = 0.1
    surface_std_m: float = 0.5e-3
    normal_std_rad: float = 0.1
    sure: float = 0.9
    moves_m: float = 2e-3
    turns_rad: float = 0.2

    def freely(self) -> Prior:
        """The same for an object that moves a little between touches."""
        return replace(self, surface_std_m=self.moves_m, normal_std_rad=self.turns_rad)


@dataclass(frozen=True)
class Fit:
    """One class at its best: ln evidence, chi^2 of how many numbers, and what it is.

    direction: normal of a plane, axis of edge or cylinder; none of a sphere. point: nearest point of plane or
    axis to the contacts' middle; centre of a sphere. covariance: of `names`: turns of the direction about two
    axes across it [rad], point across the direction [m], ln of the radius above the least.
    """

    log_evidence: float
    chi2: float
    freedom: int
    direction: FloatArray
    point: FloatArray
    radius_m: float
    radius_std_m: float
    covariance: FloatArray
    names: tuple[str, ...]

    @property
    def misfit(self) -> float:
        """chi^2 as standard deviations (Wilson and Hilferty, 1931)."""
        k = self.freedom
        if k <= 0:
            return 0.0
        return float((np.cbrt(self.chi2 / k) - (1 - 2 / (9 * k))) / math.sqrt(2 / (9 * k)))


def fit(
    name: str, points_m: FloatArray, normals: FloatArray, covariances_m2: FloatArray, prior: Prior
) -> Fit:
    """Fit one class to contacts as `classify` takes them."""
    return finished(fitting(name, points_m, normals, covariances_m2, prior))


def finished(steps: Generator[None, None, T]) -> T:
    """What a computation in steps comes to, all steps taken at once."""
    while True:
        try:
            next(steps)
        except StopIteration as done:
            found: T = done.value
            return found


def fitting(
    name: str, points_m: FloatArray, normals: FloatArray, covariances_m2: FloatArray, prior: Prior
) -> Generator[None, None, Fit]:
    """`fit` in small pieces, for who has little time at once."""
    middle = points_m.mean(axis=0)
    task = _Task(name, points_m - middle, -normals, covariances_m2, prior)
    found = []
    for start in task.starts():
        yield
        found.append((yield from task.solve(start)))
    return task.told(*min(found, key=lambda one: one[1]), middle)


@dataclass(frozen=True)
class _Frame:
    """A direction with two across it; parameters turn it a little."""

    axis: FloatArray
    first: FloatArray
    second: FloatArray

    @classmethod
    def of(cls, axis: FloatArray) -> _Frame:
        axis = axis / np.linalg.norm(axis)
        return cls(axis, *(one[0] for one in across(axis[None])))

    def turned(self, by: FloatArray) -> FloatArray:
        """Directions (b, 3) for turns (b, 2)."""
        found = self.axis + by[:, :1] * self.first + by[:, 1:2] * self.second
        return np.asarray(found / np.sqrt((found * found).sum(axis=1, keepdims=True)))


Residuals = tuple[FloatArray, FloatArray]
"""r (b, n, 3), and variances (b, n, 3) of them."""


@dataclass(frozen=True)
class _Task:
    """Contacts about their middle, with the object's outward normals, and one class."""

    name: str
    points: FloatArray
    outward: FloatArray
    covariances: FloatArray
    prior: Prior

    @cached_property
    def across(self) -> tuple[FloatArray, FloatArray]:
        """Two directions (n, 3) across each normal."""
        return across(self.outward)

    @cached_property
    def aside(self) -> FloatArray:
        """Variance (n,) of points, one way across their normals."""
        along = np.einsum("ni,nij,nj->n", self.outward, self.covariances, self.outward)
        return np.asarray((np.trace(self.covariances, axis1=1, axis2=2) - along) / 2)

    def starts(self) -> list[tuple[_Frame, FloatArray]]:
        """Where to begin: from normals, and from how the points lie."""
        mean = self.outward.mean(axis=0)
        mean = mean if np.linalg.norm(mean) > 1e-3 else self.outward[0]
        if self.name == "flat":
            return [(_Frame.of(mean), np.zeros(3))]
        if self.name == "sphere":
            centre, radius = self._ball(np.eye(3))
            return [(_Frame.of(mean), np.array([*centre, self._size(radius)]))]
        by_normals = np.linalg.eigh(self.outward.T @ self.outward)[1][:, 0]
        by_points = np.linalg.eigh(self.points.T @ self.points)[1][:, 2]
        found = []
        for axis in (by_normals, by_points) if len(self.points) > 1 else (by_normals,):
            frame = _Frame.of(axis)
            across = np.stack([frame.first, frame.second])
            if self.name == "edge":
                found.append((frame, np.zeros(4)))
            else:
                centre, radius = self._ball(across)
                found.append((frame, np.array([0.0, 0.0, *centre, self._size(radius)])))
        return found

    def _ball(self, across: FloatArray) -> tuple[FloatArray, float]:
        """Centre and radius of p = c + R n, least squares, in the directions `across` (k, 3)."""
        p, n = self.points @ across.T, self.outward @ across.T
        n0 = n.mean(axis=0)
        spread = float(((n - n0) ** 2).sum())
        radius = float(((p - p.mean(axis=0)) * (n - n0)).sum()) / spread if spread > 1e-4 else -1.0
        radius = min(max(radius, _SMALL_M), _LARGE_M) if radius > 0 else self.prior.radius_m
        return p.mean(axis=0) - radius * n0, radius

    def _size(self, radius: float) -> float:
        return math.log(max(radius - self.prior.least_radius_m, _SMALL_M))

    def precision(self) -> FloatArray:
        """Of the priors of the parameters, (d,); their means are 0, and ln of the median radius."""
        turn, place, size = 1.0, self.prior.reach_m**-2, self.prior.radius_log_std**-2
        return np.array(
            {
                "flat": [turn, turn, place],
                "edge": [turn, turn, place, place],
                "cylinder": [turn, turn, place, place, size],
                "sphere": [place, place, place, size],
            }[self.name]
        )

    def residuals(self, frame: _Frame, theta: FloatArray) -> Residuals:
        """Of parameters (b, d), which turn and move `frame`."""
        return _RESIDUALS[self.name](self, frame, theta)

    def cost(self, frame: _Frame, theta: FloatArray) -> tuple[FloatArray, Residuals]:
        """-2 ln (likelihood x prior) (b,), constants of the model left out."""
        r, variance = self.residuals(frame, theta)
        off = theta - self._centre()
        total = (r * r / variance + np.log(variance)).sum(axis=(1, 2)) + (off * off) @ self.precision()
        return np.asarray(total), (r, variance)

    def _centre(self) -> FloatArray:
        centre = np.zeros(len(self.precision()))
        if SIZES[self.name]:
            centre[-1] = math.log(self.prior.radius_m - self.prior.least_radius_m)
        return centre

    def solve(
        self, start: tuple[_Frame, FloatArray]
    ) -> Generator[None, None, tuple[tuple[_Frame, FloatArray], float, FloatArray]]:
        """Levenberg-Marquardt: parameters, cost, and half the curvature of the cost there."""
        frame, theta = start
        d, damping = len(theta), 1e-3
        steps = np.concatenate([np.zeros((1, d)), _H * np.eye(d)])
        cost, (r, variance) = self.cost(frame, theta + steps)
        best, curvature = float(cost[0]), np.eye(d)
        for _ in range(_STEPS):
            yield
            weight = 1 / np.sqrt(variance[0])
            slope = ((r[1:] - r[0]) / _H * weight).reshape(d, -1)
            curvature = slope @ slope.T + np.diag(self.precision())
            downhill = slope @ (r[0] * weight).ravel() + self.precision() * (theta - self._centre())
            damped = curvature + damping * np.diag(np.diagonal(curvature))
            new = theta - np.linalg.solve(damped, downhill)
            if SIZES[self.name]:
                new[-1] = min(max(new[-1], math.log(_SMALL_M) - 2), math.log(_LARGE_M) + 3)
            cost, found = self.cost(frame, new + steps)
            gained = best - float(cost[0])
            if gained > 0:
                theta, best, (r, variance), damping = new, float(cost[0]), found, damping * 0.1
            else:
                damping *= 10
            if abs(gained) < _SETTLED:
                break
        return (frame, theta), best, curvature

    def told(
        self, at: tuple[_Frame, FloatArray], cost: float, curvature: FloatArray, middle: FloatArray
    ) -> Fit:
        """Evidence and what it is."""
        frame, theta = at
        n, d = len(self.points), len(theta)
        r, variance = self.residuals(frame, theta[None])
        priors = self.precision()
        log_evidence = -cost / 2 + 0.5 * float(np.log(priors).sum())
        log_evidence -= 0.5 * float(np.linalg.slogdet(curvature)[1])
        if self.name == "edge":  # normals may point anywhere in a right angle
            log_evidence += n * (0.5 * math.log(2 * math.pi) - math.log(math.pi / 2))
        else:  # touches in a row are no news: density of where across the row, at its greatest
            log_evidence -= 0.5 * float(np.log(self.aside + self.prior.surface_std_m**2).sum())
        covariance = np.linalg.inv(curvature)
        beyond = math.exp(theta[-1]) if SIZES[self.name] else 0.0
        direction, point, names = self._place(frame, theta)
        return Fit(
            log_evidence,
            float((r * r / variance).sum()),
            3 * n - d,
            direction,
            middle + point,
            self.prior.least_radius_m + beyond if SIZES[self.name] else 0.0,
            beyond * math.sqrt(covariance[-1, -1]) if SIZES[self.name] else 0.0,
            np.asarray(covariance, np.float64),
            names,
        )

    def _place(self, frame: _Frame, theta: FloatArray) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
        if self.name == "sphere":
            return np.full(3, np.nan), theta[:3], ("x", "y", "z", "ln_radius_above_least")
        direction = frame.turned(theta[None, :2])[0]
        if self.name == "flat":
            return direction, theta[2] * direction, ("turn_1", "turn_2", "off")
        point = theta[2] * frame.first + theta[3] * frame.second
        names = ("turn_1", "turn_2", "across_1", "across_2", "ln_radius_above_least")
        return direction, point - (point @ direction) * direction, names[: len(theta)]


def _flat(task: _Task, frame: _Frame, theta: FloatArray) -> Residuals:
    normal = frame.turned(theta[:, :2])
    distance = normal @ task.points.T - theta[:, 2:3]
    surface = np.broadcast_to(normal[:, None], (len(theta), *task.points.shape))
    return _on_surface(task, distance, surface, np.zeros((len(theta), 1)))


def _sphere(task: _Task, frame: _Frame, theta: FloatArray) -> Residuals:  # noqa: ARG001
    away = task.points - theta[:, None, :3]
    length = np.sqrt((away * away).sum(axis=2)) + 1e-12
    radius = task.prior.least_radius_m + np.exp(theta[:, 3:])
    return _on_surface(task, length - radius, away / length[:, :, None], 1 / radius)


def _cylinder(task: _Task, frame: _Frame, theta: FloatArray) -> Residuals:
    away = _off_axis(task, frame, theta)[1]
    length = np.sqrt((away * away).sum(axis=2)) + 1e-12
    radius = task.prior.least_radius_m + np.exp(theta[:, 4:])
    return _on_surface(task, length - radius, away / length[:, :, None], 1 / radius)


def _edge(task: _Task, frame: _Frame, theta: FloatArray) -> Residuals:
    axis, away = _off_axis(task, frame, theta)
    r = np.stack([away @ frame.first, away @ frame.second, axis @ task.outward.T], axis=2)
    variance = np.empty_like(r)
    for column, direction in enumerate((frame.first, frame.second)):
        variance[:, :, column] = np.einsum("i,nij,j->n", direction, task.covariances, direction)
    variance[:, :, :2] += task.prior.surface_std_m**2
    variance[:, :, 2] = task.prior.normal_std_rad**2
    return r, variance


def _off_axis(task: _Task, frame: _Frame, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    axis = frame.turned(theta[:, :2])
    foot = theta[:, 2:3] * frame.first + theta[:, 3:4] * frame.second
    away = task.points - foot[:, None]
    return axis, away - np.einsum("bni,bi->bn", away, axis)[:, :, None] * axis[:, None]


def _on_surface(task: _Task, distance: FloatArray, normal: FloatArray, curvature: FloatArray) -> Residuals:
    """Distance from a surface, and how its normal differs from the contact's, two ways across."""
    prior = task.prior
    off = task.outward - normal
    # two ways across the contact's own normal, the same for all parameters
    r = np.stack([distance, (off * task.across[0]).sum(axis=2), (off * task.across[1]).sum(axis=2)], axis=2)
    spread = np.einsum("bni,nij->bnj", normal, task.covariances)
    along = np.einsum("bnj,bnj->bn", spread, normal)
    variance = np.empty_like(r)
    variance[:, :, 0] = along + prior.surface_std_m**2
    variance[:, :, 1:] = (prior.normal_std_rad**2 + curvature**2 * task.aside)[:, :, None]
    return r, variance


_RESIDUALS: dict[str, Callable[[_Task, _Frame, FloatArray], Residuals]] = {
    "flat": _flat,
    "edge": _edge,
    "cylinder": _cylinder,
    "sphere": _sphere,
}
