"""Estimate the ratios of a pad's channel gains from ordinary contacts, without a reference.

Public: `GainEstimator` (contacts in, `GainEstimate` out). `contact_scores` has the equations.

A point contact has three unknowns and gives c currents, four as a rule. Each of the c - 3 numbers left over,
a score, is the part of the misfit along a left null vector n of the fit's whitened Jacobian: a standard
normal number if the gains are right. Log gains with an error d (summing to zero) move it by h . d, where
h = n * expected currents / noise. So each score is one linear equation for d; contacts are fitted again with
the gains found (Gauss-Newton), which makes it the maximum-likelihood estimate with the positions as nuisance
parameters. Three currents leave no score: their gains aren't observable.

Scores also depend on the other parts of the pad that aren't exactly as stated: gaps, sides, resistors. They
are parameters of the same equations, with their tolerances as priors, so that the covariance of the gains
includes what they could explain.

Contacts come in batches. A batch is iterated to convergence around the former gains, then only its
information matrix is kept: the state has a fixed size. Contacts that are no points are recognised by a
mixture of two normal distributions of the score, whose shares are estimated too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.calibration.calibration import Gains
from handtouch.calibration.contact_scores import (
    UNKNOWNS,
    ContactScores,
    channel_count,
    elongation_error,
    gain_basis,
    gain_deviation,
)
from handtouch.field.estimate import estimate
from handtouch.field.model import ChannelModel, ForwardModel, FractionModel, channel_noise
from handtouch.hand.pads import models_with_other_parts, part_limits

# Constants without an origin beside them were chosen; docs/benchmarks/swap.md measures what they yield.
BATCH_CONTACTS = 32
MAX_SHAPE_DEVIATION = 20.0
"""Standard deviation of a log gain after 400 contacts, per noise, above which a shape is refused."""
MAX_TOUCH_ERROR = 2e-3
"""Standard deviation of the fractions of a touch that is still a point; larger errors of most contacts are
those of other gains or objects."""

_MAX_BATCH_ITERATIONS = 8
_CONVERGED_STEP_SIGMA = 0.02  # standard deviations of the gains: a smaller step ends a batch
_L1_ITERATIONS, _EM_ITERATIONS = 12, 20
_MIN_EDGE_DISTANCE_FRACTION = 0.05
"""Distance over a side: nearer to an edge, a contact of real size is no point of the model."""
_MAX_NOISE_FRACTION = 0.02  # noise over the total: weaker contacts hold little information, with a bias
_CELLS_PER_SIDE = 10  # a side
_MEMORY_CONTACTS = 128.0  # contacts over which the share of points is estimated
_MIN_OUTLIER_VARIANCE = 25.0  # variance of the scores of contacts that are no points, at least
_MIN_INFORMATION_FRACTION = 0.2  # part of a batch's information that counts, however unlikely its contacts
_MIN_GAIN_STD = 1e-4  # as good as exact
_PART_RATIOS = 12  # of deviations of parts to stated ones that are tried
_MEDIAN_SQUARED_SCORE = 0.4549  # median of the square of a standard normal number
_DAY_NS = 86_400e9


class GainStatus(StrEnum):
    """Status of a gain estimate."""

    UNDETERMINED = "undetermined"
    ESTIMATED = "estimated"
    INVALID = "invalid"


@dataclass(frozen=True)
class GainEstimate:
    """Gains of c channels estimated from contacts, in the order of the model's.

    gains: (c,), factors that correct the currents; their product is 1, a common factor is not observable.
    covariance: (c, c), of the logarithms of the gains; singular, as they sum to zero. Widened by the misfit.
    touch_error: standard deviation of the fractions of a touch, another one each time: that stated, or what
        explains the scores beyond noise; patches that aren't round have one.
    part_offsets: (p,) of the other parts, in their standard deviations as stated.
    joint_covariance: (c + p, c + p) of the logarithms of the gains and of these.
    widening: standard deviation of the parts that may be wider than stated, as these contacts show it, over
        that stated; at least 1.
    contacts: number used. effective_contacts: number that counts, once those of one touch, at one position,
        and those that are no points are discounted. point_fraction: share of them that are points.
    misfit: root mean square score of recent points, near 1 where model and noise are right.
    reason: of the status, as text.
    """

    gains: FloatArray
    covariance: FloatArray
    part_offsets: FloatArray
    joint_covariance: FloatArray
    widening: float
    touch_error: float
    contacts: int
    effective_contacts: float
    point_fraction: float
    misfit: float
    status: GainStatus
    reason: str

    @property
    def std(self) -> float:
        """Standard deviation of the least certain log gain."""
        return float(np.sqrt(np.diag(self.covariance).max()))


class PartModels(NamedTuple):
    """Parts (p,) of a pad that differ from pad to pad, such as a gap."""

    models: Sequence[FractionModel] = ()
    """in each of which one part differs by one standard deviation; the pad's own for one without a
    tolerance"""
    limits: ArrayLike = 1.0
    """(p,) how many times that deviation a part may have at most, if contacts show that such parts have more
    than stated; stored parts were found so before"""
    touch_error: float = 0.0
    """standard deviation of the fractions of a touch, as stated (`elongation_error`) or more. The contacts of
    a touch share it, so a touch never adds more information than it allows, however many contacts a slide
    has. A few touches don't show how large it is, as parts explain their scores, too."""

    @classmethod
    def of_pad(
        cls, network: ChannelModel, pad: config.Pad, node: config.Node, sheet: config.Sheet
    ) -> PartModels:
        """Return those that a deployment states of a pad, whose channels are `network`'s."""
        return cls(
            models_with_other_parts(network, pad, node, sheet),
            part_limits(pad, node),
            elongation_error(pad, sheet, network),
        )


NO_PARTS = PartModels()


class GainEstimator:
    """Running estimate of the gains of one pad; its state has a fixed size.

    model: of the pad, with c channels.
    tolerance: standard deviation of a log gain before any contact.
    drift_per_day: standard deviation of a log gain's random walk, after a day.
    model_error: standard deviation of the model's fractions. It is the same for all contacts in one cell of
        the pad, so a cell never adds more information than this allows, however often it is touched.
    required_std: of the least certain log gain, at which the gains count as estimated; for other parts as
        stated, as no number of contacts separates them from gains.
    gain_std: standard deviation of a log gain as stated, which counts unless contacts show that gains have
        more, up to the tolerance; None: nothing is stated.
    known: gains and parts found before.
    parts: those that differ from pad to pad.

    Raises ValueError for a parameter out of range.
    """

    def __init__(
        self,
        model: ForwardModel,
        *,
        tolerance: float = 0.05,
        drift_per_day: float = 1e-3,
        model_error: float = 5e-4,
        required_std: float = 5e-3,
        gain_std: float | None = None,
        known: Gains | None = None,
        parts: PartModels = NO_PARTS,
    ) -> None:
        for name, value, least in (
            ("tolerance", tolerance, 1e-9),
            ("drift_per_day", drift_per_day, 0.0),
            ("model_error", model_error, 0.0),
            ("required_std", required_std, 1e-9),
        ):
            if not least <= value < np.inf:
                raise ValueError(f"{name} = {value}: must be finite and at least {least:g}")
        self.shape_deviation = gain_deviation(model)
        self._model, self._channels = model, channel_count(model)
        self._drift_per_day, self._model_error, self._required_std = drift_per_day, model_error, required_std
        self._log_gains = np.zeros(self._channels)
        learned = None if known is None else known.parts
        if known is not None:
            self._log_gains = _normalised_logs(known.factors, self._channels)
        self._parts, self._part_offsets = tuple(parts.models), np.zeros(len(parts.models))
        free, self._gain_basis = self._channels - 1, gain_basis(self._channels)
        limits = np.asarray(parts.limits if learned is None else 1.0, dtype=np.float64)
        least = tolerance if gain_std is None else min(max(gain_std, _MIN_GAIN_STD), tolerance)
        self._stated: FloatArray = np.concatenate([np.full(free, least), np.ones(len(self._parts))])
        self._widest = np.concatenate([np.full(free, tolerance), np.broadcast_to(limits, len(self._parts))])
        """(p,) standard deviations before any contact: as stated, and those of the present information"""
        self._information: FloatArray = np.diag(self._widest**-2.0)
        self._basis = np.eye(self._channels + len(self._parts))[:, 1:]
        self._basis[: self._channels, :free] = self._gain_basis
        if known is not None:  # nothing is stated of these gains
            self._stated = self._widest.copy()
        if learned is not None:
            self._part_offsets = np.array(learned.offsets, dtype=np.float64)
            self._information = _information(learned.covariance, self._basis)
        elif known is not None:
            self._information[:free, :free] = _information(known.covariance, self._gain_basis)
        self._prior = self._information, self._values
        # the positions behind given gains are unknown: each cell starts with half of the information it can
        # add
        already = 0.0 if known is None or model_error == 0 else model_error**-2
        scores = max(self._channels - UNKNOWNS, 0)
        self._cell_information = np.full((_CELLS_PER_SIDE, _CELLS_PER_SIDE, scores), already)
        self._mixture = _OutlierMixture()
        self._pending: list[FloatArray] = []
        self._stated_touch_variance = self._touch_variance = parts.touch_error**2
        self._last_touch: tuple[float, FloatArray] = math.nan, np.zeros(scores)
        """number of the last contact's touch, and the information that its scores (s,) have without errors"""
        self._contacts, self._effective_contacts = 0, 0.0
        self._misfit_sums = np.array([1.0, 0.0])  # weighted sum of squares, and of weights
        self._last_ns: int | None = None

    def add_contacts(
        self, currents: ArrayLike, noise: ArrayLike, now_ns: int, touches: ArrayLike = math.nan
    ) -> int:
        """Add contacts, one column each; return the number of useful ones.

        currents: (c, n) or (c,), any unit, offsets taken off, *not* corrected by this estimator's gains.
        noise: their standard deviations, same unit: one, (c,) a channel, or broadcastable. Give a held
            contact once, as its mean with the noise of that mean. now_ns: monotonic time of the last of them.
        touches: (n,) numbers of the touches they are parts of, such as slides; NaN: a touch of its own.
        Raises ValueError for three channels, other shapes, or a time before that of the contacts given
        before.
        """
        readings, c = np.asarray(currents, dtype=np.float64), self._channels
        if c <= UNKNOWNS:
            raise ValueError(f"gains of {c} channels can't be estimated: a contact has as many unknowns")
        if readings.shape[:1] != (c,) or readings.ndim > 2:
            raise ValueError(f"currents have shape {readings.shape}: must be ({c},) or ({c}, n)")
        sigma = channel_noise(noise, readings.shape)
        if self._last_ns is not None and now_ns < self._last_ns:
            raise ValueError(f"now_ns = {now_ns}: contacts of {self._last_ns} were added before")
        self._propagate_drift(now_ns)
        columns = np.concatenate([readings.reshape(c, -1), sigma.reshape(c, -1)])
        numbers = np.broadcast_to(np.asarray(touches, dtype=np.float64), (1, columns.shape[1]))
        is_useful = self._usable(columns[:c], columns[c:])
        useful = np.concatenate([columns, numbers])[:, is_useful]
        self._pending.extend(useful.T)
        while len(self._pending) >= BATCH_CONTACTS:
            batch, self._pending = np.array(self._pending[:BATCH_CONTACTS]).T, self._pending[BATCH_CONTACTS:]
            self._process_batch(batch[:c], batch[c:-1], batch[-1])
        return int(useful.shape[1])

    @property
    def estimate(self) -> GainEstimate:
        """Return the estimate after the batches so far."""
        misfit, widening = self._misfit
        stds, part_widening = self._most_likely_priors(widening)
        information, log_gains, part_offsets = self._with_priors(stds)
        prior = np.diag(stds**-2.0)  # which misfit doesn't widen
        joint = self._basis @ _inverse((information - prior) / widening + prior) @ self._basis.T
        basis, free = self._gain_basis, self._channels - 1
        with_parts_as_stated = basis @ _inverse(self._information[:free, :free]) @ basis.T * widening
        status, reason = self._assess(float(np.sqrt(np.diag(with_parts_as_stated).max())))
        return GainEstimate(
            gains=np.exp(log_gains),
            covariance=joint[: self._channels, : self._channels],
            part_offsets=part_offsets,
            joint_covariance=joint,
            widening=part_widening,
            touch_error=math.sqrt(self._touch_variance),
            contacts=self._contacts,
            effective_contacts=self._effective_contacts,
            point_fraction=1 - self._mixture.outlier_fraction,
            misfit=misfit,
            status=status,
            reason=reason,
        )

    @property
    def _values(self) -> FloatArray:
        """Log gains along the basis, then the parts' offsets (p,)."""
        return np.concatenate([self._gain_basis.T @ self._log_gains, self._part_offsets])

    @property
    def _misfit(self) -> tuple[float, float]:
        """Root mean square of the scores, NaN without any, and the variance that it adds: scores wider than
        by noise show model errors of the points, which widen the covariance of the gains, too."""
        squares, counted = self._misfit_sums
        misfit = float(np.sqrt(squares / counted)) if counted > 0 else float("nan")
        return misfit, max(1.0, np.nan_to_num(misfit) ** 2)

    def evidence_nats(self, known: Gains) -> float:
        """Return how much more probable gains with parts as `known` make the contacts than the prior [nats].

        The information of the contacts is that of the estimate less that of its prior, by their misfit.
        """
        assert known.parts is not None
        before, start = self._prior
        _, widening = self._misfit
        contacts = (self._information - before) / widening
        right = (self._information @ self._values - before @ start) / widening

        def log_evidence(values: FloatArray, information: FloatArray) -> float:
            total, pull = contacts + information, right + information @ values
            determinants = np.linalg.slogdet(information)[1] - np.linalg.slogdet(total)[1]
            squares = pull @ np.linalg.solve(total, pull) - values @ information @ values
            return float((squares + determinants) / 2)

        log_gains = self._gain_basis.T @ _normalised_logs(known.factors, self._channels)
        given = _information(known.parts.covariance, self._basis)
        values = np.concatenate([log_gains, known.parts.offsets])
        return log_evidence(values, given) - log_evidence(start, before)

    def _most_likely_priors(self, score_variance: float) -> tuple[FloatArray, float]:
        """Return the most likely standard deviations of gains and of parts, (p,), from those stated on; and
        that of the parts that may be wider, over that stated."""
        stds, widenings, free = self._widest.copy(), [], self._channels - 1
        values = self._values
        for group in (np.arange(free), np.arange(free, len(stds))):
            wide = group[self._widest[group] > self._stated[group]]
            widenings.append(self._widening(wide, values[wide], score_variance) if len(wide) else 1.0)
            stds[wide] = np.minimum(widenings[-1] * self._stated[wide], self._widest[wide])
        return stds, widenings[-1]

    def _widening(self, at: NDArray[np.intp], values: FloatArray, score_variance: float) -> float:
        """Return the most likely deviation of these parameters (k,), over that stated, from 1 on.

        The contacts' information about them alone is that of the estimate less that of its prior.
        """
        known = _inverse(_inverse(self._information)[np.ix_(at, at)])
        score = known @ values / score_variance
        known = (known - np.diag(self._widest[at] ** -2.0)) / score_variance
        ratios, evidence = np.geomspace(1.0, (self._widest[at] / self._stated[at]).max(), _PART_RATIOS), []
        for ratio in ratios:
            std = np.minimum(ratio * self._stated[at], self._widest[at])
            total = known + np.diag(std**-2.0)
            log_determinant = np.linalg.slogdet(total)[1] + 2 * np.log(std).sum()
            evidence.append(score @ np.linalg.solve(total, score) - log_determinant)
        return float(ratios[np.argmax(evidence)])

    def _with_priors(self, stds: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return information, log gains and offsets of the parts with other standard deviations (p,) before
        any contact."""
        free = self._channels - 1
        more = stds**-2.0 - self._widest**-2.0
        information = self._information + np.diag(more)
        step = np.asarray(np.linalg.solve(information, -more * self._values), dtype=np.float64)
        return information, self._log_gains + self._gain_basis @ step[:free], self._part_offsets + step[free:]

    def _assess(self, std: float) -> tuple[GainStatus, str]:
        if self._channels <= UNKNOWNS:
            return GainStatus.INVALID, (
                f"{self._channels} channels can't be calibrated by contacts, which have as many unknowns; "
                "measure their gains with a known current into every channel"
            )
        if self.shape_deviation > MAX_SHAPE_DEVIATION:
            return GainStatus.INVALID, (
                f"a pad of {self._model.a:.3g} by {self._model.b:.3g} can't be calibrated by contacts: 400 "
                f"would determine its gains to {self.shape_deviation:.0f} times the noise (limit "
                f"{MAX_SHAPE_DEVIATION:.0f}); measure them with a known current into every channel"
            )
        if self._mixture.outlier_fraction > 0.5:
            return GainStatus.INVALID, (
                f"{100 * self._mixture.outlier_fraction:.0f} % of its contacts are no points under any "
                "gains near these: the pad isn't built as configured, its gains have jumped, or only edges "
                "touch it; calibrate again, with round contacts"
            )
        counts = f"{self._contacts} contacts, worth {self._effective_contacts:.0f} at distinct positions"
        result = f"{counts}; gains known to {100 * std:.2g} %"
        if std > self._required_std or self._contacts == 0:
            return (
                GainStatus.UNDETERMINED,
                f"{result}, {100 * self._required_std:.2g} % required: touch the pad all over",
            )
        return GainStatus.ESTIMATED, result

    def _usable(self, currents: FloatArray, sigma: FloatArray) -> NDArray[np.bool_]:
        """Return which contacts (n,) have enough force and distance from the edges."""
        gains = np.exp(self._log_gains)[:, None]
        found = estimate(self._model, currents * gains, sigma * gains)
        inside = np.ones(currents.shape[1], dtype=bool)
        with np.errstate(invalid="ignore"):
            for at, side in ((found.x, self._model.a), (found.y, self._model.b)):
                inside &= (at > _MIN_EDGE_DISTANCE_FRACTION * side) & (
                    at < (1 - _MIN_EDGE_DISTANCE_FRACTION) * side
                )
            useful = inside & found.converged & (sigma.max(axis=0) < _MAX_NOISE_FRACTION * found.total)
        return np.asarray(useful)

    def _propagate_drift(self, now_ns: int) -> None:
        """Add drift of the gains until now_ns; the information in the cells fades with it."""
        days = 0.0 if self._last_ns is None else (now_ns - self._last_ns) / _DAY_NS
        self._last_ns = now_ns
        if days > 0 and self._drift_per_day > 0:
            before = _inverse(self._information)
            after = before.copy()
            free = self._channels - 1
            after[:free, :free] += self._drift_per_day**2 * days * np.eye(free)
            self._information = _inverse(after)
            self._cell_information *= np.trace(before[:free, :free]) / np.trace(after[:free, :free])

    def _process_batch(self, currents: FloatArray, sigma: FloatArray, touches: FloatArray) -> None:
        """Process a batch (c, n) of touches (n,): iterate around the former gains; keep its information."""
        known, known_parts, positions = self._log_gains, self._part_offsets, None
        known_variance, contacts = self._touch_variance, min(self._contacts, _MEMORY_CONTACTS)
        basis, free, count = self._gain_basis, self._channels - 1, currents.shape[1]
        for _ in range(_MAX_BATCH_ITERATIONS):
            gains = np.exp(self._log_gains)[:, None]
            view = ContactScores.linearise(
                self._model, self._parts, currents * gains, sigma * gains, positions
            )
            positions = view.positions
            share, cells, last_touch = self._information_shares(view, touches)
            error2 = self._model_error**2 + self._touch_variance
            spread = np.sqrt(1 + error2 * view.score_sensitivity**2)
            mixture = replace(self._mixture)
            prior = np.concatenate([basis.T @ (known - self._log_gains), known_parts])
            found = mixture.solve(view, share, spread, self._information, prior)
            information = self._information + view.information(found.precision)
            # the step of the gains is from the present ones; scores are linear in the parts' offsets
            self._log_gains = self._log_gains + basis @ found.step[:free]
            touch_variance = _touch_variance(
                (found.squared_scores * spread**2).ravel(), view.score_sensitivity.ravel()
            )
            touch_variance = (contacts * known_variance + count * touch_variance) / (contacts + count)
            self._touch_variance = max(touch_variance, self._stated_touch_variance)
            step = np.concatenate([found.step[:free], found.step[free:] - self._part_offsets])
            self._part_offsets = found.step[free:]
            if step @ information @ step < _CONVERGED_STEP_SIGMA**2:
                break
        self._information, self._mixture, self._cell_information = information, mixture, cells
        self._last_touch = last_touch
        self._contacts += count
        self._effective_contacts += float((found.precision * spread**2).mean(axis=1).sum())
        fade = 1 - count / _MEMORY_CONTACTS
        self._misfit_sums = fade * self._misfit_sums + [
            found.point_probability @ found.squared_scores.mean(axis=1),
            found.point_probability.sum(),
        ]

    def _information_shares(
        self, view: ContactScores, touches: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[float, FloatArray]]:
        """Return the share of each score's information (n, s) given earlier ones of its touch and nearby; the
        updated cells; and the last touch with its information.

        Independent information i of a touch or a cell and a common error m give 1 / (1 / i + m^2) together.
        By the inequality of Cauchy and Schwarz, that is no more than they have if the error of a touch isn't
        the same in all its scores but m is its root mean square there.
        """
        cells, error = self._cell_information.copy(), self._model_error**2
        at = (
            (view.positions / [[self._model.a], [self._model.b]] * _CELLS_PER_SIDE)
            .clip(0, _CELLS_PER_SIDE - 1)
            .astype(int)
        )
        own, touch_error = view.score_sensitivity**2, self._touch_variance
        touch, in_touch = self._last_touch
        share = np.zeros(own.shape)
        for k, (i, j) in enumerate(at.T):
            known = in_touch if touches[k] == touch else np.zeros(own.shape[1])
            touch, in_touch = float(touches[k]), known + own[k]
            kept = 1 / ((1 + known * touch_error) * (1 + in_touch * touch_error))
            before = cells[i, j].copy()
            cells[i, j] += kept * own[k]
            share[k] = kept / ((1 + before * error) * (1 + cells[i, j] * error))
        return share, cells, (touch, in_touch)


def _touch_variance(squared_scores: FloatArray, sensitivity: FloatArray) -> float:
    """Return the variance of the fractions that explains scores (k,) beyond noise.

    From the median of the more sensitive half, which a minority that are no points doesn't change.
    """
    sensitive = sensitivity >= np.median(sensitivity)
    excess = squared_scores[sensitive] / _MEDIAN_SQUARED_SCORE - 1
    variance = float(np.median(excess / sensitivity[sensitive] ** 2))
    return min(max(variance, 0.0), MAX_TOUCH_ERROR**2)


@dataclass
class _OutlierMixture:
    """Mixture of scores: standard normal for points, normal with a wide spread for other contacts.

    points, others: contacts counted as either, with what is thought before any. squares: of scores, summed
    over the others.
    """

    point_count: float = 19.0
    outlier_count: float = 1.0
    outlier_squares: float = 100.0

    @property
    def outlier_fraction(self) -> float:
        """Share of contacts that are no points."""
        return self.outlier_count / (self.point_count + self.outlier_count)

    def solve(
        self,
        view: ContactScores,
        share: FloatArray,
        spread: FloatArray,
        information: FloatArray,
        prior: FloatArray,
    ) -> _GainStep:
        """Return the most likely step of gains and parts for contacts and prior, (p,) with its information.

        share (n, s): of a score's information that counts; spread (n, s): standard deviation of a point's
        scores. Starts from the least absolute scores, which are robust against a minority, then
        expectation-maximisation.
        """

        def step_for(precision: FloatArray) -> FloatArray:
            right = information @ prior - np.einsum("pns,ns->p", view.score_slope, precision * view.score)
            return np.asarray(np.linalg.solve(information + view.information(precision), right))

        step = prior
        for _ in range(_L1_ITERATIONS):
            score = np.abs(view.scores_after(step)) / spread
            step = step_for(share / np.maximum(score, 0.1))
        points, others, squares = self.point_count, self.outlier_count, self.outlier_squares
        for _ in range(_EM_ITERATIONS):
            z = view.scores_after(step) ** 2 / spread**2
            wide = max(self.outlier_squares / self.outlier_count, _MIN_OUTLIER_VARIANCE)
            log_odds = (
                np.log(self.outlier_count / self.point_count)
                - z.shape[1] * np.log(wide) / 2
                + z.sum(axis=1) * (1 - 1 / wide) / 2
            )
            other = (1 + np.tanh(log_odds / 2)) / 2  # logistic function
            self.point_count, self.outlier_count = points + (1 - other).sum(), others + other.sum()
            self.outlier_squares = squares + other @ z.mean(axis=1)
            weight = (1 - other + other / wide)[:, None]
            # uncertainty of a contact's class reduces the information (Louis 1982)
            information_loss = (other * (1 - other))[:, None] * (1 - 1 / wide) ** 2 * z
            loss = (share * information_loss).sum() / (share * weight).sum()
            kept = max(1 - loss, _MIN_INFORMATION_FRACTION)
            weight = kept * share * weight
            step = step_for(weight)
        fade = min(1.0, _MEMORY_CONTACTS / (self.point_count + self.outlier_count))
        self.point_count, self.outlier_count, self.outlier_squares = (
            fade * v for v in (self.point_count, self.outlier_count, self.outlier_squares)
        )
        return _GainStep(step, weight, 1 - other, z)


class _GainStep(NamedTuple):
    """Step (p,); precision of each score (n, s), probability (n,) of a point, squared scores (n, s)."""

    step: FloatArray
    precision: FloatArray
    point_probability: FloatArray
    squared_scores: FloatArray


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _information(covariance: ArrayLike, basis: FloatArray) -> FloatArray:
    """Return the information along the directions of a basis (c, k) that a covariance (c, c) leaves."""
    known = basis.T @ np.asarray(covariance, dtype=np.float64) @ basis
    return _inverse(known + 1e-18 * np.eye(len(known)))


def _normalised_logs(gains: ArrayLike, channels: int) -> FloatArray:
    values = np.asarray(gains, dtype=np.float64)
    if values.shape != (channels,) or not (values > 0).all() or not np.isfinite(values).all():
        raise ValueError(f"gains {values}: must be {channels} positive numbers")
    logs = np.log(values)
    return np.asarray(logs - logs.mean())
