"""Texture over the way of a slide: its period, its limits, and no texture where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.percept.ask import expected_bits
from handtouch.percept.percept import Perceiver
from handtouch.percept.spectrum import texture
from handtouch.percept.stream import KINDS, Percept, Sample, Stream
from handtouch.percept.texture import Texture

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
def test_a_period_is_found_whatever_the_speed_with_a_deviation_that_holds(
    period_m: float, vary: float
) -> None:
    for seed in range(15):
        found = texture(*slide(period_m, seed, vary=vary), NOISE)
        assert (found.state, found.label) == ("estimated", "periodic")
        assert abs(found.period_m - period_m) < 5 * found.period_std_m < 0.05 * period_m
        assert found.amplitude == pytest.approx(0.01, rel=0.15)
        assert found.roughness == pytest.approx(0.01 / np.sqrt(2), rel=0.15)


def test_without_texture_none_is_found() -> None:
    labels = [texture(*slide(1e-3, seed, amplitude=0.0), NOISE).label for seed in range(200)]
    assert labels.count("periodic") <= 2
    assert labels.count("smooth") > 150


def test_what_has_no_period_is_rough() -> None:
    labels = []
    for seed in range(30):
        current, way = slide(1e-3, seed, amplitude=0.0)
        heights = np.random.default_rng(seed).normal(size=200)
        bumps = np.interp(way, np.linspace(0, way[-1], 200), heights)
        found = texture(current * np.exp(0.01 * bumps), way, NOISE)
        assert found.roughness == pytest.approx(0.008, rel=0.3)
        labels.append(found.label)
    assert labels.count("rough") >= 27
    assert labels.count("periodic") <= 1


def test_below_the_nyquist_limit_a_steady_slide_warns_and_an_uneven_one_denies() -> None:
    steady = texture(*slide(0.85 * FINEST, 1), NOISE)
    assert steady.aliased
    assert steady.period_m > FINEST  # looks coarser than it is
    uneven = [texture(*slide(0.85 * FINEST, seed, vary=0.4), NOISE) for seed in range(10)]
    assert all(found.label != "periodic" for found in uneven)
    assert not texture(*slide(1e-3, 1, vary=0.4), NOISE).aliased


def test_limits_follow_from_speed_rate_and_length() -> None:
    found = texture(*slide(1e-3, 1), NOISE)
    assert found.finest_m == pytest.approx(FINEST)
    assert found.longest_m == pytest.approx(SPEED * (N - 1) / RATE_HZ / 4)
    longer = texture(*slide(0.02, 1), NOISE)
    assert longer.state == "unestimated"
    assert "longer than 13 mm" in longer.reason
    short = texture(*slide(1e-3, 1, n=20), NOISE)
    assert short.state == "unestimated"
    assert "20 of 48 samples" in short.reason
    with pytest.raises(ValueError, match="must be one"):
        texture(np.ones(3), np.ones(4))


def felt(period_m: float, joints: bool) -> tuple[Percept, Texture]:
    """The part on a stream: a pad rests, then slides on."""
    stream, part = Stream(1), Texture(1)
    perceiver = Perceiver(stream, [part])
    perceiver.want(np.ones((len(KINDS), 1), np.bool_), np.ones(1, np.bool_))
    current, way = slide(period_m, 5)
    current = np.concatenate([1e-3 * np.exp(NOISE * np.random.default_rng(2).normal(size=100)), current])
    way = np.concatenate([np.zeros(100), way])
    told: list[Percept] = []
    chance = np.random.default_rng(7)
    for i, (amps, s) in enumerate(zip(current, way, strict=True)):
        sample = Sample(np.zeros(1, np.intp), np.array([i * 5_000_000]), np.array([4], np.uint32))
        sample["current_a"] = np.array([amps])
        if joints:
            sample["palm_position_m"] = np.array([[s, 0, 0.1]]) + 2e-6 * chance.normal(size=3)
            sample["palm_rotation"], sample["position_m"] = np.eye(3)[None], np.zeros((1, 3))
        else:
            sample["pad_m"] = np.array([[s, 0.01]]) + 50e-6 * chance.normal(size=2)
        told += perceiver.step(sample, np.zeros(0, np.intp), i * 5_000_000)[0]
        if i == 90:
            assert told[-1].reason == "it doesn't slide"
            assert len(part.questions(0)) == 1
    return told[-1], part


@pytest.mark.parametrize(("joints", "by"), [(True, "joints"), (False, "place")])
def test_a_part_of_perception_tells_period_and_how_it_knows_the_distance(joints: bool, by: str) -> None:
    told, part = felt(1e-3, joints)
    assert (told.state, told.label) == ("estimated", "periodic")
    assert told.values["period_m"] == pytest.approx(1e-3, rel=0.03)
    assert told.values["distance_by"] == by
    assert told.evidence["distance_m"] > 0.04
    assert part.questions(0) == []


def test_a_contact_that_rests_is_asked_to_slide_so_that_it_tells_much() -> None:
    part = Texture(1)
    stream = Stream(1)
    part.wanted[:] = True
    for i in range(60):
        sample = Sample(np.zeros(1, np.intp), np.array([i * 5_000_000]), np.array([4], np.uint32))
        sample["current_a"], sample["pad_m"] = np.ones(1), np.full((1, 2), 0.01)
        stream.add(sample)
    part.fit(stream, 0, 0)
    (question,) = part.questions(0)
    (action,) = question.actions
    assert action.do == "slide"
    assert action.amount["speed_m_per_s"] == pytest.approx(0.02)
    assert expected_bits(question, action) > 0.5
