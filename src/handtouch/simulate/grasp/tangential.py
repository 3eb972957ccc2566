"""Tangential and normal forces of a simulated grasp on each pad.

Public names: `PadForces`, `pad_forces`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.simulate.grasp.simulation import GraspRecord


@dataclass(frozen=True)
class PadForces:
    """Forces on one pad over time: tangential (2, n) along its x and y, and normal (n,) [N]."""

    tangential_n: FloatArray
    normal_n: FloatArray


def pad_forces(grasp: GraspRecord, row: int) -> PadForces:
    """Return MuJoCo's forces on a pad at each of the n steps, sums of those of its contacts."""
    pad, count = grasp.pads[row], len(grasp.times_s)
    mine = grasp.pad_row == row
    step = grasp.step_index[mine]
    rotation = grasp.link_rotation[step, row]
    on_link = np.einsum("kji,kj->ki", rotation, grasp.point_m[mine] - grasp.link_m[step, row])
    force = np.einsum("kji,kj->ki", rotation, grasp.force_n[mine]) @ pad.rotation
    foot = pad.shape.project((on_link - pad.translation_m) @ pad.rotation)
    inward = np.einsum("ki,ki->k", force, foot.normal)
    along = force - inward[:, None] * foot.normal
    across = np.cross(foot.normal, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    forward = np.cross(across, foot.normal)
    total = np.zeros((3, count))
    for k, values in enumerate(
        (np.einsum("ki,ki->k", along, forward), np.einsum("ki,ki->k", along, across), -inward)
    ):
        np.add.at(total[k], step, values)
    return PadForces(total[:2], total[2])
