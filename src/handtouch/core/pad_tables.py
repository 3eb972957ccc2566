"""Tables of forward models that the stages read, built once for each distinct pad.

Public names: `ForwardTable`, `hermite_table`, `pair_limit`, `MAX_SQUARED_MISFIT`.

A forward model is tabulated over cells that shrink towards the edges and the ends of the electrodes, as the
distances do over which its fractions vary.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.field.channel_map import ChannelMap
from handtouch.field.model import ChannelModel
from handtouch.field.network import ElectrodeNetwork

_STENCIL = 7  # nodes that a slope is computed from
_FORWARD_CELLS = 108  # a table of four electrodes has 1.9 MB
CELLS_PER_TOLERANCE_CELL = 3  # tables of tolerances have 0.9 MB
_TOLERANCE_STEP = 3e-5  # step of differences, in sides
_EDGE_CELL, _ELECTRODE_END_CELL = 0.003, 0.008
"""Distances from an edge and from an electrode's end below which cells shrink no further, in sides."""
SEARCH_POINTS = 9
MIN_PAIR_ELECTRODES = 6
_BISECTIONS = 60
_MIN_EDGE_DISTANCE = 1e-6  # distance over a side
_MIN_RADIUS_DISTANCE = 1e-3  # distance over a side: the spreading radius vanishes at an edge
MAX_SQUARED_MISFIT = 9.0
"""Squared misfit of a point contact, in variances of noise and tolerances, that these explain; of n currents,
n - 3 degrees of freedom, scaled so that this is as likely as of one. Beyond it the contact is no point: the
covariance is inflated by the excess (Birge, Phys. Rev. 40, 1932), as the errors of currents along the
directions that move the position are as large as along the observable one, and of four currents by the extent
that explains the residual."""


def hermite_table(values: FloatArray) -> FloatArray:
    """Return nodes for `read_table`, (y, x, 4, columns), of the values (y, x, columns) on a square grid."""
    slope = _slope_operator(len(values) - 1)
    by_x = np.einsum("ij,kjc->kic", slope, values)
    by_y, by_both = np.einsum("ij,jkc->ikc", slope, values), np.einsum("ij,jkc->ikc", slope, by_x)
    return np.ascontiguousarray(np.stack([values, by_x, by_y, by_both], axis=2))


@cache
def _slope_operator(cells: int) -> FloatArray:
    """Return the matrix (nodes, nodes) from values at the nodes to slopes there, per cell.

    Each from the seven nearest nodes only: a singular edge spoils no slope farther inside.
    """
    slopes = np.zeros((cells + 1, cells + 1))
    for node in range(cells + 1):
        first = min(max(node - _STENCIL // 2, 0), cells + 1 - _STENCIL)
        powers = np.vander(np.arange(first, first + _STENCIL) - float(node), increasing=True).T
        slopes[node, first : first + _STENCIL] = np.linalg.solve(powers, np.eye(_STENCIL)[1])
    return slopes


@dataclass(frozen=True)
class ForwardTable:
    """Forward model of a pad: fractions of its n electrodes and ln of its spreading radius.

    Of a `ChannelMap` the fractions are signals, and its tolerances take the places of those of electrodes: in
    that of its two ends each channel's own, in those of the waves what all have in common, in those of the
    second derivatives `patch_slopes`.

    nodes: (cells + 1, cells + 1, 4, n + 1), see `hermite_table`. nodes_x, nodes_y: (cells + 1, 2) coordinates
    of the nodes and their derivatives by cell. search_fractions: (81, n), search_cells: (2, 9), see
    `ModelTable`.

    tolerance_nodes: (37, 37, 4, (8 + 2 s) n), on every third node, in single precision: fields of the 2 n
    ends of electrodes in each of s states of a schedule, 1 without, and derivatives of the fractions by the
    logarithm of a / b, by waves of the sheet resistance, and second ones by x x and x y, see
    `PadTolerances`. end_vectors: (2 n, n), derivatives of the fractions by the bare length at each end, two
    of each electrode, per its field.
    series_vectors: (n, n), by each resistor [1/ohm], per its electrode's fraction.
    """

    nodes: FloatArray
    nodes_x: FloatArray
    nodes_y: FloatArray
    search_fractions: FloatArray
    search_cells: FloatArray
    tolerance_nodes: NDArray[np.float32]
    end_vectors: FloatArray
    series_vectors: FloatArray

    @classmethod
    def from_network(cls, model: ChannelModel) -> ForwardTable:
        """Tabulate a pad's electrode network, or channel map."""
        ends: tuple[set[float], set[float]] = {0.0, model.a}, {0.0, model.b}
        for end in model.ends:
            ends[end.axis].add(end[end.axis])
        axes = (
            _Axis(model.a, sorted(ends[0] - {0.0, model.a})),
            _Axis(model.b, sorted(ends[1] - {0.0, model.b})),
        )
        nodes_x, nodes_y = (axis.nodes() for axis in axes)
        x, y = np.meshgrid(*(_inside(at[:, 0]) for at in (nodes_x, nodes_y)))
        fractions = model.fractions(x, y)
        log_spreading = _log_spreading(model, *_spreading_nodes(model, nodes_x, nodes_y))
        values = np.stack([*fractions, log_spreading], axis=-1)
        search = (np.arange(SEARCH_POINTS) + 0.5) / SEARCH_POINTS
        x, y = (at.ravel() for at in np.meshgrid(model.a * search, model.b * search))
        return cls(
            hermite_table(values),
            nodes_x,
            nodes_y,
            np.ascontiguousarray(model.fractions(x, y).T),
            np.stack([axis.cells(search * axis.side) for axis in axes]),
            *_tabulate_tolerances(
                model, nodes_x[::CELLS_PER_TOLERANCE_CELL], nodes_y[::CELLS_PER_TOLERANCE_CELL]
            ),
            np.ascontiguousarray(model.series_sensitivity.T),
        )

    @property
    def electrodes(self) -> int:
        """Number of electrodes."""
        return int(self.search_fractions.shape[1])

    def with_dead_electrode(self, model: ChannelModel, electrode: int) -> ForwardTable:
        """Return the table of the same pad with one electrode connected to nothing.

        model: the pad's network. The others collect its current in constant proportions; how these vary with
        the tolerances of parts is neglected.
        """
        floating = model.with_open_electrode(electrode)
        mixing = floating.currents_per_ideal @ np.linalg.inv(model.currents_per_ideal)
        n = self.electrodes
        nodes, tolerances = self.nodes.copy(), self.tolerance_nodes.copy()
        nodes[..., :n] = nodes[..., :n] @ mixing.T
        by_part = tolerances[..., 2 * n :].reshape(*tolerances.shape[:-1], -1, n) @ mixing.T
        tolerances[..., 2 * n :] = by_part.reshape(*tolerances.shape[:-1], -1)
        x, y = _spreading_nodes(model, self.nodes_x, self.nodes_y)
        nodes[..., n:] = hermite_table(_log_spreading(floating, x, y)[..., None])
        return replace(
            self,
            nodes=nodes,
            search_fractions=np.ascontiguousarray(self.search_fractions @ mixing.T),
            tolerance_nodes=tolerances,
            end_vectors=self.end_vectors @ mixing.T,
            series_vectors=np.ascontiguousarray(floating.series_sensitivity.T),
        )

    def misfit_scale(self, states: int = 1) -> float:
        """Return the factor from a squared misfit of n currents at the limit to MAX_SQUARED_MISFIT, which is
        as likely of one degree of freedom (chi-squared by Wilson and Hilferty, PNAS 17, 1931).

        states: of a schedule, whose totals are free but for one.
        """
        freedom = self.live_electrodes() - (states - 1) - 3
        if freedom <= 1:
            return 1.0
        return MAX_SQUARED_MISFIT / _chi_squared(freedom, math.erfc(math.sqrt(MAX_SQUARED_MISFIT / 2)))

    def live_electrodes(self) -> int:
        """Return the number of electrodes that collect current."""
        return int(np.count_nonzero(self.search_fractions.any(axis=0)))


def _spreading_nodes(
    model: ChannelModel, nodes_x: FloatArray, nodes_y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the positions at which the spreading radius is tabulated, off the edges, where it vanishes."""
    edge = _MIN_RADIUS_DISTANCE
    x, y = np.meshgrid(nodes_x[:, 0], nodes_y[:, 0])
    return np.clip(x, edge * model.a, (1 - edge) * model.a), np.clip(y, edge * model.b, (1 - edge) * model.b)


def _log_spreading(model: ChannelModel, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return ln of the spreading radius; with a floating electrode, enlarged by the resistance that it and
    the resistors add."""
    log_radius = np.log(np.asarray(model.spreading_radius(x, y), np.float64))
    if np.isfinite(model.series_ohm).all():
        return np.asarray(log_radius)
    added_ohm = model.series_resistance(x, y)
    return np.asarray(log_radius + 2 * math.pi * added_ohm / model.sheet_ohm_per_square)


def _chi_squared(freedom: int, probability: float) -> float:
    """Return what chi-squared exceeds with this probability, by Wilson and Hilferty."""
    variance, deviations = 2 / (9 * freedom), NormalDist().inv_cdf(1 - probability)
    return freedom * (1 - variance + deviations * math.sqrt(variance)) ** 3


def pair_limit(table: ForwardTable, false_alarm: float, states: int = 1) -> float:
    """Return the squared misfit of one contact that it exceeds with the probability `false_alarm`.

    Infinite for a probability of 0, and for fewer than six currents: two contacts have six unknowns. Each of
    several `states` of a schedule after the first has one more, its total.
    """
    electrodes = table.live_electrodes() - (states - 1)
    if electrodes < MIN_PAIR_ELECTRODES or not false_alarm > 0:
        return math.inf
    return _chi_squared(electrodes - 3, false_alarm)


class _Axis:
    """Coordinate of a side, and the cells that it is tabulated in."""

    def __init__(self, side: float, ends: Sequence[float]) -> None:
        self.side = side
        self._ends = ends
        self._low, high = (self._stretched(np.array([at]))[0] for at in (0.0, side))
        self._per_unit = _FORWARD_CELLS / (high - self._low)

    def cells(self, x: FloatArray) -> FloatArray:
        """Return coordinates in cells."""
        return np.asarray((self._stretched(x) - self._low) * self._per_unit)

    def nodes(self) -> FloatArray:
        """Return the coordinates of the nodes and their derivatives by cell, (cells + 1, 2)."""
        targets = np.arange(_FORWARD_CELLS + 1.0)
        low, high = np.zeros_like(targets), np.full_like(targets, self.side)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            below = self.cells(middle) < targets
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        x = (low + high) / 2
        x[0], x[-1] = 0.0, self.side
        return np.stack([x, 1 / (self._density(x) * self._per_unit)], axis=1)

    def _stretched(self, x: FloatArray) -> FloatArray:
        edge = _EDGE_CELL * self.side
        stretched = np.log((x + edge) / (self.side - x + edge))
        for end in self._ends:
            stretched = stretched + np.arcsinh((x - end) / (_ELECTRODE_END_CELL * self.side))
        return np.asarray(stretched)

    def _density(self, x: FloatArray) -> FloatArray:
        """Return the derivative of `_stretched`."""
        edge = _EDGE_CELL * self.side
        density = 1 / (x + edge) + 1 / (self.side - x + edge)
        for end in self._ends:
            density = density + 1 / np.hypot(x - end, _ELECTRODE_END_CELL * self.side)
        return np.asarray(density)


def _tabulate_tolerances(
    model: ChannelModel, nodes_x: FloatArray, nodes_y: FloatArray
) -> tuple[NDArray[np.float32], FloatArray]:
    """Return nodes of the fields of a model's tolerances, and the vectors of its ends."""
    s, t = np.meshgrid(_inside(nodes_x[:, 0]) / model.a, _inside(nodes_y[:, 0]) / model.b)
    if isinstance(model, ChannelMap):
        fields, vectors = _fields_of_map(model, s * model.a, t * model.b)
    else:
        assert isinstance(model, ElectrodeNetwork)
        fields, vectors = _fields_of_network(model, s, t)
    return hermite_table(np.moveaxis(fields, 0, -1)).astype(np.float32), vectors


def _fields_of_map(model: ChannelMap, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the fields (columns, y, x) of a map, and its vectors: of two parts of each channel, itself."""
    own = np.swapaxes(model.channel_slopes(x, y), 0, 1).reshape(-1, *x.shape)
    variations = model.variation_slopes(x, y).reshape(-1, *x.shape)
    by_aspect = np.zeros((model.channels, *x.shape))
    fields = np.concatenate([own, by_aspect, variations, *model.patch_slopes(x, y)])
    return fields, np.repeat(np.eye(model.channels), 2, axis=0)


def _fields_of_network(
    network: ElectrodeNetwork, s: FloatArray, t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the fields (columns, y, x) of a network's ends and of the derivatives by its aspect and by waves
    of its sheet's resistance, and the vectors of its ends.

    By differences to networks that are slightly different, but for the waves.
    """
    nominal = network.fractions(s * network.a, t * network.b)

    def slope(other: ElectrodeNetwork, step: float) -> FloatArray:
        """Return derivatives (n, y, x) at fixed fractions of the sides."""
        return np.asarray((other.fractions(s * other.a, t * other.b) - nominal) / step)

    states = network.states or (tuple(range(len(nominal))),)
    ends, vectors = network.ends, np.zeros((len(network.ends), len(nominal)))
    fields = np.zeros((len(states), len(ends), *s.shape))
    for number, end in enumerate(ends):
        step = _TOLERANCE_STEP * (network.a, network.b)[end.axis]
        by_end = slope(network.with_moved_end(number, step), step)
        for state, electrodes in enumerate(states):  # rank 1; the singularities differ between states
            own = by_end[list(electrodes)].reshape(len(electrodes), -1)
            left, singular, right = np.linalg.svd(own, full_matrices=False)
            vectors[number, list(electrodes)] = left[:, 0] * singular[0]
            fields[state, number] = right[0].reshape(s.shape)
    by_aspect = slope(network.stretched(math.exp(_TOLERANCE_STEP)), _TOLERANCE_STEP)
    by_waves = network.variation_slopes(s * network.a, t * network.b)
    columns = np.concatenate(
        [
            fields.reshape(-1, *s.shape),
            by_aspect,
            by_waves.reshape(-1, *s.shape),
            *network.patch_slopes(s * network.a, t * network.b),
        ]
    )
    return columns, vectors


def _inside(x: FloatArray) -> FloatArray:
    """Return node coordinates with the outermost off the edges, where a model may have no value."""
    return np.clip(x, _MIN_EDGE_DISTANCE * x[-1], (1 - _MIN_EDGE_DISTANCE) * x[-1])
