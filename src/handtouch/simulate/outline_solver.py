"""Solve the potential of a sheet of any outline by finite elements: the simulator's forward model for them.

Public names: `solve_outline` -> `SheetMaps`, `outline_mutual_resistance`; `log_radius_table`.

The sheet's equation is solved on the square that the transfinite map of `SimulatedOutline` takes to the pad,
where it has the conductivity tensor det J (J' J)^-1. Elements are products of one-dimensional ones, graded
towards the ends of the electrodes and with limits at the outline's vertices. It uses nothing of
`handtouch.field`, so that the two can be checked against each other.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.simulate.outline_geometry import SimulatedOutline
from handtouch.simulate.sheet_solver import (
    EDGE_INSET_FRACTION,
    RADIUS_NODES,
    TABLE_NODES,
    ArcEnds,
    ElectrodeGaps,
    MutualResistance,
    SheetMaps,
)
from handtouch.simulate.spectral_elements import ElementAxis, lobatto_nodes
from handtouch.simulate.unevenness import Unevenness

_DEGREE, _RADIUS_DEGREE, _ARC_RADIUS_DEGREE = 5, 4, 3  # arcs have more elements
_MIN_GAP_FRACTION = 1e-3  # bare gap over a side
_MIN_ARC_FRACTION = 1e-4  # part of an electrode over a side; shorter ones are left out
_MIN_STATIC_TIMES = 20
"""Samples of two contacts that don't move, from which on they are solved without a table."""
_TABLE_DEGREE = 12
RADIUS_TABLE_NODES = 0.5 + (0.5 - EDGE_INSET_FRACTION) * lobatto_nodes(_TABLE_DEGREE)
"""Fractions of a side at which conformal radii are solved, for `log_radius_table`."""
_TO_TABLE = np.linalg.solve(  # interpolates values at the nodes to the tables' nodes
    np.polynomial.legendre.legvander(
        (2 * RADIUS_TABLE_NODES - 1) / (1 - 2 * EDGE_INSET_FRACTION), _TABLE_DEGREE
    ).T,
    np.polynomial.legendre.legvander((2 * TABLE_NODES - 1) / (1 - 2 * EDGE_INSET_FRACTION), _TABLE_DEGREE).T,
).T


@lru_cache(maxsize=32)
def solve_outline(
    shape: SimulatedOutline, gaps: ElectrodeGaps | ArcEnds, unevenness: Unevenness
) -> SheetMaps:
    """Return the maps of a sheet of nominally 1 ohm per square; cached.

    Shares and conductance are those of the uneven sheet, the conformal radius that of an even one.
    """
    covers_sides = isinstance(gaps, ElectrodeGaps)
    sheet = _OutlineSheet(shape, gaps, unevenness, _DEGREE if covers_sides else _RADIUS_DEGREE)
    shares = sheet.interpolate(TABLE_NODES, TABLE_NODES, sheet.unit_potentials)
    even = _OutlineSheet(shape, gaps, Unevenness(), _RADIUS_DEGREE if covers_sides else _ARC_RADIUS_DEGREE)
    coarse = np.stack(np.meshgrid(RADIUS_TABLE_NODES, RADIUS_TABLE_NODES, indexing="ij")).reshape(2, -1)
    regular = (even.evaluate(RADIUS_TABLE_NODES, RADIUS_TABLE_NODES) * even.regular_parts(coarse).T).sum(
        axis=1
    )
    log_radius = 2 * math.pi * regular + np.log(shape.stretch_at(coarse))
    log_radius -= math.log(
        (1 + shape.stretch) / 2
    )  # a disc is stretched to an ellipse, of that mean half axis
    table = log_radius_table(log_radius, covers_sides)
    return SheetMaps(sheet.conductance, np.concatenate([shares, table[None]]))


def log_radius_table(log_radius: FloatArray, covers_sides: bool) -> FloatArray:
    """Return logarithms of conformal radii at `TABLE_NODES` from those (n n,) at `RADIUS_TABLE_NODES`.

    covers_sides: electrodes cover all sides, where the radius vanishes; without that a polynomial is left.
    """
    table = log_radius.reshape(2 * (len(RADIUS_TABLE_NODES),))
    if not covers_sides:
        return np.asarray(_TO_TABLE @ table @ _TO_TABLE.T)
    table = _TO_TABLE @ (table - _log_edge_distance(RADIUS_TABLE_NODES)) @ _TO_TABLE.T
    return np.asarray(table + _log_edge_distance(TABLE_NODES))


def _log_edge_distance(nodes: FloatArray) -> FloatArray:
    """Return ln (n, n) of a length on the grid of nodes that vanishes at electrodes as the radius does: in a
    quadrant it is half the conformal radius."""
    along = nodes**-2.0 + (1 - nodes) ** -2.0
    return np.asarray(-np.log(along[:, None] + along) / 2)


class _OutlineMutualResistance(MutualResistance):
    """Green's function of a sheet of any outline with grounded electrodes, as a resistance."""

    def __init__(self, shape: SimulatedOutline, gaps: ElectrodeGaps | ArcEnds) -> None:
        self._outline = shape
        self._sheet = _OutlineSheet(shape, gaps, Unevenness(), _RADIUS_DEGREE)

    @cached_property
    def _table(self) -> FloatArray:  # type: ignore[override]
        """Regular parts between all nodes: takes seconds, for contacts that move."""
        points = np.stack(np.meshgrid(RADIUS_NODES, RADIUS_NODES, indexing="ij")).reshape(2, -1)
        regular = self._sheet.evaluate(RADIUS_NODES, RADIUS_NODES) @ self._sheet.regular_parts(points)
        return np.asarray(regular.reshape(4 * (len(RADIUS_NODES),)))

    @lru_cache(maxsize=4096)  # noqa: B019  there are few sheets
    def static_resistance_ohm(
        self, x: float, y: float, other_x: float, other_y: float, nearest_m: float
    ) -> float:
        """Return `resistance_ohm` between two static positions, without a table; cached."""
        one, other = np.array([[x], [y]]), np.array([[other_x], [other_y]])
        regular = self._sheet.evaluate(one[0], one[1]) @ self._sheet.regular_parts(other)
        return float(regular[0, 0] + self._direct_part(one, other, np.array([nearest_m]))[0])

    def resistance_ohm(self, one: FloatArray, other: FloatArray, nearest_m: FloatArray) -> FloatArray:
        """Return the resistance (n,) between positions (2, n) [fractions], at least `nearest_m` apart."""
        pairs, times = np.unique(np.stack([*one, *other, nearest_m]), axis=1, return_inverse=True)
        if _MIN_STATIC_TIMES * pairs.shape[1] <= len(nearest_m):  # contacts that rest, one after the other
            solved = [self.static_resistance_ohm(*pair) for pair in pairs.T.tolist()]
            return np.array(solved)[times.ravel()]
        return np.asarray(self._regular_part(one, other) + self._direct_part(one, other, nearest_m))

    def _direct_part(self, one: FloatArray, other: FloatArray, nearest_m: FloatArray) -> FloatArray:
        """Return the resistance (n,) on an infinite sheet, to a constant."""
        apart = _stretched(self._outline, one)[0] - _stretched(self._outline, other)[0]
        distance = np.maximum(np.hypot(*apart), nearest_m / self._outline.stretch_at(one))
        return np.asarray(-np.log(distance) / (2 * math.pi))


@lru_cache(maxsize=24)
def outline_mutual_resistance(shape: SimulatedOutline, gaps: ElectrodeGaps | ArcEnds) -> MutualResistance:
    """Return the Green's function of a sheet; cached."""
    return _OutlineMutualResistance(shape, gaps)


def _stretched(shape: SimulatedOutline, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the drawing and its derivatives, stretched along x until the sheet is isotropic."""
    drawn, slopes = shape.drawing(position)
    factors = np.array([shape.stretch, 1.0])
    return (
        drawn * factors.reshape(2, *(1,) * (drawn.ndim - 1)),
        slopes * factors.reshape(2, *(1,) * (slopes.ndim - 1)),
    )


class _OutlineSheet:
    """Solutions on one sheet; nodes are those of the square, p slowest."""

    def __init__(
        self, shape: SimulatedOutline, gaps: ElectrodeGaps | ArcEnds, unevenness: Unevenness, degree: int
    ) -> None:
        from scipy.sparse.linalg import splu

        self._shape, self._degree = shape, degree
        self._covered = (
            _sides_covered(shape, gaps) if isinstance(gaps, ElectrodeGaps) else _arcs_covered(shape, gaps)
        )
        ends: list[list[float]] = [[], []]
        for side, begin, end in (part for parts in self._covered for part in parts):
            ends[side < 2] += [at for at in (begin, end) if 0 < at < 1]
        self._p = ElementAxis.graded(1.0, _distinct([*ends[0], *shape.breaks((0, 2))]), degree)
        self._q = ElementAxis.graded(1.0, _distinct([*ends[1], *shape.breaks((1, 3))]), degree)
        stiffness = self._assemble(unevenness)
        size = (len(self._p.nodes), len(self._q.nodes))
        number = np.arange(size[0] * size[1]).reshape(size)
        sides = (number[0], number[-1], number[:, 0], number[:, -1])
        lines = (self._q.nodes, self._q.nodes, self._p.nodes, self._p.nodes)
        slack = 1e-9
        self._electrodes = [
            np.unique(
                np.concatenate(
                    [
                        sides[side][(lines[side] >= begin - slack) & (lines[side] <= end + slack)]
                        for side, begin, end in parts
                    ]
                )
            )
            for parts in self._covered
        ]
        held = np.concatenate(self._electrodes)
        self._free = np.setdiff1d(number.ravel(), held)
        self._stiffness = stiffness
        self._factors = splu(
            stiffness[self._free][:, self._free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        potentials = np.zeros((number.size, len(self._electrodes)))
        for electrode, nodes in enumerate(self._electrodes):
            potentials[nodes, electrode] = 1.0
        self.unit_potentials = self._complete(potentials, np.zeros_like(potentials))
        """(nodes, m), with one electrode at 1."""
        self.conductance: FloatArray = self.unit_potentials.T @ (stiffness @ self.unit_potentials)

    def evaluate(self, p: FloatArray, q: FloatArray) -> FloatArray:
        """Return the matrix (points, nodes) to the values on the grid p x q."""
        return np.asarray(np.kron(self._p.evaluate_basis(p), self._q.evaluate_basis(q)), np.float64)

    def interpolate(self, p: FloatArray, q: FloatArray, values: FloatArray) -> FloatArray:
        """Return values (nodes, k) on the grid p x q: (k, points p, points q)."""
        grid = values.T.reshape(-1, len(self._p.nodes), len(self._q.nodes))
        return np.asarray(self._p.evaluate_basis(p) @ grid @ self._q.evaluate_basis(q).T, np.float64)

    def regular_parts(self, position: FloatArray) -> FloatArray:
        """Return the regular part (nodes, k) of the potential of a unit current at positions (2, k).

        It compensates the values of -ln(r) / 2 pi on the electrodes and its flux through the bare boundary.
        """
        source = _stretched(self._shape, position)[0]
        potentials = np.zeros((len(self._p.nodes) * len(self._q.nodes), position.shape[1]))
        loads = np.zeros_like(potentials)
        for nodes in self._electrodes:
            at = self._node_positions[:, nodes]
            apart = _stretched(self._shape, at)[0][:, :, None] - source[:, None]
            potentials[nodes] = np.log(np.hypot(*apart)) / (2 * math.pi)
        for side in range(4):
            line = self._q if side < 2 else self._p
            points = line.quadrature_points
            is_bare = np.ones(len(points), np.bool_)
            for on, begin, end in (part for parts in self._covered for part in parts):
                is_bare &= (on != side) | (points < begin) | (points > end)
            fixed = np.full(int(is_bare.sum()), float(side % 2))
            way = points[is_bare]
            on_side = np.stack([fixed, way] if side < 2 else [way, fixed])
            drawn, slopes = _stretched(self._shape, on_side)
            along = slopes[:, 1 if side < 2 else 0]
            x, y = drawn[:, :, None] - source[:, None]
            sign = 1.0 if side in (1, 2) else -1.0  # sense of the outline along the side
            turn = sign * (x * along[1][:, None] - y * along[0][:, None]) / (x * x + y * y)
            weights = line.weights[is_bare, None] * turn / (2 * math.pi)
            numbers = self._side_numbers[side]
            loads[numbers] += line.values[is_bare].T @ weights
        return self._complete(potentials, loads)

    @cached_property
    def _node_positions(self) -> FloatArray:
        return np.stack(np.meshgrid(self._p.nodes, self._q.nodes, indexing="ij")).reshape(2, -1)

    @cached_property
    def _side_numbers(self) -> list[NDArray[np.intp]]:
        number = np.arange(self._node_positions.shape[1]).reshape(len(self._p.nodes), -1)
        return [number[0], number[-1], number[:, 0], number[:, -1]]

    def _complete(self, potentials: FloatArray, loads: FloatArray) -> FloatArray:
        """Return the potentials (nodes, k) that are given on the electrodes, with loads elsewhere."""
        whole = potentials.copy()
        right = loads - self._stiffness @ potentials
        whole[self._free] = self._factors.solve(np.ascontiguousarray(right[self._free]))
        return whole

    def _assemble(self, unevenness: Unevenness):  # type: ignore[no-untyped-def]
        from scipy.sparse import coo_array

        p, q = self._p, self._q
        count, points = self._degree + 1, self._degree + 2
        across = np.stack(np.meshgrid(p.quadrature_points, q.quadrature_points, indexing="ij"))
        (xp, xq), (yp, yq) = _stretched(self._shape, across)[1]
        det = xp * yq - xq * yp
        if not (det > 0).all():
            raise ValueError(
                "outline: the simulator's grid folds over; choose corners nearer to its real ones"
            )
        weight = np.outer(p.weights, q.weights) / det
        if not unevenness.is_even:
            weight = weight / unevenness.ohm_ratio(across)
        tensors = (weight * (xq * xq + yq * yq), weight * (xp * xp + yp * yp), -weight * (xp * xq + yp * yq))
        rows, columns, values = [], [], []
        number = np.arange(len(p.nodes) * len(q.nodes)).reshape(len(p.nodes), -1)
        for e in range(len(p.breaks) - 1):
            pick = slice(e * points, (e + 1) * points)
            own = slice(e * self._degree, e * self._degree + count)
            at, by = p.values[pick, own], p.slopes[pick, own]
            for f in range(len(q.breaks) - 1):
                here = slice(f * points, (f + 1) * points)
                mine = slice(f * self._degree, f * self._degree + count)
                value, slope = q.values[here, mine], q.slopes[here, mine]
                by_p, by_q = _kronecker(by, value), _kronecker(at, slope)
                pp, qq, pq = (tensor[pick, here].reshape(-1, 1) for tensor in tensors)
                local = by_p.T @ (pp * by_p + pq * by_q) + by_q.T @ (qq * by_q + pq * by_p)
                nodes = number[own, mine].ravel()
                rows.append(np.repeat(nodes, len(nodes)))
                columns.append(np.tile(nodes, len(nodes)))
                values.append(local.ravel())
        indices = np.concatenate(rows), np.concatenate(columns)
        return coo_array((np.concatenate(values), indices), shape=2 * (number.size,)).tocsr()


def _kronecker(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return `numpy.kron` of two matrices, without its overhead."""
    rows, columns = one.shape[0] * other.shape[0], one.shape[1] * other.shape[1]
    return np.asarray((one[:, None, :, None] * other[None, :, None, :]).reshape(rows, columns))


def _distinct(ends: list[float]) -> list[float]:
    """Return sorted ends without those that almost coincide with another one."""
    kept: list[float] = []
    for end in sorted(ends):
        if not kept or end - kept[-1] > 1e-6:
            kept.append(end)
    return kept


_Covered = list[list[tuple[int, float, float]]]
"""Parts that each electrode covers: side (0 to 3: x0, xa, y0, yb), begin and end as fractions of it."""


def _sides_covered(shape: SimulatedOutline, gaps: ElectrodeGaps) -> _Covered:
    units = (shape.arc, shape.arc, shape.length_m, shape.length_m)
    bare = [
        [max(gap / unit, _MIN_GAP_FRACTION) for gap in pair] for pair, unit in zip(gaps, units, strict=True)
    ]
    return [[(side, before, 1 - after)] for side, (before, after) in enumerate(bare)]


def _arcs_covered(shape: SimulatedOutline, arcs: ArcEnds) -> _Covered:
    """Divide arcs at the corners of the square."""
    whole = sum(shape.side_lengths_m)
    covered: _Covered = []
    for begin, end in arcs:
        parts: list[tuple[int, float, float]] = []
        length = (end - begin) % whole
        # sides in the order of the outline, which passes yb and x0 from their high to their low ends
        for side, corner, own in zip((2, 1, 3, 0), shape.corners_m, shape.side_lengths_m, strict=True):
            for turn in (0.0, whole):
                from_begin = (corner - begin) % whole - turn
                low, high = max(0.0, -from_begin) / own, min(own, length - from_begin) / own
                if high - low > _MIN_ARC_FRACTION:
                    parts.append((side, low, high) if side in (1, 2) else (side, 1 - high, 1 - low))
        covered.append(parts)
    return covered
