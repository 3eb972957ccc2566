"""Texture along a slide: its period, its limits, and none on smooth surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.percept.action_request import expected_information_bits
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate
from handtouch.percept.spectrum import estimate_texture
from handtouch.percept.texture import TextureEstimator
from handtouch.wire import PERCEPT_KINDS

FloatArray = NDArray[np.float64]
RATE_HZ, SPEED, N, NOISE = 200.0, 0.02, 512, 2e-3
FINEST = 2 * SPEED / RATE_HZ


def slide(
    period_m: float, seed: int, amplitude: float = 0.01, vary: float = 0.0, n: int = N
) -> tuple[FloatArray, FloatArray]:
    """Currents and distances of a slide whose speed swings by `vary`."""
    chance = np.random.default_rng(seed)
    t = np.arange(n) / RATE_HZ
    way = SPEED * (t + vary * np.sin(2 * np.pi * t / t[-1]) * t[-1] / (2 * np.pi))
    wave = amplitude * np.sin(2 * np.pi * way / period_m + chance.uniform(0, 6))
    return 1e-3 * np.exp(wave + 0.1 * way / way[-1] + NOISE * chance.normal(size=n)), way


@pytest.mark.parametrize("vary", [0.0, 0.4])
@pytest.mark.parametrize("period_m", [0.5e-3, 1e-3, 3e-3, 8e-3])
def test_period_is_found_at_any_speed_with_a_valid_deviation(period_m: float, vary: float) -> None:
    for seed in range(15):
        found = estimate_texture(*slide(period_m, seed, vary=vary), NOISE)
        assert (found.state, found.label) == ("estimated", "periodic")
        assert abs(found.period_m - period_m) < 5 * found.period_std_m < 0.05 * period_m
        assert found.amplitude == pytest.approx(0.01, rel=0.15)
        assert found.roughness == pytest.approx(0.01 / np.sqrt(2), rel=0.15)


def test_smooth_surface_has_no_period() -> None:
    labels = [estimate_texture(*slide(1e-3, seed, amplitude=0.0), NOISE).label for seed in range(200)]
    assert labels.count("periodic") <= 2
    assert labels.count("smooth") > 150


def test_aperiodic_surface_is_rough() -> None:
    labels = []
    for seed in range(30):
        current, way = slide(1e-3, seed, amplitude=0.0)
        heights = np.random.default_rng(seed).normal(size=200)
        bumps = np.interp(way, np.linspace(0, way[-1], 200), heights)
        found = estimate_texture(current * np.exp(0.01 * bumps), way, NOISE)
        assert found.roughness == pytest.approx(0.008, rel=0.3)
        labels.append(found.label)
    assert labels.count("rough") >= 27
    assert labels.count("periodic") <= 1


def test_aliasing_is_flagged_for_steady_slides_and_excluded_for_uneven_ones() -> None:
    steady = estimate_texture(*slide(0.85 * FINEST, 1), NOISE)
    assert steady.aliased
    assert steady.period_m > FINEST  # looks coarser than it is
    uneven = [estimate_texture(*slide(0.85 * FINEST, seed, vary=0.4), NOISE) for seed in range(10)]
    assert all(found.label != "periodic" for found in uneven)
    assert not estimate_texture(*slide(1e-3, 1, vary=0.4), NOISE).aliased


def test_limits_follow_from_speed_rate_and_length() -> None:
    found = estimate_texture(*slide(1e-3, 1), NOISE)
    assert found.min_period_m == pytest.approx(FINEST)
    assert found.max_period_m == pytest.approx(SPEED * (N - 1) / RATE_HZ / 4)
    longer = estimate_texture(*slide(0.02, 1), NOISE)
    assert longer.state == "undetermined"
    assert "longer than 13 mm" in longer.reason
    short = estimate_texture(*slide(1e-3, 1, n=20), NOISE)
    assert short.state == "undetermined"
    assert "20 of 48 samples" in short.reason
    with pytest.raises(ValueError, match="must be one"):
        estimate_texture(np.ones(3), np.ones(4))


def played(period_m: float, joints: bool) -> tuple[PerceptEstimate, TextureEstimator]:
    """The part on a stream: a pad rests, then slides on."""
    stream, part = ContactBuffer(1), TextureEstimator(1)
    perceiver = PerceptPipeline(stream, [part])
    perceiver.set_requested(np.ones((len(PERCEPT_KINDS), 1), np.bool_), np.ones(1, np.bool_))
    current, way = slide(period_m, 5)
    current = np.concatenate([1e-3 * np.exp(NOISE * np.random.default_rng(2).normal(size=100)), current])
    way = np.concatenate([np.zeros(100), way])
    percepts: list[PerceptEstimate] = []
    chance = np.random.default_rng(7)
    for i, (amps, s) in enumerate(zip(current, way, strict=True)):
        sample = ContactSamples(np.zeros(1, np.intp), np.array([i * 5_000_000]), np.array([4], np.uint32))
        sample["total_current_a"] = np.array([amps])
        if joints:
            sample["palm_position_m"] = np.array([[s, 0, 0.1]]) + 2e-6 * chance.normal(size=3)
            sample["palm_rotation"], sample["position_m"] = np.eye(3)[None], np.zeros((1, 3))
        else:
            sample["pad_m"] = np.array([[s, 0.01]]) + 50e-6 * chance.normal(size=2)
        percepts += perceiver.process_tick(sample, np.zeros(0, np.intp), i * 5_000_000)[0]
        if i == 90:
            assert percepts[-1].reason == "the contact doesn't slide"
            assert len(part.open_questions(0)) == 1
    return percepts[-1], part


@pytest.mark.parametrize(("joints", "by"), [(True, "joints"), (False, "position")])
def test_percept_has_period_and_source_of_distance(joints: bool, by: str) -> None:
    percepts, part = played(1e-3, joints)
    assert (percepts.state, percepts.label) == ("estimated", "periodic")
    assert percepts.values["period_m"] == pytest.approx(1e-3, rel=0.03)
    assert percepts.values["distance_source"] == by
    assert percepts.evidence["distance_m"] > 0.04
    assert part.open_questions(0) == []


def test_resting_contact_poses_an_informative_slide_question() -> None:
    part = TextureEstimator(1)
    stream = ContactBuffer(1)
    part.requested[:] = True
    for i in range(60):
        sample = ContactSamples(np.zeros(1, np.intp), np.array([i * 5_000_000]), np.array([4], np.uint32))
        sample["total_current_a"], sample["pad_m"] = np.ones(1), np.full((1, 2), 0.01)
        stream.add_samples(sample)
    part.fit_contact(stream, 0, 0)
    (question,) = part.open_questions(0)
    (action,) = question.actions
    assert action.kind == "slide"
    assert action.parameters["speed_m_per_s"] == pytest.approx(0.02)
    assert expected_information_bits(question, action) > 0.5
