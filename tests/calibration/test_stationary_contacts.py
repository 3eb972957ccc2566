"""Segmentation of contacts into stationary ones, each once, with the noise of its mean."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.calibration.stationary_contacts import StationaryContact, StationaryContactDetector
from handtouch.field import Rectangle

PAD = Rectangle(1.0, 1.0)
NOISE = np.full(4, 1e-7)


def segment_contacts(
    x: NDArray[np.float64], y: NDArray[np.float64], contact: NDArray[np.int64], total: float = 1e-3
) -> list[StationaryContact]:
    """Stationary contacts in samples (k,) on a square, with noise."""
    rng = np.random.default_rng(1)
    currents = total * PAD.fractions(x, y).T + NOISE * rng.normal(size=(len(x), 4))
    detector = StationaryContactDetector(NOISE)
    segments = [
        detector.add_sample(number, row, 10 * k)
        for k, (number, row) in enumerate(zip(contact.tolist(), currents, strict=True))
    ]
    return [segment for segment in segments if segment is not None]


def test_held_contact_is_one_stationary_contact_with_the_noise_of_its_mean() -> None:
    held = np.full(103, 0.4)
    (contact_at_rest,) = segment_contacts(held, held + 0.1, np.array([1] * 102 + [0]))
    assert contact_at_rest.samples == 100
    assert contact_at_rest.noise == pytest.approx(NOISE / 10)
    expected = 1e-3 * PAD.fractions(0.4, 0.5)
    assert np.abs(contact_at_rest.currents - expected).max() < 5e-8


def test_slow_slide_is_many_stationary_contacts_along_its_path() -> None:
    x = np.linspace(0.2, 0.8, 400)
    segments = segment_contacts(x, np.full(400, 0.5), np.array([1] * 399 + [0]))
    assert 10 < len(segments) < 40
    path = PAD.fractions(np.linspace(0.2, 0.8, 20_001), np.full(20_001, 0.5)).T
    for contact_at_rest in segments:
        along = contact_at_rest.currents / contact_at_rest.currents.sum()
        nearest = np.abs(path - along).max(axis=1).min()
        assert nearest < 2e-4


def test_fast_slide_is_no_stationary_contact() -> None:
    x = np.tile(np.linspace(0.1, 0.9, 12), 10)
    assert segment_contacts(x, np.full(120, 0.5), np.array([1] * 119 + [0])) == []


def test_short_contact_is_no_stationary_contact() -> None:
    held = np.full(30, 0.4)
    assert segment_contacts(held, held, np.array([1, 1, 1, 1, 1, 0] * 5)) == []


def test_two_contacts_at_one_position_are_two_stationary_contacts() -> None:
    held = np.full(40, 0.4)
    assert len(segment_contacts(held, held, np.array([1] * 15 + [0] * 5 + [2] * 15 + [0] * 5))) == 2
