"""Simulated sheets of any outline: Green's function between contacts that don't move."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from handtouch.simulate.outline_geometry import SimulatedOutline
from handtouch.simulate.outline_solver import outline_mutual_resistance
from handtouch.simulate.sheet_solver import ElectrodeGaps

RADIUS_MM = 9.0
QUARTER_MM = math.pi * RADIUS_MM / 2
DISC = SimulatedOutline.from_table(
    SimpleNamespace(
        outline_x_mm=[RADIUS_MM, -RADIUS_MM],
        outline_y_mm=[0.0, 0.0],
        edge_turn_deg=[180.0, 180.0],
        corners_mm=[QUARTER_MM * (side + 0.5) for side in (2, 3, 0, 1)],
    ),
    "plane",
)
GROUNDED = ElectrodeGaps((0, 0), (0, 0), (0, 0), (0, 0))
TIMES = 25
PAIRS = [((0.3, 0.4), (0.7, 0.6)), ((0.5, 0.5), (0.8, 0.3)), ((0.2, 0.2), (0.3, 0.7))]


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_contacts_at_rest_on_a_grounded_disc_have_the_mutual_resistance_of_images(
    one: tuple[float, float], other: tuple[float, float]
) -> None:
    at = [np.repeat(np.array(place)[:, None], TIMES, axis=1) for place in (one, other)]
    green = outline_mutual_resistance(DISC, GROUNDED)
    found = green.resistance_ohm(at[0], at[1], np.full(TIMES, 1e-4))
    a, b = (complex(*DISC.drawing(place[:, :1])[0][:, 0]) / (1e-3 * RADIUS_MM) for place in at)
    exact = math.log(abs(1 - a * b.conjugate()) / abs(a - b)) / (2 * math.pi)
    assert found == pytest.approx(exact, abs=2e-5)
    assert len(set(found.tolist())) == 1


def test_contacts_that_rest_one_after_the_other_need_no_table() -> None:
    outline_mutual_resistance.cache_clear()
    green = outline_mutual_resistance(DISC, GROUNDED)
    one, other = np.repeat(np.array(PAIRS).transpose(1, 2, 0), TIMES, axis=2)
    found = green.resistance_ohm(one, other, np.full(TIMES * len(PAIRS), 1e-4))
    solved = [green.static_resistance_ohm(*a, *b, 1e-4) for a, b in PAIRS]
    assert found.tolist() == np.repeat(solved, TIMES).tolist()
    assert "_table" not in vars(green)


def test_the_mutual_resistance_of_contacts_at_rest_is_that_of_the_table_of_moving_ones() -> None:
    green = outline_mutual_resistance(DISC, GROUNDED)
    (one, other), few = np.array(PAIRS).transpose(1, 2, 0), np.full(len(PAIRS), 1e-4)
    solved = [green.static_resistance_ohm(*a, *b, 1e-4) for a, b in zip(one.T, other.T, strict=True)]
    assert green.resistance_ohm(one, other, few) == pytest.approx(solved, abs=3e-4)
