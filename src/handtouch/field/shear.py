"""Shear pads: from the overlap of two facing electrode patterns to displacement and tangential force.

Public names: `overlap_ratio`, `edge_excess`, `gap_loss` (film between two plates); `BarCell`, `BarPattern`,
`DiscPattern`, `ShearPattern`; `FilmLaw`.

An upper pattern at one potential moves with the skin over a lower one of grounded electrodes, one per
channel, with a resistive film of thickness t between them. An electrode collects the current of its overlap;
ratios of currents give the displacement, their sum the conductance of the film, and so the pressure.
Derivation and limits: docs/shear.md. The inverse for any pattern: `shear_estimate`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray

EDGE_EXCESS = 2 * math.log(2) / math.pi
"""Width, in thicknesses of the film, that current gains beyond an edge of a plate over a larger one."""
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(3)


def overlap_ratio(overlap: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return conductance and its derivative of a film between two half-planes that overlap.

    overlap: in thicknesses of the film, negative apart. The conductance is that of 1 m of edge for a film of
    1 S/m: K(1 - m) / K(m) with m = 1 / (1 + exp(pi s)), exactly; s + 4 ln 2 / pi for a wide overlap.
    """
    from scipy.special import ellipkm1, expit  # not loaded with the package

    s = np.asarray(overlap, np.float64)
    low = ellipkm1(expit(np.pi * s))
    return ellipkm1(expit(-np.pi * s)) / low, (np.pi / 2 / low) ** 2


def edge_excess(film_m: float) -> float:
    """Return the width [m] that an edge of a plate over a larger one adds to the area of their overlap."""
    return EDGE_EXCESS * film_m


def gap_loss(gap_m: float, film_m: float) -> float:
    """Return the width [m] that a gap between two grounded electrodes under one plate takes from the area.

    (4 t / pi) ln cosh(pi g / 4 t), exactly; g less two edge excesses for a wide gap.
    """
    wide = math.pi * gap_m / (4 * film_m)
    return 4 * film_m / math.pi * (wide + math.log1p(math.exp(-2 * wide)) - math.log(2))


class ShearPattern(Protocol):
    """Geometry of a shear pad: effective overlap areas of its channels at any displacement."""

    @property
    def components(self) -> tuple[str, ...]:
        """Components that the currents determine: "x", "y" [m] and "twist" [rad], in this order."""

    @property
    def channels(self) -> int:
        """Number of electrodes."""

    @property
    def travel_m(self) -> float:
        """Greatest displacement from the centre in any direction at which `areas` holds."""

    @property
    def centroids_m(self) -> FloatArray:
        """Centroids (channels, 2) of the overlaps at rest."""

    def areas(self, motion: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return effective areas (n, ...) [m2] at a motion (k, ...), and their derivatives (n, k, ...)."""


@dataclass(frozen=True)
class BarCell:
    """Edge of an upper bar over one electrode; its overlap grows as the upper pattern moves along direction.

    channel: of the electrode. direction_rad: from x. x_m, y_m: middle of the electrode's edge.
    """

    channel: int
    direction_rad: float
    x_m: float
    y_m: float


@dataclass(frozen=True)
class BarPattern:
    """Bars over electrodes with straight edges; build it by `single`, `crossed` or `pinwheel`.

    overlap_m: of each cell at rest. length_m: of each electrode along its edge; the upper bars are longer by
    the travel on both ends. gap_m: between the two electrodes under one bar, infinite where there is one.
    Raises ValueError for lengths that aren't positive.
    """

    cells: tuple[BarCell, ...]
    components: tuple[str, ...]
    overlap_m: float
    length_m: float
    gap_m: float
    film_m: float

    def __post_init__(self) -> None:
        for name in ("overlap_m", "length_m", "gap_m", "film_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    @classmethod
    def single(
        cls, bars: int, pitch_m: float, overlap_m: float, length_m: float, gap_m: float, film_m: float
    ) -> BarPattern:
        """Return parallel bars across x, each over an electrode of channel 0 and one of channel 1."""
        cells = _bar_pairs(bars, pitch_m, gap_m, 0.0, 0, (0.0, 0.0))
        return cls(cells, ("x",), overlap_m, length_m, gap_m, film_m)

    @classmethod
    def crossed(
        cls, bars: int, pitch_m: float, overlap_m: float, length_m: float, gap_m: float, film_m: float
    ) -> BarPattern:
        """Return four fields of bars: across x at two opposite corners of the pad, across y at the others.

        Channels x0, xa, y0, yb. A field has the sides bars x pitch_m and length_m; both kinds have their
        centre in that of the pad.
        """
        half = max(bars * pitch_m, length_m) / 2
        fields = [(0.0, 0, (-half, -half)), (0.0, 0, (half, half))]
        fields += [(math.pi / 2, 2, (-half, half)), (math.pi / 2, 2, (half, -half))]
        cells = [cell for field in fields for cell in _bar_pairs(bars, pitch_m, gap_m, *field)]
        return cls(tuple(cells), ("x", "y"), overlap_m, length_m, gap_m, film_m)

    @classmethod
    def pinwheel(cls, arm_m: float, overlap_m: float, length_m: float, film_m: float) -> BarPattern:
        """Return four single bars at distance arm_m from the centre, at -x, +x, -y and +y.

        The first two gain overlap by a counter-clockwise twist, the others lose; so displacement, twist and
        the film's conductance are four unknowns of four currents.
        """
        cells = (
            BarCell(0, -math.pi / 2, -arm_m, 0.0),
            BarCell(1, math.pi / 2, arm_m, 0.0),
            BarCell(2, math.pi, 0.0, -arm_m),
            BarCell(3, 0.0, 0.0, arm_m),
        )
        return cls(cells, ("x", "y", "twist"), overlap_m, length_m, math.inf, film_m)

    @property
    def channels(self) -> int:
        """Number of electrodes."""
        return 1 + max(cell.channel for cell in self.cells)

    @cached_property
    def edges(self) -> FloatArray:
        """Direction and position (m, 4) of points of integration along the electrodes' edges."""
        points = []
        for cell in self.cells:
            way = np.array([math.cos(cell.direction_rad), math.sin(cell.direction_rad)])
            along = _GAUSS_NODES * self.length_m / 2
            points += [[*way, cell.x_m - way[1] * node, cell.y_m + way[0] * node] for node in along]
        return np.array(points)

    @cached_property
    def edge_weights(self) -> FloatArray:
        """Share (channels, m) of each of these points in the electrode of a channel."""
        member = np.array([cell.channel for cell in self.cells]) == np.arange(self.channels)[:, None]
        return np.kron(member, _GAUSS_WEIGHTS / 2)

    @property
    def gap_gain_m(self) -> float:
        """Width that the gap to the other electrode under a bar adds to an overlap, 0 without; negative."""
        if math.isinf(self.gap_m):
            return 0.0
        return self.gap_m / 2 - gap_loss(self.gap_m, self.film_m) / 2 - edge_excess(self.film_m)

    @property
    def travel_m(self) -> float:
        """Displacement at which an overlap ends."""
        return self.overlap_m

    @property
    def centroids_m(self) -> FloatArray:
        """Centroids (channels, 2) of the overlaps at rest."""
        sums, counts = np.zeros((self.channels, 2)), np.zeros((self.channels, 1))
        for cell in self.cells:
            way = np.array([math.cos(cell.direction_rad), math.sin(cell.direction_rad)])
            sums[cell.channel] += np.array([cell.x_m, cell.y_m]) + way * self.overlap_m / 2
            counts[cell.channel] += 1
        return sums / counts

    def areas(self, motion: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return effective areas (n, ...) [m2] at a motion (k, ...), and their derivatives (n, k, ...).

        motion: the `components`, of which a missing y or twist is 0. A twist turns edges: overlaps are
        integrated along them.
        """
        given = np.asarray(motion, np.float64)
        x, y, twist = (given[k] if k < len(given) else np.zeros(given.shape[1:]) for k in range(3))
        excess, film = edge_excess(self.film_m), self.film_m
        length = self.length_m + 2 * excess
        edges = self.edges.reshape(-1, 4, *[1] * x.ndim)
        wx, wy, px, py = (edges[:, k] for k in range(4))
        qx, qy = px + wx * self.overlap_m, py + wy * self.overlap_m
        cosine, sine = np.cos(twist), np.sin(twist)
        rx, ry = cosine * qx - sine * qy, sine * qx + cosine * qy
        ratio, slope = overlap_ratio((wx * (rx + x - px) + wy * (ry + y - py) + self.gap_gain_m) / film)
        turn = wy * rx - wx * ry
        rates = np.stack([slope * wx, slope * wy, slope * turn], axis=1)
        weights = length * self.edge_weights
        areas = np.tensordot(weights, film * ratio, axes=1)
        slopes = np.tensordot(weights, rates, axes=1)
        return areas, slopes[:, : len(self.components)]


def _bar_pairs(
    bars: int, pitch_m: float, gap_m: float, direction_rad: float, channel: int, centre_m: tuple[float, float]
) -> tuple[BarCell, ...]:
    """Return the cells of bars across a direction; the second channel's overlap grows along it."""
    way = np.array([math.cos(direction_rad), math.sin(direction_rad)])
    cells = []
    for bar in range(bars):
        middle = np.array(centre_m) + way * pitch_m * (bar - (bars - 1) / 2)
        for side in (-1, 1):
            x, y = (middle + side * way * gap_m / 2).tolist()
            turned = direction_rad + (math.pi if side < 0 else 0.0)
            cells.append(BarCell(channel + (side > 0), turned, x, y))
    return tuple(cells)


@dataclass(frozen=True)
class DiscPattern:
    """Round upper plates, each over four sectors that face -x, +x, -y and +y; gaps along the diagonals.

    discs: number of plates, at distances large enough that they don't disturb each other; all sectors that
    face one way are one channel. Twist about its own centre doesn't change a disc's overlaps.
    Raises ValueError for lengths that aren't positive, and for a gap wider than the radius.
    """

    discs: int
    radius_m: float
    gap_m: float
    film_m: float

    def __post_init__(self) -> None:
        for name in ("discs", "radius_m", "gap_m", "film_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.gap_m >= self.radius_m:
            raise ValueError(f"gap_m {self.gap_m} must be less than radius_m {self.radius_m}")

    @property
    def components(self) -> tuple[str, ...]:
        """Displacement along both axes."""
        return ("x", "y")

    @property
    def channels(self) -> int:
        """Number of electrodes."""
        return 4

    @property
    def travel_m(self) -> float:
        """Displacement at which the corner of a sector may leave its disc."""
        return self.radius_m - self.gap_m

    @property
    def centroids_m(self) -> FloatArray:
        """Centroids (channels, 2) of the overlaps at rest, of a disc in the centre."""
        distance = 4 * math.sqrt(2) / (3 * math.pi) * self.radius_m
        return distance * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])

    def areas(self, motion: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return effective areas (4, ...) [m2] at a displacement (2, ...), and derivatives (4, 2, ...).

        NaN where the corner of a sector lies outside the disc.
        """
        x, y = np.asarray(motion, np.float64)
        radius = self.radius_m + edge_excess(self.film_m)
        inset = gap_loss(self.gap_m, self.film_m) / 2
        root = math.sqrt(0.5)
        p, q = root * (x + y), root * (y - x)  # along the diagonals
        areas, slopes = [], []
        for across, along in ((-1, 1), (1, -1), (-1, -1), (1, 1)):  # x0, xa, y0, yb
            low_p, low_q = inset - across * p, inset - along * q
            area, by_p, by_q = _corner_of_disc(radius, low_p, low_q)
            by_p, by_q = -across * by_p, -along * by_q
            areas.append(area)
            slopes.append([root * (by_p - by_q), root * (by_p + by_q)])
        return self.discs * np.array(areas), self.discs * np.array(slopes)


def _corner_of_disc(
    radius: float, low_p: FloatArray, low_q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the area of a disc where p > low_p and q > low_q, and its derivatives by both."""
    with np.errstate(invalid="ignore"):
        high_p, high_q = np.sqrt(radius**2 - low_q**2), np.sqrt(radius**2 - low_p**2)
        outside = ~(low_p**2 + low_q**2 < radius**2)
        wedge = radius**2 * (np.arccos(low_p / radius) - np.arcsin(low_q / radius))
        area = (wedge - low_q * (high_p - low_p) - low_p * (high_q - low_q)) / 2
    area = np.where(outside, np.nan, area)
    return area, -(high_q - low_q), -(high_p - low_p)


@dataclass(frozen=True)
class FilmLaw:
    """Conductance of a bonded film per area, siemens_per_m2 (1 + pressure / reference_pa)^alpha.

    plate_m2: area that carries the normal force. gyration_m2: its mean square half-width, w^2 / 12 of a side
    w: an off-centre normal force tilts the pressure by centre . position / gyration_m2.
    """

    siemens_per_m2: float
    reference_pa: float
    alpha: float
    plate_m2: float
    gyration_m2: float

    def conductance(self, normal_force_n: npt.ArrayLike) -> FloatArray:
        """Return the conductance per area [S/m2] under a central normal force."""
        pressure = np.asarray(normal_force_n, np.float64) / self.plate_m2
        return self.siemens_per_m2 * (1 + pressure / self.reference_pa) ** self.alpha

    def tilts(
        self, normal_force_n: npt.ArrayLike, centre_m: npt.ArrayLike, centroids_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return ln(conductance) of each channel over that of a central force, and its derivatives.

        normal_force_n: (...). centre_m: (2, ...) of its pressure, which is linear over the plate, and 0 where
        the plate would lift. centroids_m: (n, 2) of the channels. Returns (n, ...), derivatives by the centre
        (n, 2, ...) [1/m] and by the force (n, ...) [1/N].
        """
        reference_n = self.plate_m2 * self.reference_pa
        load = np.asarray(normal_force_n, np.float64) / reference_n
        lean = (
            1 + np.einsum("nc,c...->n...", centroids_m, np.asarray(centre_m, np.float64)) / self.gyration_m2
        )
        lean = np.maximum(lean, 0.0)
        logs = self.alpha * (np.log1p(load * lean) - np.log1p(load))
        rate = self.alpha * load * (lean > 0) / (1 + load * lean)
        arms = centroids_m.reshape(*centroids_m.shape, *[1] * load.ndim) / self.gyration_m2
        by_force = self.alpha / reference_n * (lean / (1 + load * lean) - 1 / (1 + load))
        return logs, arms * rate[:, None], by_force
