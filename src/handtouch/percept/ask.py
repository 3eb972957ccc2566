"""Active touch: what to ask of the controller, to settle what is open; chosen by expected information.

A part that can't decide states a `Question`: hypotheses with their probabilities, and actions with the
outcome that each hypothesis predicts. The action that is expected to tell most bits for its cost is asked
for.

Public names: `Question`, `Action`, `Ask`, `Asker`, `expected_bits`, `updated`, `squeeze`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(33)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


@dataclass(frozen=True, slots=True)
class Action:
    """Something small that the hand could do, and what would then be measured under each hypothesis.

    `do`: squeeze, slide, roll, hold, lift or press; `amount`: by name with its unit, as the message has it.
    """

    do: str
    amount: Mapping[str, float | str]
    outcomes: Mapping[str, tuple[float, float]]
    """hypothesis -> mean and standard deviation of the one number that the action yields; the deviation has
    the noise of the measurement, and what the hypothesis itself leaves open"""
    cost: float = 1.0
    """in units of a plain one: disturbing a grasp costs more"""
    outcome: str = ""
    """the name of that number, for people"""


@dataclass(frozen=True, slots=True)
class Question:
    """Something open: `name` is which, of the contact on a pad; probabilities of its hypotheses sum to 1."""

    name: str
    hand: int
    pad: int
    contact: int
    hypotheses: Mapping[str, float]
    actions: Sequence[Action]


@dataclass(frozen=True, slots=True)
class Ask:
    """A question with the action that would settle it best."""

    question: Question
    action: Action
    bits: float
    """expected information"""
    t_ns: int
    expires_ns: int
    why: str


def expected_bits(question: Question, action: Action) -> float:
    """Mutual information [bits] of hypothesis and outcome, 0 to the entropy of the hypotheses.

    Outcomes are normal under each hypothesis, their mixture is integrated by Gauss-Hermite quadrature about
    each. Raises ValueError for an action that predicts nothing under some hypothesis, or a deviation of 0.
    """
    missing = [name for name in question.hypotheses if name not in action.outcomes]
    if missing:
        raise ValueError(f"{question.name}: {action.do} predicts nothing for {', '.join(missing)}")
    prior = np.array(list(question.hypotheses.values()))
    mean, std = np.array([action.outcomes[name] for name in question.hypotheses]).T
    if not (std > 0).all():
        raise ValueError(f"{question.name}: outcomes of {action.do} need deviations above 0")
    at = mean[:, None] + std[:, None] * _NODES  # (hypothesis that is true, node)
    z = (at[:, :, None] - mean) / std
    likelihood = np.exp(-0.5 * z * z) / std
    mixture = likelihood @ prior
    own = np.diagonal(likelihood, axis1=0, axis2=2).T
    bits = (np.log2(np.maximum(own, 1e-300) / np.maximum(mixture, 1e-300)) * _WEIGHTS).sum(axis=1)
    return float(max(prior @ bits, 0.0))


@dataclass
class Asker:
    """Chooses at most one thing to ask for of each hand at a time, not again while it may still be done."""

    least_bits: float = 0.2
    """below this it isn't worth the motion"""
    every_ns: int = 100_000_000
    """from one look at what is open to the next"""
    patience_ns: int = 2_000_000_000
    """a request expires after this, and is then made anew if the question is still open"""
    _looked_ns: int = -(10**18)
    _open: dict[int, Ask] = field(default_factory=dict)

    def due(self, t_ns: int) -> bool:
        """Whether to look at the questions now."""
        return t_ns - self._looked_ns >= self.every_ns

    def choose(self, questions: Sequence[Question], t_ns: int) -> list[Ask]:
        """The best request of each hand, if it is new and tells enough."""
        self._looked_ns = t_ns
        best: dict[int, Ask] = {}
        for question in questions:
            for action in question.actions:
                bits = expected_bits(question, action)
                known = best.get(question.hand)
                if bits < self.least_bits or (
                    known is not None and bits / action.cost <= known.bits / known.action.cost
                ):
                    continue
                why = _why(question, action, bits)
                best[question.hand] = Ask(question, action, bits, t_ns, t_ns + self.patience_ns, why)
        for hand in [hand for hand in self._open if hand not in best]:
            del self._open[hand]
        return [ask for hand, ask in best.items() if self._is_new(hand, ask, t_ns)]

    def _is_new(self, hand: int, ask: Ask, t_ns: int) -> bool:
        before = self._open.get(hand)
        if before is not None and t_ns < before.expires_ns and _key(before) == _key(ask):
            return False
        self._open[hand] = ask
        return True


def _key(ask: Ask) -> tuple[str, int, int, str]:
    return ask.question.name, ask.question.pad, ask.question.contact, ask.action.do


def _why(question: Question, action: Action, bits: float) -> str:
    open_bits = -sum(p * math.log2(p) for p in question.hypotheses.values() if p > 0)
    told = ", ".join(
        f"{name} ({p:.0%}) would give {action.outcomes[name][0]:.3g} +- {action.outcomes[name][1]:.2g}"
        for name, p in sorted(question.hypotheses.items(), key=lambda item: -item[1])
    )
    what = f" of {action.outcome}" if action.outcome else ""
    return f"{told}{what}: {bits:.2f} of {open_bits:.2f} bits open"


def updated(question: Question, action: Action, measured: float) -> dict[str, float]:
    """Probabilities of the hypotheses once the action was done and gave `measured`."""
    log_odds = {}
    for name, prior in question.hypotheses.items():
        mean, std = action.outcomes[name]
        log_odds[name] = math.log(max(prior, 1e-300)) - 0.5 * ((measured - mean) / std) ** 2 - math.log(std)
    most = max(log_odds.values())
    weights = {name: math.exp(value - most) for name, value in log_odds.items()}
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}


def squeeze(
    curves: Mapping[str, Callable[[float], float]],
    current_a: float,
    *,
    harder: float = 2.0,
    force_std: float = 0.3,
    current_std: float = 0.05,
    between_n: tuple[float, float] = (1e-4, 1e3),
) -> Action:
    """Press `harder` times as hard: what the total current then does, under curves of current against force.

    Each hypothesis explains the present current by a force of its own, where its curve, which must rise, has
    it; the outcome is ln of the current over the present one. force_std: of ln of how much harder it really
    was, for the controller's measure of force may be crude (paper 4.5, fig. 8); current_std: of ln of the
    current, as sheets repeat. Raises ValueError where a curve doesn't reach the current between these forces.
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
    return Action("squeeze", {"force_ratio": harder}, outcomes, outcome="ln of current over current now")
