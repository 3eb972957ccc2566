"""Evidence of contacts for one explanation of a pad: with or without a fault, within stated tolerances.

Public: `explain_contacts`, `Evidence`. The scores of contacts depend linearly on what the deployment file
doesn't know: gains, gaps, sides, resistors, unevenness of the sheet. Each is a parameter common to all
contacts, with its tolerance as prior, so that a healthy pad is explained by its tolerances as well as they
can, and a fault must explain its contacts better than that. Laplace's approximation, at the mode found by
expectation maximisation; contacts that are no points are a mixture component whose share is estimated, and so
is the scatter of points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.supervisor.diagnose.hypotheses import Scores

# Constants without an origin beside them were chosen; docs/benchmarks/diagnose.md and soak_alarms.md measure
# what they yield.
_ITERATIONS = 8
_NON_POINT_SHARE_RANGE = (0.1, 0.7)
"""Limits of its estimate, so that neither few nor many contacts decide alone."""
_MAX_SCATTER = 4.0
"""Standard deviation of scores of points, at most; at least 1."""
_LOG_NON_POINT_SPREAD = np.log(8.0)
"""Log range of each score of contacts that are no points; with the least share, it bounds what one
contact counts."""


class Evidence(NamedTuple):
    """Log evidence (h,) for h explanations, and the share (h,) of contacts that are no points under each."""

    nats: FloatArray
    non_point_share: FloatArray


def explain_contacts(found: Scores, weights: FloatArray, covariance: FloatArray) -> Evidence:
    """Return the evidence of k contacts of some weights (k,) for the h explanations that gave their scores.

    found: arrays (h, k, s), (h, k, s, t), (h, k). covariance: (h, t, t), of the parameters of the slopes.
    """
    r, slopes, rest = found
    precision = np.linalg.inv(covariance)
    flat = slopes.reshape(len(r), -1, slopes.shape[3])
    spread = 1 + np.einsum("hjt,hjt->hj", flat @ covariance, flat).reshape(
        r.shape
    )  # before anything is known
    theta, freedom = np.zeros((len(r), slopes.shape[3])), r.shape[2]
    share, scatter = np.full((len(r), 1), _NON_POINT_SHARE_RANGE[0]), np.ones((len(r), 1))
    for iteration in range(_ITERATIONS + 1):
        left = (r - (flat @ theta[:, :, None])[:, :, 0].reshape(r.shape)) ** 2
        variance = scatter[:, :, None] ** 2 * (spread if iteration == 0 else np.ones(r.shape))
        misfit = (left / variance + np.log(variance)).sum(axis=2) + rest / variance.mean(axis=2)
        log_point = np.log1p(-share) - 0.5 * misfit
        log_sum = np.logaddexp(log_point, np.log(share) - freedom * _LOG_NON_POINT_SPREAD)
        part = weights * np.exp(log_point - log_sum)
        points = part.sum(axis=1, keepdims=True)
        if iteration > 1:
            squares = (part * np.where(part > 0, left.sum(axis=2) + rest, 0.0)).sum(axis=1, keepdims=True)
            squares /= np.maximum(freedom * points, 1e-9)
            scatter = np.sqrt(np.clip(squares, 1.0, _MAX_SCATTER**2))
        share = np.clip(1 - points / weights.sum(), *_NON_POINT_SHARE_RANGE)
        weighted = (slopes * (part / scatter**2)[:, :, None, None]).reshape(flat.shape).transpose(0, 2, 1)
        information = precision + weighted @ flat
        if iteration < _ITERATIONS:
            theta = np.linalg.solve(information, weighted @ r.reshape(len(r), -1, 1))[:, :, 0]
    volume = 0.5 * (np.linalg.slogdet(precision)[1] - np.linalg.slogdet(information)[1])
    prior = 0.5 * np.einsum("ht,htu,hu->h", theta, precision, theta)
    return Evidence(log_sum @ weights - prior + volume, share[:, 0])
