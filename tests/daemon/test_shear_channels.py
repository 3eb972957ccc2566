"""Channels of shear pads: what their counts show, over the reports of a pad's health."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.daemon.shear_channels import ShearChannels
from handtouch.wire import ShearStatusName

REST = np.array([2400, 2610, 2530, 2480])


def report(
    channels: ShearChannels, counts: object, *, reports: int = 1, noise: float = 0.0, rest_known: bool = True
) -> ShearStatusName:
    """Report so many samples, every other one under a touch; return the last status."""
    rng, status = np.random.default_rng(1), ""
    for k in range(reports):
        now = np.rint(np.asarray(counts) + noise * rng.standard_normal(4)).astype(np.int64)
        status = channels.update(0, 1 + k, now, now >= 32767, 1.0, touched=k % 2 == 0, rest_known=rest_known)
    return status  # type: ignore[return-value]


def test_sound_channels_are_operational_once_the_rest_position_is_known() -> None:
    assert report(ShearChannels(), REST, rest_known=False) == "no_rest"
    assert report(ShearChannels(), REST, reports=100, noise=1.0) == "operational"


@pytest.mark.parametrize(("count", "status"), [(0, "dead"), (40, "dead"), (32767, "saturated")])
@pytest.mark.parametrize("channel", range(4))
def test_an_open_and_a_saturated_channel_are_reported_at_once(channel: int, count: int, status: str) -> None:
    counts = REST.copy()
    counts[channel] = count
    assert report(ShearChannels(), counts) == status


def test_displacement_within_the_travel_is_no_dead_channel() -> None:
    assert report(ShearChannels(), [400, 4600, 2530, 2480]) == "operational"


def test_two_channels_with_equal_currents_under_touches_are_shorted() -> None:
    channels, counts = ShearChannels(), [2505, 2505, 2530 + 300, 2480]
    assert report(channels, counts, reports=5, noise=1.0) == "operational"
    assert report(channels, counts, reports=12, noise=1.0) == "shorted"
    assert report(channels, REST, noise=1.0) == "operational"


def test_currents_that_are_equal_by_chance_at_rest_are_no_short() -> None:
    channels, status = ShearChannels(), ""
    for k in range(50):
        counts = np.array([2500, 2500, 2530, 2460]) + (k % 2) * np.array([-60, 60, 0, 0])
        status = channels.update(0, k, counts, counts > 32766, 1.0, touched=k % 2 == 1, rest_known=True)
    assert status == "operational"


def test_one_sample_counts_once() -> None:
    channels, counts = ShearChannels(), np.array([2505, 2505, 2830, 2480])
    for _ in range(50):
        status = channels.update(0, 7, counts, counts > 32766, 1.0, touched=True, rest_known=True)
    assert status == "operational"
