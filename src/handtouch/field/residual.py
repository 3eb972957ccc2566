"""Test of the residual of a point fit: does the contact deviate from a point, and along which axis?

Public names: `point_test` -> `PointTest` (score, axis and extent of the deviation).

Four currents determine three unknowns, so in units of noise the misfit of a point has one free direction: the
left null vector of the Jacobian of the fit. Along it the misfit is a standard normal number, the score. A
contact with second moments M adds (M_xx - M_yy) f_xx / 2 + M_xy f_xy to each fraction f (which is harmonic),
so the score sees one combination of them: elongation along one axis against elongation across it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from handtouch.field.estimate import BoolArray, PointEstimate, estimate
from handtouch.field.model import FloatArray, ForwardModel, channel_noise

_DIFFERENCE_STEP = 1e-4  # step of the second derivatives over the distance to the nearest edge


@dataclass(frozen=True)
class PointTest:
    """Result of a point test; arrays of one shape (...), or scalars.

    score: a standard normal number for a point contact; large otherwise.

    is_point: True if |score| is below the threshold of the requested false-alarm rate.

    axis: direction of elongation [rad] from x towards y, in (-pi / 2, pi / 2]. Elongation across it would
    have the opposite score; elongation at 45 degrees to it has no effect.

    extent: distance, in the unit of the pad, of two equal contacts along `axis` with this score; the smallest
    that explains it.

    residual_std: standard deviation of the residual (excess of x0 + xa per total) of a point there.
    """

    score: FloatArray
    is_point: BoolArray
    axis: FloatArray
    extent: FloatArray
    residual_std: FloatArray


def point_test(
    model: ForwardModel,
    currents: ArrayLike,
    noise: ArrayLike,
    false_alarm: float = 1e-3,
    found: PointEstimate | None = None,
) -> PointTest:
    """Test whether `currents` (4, ...) with standard deviations `noise` come from point contacts.

    false_alarm: probability that a true point fails, 0 < false_alarm < 1, both signs together. found:
    estimates of the same currents, if available. A score is NaN where the estimate is, and `is_point` is then
    True. Raises ValueError for an impossible false-alarm rate, or a model with other channels.
    """
    threshold = _score_threshold(false_alarm)
    currents = np.asarray(currents, dtype=np.float64)
    if found is None:
        found = estimate(model, currents, noise)
    sigma = channel_noise(noise, currents.shape)
    with np.errstate(all="ignore"):
        direction = _MisfitDirection.at_point(
            model, np.asarray(found.x), np.asarray(found.y), np.asarray(found.total), sigma
        )
        score = np.einsum("...c,c...->...", direction.null, currents / sigma)
        sensitivity = np.hypot(direction.axial_sensitivity, direction.shear_sensitivity)
        axis = np.arctan2(direction.shear_sensitivity, direction.axial_sensitivity) / 2
        axis = np.where(score < 0, axis - math.pi / 2, axis)
        axis = np.where(axis <= -math.pi / 2, axis + math.pi, axis)
        extent = np.sqrt(4 * np.abs(score) / sensitivity)
    return PointTest(
        score[()], (~(np.abs(score) > threshold))[()], axis[()], extent[()], direction.residual_std[()]
    )


def _score_threshold(false_alarm: float) -> float:
    if not 0 < false_alarm < 1:
        raise ValueError(f"false_alarm = {false_alarm}: a rate lies between 0 and 1")
    return -NormalDist().inv_cdf(false_alarm / 2)


@dataclass(frozen=True)
class _MisfitDirection:
    """Observable direction of the misfit of a point fit, at one point of each element; arrays (...).

    null: (..., 4), the unit vector of whitened currents that no point contact there changes, positive in x0 +
    xa. axial_sensitivity, shear_sensitivity: score per unit of M_xx - M_yy, and of 2 M_xy. residual_std: of
    the residual.
    """

    null: FloatArray
    axial_sensitivity: FloatArray
    shear_sensitivity: FloatArray
    residual_std: FloatArray

    @classmethod
    def at_point(
        cls, model: ForwardModel, x: FloatArray, y: FloatArray, total: FloatArray, sigma: FloatArray
    ) -> _MisfitDirection:
        f, jacobian = model.fractions_with_jacobian(x, y)
        if len(f) != 4:
            raise ValueError(f"the model has {len(f)} channels: the test needs four")
        columns = np.concatenate([f[:, None], jacobian], axis=1) / sigma[:, None]
        columns = np.moveaxis(columns, (0, 1), (-2, -1))
        null = _left_null_vector(columns / np.linalg.norm(columns, axis=-2, keepdims=True))
        excess = np.moveaxis(sigma, 0, -1)[..., :2] * null[..., :2]
        sign = np.sign(excess.sum(axis=-1))
        null = null * sign[..., None]
        step = _DIFFERENCE_STEP * np.minimum(np.minimum(x, model.a - x), np.minimum(y, model.b - y))
        ahead = model.fractions_with_jacobian(x + step, y)[1]
        behind = model.fractions_with_jacobian(x - step, y)[1]
        second = (ahead - behind) / (2 * step) / sigma[:, None] * total
        by_xx, by_xy = np.einsum("...c,cd...->d...", null, second)
        return cls(null, by_xx / 2, by_xy / 2, np.abs(excess.sum(axis=-1)) / total)


def _left_null_vector(columns: FloatArray) -> FloatArray:
    """Unit vector orthogonal to three columns, (..., 4, 3) to (..., 4); NaN for NaN."""
    known = np.asarray(np.isfinite(columns).all(axis=(-2, -1)))
    safe: FloatArray = np.where(known[..., None, None], columns, 0.0)
    q = np.linalg.qr(safe, mode="complete").Q
    return np.where(known[..., None], q[..., :, 3], np.nan)
