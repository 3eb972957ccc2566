"""Frames are routed to their slots, and all of them are counted."""

from __future__ import annotations

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.canbus.bus.router import NO_SLOT, Router
from handtouch.core.slab import Slab


@given(st.lists(st.tuples(st.integers(0, 2047), st.binary(max_size=8)), max_size=50))
def test_every_frame_is_a_sample_of_wrong_length_or_returned(frames: list[tuple[int, bytes]]) -> None:
    router = Router(Slab(4))
    for slot in range(4):
        router.route(0x281 + slot, slot)
    handed_on = 0
    latest: dict[int, bytes] = {}
    for t_ns, (can_id, data) in enumerate(frames, 1):
        handed_on += not router.accept_frame(can_id, data, t_ns)
        if can_id in range(0x281, 0x285) and len(data) == 8:
            latest[can_id - 0x281] = data
    counters = router.counters
    assert counters.frames == len(frames) == counters.samples + counters.wrong_length + handed_on
    for slot in range(4):
        expected = np.frombuffer(latest.get(slot, bytes(8)), "<i2")
        np.testing.assert_array_equal(router.slab.unpack_counts()[slot], expected)


def test_samples_are_little_endian_int16_with_their_arrival() -> None:
    router = Router(Slab(2))
    router.route(0x282, 1)
    router.accept_frame(0x282, bytes.fromhex("0100ffff0080ff7f"), 42)
    assert router.slab.unpack_counts()[1].tolist() == [1, -1, -32768, 32767]
    assert router.slab.arrival_ns.tolist() == [0, 42]
    assert router.slab.fresh.tolist() == [0, 1]


def test_fresh_counts_pads_not_samples_and_starts_again_with_each_cycle() -> None:
    slab = Slab(3)
    slab.write_pdo(0, bytes(8), 1)
    slab.write_pdo(0, bytes(8), 2)
    slab.write_pdo(2, bytes(8), 3)
    assert slab.fresh_count == 2
    slab.begin_cycle(4)
    assert (slab.fresh_count, slab.fresh.tolist()) == (0, [0, 0, 0])


def test_sample_read_before_its_sync_is_fresh_in_that_cycle() -> None:
    slab = Slab(3)
    slab.write_pdo(0, bytes(8), 4)
    slab.write_pdo(1, bytes(8), 6)
    slab.begin_cycle(5)
    assert (slab.fresh_count, slab.fresh.tolist()) == (1, [0, 1, 0])
    slab.write_pdo(1, bytes(8), 7)
    assert slab.fresh_count == 1


def test_route_can_be_removed() -> None:
    router = Router(Slab(1))
    router.route(0x281, 0)
    router.route(0x281, NO_SLOT)
    assert not router.accept_frame(0x281, bytes(8), 1)
    assert router.slab.arrival_ns[0] == 0


@pytest.mark.parametrize(("can_id", "slot"), [(-1, 0), (2048, 0), (0x281, 1), (0x281, -2)])
def test_impossible_routes_are_refused(can_id: int, slot: int) -> None:
    with pytest.raises(ValueError, match=r"identifier|slot"):
        Router(Slab(1)).route(can_id, slot)


@pytest.mark.parametrize(
    ("message", "counter"),
    [
        (can.Message(arbitration_id=0x281, data=bytes(8), is_extended_id=True), "unknown_frames"),
        (
            can.Message(arbitration_id=0x281, is_remote_frame=True, dlc=8, is_extended_id=False),
            "unknown_frames",
        ),
        (
            can.Message(arbitration_id=0x281, data=bytes(8), is_fd=True, is_extended_id=False),
            "unknown_frames",
        ),
        (
            can.Message(arbitration_id=4, data=bytes(8), is_error_frame=True, is_extended_id=False),
            "error_frames",
        ),
    ],
)
def test_kinds_of_frame_that_canopen_does_not_use_never_reach_the_slab(
    message: can.Message, counter: str
) -> None:
    router = Router(Slab(1))
    router.route(0x281, 0)
    assert router.accept_message(message, 1) is None
    assert getattr(router.counters, counter) == 1
    assert router.counters.samples == 0
    assert router.slab.arrival_ns[0] == 0


def test_guarding_request_is_neither_unknown_nor_a_boot_up_message() -> None:
    router = Router(Slab(1))
    guard = can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=0, is_extended_id=False)
    assert router.accept_message(guard, 1) is None
    assert (router.counters.frames, router.counters.unknown_frames) == (1, 0)


def test_a_log_feeds_the_same_routes() -> None:
    router = Router(Slab(1))
    router.route(0x281, 0)
    assert (
        router.accept_message(can.Message(arbitration_id=0x281, data=bytes(8), is_extended_id=False), 5)
        is None
    )
    other = can.Message(arbitration_id=0x701, data=b"\x05", is_extended_id=False)
    assert router.accept_message(other, 6) == (0x701, b"\x05", 6)
    assert router.slab.arrival_ns[0] == 5


def test_bits_are_those_of_the_worst_case() -> None:
    router = Router(Slab(1))
    router.accept_frame(0x80, b"", 1)
    router.accept_frame(0x281, bytes(8), 1)
    assert router.counters.bits == 55 + 135
