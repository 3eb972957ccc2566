"""One-dimensional spectral elements, graded towards singularities; a sheet is the product of two axes.

Public names: `ElementAxis`, `lobatto_nodes`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import legendre

from handtouch.arrays import FloatArray

_GRADING_RATIO = 0.25  # ratio of successive elements towards a square-root singularity of the potential
_MIN_ELEMENT_FRACTION = 1e-3  # shortest element over the axis
_MAX_ELEMENT_FRACTION = 0.15  # longest element over the axis


@dataclass(frozen=True)
class ElementAxis:
    """Elements along one coordinate: nodes, and basis functions at the quadrature points."""

    degree: int
    breaks: FloatArray
    nodes: FloatArray
    quadrature_points: FloatArray
    weights: FloatArray
    values: FloatArray
    slopes: FloatArray

    @classmethod
    def graded(cls, length: float, singular: Iterable[float], degree: int) -> ElementAxis:
        """Return elements on [0, length], graded towards both ends and the `singular` points in between."""
        breaks = _graded_breaks(sorted({0.0, *singular, length}), length)
        reference, (abscissae, weights) = lobatto_nodes(degree), legendre.leggauss(degree + 2)
        values, slopes = _lagrange(degree, abscissae)
        half = np.diff(breaks) / 2
        middle = breaks[:-1] + half
        first = degree * np.arange(len(half))[:, None]
        into = (
            np.arange(half.size * abscissae.size).reshape(len(half), -1, 1),
            (first + np.arange(degree + 1))[:, None],
        )
        shape = (half.size * abscissae.size, degree * half.size + 1)
        all_values, all_slopes = np.zeros(shape), np.zeros(shape)
        all_values[into], all_slopes[into] = values, slopes / half[:, None, None]
        nodes = (middle[:, None] + half[:, None] * reference[:-1]).ravel()
        return cls(
            degree=degree,
            breaks=breaks,
            nodes=np.append(nodes, length),
            quadrature_points=(middle[:, None] + half[:, None] * abscissae).ravel(),
            weights=np.outer(half, weights).ravel(),
            values=all_values,
            slopes=all_slopes,
        )

    def stiffness(self, weight: FloatArray) -> FloatArray:
        """Return the matrix of the integrals of weight u' v'."""
        return self.slopes.T @ ((self.weights * weight)[:, None] * self.slopes)

    def mass(self, weight: FloatArray) -> FloatArray:
        """Return the matrix of the integrals of weight u v."""
        return self.values.T @ ((self.weights * weight)[:, None] * self.values)

    def evaluate_basis(self, points: FloatArray) -> FloatArray:
        """Return the basis functions at points: (points, nodes)."""
        element = np.clip(np.searchsorted(self.breaks, points, side="right") - 1, 0, len(self.breaks) - 2)
        start, end = self.breaks[element], self.breaks[element + 1]
        basis = np.zeros((len(points), len(self.nodes)))
        into = np.arange(len(points))[:, None], self.degree * element[:, None] + np.arange(self.degree + 1)
        basis[into] = _lagrange(self.degree, (2 * points - start - end) / (end - start))[0]
        return basis


def _graded_breaks(ends: list[float], length: float) -> FloatArray:
    """Return the boundaries of elements that shrink towards each of `ends` from both sides."""
    breaks = [ends[0]]
    for start, end in itertools.pairwise(ends):
        half = (end - start) / 2
        layers = max(0, math.ceil(math.log(_MIN_ELEMENT_FRACTION * length / half) / math.log(_GRADING_RATIO)))
        steps = half * _GRADING_RATIO ** np.arange(layers, -1.0, -1.0)
        for step in (*(start + steps), *(end - steps[-2::-1]), end):
            pieces = math.ceil((step - breaks[-1]) / (_MAX_ELEMENT_FRACTION * length))
            breaks.extend(np.linspace(breaks[-1], step, pieces + 1)[1:])
    return np.array(breaks)


@cache
def lobatto_nodes(degree: int) -> FloatArray:
    """Return the Gauss-Lobatto nodes on [-1, 1]."""
    inner = legendre.legroots(legendre.legder(np.eye(degree + 1)[degree]))
    return np.concatenate([[-1.0], np.sort(inner.real), [1.0]])


@cache
def _coefficients(degree: int) -> FloatArray:
    """Return the Legendre coefficients of the Lobatto nodes' Lagrange polynomials, as columns."""
    return np.asarray(np.linalg.inv(legendre.legvander(lobatto_nodes(degree), degree)), np.float64)


def _lagrange(degree: int, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Lagrange polynomials of the Lobatto nodes, and slopes, at points (...): (..., degree + 1)."""
    coefficients = _coefficients(degree)
    slopes = legendre.legder(coefficients)
    return (
        legendre.legvander(at, degree) @ coefficients,
        legendre.legvander(at, degree - 1) @ slopes,
    )
