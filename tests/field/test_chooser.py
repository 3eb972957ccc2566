"""The chooser takes the cheapest method that is good enough on the pad as it is, and no better."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.field import ElectrodeNetwork, Rectangle
from handtouch.field.chooser import COSTS, Cost, choose

IDEAL = Rectangle(0.060, 0.034)


def test_a_loose_tolerance_takes_the_papers_method() -> None:
    assert choose(IDEAL, 0.04, 1e-5).method == "log-ratio"
    assert choose(IDEAL, 0.02, 1e-5).method == "log-ratio, adjusted"


def test_a_tight_one_takes_the_table_and_noise_the_likelihood() -> None:
    assert choose(IDEAL, 1e-4, 1e-5, contacts=16).method == "ratio table"
    noisy = choose(IDEAL, 1e-3, 1e-3, contacts=16)
    assert noisy.method == "likelihood, tabulated"
    assert noisy.meets
    assert noisy.error <= 1e-3


def test_resistors_rule_out_what_takes_the_pad_for_ideal() -> None:
    built = ElectrodeNetwork(0.060, 0.034, 0.0005, 2400.0, (100.0,) * 4)
    assert choose(built, 1e-3, 1e-4).method.startswith("likelihood")


def test_an_impossible_tolerance_gets_the_best_there_is_and_says_so() -> None:
    choice = choose(IDEAL, 1e-6, 1e-3)
    assert not choice.meets
    assert choice.error <= 1.05 * min(m.worst for m in choice.maps)


def test_the_choice_is_the_cheapest_that_meets_and_locates() -> None:
    choice = choose(IDEAL, 5e-4, 1e-4, contacts=1000)
    assert [m.cost_us for m in choice.maps] == sorted(m.cost_us for m in choice.maps)
    for tried in choice.maps:
        if tried.method == choice.method:
            break
        assert tried.worst > 5e-4
    currents = IDEAL.fractions(0.02, 0.01)[:, None]
    x, y = choice.locate(currents, np.full((4, 1), 1e-4))
    assert (float(x[0]), float(y[0])) == pytest.approx((0.02, 0.01), abs=1e-6)


def test_other_costs_change_the_choice() -> None:
    costs = {**COSTS, "exact": Cost(0.1, 0.0)}
    assert choose(IDEAL, 1e-4, 1e-5, costs=costs).method == "exact"


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="tolerance"):
        choose(IDEAL, 0.0, 1e-3)
    with pytest.raises(ValueError, match="margin"):
        choose(IDEAL, 1e-3, 1e-3, margin=0.5)
