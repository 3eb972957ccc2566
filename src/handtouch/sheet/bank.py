"""Bank of sheet models: adaptation and slow creep of each pad, learned from how it is used.

Public names: `ModelBank`, `BankState`, `BankPrior`, `check_learned`; `BANK_MODELS`, `BANK_WINDOW`,
`BANK_LEARNED`.

No force is measured, but a load that is held steadily has one value. Each model of the bank makes loads of
the readings; a model whose loads drift while the hand holds still is less probable. Models differ in the
speed of adaptation and the end of slow creep; each estimates its own exponent by a Kalman filter.

Whether a sheet adapts at all is a property of its material: the evidence of the other pads of a bank, which
have sheets of the same material, is part of each pad's prior. Where adaptation was rejected, none is
compensated.

A contact is divided into windows of doubling length, 1 to 2 s old, 2 to 4 s, ... The change of the load from
one window to the next is the hand's: either it holds steadily, within the scatter inside the windows, or it
doesn't, which is no evidence for any model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from handtouch.arrays import BoolArray, FloatArray, IntArray
from handtouch.sheet.adaptation import Adaptation

# Constants without an origin beside them were chosen; docs/benchmarks/supervise.md and soak_sheets.md
# measure what they yield.
_SPEEDS = ((0.0, 1.0), (1.0, 0.2), (1.0, 0.4), (1.0, 0.63), (1.0, 1.0), (1.0, 1.6), (1.0, 3.0))
"""Share and time constant of adaptation over those of the preset."""
_CREEP_ENDS_S = (40.0, np.inf)
_MODELS = [(share, time, end) for end in _CREEP_ENDS_S for share, time in _SPEEDS]
_SHARE, _TIME, _CREEP_END_S = np.array(_MODELS).T
BANK_MODELS, BANK_WINDOW, BANK_LEARNED = len(_SHARE), 7, 3 * len(_SHARE)

_FIRST_S = 1.0
"""Begin of the first window."""
_CREEP_BEGIN_S = np.where(np.isfinite(_CREEP_END_S), _FIRST_S, 0.1)
"""Age from which a sheet creeps slowly: where the stated creep ends, or as soon as the bank is updated."""
_STEADY_PROBABILITY = 0.5
_STEADY_STD, _UNSTEADY_STD = 0.01, 0.15
"""Changes of the log reading between windows of a steady hold, and of one that isn't."""
_SATURATED_PROBABILITY, _SATURATED_SHARE = 0.5, 0.1
"""Probability of a press that finds its sheet adapted to it, if the share of adaptation is small; and the
part of a load that isn't adapted to at which that is half as probable. With a share of 1 there is no such
press."""
_CORRELATION_S = 1.0
"""Correlation time of the scatter inside a window."""
_EXCEPTION = 0.02
"""Probability that one pad's sheet adapts and others of its material don't, or the reverse."""
_REJECTED = 0.9
"""Probability that a sheet doesn't adapt, above which adaptation is rejected."""
_KEPT, _MIN_LOG_WEIGHT, _MIN_LIKELIHOOD = 0.995, -30.0, 1e-300
"""Evidence that is left of former windows at each new one; least log likelihood of a model."""
_EXPONENT_WALK, _MAX_EXPONENT = 0.001, 0.25
_MIN_SLOPE = 0.02


@dataclass(frozen=True)
class BankPrior:
    """Prior of a bank. log_time_std: scale of the logarithm of adaptation's time over the preset's (Cauchy).
    not_adapting: probability that the sheet doesn't adapt. exponent_std: of slow creep, 0: known not to
    creep."""

    log_time_std: float = 0.5
    not_adapting: float = 0.15
    exponent_std: float = 0.05

    def log_weights(self) -> FloatArray:
        """Return the logarithms of the models' weights (BANK_MODELS,)."""
        times = np.where(_SHARE > 0, 1 / (1 + np.square(np.log(_TIME) / self.log_time_std)), 0.0)
        times /= times.sum()
        none = np.where(_SHARE > 0, 0.0, 1 / len(_CREEP_ENDS_S))
        return np.log((1 - self.not_adapting) * times + self.not_adapting * none)


@dataclass(frozen=True)
class BankState:
    """State of n pads, which a bank updates in place."""

    log_weight: FloatArray
    """(n, BANK_MODELS) log likelihood of the holds so far"""
    back_n: FloatArray
    """(n, BANK_MODELS) back force [N]"""
    exponent: FloatArray
    """(n, BANK_MODELS) of slow creep: a lasting load reads age^exponent times as much at an age in seconds"""
    exponent_variance: FloatArray
    """(n, BANK_MODELS)"""
    sum: FloatArray
    """(n, BANK_MODELS) integral of the log load over the present window"""
    before: FloatArray
    """(n, BANK_MODELS) mean log load of the window before; NaN: none"""
    window: FloatArray
    """(n, BANK_WINDOW) length [s] of the present window, integrals of the log reading and of its square; of
    the window before, variance of the log reading, length, mean log reading, and age at its middle"""
    age_s: FloatArray
    """(n,) age of the contact"""
    growth: FloatArray
    """(n,) reading over load by slow creep at that age"""

    @classmethod
    def empty(cls, pads: int) -> BankState:
        """Return the state of fresh sheets."""
        weight, back, exponent, variance, total, before = np.zeros((6, pads, BANK_MODELS))
        window, age_s, growth = np.zeros((pads, BANK_WINDOW)), np.zeros(pads), np.ones(pads)
        return cls(
            log_weight=weight,
            back_n=back,
            exponent=exponent,
            exponent_variance=variance,
            sum=total,
            before=before,
            window=window,
            age_s=age_s,
            growth=growth,
        )


class ModelBank:
    """Bank of models of n pads around the preset's `adaptation`."""

    def __init__(self, adaptation: Adaptation, prior: BankPrior, state: BankState) -> None:
        self._state = state
        self._share = _SHARE * float(np.asarray(adaptation.share))
        self._time_s = _TIME * float(np.asarray(adaptation.time_s))
        left = 1 - self._share
        self._saturated = np.where(
            self._share > 0, _SATURATED_PROBABILITY * left / (left + _SATURATED_SHARE), 0.0
        )
        self._fatigue_s = float(np.asarray(adaptation.fatigue_s))
        self._prior, self._log_prior = prior, prior.log_weights()
        self.set_law_ages(np.full(len(state.age_s), _FIRST_S))
        self._adapts = self._share > 0
        self._weights = self._applied = np.zeros_like(state.log_weight)
        self.rejected: BoolArray = np.zeros(len(state.age_s), np.bool_)
        """(n,), adaptation was rejected: holds are steadier without its compensation"""
        self.reset_pads(np.arange(len(state.age_s)))

    def set_law_ages(self, age_s: FloatArray) -> None:
        """Set the ages (n,) [s] of the readings that the pads' contact laws were measured by.

        A lasting load reads as its law has it at that age, whatever the exponent of slow creep."""
        self._log_law_age = _log_age(age_s)

    def update_weights(self) -> None:
        """Compute the models' probabilities after the state was changed."""
        log = self._log_prior + self._state.log_weight
        log -= log.max(axis=1, keepdims=True)
        np.exp(log, out=self._weights)
        if self._adapts.any():
            self._pool_evidence()
        self._weights /= self._weights.sum(axis=1, keepdims=True)
        none = self._weights * ~self._adapts
        self.rejected = self._adapts.any() & (none.sum(1) > _REJECTED)
        self._applied = np.where(self.rejected[:, None], none, self._weights)
        self._applied /= self._applied.sum(axis=1, keepdims=True)

    def _pool_evidence(self) -> None:
        """Replace the prior probability that a pad's sheet doesn't adapt by one that follows from the others.

        The material adapts or doesn't; each sheet is an exception with a small probability, which bounds the
        evidence of each pad."""
        probability = self._prior.not_adapting
        odds, rare = probability / (1 - probability), min(_EXCEPTION, probability, 1 - probability)
        adapting = self._weights[:, self._adapts].sum(1)
        ratio = self._weights[:, ~self._adapts].sum(1) / (adapting * odds)
        evidence = np.log(((1 - rare) * ratio + rare) / (rare * ratio + 1 - rare))
        others = 1 / (1 + np.exp(-(math.log(odds) + evidence.sum() - evidence)))
        prior = others * (1 - rare) + (1 - others) * rare
        self._weights[:, ~self._adapts] *= (prior / (1 - prior) / odds)[:, None]

    def mean_back_n(self) -> FloatArray:
        """Return the mean back force (n,) [N] over the models."""
        return np.asarray((self._applied * self._state.back_n).sum(axis=1))

    def spread(self, rows: IntArray | slice) -> tuple[FloatArray, FloatArray]:
        """Return standard deviations over the models (k,): of the back force [N], and of the logarithm of
        slow creep's factor."""
        state, weights, applied = self._state, self._weights[rows], self._applied[rows]
        ages = self._log_growing_time(rows, state.age_s[rows])
        within = (weights * state.exponent_variance[rows] * np.square(ages)).sum(1)
        growth = _variance(weights, applied, state.exponent[rows] * ages) + within
        return np.sqrt(_variance(weights, applied, state.back_n[rows])), np.sqrt(growth)

    @property
    def learned(self) -> FloatArray:
        """Learned behaviour of each pad (n, BANK_LEARNED): log likelihoods, exponents and their variances."""
        state = self._state
        return np.hstack([state.log_weight, state.exponent, state.exponent_variance])

    def set_learned(self, row: int, learned: FloatArray) -> None:
        """Set it for one pad, from a store. Raises ValueError as `check_learned`."""
        check_learned(learned)
        weight, exponent, variance = learned.reshape(3, BANK_MODELS)
        state = self._state
        state.log_weight[row] = np.clip(weight - weight.max(), _MIN_LOG_WEIGHT, 0.0)
        state.exponent[row], state.exponent_variance[row] = exponent, variance
        self.update_weights()

    def set_back_force(self, back_n: FloatArray) -> None:
        """Scale the models' back forces to the mean (n,) [N]."""
        mean = self.mean_back_n()
        adapting = np.maximum((self._weights * (self._share > 0)).sum(1), 1e-3)
        known = mean > 1e-9
        factor = np.where(known, back_n / np.where(known, mean, 1.0), 0.0)
        fresh = np.where(self._share > 0, (back_n / adapting)[:, None], 0.0)
        self._state.back_n[:] = np.where(known[:, None], self._state.back_n * factor[:, None], fresh)

    def reset_pads(self, rows: IntArray) -> None:
        """Reset some pads to fresh sheets of which nothing is known but the prior."""
        for part in fields(self._state):
            getattr(self._state, part.name)[rows] = 0.0
        self._state.growth[rows] = 1.0
        self._state.before[rows] = np.nan
        self._state.exponent_variance[rows] = self._prior.exponent_std**2
        self.update_weights()

    def begin_contacts(self, rows: IntArray, pause: FloatArray, least_kept: float) -> None:
        """Begin contacts after pauses [forget times]; undetected presses may have wiped back forces."""
        state = self._state
        state.back_n[rows] *= least_kept + (1 - least_kept) / (1 + pause[:, None] * state.back_n[rows])
        state.before[rows] = np.nan
        state.sum[rows] = 0.0
        state.window[rows] = 0.0
        state.age_s[rows] = 0.0
        self._update_growth(rows)

    def advance(
        self, effective_n: FloatArray, flow_s: FloatArray, current_flow_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Advance all models under mean effective loads (n,) [N] while current flowed for `flow_s` (n,) [s].

        Return mean over the models (n,) of the fraction of adaptation that remains, and of its share."""
        state, n = self._state, len(flow_s)
        remaining, share = np.ones(n), np.zeros(n)
        rows = np.flatnonzero((flow_s > 0) & (effective_n > 0))
        if not rows.size:
            return remaining, share
        flow, before_s = flow_s[rows], state.age_s[rows]
        age = before_s + flow
        state.age_s[rows] = age
        reading = effective_n[rows] * state.growth[rows]
        creep = np.exp(-state.exponent[rows] * self._log_growing_time(rows, age))
        effective = reading[:, None] * creep
        load = effective + state.back_n[rows]
        speed = 1 + (current_flow_s[rows] + flow / 2) / self._fatigue_s
        learned = -np.expm1(-(flow * speed)[:, None] / self._time_s)
        old = age > _FIRST_S
        self._add_to_windows(rows[old], flow[old], np.log(reading[old]), np.log(load[old]))
        ended = np.exp2(np.ceil(np.log2(np.maximum(before_s, 2 * _FIRST_S)))) <= age
        ended &= state.window[rows, 0] > 0
        if ended.any():
            self._end_windows(rows[ended], (effective / load)[ended])
        state.back_n[rows] += (self._share * load - state.back_n[rows]) * learned
        weights = self._applied[rows]
        learned *= self._share > 0
        mean_learned = (weights * learned).sum(1)
        remaining[rows] = 1 - mean_learned
        share[rows] = (weights * learned * self._share).sum(1) / np.maximum(mean_learned, 1e-12)
        self._update_growth(rows)
        return remaining, share

    def _update_growth(self, rows: IntArray) -> None:
        state = self._state
        creep = np.exp(-state.exponent[rows] * self._log_growing_time(rows, state.age_s[rows]))
        state.growth[rows] = 1 / (self._applied[rows] * creep).sum(1)

    def _log_growing_time(self, rows: IntArray | slice, age_s: FloatArray) -> FloatArray:
        """Return logarithms (k, BANK_MODELS) of ages (k,) [s] over those of the laws, as far as sheets creep
        at them."""
        return np.asarray(_log_age(age_s) - self._log_law_age[rows])

    def _add_to_windows(
        self, rows: IntArray, flow: FloatArray, log_reading: FloatArray, log_load: FloatArray
    ) -> None:
        state = self._state
        state.sum[rows] += flow[:, None] * log_load
        state.window[rows, 0] += flow
        state.window[rows, 1] += flow * log_reading
        state.window[rows, 2] += flow * np.square(log_reading)

    def _end_windows(self, rows: IntArray, slope: FloatArray) -> None:
        """Compare windows that ended with those before; slope (k, BANK_MODELS): log load over reading."""
        state, slope = self._state, np.maximum(slope, _MIN_SLOPE)
        length, total, squares = state.window[rows, :3].T
        mean, reading = state.sum[rows] / length[:, None], total / length
        scatter = np.maximum(squares / length - np.square(reading), 0.0)
        ended = np.column_stack([scatter, length, reading, state.age_s[rows] - length / 2])
        both = np.isfinite(state.before[rows, 0])
        if both.any():
            mean[both] -= self._compare_windows(rows[both], slope[both], mean[both], ended[both])
            self.update_weights()
        state.before[rows], state.sum[rows] = mean, 0.0
        state.window[rows, :3], state.window[rows, 3:] = 0.0, ended

    def _compare_windows(
        self, rows: IntArray, slope: FloatArray, mean: FloatArray, ended: FloatArray
    ) -> FloatArray:
        """Update likelihoods and exponents; return what the latter change in the mean log loads."""
        state, before = self._state, self._state.window[rows, 3:]
        scatter, length, reading, middle_s = ended.T
        scatter_before, length_before, reading_before, middle_before_s = before.T
        ages = _log_age(middle_s) - _log_age(middle_before_s)
        noise = scatter * np.minimum(_CORRELATION_S / length, 1) + _STEADY_STD**2
        noise += scatter_before * np.minimum(_CORRELATION_S / length_before, 1)
        uncertain = state.exponent_variance[rows] * ages
        variance = noise[:, None] + uncertain * ages
        change = reading - reading_before
        adapting = (mean - state.before[rows]) / slope
        saturated = change[:, None] - state.exponent[rows] * ages
        steady = _STEADY_PROBABILITY * (1 - self._saturated) * _density(adapting, variance)
        still = _STEADY_PROBABILITY * self._saturated * _density(saturated, variance)
        unsteady = _density(change, _UNSTEADY_STD**2 + scatter + scatter_before)
        likelihood = steady + still + (1 - _STEADY_PROBABILITY) * unsteady[:, None]
        likelihood = np.maximum(likelihood, _MIN_LIKELIHOOD)  # what no model explains is evidence for none
        gain = uncertain / variance
        move = gain * (steady * adapting + still * saturated) / likelihood
        move = np.clip(state.exponent[rows] + move, 0.0, _MAX_EXPONENT) - state.exponent[rows]
        state.exponent[rows] += move
        state.exponent_variance[rows] *= 1 - gain * ages * (steady + still) / likelihood
        state.exponent_variance[rows] += min(_EXPONENT_WALK, self._prior.exponent_std) ** 2
        found = _KEPT * state.log_weight[rows] + np.log(likelihood)
        found -= found.max(axis=1, keepdims=True)
        state.log_weight[rows] = np.maximum(found, _MIN_LOG_WEIGHT)
        return np.asarray(slope * self._log_growing_time(rows, middle_s) * move)


def check_learned(learned: npt.ArrayLike) -> None:
    """Raise ValueError unless `ModelBank.learned` could have a row of these values."""
    values = np.asarray(learned, np.float64)
    if values.shape != (BANK_LEARNED,) or not np.isfinite(values).all():
        raise ValueError(f"{BANK_LEARNED} finite values are needed, got {values}")
    _, exponent, variance = values.reshape(3, BANK_MODELS)
    if (exponent < 0).any() or (exponent > _MAX_EXPONENT).any() or (variance < 0).any():
        raise ValueError(f"exponents must be from 0 to {_MAX_EXPONENT}, got {exponent}, variances {variance}")


def _log_age(age_s: FloatArray) -> FloatArray:
    """Return logarithms (k, BANK_MODELS) of the ages (k,) [s] that count for slow creep."""
    return np.asarray(np.log(np.clip(age_s[:, None], _CREEP_BEGIN_S, _CREEP_END_S)))


def _density(change: FloatArray, variance: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * np.square(change) / variance) / np.sqrt(variance))


def _variance(weights: FloatArray, applied: FloatArray, values: FloatArray) -> FloatArray:
    """Return the weighted variance of each row about its mean with the applied weights."""
    mean = (applied * values).sum(1, keepdims=True)
    return np.asarray((weights * np.square(values - mean)).sum(1))
