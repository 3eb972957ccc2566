"""Pads with real electrodes: bare corners, divided sides, series resistors to ground.

Public names: `ElectrodeNetwork`, `Electrode`.

By reciprocity the current that a point contact sends to grounded electrode i is the potential phi_i there
when electrode i alone is at 1 and the bare boundary insulates; `_electrodes` computes those potentials to
rounding error, `_series_resistors` adds the resistors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from handtouch.field._disc import CirclePoints, DiscMap
from handtouch.field._electrodes import ElectrodePotentials
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.rectangle_network import ElectrodeEnd, RectangleNetwork

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
Side = Literal["x0", "xa", "y0", "yb"]

SIDES: tuple[Side, ...] = ("x0", "xa", "y0", "yb")
MAX_ASPECT_RATIO = 50.0
_MAX_STEPS = 45
_MAX_SETTLED_STEP = 1e-8  # step over a side; Newton's next step would be its square
_MIN_OBSERVABLE_FRACTION = 1e-12  # with both fractions smaller, a coordinate isn't observable
_MIN_USED_FRACTION = 1e-5  # smaller ones are excluded where the opposite side has ten times as much
_FRACTION_ROUNDING = 2e-15  # upper bound: smaller steps are rounding
_FRACTION_FLOOR = 1e-17  # start value where a fraction is rounding


@dataclass(frozen=True)
class Electrode:
    """A piece of a side: from `start` to `stop`, measured along y on x0 and xa, along x on y0 and yb."""

    side: Side
    start: float
    stop: float


class ElectrodeNetwork(RectangleNetwork):
    """A resistive rectangle [0, a] x [0, b] with any electrodes on its boundary; a `ForwardModel`.

    The usual case is four electrodes that leave `gap` bare from each corner along each side: one number, or
    one for each side in the order x0, xa, y0, yb; 0 <= gap < half a side, in the unit of a and b.
    `series_ohm` are the resistors from the electrodes to ground; infinity leaves one floating. Any other
    arrangement is made by `from_electrodes`; channels are in the order of the given electrodes.

    Fractions are accurate to a few 1e-16 for sides within 50:1 of each other, which is the limit. Arguments
    broadcast; points off the pad or NaN give NaN.

    Raises ValueError naming impossible sides, gaps, resistances or arrangements.
    """

    def __init__(
        self,
        a: float,
        b: float,
        gap: float | Sequence[float],
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        gaps = [float(g) for g in np.broadcast_to(np.asarray(gap, np.float64), (4,))]
        lengths = {"x0": b, "xa": b, "y0": a, "yb": a}
        for side, bare in zip(SIDES, gaps, strict=True):
            if not 0 <= bare < lengths[side] / 2:
                raise ValueError(f"gap must be at least 0 and less than half of side {side}, got {bare}")
        electrodes = [Electrode(s, g, lengths[s] - g) for s, g in zip(SIDES, gaps, strict=True)]
        self._build(a, b, electrodes, sheet_ohm_per_square, series_ohm)

    @classmethod
    def from_electrodes(
        cls,
        a: float,
        b: float,
        electrodes: Sequence[Electrode],
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] | None = None,
    ) -> ElectrodeNetwork:
        """A pad with two or more electrodes anywhere on its boundary; without resistors unless given."""
        network = cls.__new__(cls)
        series = (0.0,) * len(electrodes) if series_ohm is None else series_ohm
        network._build(a, b, list(electrodes), sheet_ohm_per_square, series)
        return network

    @property
    def a(self) -> float:
        """Length along x, from side x0 to xa."""
        return self._rectangle.a

    @property
    def b(self) -> float:
        """Length along y, from side y0 to yb."""
        return self._rectangle.b

    @property
    def ends(self) -> tuple[ElectrodeEnd, ...]:
        """Low and high end of each electrode: (2 m,)."""
        fixed = {"x0": 0.0, "xa": self.a, "y0": 0.0, "yb": self.b}
        return tuple(
            ElectrodeEnd(at, fixed[side], 0) if side in ("y0", "yb") else ElectrodeEnd(fixed[side], at, 1)
            for side, start, stop in ((one.side, one.start, one.stop) for one in self.electrodes)
            for at in (start, stop)
        )

    @property
    def centres(self) -> FloatArray:
        """Middle of each electrode, (m, 2)."""
        return np.asarray(np.array([end[:2] for end in self.ends]).reshape(-1, 2, 2).mean(axis=1))

    def with_moved_end(self, end: int, step: float) -> ElectrodeNetwork:
        """Return the pad with an end (index of `ends`) moved inward, which makes its electrode shorter."""
        number, is_stop = divmod(end, 2)
        old = self.electrodes[number]
        new = replace(old, stop=old.stop - step) if is_stop else replace(old, start=old.start + step)
        electrodes = (*self.electrodes[:number], new, *self.electrodes[number + 1 :])
        return self.from_electrodes(self.a, self.b, electrodes, self.sheet_ohm_per_square, self.series_ohm)

    def stretched(self, factor: float) -> ElectrodeNetwork:
        """Return the pad with a, and the electrodes along x, multiplied by a factor."""
        longer = [
            replace(electrode, start=factor * electrode.start, stop=factor * electrode.stop)
            if electrode.side in ("y0", "yb")
            else electrode
            for electrode in self.electrodes
        ]
        return self.from_electrodes(
            factor * self.a, self.b, longer, self.sheet_ohm_per_square, self.series_ohm
        )

    @property
    def conductance(self) -> FloatArray:
        """Currents into the electrodes per unit of their voltages (m, m), for one ohm per square.

        Symmetric; rows sum to zero. Raises ValueError if electrodes touch: their conductance is infinite.
        """
        if self._potentials.conductance is None:
            raise ValueError("gap: electrodes that touch (gap 0) have infinite conductance")
        return self._potentials.conductance[np.ix_(self._ring_position, self._ring_position)]

    def ideal_fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the fractions that directly grounded electrodes would collect, shape (m, ...), summing to
        1.
        """
        with np.errstate(all="ignore"):  # NaN in gives NaN out
            return np.asarray(self._potentials.potentials(self._to_disc(x, y))[self._ring_position])

    @np.errstate(all="ignore")
    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `fractions` (m, ...) and derivatives by (x, y) (m, 2, ...), unbounded at electrodes'
        ends.
        """
        ideal, jacobian = self._ideal_with_jacobian(self._to_disc(x, y))
        return self._mixed(ideal), self._mixed(jacobian) / self._unit

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return R: the sheet's resistance to a contact of radius A at (x, y) is sheet / (2 pi) ln(R / A).

        Electrodes at ground, in the unit of a and b, shape (...). It is the conformal radius, enlarged by the
        gaps: ln R is 2 pi times the regular part of Green's function, so it is exact for small contacts. Zero
        at an electrode. For resistors see `series_resistance`.
        """
        defects = self._to_disc(x, y)
        with np.errstate(all="ignore"):
            radius = self._disc.radius(defects) * np.exp(self._potentials.log_spread(defects))
            return np.asarray(radius * self._unit)

    @np.errstate(all="ignore")
    def locate(self, currents: npt.ArrayLike) -> Location:
        """Return the point contact that sends `currents` (m, ...), the exact inverse of `currents`.

        x follows from the currents of sides x0 and xa, y from those of y0 and yb, resistors undone, as in
        `Rectangle.locate`, to which this tends for small gaps; the residual is the remainder. Where the far
        side's fraction is below 1e-5 and a tenth of the near one's, the near side decides alone, so the error
        is rounding over the near fraction: for gaps of 10 %, 3 % or farther from the edges, 1e-12 of the
        short side up to 3:1, 1e-10 at 5:1, 1e-8 at 10:1. NaN for a coordinate whose sides both have less than
        1e-12 (mid-length of a pad of 20:1), for both where no point of the pad fits or the iteration doesn't
        converge. Raises ValueError if a side has no electrode, or an electrode floats: see `estimate`.
        """
        currents = np.asarray(currents, np.float64)
        self._check_channels(currents)
        if self._side_sums is None or self._unmix is None:
            raise ValueError("locate needs a connected electrode on every side; estimate does not")
        shape = currents.shape[1:]
        flat = currents.reshape(currents.shape[0], -1)
        total = flat.sum(axis=0)
        measured = self._side_sums @ (self._unmix @ (flat / total))
        x, y = self._newton(self._side_sums, measured)
        expected = self.ideal_fractions(x, y)
        residual = measured[:2].sum(axis=0) - (self._side_sums[:2] @ expected).sum(axis=0)
        return Location(*(v.reshape(shape)[()] for v in (x, y, total, residual)))

    @np.errstate(all="ignore")
    def _build(
        self,
        a: float,
        b: float,
        electrodes: Sequence[Electrode],
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float],
    ) -> None:
        self._rectangle = Rectangle(a, b)
        if max(a / b, b / a) > MAX_ASPECT_RATIO:
            raise ValueError(f"a and b must be within {MAX_ASPECT_RATIO:g}:1 of each other, got {a} and {b}")
        if not (sheet_ohm_per_square > 0 and math.isfinite(sheet_ohm_per_square)):
            raise ValueError(f"sheet_ohm_per_square must be positive and finite, got {sheet_ohm_per_square}")
        self.electrodes = tuple(electrodes)
        self.sheet_ohm_per_square = float(sheet_ohm_per_square)
        order = _counter_clockwise(self.electrodes, a, b)
        self._ring_position = np.argsort(order)
        # a power of two scales any unit to near 1, so that no product leaves the range of doubles
        self._unit = math.ldexp(1.0, math.frexp(max(self.a, self.b))[1])
        self._disc = DiscMap(self.a / self._unit, self.b / self._unit)
        ends = (
            np.array([_electrode_ends(self.electrodes[i], a, b) for i in order]) / self._unit
        )  # (m, 2 ends, x and y)
        starts = CirclePoints(self._disc, self._disc.defects(*np.roll(ends[:, 0], -1, axis=0).T))
        stops = CirclePoints(self._disc, self._disc.defects(*ends[:, 1].T))
        self._potentials = ElectrodePotentials(stops, starts, self._disc.defects(*ends[0].mean(axis=0)))
        sums = np.array([[float(e.side == side) for e in self.electrodes] for side in SIDES])
        self._side_sums = sums if sums.any(axis=1).all() else None
        self._set_series_resistors(series_ohm, len(self.electrodes))

    def _to_disc(self, x: npt.ArrayLike, y: npt.ArrayLike) -> ComplexArray:
        """Return defects (4, ...), NaN off the pad."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        on_pad = (x >= 0) & (x <= self.a) & (y >= 0) & (y <= self.b)
        with np.errstate(all="ignore"):
            x, y = (np.where(on_pad, coordinate, np.nan) / self._unit for coordinate in (x, y))
            return self._disc.defects(x, y)

    def _ideal_with_jacobian(self, defects: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return potentials (m, ...) and their derivatives (m, 2, ...) by coordinates in `_unit`."""
        with np.errstate(all="ignore"):
            values, slope = self._potentials.potentials_and_slope(defects)
            slope = slope * self._disc.derivative(defects)
        # phi = Im Phi: d/dx = Im Phi', d/dy = Im(i Phi') = Re Phi'
        return values[self._ring_position], np.stack([slope.imag, slope.real], axis=1)[self._ring_position]

    def _check_channels(self, currents: FloatArray) -> None:
        if currents.shape[:1] != (len(self.electrodes),):
            raise ValueError(
                f"currents have shape {currents.shape}: the first axis is the {len(self.electrodes)} channels"
            )

    def _newton(self, sums: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y (n,) where the side sums (4, n) are as measured, starting at the pad without
        gaps.

        A coordinate whose two sums are below rounding is NaN; one where only the far sum is, or nearly,
        follows from the near sum alone.
        """
        held, weights = _side_weights(measured)
        start = self._rectangle.locate(
            np.where(np.abs(measured) < _MIN_OBSERVABLE_FRACTION, _FRACTION_FLOOR, measured)
        )
        sides = np.array([[self.a], [self.b]]) / self._unit
        inset = 1e-9 * sides
        far = sides - inset
        at = np.where(held, np.stack([start.x, start.y]) / self._unit, sides / 2)
        at = np.clip(at, inset, far)
        target = _weighted_difference(weights, _log_tangents(measured)[0])
        settled = np.zeros(at.shape[1], bool)
        rounding = _FRACTION_ROUNDING / np.maximum(measured[::2], measured[1::2]) * sides.min()
        enough = _MAX_SETTLED_STEP * sides + np.where(held, rounding, 0.0)
        for step_number in range(_MAX_STEPS):
            moving = np.flatnonzero(~settled & np.isfinite(at).all(axis=0))
            if moving.size == 0:
                break
            values, jacobian = self._ideal_with_jacobian(self._disc.defects(*at[:, moving]))
            logs, slopes = _log_tangents(sums @ values)
            rates = slopes[:, None] * np.tensordot(sums, jacobian, axes=1)
            active, known = weights[:, moving], held[:, moving]
            rates_of = [_weighted_difference(active, rates[:, axis]) for axis in range(2)]
            xx, yx = (np.where(known[i], rates_of[0][i], 1.0 - i) for i in range(2))
            xy, yy = (np.where(known[i], rates_of[1][i], float(i)) for i in range(2))
            miss_x, miss_y = np.where(known, target[:, moving] - _weighted_difference(active, logs), 0.0)
            step = np.stack([yy * miss_x - xy * miss_y, xx * miss_y - yx * miss_x]) / (xx * yy - xy * yx)
            if step_number > _MAX_STEPS / 3:  # the iteration may oscillate
                step *= np.where((np.abs(step) > sides / 100).any(axis=0), 0.5, 1.0)
            new = np.clip(at[:, moving] + np.clip(step, -far / 4, far / 4), inset, far)
            settled[moving] = (np.abs(new - at[:, moving]) < enough[:, moving]).all(axis=0)
            at[:, moving] = new
        on_edge = (held & ((at == inset) | (at == far))).any(axis=0)
        at[:, on_edge | ~settled] = np.nan
        # an excluded sum must be as small there as measured
        left_out = (weights == 0) & (
            sums @ self._ideal_with_jacobian(self._disc.defects(*at))[0] > 10 * _MIN_USED_FRACTION
        )
        at = np.where(held & ~left_out.any(axis=0), at, np.nan) * self._unit
        return at[0], at[1]


def _side_weights(sides: FloatArray) -> tuple[npt.NDArray[np.bool_], FloatArray]:
    """Return which coordinates the side sums determine (2, n), and the weight, 0 or 1, of each sum (4, n)."""
    weights = []
    for near, far in ((0, 1), (1, 0), (2, 3), (3, 2)):
        unused = (sides[near] < _MIN_USED_FRACTION) & (sides[near] < sides[far] / 10)
        weights.append(np.where(unused & (sides[near] > -_MIN_OBSERVABLE_FRACTION), 0.0, 1.0))
    least = np.maximum(np.abs(sides[::2]), np.abs(sides[1::2]))
    return ~(least < _MIN_OBSERVABLE_FRACTION), np.stack(weights)


def _weighted_difference(weights: FloatArray, sides: FloatArray) -> FloatArray:
    """Return far side less near side of either pair, (2, n), without those of weight 0."""
    counted = np.where(weights > 0, sides, 0.0)
    return np.asarray(counted[1::2] - counted[::2])


def _log_tangents(sides: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ln tan(pi f / 2) of every side (4, n), NaN where f has no digits left, and its derivative by
    f.
    """
    sides = np.where(sides > _MIN_OBSERVABLE_FRACTION / 100, sides, np.nan)
    return np.log(np.tan(np.pi / 2 * sides)), np.pi / np.sin(np.pi * sides)


def _counter_clockwise(electrodes: Sequence[Electrode], a: float, b: float) -> list[int]:
    """Return the order of the electrodes counter-clockwise from corner (0, 0); check that they don't
    overlap.
    """
    if len(electrodes) < 2:
        raise ValueError(f"electrodes: at least two are needed, got {len(electrodes)}")
    for electrode in electrodes:
        if electrode.side not in SIDES:
            raise ValueError(f"side must be one of {', '.join(SIDES)}, got {electrode.side!r}")
        length = a if electrode.side in ("y0", "yb") else b
        if not 0 <= electrode.start < electrode.stop <= length:
            raise ValueError(f"start and stop must be 0 <= start < stop <= {length}, got {electrode}")
    for side in SIDES:
        pieces = sorted((e for e in electrodes if e.side == side), key=lambda e: e.start)
        for one, other in itertools.pairwise(pieces):
            if other.start < one.stop:
                raise ValueError(f"electrodes overlap: {one} and {other}")
    side_order: tuple[Side, ...] = ("y0", "xa", "yb", "x0")

    def place(i: int) -> tuple[int, float]:
        side = electrodes[i].side
        return side_order.index(side), electrodes[i].start if side in ("y0", "xa") else -electrodes[i].start

    return sorted(range(len(electrodes)), key=place)


def _electrode_ends(electrode: Electrode, a: float, b: float) -> list[tuple[float, float]]:
    """Return the two ends of an electrode, counter-clockwise."""
    start, stop = electrode.start, electrode.stop
    return {
        "y0": [(start, 0.0), (stop, 0.0)],
        "xa": [(a, start), (a, stop)],
        "yb": [(stop, b), (start, b)],
        "x0": [(0.0, stop), (0.0, start)],
    }[electrode.side]
