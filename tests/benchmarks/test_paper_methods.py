"""The paper's methods reproduce the paper."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.paper_methods import LogRatioTable, single_sum_fractions
from handtouch.arrays import FloatArray
from handtouch.field import Rectangle
from handtouch.field.figures import log_ratio

SQUARE = Rectangle(1.0, 1.0)


def grid(pad: Rectangle, margin: float, count: int = 31) -> tuple[FloatArray, FloatArray]:
    side = np.linspace(margin, 1 - margin, count)
    x, y = np.meshgrid(pad.a * side, pad.b * side)
    return x, y


def test_ten_terms_of_the_single_sum_conserve_current() -> None:
    """Within 0.01 % between 0.1 and 0.9 of full scale."""
    x, y = grid(SQUARE, 0.1)
    assert np.abs(single_sum_fractions(SQUARE, x, y).sum(axis=0) - 1).max() < 5e-4
    x, y = grid(SQUARE, 0.05)
    many = single_sum_fractions(SQUARE, x, y, terms=60)
    assert np.abs(many - SQUARE.side_fractions(x, y)).max() < 1e-5


@pytest.mark.parametrize("aspect", [1e-3, 0.3, 1.0, 40.0])
def test_the_single_sum_does_not_overflow(aspect: float) -> None:
    pad = Rectangle(aspect, 1.0)
    with np.errstate(all="raise"):
        fractions = single_sum_fractions(pad, 0.4 * aspect, 0.6, terms=400)
    assert fractions == pytest.approx(pad.side_fractions(0.4 * aspect, 0.6), abs=2e-3)


def test_log_ratio_error_matches_theory() -> None:
    """0.12 of the side rms, 0.53 at worst; and 0.6068 for a point at 0.6 (the paper prints 0.608)."""
    worst, rms = (
        np.hypot(*(np.array(log_ratio(SQUARE, SQUARE.side_fractions(x, y))) - (x, y)))
        for x, y in (grid(SQUARE, 0.05), np.random.default_rng(1).uniform(0.05, 0.95, (2, 5000)))
    )
    assert np.sqrt((rms**2).mean()) == pytest.approx(0.12, abs=0.01)
    assert worst.max() == pytest.approx(0.53, abs=0.01)
    assert log_ratio(SQUARE, SQUARE.side_fractions(0.6, 0.5))[0] == pytest.approx(0.6068, abs=5e-5)
    pair = SQUARE.side_fractions([0.5, 0.7], [0.5, 0.5]).mean(axis=1)
    assert log_ratio(SQUARE, pair)[0] == pytest.approx(0.606, abs=5e-4)


@pytest.mark.parametrize("aspect", [1.0, 1.77])
def test_correction_table_improves_with_its_cells(aspect: float) -> None:
    pad = Rectangle(aspect, 1.0)
    x, y = grid(pad, 0.05)
    currents = pad.side_fractions(x, y)
    worst = []
    for cells in (0, 16, 32):
        found = LogRatioTable(pad, cells).locate(currents)
        worst.append(float(np.hypot(found[0] - x, found[1] - y).max()))
    assert worst[0] > 20 * worst[1]
    assert 2.5 < worst[1] / worst[2] < 6


def test_invalid_input_is_nan_in_its_own_element_or_named() -> None:
    currents = np.array([[0.25] * 4, [np.nan, 1, 1, 1], [-0.1, 0.5, 0.3, 0.3]]).T
    with np.errstate(all="raise"):
        found = LogRatioTable(SQUARE).locate(currents)
        assert found[0][0] == pytest.approx(0.5, abs=1e-3)
        assert np.isnan(found[0][1:]).all()
        assert np.isnan(single_sum_fractions(SQUARE, [0.5, 2.0], 0.5)[:, 1]).all()
    with pytest.raises(ValueError, match="terms = 0"):
        single_sum_fractions(SQUARE, 0.5, 0.5, terms=0)
