"""Rectangular pads with electrodes on arcs of the boundary, resistors to ground and switches.

Public names: `ElectrodeNetwork`, `Electrode`, `ElectrodeEnd`, `perimeter_point`.

By reciprocity the current that a point contact sends to grounded electrode i is the potential phi_i there
when electrode i alone is at 1 and the bare boundary insulates; `_electrodes` computes those potentials to
rounding error, `_series_resistors` adds the resistors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field._disc import CirclePoints, DiscMap
from handtouch.field._electrodes import ElectrodePotentials
from handtouch.field._series_resistors import GroundedElectrodes
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.uneven_sheet import unevenness_slopes

ComplexArray = npt.NDArray[np.complex128]
Side = Literal["x0", "xa", "y0", "yb"]

SIDES: tuple[Side, ...] = ("x0", "xa", "y0", "yb")
MAX_ASPECT_RATIO = 50.0
_RING_OF_SIDES: tuple[Side, ...] = ("y0", "xa", "yb", "x0")  # counter-clockwise from corner (0, 0)
_CENTRE_POINTS = 64  # points of an electrode, whose mean is its centre
_MAX_STEPS = 45
_MAX_SETTLED_STEP = 1e-8  # step over a side; Newton's next step would be its square
_MIN_OBSERVABLE_FRACTION = 1e-12  # with both fractions smaller, a coordinate isn't observable
_MIN_USED_FRACTION = 1e-5  # smaller ones are excluded where the opposite side has ten times as much
_FRACTION_ROUNDING = 2e-15  # upper bound: smaller steps are rounding
_PATCH_STEP = 0.02  # step of second differences, in sides: currents of a patch vary no faster
_FRACTION_FLOOR = 1e-17  # start value where a fraction is rounding


@dataclass(frozen=True)
class Electrode:
    """A piece of a side: from `start` to `stop`, measured along y on x0 and xa, along x on y0 and yb."""

    side: Side
    start: float
    stop: float


class ElectrodeEnd(NamedTuple):
    """End of an electrode at (x, y); `axis`: 0 where its side is along x, 1 along y."""

    x: float
    y: float
    axis: int


class ElectrodeNetwork(GroundedElectrodes):
    """A resistive rectangle [0, a] x [0, b] with electrodes on arcs of its boundary; a `ForwardModel`.

    The usual case is four electrodes that leave `gap` bare from each corner along each side: one number, or
    one for each side in the order x0, xa, y0, yb; 0 <= gap < half a side, in the unit of a and b. Other
    arrangements are made by `from_sides` and, across corners too, by `from_arcs`; channels are in the order
    of the given electrodes. `series_ohm` are the resistors from the electrodes to ground; infinity leaves one
    floating. `switched` connects the electrodes in turn.

    Fractions are accurate to a few 1e-16 for sides within 50:1 of each other, which is the limit. Arguments
    broadcast; points off the pad or NaN give NaN.

    Raises ValueError naming impossible sides, gaps, resistances or arrangements.
    """

    is_potential = True
    states: tuple[tuple[int, ...], ...] = ()
    """Electrodes that are connected in each state of a schedule; empty: all of them, always."""

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
        ends, begins = _ends_on_sides(electrodes, a, b)
        self._build(a, b, ends, begins, sheet_ohm_per_square, series_ohm)

    @classmethod
    def from_sides(
        cls,
        a: float,
        b: float,
        electrodes: Sequence[Electrode],
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] | None = None,
    ) -> ElectrodeNetwork:
        """A pad with two or more electrodes anywhere on its sides; without resistors unless given."""
        network = cls.__new__(cls)
        ends, begins = _ends_on_sides(electrodes, a, b)
        network._build(a, b, ends, begins, sheet_ohm_per_square, series_ohm)
        return network

    @classmethod
    def from_arcs(
        cls,
        a: float,
        b: float,
        arcs: npt.ArrayLike,
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] | None = None,
    ) -> ElectrodeNetwork:
        """A pad with electrodes on any stretches of its boundary; without resistors unless given.

        arcs: begin and end of each electrode (m, 2), lengths along the boundary counter-clockwise from corner
        (0, 0), in the unit of a and b, modulo 2 (a + b); begin < end, in the order in which they follow each
        other, without touching.
        """
        network = cls.__new__(cls)
        spans = np.array(arcs, np.float64)
        if spans.ndim != 2 or spans.shape[1] != 2:
            raise ValueError(f"arcs must be begin and end of each electrode, got an array {spans.shape}")
        ring = np.append(spans.ravel(), spans[:1, 0] + 2 * (a + b))
        if not (np.diff(ring) > 0).all():
            raise ValueError("arcs: electrodes must follow each other around the boundary without touching")
        ends = _ends_at(a, b, spans.ravel())
        network._build(a, b, ends, [0] * len(spans), sheet_ohm_per_square, series_ohm)
        return network

    def switched(self, states: Sequence[Sequence[int]]) -> ElectrodeNetwork:
        """Return the pad whose electrodes are connected in turn, each with its own resistor.

        states: (states, k), the electrodes that are connected in each period, each of them in one; the others
        float meanwhile. Fractions are those of the whole schedule: of one state they sum to 1 / states, as if
        the same current entered in each; the true ones differ, since a contact sees other electrodes in each
        state, which is for the estimate to allow for. What floating electrodes and resistors add to the
        resistance between a contact and ground, in the mean of the states, is part of `spreading_radius`.

        Raises ValueError for fewer than two states, and unless each electrode is in exactly one.
        """
        network = self.__class__.__new__(self.__class__)
        network.__dict__.update(self.__dict__)
        network.states = tuple(tuple(int(number) for number in state) for state in states)
        count = len(self.series_ohm)
        if len(network.states) < 2 or sorted(sum(network.states, ())) != list(range(count)):
            raise ValueError(
                f"states: each of {count} electrodes must be in one of two states or more, got {states}"
            )
        network._set_series_resistors(self.series_ohm)
        return network

    @property
    def digest(self) -> str:
        """Name of a film of varying sheet resistance; empty for an even one."""
        return ""

    def variation_slopes(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return `unevenness_slopes`."""
        return unevenness_slopes(self, x, y)

    @property
    def a(self) -> float:
        """Length along x, from side x0 to xa."""
        return self._rectangle.a

    @property
    def b(self) -> float:
        """Length along y, from side y0 to yb."""
        return self._rectangle.b

    @property
    def arcs(self) -> FloatArray:
        """Begin and end of each electrode (m, 2), begin < end, lengths along the boundary counter-clockwise
        from corner (0, 0)."""
        at = np.array([_position_of(self.a, self.b, end) for end in self.ends]).reshape(-1, 2)
        begin, stop = at[np.arange(len(at)), self._begins], at[np.arange(len(at)), 1 - self._begins]
        return np.stack([begin, np.where(stop <= begin, stop + 2 * (self.a + self.b), stop)], axis=1)

    @property
    def centres(self) -> FloatArray:
        """Mean position of each electrode, (m, 2)."""
        along = (np.arange(_CENTRE_POINTS) + 0.5) / _CENTRE_POINTS
        arcs = self.arcs
        positions = arcs[:, :1] + np.diff(arcs) * along
        return np.asarray(perimeter_point(self.a, self.b, positions).mean(axis=-1).T)

    def electrode_at(self, position: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Return the electrode, -1 for none, at lengths (...) along the boundary as in `arcs`."""
        begins, stops = self.arcs.T
        beyond = np.mod(np.asarray(position, np.float64)[..., None] - begins, 2 * (self.a + self.b))
        covers = beyond <= stops - begins
        return np.where(covers.any(axis=-1), covers.argmax(axis=-1), -1)

    def with_moved_end(self, end: int, step: float) -> ElectrodeNetwork:
        """Return the pad with an end (index of `ends`) moved inward, which makes its electrode shorter."""
        ends = list(self.ends)
        ends[end] = _moved(self.a, self.b, ends[end], step if end % 2 == self._begins[end // 2] else -step)
        return self._remade(self.a, ends)

    def stretched(self, factor: float) -> ElectrodeNetwork:
        """Return the pad with a, and the electrodes along x, multiplied by a factor."""
        return self._remade(factor * self.a, [end._replace(x=factor * end.x) for end in self.ends])

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
        return self._mixed(ideal), self._mixed(jacobian / self._unit)

    def patch_slopes(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return derivatives (m, ...) of the fractions by x x and by x y."""
        half = _PATCH_STEP * self.a
        x = np.clip(x, 1.01 * half, self.a - 1.01 * half)
        y = np.clip(y, _PATCH_STEP * self.b, (1 - _PATCH_STEP) * self.b)
        more, less = (self.fractions_with_jacobian(x + step, y)[1] for step in (half, -half))
        by_x, by_y = np.moveaxis((more - less) / (2 * half), 1, 0)
        return by_x, by_y

    def estimate(
        self, currents: npt.ArrayLike, noise: npt.ArrayLike, start: npt.ArrayLike | None = None
    ) -> PointEstimate:
        """Return the maximum-likelihood contact from all noisy currents (m, ...); see
        `handtouch.field.estimate`.
        """
        return estimate(self, currents, noise, start)

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return R: the sheet's resistance to a contact of radius A at (x, y) is sheet / (2 pi) ln(R / A).

        Electrodes at ground, in the unit of a and b, shape (...). It is the conformal radius, enlarged by the
        gaps: ln R is 2 pi times the regular part of Green's function, so it is exact for small contacts. Zero
        at an electrode. For resistors see `series_resistance`; those of a schedule are included, in the mean
        of its states.
        """
        defects = self._to_disc(x, y)
        with np.errstate(all="ignore"):
            radius = self._disc.radius(defects) * np.exp(self._potentials.log_spread(defects)) * self._unit
            if self.states:
                added = self.state_resistance(x, y).mean(axis=0)
                radius = radius * np.exp(2 * math.pi * added / self.sheet_ohm_per_square)
            return np.asarray(radius)

    def state_resistance(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the resistance [ohm] from a contact to ground that each state of the schedule adds to that
        of the electrodes all connected directly, (states, ...)."""
        return np.array([one.series_resistance(x, y) for one in self._networks_of_states])

    def series_resistance(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the resistance [ohm] that resistors add between a contact and ground; 0 with a schedule,
        where it is part of `spreading_radius`."""
        if self.states:
            return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
        return super().series_resistance(x, y)

    @property
    def series_quadratic_form(self) -> FloatArray:
        """Matrix Q (m, m) of the form f @ Q @ f [ohm] that gives `series_resistance` from measured fractions
        f.

        Raises ValueError where an electrode floats: its voltage doesn't follow from the currents.
        """
        return np.zeros_like(self._mix) if self.states else super().series_quadratic_form

    @property
    def series_sensitivity(self) -> FloatArray:
        """Matrix S (m, m) [1/ohm]: more of resistor j changes the measured fractions f of its state by
        S[:, j] f[j]."""
        if not self.states:
            return super().series_sensitivity
        found = np.zeros_like(self._mix)
        for state, one in zip(self.states, self._networks_of_states, strict=True):
            found[:, state] = one.series_sensitivity[:, state]
        return found

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
        if currents.shape[:1] != (count := len(self.series_ohm),):
            raise ValueError(f"currents have shape {currents.shape}: the first axis is the {count} channels")
        if self._side_sums is None or self._unmix is None:
            raise ValueError(
                "locate needs a connected electrode on every side, none across a corner; estimate does not"
            )
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
        ends: Sequence[ElectrodeEnd],
        begins: Sequence[int],
        sheet_ohm_per_square: float,
        series_ohm: Sequence[float] | None,
    ) -> None:
        """Set the pad up; `begins`: of each electrode the end, 0 or 1, where it begins counter-clockwise."""
        self._rectangle = Rectangle(a, b)
        if max(a / b, b / a) > MAX_ASPECT_RATIO:
            raise ValueError(f"a and b must be within {MAX_ASPECT_RATIO:g}:1 of each other, got {a} and {b}")
        if not (sheet_ohm_per_square > 0 and math.isfinite(sheet_ohm_per_square)):
            raise ValueError(f"sheet_ohm_per_square must be positive and finite, got {sheet_ohm_per_square}")
        self.sheet_ohm_per_square = float(sheet_ohm_per_square)
        self.ends: tuple[ElectrodeEnd, ...] = tuple(ends)
        """Both ends of each electrode (2 m,): low and high one on a side, begin and end of an arc."""
        self._begins = np.array(begins, np.intp)
        arcs = self.arcs
        if len(arcs) < 2:
            raise ValueError(f"electrodes: at least two are needed, got {len(arcs)}")
        begin = [_place_on_ring(self.a, self.b, self.ends[2 * i + k]) for i, k in enumerate(self._begins)]
        order = np.array(sorted(range(len(arcs)), key=begin.__getitem__))
        self._ring_position = np.argsort(order)
        # a power of two scales any unit to near 1, so that no product leaves the range of doubles
        self._unit = math.ldexp(1.0, math.frexp(max(self.a, self.b))[1])
        self._disc = DiscMap(self.a / self._unit, self.b / self._unit)
        corners = np.array([end[:2] for end in self.ends]).reshape(-1, 2, 2)[order] / self._unit
        number = np.arange(len(order))
        first, last = (corners[number, end] for end in (self._begins[order], 1 - self._begins[order]))
        starts = CirclePoints(self._disc, self._disc.defects(*np.roll(first, -1, axis=0).T))
        stops = CirclePoints(self._disc, self._disc.defects(*last.T))
        middle = perimeter_point(self.a, self.b, arcs[order[0]].mean()) / self._unit
        self._potentials = ElectrodePotentials(stops, starts, self._disc.defects(*middle))
        self._set_series_resistors((0.0,) * len(arcs) if series_ohm is None else series_ohm, len(arcs))

    def _remade(self, a: float, ends: Sequence[ElectrodeEnd]) -> ElectrodeNetwork:
        """Return a pad of another length, or with other ends of the same electrodes."""
        network = self.__class__.__new__(self.__class__)
        network.states = self.states
        network._build(a, self.b, ends, self._begins.tolist(), self.sheet_ohm_per_square, self.series_ohm)
        return network

    def _set_series_resistors(self, series_ohm: Sequence[float], count: int | None = None) -> None:
        """Compute the resistors' matrices; of a schedule the sum of its states'."""
        self.__dict__.pop("_networks_of_states", None)
        super()._set_series_resistors(series_ohm, count)
        if self.states:
            # a floating electrode has no current, so that each row of the sum is of one state
            mixes = [one.currents_per_ideal for one in self._networks_of_states]
            self._mix = np.sum(mixes, axis=0) / len(self.states)
            self._unmix = None

    @cached_property
    def _networks_of_states(self) -> list[Self]:
        """The same pad, always in one state, for each."""
        found = []
        for state in self.states:
            one = self.__class__.__new__(self.__class__)
            one.__dict__.update(self.__dict__)
            one.states = ()
            one._set_series_resistors(
                [ohm if number in state else math.inf for number, ohm in enumerate(self.series_ohm)]
            )
            found.append(one)
        return found

    @cached_property
    def _side_sums(self) -> FloatArray | None:
        """Matrix (4, m) from the electrodes to the sides they are on; None where one is across a corner, or a
        side without any."""
        knots = np.cumsum([0.0, self.a, self.b, self.a, self.b])
        begins, stops = self.arcs.T
        low, high = knots[:-1, None], knots[1:, None]
        on_side = ((begins >= low) & (stops <= high))[[_RING_OF_SIDES.index(side) for side in SIDES]]
        whole = on_side.any(axis=0).all() and on_side.any(axis=1).all()
        return on_side.astype(np.float64) if whole else None

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

    def _mixed(self, ideal: FloatArray) -> FloatArray:
        return np.asarray(np.tensordot(self._mix, ideal, axes=1)) if self.states else super()._mixed(ideal)

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


def perimeter_point(a: float, b: float, position: npt.ArrayLike) -> FloatArray:
    """Return the points (2, ...) of a rectangle's boundary at lengths along it from corner (0, 0),
    counter-clockwise.
    """
    t = np.mod(np.asarray(position, np.float64), 2 * (a + b))
    knots = np.array([0.0, a, a + b, 2 * a + b, 2 * (a + b)])
    return np.stack([np.interp(t, knots, [0.0, a, a, 0.0, 0.0]), np.interp(t, knots, [0.0, 0.0, b, b, 0.0])])


def _ends_at(a: float, b: float, positions: FloatArray) -> list[ElectrodeEnd]:
    """Return the ends of electrodes at lengths (n,) along the boundary."""
    x, y = perimeter_point(a, b, positions)
    axes = (np.mod(positions, a + b) >= a).astype(int)
    return list(map(ElectrodeEnd, x.tolist(), y.tolist(), axes.tolist()))


def _place_on_ring(a: float, b: float, end: ElectrodeEnd) -> tuple[int, float]:
    """Return the side of an end, by number counter-clockwise from corner (0, 0), and its coordinate along it,
    negative where the boundary runs against the axis."""
    if end.axis == 0:
        return (0, end.x) if end.y < b / 2 else (2, -end.x)
    return (1, end.y) if end.x > a / 2 else (3, -end.y)


def _position_of(a: float, b: float, end: ElectrodeEnd) -> float:
    """Return the length along the boundary of an end."""
    side, along = _place_on_ring(a, b, end)
    return (along, a + along, a + b + (a + along), a + b + a + (b + along))[side]


def _moved(a: float, b: float, end: ElectrodeEnd, step: float) -> ElectrodeEnd:
    """Return an end moved counter-clockwise along the boundary."""
    at, side = end[end.axis], (a, b)[end.axis]
    at += step if _place_on_ring(a, b, end)[0] < 2 else -step
    if not 0 <= at <= side:
        return _ends_at(a, b, np.array([_position_of(a, b, end) + step]))[0]
    return end._replace(y=at) if end.axis else end._replace(x=at)


def _ends_on_sides(
    electrodes: Sequence[Electrode], a: float, b: float
) -> tuple[list[ElectrodeEnd], list[int]]:
    """Return both ends of each electrode, and which one comes first counter-clockwise; raise ValueError where
    they overlap."""
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
    fixed = {"x0": 0.0, "xa": float(a), "y0": 0.0, "yb": float(b)}
    ends = [
        ElectrodeEnd(at, fixed[side], 0) if side in ("y0", "yb") else ElectrodeEnd(fixed[side], at, 1)
        for side, start, stop in ((one.side, one.start, one.stop) for one in electrodes)
        for at in (start, stop)
    ]
    return ends, [int(one.side in ("x0", "yb")) for one in electrodes]
