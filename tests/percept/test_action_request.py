"""Active touch: the action of most information per cost is requested, once until it expires."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.field import contact_stack_resistance
from handtouch.percept.action_request import (
    ActionSelector,
    CandidateAction,
    Question,
    expected_information_bits,
    squeeze_action,
    update_probabilities,
)

OHM_PER_SQUARE, OUTER_M, VOLT = 2400.0, 0.02, 12.0
CONTACT_OHM_M2, REFERENCE_PA, ALPHA = 0.005, 1e4, 1.5
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


def current(force_n: float, radius_m: float) -> float:
    """Return the current of a disc under even pressure on sheet S1: eqs. 9 to 12 of the paper."""
    area = math.pi * radius_m**2
    contact = CONTACT_OHM_M2 * (force_n / area / REFERENCE_PA) ** -ALPHA
    return VOLT / float(contact_stack_resistance(OHM_PER_SQUARE, contact, radius_m, OUTER_M))


def spacer(force_n: float) -> float:
    """Return the current of a spacer of about 1 cm square, of constant area."""
    return current(force_n, 0.01 / math.sqrt(math.pi))


def sphere(force_n: float) -> float:
    """Return the current of a sphere of 0.8 cm radius on rubber of some 2 MPa, by Hertz."""
    return current(force_n, (0.75 * force_n * 0.008 / 2.7e6) ** (1 / 3))


CURVES: dict[str, Callable[[float], float]] = {"spacer": spacer, "sphere": sphere}


def test_squeezing_separates_the_two_curves_of_figure_8_with_a_crude_force_estimate() -> None:
    now = sphere(0.1)  # the ball's own weight: one current that both objects may give
    harder = squeeze_action(CURVES, now, force_std=0.3)
    still = CandidateAction("hold", {"duration_s": 0.5}, dict.fromkeys(CURVES, (0.0, 0.05)))
    posed = Question("object", 0, 0, 1, {"spacer": 0.5, "sphere": 0.5}, [still, harder])
    (request,) = ActionSelector().select_requests([posed], 0)
    assert request.action.kind == "squeeze"
    assert request.expected_information_bits > 0.5
    assert "bits open" in request.explanation


@pytest.mark.parametrize("true", ["spacer", "sphere"])
def test_object_is_identified_after_a_few_squeezes(true: str) -> None:
    rng = np.random.default_rng(8)
    settled = 0
    for _ in range(12):
        now = sphere(0.1)
        prior = {"spacer": 0.5, "sphere": 0.5}
        low, high = 1e-4, 1e3
        for _ in range(40):  # force that the true object gives this current at
            middle = math.sqrt(low * high)
            low, high = (middle, high) if CURVES[true](middle) < now else (low, middle)
        for _ in range(3):
            action = squeeze_action(CURVES, now)
            really = 2.0 * math.exp(0.3 * rng.standard_normal())
            measured = math.log(CURVES[true](low * really) / now) + 0.05 * rng.standard_normal()
            prior = update_probabilities(Question("object", 0, 0, 1, prior, [action]), action, measured)
        settled += prior[true] > 0.95
    assert settled >= 10
