"""Convert the contact points of a grasp to patches on the pads: discs with position, force and radius.

Public names: `ContactPatches` (discs and resultants of all pads), `contact_patches`; of one pad:
`project_points`, `pad_discs`, `clip_to_pad`. A soft
skin spreads a point's force over a disc, by Hertz's law for two round bodies. Two convex bodies with
several contact points also touch between them: the points move towards their centre of force until their
second moment is that of a uniform load. Overlapping discs are merged, preserving their moments of force.
The skin ends at the edges of a pad: the whole force of a disc acts on its part on the pad. Contact points
beside the sensing surfaces aren't sensed; their number is recorded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handtouch.arrays import FloatArray, IntArray
from handtouch.simulate.grasp.mujoco_scene import MujocoPad
from handtouch.simulate.grasp.simulation import GraspRecord

_SKIN_MODULUS_PA = 1.0e6  # effective modulus of a rubber skin on a hard object
_MIN_RADIUS_M, _MAX_RADIUS_M = 0.5e-3, 5e-3
_MIN_FORCE_N = 1e-4
_MAX_OVERHANG_M = 0.5e-3  # points that far beyond the edge of a pad press on the edge
_MAX_HEIGHT_M = 5e-3
"""Height of a contact point above or below the surface: penetration, and pads out of place."""
_UNIFORM_LOAD_RATIO = 3**-0.5  # a uniform line or rectangle has a third of the second moment of its ends


@dataclass(frozen=True, eq=False)
class ContactPatches:
    """Discs of n steps, p pads, and at most d simultaneous discs per pad; forces are normal to the pads."""

    position: FloatArray
    """(n, p, d, 2), fractions of the pad from electrodes x0 and y0."""
    force_n: FloatArray
    """(n, p, d), 0 without a disc."""
    radius_m: FloatArray
    """(n, p, d)."""
    force_centre: FloatArray
    """(n, p, 2), centre of force of each pad, fractions of the pad; NaN without force."""
    total_n: FloatArray
    """(n, p), total force on each pad."""
    effective_radius_m: FloatArray
    """(n, p), radius of a uniform disc with the same moment of force; 0 without force."""
    points_off_pad: int
    """Number of contact points beside the sensing surfaces, all steps together."""
    force_fraction_off_pad: float
    """Their fraction of the force on the hand, summed over the steps."""


def contact_patches(grasp: GraspRecord) -> ContactPatches:
    """Return the contact patches of a grasp."""
    n, p = len(grasp.times_s), len(grasp.pads)
    sensed = [_sensed_points(grasp, row) for row in range(p)]
    discs = [pad_discs(grasp.pads[row], *points[1:]) for row, points in enumerate(sensed)]
    depth = max((int(np.bincount(steps).max()) for steps, *_ in discs if len(steps)), default=1)
    patches = ContactPatches(
        position=np.full((n, p, depth, 2), 0.5),
        force_n=np.zeros((n, p, depth)),
        radius_m=np.full((n, p, depth), _MIN_RADIUS_M),
        force_centre=np.full((n, p, 2), np.nan),
        total_n=np.zeros((n, p)),
        effective_radius_m=np.zeros((n, p)),
        points_off_pad=len(grasp.step_index) - sum(len(points) for points, *_ in sensed),
        force_fraction_off_pad=_force_fraction_off_pad(
            grasp, np.concatenate([points for points, *_ in sensed])
        ),
    )
    for row, (steps, position, force, radius) in enumerate(discs):
        lane = np.arange(len(steps)) - np.searchsorted(steps, steps)  # steps are in order
        patches.position[steps, row, lane], patches.force_n[steps, row, lane] = position, force
        patches.radius_m[steps, row, lane] = radius
    _set_resultants(patches, grasp)
    return patches


def _sensed_points(
    grasp: GraspRecord, row: int
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Return contact points (k,) on a pad: indices, steps, positions, normal forces, radii."""
    pad, indices = grasp.pads[row], np.flatnonzero(grasp.pad_row == row)
    steps = grasp.step_index[indices]
    rotation = grasp.link_rotation[steps, row]
    on_link = np.einsum("kji,kj->ki", rotation, grasp.point_m[indices] - grasp.link_m[steps, row])
    force = np.einsum("kji,kj->ki", rotation, grasp.force_n[indices])
    on, position, normal_n, radius = project_points(pad, on_link, force, grasp.grasped_object.curvature)
    return indices[on], steps[on], position, normal_n, radius


def project_points(
    pad: MujocoPad, on_link_m: FloatArray, force_n: FloatArray, curvature: FloatArray | float
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the contact points (k,) that a pad senses: indices, positions, normal forces, radii.

    on_link_m, force_n: (n, 3), points and forces on the link, in its frame. curvature: (n,) or (), mean
    curvature of the other body [1/m].
    """
    foot = pad.shape.project((on_link_m - pad.translation_m) @ pad.rotation)
    force = -np.einsum("ki,ki->k", force_n @ pad.rotation, foot.normal)
    rim = 0.5 + _MAX_OVERHANG_M / _side_lengths_m(pad, 0.5)
    near = np.abs(foot.height_m) <= _MAX_HEIGHT_M
    on = np.flatnonzero((np.abs(foot.fraction - 0.5) <= rim).all(axis=1) & near & (force > _MIN_FORCE_N))
    position = np.clip(foot.fraction[on], 0.0, 1.0)
    curvatures = np.broadcast_to(curvature, len(force_n))[on]
    return on, position, force[on], _hertz_radius_m(pad, position, force[on], curvatures)


def pad_discs(
    pad: MujocoPad, steps: IntArray, position: FloatArray, force: FloatArray, radius: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return discs (d,) of contact points (k,) on a pad, both in the order of steps: steps, positions,
    forces, radii."""
    equalised = _equalise_load(steps, position, force, radius)
    return clip_to_pad(pad, *_merge_overlapping(pad, *equalised))


def _equalise_load(
    steps: IntArray, position: FloatArray, force: FloatArray, radius: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Move points that represent a line or face towards their centre of force."""
    if not len(steps):
        return steps, position, force, radius
    total = np.bincount(steps, force)
    sums = np.stack([np.bincount(steps, force * along) for along in position.T], axis=1)
    centre = sums[steps] / total[steps][:, None]
    return steps, centre + _UNIFORM_LOAD_RATIO * (position - centre), force, radius


def _hertz_radius_m(
    pad: MujocoPad, position: FloatArray, force_n: FloatArray, other_curvature: FloatArray
) -> FloatArray:
    """Return radii (k,) of discs: a^3 = 3 F R / 4 E, where 1 / R is the sum of both mean curvatures."""
    curvature = np.zeros(len(force_n))
    if not pad.shape.flat:
        curvature = 0.5 / pad.shape.radius(position[:, 0] * pad.shape.length_m)
        if pad.shape.sphere_from_rad is not None:
            curvature = np.full(len(force_n), 1 / pad.shape.start_radius_m)
    total_curvature = np.maximum(curvature + other_curvature, 1.0)
    cube = 3 * force_n / (4 * _SKIN_MODULUS_PA * total_curvature)
    return np.asarray(np.clip(np.cbrt(cube), _MIN_RADIUS_M, _MAX_RADIUS_M))


def _merge_overlapping(
    pad: MujocoPad, steps: IntArray, position: FloatArray, force: FloatArray, radius: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Merge overlapping discs; rows are in the order of steps."""
    alone = np.ones(len(steps), np.bool_)
    same = np.flatnonzero(steps[1:] == steps[:-1])
    if not len(same):
        return steps, position, force, radius
    alone[same] = alone[same + 1] = False
    kept = [(int(steps[i]), position[i], force[i], radius[i]) for i in np.flatnonzero(alone)]
    for step in np.unique(steps[~alone]):
        rows = np.arange(*np.searchsorted(steps, [step, step + 1]))
        discs = [(position[i], float(force[i]), float(radius[i])) for i in rows]
        kept += [(int(step), *disc) for disc in _merge_discs(pad, discs)]
    kept.sort(key=lambda disc: disc[0])
    numbers, positions, forces, radii = zip(*kept, strict=True)
    return np.array(numbers, np.intp), np.array(positions), np.array(forces), np.array(radii)


def clip_to_pad(
    pad: MujocoPad, steps: IntArray, position: FloatArray, force: FloatArray, radius: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Clip uniform discs (k,) to the pad: each is cut by the nearest edges along x and y."""
    if not len(steps):
        return steps, position, force, radius
    sides = _side_lengths_m(pad, position[:, 0])
    inward = np.where(position < 0.5, 1.0, -1.0)
    depth = np.clip(
        (0.5 - np.abs(position - 0.5)) * sides / radius[:, None], 0.0, 1.0
    )  # depth of the centre, in radii
    part = 1 - (np.arccos(depth) - depth * np.sqrt(1 - depth**2)) / np.pi  # area of a disc cut by a chord
    shift = 2 / (3 * np.pi) * (1 - depth**2) ** 1.5 / part  # shift of its centroid, in radii
    radii = np.maximum(radius * np.sqrt(part.prod(axis=1)), _MIN_RADIUS_M)
    return steps, position + inward * shift * radius[:, None] / sides, force, radii


Disc = tuple[FloatArray, float, float]


def _merge_discs(pad: MujocoPad, discs: list[Disc]) -> list[Disc]:
    """Merge the discs of one step until none overlap."""
    done: list[Disc] = []
    while discs:
        one = discs.pop()
        touching = (k for k, other in enumerate(discs) if _distance_m(pad, one, other) < one[2] + other[2])
        near = next(touching, None)
        if near is None:
            done.append(one)
        else:
            discs.append(_combine_discs(pad, one, discs.pop(near)))
    return done


def _combine_discs(pad: MujocoPad, one: Disc, other: Disc) -> Disc:
    """Return a disc with the force, centre and second moment of two; a uniform disc's is F a^2 / 2."""
    force = one[1] + other[1]
    centre = (one[0] * one[1] + other[0] * other[1]) / force
    middle = centre, force, 0.0
    moment = sum(disc[1] * (disc[2] ** 2 / 2 + _distance_m(pad, disc, middle) ** 2) for disc in (one, other))
    return centre, force, float(np.sqrt(2 * moment / force))


def _distance_m(pad: MujocoPad, one: Disc, other: Disc) -> float:
    along, around = (one[0] - other[0]) * _side_lengths_m(pad, 0.5 * (one[0][0] + other[0][0]))
    return float(np.hypot(along, around))


def _side_lengths_m(pad: MujocoPad, x: FloatArray | float) -> FloatArray:
    """Return metres per unit of the fractions (..., 2), at x (...)."""
    across = np.asarray(pad.shape.arc * pad.shape.radius(np.asarray(x) * pad.shape.length_m))
    return np.stack([np.full(across.shape, pad.shape.length_m), across], axis=-1)


def _set_resultants(patches: ContactPatches, grasp: GraspRecord) -> None:
    patches.total_n[:] = patches.force_n.sum(2)
    on = patches.total_n > 0
    weight = patches.force_n[on] / patches.total_n[on][:, None]
    patches.force_centre[on] = (weight[:, :, None] * patches.position[on]).sum(1)
    sides = np.array([_side_lengths_m(pad, 0.5) for pad in grasp.pads])[np.nonzero(on)[1]]
    off_m = (patches.position[on] - patches.force_centre[on][:, None]) * sides[:, None]
    moment = weight * (patches.radius_m[on] ** 2 / 2 + (off_m**2).sum(2))
    patches.effective_radius_m[on] = np.sqrt(2 * moment.sum(1))


def _force_fraction_off_pad(grasp: GraspRecord, on_pads: IntArray) -> float:
    """Return the fraction of all force magnitudes on the hand that no pad senses."""
    size = np.linalg.norm(grasp.force_n, axis=1)
    return float(1 - size[on_pads].sum() / size.sum()) if len(size) else 0.0
