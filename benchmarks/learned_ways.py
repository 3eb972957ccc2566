"""Ways to locate contacts and to estimate forces that are learned from labelled presses of one pad.

Public names: `Presses`, `LEARNERS`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize

FloatArray = NDArray[np.float64]
Predictor = Callable[[FloatArray], FloatArray]
"""From features (n, 4) to labels (n, 3)."""
MIN_FRACTION = 1e-4
"""Least fraction of a current whose logarithm is a feature"""
MIN_NOISE_RATIO = 1e-10  # variance of noise over that of the process
MAX_DEGREE, RIDGE = 6, 1e-10
HYPER_PRESSES = 256
"""Most presses by which the parameters of a Gaussian process are found"""
HIDDEN, DECAYS, STARTS, HELD_OUT = 16, (1e-6, 1e-4, 1e-2), 3, 4


@dataclass(frozen=True)
class Presses:
    """Contacts of a pad: currents (4, n) [A]; places x, y [m] and forces [N] (3, n)."""

    currents: FloatArray
    truth: FloatArray

    def first(self, count: int) -> Presses:
        return Presses(self.currents[:, :count], self.truth[:, :count])


def features(currents: FloatArray) -> FloatArray:
    """Return the logarithms of opposite currents' ratios, of the pairs' ratio and of the total (n, 4)."""
    total = np.maximum(currents.sum(axis=0), 1e-9)
    x0, xa, y0, yb = np.maximum(currents, MIN_FRACTION * total)
    return np.stack([np.log(xa / x0), np.log(yb / y0), np.log((x0 + xa) / (y0 + yb)), np.log(total)], axis=1)


def learned(fit: Callable[[FloatArray, FloatArray], Predictor], presses: Presses) -> Predictor:
    """Return the way that `fit` learns from standardised features and labels, of currents (4, n) to x, y and
    force (3, n)."""
    inputs = features(presses.currents)
    labels = np.concatenate([presses.truth[:2], np.log(presses.truth[2:])]).T
    middle, scale = inputs.mean(axis=0), inputs.std(axis=0) + 1e-12
    label_middle, label_scale = labels.mean(axis=0), labels.std(axis=0) + 1e-12
    low, high = inputs.min(axis=0), inputs.max(axis=0)
    predict = fit((inputs - middle) / scale, (labels - label_middle) / label_scale)

    def estimate(currents: FloatArray) -> FloatArray:
        given = np.clip(features(currents), low, high)  # no way extrapolates
        found = predict((given - middle) / scale) * label_scale + label_middle
        found[:, 2] = np.exp(found[:, 2])
        return np.ascontiguousarray(found.T)

    return estimate


def fit_polynomial(inputs: FloatArray, labels: FloatArray) -> Predictor:
    """Fit by least squares; the degree is that of the least error of presses left out one by one."""
    best: tuple[float, FloatArray, FloatArray] | None = None
    for degree in range(1, MAX_DEGREE + 1):
        powers = np.array([p for p in itertools.product(range(degree + 1), repeat=4) if sum(p) <= degree])
        if len(powers) > 0.8 * len(inputs):
            break
        design = _monomials(inputs, powers)
        inverse = np.linalg.pinv(design, rcond=RIDGE)
        weights, leverage = inverse @ labels, np.einsum("np,pn->n", design, inverse)
        left_out = (labels - design @ weights) / np.maximum(1 - leverage, 1e-6)[:, None]
        error = float(np.mean(left_out**2))
        if best is None or error < best[0]:
            best = error, powers, weights
    assert best is not None
    _, powers, weights = best
    return lambda given: _monomials(given, powers) @ weights


def _monomials(inputs: FloatArray, powers: NDArray[Any]) -> FloatArray:
    table = inputs[:, :, None] ** np.arange(powers.max() + 1)
    return np.asarray(np.prod([table[:, k][:, powers[:, k]] for k in range(inputs.shape[1])], axis=0))


def fit_gaussian_process(inputs: FloatArray, labels: FloatArray) -> Predictor:
    """Fit a line and a Gaussian process of squared-exponential covariance, of its own lengths for each label,
    by the marginal likelihood."""
    line = _monomials(inputs, np.vstack([np.zeros(4, np.int64), np.eye(4, dtype=np.int64)]))
    slopes, *_ = np.linalg.lstsq(line, labels, rcond=None)
    rest = labels - line @ slopes
    parts = []
    for column in rest.T:
        few = slice(0, HYPER_PRESSES)
        start = np.log([1.0] * 4 + [max(column.std(), 1e-6), 0.1 * max(column.std(), 1e-6)])
        bounds = [(-2.0, 5.0)] * 4 + [(-14.0, 3.0)] * 2
        found = minimize(
            _negative_likelihood, start, (inputs[few], column[few]), "L-BFGS-B", jac=True, bounds=bounds,
            options={"maxiter": 60},
        )  # fmt: skip
        lengths, signal, noise = np.exp(found.x[:4]), np.exp(found.x[4]), float(np.exp(found.x[5]))
        root = _root(_covariance(inputs, inputs, lengths, signal), noise)
        parts.append((lengths, signal, cho_solve((root, True), column)))

    def predict(given: FloatArray) -> FloatArray:
        mean = np.hstack([np.ones((len(given), 1)), given]) @ slopes
        rest = [_covariance(given, inputs, lengths, signal) @ w for lengths, signal, w in parts]
        return np.asarray(mean + np.stack(rest, axis=1))

    return predict


def _covariance(left: FloatArray, right: FloatArray, lengths: FloatArray, signal: float) -> FloatArray:
    left, right = left / lengths, right / lengths
    square = (left**2).sum(axis=1)[:, None] + (right**2).sum(axis=1) - 2 * left @ right.T
    return np.asarray(signal**2 * np.exp(-0.5 * np.maximum(square, 0.0)))


def _root(smooth: FloatArray, noise: float) -> FloatArray:
    """Return the Cholesky factor of a covariance with noise, of which rounding needs some."""
    least = MIN_NOISE_RATIO * smooth[0, 0]
    return np.asarray(cholesky(smooth + (noise**2 + least) * np.eye(len(smooth)), lower=True))


def _negative_likelihood(
    logs: FloatArray, inputs: FloatArray, column: FloatArray
) -> tuple[float, FloatArray]:
    lengths, signal, noise = np.exp(logs[:4]), float(np.exp(logs[4])), float(np.exp(logs[5]))
    smooth = _covariance(inputs, inputs, lengths, signal)
    root = _root(smooth, noise)
    weights = cho_solve((root, True), column)
    inner = np.outer(weights, weights) - cho_solve((root, True), np.eye(len(inputs)))
    slopes = [
        -0.5 * np.sum(inner * smooth * ((inputs[:, k, None] - inputs[:, k]) / lengths[k]) ** 2)
        for k in range(4)
    ]
    slopes += [-np.sum(inner * smooth), -np.trace(inner) * noise**2]
    return float(0.5 * column @ weights + np.log(np.diag(root)).sum()), np.array(slopes)


def fit_network(inputs: FloatArray, labels: FloatArray) -> Predictor:
    """Fit a network of two hidden layers of 16 units; a quarter of the presses chooses its weight decay and
    the best of three starts, then it is trained with all."""
    chosen = np.arange(len(inputs)) % HELD_OUT == 0
    best: tuple[float, float, FloatArray] | None = None
    for decay in DECAYS:
        for start in range(STARTS):
            weights = _train(inputs[~chosen], labels[~chosen], decay, _first_weights(start))
            error = float(np.mean((_forward(weights, inputs[chosen])[-1] - labels[chosen]) ** 2))
            if best is None or error < best[0]:
                best = error, decay, weights
    assert best is not None
    weights = _train(inputs, labels, best[1], best[2])
    return lambda given: _forward(weights, given)[-1]


_SHAPES = ((5, HIDDEN), (HIDDEN + 1, HIDDEN), (HIDDEN + 1, 3))
_ENDS = np.cumsum([0, *(rows * columns for rows, columns in _SHAPES)])


def _first_weights(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(0, rows**-0.5, rows * columns) for rows, columns in _SHAPES])


def _layers(weights: FloatArray) -> list[FloatArray]:
    return [
        weights[first:end].reshape(shape)
        for first, end, shape in zip(_ENDS, _ENDS[1:], _SHAPES, strict=False)
    ]


def _forward(weights: FloatArray, inputs: FloatArray) -> list[FloatArray]:
    """Return the values of all layers, inputs first."""
    first, second, last = _layers(weights)
    one = np.tanh(inputs @ first[:-1] + first[-1])
    two = np.tanh(one @ second[:-1] + second[-1])
    return [inputs, one, two, two @ last[:-1] + last[-1]]


def _train(inputs: FloatArray, labels: FloatArray, decay: float, weights: FloatArray) -> FloatArray:
    def loss(at: FloatArray) -> tuple[float, FloatArray]:
        values, layers = _forward(at, inputs), _layers(at)
        error = (values[-1] - labels) / len(inputs)
        slope, slopes = 2 * error, list[FloatArray]()
        for below, layer in zip(values[-2::-1], layers[::-1], strict=True):
            slopes.append(np.vstack([below.T @ slope, slope.sum(axis=0)]).ravel())
            slope = (slope @ layer[:-1].T) * (1 - below**2)
        total = float(np.sum(error**2) * len(inputs) + decay * at @ at)
        return total, np.concatenate(slopes[::-1]) + 2 * decay * at

    return np.asarray(minimize(loss, weights, jac=True, method="L-BFGS-B", options={"maxiter": 500}).x)


LEARNERS: Mapping[str, Callable[[FloatArray, FloatArray], Predictor]] = {
    "polynomial": fit_polynomial,
    "Gaussian process": fit_gaussian_process,
    "neural network": fit_network,
}
"""By name."""
