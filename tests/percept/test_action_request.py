"""Active touch: the action of most information per cost is requested, once until it expires."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.percept.action_request import (
    ActionSelector,
    CandidateAction,
    Question,
    expected_information_bits,
)

HALF = {"a": 0.5, "b": 0.5}


def question(*actions: CandidateAction, hypotheses: dict[str, float] = HALF) -> Question:
    return Question("which", 0, 0, 1, hypotheses, actions)


@given(
    st.floats(0.01, 0.99),
    st.floats(-5, 5),
    st.floats(-5, 5),
    st.floats(0.05, 5),
    st.floats(0.05, 5),
)
def test_expected_information_is_between_zero_and_the_entropy(
    prior: float, first: float, second: float, std: float, other: float
) -> None:
    action = CandidateAction("squeeze", {}, {"a": (first, std), "b": (second, other)})
    posed = question(action, hypotheses={"a": prior, "b": 1 - prior})
    open_bits = -prior * math.log2(prior) - (1 - prior) * math.log2(1 - prior)
    assert -1e-9 <= expected_information_bits(posed, action) <= open_bits + 0.02


def test_expected_information_equals_the_integral() -> None:
    action = CandidateAction("squeeze", {}, {"a": (0.0, 1.0), "b": (1.5, 0.7)})
    x = np.linspace(-12, 12, 200_001)
    a = np.exp(-0.5 * x**2) / math.sqrt(2 * math.pi)
    b = np.exp(-0.5 * ((x - 1.5) / 0.7) ** 2) / (0.7 * math.sqrt(2 * math.pi))
    mixture = (a + b) / 2
    expected = sum(np.trapezoid(0.5 * p * np.log2(np.maximum(p, 1e-300) / mixture), x) for p in (a, b))
    assert expected_information_bits(question(action), action) == pytest.approx(expected, abs=2e-3)


def test_equal_predictions_have_no_information() -> None:
    action = CandidateAction("hold", {}, {"a": (1.0, 0.3), "b": (1.0, 0.3)})
    assert expected_information_bits(question(action), action) == pytest.approx(0.0, abs=1e-9)
    assert ActionSelector().select_requests([question(action)], 0) == []


def test_action_without_prediction_for_a_hypothesis_is_rejected() -> None:
    with pytest.raises(ValueError, match="no prediction for b"):
        expected_information_bits(question(), CandidateAction("hold", {}, {"a": (0.0, 1.0)}))


def test_cheaper_of_two_equal_actions_is_requested_once_until_it_expires() -> None:
    far = {"a": (0.0, 1.0), "b": (4.0, 1.0)}
    selector = ActionSelector()
    both = [question(CandidateAction("slide", {}, far, cost=3.0), CandidateAction("squeeze", {}, far))]
    (posed,) = selector.select_requests(both, 0)
    assert posed.action.kind == "squeeze"
    assert selector.select_requests(both, 10) == []
    assert len(selector.select_requests(both, posed.expires_ns)) == 1
