"""Scores of contacts: what the currents of a point contact leave over, and what gains add to them.

Public: `ContactScores` of a batch of contacts; `score_slopes`; `elongation_error`; `gain_deviation` and
`fisher_covariance`, the Fisher bounds for a shape of pad and for given contacts; `gain_basis`,
`channel_count`, `UNKNOWNS`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.field.estimate import estimate
from handtouch.field.model import ChannelModel, ForwardModel, FractionModel, channel_noise
from handtouch.hand.pads import elongation_stds, pad_surface

UNKNOWNS = 3
"""Unknowns of a contact: position and total."""
_GRID_MARGIN = 0.1  # of a side
_DIFFERENCE_STEP = 0.01
"""Step of difference quotients, over a side: small beside the margin."""


@dataclass(frozen=True)
class ContactScores:
    """Linearisation of the s scores of each of n contacts around the gains that correct them.

    positions (2, n); score (n, s); score_slope (p, n, s): what a step of gains and parts adds to the scores;
    score_sensitivity (n, s): score per error of the fractions.
    """

    positions: FloatArray
    score: FloatArray
    score_slope: FloatArray
    score_sensitivity: FloatArray

    def scores_after(self, step: FloatArray) -> FloatArray:
        """Return the scores (n, s) after a step (p,) of gains and parts."""
        return np.asarray(self.score + np.tensordot(step, self.score_slope, axes=1))

    def information(self, precision: FloatArray) -> FloatArray:
        """Return the information (p, p) of scores of some precision (n, s)."""
        slope = self.score_slope.reshape(len(self.score_slope), -1)
        return np.asarray((slope * precision.ravel()) @ slope.T)

    @classmethod
    def linearise(
        cls,
        model: ForwardModel,
        parts: Sequence[FractionModel],
        currents: FloatArray,
        sigma: FloatArray,
        start: FloatArray | None,
    ) -> ContactScores:
        found = estimate(model, currents, sigma, start)
        positions = np.stack([found.x, found.y])
        known = np.isfinite(positions).all(axis=0)
        x, y = np.where(known, positions, [[model.a / 2], [model.b / 2]])
        total = np.where(known, found.total, 1.0)
        null, slope = score_slopes(model, x, y, sigma, total)
        if parts:
            nominal = model.fractions(x, y)
            by_part = np.zeros((len(parts), *nominal.shape))
            for change, part in zip(by_part, parts, strict=True):
                if part is not model:
                    change += part.fractions(x * (part.a / model.a), y * (part.b / model.b)) - nominal
            by_part = -np.einsum("ncs,pcn->pns", null, by_part * total / sigma)
            slope = np.concatenate([slope, by_part])
        score = np.einsum("ncs,cn->ns", null, currents / sigma)
        sensitivity = total[:, None] * np.linalg.norm(null / sigma.T[:, :, None], axis=1)
        is_point = np.asarray(np.isfinite(positions).all(axis=0))[:, None]
        return cls(np.stack([x, y]), np.where(is_point, score, 0.0), slope * is_point, sensitivity)


def elongation_error(pad: config.Pad, sheet: config.Sheet, model: ChannelModel) -> float:
    """Return the standard deviation of the fractions, as scores see it, of contacts as elongated as stated.

    Root mean square over the pad, `_GRID_MARGIN` of a side and farther from the edges. 0 for three channels.
    """
    at = np.linspace(_GRID_MARGIN, 1 - _GRID_MARGIN, 9)
    x, y = (grid.ravel() for grid in np.meshgrid(at * model.a, at * model.b))
    step = _DIFFERENCE_STEP * model.a
    # second derivatives (c, 2, n) by x x and x y; that by y y is minus the first, as fractions are harmonic
    after, before = (model.fractions_with_jacobian(along, y)[1] for along in (x + step, x - step))
    second = (after - before) / (2 * step)
    null, _ = score_slopes(model, x, y, np.ones((len(second), x.size)), np.ones(x.size))
    squares = (np.einsum("ncs,cjn->njs", null, second) ** 2).sum(axis=1)
    variances = elongation_stds(sheet, pad_surface(pad), model, x) ** 2
    return math.sqrt((squares * variances[:, None]).mean()) if squares.size else 0.0


def gain_deviation(model: ForwardModel, contacts: int = 400) -> float:
    """Return the Fisher bound: standard deviation of the least certain log gain, per noise / total.

    For `contacts` spread evenly over the pad, 10 % of a side and farther from the edges. Infinite for three
    channels.
    """
    if channel_count(model) <= UNKNOWNS:
        return math.inf
    at = 0.1 + 0.8 * (np.arange(20) + 0.5) / 20
    x, y = (grid.ravel() for grid in np.meshgrid(at * model.a, at * model.b))
    covariance = fisher_covariance(model, x, y, 1.0) * x.size / contacts
    return float(np.sqrt(np.diag(covariance).max()))


def fisher_covariance(model: ForwardModel, x: FloatArray, y: FloatArray, noise: ArrayLike) -> FloatArray:
    """Return the Fisher bound of the log gains, (c, c), of contacts at unknown positions x, y (n,).

    noise: of the channels as a part of each contact's total, as `channel_noise` takes it.
    """
    channels = channel_count(model)
    slope = score_slopes(model, x, y, channel_noise(noise, (channels, *x.shape)), np.ones(x.shape))[1]
    slope, basis = slope.reshape(len(slope), -1), gain_basis(channels)
    return np.asarray(basis @ np.linalg.pinv(slope @ slope.T, rcond=1e-14) @ basis.T)


def score_slopes(
    model: ForwardModel, x: FloatArray, y: FloatArray, sigma: FloatArray, total: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return left null vectors (n, c, c - 3) of fits at x, y (n,), and the slopes (c - 1, n, c - 3) of their
    scores by gains.

    The vectors of a contact are chosen so that equal errors of all fractions change the scores independently.
    """
    fractions, jacobian = model.fractions_with_jacobian(x, y)
    columns = np.moveaxis(np.concatenate([fractions[:, None], jacobian], axis=1) / sigma[:, None], 2, 0)
    columns = columns / np.linalg.norm(columns, axis=1, keepdims=True)
    null = np.linalg.qr(columns, mode="complete").Q[:, :, UNKNOWNS:]
    if null.shape[2] > 1:
        null = null @ np.linalg.svd(null / sigma.T[:, :, None])[2].transpose(0, 2, 1)
    by_channel = null * (total * fractions / sigma).T[:, :, None]
    return null, np.einsum("cp,ncs->pns", gain_basis(len(fractions)), by_channel)


def channel_count(model: FractionModel) -> int:
    """Return the number of channels of a model."""
    return len(model.fractions(model.a / 2, model.b / 2))


def gain_basis(channels: int) -> FloatArray:
    """Return orthonormal directions (c, c - 1) of log gains that sum to zero."""
    from scipy.linalg import helmert  # not loaded with the package

    return np.asarray(helmert(channels).T)
