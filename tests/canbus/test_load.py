"""Bus load: known lengths of frames, and sums of them."""

from __future__ import annotations

import pytest

from handtouch.canbus.bus.load import burst_s, bus_load, frame_bits


def test_frame_bits_are_those_of_the_literature() -> None:
    """Davis et al. 2007, eq. 1 for 11-bit identifiers: 55 + 10 s bits with s bytes, worst case."""
    assert [frame_bits(size) for size in range(9)] == [55 + 10 * size for size in range(9)]


@pytest.mark.parametrize("size", [-1, 9, 64])
def test_no_classic_frame_has_more_than_8_bytes(size: int) -> None:
    with pytest.raises(ValueError, match="0 to 8"):
        frame_bits(size)


def test_fifteen_pads_at_500_hz_fill_a_bus_and_need_two_at_1_khz() -> None:
    assert 0.9 < bus_load(1e6, 15, 0.002, 0.1) < 1.15
    assert bus_load(1e6, 15, 0.005, 0.1) < 0.5
    assert bus_load(1e6, 15, 0.001, 0.1) > 2


def test_burst_of_a_hand_takes_two_milliseconds() -> None:
    assert burst_s(1e6, 15) == pytest.approx(55e-6 + 15 * 135e-6)


def test_second_tpdos_add_their_frames() -> None:
    further = 15 * frame_bits(2)
    assert bus_load(1e6, 15, 0.005, 0.1, further) == pytest.approx(
        bus_load(1e6, 15, 0.005, 0.1) + further / 0.005 / 1e6
    )
    assert burst_s(1e6, 15, further) > burst_s(1e6, 15)
