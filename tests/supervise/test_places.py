"""What becomes a place of a contact: where it stood still, once, and as sure as its samples make it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.field import Rectangle
from handtouch.supervise.places import Place, Places

PAD = Rectangle(1.0, 1.0)
NOISE = np.full(4, 1e-7)


def cut(
    x: NDArray[np.float64], y: NDArray[np.float64], contact: NDArray[np.int64], total: float = 1e-3
) -> list[Place]:
    """Places of samples (k,) on a square, with noise."""
    rng = np.random.default_rng(1)
    currents = total * PAD.fractions(x, y).T + NOISE * rng.normal(size=(len(x), 4))
    places = Places(NOISE)
    taken = [
        places.take(number, row, 10 * k)
        for k, (number, row) in enumerate(zip(contact.tolist(), currents, strict=True))
    ]
    return [place for place in taken if place is not None]


def test_a_held_contact_is_one_place_with_the_noise_of_its_mean() -> None:
    held = np.full(103, 0.4)
    (place,) = cut(held, held + 0.1, np.array([1] * 102 + [0]))
    assert place.samples == 100
    assert place.noise == pytest.approx(NOISE / 10)
    expected = 1e-3 * PAD.fractions(0.4, 0.5)
    assert np.abs(place.currents - expected).max() < 5e-8


def test_a_slow_slide_is_many_places_each_where_its_currents_say() -> None:
    x = np.linspace(0.2, 0.8, 400)
    places = cut(x, np.full(400, 0.5), np.array([1] * 399 + [0]))
    assert 10 < len(places) < 40
    path = PAD.fractions(np.linspace(0.2, 0.8, 20_001), np.full(20_001, 0.5)).T
    for place in places:
        along = place.currents / place.currents.sum()
        nearest = np.abs(path - along).max(axis=1).min()
        assert nearest < 2e-4


def test_a_quick_slide_is_no_place() -> None:
    x = np.tile(np.linspace(0.1, 0.9, 12), 10)
    assert cut(x, np.full(120, 0.5), np.array([1] * 119 + [0])) == []


def test_what_is_too_short_is_no_place() -> None:
    held = np.full(30, 0.4)
    assert cut(held, held, np.array([1, 1, 1, 1, 1, 0] * 5)) == []


def test_two_touches_at_one_place_are_two_places_of_two_contacts() -> None:
    held = np.full(40, 0.4)
    assert len(cut(held, held, np.array([1] * 15 + [0] * 5 + [2] * 15 + [0] * 5))) == 2
