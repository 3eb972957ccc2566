"""Interpolating splines through even nodes, as one matrix, from which all tables are built.

Public names: `spline_operator`. The same splines as scipy.interpolate's (not-a-knot ends), whose import takes
longer than all tables of a hand.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from handtouch.field.model import FloatArray


@cache
def spline_operator(cells: int, degree: int) -> FloatArray:
    """Return the matrix from node values to the cells' polynomials: (cells, degree + 1, cells + 1).

    Lowest power first. Nodes are 0, 1 ... cells; each polynomial counts from the left end of its cell.
    degree: odd, at most cells. For up to a few hundred cells: it is a dense inverse.
    """
    nodes = np.arange(cells + 1.0)
    halves = (degree + 1) // 2
    knots = np.concatenate(
        [np.zeros(degree + 1), nodes[halves:-halves], np.full(degree + 1, float(cells))]
    )  # not-a-knot: none at the nodes next to the ends
    within = (np.arange(degree + 1) + 0.5) / (degree + 1)
    points = (nodes[:-1, None] + within).ravel()
    values = _basis(knots, degree, points) @ np.linalg.inv(_basis(knots, degree, nodes))
    to_powers = np.linalg.inv(np.vander(within, increasing=True))
    return np.asarray(to_powers @ values.reshape(cells, degree + 1, cells + 1))


def _basis(knots: FloatArray, degree: int, x: FloatArray) -> FloatArray:
    """Return B-splines (points, functions) at x, by the recursion of Cox and de Boor."""
    last = len(knots) - degree - 2
    span = np.clip(np.searchsorted(knots, x, side="right") - 1, degree, last)
    values = np.zeros((len(x), len(knots) - 1))
    values[np.arange(len(x)), span] = 1.0
    for order in range(1, degree + 1):
        width = knots[order:] - knots[:-order]
        per_width = np.divide(1.0, width, out=np.zeros_like(width), where=width > 0)
        rising = (x[:, None] - knots[: -order - 1]) * per_width[:-1]
        falling = (knots[order + 1 :] - x[:, None]) * per_width[1:]
        values = rising * values[:, :-1] + falling * values[:, 1:]
    return values
