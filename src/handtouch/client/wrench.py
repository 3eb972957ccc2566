"""Wrenches of contacts and the grasp matrix, from positions, normals and normal forces.

A pad measures the normal force only: friction isn't part of any wrench. Public names: `Wrench`,
`GraspMatrix`, `contact_wrenches`, `sum_wrenches`, `grasp_matrix`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Wrench:
    """Force and moment that contacts exert on the hand, about the origin of a frame."""

    force_n: FloatArray
    """(3,) [N], against the outward normal of a pad"""
    moment_nm: FloatArray
    """(3,) [N m], about the frame's origin"""
    covariance: FloatArray
    """(6, 6) of force and moment [N^2, N^2 m, N^2 m^2], from those of forces
    and positions; contacts count as independent"""
    point_m: FloatArray | None
    """(3,) [m] contact position; None for a sum"""
    missing: tuple[str, ...] = ()
    """links that aren't included: without a valid sample, or a contact without valid force or position"""


class GraspMatrix(NamedTuple):
    """Contact forces to the wrench on the object."""

    matrix: FloatArray
    """(6, 3 k): of each contact the outward normal of the pad, and two tangents"""
    links: tuple[str, ...]
    """the k links"""


def contact_wrenches(
    position_m: FloatArray,
    normal: FloatArray,
    covariance_m2: FloatArray,
    force_n: FloatArray,
    force_std_n: FloatArray,
) -> list[Wrench]:
    """Return the wrenches of n contacts.

    position_m, normal: (n, 3). covariance_m2: (n, 3, 3) of the positions. force_n, force_std_n: (n,). First
    order; the normal counts as exact.
    """
    force = -normal * force_n[:, None]
    moment = np.cross(position_m, force)
    # d moment = position x d force - force x d position
    unit = np.concatenate([-normal, np.cross(position_m, -normal)], axis=1)  # (n, 6) per newton
    covariance = force_std_n[:, None, None] ** 2 * unit[:, :, None] * unit[:, None, :]
    lever = cross_matrix(force)
    covariance[:, 3:, 3:] += lever @ covariance_m2 @ lever.transpose(0, 2, 1)
    return [
        Wrench(*parts) for parts in zip(force, moment, covariance, position_m.astype(np.float64), strict=True)
    ]


def sum_wrenches(wrenches: Sequence[Wrench], missing: tuple[str, ...] = ()) -> Wrench:
    """Return the sum of wrenches about one origin."""
    return Wrench(
        sum((w.force_n for w in wrenches), np.zeros(3)),
        sum((w.moment_nm for w in wrenches), np.zeros(3)),
        sum((w.covariance for w in wrenches), np.zeros((6, 6))),
        None,
        missing,
    )


def grasp_matrix(position_m: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the matrix (6, 3 n) from forces at n contacts to the wrench on the object.

    position_m, normal: (n, 3) contact positions and outward unit normals of the pads, which push along them.
    A contact's three columns are unit forces along the normal and two tangents that complete a right-handed
    frame.
    """
    axes = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, axes)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    basis = np.stack([normal, first, np.cross(normal, first)], axis=1)  # (n, 3 directions, 3)
    moments = np.cross(position_m[:, None, :], basis)
    return np.asarray(np.concatenate([basis, moments], axis=2).reshape(-1, 6).T)


def cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) that map w to v x w, of vectors v (n, 3)."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)).transpose(0, 2, 1))
