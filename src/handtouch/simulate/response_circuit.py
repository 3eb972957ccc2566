"""Signals of a pad that is no sheet with electrodes: what its channels read, with effects that no estimator
models.

Public names: `ResponseCircuit`, `response_circuit`. The physics of each kind is its own (`_PHYSICS`, and the
entry points of the group `handtouch.simulated_responses`), independent of `handtouch.field`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator, RectBivariateSpline

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.responses import ForceLaw
from handtouch.host.plugins import load_plugins
from handtouch.simulate.contact_patch import discs
from handtouch.simulate.faults import DeadElectrode, Fault
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.solved_contact import PatchNodes
from handtouch.simulate.stimulus import PadStimulus
from handtouch.simulate.worlds.response_spread import HiddenResponse

PointResponse = Callable[[FloatArray, FloatArray], FloatArray]
"""Signals (points, n) of unit point loads at points (points, 3) [m] with outward normals (points, 3)."""
_STEP = 1e-3  # of derivatives, in sides
_TABLE_POINTS = 49  # along each side
_NEIGHBOURS = 1.5  # distance of neighbours, over that of the nearest one
_SMOOTHING = 1e-4  # of a plate, in squares of the unit signal
_TAIL_WIDTH = 2.0  # of the wide part of a response, over the whole


@dataclass(frozen=True)
class ResponseCircuit:
    """Channels of a pad with their true response, tabulated over it."""

    shape: SimulatedSurface
    tables: tuple[RectBivariateSpline, ...]
    """(n,) of the channels, by fractions of the pad, for a point load of unit strength."""
    mixing: FloatArray
    """(n, n), cross-talk."""
    law: ForceLaw | None = None
    """That of the strength, of kinds that have one."""
    signal_ratio: float = 1.0
    field_axes: FloatArray | None = None
    """(n, 3) of a magnetic pad's channels in its frame: signals in the Earth's field along them."""
    states: tuple[tuple[int, ...], ...] = ()
    names: tuple[str, ...] = field(default=())

    def shares(self, position: FloatArray, patch: FloatArray) -> FloatArray:
        """Return the signals (k, n) of patches (PATCH_ROWS, k) of unit strength at positions (2, k)."""
        nodes = PatchNodes.of_patches(self.shape, position, patch)
        weight = nodes.area_m2 * nodes.pressure
        weight = weight / weight.sum(axis=1, keepdims=True)
        x, y = np.clip(np.moveaxis(nodes.position, 1, 0), 0.0, 1.0)
        found = np.stack([(table.ev(x, y) * weight).sum(axis=1) for table in self.tables], axis=1)
        return np.asarray(found @ self.mixing.T)

    def signals(self, position: FloatArray, patch: FloatArray, force_n: FloatArray) -> FloatArray:
        """Return the signals (k, n) of patches (PATCH_ROWS, k) under forces (k,) at positions (2, k)."""
        assert self.law is not None
        columns = np.concatenate([position, patch])
        columns, number = np.unique(columns, axis=1, return_inverse=True)
        shares = self.shares(columns[:2], columns[2:])[number.ravel()]
        strength = self.law.unit_signal * self.signal_ratio * np.maximum(force_n, 0.0) ** self.law.alpha
        return np.asarray(strength[:, None] * shares)

    def currents(
        self,
        times_s: FloatArray,
        touches: PadStimulus,
        faults: Sequence[Fault],
        force_ratio: FloatArray,
        supply_ratio: FloatArray | float = 1.0,
    ) -> FloatArray:
        """Return the signals (n, m) of the channels, in the unit of the node's counts; see `PadCircuit`."""
        position, force, patches = touches.contacts(times_s)
        lanes = [(position[k], patches[k], force[k]) for k in range(len(force)) if force[k].any()]
        for fault in faults:
            added = fault.contacts(times_s, self.size_m)
            if added is not None and added.force_n is not None:
                for at, radius_m in zip(added.position, added.radius_m, strict=True):
                    where = np.repeat(at[:, None], len(times_s), axis=1)
                    lanes.append((where, discs(np.full(len(times_s), radius_m)), added.force_n))
        found = np.zeros((len(times_s), len(self.tables)))
        for where, patch, force_n in lanes:
            rows = np.flatnonzero(force_n > 0)
            if len(rows):
                found[rows] += self.signals(where[:, rows], patch[:, rows], force_n[rows] * force_ratio[rows])
        for fault in faults:
            if isinstance(fault, DeadElectrode):
                found[fault.is_active(times_s), self.names.index(fault.electrode)] = 0.0
        return np.asarray(found * np.reshape(supply_ratio, (-1, 1)))

    def signals_with_jacobian(
        self, x: float, y: float, force_n: float, patch: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the signals (n,) of a contact at (x, y), fractions of the pad, and their derivatives (n, 3)
        by x, y and the logarithm of the strength."""
        steps = _STEP * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        position = np.array([[x, y]]).T + steps.T
        count = len(steps)
        signals = self.signals(position, np.repeat(patch[:, None], count, axis=1), np.full(count, force_n))
        slopes = (signals[[1, 3]] - signals[[2, 4]]) / (2 * _STEP)
        return signals[0], np.column_stack([*slopes, signals[0]])

    @property
    def size_m(self) -> tuple[float, float]:
        """Sides along x and y, at the middle of the pad."""
        return self.shape.length_m, self.shape.arc * float(self.shape.radius(self.shape.length_m / 2))


def response_circuit(pad: config.Pad, shape: SimulatedSurface, hidden: HiddenResponse) -> ResponseCircuit:
    """Return the true channels of a pad. Raises ValueError for a kind of response without a simulation."""
    table = pad.response
    assert isinstance(table, config.ResponseTable)
    build = _PHYSICS.get(table.kind) or load_plugins("handtouch.simulated_responses").get(table.kind)
    if build is None:
        raise ValueError(
            f'response kind "{table.kind}" isn\'t simulated; its package adds a simulation by an entry point '
            f'"{table.kind}" of the group handtouch.simulated_responses (docs/responses.md)'
        )
    assert isinstance(table, ForceLaw)  # of other laws no package adds a simulation
    respond, places_m = build(table, shape, hidden)
    along = np.linspace(0.0, 1.0, _TABLE_POINTS)
    at = [(s * shape.length_m, t * shape.arc) for s in along.tolist() for t in along.tolist()]
    points, normals = (np.array([of(*place) for place in at]) for of in (shape.point, shape.normal))
    signals = respond(points, normals).reshape(_TABLE_POINTS, _TABLE_POINTS, -1)
    return ResponseCircuit(
        shape,
        tuple(RectBivariateSpline(along, along, signals[:, :, k]) for k in range(signals.shape[2])),
        _mixing(places_m, hidden.crosstalk),
        table,
        hidden.signal_ratio,
        _field_axes(table, shape, hidden) if pad.is_magnetic else None,
        names=pad.electrode_names,
    )


def _mixing(places_m: FloatArray, crosstalk: float) -> FloatArray:
    """Return the matrix (n, n) by which each channel reads a share of its neighbours."""
    distance = np.linalg.norm(places_m[:, None] - places_m[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(np.eye(len(places_m)) + crosstalk * (distance < _NEIGHBOURS * distance.min()))


def _stated_taxels(table: Any, shape: SimulatedSurface) -> tuple[FloatArray, FloatArray]:
    """Return places (n, 3) and normals (n, 3) of taxels as stated."""
    stated = 1e-3 * np.array(table.positions_mm)
    if stated.shape[1] == 2:
        s_m = shape.length_m / 2 + stated[:, 0]
        phi = shape.arc / 2 + stated[:, 1] / shape.radius(s_m)
        places = np.array([shape.point(*at) for at in zip(s_m.tolist(), phi.tolist(), strict=True)])
    else:
        places = stated
    feet = shape.project(places)
    normals = feet.normal if table.normals is None else np.array(table.normals, np.float64)
    return places, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _field_axes(table: Any, shape: SimulatedSurface, hidden: HiddenResponse) -> FloatArray:
    """Return the axes of magnetic taxels: not quite their normals."""
    normals = _stated_taxels(table, shape)[1]
    axes = normals + np.reshape(hidden.field_tilt, (-1, 3))
    gain = hidden.signal_ratio * np.broadcast_to(table.signal_per_n, len(axes))
    return np.asarray(hidden.field_n * gain[:, None] * axes)


def _taxels(table: Any, shape: SimulatedSurface, hidden: HiddenResponse) -> tuple[PointResponse, FloatArray]:
    """Return the response of taxels whose places and widths aren't quite as stated, with a wide tail."""
    places, normals = _stated_taxels(table, shape)
    count = len(places)
    along = np.cross(np.array([0.0, 1.0, 0.0]), normals)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    moved = 1e-3 * np.reshape(hidden.position_offset_mm, (2, count))
    places = places + moved[0][:, None] * along + moved[1][:, None] * np.cross(normals, along)
    width = 1e-3 * np.broadcast_to(table.width_mm, count) * np.array(hidden.width_ratio)
    gain = np.broadcast_to(table.signal_per_n, count) / table.unit_signal
    unit = _mean_over_disc(table.profile, 1e-3 * table.contact_radius_mm / width)

    def respond(points: FloatArray, outward: FloatArray) -> FloatArray:
        away = points[:, None] - places[None]
        height = (away * normals).sum(axis=2)
        square = np.maximum((away**2).sum(axis=2) - height**2, 0.0) / width**2
        core = _profile(table.profile, square)
        tail = _profile(table.profile, square / _TAIL_WIDTH**2) / _TAIL_WIDTH**2
        facing = np.maximum(outward @ normals.T, 0.0)
        return np.asarray(((1 - hidden.tail) * core + hidden.tail * tail) * facing * gain / unit)

    return respond, places


def _measured(table: Any, shape: SimulatedSurface, _: HiddenResponse) -> tuple[PointResponse, FloatArray]:
    """Return the response that presses show, by a thin plate through them."""
    presses = config.presses_of(table.presses)
    places = presses.place_m
    if places.shape[1] == 2:
        s_m, v_m = places.T
        along = zip(s_m.tolist(), (v_m / shape.radius(s_m)).tolist(), strict=True)
        places = np.array([shape.point(*at) for at in along])
    assert presses.force_n is not None
    signals = presses.signals / presses.force_n[:, None] ** table.alpha / table.unit_signal
    plate = RBFInterpolator(places, signals, smoothing=_SMOOTHING, kernel="thin_plate_spline")
    return lambda points, _: np.asarray(plate(points)), places[signals.argmax(axis=0)]


def _profile(name: str, square: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-square / 2) if name == "gaussian" else (1 + square) ** -2.5)


def _mean_over_disc(name: str, radius: FloatArray) -> FloatArray:
    """Return the mean (n,) of a profile over discs of a radius (n,) in widths, right on it."""
    square = radius**2
    if name == "gaussian":
        return np.asarray(-np.expm1(-square / 2) * 2 / square)
    return np.asarray((1 - (1 + square) ** -1.5) / 1.5 / square)


_PHYSICS: Mapping[str, Callable[..., tuple[PointResponse, FloatArray]]] = MappingProxyType(
    {"taxels": _taxels, "measured": _measured}
)
