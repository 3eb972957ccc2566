"""Solve the potential of a sheet on its curved surface by finite elements: the simulator's forward model.

Public names: `solve_sheet` (a sheet with its electrodes) -> `SheetMaps`; `SheetMapBank` (maps of many pads);
`mutual_resistance` -> `MutualResistance` (between contacts).

The sheet obeys d/ds (r du/ds) + d/dphi (1/r du/dphi) = 0 in arc length s and angle phi, r(s) being the
radius; electrodes impose the potential on the sides, the gaps at the corners are insulated. By reciprocity
the share of an injected current that electrode i collects is the potential at the contact with electrode i at
1 and the others at 0: one solution per electrode gives the map of its share.

The elements are tensor products of one-dimensional ones, graded towards the ends of the electrodes. With all
sides insulated their stiffness matrix is diagonal in products of the one-dimensional eigenvectors; the
electrodes' potentials are then imposed by the currents through their nodes, the unknowns of a dense system on
the boundary. The result is the same Galerkin solution as by sparse factorisation, in a tenth of the time. It
uses nothing of `handtouch.field`, so that the two can be checked against each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, lu_factor, lu_solve

from handtouch.arrays import FloatArray
from handtouch.simulate.pad_geometry import SheetMetric, SimulatedSurface
from handtouch.simulate.spectral_elements import ElementAxis, lobatto_nodes
from handtouch.simulate.stages.patches import NodeTables

EDGE_INSET_FRACTION: Final = 0.02
"""Smallest distance from a side at which maps are evaluated, as a fraction of the pad."""

_MIN_GAP_FRACTION = 1e-3  # bare gap over the side: adjoining electrodes would short the corner
_MIN_GAP_DIFFERENCE_FRACTION = 1e-5  # smaller differences of opposite gaps are removed, to avoid slivers
_EDGE_BREAKS = np.array([EDGE_INSET_FRACTION, 0.03, 0.045, 0.065, 0.1, 0.16, 0.25, 0.37])
_SHARE_BREAKS = np.concatenate([_EDGE_BREAKS, [0.5], 1 - _EDGE_BREAKS[::-1]])  # elements of the tables
_RADIUS_BREAKS = np.array([EDGE_INSET_FRACTION, 0.08, 0.35, 0.65, 0.92, 1 - EDGE_INSET_FRACTION])
_TABLE_DEGREE = 5
_POWERS = np.arange(_TABLE_DEGREE + 1)
_VALUES = np.linalg.inv(np.vander(lobatto_nodes(_TABLE_DEGREE), increasing=True))  # Lagrange polynomials
_SLOPES = np.append(_POWERS[1:, None] * _VALUES[1:], np.zeros((1, _TABLE_DEGREE + 1)), axis=0)
_MUTUAL_DEGREE = 5


class ElectrodeGaps(NamedTuple):
    """Bare lengths before and after the electrode of each side.

    They are in the side's coordinate: phi for electrodes x0 and xa, s [m] for y0 and yb.
    """

    x0: tuple[float, float]
    xa: tuple[float, float]
    y0: tuple[float, float]
    yb: tuple[float, float]

    def stretched(self, factor: float) -> ElectrodeGaps:
        """Return the gaps with s multiplied by `factor`."""
        (a, b), (c, d) = self.y0, self.yb
        return self._replace(y0=(factor * a, factor * b), yb=(factor * c, factor * d))

    def regularised(self, shape: SheetMetric) -> ElectrodeGaps:
        """Return gaps without electrodes that short a corner, and without nearly equal opposite gaps."""
        x0, xa = _separate_gaps(self.x0, self.xa, shape.arc)
        y0, yb = _separate_gaps(self.y0, self.yb, shape.length_m)
        return ElectrodeGaps(x0, xa, y0, yb)


ArcEnds = tuple[tuple[float, float], ...]
"""Begin and end of each electrode on an outline, lengths along it [m] counter-clockwise."""


@dataclass(frozen=True)
class SheetMaps:
    """Response of a sheet of 1 ohm per square to a current injected at a point."""

    conductance: FloatArray
    """(m, m) siemens: current into the sheet at electrode i per volt at electrode j."""
    table: FloatArray
    """(m + 1, n, n) over (s, phi): shares of the m electrodes; logarithm of the conformal radius [m].

    A round contact of the conformal radius would have no sheet resistance to the electrodes.
    """


@lru_cache(maxsize=64)
def solve_sheet(shape: SimulatedSurface, gaps: ElectrodeGaps, degree: int = 8) -> SheetMaps:
    """Solve a sheet with elements of a degree; cached, as many pads of a hand are equal.

    With the default degree the errors of shares are 2e-5 at 3 % or more from the sides, 1e-5 from 5 % on,
    and a tenth of that for gaps up to 3 % of a side.
    """
    stretch = shape.stretch
    metric, gaps = shape.metric, gaps.stretched(stretch)
    sheet = _SheetSolver(metric, gaps, degree)
    currents, constant = sheet.impose_potentials(sheet.membership.T, np.zeros((1, 4)))
    conductance = sheet.membership @ currents
    fine, coarse = TABLE_NODES, RADIUS_NODES
    s, phi = metric.length_m * fine, metric.arc * fine
    shares = [sheet.potential(currents[:, i], s, phi) + constant[i] for i in range(4)]
    finer = _basis_matrix(_RADIUS_BREAKS, fine)
    log_radius = finer @ sheet.log_radius(metric.length_m * coarse, metric.arc * coarse) @ finer.T
    log_radius -= math.log((1 + stretch) / 2)  # a disc is stretched to an ellipse, of that mean half axis
    return SheetMaps(conductance, np.stack([*shares, log_radius]))


class MutualResistance:
    """Green's function of a sheet of 1 ohm per square with grounded electrodes, as a resistance.

    It couples simultaneous contacts of a pad.
    """

    def __init__(self, shape: SimulatedSurface, gaps: ElectrodeGaps) -> None:
        nodes = RADIUS_NODES
        metric, gaps = shape.metric, gaps.stretched(shape.stretch)
        table = _SheetSolver(metric, gaps, _MUTUAL_DEGREE).mutual_table(
            metric.length_m * nodes, metric.arc * nodes
        )
        self._shape = metric
        self._table = table.reshape(4 * (len(nodes),))

    def resistance_ohm(self, one: FloatArray, other: FloatArray, nearest_m: FloatArray) -> FloatArray:
        """Return the resistance (n,) between positions (2, n) [fractions], at least `nearest_m` apart."""
        shape = self._shape
        s = shape.length_m * np.stack([one[0], other[0]])
        along, across = np.diff(shape.isothermal(s), axis=0)[0], shape.arc * (other[1] - one[1])
        min_distance = nearest_m / shape.radius(s).mean(0)
        distance = np.maximum(np.hypot(along, across), min_distance)
        return np.asarray(self._regular_part(one, other) - np.log(distance) / (2 * math.pi))

    @lru_cache(maxsize=4096)  # noqa: B019  there are few sheets
    def static_resistance_ohm(
        self, x: float, y: float, other_x: float, other_y: float, nearest_m: float
    ) -> float:
        """Return `resistance_ohm` between two static positions; cached."""
        one, other = np.array([[x], [y]]), np.array([[other_x], [other_y]])
        return float(self.resistance_ohm(one, other, np.array([nearest_m]))[0])

    def _regular_part(self, one: FloatArray, other: FloatArray) -> FloatArray:
        if (other == other[:, :1]).all():  # the usual case: one of them is static
            (k, of_k, _), (m, of_m, _) = (_basis(_RADIUS_BREAKS, axis[:1]) for axis in other)
            part = np.einsum("abij,i,j->ab", self._table[:, :, k[0]][..., m[0]], of_k[0], of_m[0])
            (i, of_i, _), (j, of_j, _) = (_basis(_RADIUS_BREAKS, axis) for axis in one)
            near = part[i[:, :, None], j[:, None, :]]
            return np.asarray(np.einsum("tij,ti,tj->t", near, of_i, of_j))
        if (one == one[:, :1]).all():
            return self._regular_part(other, one)
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
def mutual_resistance(shape: SimulatedSurface, gaps: ElectrodeGaps) -> MutualResistance:
    """Return the Green's function of a sheet; cached."""
    return MutualResistance(shape, gaps)


class SheetMapBank:
    """Maps of many sheets, evaluated together.

    w is the number of electrodes of the sheet with most; shares of the others' missing ones are 0. `sheet`
    (k,) are indices of sheets, `s` and `phi` (k,) fractions of their sides.
    """

    def __init__(self, sheets: Sequence[SheetMaps]) -> None:
        self._rows = max(len(sheet.table) for sheet in sheets)
        shape = sheets[0].table.shape[1:]
        tables = np.zeros((len(sheets), *shape, self._rows))
        for table, sheet in zip(tables, sheets, strict=True):
            table[..., : len(sheet.table) - 1] = np.moveaxis(sheet.table[:-1], 0, -1)
            table[..., -1] = sheet.table[-1]
        arrays = tables, _SHARE_BREAKS, _VALUES, _SLOPES, np.zeros((4, _TABLE_DEGREE + 1))
        memory: list[Any] = [array.reshape(-1).data for array in arrays]
        self._tables = NodeTables(memory[0], shape[0], self._rows, *memory[1:])

    def look_up(
        self, sheet: NDArray[np.intp], s: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return values (w + 1, k) of `SheetMaps.table` and their derivatives (w + 1, 2, k) by s and phi;
        positions are clipped to `EDGE_INSET_FRACTION` from each side."""
        slopes = np.empty((self._rows, 2, len(sheet)))
        return self._read(sheet, s, phi, slopes), slopes

    def values_anywhere(self, sheet: NDArray[np.intp], s: FloatArray, phi: FloatArray) -> FloatArray:
        """Return values (w + 1, k) at positions on the whole pad: beyond the maps' ends, shares and the
        conformal radius itself continue as straight lines, the latter down to 1e-3 of its value there."""
        values = self._read(sheet, s, phi, np.empty(0))
        least, greatest = EDGE_INSET_FRACTION, 1 - EDGE_INSET_FRACTION
        beyond = np.flatnonzero((np.minimum(s, phi) < least) | (np.maximum(s, phi) > greatest))
        if len(beyond):
            position = np.stack([s[beyond], phi[beyond]])
            _, slopes = self.look_up(sheet[beyond], *position)
            change = (slopes * (position - np.clip(position, least, greatest))).sum(axis=1)
            values[:-1, beyond] += change[:-1]
            values[-1, beyond] += np.log(np.maximum(1 + change[-1], 1e-3))
        return values

    def _read(
        self, sheet: NDArray[np.intp], s: FloatArray, phi: FloatArray, slopes: FloatArray
    ) -> FloatArray:
        found = np.empty((self._rows, len(sheet)))
        places = (np.ascontiguousarray(axis, np.float64) for axis in (s, phi))
        arrays = np.ascontiguousarray(sheet), *places, found.reshape(-1), slopes.reshape(-1)
        memory: list[Any] = [array.data for array in arrays]
        self._tables.read(*memory)
        return found


class _SheetSolver:
    """Solutions on one sheet.

    The boundary nodes are those of the four sides in the order x0, xa, y0, yb; a corner is a node of both its
    sides.
    """

    def __init__(self, shape: SheetMetric, gaps: ElectrodeGaps, degree: int) -> None:
        self._shape = shape
        bare = gaps.regularised(shape)
        s, phi = _element_axis(shape.length_m, bare[2:], degree), _element_axis(shape.arc, bare[:2], degree)
        self._s, self._phi = s, phi
        radius = shape.radius(s.quadrature_points)
        eigen_s, self._modes_s = eigh(s.stiffness(radius), s.mass(1 / radius))
        eigen_phi, self._modes_phi = eigh(phi.stiffness(np.ones(1)), phi.mass(np.ones(1)))
        eigenvalues = eigen_s[:, None] + eigen_phi
        eigenvalues[0, 0] = np.inf  # the constant is a separate unknown
        self._inverse = 1 / eigenvalues
        self._sides = [
            _SheetSide(phi, phi.weights, bare[0], 0, -1),
            _SheetSide(phi, phi.weights, bare[1], 0, 1),
            _SheetSide(s, s.weights / radius, bare[2], 1, -1),
            _SheetSide(s, s.weights / radius, bare[3], 1, 1),
        ]
        self._covered = np.concatenate([side.covered for side in self._sides])  # nodes under an electrode
        owner = np.repeat(np.arange(4), [len(side.covered) for side in self._sides])[self._covered]
        self.membership = (owner == np.arange(4)[:, None]).astype(np.float64)
        self._boundary = np.concatenate(
            [
                self.potential_response(np.zeros(1), phi.nodes),
                self.potential_response(s.nodes[-1:], phi.nodes),
                self.potential_response(s.nodes, np.zeros(1)),
                self.potential_response(s.nodes, phi.nodes[-1:]),
            ]
        )
        n = int(self._covered.sum())
        bordered = np.ones((n + 1, n + 1))
        bordered[:n, :n] = self._boundary[np.ix_(self._covered, self._covered)]
        bordered[n, n] = 0
        self._factors = lu_factor(bordered, overwrite_a=True)

    def potential_response(self, s: FloatArray, phi: FloatArray) -> FloatArray:
        """Return the potential at the points of the grid s x phi, per current into each boundary node.

        Every side is insulated, the current leaves uniformly, and the mean potential is 0.
        """
        modes_s, modes_phi = (
            self._s.evaluate_basis(s) @ self._modes_s,
            self._phi.evaluate_basis(phi) @ self._modes_phi,
        )
        columns = []
        for end in (0, -1):
            along = (modes_s * self._modes_s[end]) @ self._inverse
            columns.append((along[:, None] * modes_phi).reshape(-1, len(self._phi.nodes)) @ self._modes_phi.T)
        for end in (0, -1):
            around = (modes_phi * self._modes_phi[end]) @ self._inverse.T
            columns.append((modes_s[:, None] * around).reshape(-1, len(self._s.nodes)) @ self._modes_s.T)
        return np.concatenate(columns, axis=1)

    def impose_potentials(self, potentials: FloatArray, total: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return currents into the electrode nodes, and constants, for given potentials and total current."""
        solution = lu_solve(self._factors, np.concatenate([potentials, total]))
        return solution[:-1], solution[-1]

    def potential(self, currents: FloatArray, s: FloatArray, phi: FloatArray) -> FloatArray:
        """Return the potential (s, phi) of currents into the electrodes' nodes."""
        ends_s, ends_phi = self._modes_s[[0, -1]], self._modes_phi[[0, -1]]
        load = np.zeros(len(self._covered))
        load[self._covered] = currents
        x_sides, y_sides = np.split(load, [2 * len(self._phi.nodes)])
        modal = ends_s.T @ (x_sides.reshape(2, -1) @ self._modes_phi)
        modal += (y_sides.reshape(2, -1) @ self._modes_s).T @ ends_phi
        modes_s, modes_phi = (
            self._s.evaluate_basis(s) @ self._modes_s,
            self._phi.evaluate_basis(phi) @ self._modes_phi,
        )
        return np.asarray(modes_s @ (modal * self._inverse) @ modes_phi.T)

    def log_radius(self, s: FloatArray, phi: FloatArray) -> FloatArray:
        """Return the logarithm of the conformal radius [m] at the points of the grid s x phi.

        It is 2 pi times the regular part of the potential at the injected current, which is the resistance of
        a contact of unit radius.
        """
        load, constant = self._regular_part(s, phi)
        regular = np.einsum("pb,bp->p", self.potential_response(s, phi), load) + constant
        return np.asarray(2 * math.pi * regular).reshape(len(s), len(phi))

    def mutual_table(self, s: FloatArray, phi: FloatArray) -> FloatArray:
        """Return the potential at each point of the grid s x phi per current into each, plus ln(d) / 2 pi.

        The result is (points, points); d is their distance in the plane of (integral of ds / r, phi).
        """
        load, constant = self._regular_part(s, phi)
        radius = np.repeat(self._shape.radius(s), len(phi))
        return np.asarray(self.potential_response(s, phi) @ load + constant - np.log(radius) / (2 * math.pi))

    def _regular_part(self, s: FloatArray, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the regular part h of the potential of a unit current at each point of the grid s x phi.

        The potential of a unit current at P is -ln(d r) / 2 pi + h, where d is the distance from P in the
        plane of (integral of ds / r, phi). The first term is harmonic, so that h is determined by the values
        and fluxes that compensate it on the boundary. Returned are currents into the boundary
        (boundary, points) and constants (points,).
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
            bare = along(side.line.quadrature_points[side.bare])[:, None] - points[1 - side.axis]
            flux = side.outward * across / (bare**2 + across**2) / (2 * math.pi)
            loads.append(side.line.values[side.bare].T @ (side.weights[side.bare, None] * flux))
        load = np.concatenate(loads)
        insulated = self._boundary[self._covered] @ load
        currents, constant = self.impose_potentials(
            np.concatenate(potentials) - insulated, -load.sum(0, keepdims=True)
        )
        load[self._covered] += currents
        return load, constant


@dataclass(frozen=True)
class _SheetSide:
    """One side: the axis along it, its electrode, and its outward direction."""

    line: ElementAxis
    weights: FloatArray
    """Quadrature weights along the side, in the isothermal coordinate."""
    gap: tuple[float, float]
    axis: int
    """Outward direction: 0 along s, 1 along phi."""
    outward: int

    @cached_property
    def covered(self) -> NDArray[np.bool_]:
        """Mask of the nodes on the electrode, its ends included."""
        nodes, slack = self.line.nodes, 1e-9 * self.line.nodes[-1]
        return np.asarray((nodes >= self.gap[0] - slack) & (nodes <= nodes[-1] - self.gap[1] + slack))

    @cached_property
    def bare(self) -> NDArray[np.bool_]:
        """Mask of the quadrature points in the gaps."""
        at = self.line.quadrature_points
        return np.asarray((at < self.gap[0]) | (at > self.line.nodes[-1] - self.gap[1]))


def _separate_gaps(
    one: tuple[float, float], other: tuple[float, float], length: float
) -> Sequence[tuple[float, float]]:
    """Return the gaps along two opposite sides, neither too small nor almost equal."""
    first, second = np.maximum([one, other], _MIN_GAP_FRACTION * length)
    second = np.where(np.abs(second - first) < _MIN_GAP_DIFFERENCE_FRACTION * length, first, second)
    return [(float(before), float(after)) for before, after in (first, second)]


def _element_axis(length: float, gaps: Sequence[tuple[float, float]], degree: int) -> ElementAxis:
    """Return elements along two opposite sides with these gaps."""
    return ElementAxis.graded(
        length, [end for before, after in gaps for end in (before, length - after)], degree
    )


def _table_nodes(breaks: FloatArray) -> FloatArray:
    """Return the nodes of a table's elements, as fractions of a side."""
    half = np.diff(breaks)[:, None] / 2
    return np.append((breaks[:-1, None] + half * (lobatto_nodes(_TABLE_DEGREE)[:-1] + 1)).ravel(), breaks[-1])


def _basis(breaks: FloatArray, at: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return nodes (k, degree + 1) relevant at points (k,), their weights, and the weights' derivatives."""
    inside = np.clip(at, EDGE_INSET_FRACTION, 1 - EDGE_INSET_FRACTION)
    element = np.clip(np.searchsorted(breaks, inside, side="right") - 1, 0, len(breaks) - 2)
    half = (breaks[element + 1] - breaks[element]) / 2
    powers = np.ones((len(_POWERS), len(inside)))
    powers[1:] = (inside - breaks[element]) / half - 1
    powers = np.multiply.accumulate(powers, axis=0).T
    return _TABLE_DEGREE * element[:, None] + _POWERS, powers @ _VALUES, (powers @ _SLOPES) / half[:, None]


def _basis_matrix(breaks: FloatArray, at: FloatArray) -> FloatArray:
    """Return the matrix (k, nodes) from values at a table's nodes to values at points (k,)."""
    nodes, weights, _ = _basis(breaks, at)
    matrix = np.zeros((len(at), int(nodes.max()) + 1))
    matrix[np.arange(len(at))[:, None], nodes] = weights
    return matrix


RADIUS_NODES: Final[FloatArray] = _table_nodes(_RADIUS_BREAKS)
"""Nodes of the coarser tables, of conformal radii and mutual resistances."""
TABLE_NODES: Final[FloatArray] = _table_nodes(_SHARE_BREAKS)
"""Nodes of the tables of `SheetMaps`, as fractions of a side."""
