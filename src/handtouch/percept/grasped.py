"""How the contacts that hold a thing give, when all that is known is how their links went.

The thing is a rigid body on contacts that stick, each a spring along its normal: went = rigid motion +
give x force, in which six numbers of the motion and a give of each contact are unknown. Those of one thing
are alike within a factor. Least squares; a contact that slides after all counts for less (Student's t). What
a contact makes up by rolling, and by not being where it is taken to be, goes with how its link turns against
the thing.

Public names: `gives`, `rigid`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_ARM_M = 5e-3  # by how far off a contact is taken to be, where its link turns against the thing
_OFF = 0.15  # of how far links went: what doesn't stick, by share of it
_UNKNOWN_M = 0.1
_MOVES_M, _TURNS_RAD = 5e-3, 0.2  # prior of the thing's motion
_ALIKE = 0.5  # relative deviation of how contacts of one thing give
_LEAST, _MOST = 1e-5, 0.1  # give of a contact [m/N]
_WORSE = 1.7  # chi^2 for a degree of freedom, at least: what contacts get wrong they get wrong together
_ROUNDS = 6
_LOOSE = 3.0  # degrees of freedom of Student's t


def rigid(frames: FloatArray, places: FloatArray) -> FloatArray:
    """Ways (3m, 6) of places (m, 3) on a body, along the rows of frames (m, 3, 3), for a unit of each of its
    three ways and three turns."""
    x, y, z = places.T
    rows = np.zeros((len(places), 3, 6))
    rows[:, [0, 1, 2], [0, 1, 2]] = 1.0
    rows[:, 0, 4], rows[:, 0, 5], rows[:, 1, 3] = z, -y, -z
    rows[:, 1, 5], rows[:, 2, 3], rows[:, 2, 4] = x, y, -x
    return np.asarray((frames @ rows).reshape(-1, 6))


def gives(
    went: FloatArray,
    force: FloatArray,
    moves: FloatArray,
    turned: FloatArray,
    std: FloatArray,
) -> tuple[FloatArray, float, float, float]:
    """Weights (m, 3) of ways which add up to a contact's mean give [m/N]; that give, its deviation, and how
    far the thing went at the contacts (root mean square).

    went, std (m, 3): how far each link went along its normal and two ways across, and within what a contact
    keeps to the model; force (m,): by how much each rose, NaN where that isn't known. moves (3m, 6): `rigid`.
    turned (m, 3): turns of the links [rad], NaN where they aren't known.
    """
    m = len(went)
    springs = np.zeros((m, 3, m))
    felt = np.isfinite(force)
    springs[np.arange(m), 0, np.arange(m)] = np.where(felt, force, 0.0)
    design = np.concatenate([moves, springs.reshape(-1, m)], axis=1)
    aim = np.concatenate([np.zeros(6), felt / felt.sum()])
    prior = np.zeros((6 + m, 6 + m))
    prior[:6, :6] = np.diag([_MOVES_M**-2] * 3 + [_TURNS_RAD**-2] * 3)
    apart = np.eye(m) - 1 / m
    off = _OFF**2 * float((went**2).sum()) / m
    slack, turns, unsure, give = np.ones(m), np.zeros(3), np.zeros((3, 3)), 0.0
    normals = moves.reshape(m, 3, 6)[:, 0, :3]  # turns about them move no contact
    known = np.isfinite(turned).all(axis=1)
    for _ in range(_ROUNDS):
        about = np.cross(turned - turns, normals)
        open_turns = np.trace(unsure) - np.einsum("mi,ij,mj->m", normals, unsure, normals)
        rolls = np.where(known, _ARM_M**2 * ((about**2).sum(axis=1) + open_turns), 0.0)
        variance = std**2 + rolls[:, None] + off
        variance[~felt, 0] = _UNKNOWN_M**2
        variance *= slack[:, None]
        weighted = design.T / variance.ravel()
        prior[6:, 6:] = apart / (_ALIKE * max(give, _LEAST)) ** 2 + (m * _MOST) ** -2
        covariance = np.linalg.inv(weighted @ design + prior)
        found = covariance @ (weighted @ went.ravel())
        turns, unsure, give = found[3:6], covariance[3:6, 3:6], float(aim @ found)
        left = (went.ravel() - design @ found).reshape(m, 3)
        slips = (left[:, 1:] ** 2).sum(axis=1) / (variance[:, 1] / slack)
        slack = np.maximum((slips + _LOOSE) / (2 + _LOOSE), 1.0)
    chi2 = float((left**2 / variance).sum() + found[6:] @ prior[6:, 6:] @ found[6:])
    worse = max(chi2 / max(3 * m - 7, 1), _WORSE)
    weights = (aim @ covariance @ weighted).reshape(m, 3)
    far = float(np.sqrt(((moves @ found[:6]) ** 2).sum() / m))
    return weights, give, float(np.sqrt(aim @ covariance @ aim * worse)), far
