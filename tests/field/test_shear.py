"""Shear pads: laws of the overlap, derivatives, round trips, covariance, and compensation of the pressure."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.field.elastic_layer import ElasticLayer, calibrate_layer
from handtouch.field.shear import (
    BarPattern,
    DiscPattern,
    FilmLaw,
    ShearPattern,
    edge_excess,
    gap_loss,
    overlap_ratio,
)
from handtouch.field.shear_estimate import ShearPad

MM = 1e-3
BARS = (0.6 * MM, 6 * MM, 0.4 * MM, 0.15 * MM)
PATTERNS: dict[str, ShearPattern] = {
    "bars": BarPattern.single(3, 3.4 * MM, *BARS),
    "crossed bars": BarPattern.crossed(2, 3.4 * MM, *BARS),
    "pinwheel": BarPattern.pinwheel(5 * MM, 0.8 * MM, 5 * MM, 0.15 * MM),
    "discs": DiscPattern(9, 2 * MM, 0.4 * MM, 0.15 * MM),
}
FILM = FilmLaw(110.0, 5e4, 0.3, 1.96e-4, 1.63e-5)
CONDUCTANCE = 110.0
every_pattern = pytest.mark.parametrize("pattern", PATTERNS.values(), ids=list(PATTERNS))


def motions(pattern: ShearPattern, count: int) -> NDArray[np.float64]:
    """Return random motions (k, count) within half the travel, twists up to 0.05 rad."""
    rng = np.random.default_rng(1)
    size = np.full((len(pattern.components), 1), pattern.travel_m / 2)
    size[2:] = 0.05
    motion: NDArray[np.float64] = rng.uniform(-1, 1, (len(size), count)) * size / math.sqrt(2)
    return motion


def test_overlap_and_distance_are_dual() -> None:
    """The film's other pair of sides are the electrodes of the same problem with -s."""
    s = np.linspace(-5, 5, 41)
    np.testing.assert_allclose(overlap_ratio(s)[0] * overlap_ratio(-s)[0], 1, rtol=1e-13)


def test_a_wide_overlap_gains_one_excess_at_each_end() -> None:
    ratio, slope = overlap_ratio(np.array([10.0, 40.0]))
    np.testing.assert_allclose(ratio, np.array([10.0, 40.0]) + 2 * edge_excess(1.0), rtol=1e-12)
    np.testing.assert_allclose(slope, 1, rtol=1e-12)


def test_a_wide_gap_loses_its_width_less_two_excesses_and_a_narrow_one_nothing() -> None:
    assert gap_loss(20.0, 1.0) == pytest.approx(20 - 2 * edge_excess(1.0), rel=1e-12)
    assert gap_loss(0.01, 1.0) < 1e-4


@every_pattern
def test_derivatives_are_those_of_the_areas(pattern: ShearPattern) -> None:
    motion, step = motions(pattern, 20), 1e-8
    _, slopes = pattern.areas(motion)
    for k in range(len(motion)):
        change = np.zeros((len(motion), 1))
        change[k] = step
        numeric = (pattern.areas(motion + change)[0] - pattern.areas(motion - change)[0]) / (2 * step)
        np.testing.assert_allclose(slopes[:, k], numeric, atol=1e-7 * np.abs(slopes).max())


@every_pattern
def test_estimate_inverts_the_currents(pattern: ShearPattern) -> None:
    pad, motion = ShearPad(pattern, 5.0), motions(pattern, 50)
    found = pad.estimate(pad.currents(motion, CONDUCTANCE), 1e-6)
    np.testing.assert_allclose(found.motion, motion, atol=1e-12)
    np.testing.assert_allclose(found.conductance_s_per_m2, CONDUCTANCE, rtol=1e-9)


@every_pattern
def test_covariance_is_that_of_repeated_estimates(pattern: ShearPattern) -> None:
    pad = ShearPad(pattern, 5.0)
    motion = np.repeat(motions(pattern, 1), 4000, axis=1)
    exact = pad.currents(motion, CONDUCTANCE)
    noise = 1e-3 * exact.max()
    found = pad.estimate(exact + noise * np.random.default_rng(2).standard_normal(exact.shape), noise)
    scatter = np.cov(found.motion).reshape(len(motion), -1)
    scale = np.sqrt(np.outer(np.diag(scatter), np.diag(scatter)))
    np.testing.assert_allclose(found.covariance.mean(axis=0) / scale, scatter / scale, atol=0.08)
    if found.degrees:
        assert found.chi_squared.mean() == pytest.approx(found.degrees, rel=0.1)


def test_twist_moves_the_ratios_of_a_pinwheel_only() -> None:
    twist = np.array([0.0, 0.0, 0.02])[:, None]
    still, turned = (PATTERNS["crossed bars"].areas(motion)[0] for motion in (0 * twist, twist))
    np.testing.assert_allclose(turned[0] / turned[1], still[0] / still[1], rtol=1e-9)
    rest, wheel = (PATTERNS["pinwheel"].areas(motion)[0] for motion in (0 * twist, twist))
    assert (wheel[:2] > 1.05 * rest[:2]).all()
    assert (wheel[2:] < 0.95 * rest[2:]).all()


def test_off_centre_pressure_looks_like_displacement_unless_its_centre_is_known() -> None:
    pad = ShearPad(PATTERNS["discs"], 5.0, FILM)
    force, centre = np.array([5.0]), np.array([[2 * MM], [-1 * MM]])
    tilt, _, _ = FILM.tilts(force, centre, pad.pattern.centroids_m)
    currents = pad.currents(np.zeros((2, 1)), FILM.conductance(force), tilt)
    biased = pad.estimate(currents, 1e-6).motion
    assert biased[0, 0] > 10e-6
    assert biased[1, 0] < -5e-6
    compensated = pad.estimate(currents, 1e-6, normal_force_n=force, centre_m=centre)
    np.testing.assert_allclose(compensated.motion, 0, atol=1e-12)
    np.testing.assert_allclose(compensated.conductance_s_per_m2, FILM.conductance(force), rtol=1e-9)
    unsure = pad.estimate(currents, 1e-6, normal_force_n=force, centre_m=centre, centre_std_m=1 * MM)
    expected = np.abs(biased[1, 0])  # 1 mm in y moved it so far
    assert math.sqrt(unsure.covariance[0, 1, 1]) == pytest.approx(expected, rel=0.15)
    rough = pad.estimate(currents, 1e-6, normal_force_n=force, centre_m=centre, normal_force_std_n=0.1)
    weaker = pad.estimate(currents, 1e-6, normal_force_n=force - 0.1, centre_m=centre).motion
    assert math.sqrt(rough.covariance[0, 0, 0]) == pytest.approx(abs(weaker[0, 0]), rel=0.1)


def test_conductance_of_channels_follows_the_pressure_there_and_its_derivatives_those_of_it() -> None:
    places = PATTERNS["discs"].centroids_m
    for centre in (np.array([1 * MM, -2 * MM]), np.array([9 * MM, 5 * MM])):
        force = 3.0
        logs, by_centre, by_force = FILM.tilts(force, centre, places)
        pressure = force / FILM.plate_m2 * np.maximum(1 + places @ centre / FILM.gyration_m2, 0.0)
        ratio = (1 + pressure / FILM.reference_pa) ** FILM.alpha * FILM.siemens_per_m2
        np.testing.assert_allclose(np.exp(logs) * FILM.conductance(force), ratio, rtol=1e-12)
        step = 1e-7
        for axis in range(2):
            moved = centre + step * np.eye(2)[axis]
            change = (FILM.tilts(force, moved, places)[0] - logs) / step
            np.testing.assert_allclose(by_centre[:, axis], change, rtol=1e-3, atol=1e-3)
        change = (FILM.tilts(force + step, centre, places)[0] - logs) / step
        np.testing.assert_allclose(by_force, change, rtol=1e-4, atol=1e-6)


def test_currents_that_no_displacement_has_give_nan() -> None:
    pad = ShearPad(PATTERNS["bars"], 5.0)
    found = pad.estimate(np.array([[1.0, -1.0, 1e-4], [1.0, 1.0, 1.0]]), 1e-12)
    assert np.isfinite(found.motion[:, 0]).all()
    assert np.isnan(found.motion[:, 1:]).all()


def test_patterns_and_currents_of_wrong_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="4 channels"):
        ShearPad(PATTERNS["discs"], 5.0).estimate(np.ones((2, 1)), 1e-3)
    with pytest.raises(ValueError, match="gap_m"):
        DiscPattern(1, 1 * MM, 2 * MM, 0.1 * MM)
    with pytest.raises(ValueError, match="overlap_m"):
        BarPattern.pinwheel(1.0, 0.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="stiffness"):
        ElasticLayer((0.0, 1.0))


def test_force_covariance_has_each_stated_part() -> None:
    moved = np.array([[1e-4], [0.0]])
    layer = ElasticLayer((1e4, 2e4), stiffness_std=0.1, axis_std=0.0, hysteresis=0.0, zero_std_n=0.0)
    force = layer.force(moved)
    np.testing.assert_allclose(force.vector_n[:, 0], [1.0, 0.0])
    np.testing.assert_allclose(force.covariance_n2[0], np.diag([0.01, 0.0]), atol=1e-15)
    noisy = layer.force(0 * moved, 1e-12 * np.eye(2))
    np.testing.assert_allclose(noisy.covariance_n2[0], np.diag([1e-4, 4e-4]))
    loop = ElasticLayer((1e4, 1e4), 0.0, 0.0, hysteresis=0.1, zero_std_n=0.0).force(0 * moved, peak_n=[3.0])
    np.testing.assert_allclose(loop.covariance_n2[0], 0.03 * np.eye(2))


def test_calibration_measures_the_loop_of_the_pad_by_what_remains_of_loads() -> None:
    force = np.array([[2.0, -2.0, 0.0, 0.0], [0.0, 0.0, 1.5, -1.5]])
    moved = force / 1e4
    layer = calibrate_layer(moved, force, force_std=0.01, released_m=0.03 * moved)
    assert layer.hysteresis == pytest.approx(0.03)
    assert layer.axis_std == pytest.approx(0.03 / 2 / np.sqrt(3) / np.sqrt(2), rel=1e-6)


def test_calibration_finds_the_stiffness_of_each_axis_from_loads_in_both_directions() -> None:
    force = np.array([[2.0, -2.0, 0.0, 0.0], [0.0, 0.0, 1.5, -1.5]])
    moved = force / np.array([[1.2e4], [0.9e4]])
    residue = 1e-6 * np.array([[1.0, 1.0, 0, 0], [0, 0, 1.0, 1.0]])  # left by the load before
    layer = calibrate_layer(moved + residue, force, force_std=0.01)
    np.testing.assert_allclose(layer.stiffness_n_per_m, [1.2e4, 0.9e4], rtol=1e-12)
    assert layer.stiffness_std == 0.01
    assert 0.01 < layer.axis_std < 0.03
    assert layer.hysteresis == 0.05
    with pytest.raises(ValueError, match="two loads"):
        calibrate_layer(moved[:, :3], force[:, :3], force_std=0.01)
