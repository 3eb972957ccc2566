"""Every fault switch has its effect, on one node, until it is cleared."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from handtouch.device import LineFaults

MS = 1_000_000
GENERAL = 0x08000000
DATA = (0x281, struct.pack("<4h", 10, 20, 30, 40))


def counts(frames: list[tuple[int, bytes]]) -> tuple[int, ...]:
    ((_, data),) = frames
    return struct.unpack("<4h", data)


# What the cable does.


def test_a_line_loses_its_share_and_the_same_frames_with_the_same_seed(bench: Any) -> None:
    node = bench.running()
    runs = []
    for seed in (1, 1, 2):
        node.line = LineFaults(lost=0.3, seed=seed)
        runs.append([len(bench.sync()) for _ in range(1000)])
    assert runs[0] == runs[1] != runs[2]
    assert 640 < sum(runs[0]) < 760
    node.line = None
    assert bench.sync() == [DATA]


def test_a_line_loses_every_nth_frame(bench: Any) -> None:
    bench.running().line = LineFaults(lost_every=3)
    assert [len(bench.sync()) for _ in range(9)] == [1, 1, 0] * 3


def test_late_frames_carry_what_was_measured_then(bench: Any) -> None:
    bench.running().line = LineFaults(late_ns=7 * MS)
    assert bench.sync() == []
    bench.counts = bench.counts + 1
    assert bench.bus.advance(bench.t_ns) == bench.t_ns + 7 * MS
    sent_ms = bench.t_ns // MS
    assert bench.run(20) == [(sent_ms + 7, DATA)]


def test_duplicates_are_alike(bench: Any) -> None:
    bench.running().line = LineFaults(duplicate=1.0)
    assert bench.sync() == [DATA, DATA]


def test_corrupt_frames_keep_their_length_and_differ(bench: Any) -> None:
    node = bench.running()
    node.line = LineFaults(corrupt=1.0)
    seen = set()
    for _ in range(50):
        ((identifier, data),) = bench.sync()
        assert (identifier, len(data)) == (0x281, 8)
        assert data != DATA[1]
        seen.add(data)
    assert len(seen) > 40
    node.line = None
    assert bench.sync() == [DATA]  # what the node keeps is not touched


def test_a_line_affects_only_data_by_default(bench: Any) -> None:
    node = bench.running()
    node.line = LineFaults(lost=1.0)
    assert bench.sync() == []
    assert bench.read(1, 0x1018, 2) == 0x401
    node.line = LineFaults(lost=1.0, data_only=False)
    assert bench.request(1, b"\x40\x18\x10\x02") == bench.run(1000) == []


@pytest.mark.parametrize(
    "wrong", [{"lost": 1.5}, {"corrupt": -0.1}, {"duplicate": 2.0}, {"late_ns": -1}, {"lost_every": -1}]
)
def test_invalid_line_faults_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LineFaults(**wrong)


@pytest.mark.parametrize("length", [0, 3, 7, 8])
def test_frames_have_the_length_that_is_set(bench: Any, length: int) -> None:
    node = bench.running()
    node.frame_bytes = length
    assert bench.sync() == [(0x281, DATA[1][:length])]
    node.frame_bytes = None
    assert bench.sync() == [DATA]
    with pytest.raises(ValueError, match="frame_bytes"):
        node.frame_bytes = 9


# What the electrodes do.


def test_inputs_measure_the_electrodes_that_they_are_wired_to(bench: Any) -> None:
    node = bench.running()
    node.wiring = (2, 0, 3, 1)
    assert counts(bench.sync()) == (30, 10, 40, 20)
    assert [bench.read(1, 0x6401, sub) for sub in (1, 2, 3, 4)] == [30, 10, 40, 20]
    node.wiring = (0, 1, 2, 3)
    assert bench.sync() == [DATA]
    with pytest.raises(ValueError, match="wiring"):
        node.wiring = (0, 1, 2)


def test_an_open_electrode_is_noise_about_zero_with_any_wiring(bench: Any) -> None:
    node = bench.running()
    node.open_electrodes = {1}
    node.wiring = (1, 0, 2, 3)
    seen = np.array([counts(bench.sync()) for _ in range(400)])
    assert (seen[:, 1:] == (10, 30, 40)).all()
    assert abs(seen[:, 0].mean()) < 0.2
    assert 0.8 < seen[:, 0].std() < 1.3
    node.open_electrodes, node.wiring = frozenset(), (0, 1, 2, 3)
    assert bench.sync() == [DATA]


def test_a_stuck_channel_keeps_its_count_and_the_others_continue(bench: Any) -> None:
    node = bench.running()
    bench.sync()
    node.stick_channel(3)
    bench.counts = bench.counts + 100
    assert counts(bench.sync()) == (110, 120, 130, 40)
    node.release_channels()
    assert counts(bench.sync()) == (110, 120, 130, 140)


def test_saturated_channels_are_at_the_end_of_their_own_ranges(bench: Any, write_eds: Any) -> None:
    kinds = [(0x2001, 1, 8, False), (0x2001, 2, 16, False), (0x2001, 3, 24, True), (0x2001, 4, 8, True)]
    channels = tuple(kind[:2] for kind in kinds)
    node = bench.running(eds=write_eds(kinds, [[(i, s, b) for i, s, b, _ in kinds]]), channels=channels)
    node.saturate_channels()
    ((_, data),) = bench.sync()
    assert data == (0xFF_FFFF_7FFFFF_7F).to_bytes(7, "big")[:1] + b"\xff\xff" + b"\xff\xff\x7f" + b"\x7f"


def test_switches_outlast_a_reboot(bench: Any) -> None:
    node = bench.running()
    node.stuck_counts = {0: 99}
    node.line = LineFaults(duplicate=1.0)
    node.reboot()
    bench.nmt(1, 1)
    assert [counts([frame]) for frame in bench.sync()] == [(99, 20, 30, 40)] * 2


# What power and transceiver do.


def test_a_brown_out_takes_the_node_away_and_brings_it_back_with_defaults(bench: Any) -> None:
    node = bench.running()
    bench.write(1, 0x1801, 2, 3, 1)
    start_ms = bench.t_ns // MS
    node.brown_out(30 * MS)
    assert node.state == "UNPLUGGED"
    assert bench.sync() == bench.request(1, b"\x40\x18\x10\x02") == []
    assert bench.run(30) == [(start_ms + 30, (0x701, b"\0"))]
    assert node.state == "PRE-OPERATIONAL"
    assert bench.read(1, 0x1801, 2) == 1


def test_a_brown_out_repeats(bench: Any) -> None:
    node = bench.running()
    start_ms = bench.t_ns // MS
    node.brown_out(20 * MS, times=3, every_ns=100 * MS)
    assert [(t - start_ms, f) for t, f in bench.run(400) if f[1] == b"\0"] == [
        (at, (0x701, b"\0")) for at in (20, 120, 220)
    ]


def test_unplugging_ends_a_brown_out(bench: Any) -> None:
    node = bench.running()
    node.brown_out(20 * MS, times=3, every_ns=100 * MS)
    node.unplug()
    assert bench.run(1000) == []


@pytest.mark.parametrize("wrong", [{"times": 0}, {"times": 2, "every_ns": 5}, {"away_ns": -1}])
def test_an_invalid_brown_out_is_refused(bench: Any, wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="away_ns"):
        bench.running().brown_out(**{"away_ns": 10} | wrong)


def test_a_bus_off_node_neither_sends_nor_receives_and_then_continues(bench: Any) -> None:
    node = bench.running()
    node.bus_off(500 * MS)
    assert bench.sync() == bench.nmt(128, 1) == bench.request(1, b"\x40\x18\x10\x02") == []
    assert bench.run(490) == []  # no heartbeats either
    bench.run(10)
    assert node.state == "OPERATIONAL"  # the command was not received
    assert bench.sync() == [DATA]
    assert [frame for _, frame in bench.run(200)] == [(0x701, b"\x05")]


def test_bus_off_may_end_in_a_boot(bench: Any) -> None:
    node = bench.running()
    start_ms = bench.t_ns // MS
    node.bus_off(50 * MS, boots=True)
    assert bench.run(60) == [(start_ms + 50, (0x701, b"\0"))]
    assert node.state == "PRE-OPERATIONAL"


def test_a_node_without_power_stays_off_when_its_bus_off_ends(bench: Any) -> None:
    node = bench.running()
    node.bus_off(50 * MS, boots=True)
    node.unplug()
    assert bench.run(300) == []


def test_a_babbling_node_sends_at_its_rate_until_stopped(bench: Any) -> None:
    node = bench.running()
    node.start_babbling(5000)
    bench.run(1)
    assert [frame for _, frame in bench.data(100)] == [(0x281, bytes(8))] * 500
    node.start_babbling(1000, 0x005, b"\1")
    assert {frame for _, frame in bench.data(100)} == {(0x005, b"\1")}
    node.stop_babbling()
    assert bench.data(50) == []
    with pytest.raises(ValueError, match="rate_hz"):
        node.start_babbling(0)


def test_a_babbling_node_makes_up_for_no_more_than_a_tenth_of_a_second(bench: Any) -> None:
    bench.running().start_babbling(1000)
    bench.t_ns += 10_000 * MS
    bench.bus.advance(bench.t_ns)
    assert sum(identifier == 0x281 for identifier, _ in bench.take()) <= 102


# Who is there.


def test_twins_both_answer_under_one_id(bench: Any) -> None:
    bench.running(2, serial=7)
    twin = bench.bus.add_twin(2, serial=8)
    twin.plug()
    assert bench.take() == [(0x702, b"\0")]
    bench.nmt(1, 2)
    bench.counts[0] = (1, 2, 3, 4)
    assert bench.sync() == [(0x282, struct.pack("<4h", 1, 2, 3, 4))] * 2
    answers = bench.request(2, b"\x40\x18\x10\x04")
    assert [data[4] for _, data in answers] == [7, 8]
    twin.unplug()
    assert len(bench.sync()) == 1
    with pytest.raises(KeyError):
        bench.bus.add_twin(9, serial=1)


def test_a_replaced_node_keeps_its_serial_number_through_reboots(bench: Any) -> None:
    node = bench.running(serial=7)
    node.replace_device(8)
    node.reboot()
    assert bench.take() == [(0x701, b"\0")] * 2
    assert node.serial == bench.read(1, 0x1018, 4) == 8


# What the SDO server does.


def upload_name(bench: Any, toggles: tuple[int, ...] = (0, 0x10, 0, 0x10)) -> list[bytes]:
    """The answers to a segmented upload of the device name, 27 characters."""
    answers = [data for _, data in bench.request(1, b"\x40\x08\x10\x00")]
    for toggle in toggles:
        answers += [data for _, data in bench.request(1, bytes([0x60 | toggle]))]
    return answers


def test_a_long_object_comes_in_segments(bench: Any) -> None:
    bench.running()
    first, *segments = upload_name(bench)
    assert first == b"\x41\x08\x10\0" + struct.pack("<I", 27)
    assert b"".join(data[1:] for data in segments) == b"handtouch four-channel node\0"


def test_a_failing_object_is_aborted_with_its_code_or_not_answered(bench: Any) -> None:
    node = bench.running()
    node.sdo.fail[0x1018, 2] = GENERAL
    node.sdo.fail[0x1801, 2] = None
    assert bench.read(1, 0x1018, 2) == -GENERAL
    assert bench.request(1, b"\x40\x01\x18\x02") == bench.request(1, b"\x2f\x01\x18\x02\x05") == []
    assert bench.read(1, 0x1018, 1) == 0
    node.sdo.fail.clear()
    assert bench.read(1, 0x1801, 2) == 1


def test_a_refused_write_leaves_reading_alone(bench: Any) -> None:
    node = bench.running()
    node.sdo.fail_write[0x1017, 0] = 0x06010002
    assert bench.write(1, 0x1017, 0, 50, 2) == 0x06010002
    assert bench.read(1, 0x1017, 0) == 200
    node.sdo.fail_write.clear()
    assert bench.write(1, 0x1017, 0, 50, 2) == 0


def test_any_step_of_a_sequence_can_fail_once(bench: Any) -> None:
    node = bench.running()
    for step in range(5):
        first = node.sdo.requests + 1
        node.sdo.fail_nth = {first + step: 0x06040047}
        expected = [bench.read(1, 0x1018, 2) for _ in range(5)]
        assert expected == [0x401] * step + [-0x06040047] + [0x401] * (4 - step)
        node.sdo.fail_nth = {node.sdo.requests + 1 + step: None}
        answered = [len(bench.request(1, b"\x40\x18\x10\x02")) for _ in range(5)]
        assert answered == [1] * step + [0] + [1] * (4 - step)


def test_a_segment_can_fail_too(bench: Any) -> None:
    node = bench.running()
    node.sdo.fail_nth = {node.sdo.requests + 3: GENERAL}
    answers = upload_name(bench)
    assert [data[0] for data in answers] == [0x41, 0x00, 0x80, 0x80, 0x80]
    assert struct.unpack_from("<BHBI", answers[2]) == (0x80, 0x1008, 0, GENERAL)


def test_a_frozen_server_does_not_respond_while_data_continue(bench: Any) -> None:
    node = bench.running()
    node.sdo.frozen = True
    assert bench.request(1, b"\x40\x18\x10\x02") == []
    assert bench.sync() == [DATA]
    node.sdo.frozen = False
    assert bench.read(1, 0x1018, 2) == 0x401


def test_garbled_answers_have_wrong_toggles_or_objects_or_are_noise(bench: Any) -> None:
    node = bench.running()
    good = upload_name(bench)
    node.sdo.garble = "toggle"
    wrong = upload_name(bench)
    assert wrong[0] == good[0]
    assert [data[0] ^ 0x10 for data in wrong[1:]] == [data[0] for data in good[1:]]
    node.sdo.garble = "object"
    (name,) = bench.request(1, b"\x40\x18\x10\x02")
    assert name[1][1:4] != b"\x18\x10\x02"
    node.sdo.garble = "noise"
    assert len({bench.request(1, b"\x40\x18\x10\x02")[0][1] for _ in range(20)}) == 20
    node.sdo.garble = None
    assert bench.read(1, 0x1018, 2) == 0x401


def test_an_abort_of_the_client_ends_the_transfer(bench: Any) -> None:
    bench.running()
    upload_name(bench, toggles=(0,))
    assert bench.request(1, b"\x80\x08\x10\0\0\0\x04\x05") == []
    ((_, data),) = bench.request(1, b"\x70")
    assert data[0] == 0x80


# What is still there.


def test_heartbeat_and_data_fail_apart(bench: Any) -> None:
    node = bench.running()
    node.send_data = False
    assert bench.sync() == []
    assert [frame for _, frame in bench.run(200)] == [(0x701, b"\x05")]
    node.send_data, node.send_heartbeat = True, False
    assert bench.sync() == [DATA]
    assert bench.run(400) == []


def test_an_emergency_sets_the_error_register_and_a_stopped_node_sends_none(bench: Any) -> None:
    node = bench.running()
    node.send_emergency(0x3210, 0x05)
    assert bench.take() == [(0x81, b"\x10\x32\x05\0\0\0\0\0")]
    assert bench.read(1, 0x1001, 0) == 0x05
    bench.nmt(2, 1)
    node.send_emergency(0x3210, 0x05)
    assert bench.take() == []
