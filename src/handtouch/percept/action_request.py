"""Active touch: select the action of largest expected information and request it from the controller.

An estimator that can't decide poses a `Question`: hypotheses with their probabilities, and candidate actions
with the outcome that each hypothesis predicts. The action with the most expected bits per cost is requested.

Public names: `Question`, `CandidateAction`, `ActionRequest`, `ActionSelector`,
`expected_information_bits`, `make_request_message`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from handtouch import wire
from handtouch.percept.messages import make_message

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


def make_request_message(request: ActionRequest, hand: str, link: str) -> wire.Percept:
    """Return the message about an action request; `seq` and `session` are 0."""
    question, action = request.question, request.action
    return make_message(
        "action_request",
        t_ns=request.request_ns,
        hand=hand,
        link=link,
        contact_id=question.contact,
        state="open",
        label=action.kind,
        confidence=None,
        probabilities=dict(question.hypotheses),
        values={**action.parameters, "expected_information_bits": request.expected_information_bits},
        evidence={},
        reason=request.explanation,
        question=question.name,
        expires_ns=request.expires_ns,
    )
