"""Measured sheet resistance of a film, place by place, and the pad that it makes.

Public names: `Film`, `UnevenNetwork`.

What the film changes, against an even sheet with the same electrodes, is solved by bilinear elements on a
rectangle graded towards the electrodes' ends, and added to the network of the even sheet, which is exact: the
singularities there have nearly the same strength on both.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import zipfile
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.network import ElectrodeEnd, ElectrodeNetwork
from handtouch.field.surface_base import Surface

MIN_SPOTS = 4
_END_CELLS, _CELLS = 8, 56  # least between two ends of electrodes, and of a whole side
_SMOOTHING = 1e-6  # of a thin plate, over the spots' own scatter: measured places that nearly coincide
_RADIUS_NODES = 9
_RADIUS_INSET = 0.06
_MAX_EXTRAPOLATION = 1.25  # of the spots' range of logarithms, beyond which a plate isn't followed


class Film:
    """Places where a film's sheet resistance was measured.

    Made from the content of a NumPy archive (.npz): `x_mm`, `y_mm` (n,), lengths along the film from
    electrodes x0 and y0, with `z_mm` coordinates of the frame of the surface's file; `ohm_per_square` (n,).
    Raises ValueError for what isn't.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                columns = {name: np.asarray(archive[name], np.float64).ravel() for name in archive.files}
        except (EOFError, OSError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError("no NumPy archive (.npz) of numbers") from error
        names = ["x_mm", "y_mm", *(["z_mm"] if "z_mm" in columns else []), "ohm_per_square"]
        if missing := [name for name in names if name not in columns]:
            raise ValueError(f"lacks {', '.join(missing)}; it has {', '.join(columns) or 'nothing'}")
        lengths = {len(columns[name]) for name in names}
        if len(lengths) > 1 or lengths.pop() < MIN_SPOTS:
            raise ValueError(f"{', '.join(names)} must have one value for each of {MIN_SPOTS} places or more")
        if not all(np.isfinite(columns[name]).all() for name in names):
            raise ValueError("has values that aren't finite")
        if not (columns["ohm_per_square"] > 0).all():
            raise ValueError("ohm_per_square must be positive")
        self.place_m = 1e-3 * np.stack([columns[name] for name in names[:-1]], axis=1)
        """(n, 2) along the film, or (n, 3) in the frame of the surface's file."""
        self.ohm_per_square = columns["ohm_per_square"]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Film) and self._data == other._data

    def __hash__(self) -> int:
        return hash(self._data)

    def fractions(self, surface: Surface) -> FloatArray:
        """Return the places as fractions (n, 2) of a surface's rectangle."""
        return surface.fractions_of_places(self.place_m)

    def log_ratio(self, surface: Surface, nominal_ohm: float) -> _Plate:
        """Return the logarithm of the sheet resistance over its nominal value, on the rectangle."""
        return _Plate(self.fractions(surface), np.log(self.ohm_per_square / nominal_ohm))


class _Plate:
    """Smooth function through values at fractions (n, 2) of a rectangle: a thin plate."""

    def __init__(self, place: FloatArray, values: FloatArray) -> None:
        from scipy.interpolate import RBFInterpolator  # not loaded with the package

        centre, half = (values.max() + values.min()) / 2, (values.max() - values.min()) / 2
        self._limits = centre - _MAX_EXTRAPOLATION * half, centre + _MAX_EXTRAPOLATION * half
        self._plate = RBFInterpolator(place, values, smoothing=_SMOOTHING, kernel="thin_plate_spline")

    def __call__(self, s: FloatArray, t: FloatArray) -> FloatArray:
        """Return the value at fractions of the sides, shape (...)."""
        found = self._plate(np.stack([s.ravel(), t.ravel()], axis=1)).reshape(s.shape)
        return np.asarray(np.clip(found, *self._limits))


class _Change(NamedTuple):
    """What an uneven film changes against an even one."""

    shares: tuple[Any, ...]
    """Splines by fractions of the sides, one for each electrode."""
    log_radius: Any
    """Of the spreading radius."""
    conductance: FloatArray
    digest: str
    """Names the film and all that the change depends on."""


class UnevenNetwork(ElectrodeNetwork):
    """A network on a film whose sheet resistance was measured.

    Shares and conductance are those of the film. The spreading radius is that of an even sheet which resists
    a contact of the radius `contact_radius`, in the unit of a and b, as the film does. Pads with other ends
    of electrodes, or of another length, differ from their even ones by as much.
    """

    _even: ElectrodeNetwork
    _change: _Change

    @classmethod
    def on_film(
        cls, even: ElectrodeNetwork, film: Film, surface: Surface, contact_radius: float
    ) -> UnevenNetwork:
        """Return a pad's network on a film that covers its surface."""
        return cls._changed(even, _film_change(even, film, surface, contact_radius))

    @classmethod
    def _changed(cls, even: ElectrodeNetwork, change: _Change) -> UnevenNetwork:
        network = cls.__new__(cls)
        network.__dict__.update(even.__dict__)
        network._even, network._change = even, change
        network._set_series_resistors(even.series_ohm)
        return network

    @property
    def digest(self) -> str:
        return self._change.digest

    @property
    def conductance(self) -> FloatArray:
        return super().conductance + self._change.conductance

    def _remade(self, a: float, ends: Sequence[ElectrodeEnd]) -> UnevenNetwork:
        return self._changed(self._even._remade(a, ends), self._change)

    def ideal_fractions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return super().ideal_fractions(x, y) + self._evaluate(x, y)

    @np.errstate(all="ignore")
    def fractions_with_jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        ideal, jacobian = self._ideal_with_jacobian(self._to_disc(x, y))
        more = np.stack([self._evaluate(x, y, 1, 0) / self.a, self._evaluate(x, y, 0, 1) / self.b], axis=1)
        return self._mixed(ideal + self._evaluate(x, y)), self._mixed(jacobian / self._unit + more)

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        s, t = np.broadcast_arrays(np.asarray(x) / self.a, np.asarray(y) / self.b)
        ratio = np.exp(self._change.log_radius(s, t, grid=False))
        return np.asarray(super().spreading_radius(x, y) * ratio)

    def _evaluate(self, x: npt.ArrayLike, y: npt.ArrayLike, by_x: int = 0, by_y: int = 0) -> FloatArray:
        """Return the changes of the shares (m, ...), or derivatives by the fractions of the sides."""
        s, t = np.broadcast_arrays(np.asarray(x) / self.a, np.asarray(y) / self.b)
        return np.stack([spline(s, t, dx=by_x, dy=by_y, grid=False) for spline in self._change.shares])


@lru_cache(maxsize=64)
def _film_change(even: ElectrodeNetwork, film: Film, surface: Surface, contact_radius: float) -> _Change:
    from scipy.interpolate import RectBivariateSpline  # not loaded with the package

    grid = _FilmGrid(even)
    log_ratio = film.log_ratio(surface, even.sheet_ohm_per_square)
    flat, uneven = grid.solve(np.ones(grid.cells)), grid.solve(np.exp(-log_ratio(*grid.middles)))
    shares = uneven.potentials - flat.potentials
    splines = tuple(RectBivariateSpline(grid.s, grid.t, share.reshape(grid.size)) for share in shares.T)
    nodes = np.polynomial.legendre.leggauss(_RADIUS_NODES)[0]
    nodes = 0.5 + nodes / nodes[-1] * (0.5 - _RADIUS_INSET)
    places = np.stack(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)
    sources = grid.smeared(places, contact_radius)
    more = 2 * np.pi * (uneven.own_resistance(sources) - flat.own_resistance(sources))
    radius = RectBivariateSpline(nodes, nodes, more.reshape(len(nodes), -1))
    known = repr((film.place_m.tolist(), film.ohm_per_square.tolist(), surface, contact_radius))
    digest = hashlib.sha256(known.encode()).hexdigest()
    return _Change(splines, radius, uneven.conductance - flat.conductance, digest)


class _FilmGrid:
    """Bilinear elements on a network's rectangle."""

    def __init__(self, network: ElectrodeNetwork) -> None:
        self._a, self._b = network.a, network.b
        ends: tuple[set[float], set[float]] = {0.0, 1.0}, {0.0, 1.0}
        for end in network.ends:
            ends[end.axis].add(round(end[end.axis] / (network.a, network.b)[end.axis], 9))
        self.s, self.t = (_graded(sorted(some)) for some in ends)
        self.size = len(self.s), len(self.t)
        self.cells = len(self.s) - 1, len(self.t) - 1
        self.middles = np.meshgrid(*((at[1:] + at[:-1]) / 2 for at in (self.s, self.t)), indexing="ij")
        self._s, self._t = (part.ravel() for part in np.meshgrid(self.s, self.t, indexing="ij"))
        a, b, x, y = network.a, network.b, network.a * self._s, network.b * self._t
        sides = [(self._t == 0, x), (self._s == 1, a + y), (self._t == 1, 2 * a + b - x)]
        self._electrode = np.full(len(x), -1)
        for is_on, along in [*sides, (self._s == 0, 2 * (a + b) - y)]:
            found = network.electrode_at(_snapped(network, along[is_on]))
            at = np.flatnonzero(is_on)
            self._electrode[at] = np.maximum(self._electrode[at], found)
        self._count = len(network.series_ohm)

    def solve(self, conductivity: FloatArray) -> _Solution:
        """Return the potentials of a sheet with this conductivity in each cell."""
        from scipy.sparse import coo_array

        wide, high = self._a * np.diff(self.s)[:, None], self._b * np.diff(self.t)[None]
        along, across = conductivity * high / wide, conductivity * wide / high
        number = np.arange(len(self._s)).reshape(self.size)
        corners = [number[i : i + n, j : j + m] for n, m in [self.cells] for i in (0, 1) for j in (0, 1)]
        line, mass = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([[2.0, 1.0], [1.0, 2.0]]) / 6
        parts = [(along, np.kron(line, mass)), (across, np.kron(mass, line))]
        values = [sum(k * weight[p, q] for k, weight in parts).ravel() for p in range(4) for q in range(4)]
        rows = [corners[p].ravel() for p in range(4) for _ in range(4)]
        columns = [corners[q].ravel() for _ in range(4) for q in range(4)]
        at = np.concatenate(rows), np.concatenate(columns)
        stiffness = coo_array((np.concatenate(values), at), shape=2 * (len(self._s),)).tocsr()
        return _Solution(stiffness, self._electrode, self._count)

    def smeared(self, places: FloatArray, radius: float) -> FloatArray:
        """Return unit currents (points, k), spread about places (2, k) by Gaussians of this radius."""
        areas = np.outer(*(np.gradient(at) for at in (self.s, self.t))).ravel()
        x = self._a * (self._s[:, None] - places[0])
        y = self._b * (self._t[:, None] - places[1])
        weight = areas[:, None] * np.exp(-(x * x + y * y) / radius**2)
        return np.asarray(weight / weight.sum(axis=0))


class _Solution:
    """Potentials of one sheet."""

    def __init__(self, stiffness: Any, electrode: npt.NDArray[np.intp], count: int) -> None:
        from scipy.sparse.linalg import splu

        self._free = np.flatnonzero(electrode < 0)
        self._factors = splu(stiffness[self._free][:, self._free].tocsc())
        self.potentials = (electrode[:, None] == np.arange(count)).astype(np.float64)
        """(points, m), with one electrode at 1."""
        right = -(stiffness @ self.potentials)[self._free]
        self.potentials[self._free] = self._factors.solve(right)
        self.conductance: FloatArray = self.potentials.T @ (stiffness @ self.potentials)

    def own_resistance(self, sources: FloatArray) -> FloatArray:
        """Return the mean potentials (k,) at sources (points, k) of unit currents, electrodes grounded."""
        free = sources[self._free]
        return np.asarray((free * self._factors.solve(free)).sum(axis=0))


def _graded(ends: Sequence[float]) -> FloatArray:
    """Return points from 0 to 1, closer towards each of the ends."""
    parts = []
    for low, high in itertools.pairwise(ends):
        count = max(_END_CELLS, round(_CELLS * (high - low)))
        way = (1 - np.cos(np.pi * np.arange(count) / count)) / 2
        parts.append(low + (high - low) * way)
    return np.append(np.concatenate(parts), 1.0)


def _snapped(network: ElectrodeNetwork, along: FloatArray) -> FloatArray:
    """Return lengths along the boundary, those that an end has but for rounding a hair inside."""
    found = along.copy()
    whole = 2 * (network.a + network.b)
    for begin, stop in network.arcs:
        for end, step in ((begin, 1e-6), (stop, -1e-6)):
            away = (along - end + whole / 2) % whole - whole / 2
            found[np.abs(away) < 1e-7 * whole] = end + step * whole
    return found
