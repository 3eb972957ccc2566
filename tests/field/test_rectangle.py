"""Rectangle agrees with 25-digit references, with potential theory and with its own inverse."""

from __future__ import annotations

import json
import math
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from handtouch.field import Rectangle

CASES: list[dict[str, Any]] = json.loads((Path(__file__).parent / "data" / "rectangle.json").read_text())
CHANNELS = ("x0", "xa", "y0", "yb")

aspects = st.floats(-3, 3).map(lambda e: 10.0**e)
places = st.floats(0.001, 0.999)
logarithmic_places = st.tuples(st.floats(-12, math.log10(0.5)), st.booleans()).map(
    lambda t: 10.0 ** t[0] if t[1] else 1 - 10.0 ** t[0]
)


@pytest.fixture(autouse=True)
def _floating_point_warnings_are_errors() -> Any:
    with np.errstate(all="raise"):
        yield


def test_fractions_match_the_reference() -> None:
    worst_absolute = worst_relative = 0.0
    for case in CASES:
        fractions = Rectangle(case["a"], case["b"]).side_fractions(case["x"], case["y"])
        for value, name in zip(fractions, CHANNELS, strict=True):
            exact = Decimal(case[name])
            error = abs(Decimal(float(value)) - exact)
            worst_absolute = max(worst_absolute, float(error))
            if exact > Decimal("1e-290"):
                worst_relative = max(worst_relative, float(error / exact))
    assert worst_absolute < 5e-16
    assert worst_relative < 2e-13


def test_conformal_radius_matches_the_reference() -> None:
    for case in CASES:
        if "conformal_radius" in case:
            value = Decimal(float(Rectangle(case["a"], case["b"]).conformal_radius(case["x"], case["y"])))
            assert abs(value / Decimal(case["conformal_radius"]) - 1) < Decimal("2e-15")


def test_location_matches_the_reference() -> None:
    for case in CASES:
        currents = np.array([float(case[name]) for name in CHANNELS])
        found = Rectangle(case["a"], case["b"]).locate(currents)
        for axis, side, pair in (("x", "a", currents[:2]), ("y", "b", currents[2:])):
            if max(pair) == 0:
                assert math.isnan(getattr(found, axis)), "the currents don't determine this coordinate"
            else:
                assert getattr(found, axis) == pytest.approx(case[axis], abs=1e-12 * case[side])
                other = found.y if axis == "x" else found.x
                if math.isfinite(other):
                    assert abs(found.residual) < 1e-15


@given(aspects, logarithmic_places, logarithmic_places)
def test_locate_inverts_the_currents(aspect: float, u: float, v: float) -> None:
    pad = Rectangle(aspect, 1.0)
    x, y = u * aspect, v
    currents = pad.side_fractions(x, y)
    found = pad.locate(currents)
    if min(currents) > 1e-290:
        assert found.x == pytest.approx(x, rel=1e-12, abs=1e-15 * aspect)
        assert found.y == pytest.approx(y, rel=1e-12, abs=1e-15)
        assert abs(found.residual) < 1e-14


@given(aspects, logarithmic_places, logarithmic_places)
def test_current_is_conserved_and_positive(aspect: float, u: float, v: float) -> None:
    fractions = Rectangle(1.0, aspect).side_fractions(u, v * aspect)
    assert fractions.min() >= 0
    assert fractions.sum() == pytest.approx(1, abs=1e-15)


@given(aspects, places, places)
def test_mirrored_and_transposed_pads_agree(aspect: float, u: float, v: float) -> None:
    x, y = u * aspect, v
    f = Rectangle(aspect, 1.0).side_fractions(x, y)
    assert Rectangle(1.0, aspect).side_fractions(y, x) == pytest.approx(
        f[[2, 3, 0, 1]], rel=1e-12, abs=1e-300
    )
    mirrored = Rectangle(aspect, 1.0).side_fractions(aspect - x, y)
    assert mirrored == pytest.approx(f[[1, 0, 2, 3]], rel=1e-10, abs=1e-15)


@given(st.floats(0.2, 5), st.floats(0.02, 0.98), st.floats(0.02, 0.98))
def test_jacobian_equals_the_derivative(aspect: float, u: float, v: float) -> None:
    pad, h = Rectangle(aspect, 1.0), 1e-6
    x, y = u * aspect, v
    fractions, jacobian = pad.fractions_with_jacobian(x, y)
    assert fractions == pytest.approx(pad.fractions(x, y), abs=1e-15)
    by_x = (pad.fractions(x + h, y) - pad.fractions(x - h, y)) / (2 * h)
    by_y = (pad.fractions(x, y + h) - pad.fractions(x, y - h)) / (2 * h)
    assert jacobian[:, 0] == pytest.approx(by_x, abs=1e-6)
    assert jacobian[:, 1] == pytest.approx(by_y, abs=1e-6)


def test_fractions_are_harmonic() -> None:
    pad, h = Rectangle(1.3, 0.8), 1e-3
    x, y = np.meshgrid(np.linspace(0.1, 1.2, 9), np.linspace(0.1, 0.7, 9))
    ring = sum(pad.side_fractions(x + dx, y + dy) for dx, dy in ((h, 0), (-h, 0), (0, h), (0, -h)))
    assert np.abs(ring - 4 * pad.side_fractions(x, y)).max() < 1e-8


def test_worked_values_of_the_unit_square() -> None:
    pad = Rectangle(1, 1)
    assert pad.side_fractions(0.5, 0.5) == pytest.approx(0.25, abs=1e-15)
    expected = [0.176531426977, 0.345349521871, 0.239059525576, 0.239059525576]
    assert pad.side_fractions(0.6, 0.5) == pytest.approx(expected, abs=1e-12)
    assert pad.conformal_radius(0.5, 0.5) == pytest.approx(0.5393526, abs=1e-7)


def test_edges_and_corners_have_their_limits() -> None:
    pad = Rectangle(2.0, 1.0)
    assert pad.side_fractions(0.0, 0.3).tolist() == [1, 0, 0, 0]
    assert pad.side_fractions(2.0, 0.3).tolist() == [0, 1, 0, 0]
    assert pad.side_fractions(0.7, 1.0).tolist() == [0, 0, 0, 1]
    assert pad.side_fractions(0.0, 1.0).tolist() == [0.5, 0, 0, 0.5]
    assert pad.conformal_radius([0, 0, 1], [0, 0.5, 1]).tolist() == [0, 0, 0]
    assert np.isfinite(pad.fractions_with_jacobian([0.0, 2.0, 1.0], [0.5, 0.5, 0.0])[1]).all()
    on_side = pad.locate([1.0, 0, 0, 0])
    assert on_side.x == 0
    assert math.isnan(on_side.y)


def test_minus_zero_is_zero() -> None:
    """Once the sign of -0.0 turned a side's fraction negative."""
    pad = Rectangle(1.0, 1.0)
    assert pad.side_fractions(-0.0, 0.3).tolist() == [1, 0, 0, 0]
    assert pad.side_fractions(-0.0, -0.0).tolist() == [0.5, 0, 0.5, 0]
    assert pad.conformal_radius(-0.0, 0.5) == 0
    assert pad.locate([1.0, -0.0, -0.0, -0.0]).x == 0


@pytest.mark.parametrize("near", [1e-320, 1e-308, 7e-308, 1e-300, 1e-280])
def test_current_is_conserved_next_to_a_corner(near: float) -> None:
    """Once the ratios overflowed here, and half of the current was lost."""
    for u in (1e-320, 3e-309, 1e-307, 1e-290):
        assert Rectangle(1.0, 1.6).side_fractions(near, u).sum() == pytest.approx(1, abs=1e-15)


def test_nan_stays_in_its_own_element() -> None:
    pad = Rectangle(1.0, 1.0)
    x = np.array([0.5, np.nan, -0.1, 1.1, np.inf, 0.5])
    y = np.array([0.5, 0.5, 0.5, 0.5, 0.5, np.nan])
    for value in (pad.side_fractions(x, y), pad.fractions_with_jacobian(x, y)[1], pad.conformal_radius(x, y)):
        assert np.isfinite(value[..., 0]).all()
        assert np.isnan(value[..., 1:]).all()
    found = pad.locate(np.array([[0.25] * 4, [np.nan, 1, 1, 1], [-0.1, 0.5, 0.3, 0.3], [0.25] * 4]).T)
    assert found.x[[0, 3]] == pytest.approx(0.5)
    assert np.isnan(found.x[1:3]).all()


def test_two_contacts_leave_the_papers_residual() -> None:
    """Eqs. 14-15: the pair at 0.5 and 0.7 differs from a point by 1.1913 against 1.0915."""
    pad = Rectangle(1.0, 1.0)
    pair = pad.side_fractions([0.5, 0.7], [0.5, 0.5]).mean(axis=1)
    assert pair == pytest.approx([0.184708, 0.358951, 0.228171, 0.228171], abs=1e-6)
    assert (pair[0] + pair[1]) / (pair[2] + pair[3]) == pytest.approx(1.1913, abs=1e-4)
    assert pad.locate(pair).residual > 0.02
    assert pad.locate(pair[[2, 3, 0, 1]]).residual < -0.02
    assert pad.locate(pair * 3e-6).total == pytest.approx(3e-6)


@pytest.mark.parametrize("scale", [1e-290, 1e-150, 1.0, 1e150, 1e290])
def test_units_make_no_difference(scale: float) -> None:
    pad, scaled = Rectangle(1.5, 1.0), Rectangle(1.5 * scale, scale)
    x, y = np.array([0.7, 1e-9, 0.3]), np.array([0.2, 0.5, 1e-12])
    f = scaled.side_fractions(x * scale, y * scale)
    assert f == pytest.approx(pad.side_fractions(x, y), rel=1e-13)
    assert scaled.locate(f * scale).x / scale == pytest.approx(x, rel=1e-12)
    assert scaled.conformal_radius(x * scale, y * scale) / scale == pytest.approx(
        pad.conformal_radius(x, y), rel=1e-12
    )


def test_scalars_in_scalars_out_and_shapes_broadcast() -> None:
    pad = Rectangle(1, 1)
    found = pad.locate(np.array([3, 1, 2, 2], dtype=np.int32))
    assert float(found.x) < 0.5
    assert found.y == pytest.approx(0.5, abs=2e-16)  # processors differ in the last bit of a logarithm
    assert isinstance(found.total, float)
    assert pad.side_fractions(np.full((3, 1), 0.5), np.linspace(0.1, 0.9, 5)).shape == (4, 3, 5)
    assert pad.locate(np.zeros((4, 0))).x.shape == (0,)
    assert pad.locate(np.ones((4, 2, 3))).residual.shape == (2, 3)
    with pytest.raises(ValueError, match="x0, xa, y0, yb"):
        pad.locate(np.ones((3, 4)))


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_impossible_sides_are_named(bad: float) -> None:
    with pytest.raises(ValueError, match="a = "):
        Rectangle(bad, 1.0)
    with pytest.raises(ValueError, match="b = "):
        Rectangle(1.0, bad)


sides = st.floats(1e-320, 1.7e308)


@given(sides, sides)
@example(1e-308, 1e308)
@example(1e308, 1e-308)
@example(1e300, 1.0)
def test_any_positive_sides_make_a_pad_or_are_refused(a: float, b: float) -> None:
    if max(a, b) / 1e100 > min(a, b):
        with pytest.raises(ValueError, match="times as long as the other"):
            Rectangle(a, b)
        return
    pad = Rectangle(a, b)
    fractions = pad.side_fractions(a / 2, b / 2)
    assert fractions.sum() == pytest.approx(1, rel=1e-15)
    assert fractions[[0, 2]] == pytest.approx(fractions[[1, 3]], abs=1e-3)  # halves of subnormal sides round
    assert 0 < pad.conformal_radius(a / 2, b / 2) <= 1.1 * min(a, b)
    assert not np.isnan(pad.fractions_with_jacobian(a / 2, b / 2)[0]).any()


def test_a_strip_of_any_length_ends_as_a_half_infinite_one() -> None:
    """Side x0 is seen under 2 / pi atan(sin(pi y) / sinh(pi x)) from a strip of unit width."""
    for length in (1e3, 1e10, 1e50, 1e100):
        pad = Rectangle(length, 1.0)
        fractions = pad.side_fractions(0.7, 0.3)
        expected = 2 / np.pi * np.arctan(np.sin(0.3 * np.pi) / np.sinh(0.7 * np.pi))
        assert fractions[0] == pytest.approx(expected, rel=1e-14)
        found = pad.locate(fractions)
        assert (found.x, found.y) == pytest.approx((0.7, 0.3), rel=1e-13)
