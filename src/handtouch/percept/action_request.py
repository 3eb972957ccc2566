"""Active touch: select the action of largest expected information and request it from the controller.

An estimator that can't decide poses a `Question`: hypotheses with their probabilities, and candidate actions
with the outcome that each hypothesis predicts. The action with the most expected bits per cost is requested.

Public names: `Question`, `CandidateAction`, `ActionRequest`, `ActionSelector`, `expected_information_bits`,
`update_probabilities`, `squeeze_action`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

_HERMITE_NODES, _HERMITE_WEIGHTS = np.polynomial.hermite_e.hermegauss(33)
_HERMITE_WEIGHTS = _HERMITE_WEIGHTS / _HERMITE_WEIGHTS.sum()


@dataclass(frozen=True, slots=True)
class CandidateAction:
    """A small motion of the hand, and the measurement that each hypothesis predicts for it.

    `kind`: squeeze, slide, roll, hold, lift, press or touch; `parameters`: values by name with
    unit, as published.
    """

    kind: str
    parameters: Mapping[str, float | str | Sequence[float]]
    predicted_outcomes: Mapping[str, tuple[float, float]]
    """hypothesis -> mean and standard deviation of the one number that the action measures; the deviation
    includes measurement noise and what the hypothesis itself leaves open"""
    cost: float = 1.0
    """relative to a plain squeeze; actions that disturb a grasp cost more"""
    outcome_name: str = ""
    """human-readable name of the measured number"""


@dataclass(frozen=True, slots=True)
class Question:
    """An open question `name` about the contact on a pad; the probabilities of its hypotheses sum to 1."""

    name: str
    hand: int
    pad: int
    contact: int
    hypotheses: Mapping[str, float]
    actions: Sequence[CandidateAction]


@dataclass(frozen=True, slots=True)
class ActionRequest:
    """A question with the action that is expected to answer it best."""

    question: Question
    action: CandidateAction
    expected_information_bits: float
    """mutual information of hypothesis and outcome"""
    request_ns: int
    expires_ns: int
    explanation: str


def expected_information_bits(question: Question, action: CandidateAction) -> float:
    """Return the mutual information [bits] of hypothesis and outcome, 0 to the entropy of the hypotheses.

    Outcomes are normal under each hypothesis; their mixture is integrated by Gauss-Hermite quadrature about
    each mean. Raises ValueError for an action without a prediction for some hypothesis, or with a deviation
    of 0.
    """
    missing = [name for name in question.hypotheses if name not in action.predicted_outcomes]
    if missing:
        raise ValueError(f"{question.name}: {action.kind} no prediction for {', '.join(missing)}")
    prior = np.array(list(question.hypotheses.values()))
    mean, std = np.array([action.predicted_outcomes[name] for name in question.hypotheses]).T
    if not (std > 0).all():
        raise ValueError(f"{question.name}: outcomes of {action.kind} need positive deviations")
    at = mean[:, None] + std[:, None] * _HERMITE_NODES  # (true hypothesis, node)
    z = (at[:, :, None] - mean) / std
    likelihood = np.exp(-0.5 * z * z) / std
    mixture = likelihood @ prior
    own = np.diagonal(likelihood, axis1=0, axis2=2).T
    bits = (np.log2(np.maximum(own, 1e-300) / np.maximum(mixture, 1e-300)) * _HERMITE_WEIGHTS).sum(axis=1)
    return float(max(prior @ bits, 0.0))


@dataclass
class ActionSelector:
    """Selects at most one action request per hand, and repeats none before it expires."""

    min_information_bits: float = 0.2
    """an action expected to yield less isn't requested"""
    poll_period_ns: int = 100_000_000
    """from one evaluation of the open questions to the next"""
    request_lifetime_ns: int = 2_000_000_000
    """a request expires after this, and is renewed if the question is still open"""
    _last_poll_ns: int = -(10**18)
    _open_requests: dict[int, ActionRequest] = field(default_factory=dict)

    def is_due(self, now_ns: int) -> bool:
        """Return whether the questions are due for evaluation."""
        return now_ns - self._last_poll_ns >= self.poll_period_ns

    def select_requests(self, questions: Sequence[Question], now_ns: int) -> list[ActionRequest]:
        """Return the best new request of each hand that has enough expected information."""
        self._last_poll_ns = now_ns
        best: dict[int, ActionRequest] = {}
        for question in questions:
            for action in question.actions:
                bits = expected_information_bits(question, action)
                known = best.get(question.hand)
                if bits < self.min_information_bits or (
                    known is not None
                    and bits / action.cost <= known.expected_information_bits / known.action.cost
                ):
                    continue
                why = _explain_request(question, action, bits)
                best[question.hand] = ActionRequest(
                    question, action, bits, now_ns, now_ns + self.request_lifetime_ns, why
                )
        for hand in [hand for hand in self._open_requests if hand not in best]:
            del self._open_requests[hand]
        return [ask for hand, ask in best.items() if self._is_new(hand, ask, now_ns)]

    def _is_new(self, hand: int, ask: ActionRequest, now_ns: int) -> bool:
        before = self._open_requests.get(hand)
        if before is not None and now_ns < before.expires_ns and _request_key(before) == _request_key(ask):
            return False
        self._open_requests[hand] = ask
        return True


def _request_key(ask: ActionRequest) -> tuple[str, int, int, str]:
    return ask.question.name, ask.question.pad, ask.question.contact, ask.action.kind


def _explain_request(question: Question, action: CandidateAction, bits: float) -> str:
    open_bits = -sum(p * math.log2(p) for p in question.hypotheses.values() if p > 0)
    outcomes = ", ".join(
        f"{name} ({p:.0%}) predicts {action.predicted_outcomes[name][0]:.3g} +- "
        f"{action.predicted_outcomes[name][1]:.2g}"
        for name, p in sorted(question.hypotheses.items(), key=lambda item: -item[1])
    )
    quantity = f" of {action.outcome_name}" if action.outcome_name else ""
    return f"{outcomes}{quantity}: {bits:.2f} of {open_bits:.2f} bits open"


def update_probabilities(question: Question, action: CandidateAction, measured: float) -> dict[str, float]:
    """Return the probabilities of the hypotheses after the action was done and yielded `measured`."""
    log_odds = {}
    for name, prior in question.hypotheses.items():
        mean, std = action.predicted_outcomes[name]
        log_odds[name] = math.log(max(prior, 1e-300)) - 0.5 * ((measured - mean) / std) ** 2 - math.log(std)
    most = max(log_odds.values())
    weights = {name: math.exp(value - most) for name, value in log_odds.items()}
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}


def squeeze_action(
    curves: Mapping[str, Callable[[float], float]],
    current_a: float,
    *,
    harder: float = 2.0,
    force_std: float = 0.3,
    current_std: float = 0.05,
    between_n: tuple[float, float] = (1e-4, 1e3),
) -> CandidateAction:
    """Return the action of pressing `harder` times as hard, for hypotheses of current over force.

    Each hypothesis explains the present current by a force of its own, found on its curve, which must be
    increasing; the outcome is ln of the current over the present one. force_std: of ln of the actual force
    ratio, because the controller's force estimate may be crude (paper 4.5, fig. 8); current_std: of ln of the
    current, the repeatability of sheets. Raises ValueError where a curve doesn't reach the current within
    `between_n`.
    """
    outcomes = {}
    for name, curve in curves.items():
        low, high = between_n
        if not curve(low) < current_a < curve(high):
            raise ValueError(f"{name}: no force from {low} to {high} N gives {current_a:.3g} A")
        for _ in range(40):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if curve(middle) < current_a else (low, middle)
        force = math.sqrt(low * high)
        slope = math.log(curve(force * harder * 1.01) / curve(force * harder / 1.01)) / (2 * math.log(1.01))
        outcomes[name] = (
            math.log(curve(force * harder) / current_a),
            math.hypot(slope * force_std, current_std),
        )
    return CandidateAction(
        "squeeze", {"force_ratio": harder}, outcomes, outcome_name="ln of current over current now"
    )
