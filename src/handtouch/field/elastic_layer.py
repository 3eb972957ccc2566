"""Elastic layer under the skin of a shear pad: displacement to tangential force, and its calibration.

Public names: `ElasticLayer` -> `TangentialForce`; `calibrate_layer`. Derivation and limits: docs/shear.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray


@dataclass(frozen=True)
class TangentialForce:
    """Tangential force (2, ...) [N] on the pad, in its frame, with its covariance (..., 2, 2)."""

    vector_n: FloatArray
    covariance_n2: FloatArray


@dataclass(frozen=True)
class ElasticLayer:
    """Elastic layer with friction between the upper pattern and the link: displacement to tangential force.

    stiffness_n_per_m: along x and y. stiffness_std: relative error of both together; axis_std: of each by
    itself. hysteresis: half-width of the loop as a fraction of its greatest force. zero_std_n: of each
    component at rest. Raises ValueError for stiffnesses that aren't positive.
    """

    stiffness_n_per_m: tuple[float, float]
    stiffness_std: float = 0.1
    axis_std: float = 0.02
    hysteresis: float = 0.05
    zero_std_n: float = 0.01

    def __post_init__(self) -> None:
        if not min(self.stiffness_n_per_m) > 0:
            raise ValueError(f"stiffness_n_per_m must be positive, got {self.stiffness_n_per_m}")

    def force(
        self,
        displacement_m: npt.ArrayLike,
        covariance_m2: npt.ArrayLike = 0.0,
        peak_n: npt.ArrayLike | None = None,
    ) -> TangentialForce:
        """Return the force at a displacement (2, ...) from the tared position.

        The loop is widest without force, and half as wide at its greatest force.

        covariance_m2: of it, (..., 2, 2). peak_n: greatest force since the tare (...), the width of the loop;
        default: the force itself, of a load that only grew.
        """
        stiffness = np.array(self.stiffness_n_per_m)
        moved = np.asarray(displacement_m, np.float64)
        force = stiffness.reshape(2, *[1] * (moved.ndim - 1)) * moved
        size = np.hypot(force[0], force[1])
        peak = size if peak_n is None else np.maximum(np.asarray(peak_n, np.float64), size)
        rows = np.moveaxis(force, 0, -1)
        covariance = np.outer(stiffness, stiffness) * np.asarray(covariance_m2, np.float64)
        covariance = covariance + self.stiffness_std**2 * rows[..., :, None] * rows[..., None, :]
        diagonal = (self.axis_std * rows) ** 2 + self.zero_std_n**2
        loop = self.hysteresis * (peak - size / 2)
        diagonal = diagonal + loop[..., None] ** 2 / 3
        return TangentialForce(force, covariance + diagonal[..., None] * np.eye(2))


def calibrate_layer(
    displacements_m: npt.ArrayLike,
    forces_n: npt.ArrayLike,
    force_std: float,
    hysteresis: float = 0.05,
    zero_std_n: float = 0.01,
    released_m: npt.ArrayLike | None = None,
) -> ElasticLayer:
    """Return the layer that explains displacements (2, n) under known tangential forces (2, n).

    Least squares of displacement over force for each axis. force_std: relative error of the references,
    common to all. axis_std is that of the fit, from its scatter and at least from the loop's width at its
    greatest force. released_m: displacements (2, n) after each load was taken off, which are the half-width
    of the pad's own loop; else `hysteresis` is kept. Raises ValueError unless each axis has two loads or
    more.
    """
    moved, force = np.asarray(displacements_m, np.float64), np.asarray(forces_n, np.float64)
    size = np.abs(force)
    used = size > 0.1 * size.max()
    if (used.sum(axis=1) < 2).any():
        raise ValueError("each axis needs two loads or more, best in both directions")
    weight = np.where(used, force, 0.0)
    compliance = (moved * weight).sum(axis=1) / (force * weight).sum(axis=1)
    if released_m is not None:
        left_n = np.asarray(released_m, np.float64) / compliance[:, None]
        hysteresis = float(np.sqrt(np.mean((left_n**2).sum(axis=0) / (force**2).sum(axis=0))))
    off = np.where(used, moved / compliance[:, None] - force, 0.0)
    spread = np.sqrt((off**2).sum(axis=1) / (used.sum(axis=1) - 1))
    loop = hysteresis * size.max(axis=1) / 2 / np.sqrt(3)
    axis_std = np.maximum(spread, loop) / np.sqrt((weight**2).sum(axis=1))
    x, y = (1 / compliance).tolist()
    return ElasticLayer((x, y), force_std, float(axis_std.max()), hysteresis, zero_std_n)
