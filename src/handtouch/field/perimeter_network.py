"""Rectangular pads whose electrodes lie anywhere on the boundary, across corners too.

Public names: `PerimeterNetwork`, `perimeter_point`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handtouch.field._disc import CirclePoints, DiscMap
from handtouch.field._electrodes import ElectrodePotentials
from handtouch.field.rectangle import Rectangle
from handtouch.field.rectangle_network import ElectrodeEnd, RectangleNetwork

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
_CENTRE_POINTS = 64  # points of an electrode, whose mean is its centre


class PerimeterNetwork(RectangleNetwork):
    """A resistive rectangle [0, a] x [0, b] with electrodes on any stretches of its boundary; a
    `ForwardModel`.

    spans: begin and end of each electrode, (m, 2), lengths along the boundary counter-clockwise from corner
    (0, 0), in the unit of a and b, modulo 2 (a + b); begin < end, in the order in which they follow each
    other. Channels are in this order. Fractions are as accurate as those of `ElectrodeNetwork`, which has
    electrodes on one side each. Points off the pad or NaN give NaN.

    Raises ValueError for electrodes that touch, overlap or aren't in order, and for impossible resistances.
    """

    def __init__(
        self,
        a: float,
        b: float,
        spans: npt.ArrayLike,
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] | None = None,
    ) -> None:
        self._rectangle = Rectangle(a, b)
        self.spans = np.array(spans, np.float64)
        self.sheet_ohm_per_square = float(sheet_ohm_per_square)
        perimeter = 2 * (a + b)
        ring = np.append(self.spans.ravel(), self.spans[0, 0] + perimeter)
        if self.spans.ndim != 2 or len(self.spans) < 2 or not (np.diff(ring) > 0).all():
            raise ValueError("spans: electrodes must follow each other around the boundary without touching")
        # a power of two scales any unit to near 1, as in `ElectrodeNetwork`
        self._unit = math.ldexp(1.0, math.frexp(max(a, b))[1])
        self._disc = DiscMap(a / self._unit, b / self._unit)
        points = perimeter_point(a, b, np.column_stack([self.spans, self.spans.mean(axis=1)])) / self._unit
        starts = CirclePoints(self._disc, self._disc.defects(*np.roll(points[:, :, 0], -1, axis=1)))
        stops = CirclePoints(self._disc, self._disc.defects(*points[:, :, 1]))
        self._potentials = ElectrodePotentials(stops, starts, self._disc.defects(*points[:, 0, 2]))
        none = (0.0,) * len(self.spans)
        self._set_series_resistors(none if series_ohm is None else series_ohm, len(self.spans))

    @property
    def a(self) -> float:
        """Length along x."""
        return self._rectangle.a

    @property
    def b(self) -> float:
        """Length along y."""
        return self._rectangle.b

    @property
    def ends(self) -> tuple[ElectrodeEnd, ...]:
        """Begin and end of each electrode: (2 m,)."""
        positions = self.spans.ravel()
        x, y = perimeter_point(self.a, self.b, positions)
        within = np.mod(positions, self.a + self.b)
        axes = (within >= self.a).astype(int)
        return tuple(map(ElectrodeEnd, x.tolist(), y.tolist(), axes.tolist()))

    @property
    def centres(self) -> FloatArray:
        """Mean position of each electrode, (m, 2)."""
        along = (np.arange(_CENTRE_POINTS) + 0.5) / _CENTRE_POINTS
        positions = self.spans[:, :1] + np.diff(self.spans) * along
        return np.asarray(perimeter_point(self.a, self.b, positions).mean(axis=-1).T)

    def with_moved_end(self, end: int, step: float) -> PerimeterNetwork:
        """Return the pad with an end (index of `ends`) moved inward, which makes its electrode shorter."""
        spans = self.spans.copy()
        spans[divmod(end, 2)] += -step if end % 2 else step
        return PerimeterNetwork(self.a, self.b, spans, self.sheet_ohm_per_square, self.series_ohm)

    def stretched(self, factor: float) -> PerimeterNetwork:
        """Return the pad with a, and the electrodes along x, multiplied by a factor."""
        longer = factor * self.a
        rounds, within = np.divmod(self.spans, 2 * (self.a + self.b))
        knots = np.cumsum([0.0, self.a, self.b, self.a, self.b])
        moved = np.interp(within, knots, np.cumsum([0.0, longer, self.b, longer, self.b]))
        spans = moved + rounds * 2 * (longer + self.b)
        return PerimeterNetwork(longer, self.b, spans, self.sheet_ohm_per_square, self.series_ohm)

    @property
    def conductance(self) -> FloatArray:
        """Currents into the electrodes per unit of their voltages (m, m), for one ohm per square."""
        found = self._potentials.conductance
        assert found is not None  # no two touch
        return found

    def ideal_fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the fractions that directly grounded electrodes would collect, shape (m, ...)."""
        with np.errstate(all="ignore"):
            return np.asarray(self._potentials.potentials(self._to_disc(x, y)))

    @np.errstate(all="ignore")
    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` (m, ...) and derivatives by (x, y) (m, 2, ...)."""
        defects = self._to_disc(x, y)
        values, slope = self._potentials.potentials_and_slope(defects)
        slope = slope * self._disc.derivative(defects) / self._unit
        return self._mixed(values), self._mixed(np.stack([slope.imag, slope.real], axis=1))

    @np.errstate(all="ignore")
    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the radius of the contact without sheet resistance, as `ElectrodeNetwork` does, (...)."""
        defects = self._to_disc(x, y)
        radius = self._disc.radius(defects) * np.exp(self._potentials.log_spread(defects))
        return np.asarray(radius * self._unit)

    def _to_disc(self, x: npt.ArrayLike, y: npt.ArrayLike) -> ComplexArray:
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        on_pad = (x >= 0) & (x <= self.a) & (y >= 0) & (y <= self.b)
        return self._disc.defects(*(np.where(on_pad, at, np.nan) / self._unit for at in (x, y)))


def perimeter_point(a: float, b: float, position: npt.ArrayLike) -> FloatArray:
    """Return the points (2, ...) of a rectangle's boundary at lengths along it from corner (0, 0),
    counter-clockwise.
    """
    t = np.mod(np.asarray(position, np.float64), 2 * (a + b))
    knots = np.array([0.0, a, a + b, 2 * a + b, 2 * (a + b)])
    return np.stack([np.interp(t, knots, [0.0, a, a, 0.0, 0.0]), np.interp(t, knots, [0.0, 0.0, b, b, 0.0])])
