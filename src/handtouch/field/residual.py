"""More than a point: what the one number left over by a fit says about the shape of a contact.

Public: `point_test` (is it a point, and if not, elongated along which axis, by how much) and
`resolvable_separation` (how far apart two equal contacts must be to be told from one).

Four currents fix three unknowns, so in units of noise the misfit of a point has one free direction: the left
null vector of the Jacobian of the fit. Along it the misfit is a standard normal number, the score. A contact
with second moments M adds (M_xx - M_yy) f_xx / 2 + M_xy f_xy to each fraction f (which is harmonic), so the
score sees one combination of them: elongation along one axis against elongation across it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from handtouch.field.estimate import BoolArray, PointEstimate, estimate
from handtouch.field.model import FloatArray, ForwardModel, channel_noise

_DIFFERENCE = 1e-4  # of the distance to the nearest edge: step of the second derivatives
_BISECTIONS = 24


@dataclass(frozen=True)
class PointTest:
    """Whether contacts are points; arrays of one shape (...), or scalars.

    score: a standard normal number for a point contact; large where it is something else.
    is_point: whether |score| stays under the threshold of the false-alarm rate asked for.
    axis: direction of elongation [rad] from x towards y, in (-pi / 2, pi / 2]. Elongation across it would
        push the score the other way; elongation at 45 degrees to it is not seen.
    extent: distance, in the unit of the pad, of two equal contacts along `axis` with this score; the least
        that explains it.
    deviation: standard deviation of the residual (excess of x0 + xa per total) of a point there.
    """

    score: FloatArray
    is_point: BoolArray
    axis: FloatArray
    extent: FloatArray
    deviation: FloatArray


def point_test(
    model: ForwardModel,
    currents: ArrayLike,
    noise: ArrayLike,
    false_alarm: float = 1e-3,
    found: PointEstimate | None = None,
) -> PointTest:
    """Return whether `currents` (4, ...) with standard deviations `noise` come from point contacts.

    false_alarm: the part of true points that may fail, 0 < false_alarm < 1, both signs together. found: the
    estimates of the same currents, if there are any yet. A score is NaN where the estimate is, and then
    nothing speaks against a point: `is_point` is True.
    Raises ValueError for a false-alarm rate that cannot be, or a model with other channels.
    """
    threshold = _threshold(false_alarm)
    currents = np.asarray(currents, dtype=np.float64)
    if found is None:
        found = estimate(model, currents, noise)
    sigma = channel_noise(noise, currents.shape)
    with np.errstate(all="ignore"):
        view = _View.at(model, np.asarray(found.x), np.asarray(found.y), np.asarray(found.total), sigma)
        score = np.einsum("...c,c...->...", view.null, currents / sigma)
        strength = np.hypot(view.plain, view.skew)
        axis = np.arctan2(view.skew, view.plain) / 2
        axis = np.where(score < 0, axis - math.pi / 2, axis)
        axis = np.where(axis <= -math.pi / 2, axis + math.pi, axis)
        extent = np.sqrt(4 * np.abs(score) / strength)
    return PointTest(score[()], (~(np.abs(score) > threshold))[()], axis[()], extent[()], view.deviation[()])


def resolvable_separation(
    model: ForwardModel,
    x: ArrayLike,
    y: ArrayLike,
    noise: ArrayLike,
    angle: float = 0.0,
    false_alarm: float = 1e-3,
    detection: float = 0.9,
) -> FloatArray:
    """Return how far apart two equal contacts centred at (x, y) must be to be told from one, shape (...).

    noise: standard deviations of the channels, per total current, broadcastable against (4, ...). angle: of
    the line through them, from x towards y [rad]. They are told from one with probability `detection` by
    `point_test` at `false_alarm`. Infinite where they would have to leave the pad first.
    """
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    wanted = _threshold(false_alarm) + NormalDist().inv_cdf(detection)
    direction = math.cos(angle), math.sin(angle)
    with np.errstate(all="ignore"):
        room = [
            np.where(d != 0, np.minimum(p, side - p) / abs(d), np.inf)
            for p, side, d in ((x, model.a, direction[0]), (y, model.b, direction[1]))
        ]
        longest = 2 * np.minimum(*room) * (1 - 1e-9)
        sigma = channel_noise(noise, (4, *x.shape))

        def score(distance: FloatArray) -> FloatArray:
            half = [distance / 2 * d for d in direction]
            pair = model.fractions(x - half[0], y - half[1]) + model.fractions(x + half[0], y + half[1])
            found = estimate(model, pair / 2, sigma, start=(x, y))
            return np.sqrt(np.asarray(found.chi_squared))

        low, high = np.zeros(x.shape), longest
        reachable = score(longest) >= wanted
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            enough = score(middle) >= wanted
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return np.where(reachable, high, np.inf)[()]


def _threshold(false_alarm: float) -> float:
    if not 0 < false_alarm < 1:
        raise ValueError(f"false_alarm = {false_alarm}: a rate lies between 0 and 1")
    return -NormalDist().inv_cdf(false_alarm / 2)


@dataclass(frozen=True)
class _View:
    """What the misfit of a point fit can see at one point of each element; arrays (...).

    null: (..., 4), the unit vector of whitened currents that no point contact there moves, positive in
    x0 + xa. plain, skew: score per unit of M_xx - M_yy, and of 2 M_xy. deviation: of the residual.
    """

    null: FloatArray
    plain: FloatArray
    skew: FloatArray
    deviation: FloatArray

    @classmethod
    def at(
        cls, model: ForwardModel, x: FloatArray, y: FloatArray, total: FloatArray, sigma: FloatArray
    ) -> _View:
        f, jacobian = model.fractions_with_jacobian(x, y)
        if len(f) != 4:
            raise ValueError(f"the model has {len(f)} channels: one number is left over of four")
        columns = np.concatenate([f[:, None], jacobian], axis=1) / sigma[:, None]
        columns = np.moveaxis(columns, (0, 1), (-2, -1))
        null = _left_null(columns / np.linalg.norm(columns, axis=-2, keepdims=True))
        excess = np.moveaxis(sigma, 0, -1)[..., :2] * null[..., :2]
        sign = np.sign(excess.sum(axis=-1))
        null = null * sign[..., None]
        step = _DIFFERENCE * np.minimum(np.minimum(x, model.a - x), np.minimum(y, model.b - y))
        ahead = model.fractions_with_jacobian(x + step, y)[1]
        behind = model.fractions_with_jacobian(x - step, y)[1]
        second = (ahead - behind) / (2 * step) / sigma[:, None] * total
        by_xx, by_xy = np.einsum("...c,cd...->d...", null, second)
        return cls(null, by_xx / 2, by_xy / 2, np.abs(excess.sum(axis=-1)) / total)


def _left_null(columns: FloatArray) -> FloatArray:
    """Unit vector orthogonal to three columns, (..., 4, 3) to (..., 4); NaN for NaN."""
    known = np.asarray(np.isfinite(columns).all(axis=(-2, -1)))
    safe: FloatArray = np.where(known[..., None, None], columns, 0.0)
    q = np.linalg.qr(safe, mode="complete").Q
    return np.where(known[..., None], q[..., :, 3], np.nan)
