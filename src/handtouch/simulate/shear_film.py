"""Current through the cross-section of a film between the bars of two facing patterns, by finite elements.

Public names: `Plates`, `solve_section`.

Bilinear elements on a grid that is graded towards the plates' edges; plates meet the film through a specific
contact resistance, or impose their potential where it is 0. Nothing of `handtouch.field` is used, so that the
two can be checked against each other.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from handtouch.arrays import FloatArray, IntArray

_GRADING = (1e-2, 2.0)  # element at an edge, in thicknesses of the film, and growth from one to the next
_COARSEST = 2.0
_MARGIN = 4.0  # margin of the film beyond the outermost edge
_TINY = 1e-6  # length of film that stands for no contact resistance, over the thickness


@dataclass(frozen=True)
class Plates:
    """Cross-section of a film: intervals [m] of plates along x, of the upper and the lower side.

    contact_m: specific contact resistance of either side over the film's resistivity, a length of film.
    """

    upper: tuple[tuple[float, float], ...]
    lower: tuple[tuple[float, float], ...]
    film_m: float
    contact_m: float = 0.0


def solve_section(plates: Plates) -> FloatArray:
    """Return the currents into the lower plates per metre of bar, per volt, for a film of 1 S/m.

    Errors are those of an overlap that is wider by 0.03 of the film's thickness.
    """
    film = plates.film_m
    ends = np.unique(np.array([*plates.upper, *plates.lower]).ravel()) / film
    x = _graded(ends, np.array([ends[0] - _MARGIN, ends[-1] + _MARGIN]), *_GRADING)
    y = _graded(np.array([0.0, 1.0]), np.array([0.0, 1.0]), *_GRADING)
    columns, rows = len(x), len(y)
    node = np.arange(columns * rows).reshape(columns, rows)
    stiffness = _bilinear(x, y, node)
    leak = 1 / max(plates.contact_m / film, _TINY)
    drive = np.zeros(columns * rows)
    lower: list[FloatArray] = []
    for side, intervals in ((rows - 1, plates.upper), (0, plates.lower)):
        for begin, end in intervals:
            inside = (x[:-1] > begin / film - 1e-9) & (x[1:] < end / film + 1e-9)
            first, second = node[:-1, side][inside], node[1:, side][inside]
            half = leak * np.diff(x)[inside] / 2  # lumped: the plate's current through its contact
            weight = np.bincount(first, half, columns * rows) + np.bincount(second, half, columns * rows)
            stiffness = stiffness + diags(weight)
            if side:
                drive += weight
            else:
                lower.append(np.asarray(weight, np.float64))
    potential = splu(stiffness.tocsc()).solve(drive)
    return np.array([weight @ potential for weight in lower])


def _graded(points: FloatArray, limits: FloatArray, finest: float, growth: float) -> FloatArray:
    """Return coordinates that are finest at `points`, from limit to limit."""
    stops = np.unique(np.concatenate([points, limits]))
    pieces = []
    for begin, end in itertools.pairwise(stops.tolist()):
        both = begin in points and end in points
        length = (end - begin) / 2 if both else end - begin
        steps = [finest]
        while sum(steps) < length:
            steps.append(min(steps[-1] * growth, _COARSEST))
        ramp = np.concatenate([[0.0], np.cumsum(steps)])
        ramp *= length / ramp[-1]
        pieces += [begin + ramp] if begin in points else []
        pieces += [end - ramp[::-1]] if both or begin not in points else []
    return np.unique(np.round(np.concatenate(pieces), 12))


def _bilinear(x: FloatArray, y: FloatArray, node: IntArray) -> csr_matrix:
    """Return the stiffness matrix of bilinear elements of unit conductivity on a tensor grid."""
    wide, high = np.meshgrid(np.diff(x), np.diff(y), indexing="ij")
    corner = np.stack([node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]]).reshape(4, -1)
    along = np.array([[2, -2, -1, 1], [-2, 2, 1, -1], [-1, 1, 2, -2], [1, -1, -2, 2]]) / 6
    across = np.array([[2, 1, -1, -2], [1, 2, -2, -1], [-1, -2, 2, 1], [-2, -1, 1, 2]]) / 6
    entries = np.multiply.outer(along, (high / wide).ravel()) + np.multiply.outer(
        across, (wide / high).ravel()
    )
    i, j = np.broadcast_arrays(corner[:, None], corner[None, :])
    size = node.size
    return coo_matrix((entries.ravel(), (i.ravel(), j.ravel())), shape=(size, size)).tocsr()
