"""Finite elements for the potential in a sheet on its own curved surface: the simulator's forward path.

Public names: `solve` (a sheet with its electrodes) -> `SheetMaps`; `SheetBank` looks them up for many pads;
`mutual` -> `Mutual`, between contacts.

The sheet obeys d/ds (r du/ds) + d/dphi (1/r du/dphi) = 0 in arc length s and angle phi, r(s) being the
radius; electrodes hold the potential on the sides, the gaps at the corners insulate. By reciprocity the
share of an injected current that electrode i collects is the potential at the touch when electrode i is at
1 and the others are at 0: one solution per electrode gives the map of that share.

The elements are tensor products of one-dimensional ones, graded towards the ends of the electrodes. With
all sides insulated their stiffness matrix is diagonal in products of the one-dimensional eigenvectors; the
potentials of the electrodes are then imposed by the currents through their nodes, the unknowns of a dense
system on the boundary alone. It is the Galerkin solution that a sparse factorisation would give, in a tenth
of the time. Nothing of `handtouch.field` is used: the two are checked against each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, lu_factor, lu_solve

from handtouch.simulate.elements import Axis, lobatto
from handtouch.simulate.shape import Shape

FloatArray = NDArray[np.float64]

INSET: Final = 0.02
"""Maps are looked up no nearer to a side than this fraction of the pad."""

_LEAST_GAP = 1e-3  # as a fraction of the side: electrodes that met would short the corner
_SAME_GAP = 1e-5  # electrodes of opposite sides that end so near end alike: no element may be a sliver
_NEAR_A_SIDE = np.array([INSET, 0.03, 0.045, 0.065, 0.1, 0.16, 0.25, 0.37])
_BREAKS = np.concatenate([_NEAR_A_SIDE, [0.5], 1 - _NEAR_A_SIDE[::-1]])  # of the tables' elements
_RADIUS_BREAKS = np.array([INSET, 0.08, 0.35, 0.65, 0.92, 1 - INSET])  # enough for a logarithm
_TABLE_DEGREE = 5
_POWERS = np.arange(_TABLE_DEGREE + 1)
_VALUES = np.linalg.inv(
    np.vander(lobatto(_TABLE_DEGREE), increasing=True)
)  # Lagrange's polynomials in powers
_SLOPES = np.append(_POWERS[1:, None] * _VALUES[1:], np.zeros((1, _TABLE_DEGREE + 1)), axis=0)
_ROWS = np.arange(5)
_MUTUAL_DEGREE = 5


class Gaps(NamedTuple):
    """Bare length from each corner along each side, before and after the electrode, in the side's coordinate:
    phi for electrodes x0 and xa, s [m] for y0 and yb."""

    x0: tuple[float, float]
    xa: tuple[float, float]
    y0: tuple[float, float]
    yb: tuple[float, float]

    def solvable(self, shape: Shape) -> Gaps:
        """The same, no gap so small that electrodes would short a corner, and no two nearly the same."""
        x0, xa = _apart(self.x0, self.xa, shape.arc)
        y0, yb = _apart(self.y0, self.yb, shape.length_m)
        return Gaps(x0, xa, y0, yb)


@dataclass(frozen=True)
class SheetMaps:
    """What a sheet of 1 ohm per square does with a current injected at a point."""

    conductance: FloatArray
    """(4, 4) siemens: current into the sheet at electrode i per volt at electrode j."""
    table: FloatArray
    """(5, n, n) over (s, phi): the shares of the electrodes x0, xa, y0, yb, and the logarithm of the radius
    [m] at which a small round contact would find no resistance to the electrodes (its conformal radius)."""


@lru_cache(maxsize=64)
def solve(shape: Shape, gaps: Gaps, degree: int = 8) -> SheetMaps:
    """Solve a sheet with elements of a degree; remembered, as many pads of a hand are alike.

    The default gives shares within 2e-5 of the total 3 % or more from the sides, 1e-5 from 5 % on; a tenth of
    that for gaps up to 3 % of a side.
    """
    sheet = _Sheet(shape, gaps, degree)
    currents, constant = sheet.impose(sheet.member.T, np.zeros((1, 4)))
    conductance = sheet.member @ currents
    fine, coarse = _nodes(_BREAKS), _nodes(_RADIUS_BREAKS)
    s, phi = shape.length_m * fine, shape.arc * fine
    shares = [sheet.potential(currents[:, i], s, phi) + constant[i] for i in range(4)]
    finer = _basis_matrix(_RADIUS_BREAKS, fine)
    log_radius = finer @ sheet.log_radius(shape.length_m * coarse, shape.arc * coarse) @ finer.T
    return SheetMaps(conductance, np.stack([*shares, log_radius]))


class Mutual:
    """Resistance between places of a sheet of 1 ohm per square with grounded electrodes (Green's function).

    For pads with several contacts at a time.
    """

    def __init__(self, shape: Shape, gaps: Gaps) -> None:
        nodes = _nodes(_RADIUS_BREAKS)
        table = _Sheet(shape, gaps, _MUTUAL_DEGREE).mutual(shape.length_m * nodes, shape.arc * nodes)
        self._shape = shape
        self._table = table.reshape(4 * (len(nodes),))

    def ohm(self, one: FloatArray, other: FloatArray, nearest_m: FloatArray) -> FloatArray:
        """Ohms (n,) between places (2, n), fractions of the pad, taken no nearer than `nearest_m` (n,)."""
        shape = self._shape
        s = shape.length_m * np.stack([one[0], other[0]])
        along, across = np.diff(shape.isothermal(s), axis=0)[0], shape.arc * (other[1] - one[1])
        least = nearest_m / shape.radius(s).mean(0)
        distance = np.maximum(np.hypot(along, across), least)
        return np.asarray(self._regular(one, other) - np.log(distance) / (2 * math.pi))

    @lru_cache(maxsize=4096)  # noqa: B019  as few as there are sheets
    def resting(self, x: float, y: float, other_x: float, other_y: float, nearest_m: float) -> float:
        """The same of two places that stay, remembered."""
        one, other = np.array([[x], [y]]), np.array([[other_x], [other_y]])
        return float(self.ohm(one, other, np.array([nearest_m]))[0])

    def _regular(self, one: FloatArray, other: FloatArray) -> FloatArray:
        if (other == other[:, :1]).all():  # the usual case: one of them stays where it is
            (k, of_k, _), (m, of_m, _) = (_basis(_RADIUS_BREAKS, axis[:1]) for axis in other)
            part = np.einsum("abij,i,j->ab", self._table[:, :, k[0]][..., m[0]], of_k[0], of_m[0])
            (i, of_i, _), (j, of_j, _) = (_basis(_RADIUS_BREAKS, axis) for axis in one)
            near = part[i[:, :, None], j[:, None, :]]
            return np.asarray(np.einsum("tij,ti,tj->t", near, of_i, of_j))
        if (one == one[:, :1]).all():
            return self._regular(other, one)
        found = np.empty(one.shape[1])
        for at in np.array_split(np.arange(len(found)), max(len(found) // 500, 1)):
            weights = [_basis(_RADIUS_BREAKS, axis) for axis in (*one[:, at], *other[:, at])]
            (i, wi, _), (j, wj, _), (k, wk, _), (m, wm, _) = weights
            patch = self._table[
                i[:, :, None, None, None],
                j[:, None, :, None, None],
                k[:, None, None, :, None],
                m[:, None, None, None, :],
            ]
            found[at] = np.einsum("tijkm,ti,tj,tk,tm->t", patch, wi, wj, wk, wm, optimize=True)
        return found


@lru_cache(maxsize=24)
def mutual(shape: Shape, gaps: Gaps) -> Mutual:
    """Of a sheet; remembered."""
    return Mutual(shape, gaps)


class SheetBank:
    """Maps of many sheets, looked up together."""

    def __init__(self, sheets: Sequence[SheetMaps]) -> None:
        self._tables = np.stack([sheet.table for sheet in sheets])  # (sheets, 5, n, n)

    def look_up(
        self, sheet: NDArray[np.intp], s: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Values (5, k) of `SheetMaps.table` and their derivatives (5, 2, k) by s and phi.

        `sheet` (k,) says which sheet, `s` and `phi` (k,) where as fractions of its sides, taken no nearer
        to a side than INSET.
        """
        row, of_s, slope_s = _basis(_BREAKS, s)
        column, of_phi, slope_phi = _basis(_BREAKS, phi)
        patch = self._tables[
            sheet[:, None, None, None], _ROWS[:, None, None], row[:, None, :, None], column[:, None, None, :]
        ]
        across = patch @ np.stack([of_phi, slope_phi], axis=-1)[:, None]  # (k, 5, degree + 1, 2)
        values = np.einsum("kmi,ki->mk", across[..., 0], of_s)
        by_s = np.einsum("kmi,ki->mk", across[..., 0], slope_s)
        by_phi = np.einsum("kmi,ki->mk", across[..., 1], of_s)
        return values, np.stack([by_s, by_phi], axis=1)


class _Sheet:
    """Solutions on one sheet.

    The boundary is the nodes of the four sides one after another, in the order of the electrodes: x0, xa,
    y0, yb; a corner is a node of both its sides.
    """

    def __init__(self, shape: Shape, gaps: Gaps, degree: int) -> None:
        self._shape = shape
        bare = gaps.solvable(shape)
        s, phi = _axis(shape.length_m, bare[2:], degree), _axis(shape.arc, bare[:2], degree)
        self._s, self._phi = s, phi
        radius = shape.radius(s.at)
        eigen_s, self._modes_s = eigh(s.stiffness(radius), s.mass(1 / radius))
        eigen_phi, self._modes_phi = eigh(phi.stiffness(np.ones(1)), phi.mass(np.ones(1)))
        eigenvalues = eigen_s[:, None] + eigen_phi
        eigenvalues[0, 0] = np.inf  # the constant is an unknown of its own
        self._inverse = 1 / eigenvalues
        self._sides = [
            _Side(phi, phi.weights, bare[0], 0, -1),
            _Side(phi, phi.weights, bare[1], 0, 1),
            _Side(s, s.weights / radius, bare[2], 1, -1),
            _Side(s, s.weights / radius, bare[3], 1, 1),
        ]
        self._on = np.concatenate([side.covered for side in self._sides])  # is there an electrode?
        owner = np.repeat(np.arange(4), [len(side.covered) for side in self._sides])[self._on]
        self.member = (owner == np.arange(4)[:, None]).astype(np.float64)
        self._boundary = np.concatenate(
            [
                self.response(np.zeros(1), phi.nodes),
                self.response(s.nodes[-1:], phi.nodes),
                self.response(s.nodes, np.zeros(1)),
                self.response(s.nodes, phi.nodes[-1:]),
            ]
        )
        n = int(self._on.sum())
        bordered = np.ones((n + 1, n + 1))
        bordered[:n, :n] = self._boundary[np.ix_(self._on, self._on)]
        bordered[n, n] = 0
        self._factors = lu_factor(bordered, overwrite_a=True)

    def response(self, s: FloatArray, phi: FloatArray) -> FloatArray:
        """Potential at the points of the grid s x phi, in that order, per current into each boundary node.

        Every side is insulated, the current leaves evenly, and the mean potential is 0.
        """
        modes_s, modes_phi = self._s.at_points(s) @ self._modes_s, self._phi.at_points(phi) @ self._modes_phi
        columns = []
        for end in (0, -1):
            along = (modes_s * self._modes_s[end]) @ self._inverse
            columns.append((along[:, None] * modes_phi).reshape(-1, len(self._phi.nodes)) @ self._modes_phi.T)
        for end in (0, -1):
            around = (modes_phi * self._modes_phi[end]) @ self._inverse.T
            columns.append((modes_s[:, None] * around).reshape(-1, len(self._s.nodes)) @ self._modes_s.T)
        return np.concatenate(columns, axis=1)

    def impose(self, potentials: FloatArray, total: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Currents into the electrode nodes, and constants, that hold them at potentials and sum to total."""
        solution = lu_solve(self._factors, np.concatenate([potentials, total]))
        return solution[:-1], solution[-1]

    def potential(self, currents: FloatArray, s: FloatArray, phi: FloatArray) -> FloatArray:
        """`response` to the currents into the electrodes' nodes, summed; shape (s, phi)."""
        ends_s, ends_phi = self._modes_s[[0, -1]], self._modes_phi[[0, -1]]
        load = np.zeros(len(self._on))
        load[self._on] = currents
        x_sides, y_sides = np.split(load, [2 * len(self._phi.nodes)])
        modal = ends_s.T @ (x_sides.reshape(2, -1) @ self._modes_phi)
        modal += (y_sides.reshape(2, -1) @ self._modes_s).T @ ends_phi
        modes_s, modes_phi = self._s.at_points(s) @ self._modes_s, self._phi.at_points(phi) @ self._modes_phi
        return np.asarray(modes_s @ (modal * self._inverse) @ modes_phi.T)

    def log_radius(self, s: FloatArray, phi: FloatArray) -> FloatArray:
        """Logarithm of the conformal radius [m] at the points of the grid s x phi.

        It is 2 pi times the regular part of the potential at the very place of the current: the resistance
        of a contact of unit radius.
        """
        load, constant = self._regular(s, phi)
        regular = np.einsum("pb,bp->p", self.response(s, phi), load) + constant
        return np.asarray(2 * math.pi * regular).reshape(len(s), len(phi))

    def mutual(self, s: FloatArray, phi: FloatArray) -> FloatArray:
        """Potential at each point of the grid s x phi per current into each, (points, points), with
        ln(d) / 2 pi added to it, d being their distance in the plane of (integral of ds / r, phi)."""
        load, constant = self._regular(s, phi)
        radius = np.repeat(self._shape.radius(s), len(phi))
        return np.asarray(self.response(s, phi) @ load + constant - np.log(radius) / (2 * math.pi))

    def _regular(self, s: FloatArray, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Currents into the boundary (boundary, points) and constants (points,) of the regular part h of the
        potential of a unit current at each point of the grid s x phi.

        The potential of a unit current at P is -ln(d r) / 2 pi + h, d being the distance from P in the plane
        of (integral of ds / r, phi): that much is harmonic, so that h has only the values and fluxes that
        make up for it on the boundary.
        """
        points = np.stack(np.broadcast_arrays(self._shape.isothermal(s)[:, None], phi)).reshape(2, -1)
        radius = np.repeat(self._shape.radius(s), len(phi))
        corners = (
            self._shape.isothermal(np.array([0.0, self._shape.length_m])),
            np.array([0.0, self._shape.arc]),
        )
        potentials, loads = [], []
        for side in self._sides:
            across = corners[side.axis][int(side.outward > 0)] - points[side.axis]
            along = self._shape.isothermal if side.axis == 1 else np.asarray
            over = along(side.line.nodes[side.covered])[:, None] - points[1 - side.axis]
            potentials.append(np.log((over**2 + across**2) * radius**2) / (4 * math.pi))
            bare = along(side.line.at[side.bare])[:, None] - points[1 - side.axis]
            flux = side.outward * across / (bare**2 + across**2) / (2 * math.pi)
            loads.append(side.line.values[side.bare].T @ (side.weights[side.bare, None] * flux))
        load = np.concatenate(loads)
        insulated = self._boundary[self._on] @ load
        currents, constant = self.impose(np.concatenate(potentials) - insulated, -load.sum(0, keepdims=True))
        load[self._on] += currents
        return load, constant


@dataclass(frozen=True)
class _Side:
    """One side: the axis along it, where its electrode is, and which way is out."""

    line: Axis
    weights: FloatArray
    """Of the quadrature along the side, in the isothermal coordinate."""
    gap: tuple[float, float]
    axis: int
    """0: out is along s; 1: out is along phi."""
    outward: int

    @cached_property
    def covered(self) -> NDArray[np.bool_]:
        """Which nodes are on the electrode, its ends included."""
        nodes, slack = self.line.nodes, 1e-9 * self.line.nodes[-1]
        return np.asarray((nodes >= self.gap[0] - slack) & (nodes <= nodes[-1] - self.gap[1] + slack))

    @cached_property
    def bare(self) -> NDArray[np.bool_]:
        """Which quadrature points are in the gaps."""
        at = self.line.at
        return np.asarray((at < self.gap[0]) | (at > self.line.nodes[-1] - self.gap[1]))


def _apart(
    one: tuple[float, float], other: tuple[float, float], length: float
) -> Sequence[tuple[float, float]]:
    """Gaps along two opposite sides."""
    first, second = np.maximum([one, other], _LEAST_GAP * length)
    second = np.where(np.abs(second - first) < _SAME_GAP * length, first, second)
    return [(float(before), float(after)) for before, after in (first, second)]


def _axis(length: float, gaps: Sequence[tuple[float, float]], degree: int) -> Axis:
    """Elements along two sides whose electrodes leave `gaps`."""
    return Axis.graded(length, [end for before, after in gaps for end in (before, length - after)], degree)


def _nodes(breaks: FloatArray) -> FloatArray:
    """Nodes of a table's elements, as fractions of a side."""
    half = np.diff(breaks)[:, None] / 2
    return np.append((breaks[:-1, None] + half * (lobatto(_TABLE_DEGREE)[:-1] + 1)).ravel(), breaks[-1])


def _basis(breaks: FloatArray, at: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Nodes (k, degree + 1) that matter at points (k,), their weights, and the derivatives of those."""
    inside = np.clip(at, INSET, 1 - INSET)
    element = np.clip(np.searchsorted(breaks, inside, side="right") - 1, 0, len(breaks) - 2)
    half = (breaks[element + 1] - breaks[element]) / 2
    powers = ((inside - breaks[element]) / half - 1)[:, None] ** _POWERS
    return _TABLE_DEGREE * element[:, None] + _POWERS, powers @ _VALUES, (powers @ _SLOPES) / half[:, None]


def _basis_matrix(breaks: FloatArray, at: FloatArray) -> FloatArray:
    """Takes values at the nodes of a table to values at points (k,): shape (k, nodes)."""
    nodes, weights, _ = _basis(breaks, at)
    matrix = np.zeros((len(at), int(nodes.max()) + 1))
    matrix[np.arange(len(at))[:, None], nodes] = weights
    return matrix


TABLE_AT: Final[FloatArray] = _nodes(_BREAKS)
"""Where the tables of `SheetMaps` have their nodes, as fractions of a side."""
