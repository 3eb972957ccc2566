"""Tares: what is refused, and pads whose zeros were never known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from handtouch.daemon.tare import TareJob
from handtouch.wire import PadState
from tests.core.conftest import bench
from tests.core.test_room import FloatArray, Room, steady, touch

__all__ = ["bench"]


def tared(room: Room, counts: FloatArray) -> Any:
    """Return the result of the first pad's tare while it reads these counts."""
    selected = np.arange(room.pads) == 0
    pacer: Any = SimpleNamespace(request_full_rate=lambda *_: None)
    names = [("h", str(pad)) for pad in range(room.pads)]
    now_ns = room.pipeline.cycle.sync_ns
    job = TareJob(names, selected, room.pipeline, pacer, now_ns)
    result, step_s = None, room.period_ns * 1e-9
    while result is None:
        room.run(0.9 * step_s, lambda _: counts)
        now_ns += room.period_ns
        result = job.poll(now_ns)
    return result["pads"][0]


def test_a_pad_that_reads_a_load_since_the_start_is_tared(bench: Any) -> None:
    room, zeros = Room(bench), touch(bench, 3.0)
    room.run(0.5, lambda _: zeros)
    assert room.pipeline.state.pad_state[0] == PadState.TOUCHED
    result = tared(room, zeros)
    assert result["tared"], result["reason"]
    least_n = result["least_begin_threshold_n"]
    counts = room.pipeline.model.centre_current(0, least_n) / room.pipeline.model.mean_ampere_per_count[0]
    assert 6.0 < counts < 12.0  # 5.55 deviations of the mean of two sums: noise of a count and rounding
    assert result["begin_threshold_n"] == room.pipeline.model.touch.begin_threshold_n[0]
    states = room.run(1.0, lambda _: zeros)
    assert (states[10:, 0] == PadState.CLEAR).all()
    light = touch(bench, 2.0)
    states = room.run(0.2, lambda _: zeros + light)
    assert (states[5:, 0] == PadState.TOUCHED).all()


def test_a_touched_pad_whose_zeros_are_known_is_not_tared(bench: Any) -> None:
    room, load = Room(bench), touch(bench, 3.0)
    room.run(1.0, steady(0.0))
    room.run(0.5, lambda _: load)
    result = tared(room, load)
    assert not result["tared"]
    assert "touched during the measurement" in result["reason"]
