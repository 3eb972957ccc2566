"""Contacts solved with the sheet beneath them: where the current of a pressed patch enters, and how much.

Public names: `PatchNodes` (patches on pads, as nodes), `look_up_nodes`, `node_slopes`, `ContactLayer`,
`solve_patches`.

The layer between conductor and sheet conducts the better the harder it is pressed: sigma = (p /
p_reference)^alpha over the specific resistance. Its current density is that times what the sheet's potential
leaves of the drive, and the sheet's potential is the sum of Green's functions of these currents. A patch is a
few nodes, one linear system per contact. Green's function of two points with conformal radii R and R' at a
distance d is ln(1 + R R' / d^2) / 4 pi, exact on a disc and beside a straight edge; conformal radii are those
of the solved sheet. A node's own potential is chosen such that an even density over the whole patch has the
potential that is known for an ellipse. What hangs over an edge presses on nothing: nodes are moved so that
they cover the part on the pad, which carries the whole force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray, IntArray
from handtouch.simulate.contact_patch import PROFILES, half_axes
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_solver import SheetMapBank
from handtouch.simulate.stages.patches import NodeSystems

NODES: Final = 24  # of a patch
_RINGS, _SPOT_RINGS = 3, 2
_RING_INSIDE, _SPOT_RADIUS, _SPOT_DISTANCE = 0.6, 0.55, 1.2
_TILTS = {"half_tilted": 0.5, "tilted": 1.0}
_MIN_PRESSURE = 1e-9  # over its mean
_MIN_FORCE_N = 1e-6
_EDGE = 1e-6  # nearest distance of a node from an edge, in sides


class ContactLayer(NamedTuple):
    """Layer of a contact, numbers or (n,)."""

    contact_ohm_m2: FloatArray | float
    reference_pa: FloatArray | float
    alpha: FloatArray | float


class _Profile(NamedTuple):
    """Nodes of a profile on the unit disc.

    point: (2, NODES). area: (NODES,). lobe: (NODES,) number of the even part that each is in; centre: (2,
    NODES), radius: of its part. inside: radius of a hole, over that of the patch. tilt: rise of the pressure
    along x. shift: x of the centre of pressure.
    """

    point: FloatArray
    area: FloatArray
    lobe: IntArray
    centre: FloatArray
    radius: float
    inside: float
    tilt: float
    is_hertz: bool

    @property
    def shift(self) -> float:
        return self.tilt / 4

    def pressure(self, point: FloatArray) -> FloatArray:
        """Return the pressure (..., n), in any unit, at points (..., 2, n)."""
        if self.is_hertz:
            return np.asarray(np.sqrt(np.maximum(1 - (point**2).sum(axis=-2), _MIN_PRESSURE)))
        return np.asarray(np.maximum(1 + self.tilt * point[..., 0, :], _MIN_PRESSURE))


@cache
def _profile(number: int) -> _Profile:
    name = PROFILES[number]
    zero = np.zeros((2, NODES))
    if name == "two_spots":
        point, area = _disc_nodes(_SPOT_RINGS, NODES // 2 // _SPOT_RINGS, 0.0)
        side = np.repeat([-1.0, 1.0], NODES // 2)
        centre = np.stack([side * _SPOT_DISTANCE / 2, np.zeros(NODES)])
        points = centre + _SPOT_RADIUS * np.tile(point, 2)
        areas, lobe = _SPOT_RADIUS**2 * np.tile(area, 2), (side > 0).astype(np.intp)
        return _Profile(points, areas, lobe, centre, _SPOT_RADIUS, 0.0, 0.0, False)
    inside = _RING_INSIDE if name == "ring" else 0.0
    nodes = _disc_nodes(_RINGS, NODES // _RINGS, inside)
    one = np.zeros(NODES, np.intp)
    return _Profile(*nodes, one, zero, 1.0, inside, _TILTS.get(name, 0.0), name == "hertz")


def _disc_nodes(rings: int, around: int, inside: float) -> tuple[FloatArray, FloatArray]:
    """Return nodes (2, n) on the unit disc outside the radius `inside`, and the areas (n,) that they stand
    for: Gauss's in the square of the radius."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt(inside**2 + (1 - inside**2) * (nodes + 1) / 2)
    angle = 2 * np.pi * (np.arange(around) + 0.5) / around + (np.arange(rings)[:, None] % 2) * np.pi / around
    point = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)])
    return point.reshape(2, -1), np.repeat(weights / 2 * np.pi * (1 - inside**2) / around, around)


class PatchNodes(NamedTuple):
    """Nodes of patches (k,) on one pad or several."""

    position: FloatArray
    """(k, 2, NODES), fractions of the pad."""
    place_m: FloatArray
    """(k, 2, NODES), from the patch's position, of the isotropic equivalent of the sheet."""
    area_m2: FloatArray
    """(k, NODES), on the surface."""
    pressure: FloatArray
    """(k, NODES), per force [1/m^2]."""
    own_m: FloatArray
    """(k, NODES), distance at which another node would have a node's own potential."""
    radius_ratio: FloatArray
    """(k, 1), of a conformal radius in the sheet's metric to that on the surface."""

    @classmethod
    def of_patches(cls, shape: SimulatedSurface, position: FloatArray, patch: FloatArray) -> PatchNodes:
        """Return the nodes of patches (PATCH_ROWS, k) whose pressures' centres, were they all on the pad, are
        at positions (2, k), fractions of the pad."""
        if (patch[1:] == patch[1:, :1]).all():
            return _nodes_of(shape, position, patch[0], _form(*patch[1:, 0].tolist(), shape.stretch))
        groups: dict[tuple[float, float, float], list[int]] = {}
        for k, form in enumerate(zip(*patch[1:].tolist(), strict=True)):
            groups.setdefault(form, []).append(k)
        parts = [
            _nodes_of(shape, position[:, at], patch[0, at], _form(*form, shape.stretch))
            for form, at in groups.items()
        ]
        return cls.joined(parts).taken(np.argsort(np.concatenate(list(groups.values()))))

    @classmethod
    def joined(cls, parts: Sequence[PatchNodes]) -> PatchNodes:
        """Return the patches of several parts, one after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def taken(self, at: IntArray) -> PatchNodes:
        """Return the patches of these numbers."""
        return PatchNodes(*(column[at] for column in self))

    def centres(self, shape: SimulatedSurface, position: FloatArray) -> FloatArray:
        """Return the centres (2, k) of the pressure on the pad, fractions of it, of patches on one pad."""
        place_m = (self.place_m * (self.area_m2 * self.pressure)[:, None]).sum(axis=2, keepdims=True)
        return shape.fractions_beside(position, place_m / _stretch(shape.stretch))[:, :, 0].T


def _stretch(ratio: float) -> FloatArray:
    """Return the lengths (2, 1) along x and y in the isotropic equivalent of a sheet."""
    return np.array([[ratio], [1.0]])


class _Form(NamedTuple):
    """What patches of one form, of any size and place, have in common; lengths are over the radius."""

    profile: _Profile
    axes: FloatArray
    """(2, 2), carries the unit disc to the patch."""
    stretch: FloatArray
    """(2, 1), lengths along x and y in the isotropic equivalent of the sheet."""
    log_own: FloatArray
    """(NODES,), logarithm of `PatchNodes.own_m`."""


@lru_cache(maxsize=4096)
def _form(elongation: float, direction_rad: float, number: float, stretch: float) -> _Form:
    profile, lengths = _profile(int(number)), _stretch(stretch)
    axes = half_axes(np.array([[1.0], [elongation], [direction_rad]]))
    return _Form(profile, axes[0], lengths, _log_own(lengths * axes, profile)[0])


def _nodes_of(shape: SimulatedSurface, position: FloatArray, radius_m: FloatArray, form: _Form) -> PatchNodes:
    """Return the nodes of patches of one form."""
    profile, k = form.profile, len(radius_m)
    axes = radius_m[:, None, None] * form.axes
    both = axes.transpose(1, 2, 0).reshape(2, 2 * k)  # first the long ones
    to_fractions = shape.fractions_of(np.concatenate([position, position], axis=1), both)
    to_fractions = to_fractions.reshape(2, 2, k).transpose(2, 0, 1)
    middle = position.T - profile.shift * to_fractions[:, :, 0]
    point, area = profile.point, (radius_m**2)[:, None] * profile.area
    own_m = radius_m[:, None] * np.exp(form.log_own)
    if (over := _is_over_edge(middle, to_fractions, profile)).any():
        point, squeeze = _points_on_pad(middle, to_fractions, profile, over)
        area, own_m = area * squeeze.prod(axis=1), own_m * ((1 + squeeze) / 2).prod(axis=1)
    vector_m = axes @ point - profile.shift * axes[:, :, :1]
    pressure = profile.pressure(point)
    pressure = pressure / (area * pressure).sum(axis=1, keepdims=True)
    fractions = np.clip(shape.fractions_beside(position, vector_m), _EDGE, 1 - _EDGE)
    ratio = np.full((k, 1), (1 + shape.stretch) / 2)
    return PatchNodes(
        position=fractions,
        place_m=form.stretch * vector_m,
        area_m2=area,
        pressure=pressure,
        own_m=own_m,
        radius_ratio=ratio,
    )


def _is_over_edge(middle: FloatArray, to_fractions: FloatArray, profile: _Profile) -> NDArray[np.bool_]:
    """Return which patches (k,) reach beyond the pad; parameters as in `_points_on_pad`."""
    beyond = np.abs(middle[:, :, None] + to_fractions @ profile.centre - 0.5)
    reach = profile.radius * np.sqrt((to_fractions**2).sum(axis=2))
    return np.asarray((beyond + reach[:, :, None] > 0.5).any(axis=(1, 2)))


def _points_on_pad(
    middle: FloatArray, to_fractions: FloatArray, profile: _Profile, over: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Return the points (k, 2, NODES) of the unit disc that stand for the part of patches on the pad.

    Second: by what they are nearer to each other along x and y than on the whole patch, (k, 2, NODES).
    middle: (k, 2) of the patches, fractions of the pad. to_fractions: (k, 2, 2), from the unit disc. over:
    (k,), those that reach beyond the pad.
    """
    point = np.repeat(profile.point[None], len(middle), axis=0)
    squeeze = np.ones_like(point)
    centres = middle[:, :, None] + to_fractions @ profile.centre
    square = profile.radius**2 * to_fractions @ to_fractions.transpose(0, 2, 1)
    for k in np.flatnonzero(over).tolist():
        at = middle[k, :, None] + to_fractions[k] @ profile.point
        for axis in (0, 1):  # nodes of a chord of their part move to what of it is on the pad
            other = square[k, 1 - axis, 1 - axis]
            aside = at[1 - axis] - centres[k, 1 - axis]
            half = np.sqrt(np.linalg.det(square[k]) / other * np.maximum(1 - aside**2 / other, 1e-9))
            begin = centres[k, axis] + square[k, 0, 1] / other * aside - half
            low, high = np.clip(begin, 0.0, 1.0), np.clip(begin + 2 * half, 0.0, 1.0)
            squeeze[k, axis] = np.maximum((high - low) / (2 * half), 1e-6)
            at[axis] = low + squeeze[k, axis] * (at[axis] - begin)
        point[k] = np.linalg.solve(to_fractions[k], at - middle[k, :, None])
    return point, squeeze


def _log_own(in_metric: FloatArray, profile: _Profile) -> FloatArray:
    """Return the logarithms (k, NODES) of `PatchNodes.own_m` of whole patches; in_metric: (k, 2, 2), from the
    unit disc.

    The integral of -ln of the distance over an ellipse with the half axes a and b is, inside it, a b pi (1/2
    - ln((a + b) / 2)) - pi (b x^2 + a y^2) / (a + b).
    """
    square = in_metric @ in_metric.transpose(0, 2, 1)
    product = np.abs(np.linalg.det(in_metric))  # a b
    total = np.sqrt(square[:, 0, 0] + square[:, 1, 1] + 2 * product)  # a + b
    root = (square + product[:, None, None] * np.eye(2)) / total[:, None, None]  # of `square`
    place, local = in_metric @ profile.point, in_metric @ (profile.point - profile.centre)
    form = (local * (np.linalg.inv(root) @ local)).sum(axis=1)
    radius = profile.radius
    size, sum_of_axes = radius**2 * product, radius * total
    known = math.pi * (size * (0.5 - np.log(sum_of_axes / 2)))[:, None]
    known = known - math.pi * product[:, None] / total[:, None] * form
    if profile.inside:
        known += math.pi * profile.inside**2 * product[:, None] * np.log(np.hypot(local[:, 0], local[:, 1]))
    area = product[:, None] * profile.area
    distance = np.hypot(*np.moveaxis(place[:, :, :, None] - place[:, :, None, :], 1, 0))
    together = (profile.lobe[:, None] == profile.lobe) & ~np.eye(NODES, dtype=bool)
    logs = np.log(np.where(together, distance, 1.0))
    return np.asarray(-(known + (logs * area[:, None, :]).sum(axis=2)) / area)


def solve_patches(
    nodes: PatchNodes,
    log_radius: FloatArray,
    shares: FloatArray,
    number: IntArray,
    force_n: FloatArray,
    sheet_ohm: FloatArray | float,
    layer: ContactLayer,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return resistances (n,) [ohm] of contacts to the grounded electrodes, and shares (n, m) of these.

    log_radius: (k, NODES), logarithm of the conformal radius [m]. shares: (m, k, NODES), of a current at each
    node. number: (n,) of the patch of each contact; force_n: (n,), that which its layer conducts as. Third:
    shares (n, NODES) of the nodes in each contact's current.
    """
    n, k = len(number), len(nodes.own_m)
    columns = np.empty((5, n))
    for column, value in zip(columns, (sheet_ohm, *layer, np.maximum(force_n, _MIN_FORCE_N)), strict=True):
        column[:] = value
    green, system, current = np.empty((k, NODES, NODES)), np.empty((NODES, NODES)), np.empty((n, NODES))
    scratch = system, np.empty(NODES)
    systems = NodeSystems(NODES, *map(_flat, (nodes.area_m2, nodes.pressure, green, *scratch)))
    radius_m = np.exp(log_radius) * nodes.radius_ratio
    systems.fill_green(*map(_flat, (nodes.place_m, nodes.own_m, radius_m)))
    systems.solve(*map(_flat, (number, columns[4], columns[0], columns[1:4], current)))
    total = current.sum(axis=1)
    by_node = current / total[:, None]
    return 1 / total, np.einsum("mnk,nk->nm", shares[:, number], by_node), by_node


def _flat(array: NDArray[Any]) -> memoryview[Any]:
    return np.ascontiguousarray(array).reshape(-1).data


def look_up_nodes(bank: SheetMapBank, sheet: IntArray, nodes: PatchNodes) -> tuple[FloatArray, FloatArray]:
    """Return logarithms of conformal radii (k, NODES) and shares (m, k, NODES) at the nodes of patches on
    sheets (k,)."""
    values = bank.values_anywhere(*_places(sheet, nodes)).reshape(-1, *nodes.own_m.shape)
    return values[-1], values[:-1]


def node_slopes(bank: SheetMapBank, sheet: IntArray, nodes: PatchNodes) -> FloatArray:
    """Return the derivatives (m, 2, k, NODES) of the shares at the nodes of patches by position."""
    _, slopes = bank.look_up(*_places(sheet, nodes))
    return slopes[:-1].reshape(-1, 2, *nodes.own_m.shape)


def _places(sheet: IntArray, nodes: PatchNodes) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return sheets and positions of all nodes of patches, each (k NODES,)."""
    return np.repeat(sheet, NODES), nodes.position[:, 0].ravel(), nodes.position[:, 1].ravel()
