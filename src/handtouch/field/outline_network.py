"""Pads of any outline with any electrodes on their boundary; a `ForwardModel` like `ElectrodeNetwork`.

Public names: `OutlineNetwork`, `BoundaryElectrode`.

By reciprocity the current that a point contact sends to grounded electrode i is the potential phi_i there
when electrode i alone is at 1 and the bare boundary insulates; `_mixed_problem` computes those potentials by
a boundary integral equation, `_series_resistors` adds the resistors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field._boundary_panels import Stretch, initial_panels
from handtouch.field._mixed_problem import MixedProblem
from handtouch.field._series_resistors import GroundedElectrodes
from handtouch.field.outline import ComplexArray, Outline
from handtouch.field.surface_base import MIN_CLEARANCE

_SMOOTH_ANGLE_RAD = 1e-9
_MAX_IMAGE_DISTANCE = 0.5  # distance of a point from its mirror image, over the larger extent
_MIN_IMAGE_CLEARANCE = 0.5  # distance of a mirror image from the boundary over that of its source
_ORIGIN_ROUNDING = 1e-9


@dataclass(frozen=True)
class BoundaryElectrode:
    """Part of a contour of an outline: from position `start` on in the direction of the vertices to `stop`.

    Positions are arc lengths from the contour's first vertex; it may lie between (stop < start). Contour 0 is
    the outer one, contour i hole i - 1.
    """

    start: float
    stop: float
    contour: int = 0


@dataclass(frozen=True)
class _Piece:
    """Part of an edge from s0 to s1 between singular points, with its electrode (-1 if bare)."""

    contour: int
    edge: int
    s0: float
    s1: float
    electrode: int


class OutlineNetwork(GroundedElectrodes):
    """A resistive sheet of any outline with two or more electrodes on its boundary; a `ForwardModel`.

    outline: touches both axes from above and from the right (`Outline.at_origin`). electrodes: their order is
    that of the channels; bare stretches insulate. series_ohm: resistors from the electrodes to ground, none
    unless given; infinity leaves one floating. resistivity_ratio: rho_x / rho_y of an anisotropic sheet,
    whose `sheet_ohm_per_square` is then sqrt(rho_x rho_y) / w. tolerance: of the boundary's densities.

    Fractions and conductance are accurate to some 1e-10, with re-entrant corners, too, derivatives to 1e-8
    from 1 % of the pad inwards. Arguments broadcast; points off the pad or NaN give NaN. Building takes the
    cube of `unknowns`: a second or two for 1,500.

    Raises ValueError naming electrodes that are off the contour, touch or overlap, electrodes and gaps
    shorter than 1e-4 of the larger extent, impossible resistances, and outlines that need more than 6,000
    unknowns.
    """

    def __init__(
        self,
        outline: Outline,
        electrodes: Sequence[BoundaryElectrode],
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] | None = None,
        resistivity_ratio: float = 1.0,
        tolerance: float = 1e-7,
    ) -> None:
        x0, y0, x1, y1 = outline.bounds
        if max(abs(x0), abs(y0)) > _ORIGIN_ROUNDING * max(x1 - x0, y1 - y0):
            raise ValueError(f"outline begins at ({x0:g}, {y0:g}), not at the axes; use outline.at_origin()")
        for name, value in (
            ("sheet_ohm_per_square", sheet_ohm_per_square),
            ("resistivity_ratio", resistivity_ratio),
            ("tolerance", tolerance),
        ):
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be positive and finite, got {value}")
        self.outline = outline
        self.electrodes = tuple(electrodes)
        self.sheet_ohm_per_square = float(sheet_ohm_per_square)
        self.resistivity_ratio = float(resistivity_ratio)
        self._extent = x1, y1
        self._stretch = math.sqrt(resistivity_ratio)
        self._unit = max(x1 * self._stretch, y1)
        self._solved = outline.stretched(self._stretch / self._unit, 1 / self._unit)
        self._pieces = _pieces(outline, self.electrodes)
        panels = [p for stretch in _stretches(self._solved, self._pieces) for p in initial_panels(stretch)]
        self._problem = MixedProblem(panels, len(self.electrodes), tolerance)
        none = (0.0,) * len(self.electrodes)
        self._set_series_resistors(none if series_ohm is None else series_ohm, len(self.electrodes))

    @property
    def a(self) -> float:
        """Extent along x, from 0, in the unit of the outline."""
        return self._extent[0]

    @property
    def b(self) -> float:
        """Extent along y, from 0, in the unit of the outline."""
        return self._extent[1]

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the boundary integral equation."""
        return self._problem.unknowns

    @property
    def conductance(self) -> FloatArray:
        """Currents into the electrodes per unit of their voltages (m, m), for one ohm per square.

        Symmetric, rows sum to zero, to the accuracy of the solution.
        """
        return self._problem.conductance

    def boundary_fractions(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `ideal_fractions` (m, n) at points of the outer contour, finer towards corners.

        First their positions on the contour (n,), then x and y (2, n).
        """
        edges = self._solved.contours[0]
        begins = np.cumsum([0.0, *(edge.length for edge in self.outline.contours[0])])
        numbers = {id(edge): number for number, edge in enumerate(edges)}
        positions = []
        for panel in self._problem.panels:
            number = numbers.get(id(panel.stretch.edge))
            if number is None:
                positions.append(np.full(len(panel.t), np.nan))
            else:
                positions.append(begins[number] + self.outline.contours[0][number].length_to(panel.s))
        position = np.concatenate(positions)
        outer = np.flatnonzero(np.isfinite(position))
        z = self._problem.nodes[outer] * self._unit
        points = np.stack([z.real / self._stretch, z.imag])
        return position[outer], points, self._problem.boundary_potentials[:, outer]

    def ideal_fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the fractions that directly grounded electrodes would collect, shape (m, ...), summing to
        1.
        """
        z, inside, shape = self._points(x, y)
        values = np.full((len(self.electrodes), z.size), np.nan)
        values[:, inside] = self._problem.potentials(z[inside])
        return values.reshape(-1, *shape)

    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` (m, ...) and derivatives by (x, y) (m, 2, ...), unbounded at electrodes'
        ends.
        """
        z, inside, shape = self._points(x, y)
        count = len(self.electrodes)
        values, jacobian = np.full((count, z.size), np.nan), np.full((count, 2, z.size), np.nan)
        values[:, inside], slope = self._problem.potentials_and_slope(z[inside])
        jacobian[:, 0, inside] = slope.real * (self._stretch / self._unit)
        jacobian[:, 1, inside] = -slope.imag / self._unit
        mixed = self._mixed(values), self._mixed(jacobian)
        return mixed[0].reshape(count, *shape), mixed[1].reshape(count, 2, *shape)

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return R: the sheet's resistance to a contact of radius A at (x, y) is sheet / (2 pi) ln(R / A).

        Electrodes at ground, in the unit of the outline, shape (...); exact for small contacts. On an
        anisotropic sheet the contact is an ellipse of the stretched pad, of the same resistance as a disc of
        its mean radius. For resistors see `series_resistance`.
        """
        z, inside, shape = self._points(x, y)
        values = np.full(z.size, np.nan)
        image, sign = self._mirror_images(z[inside])
        values[inside] = np.exp(self._problem.log_spread(z[inside], image, sign))
        return values.reshape(shape) * (self._unit * 2 / (1 + self._stretch))

    def _points(
        self, x: npt.ArrayLike, y: npt.ArrayLike
    ) -> tuple[ComplexArray, npt.NDArray[np.intp], tuple[int, ...]]:
        """Return points of the solved outline (n,), the indices of those inside, and the shape."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        z = np.asarray(x * self._stretch + 1j * y).ravel() / self._unit
        inside = np.flatnonzero(np.isfinite(z))
        inside = inside[self._solved.contains(z[inside].real, z[inside].imag)]
        return z, inside, x.shape

    def _mirror_images(self, z: ComplexArray) -> tuple[ComplexArray, FloatArray]:
        """Return reflections by the nearest edge and their signs, see `MixedProblem.log_spread`."""
        best, s = np.full(z.size, np.inf), np.zeros(z.size)
        nearest = np.zeros(z.size, np.intp)
        edges = [self._solved.contours[piece.contour][piece.edge] for piece in self._pieces]
        for index, (piece, edge) in enumerate(zip(self._pieces, edges, strict=True)):
            foot = np.clip(edge.nearest_parameter(z), piece.s0, piece.s1)
            distance = np.abs(edge.point(foot) - z)
            closer = distance < best
            best[closer], s[closer], nearest[closer] = distance[closer], foot[closer], index
        image = np.array(
            [edges[i].reflection(at, w) for i, at, w in zip(nearest, s, z, strict=True)], np.complex128
        )
        bare = np.array([piece.electrode < 0 for piece in self._pieces])
        clear = np.full(z.size, np.inf)  # distance of the images from the boundary
        for edge in dict.fromkeys(edges):
            clear = np.minimum(clear, np.abs(edge.point(edge.nearest_parameter(image)) - image))
        used = (np.abs(image - z) < _MAX_IMAGE_DISTANCE) & (clear > _MIN_IMAGE_CLEARANCE * best)
        used &= ~self._solved.contains(image.real, image.imag)
        return np.where(used, image, z + 1.0), np.where(used, np.where(bare[nearest], 1.0, -1.0), 0.0)


def _pieces(outline: Outline, electrodes: Sequence[BoundaryElectrode]) -> list[_Piece]:
    """Return the boundary between corners and electrodes' ends, in order, contour by contour."""
    if len(electrodes) < 2:
        raise ValueError(f"electrodes: at least two are needed, got {len(electrodes)}")
    shortest = MIN_CLEARANCE * max(outline.bounds[2], outline.bounds[3])
    places = [[outline.locate_position(p, e.contour) for p in (e.start, e.stop)] for e in electrodes]
    pieces = []
    for contour, edges in enumerate(outline.contours):
        mine = [i for i, e in enumerate(electrodes) if e.contour == contour]
        ends = sorted((place, i, k) for i in mine for k, place in enumerate(places[i]))
        _check_order(outline, electrodes, mine, shortest)
        # covered at the first vertex by the electrode that ends first
        current = ends[0][1] if ends and ends[0][2] == 1 else -1
        stops = {(index, 0.0) for index in range(len(edges))} | {place for place, _, _ in ends}
        ordered = sorted(stops)
        for (index, s0), (following, s1) in itertools.pairwise([*ordered, (len(edges), 0.0)]):
            for place, i, k in ends:
                if place == (index, s0):
                    current = i if k == 0 else -1
            pieces.append(_Piece(contour, index, s0, s1 if following == index else 1.0, current))
    return pieces


def _check_order(
    outline: Outline, electrodes: Sequence[BoundaryElectrode], mine: Sequence[int], shortest: float
) -> None:
    """Raise ValueError where electrodes of a contour overlap, touch, or are too short."""
    if not mine:
        return
    perimeter = outline.perimeter(electrodes[mine[0]].contour)
    order = sorted(mine, key=lambda i: electrodes[i].start % perimeter)
    for i, following in zip(order, [*order[1:], order[0]], strict=True):
        electrode, after = electrodes[i], electrodes[following]
        length = (electrode.stop - electrode.start) % perimeter
        if length < shortest:
            raise ValueError(f"electrode {i} is {length:.3g} long; at least {shortest:.3g} is needed")
        gap = (after.start - electrode.start) % perimeter - length
        if i == following:
            gap += perimeter
        if gap < -1e-12 * perimeter:
            raise ValueError(f"electrodes overlap: {i} and {following}")
        if gap < shortest:
            raise ValueError(
                f"electrodes {i} and {following} have a gap of {max(gap, 0.0):.3g}; "
                f"at least {shortest:.3g} is needed"
            )


def _stretches(outline: Outline, pieces: Sequence[_Piece]) -> list[Stretch]:
    """Return both halves of every piece, each graded towards its end as the singularity there needs."""
    stretches = []
    for contour, edges in enumerate(outline.contours):
        ring = [piece for piece in pieces if piece.contour == contour]
        angles = outline.corner_angles(contour)
        for before, piece, after in zip([ring[-1], *ring[:-1]], ring, [*ring[1:], ring[0]], strict=True):
            edge = edges[piece.edge]
            half = (piece.s1 - piece.s0) / 2
            for s, reach, other in ((piece.s0, half, before), (piece.s1, -half, after)):
                vertex = (piece.edge if s == 0 else piece.edge + 1) % len(edges) if s in (0.0, 1.0) else None
                anchor = complex(edge.point(s)) if vertex is None else edges[vertex].start
                power, reentrant = 2, False
                if vertex is not None:
                    curvatures = [
                        float(e.curvature(at)) for e, at in ((edges[vertex - 1], 1.0), (edges[vertex], 0.0))
                    ]
                    reentrant = bool(angles[vertex] > math.pi + _SMOOTH_ANGLE_RAD)
                    power = _power(angles[vertex], curvatures, other.electrode != piece.electrode)
                stretches.append(
                    Stretch(edge, s, reach, power, anchor, piece.electrode, outline.signs[contour], reentrant)
                )
    return stretches


def _power(angle: float, curvatures: Sequence[float], mixed: bool) -> int:
    """Return the power of t by which panels at a vertex are graded."""
    if abs(angle - math.pi) < _SMOOTH_ANGLE_RAD:
        if mixed:
            return 2  # the potential has a square root there, exactly
        return 1 if math.isclose(*curvatures, rel_tol=1e-9, abs_tol=1e-9) else 3
    return 4 if mixed and angle > math.pi else 3
