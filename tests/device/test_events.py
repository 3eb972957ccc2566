"""Event-driven and acyclic TPDOs, and the excitation."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

ENABLE, DELTA, EXCITATION = 0x6423, 0x6426, 0x2100


def event_driven(
    bench: Any, *, inhibit: int = 0, timer_ms: int = 0, delta: int | None = None, transmission: int = 255
) -> None:
    """Node 1, operational; its first frame is over."""
    bench.running()
    if delta is not None:
        assert bench.write(1, ENABLE, 0, 1, 1) == 0
        for sub in (1, 2, 3, 4):
            assert bench.write(1, DELTA, sub, delta, 4) == 0
    assert bench.write(1, 0x1801, 3, inhibit, 2) == 0
    assert bench.write(1, 0x1801, 5, timer_ms, 2) == 0
    assert bench.write(1, 0x1801, 2, transmission, 1) == 0
    assert len(bench.data(1)) == 1


@pytest.mark.parametrize("transmission", [254, 255])
def test_a_change_beyond_the_delta_is_sent_at_once_and_a_smaller_one_is_not(
    bench: Any, transmission: int
) -> None:
    event_driven(bench, delta=5, transmission=transmission)
    assert bench.data(50) == []
    bench.counts[0] += (5, -5, 5, 0)  # as far as the delta
    assert bench.data(50) == []
    bench.counts[0, 1] -= 1
    assert bench.data(50) == [(bench.t_ns // 10**6 - 49, (0x281, struct.pack("<4h", 15, 14, 35, 40)))]
    bench.counts[0, 0] -= 5  # the delta counts from what was sent last
    assert bench.data(50) == []


def test_a_node_whose_interrupt_is_not_enabled_reports_no_change(bench: Any) -> None:
    event_driven(bench)
    bench.counts += 1000
    assert bench.data(50) == []
    assert bench.write(1, ENABLE, 0, 1, 1) == 0
    assert len(bench.data(50)) == 1


def test_between_two_frames_lies_the_inhibit_time(bench: Any) -> None:
    event_driven(bench, delta=0, inhibit=70)  # 7 ms
    times = []
    for _ in range(30):
        bench.counts[0] += 1
        times += [t_ms for t_ms, _ in bench.data(1)]
    assert set(np.diff(times)) == {7}


def test_the_event_timer_sends_without_a_change_and_restarts_with_every_frame(bench: Any) -> None:
    event_driven(bench, delta=0, timer_ms=20)
    start_ms = bench.t_ns // 10**6
    bench.data(10)
    bench.counts += 1
    assert [t_ms - start_ms for t_ms, _ in bench.data(60)] == [11, 31, 51]


def test_a_started_node_sends_its_present_counts(bench: Any) -> None:
    event_driven(bench)
    bench.nmt(128, 1)
    assert bench.data(50) == []
    bench.nmt(1, 1)
    assert [frame for _, frame in bench.data(50)] == [(0x281, struct.pack("<4h", 10, 20, 30, 40))]
    bench.nmt(1, 1)  # it runs already
    assert bench.data(50) == []


def test_an_event_driven_node_answers_no_sync_and_reads_on_its_own_clock(bench: Any) -> None:
    event_driven(bench, delta=5)
    bench.samples.clear()
    assert bench.sync() == []
    bench.run(10)
    assert len(bench.samples) == 11
    assert np.diff(bench.samples).min() == 1_000_000


def test_the_sampler_is_called_once_for_all_and_not_for_synchronous_nodes(bench: Any) -> None:
    for node_id in (1, 2, 3):
        bench.running(node_id)
    bench.run(20)
    assert bench.samples == []
    for node_id in (1, 2):
        bench.write(node_id, 0x1801, 2, 255, 1)
    bench.run(20)
    assert len(bench.samples) == 20
    bench.nmt(128, 0)
    bench.run(20)
    assert len(bench.samples) == 20
    assert bench.bus.advance(bench.t_ns) == 200_000_000  # the next heartbeat, and no sample


def test_two_polls_within_a_sample_period_sample_once(bench: Any) -> None:
    event_driven(bench, delta=0)
    bench.samples.clear()
    for _ in range(10):
        bench.t_ns += 100_000
        assert bench.bus.advance(bench.t_ns) is not None
    assert len(bench.samples) == 1


def test_an_acyclic_pdo_is_sent_at_a_sync_only_after_a_change(bench: Any) -> None:
    bench.running()
    bench.write(1, ENABLE, 0, 1, 1)
    bench.write(1, 0x1801, 2, 0, 1)
    assert [len(bench.sync()) for _ in range(3)] == [1, 0, 0]
    bench.counts += 1
    assert [len(bench.sync()) for _ in range(3)] == [1, 0, 0]


def test_a_running_node_changes_between_sync_and_events(bench: Any) -> None:
    event_driven(bench, delta=5)
    assert bench.sync() == []
    assert bench.write(1, 0x1801, 2, 1, 1) == 0
    assert len(bench.sync()) == 1
    assert bench.data(20) == []


def counts(frames: list[tuple[int, bytes]]) -> tuple[int, ...]:
    ((_, data),) = frames
    return struct.unpack("<4h", data)


def test_without_excitation_channels_read_zero(bench: Any) -> None:
    bench.running()
    assert bench.write(1, EXCITATION, 0, 0, 1) == 0
    assert counts(bench.sync()) == (0, 0, 0, 0)
    assert bench.read(1, 0x6401, 3) == 0


def test_after_the_excitation_three_samples_are_wrong_less_each_time(bench: Any) -> None:
    bench.running()
    assert counts(bench.sync()) == (10, 20, 30, 40)  # as after power-on
    bench.write(1, EXCITATION, 0, 0, 1)
    bench.sync()
    bench.write(1, EXCITATION, 0, 1, 1)
    errors = [counts(bench.sync())[0] - 10 for _ in range(5)]
    assert errors == [4095, 2047, 1023, 0, 0]


def test_the_excitation_stays_off_through_a_communication_reset_and_comes_on_with_power(bench: Any) -> None:
    device = bench.running()
    bench.write(1, EXCITATION, 0, 0, 1)
    bench.nmt(130, 1)
    assert bench.read(1, EXCITATION, 0) == 0
    device.reboot()
    bench.take()
    assert bench.read(1, EXCITATION, 0) == 1


def test_another_object_may_switch_the_excitation(bench: Any, write_eds: Any) -> None:
    more = (
        "[2F00]\nParameterName=Bias\nObjectType=0x7\nDataType=0x0006\nAccessType=rw\nDefaultValue=1\n"
        "[2100]\nParameterName=Gain\nObjectType=0x7\nDataType=0x0005\nAccessType=rw\nDefaultValue=0\n"
    )
    channels = tuple((0x2001, sub) for sub in (1, 2, 3, 4))
    path = write_eds([(*c, 16, True) for c in channels], [[(*c, 16) for c in channels]], more=more)
    bench.running(eds=path, channels=channels, excitation=(0x2F00, 0))
    assert counts(bench.sync()) == (10, 20, 30, 40)  # what others have at 0x2100 is no concern of it
    bench.write(1, 0x2F00, 0, 0, 2)
    assert counts(bench.sync()) == (0, 0, 0, 0)
    with pytest.raises(ValueError, match="0x2F01:00"):
        bench.bus.add(2, eds=path, channels=channels, excitation=(0x2F01, 0))
