"""Compliance of the contacts that hold an object, given only the motion of their links.

The object is a rigid body on sticking contacts, each a spring along its normal: link displacement = rigid
motion + compliance x force. Unknown are the six numbers of the motion and one compliance per contact; those
of one object are alike within a factor. Solved by least squares; a contact that slides after all is
down-weighted (Student's t). Errors from rolling and from the contact position grow with the rotation of the
link against the object.

Public names: `estimate_compliance`, `rigid_motion_jacobian`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_LEVER_ARM_STD_M = 5e-3  # error of the contact position, where its link rotates against the object
_SLIP_FRACTION_STD = 0.15  # of how object_motion links link_motion: what doesn't stick, by share of it
_UNKNOWN_STD_M = 0.1
_OBJECT_TRANSLATION_STD_M, _OBJECT_ROTATION_STD_RAD = 5e-3, 0.2  # prior of the object's motion
_COMPLIANCE_RELATIVE_STD = 0.5  # between contacts of one object
_MIN_COMPLIANCE_M_PER_N, _MAX_COMPLIANCE_M_PER_N = 1e-5, 0.1  # of a contact
_MIN_REDUCED_CHI2 = 1.7  # lower bound of chi^2 per degree of freedom: errors of contacts are correlated
_ITERATIONS = 6
_STUDENT_T_DOF = 3.0


def rigid_motion_jacobian(frames: FloatArray, places: FloatArray) -> FloatArray:
    """Return displacements (3m, 6) of positions (m, 3) on a rigid body, along the rows of frames (m, 3, 3).

    Per unit of each of its three translations and three rotations.
    """
    x, y, z = places.T
    rows = np.zeros((len(places), 3, 6))
    rows[:, [0, 1, 2], [0, 1, 2]] = 1.0
    rows[:, 0, 4], rows[:, 0, 5], rows[:, 1, 3] = z, -y, -z
    rows[:, 1, 5], rows[:, 2, 3], rows[:, 2, 4] = x, y, -x
    return np.asarray((frames @ rows).reshape(-1, 6))


def estimate_compliance(
    link_motion: FloatArray,
    force: FloatArray,
    motion_jacobian: FloatArray,
    rotation: FloatArray,
    std: FloatArray,
) -> tuple[FloatArray, float, float, float]:
    """Estimate the mean compliance of the contacts of one object.

    Returns the weights (m, 3) of displacements that add up to that compliance [m/N], the compliance, its
    standard deviation, and the object's displacement at the contacts (root mean square).

    link_motion, std: (m, 3) displacement of each link along its normal and two perpendicular directions, and
    its deviation from the model; force: (m,) increase of each force, NaN where unknown; motion_jacobian: (3m,
    6), `rigid_motion_jacobian`; rotation: (m, 3) rotation vectors of the links [rad], NaN where unknown.
    """
    m = len(link_motion)
    springs = np.zeros((m, 3, m))
    known_force = np.isfinite(force)
    springs[np.arange(m), 0, np.arange(m)] = np.where(known_force, force, 0.0)
    design = np.concatenate([motion_jacobian, springs.reshape(-1, m)], axis=1)
    aim = np.concatenate([np.zeros(6), known_force / known_force.sum()])
    prior = np.zeros((6 + m, 6 + m))
    prior[:6, :6] = np.diag([_OBJECT_TRANSLATION_STD_M**-2] * 3 + [_OBJECT_ROTATION_STD_RAD**-2] * 3)
    apart = np.eye(m) - 1 / m
    off = _SLIP_FRACTION_STD**2 * float((link_motion**2).sum()) / m
    slack, turns, unsure, compliance = np.ones(m), np.zeros(3), np.zeros((3, 3)), 0.0
    normals = motion_jacobian.reshape(m, 3, 6)[:, 0, :3]  # rotations about them move no contact
    known = np.isfinite(rotation).all(axis=1)
    for _ in range(_ITERATIONS):
        about = np.cross(rotation - turns, normals)
        open_turns = np.trace(unsure) - np.einsum("mi,ij,mj->m", normals, unsure, normals)
        rolls = np.where(known, _LEVER_ARM_STD_M**2 * ((about**2).sum(axis=1) + open_turns), 0.0)
        variance = std**2 + rolls[:, None] + off
        variance[~known_force, 0] = _UNKNOWN_STD_M**2
        variance *= slack[:, None]
        weighted = design.T / variance.ravel()
        prior[6:, 6:] = (
            apart / (_COMPLIANCE_RELATIVE_STD * max(compliance, _MIN_COMPLIANCE_M_PER_N)) ** 2
            + (m * _MAX_COMPLIANCE_M_PER_N) ** -2
        )
        covariance = np.linalg.inv(weighted @ design + prior)
        found = covariance @ (weighted @ link_motion.ravel())
        turns, unsure, compliance = found[3:6], covariance[3:6, 3:6], float(aim @ found)
        left = (link_motion.ravel() - design @ found).reshape(m, 3)
        slips = (left[:, 1:] ** 2).sum(axis=1) / (variance[:, 1] / slack)
        slack = np.maximum((slips + _STUDENT_T_DOF) / (2 + _STUDENT_T_DOF), 1.0)
    chi2 = float((left**2 / variance).sum() + found[6:] @ prior[6:, 6:] @ found[6:])
    inflation = max(chi2 / max(3 * m - 7, 1), _MIN_REDUCED_CHI2)
    weights = (aim @ covariance @ weighted).reshape(m, 3)
    object_motion = float(np.sqrt(((motion_jacobian @ found[:6]) ** 2).sum() / m))
    return weights, compliance, float(np.sqrt(aim @ covariance @ aim * inflation)), object_motion
