"""Wrenches of contacts and the grasp matrix, from positions, normals and forces.

A touch pad measures the normal force only: friction is part of the wrenches of contacts above shear pads.
Public names: `Wrench`, `GraspMatrix`, `contact_wrenches`, `sum_wrenches`, `grasp_matrix`, `turn_covariance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from handtouch.arrays import FloatArray

_MIN_TANGENTIAL_N = 1e-6


@dataclass(frozen=True)
class Wrench:
    """Force and moment that contacts exert on the hand, about the origin of a frame."""

    force_n: FloatArray
    """(3,) [N], against the outward normal of a pad, with the tangential force above a shear pad"""
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
    vector_n: FloatArray | None = None,
    vector_covariance_n2: FloatArray | None = None,
) -> list[Wrench]:
    """Return the wrenches of n contacts.

    position_m, normal: (n, 3). covariance_m2: (n, 3, 3) of the positions. force_n, force_std_n: (n,).
    vector_n: (n, 3), vector_covariance_n2: (n, 3, 3), force vectors above shear pads, in place of the normal
    forces; NaN where they aren't known. First order; the normal counts as exact.
    """
    force: FloatArray = -normal * force_n[:, None]
    spread: FloatArray = force_std_n[:, None, None] ** 2 * normal[:, :, None] * normal[:, None, :]
    if vector_n is not None and vector_covariance_n2 is not None:
        known = np.isfinite(np.concatenate([vector_n, vector_covariance_n2.reshape(-1, 9)], axis=1)).all(
            axis=1
        )
        force[known], spread[known] = vector_n[known], vector_covariance_n2[known]
    moment = np.cross(position_m, force)
    # d moment = position x d force - force x d position
    by_force = np.concatenate([np.tile(np.eye(3), (len(force), 1, 1)), cross_matrix(position_m)], axis=1)
    covariance = by_force @ spread @ by_force.transpose(0, 2, 1)
    lever = cross_matrix(force)
    covariance[:, 3:, 3:] += lever @ covariance_m2 @ lever.transpose(0, 2, 1)
    return [
        Wrench(*parts) for parts in zip(force, moment, covariance, position_m.astype(np.float64), strict=True)
    ]


def sum_wrenches(wrenches: Sequence[Wrench], missing: tuple[str, ...] = ()) -> Wrench:
    """Return the sum of wrenches about one origin; NaN if any is missing."""
    if missing:
        unknown = np.full(3, np.nan)
        return Wrench(unknown, unknown.copy(), np.full((6, 6), np.nan), None, missing)
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
    basis = _axes(normal, np.zeros_like(normal)).transpose(0, 2, 1)  # (n, 3 directions, 3)
    moments = np.cross(position_m[:, None, :], basis)
    return np.asarray(np.concatenate([basis, moments], axis=2).reshape(-1, 6).T)


def turn_covariance(
    covariance_n2: FloatArray, normal: FloatArray, vector_n: FloatArray, to: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return covariances (n, 3, 3) of force vectors in another frame, in which normal and vector are `to`.

    normal, vector_n: (n, 3) in their own frame; they determine the rotation. Where the force has no
    tangential part, its direction in the tangent plane is arbitrary.
    """
    turn = _axes(*to) @ _axes(normal, vector_n).transpose(0, 2, 1)
    return np.asarray(turn @ covariance_n2 @ turn.transpose(0, 2, 1))


def _axes(normal: FloatArray, vector: FloatArray) -> FloatArray:
    """Return rotations (n, 3, 3) whose columns are the normal, the vector's tangent and the third axis."""
    tangent = vector - normal * (normal * vector).sum(axis=1, keepdims=True)
    size = np.linalg.norm(tangent, axis=1, keepdims=True)
    other = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    tangent = np.where(size > _MIN_TANGENTIAL_N, tangent, other)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([normal, tangent, np.cross(normal, tangent)], axis=2)


def cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) that map w to v x w, of vectors v (n, 3)."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)).transpose(0, 2, 1))
