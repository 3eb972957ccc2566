"""Contact points of a grasp -> what presses on each pad: discs with a place, a force and a radius.

Public names: `Patches` (discs on all pads, and the resultant on each), `patches`. A skin that gives spreads a
point's force over a disc as Hertz has it for two round bodies. Two convex bodies that touch in several
points touch in all between them: the points move towards their centre of force until their second moment is
that of an even load. Discs that overlap are one, with their moments of force. At an edge of a pad its skin
ends: all the force of a disc is on the part of it that lies on the pad. What presses beside the pads' sensing
surfaces isn't sensed, and counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.simulate.grasp.episode import Grasp
from handtouch.simulate.grasp.scene import Pad
from handtouch.simulate.grasp.shapes import foot

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_SKIN_PA = 1.0e6  # effective modulus of a rubber skin on something hard
_LEAST_M, _LARGEST_M = 0.5e-3, 5e-3
_FAINT_N = 1e-4
_RIM_M = 0.5e-3  # so far beyond the edge of a pad it is still pressed, at the edge
_EVEN = 3**-0.5  # an even line or rectangle has a third of the second moment of its ends or corners


@dataclass(frozen=True, eq=False)
class Patches:
    """n steps, p pads, at most d discs on a pad at a time; forces are those along the pads' normals."""

    place: FloatArray
    """(n, p, d, 2) fractions of the pad from electrodes x0 and y0"""
    force_n: FloatArray
    """(n, p, d), 0 where there is no disc"""
    radius_m: FloatArray
    """(n, p, d)"""
    centre: FloatArray
    """(n, p, 2) of the force on a pad, fractions of it; NaN without"""
    total_n: FloatArray
    """(n, p) what a pad senses"""
    spread_m: FloatArray
    """(n, p) radius of an even disc with the same moment of force; 0 without force"""
    beside: int
    """contact points, of all steps, beside the sensing surfaces"""
    beside_share: float
    """and their share of the force on the hand, summed over the steps"""


def patches(grasp: Grasp) -> Patches:
    """What presses on the pads in the course of a grasp."""
    n, p = len(grasp.times_s), len(grasp.pads)
    sensed = [_sensed(grasp, row) for row in range(p)]
    found = [_even(steps, place, force, radius) for _, steps, place, force, radius in sensed]
    whole = [_merged(grasp.pads[row], *of) for row, of in enumerate(found)]
    discs = [_cut(grasp.pads[row], *of) for row, of in enumerate(whole)]
    depth = max((int(np.bincount(steps).max()) for steps, *_ in discs if len(steps)), default=1)
    made = Patches(
        np.full((n, p, depth, 2), 0.5),
        np.zeros((n, p, depth)),
        np.full((n, p, depth), _LEAST_M),
        np.full((n, p, 2), np.nan),
        np.zeros((n, p)),
        np.zeros((n, p)),
        len(grasp.step) - sum(len(points) for points, *_ in sensed),
        _share_beside(grasp, np.concatenate([points for points, *_ in sensed])),
    )
    for row, (steps, place, force, radius) in enumerate(discs):
        lane = np.arange(len(steps)) - np.searchsorted(steps, steps)  # steps are in order
        made.place[steps, row, lane], made.force_n[steps, row, lane] = place, force
        made.radius_m[steps, row, lane] = radius
    _resultants(made, grasp)
    return made


def _sensed(grasp: Grasp, row: int) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Contact points (k,) on a pad by their numbers: steps, places, forces along the normal, radii."""
    pad, mine = grasp.pads[row], np.flatnonzero(grasp.pad == row)
    steps = grasp.step[mine]
    turn = grasp.link_rotation[steps, row]
    on_link = np.einsum("kji,kj->ki", turn, grasp.point_m[mine] - grasp.link_m[steps, row])
    at = foot(pad.shape, (on_link - pad.translation_m) @ pad.rotation)
    pushed = np.einsum("kji,kj->ki", turn, grasp.force_n[mine]) @ pad.rotation
    force = -np.einsum("ki,ki->k", pushed, at.normal)
    rim = 0.5 + _RIM_M / _sides_m(pad, 0.5)
    on = (np.abs(at.fraction - 0.5) <= rim).all(axis=1) & (force > _FAINT_N)
    place = np.clip(at.fraction[on], 0.0, 1.0)
    return mine[on], steps[on], place, force[on], _hertz_m(grasp, pad, place, force[on])


def _even(
    steps: IntArray, place: FloatArray, force: FloatArray, radius: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Points that stand for a line or face, moved towards their centre of force."""
    if not len(steps):
        return steps, place, force, radius
    total = np.bincount(steps, force)
    sums = np.stack([np.bincount(steps, force * along) for along in place.T], axis=1)
    centre = sums[steps] / total[steps][:, None]
    return steps, centre + _EVEN * (place - centre), force, radius


def _hertz_m(grasp: Grasp, pad: Pad, place: FloatArray, force_n: FloatArray) -> FloatArray:
    """Radii (k,) of a skin's discs: a^3 = 3 F R / 4 E, 1 / R the sum of both bodies' mean curvatures."""
    curved = np.zeros(len(force_n))
    if not pad.shape.flat:
        curved = 0.5 / pad.shape.radius(place[:, 0] * pad.shape.length_m)
        if pad.shape.sphere_from_rad is not None:
            curved = np.full(len(force_n), 1 / pad.shape.start_radius_m)
    together = np.maximum(curved + grasp.thing.curvature, 1.0)
    cube = 3 * force_n / (4 * _SKIN_PA * together)
    return np.asarray(np.clip(np.cbrt(cube), _LEAST_M, _LARGEST_M))


def _merged(
    pad: Pad, steps: IntArray, place: FloatArray, force: FloatArray, radius: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Discs that overlap made one; rows in the order of steps."""
    alone = np.ones(len(steps), np.bool_)
    same = np.flatnonzero(steps[1:] == steps[:-1])
    alone[same] = alone[same + 1] = False
    kept = [(int(steps[i]), place[i], force[i], radius[i]) for i in np.flatnonzero(alone)]
    for step in np.unique(steps[~alone]):
        at = np.arange(*np.searchsorted(steps, [step, step + 1]))
        discs = [(place[i], float(force[i]), float(radius[i])) for i in at]
        kept += [(int(step), *disc) for disc in _join(pad, discs)]
    kept.sort(key=lambda disc: disc[0])
    if not kept:
        return steps, place, force, radius
    numbers, places, forces, radii = zip(*kept, strict=True)
    return np.array(numbers, np.intp), np.array(places), np.array(forces), np.array(radii)


def _cut(
    pad: Pad, steps: IntArray, place: FloatArray, force: FloatArray, radius: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """What of even discs (k,) lies on the pad, as discs: each is cut by the nearest edges along x and y."""
    if not len(steps):
        return steps, place, force, radius
    sides = np.stack([_sides_m(pad, x) for x in place[:, 0].tolist()])
    inward = np.where(place < 0.5, 1.0, -1.0)
    depth = np.clip(
        (0.5 - np.abs(place - 0.5)) * sides / radius[:, None], 0.0, 1.0
    )  # of the centre, in radii
    part = 1 - (np.arccos(depth) - depth * np.sqrt(1 - depth**2)) / np.pi  # of a disc cut by a chord
    shift = 2 / (3 * np.pi) * (1 - depth**2) ** 1.5 / part  # of its centroid, in radii
    radii = np.maximum(radius * np.sqrt(part.prod(axis=1)), _LEAST_M)
    return steps, place + inward * shift * radius[:, None] / sides, force, radii


Disc = tuple[FloatArray, float, float]


def _join(pad: Pad, discs: list[Disc]) -> list[Disc]:
    """Discs at one moment, those that overlap made one, until none do."""
    done: list[Disc] = []
    while discs:
        one = discs.pop()
        touching = (k for k, other in enumerate(discs) if _apart_m(pad, one, other) < one[2] + other[2])
        near = next(touching, None)
        if near is None:
            done.append(one)
        else:
            discs.append(_sum(pad, one, discs.pop(near)))
    return done


def _sum(pad: Pad, one: Disc, other: Disc) -> Disc:
    """A disc with the force of two, its centre, and its second moment: F a^2 / 2 of an even disc."""
    force = one[1] + other[1]
    centre = (one[0] * one[1] + other[0] * other[1]) / force
    middle = centre, force, 0.0
    moment = sum(disc[1] * (disc[2] ** 2 / 2 + _apart_m(pad, disc, middle) ** 2) for disc in (one, other))
    return centre, force, float(np.sqrt(2 * moment / force))


def _apart_m(pad: Pad, one: Disc, other: Disc) -> float:
    along, around = (one[0] - other[0]) * _sides_m(pad, 0.5 * (one[0][0] + other[0][0]))
    return float(np.hypot(along, around))


def _sides_m(pad: Pad, x: float) -> FloatArray:
    """Metres per unit of the fractions, at x."""
    return np.array([pad.shape.length_m, pad.shape.arc * float(pad.shape.radius(x * pad.shape.length_m))])


def _resultants(made: Patches, grasp: Grasp) -> None:
    made.total_n[:] = made.force_n.sum(2)
    on = made.total_n > 0
    weight = made.force_n[on] / made.total_n[on][:, None]
    made.centre[on] = (weight[:, :, None] * made.place[on]).sum(1)
    sides = np.array([_sides_m(pad, 0.5) for pad in grasp.pads])[np.nonzero(on)[1]]
    off_m = (made.place[on] - made.centre[on][:, None]) * sides[:, None]
    moment = weight * (made.radius_m[on] ** 2 / 2 + (off_m**2).sum(2))
    made.spread_m[on] = np.sqrt(2 * moment.sum(1))


def _share_beside(grasp: Grasp, on_pads: IntArray) -> float:
    """Of all forces on the hand, by their size, what no pad senses."""
    size = np.linalg.norm(grasp.force_n, axis=1)
    return float(1 - size[on_pads].sum() / size.sum()) if len(size) else 0.0
