"""Ratios of a pad's four channel gains from ordinary contacts, without a reference.

Public: `GainEstimator` (contacts in, `GainEstimate` out); `gain_deviation` and `fisher_covariance` (what a
shape of pad, and contacts on it, permit at best).

A point contact has three unknowns and gives four currents. The one number left over, the score, is the part
of the misfit along the left null vector n of the fit's whitened Jacobian: a standard normal number if the
gains are right. Log gains that are off by d (summing to zero) move it by h . d, where h = n * expected
currents / noise. So each contact is one linear equation for d; contacts are fitted again with the gains found
(Gauss-Newton), which makes it the maximum-likelihood estimate with the locations as nuisance.

Contacts come in batches. A batch is iterated to convergence around the gains known before, then only its
information matrix is kept: the state has a fixed size. Contacts that are no points are told by a mixture of
two normal laws for the score, whose shares are learnt too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from handtouch.field.estimate import estimate
from handtouch.field.model import FloatArray, ForwardModel, channel_noise

BATCH = 32
HOPELESS = 20.0
"""Standard deviation of a log gain after 400 contacts, per noise, from which on a shape is refused."""

_ROUNDS = 8
_SETTLED = 0.02  # standard deviations of the gains: a smaller step ends a batch
_ABSOLUTE_ROUNDS, _MIXTURE_ROUNDS = 12, 20
_MARGIN = 0.05  # of a side: nearer to an edge a contact of real size is no point of the model
_NOISIEST = 0.02  # of the total: weaker contacts tell little, and that with a bias
_CELLS = 10  # a side
_MEMORY = 128.0  # contacts over which the share of points is learnt
_LEAST_SPREAD = 25.0  # variance of the scores of contacts that are no points, at least
_LEAST_KEPT = 0.2  # of a batch's information, however doubtful its contacts
_DAY_NS = 86_400e9

# orthonormal directions of four log gains that sum to zero
_BASIS = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 0, 0], [0, 0, 1, -1]], dtype=np.float64)
_BASIS = (_BASIS / np.linalg.norm(_BASIS, axis=1, keepdims=True))[1:].T


class GainStatus(StrEnum):
    """How far the gains can be relied upon."""

    UNESTIMATED = "unestimated"
    ESTIMATED = "estimated"
    INVALID = "invalid"


@dataclass(frozen=True)
class GainEstimate:
    """What the contacts tell of the gains, channels in the order x0, xa, y0, yb.

    gains: (4,), factors that correct the currents; their product is 1, a common factor is not observable.
    covariance: (4, 4), of the logarithms of the gains; singular, as they sum to zero. Widened by the misfit.
    contacts: how many were used. weight: how many of them count, once those at one place and those that
        are no points are discounted. points: share of them that are points.
    misfit: root mean square score of the points of late, near 1 where model and noise are right.
    reason: in plain words, why the status is what it is.
    """

    gains: FloatArray
    covariance: FloatArray
    contacts: int
    weight: float
    points: float
    misfit: float
    status: GainStatus
    reason: str

    @property
    def std(self) -> float:
        """Standard deviation of the least certain log gain."""
        return float(np.sqrt(np.diag(self.covariance).max()))


class GainEstimator:
    """Running estimate of the gains of one pad; its state has a fixed size.

    model: of the pad, with channels x0, xa, y0, yb.
    tolerance: standard deviation of a log gain before any contact.
    drift_per_day: standard deviation of a log gain's random walk, after a day.
    model_error: standard deviation of the model's fractions. It is the same for all contacts in one cell of
        the pad, so a cell never tells more than this allows, however often it is touched.
    wanted_std: of the least certain log gain, at which the gains count as estimated.
    start: gains (4,) to begin with, their covariance (4, 4) of logarithms as `covariance`, both as stored.

    Raises ValueError for a model with other channels, or a parameter that cannot be.
    """

    def __init__(
        self,
        model: ForwardModel,
        *,
        tolerance: float = 0.05,
        drift_per_day: float = 1e-3,
        model_error: float = 5e-4,
        wanted_std: float = 5e-3,
        start: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
    ) -> None:
        for name, value, least in (
            ("tolerance", tolerance, 1e-9),
            ("drift_per_day", drift_per_day, 0.0),
            ("model_error", model_error, 0.0),
            ("wanted_std", wanted_std, 1e-9),
        ):
            if not least <= value < np.inf:
                raise ValueError(f"{name} = {value}: must be finite and at least {least:g}")
        self.shape_deviation = gain_deviation(model)
        self._model = model
        self._drift, self._model_error, self._wanted = drift_per_day, model_error, wanted_std
        self._log_gains = np.zeros(4) if start is None else _log_of(start)
        self._information: FloatArray = np.eye(3) / tolerance**2
        if covariance is not None:
            known = _BASIS.T @ np.asarray(covariance, dtype=np.float64) @ _BASIS
            self._information = _inverse(known + 1e-18 * np.eye(3))
        # which places told what is given isn't known: as if each had told half of what its model error allows
        already = 0.0 if covariance is None or model_error == 0 else model_error**-2
        self._cells = np.full((_CELLS, _CELLS), already)
        self._mixture = _Mixture()
        self._pending: list[FloatArray] = []
        self._contacts, self._weight = 0, 0.0
        self._misfit = np.array([1.0, 0.0])  # weighted sum of squares, and of weights
        self._last_ns: int | None = None

    def add(self, currents: ArrayLike, noise: ArrayLike, t_ns: int) -> int:
        """Take contacts, one column each; return how many of them are of use.

        currents: (4, n) or (4,), any unit, offsets taken off, *not* corrected by this estimator's gains.
        noise: their standard deviations, same unit: one, (4,) a channel, or broadcastable. Give a held
            contact once, as its mean with the noise of that mean. t_ns: monotonic time of the last of them.
        Raises ValueError for other shapes, or a time before that of the contacts given before.
        """
        readings = np.asarray(currents, dtype=np.float64)
        if readings.shape[:1] != (4,) or readings.ndim > 2:
            raise ValueError(f"currents have shape {readings.shape}: must be (4,) or (4, n)")
        sigma = channel_noise(noise, readings.shape)
        if self._last_ns is not None and t_ns < self._last_ns:
            raise ValueError(f"t_ns = {t_ns}: contacts of {self._last_ns} were given before")
        self._walk(t_ns)
        columns = np.concatenate([readings.reshape(4, -1), sigma.reshape(4, -1)])
        useful = columns[:, self._of_use(columns[:4], columns[4:])]
        self._pending.extend(useful.T)
        while len(self._pending) >= BATCH:
            batch, self._pending = np.array(self._pending[:BATCH]).T, self._pending[BATCH:]
            self._take(batch[:4], batch[4:])
        return int(useful.shape[1])

    def settle(self) -> None:
        """Take also the contacts that wait for a batch to be full, as at the end of a session."""
        if self._pending:
            batch, self._pending = np.array(self._pending).T, []
            self._take(batch[:4], batch[4:])

    @property
    def estimate(self) -> GainEstimate:
        """The gains as the batches so far tell them."""
        squares, counted = self._misfit
        misfit = float(np.sqrt(squares / counted)) if counted > 0 else float("nan")
        # scores wider than the noise makes them: what is wrong with the points widens the gains too
        covariance = _BASIS @ _inverse(self._information) @ _BASIS.T * max(1.0, np.nan_to_num(misfit) ** 2)
        std = float(np.sqrt(np.diag(covariance).max()))
        status, reason = self._judge(std)
        return GainEstimate(
            np.exp(self._log_gains),
            covariance,
            self._contacts,
            self._weight,
            1 - self._mixture.share,
            misfit,
            status,
            reason,
        )

    def _judge(self, std: float) -> tuple[GainStatus, str]:
        if self.shape_deviation > HOPELESS:
            return GainStatus.INVALID, (
                f"a pad of {self._model.a:.3g} by {self._model.b:.3g} hides its gains: 400 contacts would "
                f"tell them to {self.shape_deviation:.0f} times the noise only (limit {HOPELESS:.0f}); "
                "measure them with a known current into every channel"
            )
        if self._mixture.share > 0.5:
            return GainStatus.INVALID, (
                f"{100 * self._mixture.share:.0f} % of its contacts are no points under any gains near "
                "these: the pad isn't built as configured, its gains have jumped, or only edges touch it; "
                "start again, with round contacts"
            )
        counts = f"{self._contacts} contacts, worth {self._weight:.0f} at places of their own"
        told = f"{counts}, tell the gains to {100 * std:.2g} %"
        if std > self._wanted or self._contacts == 0:
            return GainStatus.UNESTIMATED, f"{told}; {100 * self._wanted:.2g} % are wanted: touch it all over"
        return GainStatus.ESTIMATED, told

    def _of_use(self, currents: FloatArray, sigma: FloatArray) -> NDArray[np.bool_]:
        """Which contacts (n,) are strong enough and far enough from the edges."""
        gains = np.exp(self._log_gains)[:, None]
        found = estimate(self._model, currents * gains, sigma * gains)
        inside = np.ones(currents.shape[1], dtype=bool)
        with np.errstate(invalid="ignore"):
            for at, side in ((found.x, self._model.a), (found.y, self._model.b)):
                inside &= (at > _MARGIN * side) & (at < (1 - _MARGIN) * side)
            useful = inside & found.converged & (sigma.max(axis=0) < _NOISIEST * found.total)
        return np.asarray(useful)

    def _walk(self, t_ns: int) -> None:
        """Let the gains drift until t_ns; places forget with them what they have told."""
        days = 0.0 if self._last_ns is None else (t_ns - self._last_ns) / _DAY_NS
        self._last_ns = t_ns
        if days > 0 and self._drift > 0:
            before = _inverse(self._information)
            after = before + self._drift**2 * days * np.eye(3)
            self._information = _inverse(after)
            self._cells *= np.trace(before) / np.trace(after)

    def _take(self, currents: FloatArray, sigma: FloatArray) -> None:
        """A batch (4, n): iterate on it around what is known, then keep its information."""
        known, place = self._log_gains, None
        for _ in range(_ROUNDS):
            gains = np.exp(self._log_gains)[:, None]
            view = _View.at(self._model, currents * gains, sigma * gains, place)
            place = view.place
            share, cells = self._shares(view)
            spread = np.sqrt(1 + (self._model_error * view.sharpness) ** 2)
            mixture = replace(self._mixture)
            prior = _BASIS.T @ (known - self._log_gains)
            found = mixture.solve(view, share, spread, self._information, prior)
            information = self._information + (view.slope * found.precision) @ view.slope.T
            self._log_gains = self._log_gains + _BASIS @ found.step
            if found.step @ information @ found.step < _SETTLED**2:
                break
        self._information, self._mixture, self._cells = information, mixture, cells
        self._contacts += len(share)
        self._weight += float(found.precision @ spread**2)
        fade = 1 - len(share) / _MEMORY
        self._misfit = fade * self._misfit + [found.points @ found.squares, found.points.sum()]

    def _shares(self, view: _View) -> tuple[FloatArray, FloatArray]:
        """How much each contact still tells where others have been (n,), and the cells after them.

        Independent information i of a cell and a common error m give 1 / (1 / i + m^2) together.
        """
        cells, error = self._cells.copy(), self._model_error**2
        at = (view.place / [[self._model.a], [self._model.b]] * _CELLS).clip(0, _CELLS - 1).astype(int)
        share = np.zeros(at.shape[1])
        for k, (i, j) in enumerate(at.T):
            before, own = cells[i, j], view.sharpness[k] ** 2
            cells[i, j] += own
            share[k] = 1 / ((1 + before * error) * (1 + cells[i, j] * error))
        return share, cells


def gain_deviation(model: ForwardModel, contacts: int = 400) -> float:
    """Fisher bound: standard deviation of the least certain log gain, per noise as a part of the total.

    For `contacts` spread evenly over the pad, 10 % of a side and farther from the edges. Raises ValueError
    for a model with other channels.
    """
    at = 0.1 + 0.8 * (np.arange(20) + 0.5) / 20
    x, y = (grid.ravel() for grid in np.meshgrid(at * model.a, at * model.b))
    covariance = fisher_covariance(model, x, y, 1.0) * x.size / contacts
    return float(np.sqrt(np.diag(covariance).max()))


def fisher_covariance(model: ForwardModel, x: FloatArray, y: FloatArray, noise: ArrayLike) -> FloatArray:
    """Fisher bound of the log gains, (4, 4), of contacts at x, y (n,) that nothing else is known of.

    noise: of the channels as a part of each contact's total, as `channel_noise` takes it.
    """
    slope = _slopes(model, x, y, channel_noise(noise, (4, *x.shape)), np.ones(x.shape))[1]
    return np.asarray(_BASIS @ np.linalg.pinv(slope @ slope.T, rcond=1e-14) @ _BASIS.T)


@dataclass
class _Mixture:
    """Scores of points are standard normal; those of other contacts are normal too, but wide.

    points, others: contacts counted as either, with what is thought before any. squares: of scores, summed
    over the others.
    """

    points: float = 19.0
    others: float = 1.0
    squares: float = 100.0

    @property
    def share(self) -> float:
        """Of contacts that are no points."""
        return self.others / (self.points + self.others)

    def solve(
        self, view: _View, share: FloatArray, spread: FloatArray, information: FloatArray, prior: FloatArray
    ) -> _Solution:
        """Step of the gains that the contacts and the prior, (3,) with its information, make most likely.

        share (n,): of a contact's information that counts; spread (n,): standard deviation of a point's
        score. From the least absolute scores, which no minority can carry away, by expectation and
        maximisation.
        """

        def step_for(precision: FloatArray) -> FloatArray:
            weighted = view.slope * precision
            right = information @ prior - weighted @ view.score
            return np.asarray(np.linalg.solve(information + weighted @ view.slope.T, right))

        step = prior
        for _ in range(_ABSOLUTE_ROUNDS):
            score = np.abs(view.score + step @ view.slope) / spread
            step = step_for(share / np.maximum(score, 0.1))
        points, others, squares = self.points, self.others, self.squares
        for _ in range(_MIXTURE_ROUNDS):
            z = (view.score + step @ view.slope) ** 2 / spread**2
            wide = max(self.squares / self.others, _LEAST_SPREAD)
            log_odds = np.log(self.others / self.points) - np.log(wide) / 2 + z * (1 - 1 / wide) / 2
            other = expit(log_odds)
            self.points, self.others = points + (1 - other).sum(), others + other.sum()
            self.squares = squares + other @ z
            weight = 1 - other + other / wide
            # what isn't known of a contact's kind takes from the information (Louis 1982)
            doubt = other * (1 - other) * (1 - 1 / wide) ** 2 * z
            kept = max(1 - (share @ doubt) / (share @ weight), _LEAST_KEPT)
            weight = kept * share * weight
            step = step_for(weight)
        fade = min(1.0, _MEMORY / (self.points + self.others))
        self.points, self.others, self.squares = (fade * v for v in (self.points, self.others, self.squares))
        return _Solution(step, weight, 1 - other, z)


class _Solution(NamedTuple):
    """step (3,); of each contact (n,): precision of its score, probability of a point, squared score."""

    step: FloatArray
    precision: FloatArray
    points: FloatArray
    squares: FloatArray


@dataclass(frozen=True)
class _View:
    """What contacts (n,) tell of the gains near those they are corrected with.

    place (2, n); score (n,); slope (3, n): what a step of the gains adds to the score; sharpness (n,): score
    per error of the fractions.
    """

    place: FloatArray
    score: FloatArray
    slope: FloatArray
    sharpness: FloatArray

    @classmethod
    def at(
        cls, model: ForwardModel, currents: FloatArray, sigma: FloatArray, start: FloatArray | None
    ) -> _View:
        found = estimate(model, currents, sigma, start)
        place = np.stack([found.x, found.y])
        known = np.isfinite(place).all(axis=0)
        x, y = np.where(known, place, [[model.a / 2], [model.b / 2]])
        total = np.where(known, found.total, 1.0)
        null, slope = _slopes(model, x, y, sigma, total)
        score = np.einsum("nc,cn->n", null, currents / sigma)
        sharpness = total * np.linalg.norm(null.T / sigma, axis=0)
        return cls(np.stack([x, y]), np.where(known, score, 0.0), slope * known, sharpness)


def _slopes(
    model: ForwardModel, x: FloatArray, y: FloatArray, sigma: FloatArray, total: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Left null vectors (n, 4) of fits at x, y (n,), and what a gain step adds to their scores (3, n)."""
    fractions, jacobian = model.fractions_with_jacobian(x, y)
    if len(fractions) != 4:
        raise ValueError(f"the model has {len(fractions)} channels: gains are told from four")
    columns = np.moveaxis(np.concatenate([fractions[:, None], jacobian], axis=1) / sigma[:, None], 2, 0)
    columns = columns / np.linalg.norm(columns, axis=1, keepdims=True)
    null = np.linalg.qr(columns, mode="complete").Q[:, :, 3]
    return null, _BASIS.T @ (null.T * total * fractions / sigma)


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _log_of(gains: ArrayLike) -> FloatArray:
    values = np.asarray(gains, dtype=np.float64)
    if values.shape != (4,) or not (values > 0).all() or not np.isfinite(values).all():
        raise ValueError(f"gains {values}: must be four positive numbers")
    logs = np.log(values)
    return np.asarray(logs - logs.mean())
