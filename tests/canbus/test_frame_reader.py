"""Batches of frames from a socket, a pair of Unix sockets in place of SocketCAN or of multicast: stored,
routed, counted."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Iterator

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtouch.canbus.bus.frame_reader import FrameReader, enable_stamps
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.receivers import MAX_DRAIN_FRAMES, clock_offset_ns
from handtouch.canbus.bus.router import CanFrame, Router
from handtouch.canbus.bus.sockets import DatagramReceiver, SocketcanReceiver
from handtouch.config import Bus
from handtouch.core.slab import ChannelField, Slab

EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
SO_TIMESTAMPNS = 35
SLOTS = 3
TWO_PDOS = (
    ChannelField(0, 0, 32, True),
    ChannelField(0, 32, 32, True),
    ChannelField(1, 0, 32, True),
    ChannelField(1, 32, 32, True),
)


class PairBus(can.BusABC):
    """One end of a pair of sockets whose datagrams are `struct can_frame`."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__("pair")
        self._end = end

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


class Rig:
    """A port on one end, whose other end is the rest of the bus."""

    def __init__(self, kind: type[SocketcanReceiver] | type[DatagramReceiver] = SocketcanReceiver) -> None:
        self.other, self.ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        for end in (self.other, self.ours):
            end.setblocking(False)
        self.slab = Slab(SLOTS)
        self.slab.set_layout(2, TWO_PDOS)
        options = {"channel": "pair"} if kind is SocketcanReceiver else {}
        receiver = kind(lambda: PairBus(self.ours), **options).open()
        interface = "socketcan" if kind is SocketcanReceiver else "udp_multicast"
        self.port = Port(Bus(name="palm", interface=interface, channel="pair"), receiver, self.slab)
        set_routes(self.port.router)

    def close(self) -> None:
        self.port.close()
        self.other.close()
        self.ours.close()


def set_routes(router: Router) -> None:
    """Route two pads of one PDO, the second of six bytes, and one of two PDOs."""
    router.route(0x281, 0)
    router.route(0x282, 1, 0, 6)
    router.route(0x283, 2, 0)
    router.route(0x383, 2, 1)


def frame(can_id: int, data: bytes, size: int | None = None) -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data) if size is None else size, data)


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.close()


def test_samples_of_a_batch_are_in_the_slab_with_the_kernels_stamps(rig: Rig) -> None:
    before_ns = time.monotonic_ns()
    for can_id, data in ((0x281, b"\x01\x00\xff\xff\x00\x80\xff\x7f"), (0x282, b"\x02\x00\x03\x00\x04\x00")):
        rig.other.send(frame(can_id, data))
    sent_ns = time.monotonic_ns()
    assert rig.port.drain() == []
    assert rig.slab.unpack_counts()[:2].tolist() == [[1, -1, -32768, 32767], [2, 3, 4, 0]]
    assert rig.slab.fresh.tolist() == [1, 1, 0]
    first_ns, second_ns, _ = rig.slab.arrival_ns.tolist()
    clock_error_ns = 1_000_000  # both clocks are read one after the other, and a busy machine may interrupt
    assert before_ns - clock_error_ns < first_ns <= second_ns < sent_ns + clock_error_ns
    assert (rig.port.counters.samples, rig.port.counters.frames) == (2, 2)


FRAMES = st.builds(
    frame,
    st.one_of(
        st.sampled_from([0x281, 0x282, 0x283, 0x383]),
        st.integers(0, 0x7FF),
        st.builds(
            int.__or__,
            st.sampled_from([0x281, 0x701, 0x12345]),
            st.sampled_from([EXTENDED, REMOTE, ERROR, EXTENDED | REMOTE]),
        ),
    ),
    st.one_of(st.binary(min_size=6, max_size=6), st.binary(max_size=8)),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(FRAMES, max_size=40))
def test_a_batch_has_the_result_of_its_frames_one_by_one(frames: list[bytes]) -> None:
    rig = Rig()
    for data in frames:
        rig.other.send(data)
    others = rig.port.drain()
    expected_slab = Slab(SLOTS)
    expected_slab.set_layout(2, TWO_PDOS)
    router = Router(expected_slab)
    set_routes(router)
    expected = [other for data in frames if (other := accept(router, data))]
    assert [other[:2] for other in others] == [other[:2] for other in expected]
    assert rig.port.counters == router.counters
    assert rig.slab.unpack_counts().tolist() == expected_slab.unpack_counts().tolist()
    assert rig.slab.fresh.tolist() == expected_slab.fresh.tolist()
    assert rig.slab.fresh_count == expected_slab.fresh_count
    assert rig.slab.repeat_counts.tolist() == expected_slab.repeat_counts.tolist()
    rig.close()


def accept(router: Router, data: bytes) -> CanFrame | None:
    """Accept a frame as python-can would decode it."""
    can_id, size, payload = struct.unpack("=IB3x8s", data)
    is_remote, is_error = bool(can_id & REMOTE), bool(can_id & ERROR)
    message = can.Message(
        arbitration_id=can_id & 0x1FFFFFFF,
        is_extended_id=bool(can_id & EXTENDED),
        is_remote_frame=is_remote,
        is_error_frame=is_error,
        dlc=size,
        data=None if is_remote else payload[:size],
    )
    return router.accept_message(message, 1)


def test_can_fd_frames_and_malformed_datagrams_are_counted_and_dropped(rig: Rig) -> None:
    sample = frame(0x281, bytes(8))
    for data in (sample, sample + bytes(56), sample[:12], b"", frame(0x281, bytes(8), size=9), sample * 20):
        rig.other.send(data)
    rig.other.send(frame(0x281, b"\x05" + bytes(7)))
    assert rig.port.drain() == []
    counters = rig.port.counters
    assert (counters.samples, counters.unknown_frames, counters.frames) == (2, 5, 2)
    assert rig.slab.unpack_counts()[0].tolist() == [5, 0, 0, 0]


def test_samples_after_another_frame_of_the_batch_are_stored(rig: Rig) -> None:
    for data in (
        frame(0x80, b""),
        frame(0x281, b"\x01" * 8),
        frame(0x701, b"\x05"),
        frame(0x281, b"\x02" * 8),
    ):
        rig.other.send(data)
    others = rig.port.drain()
    assert [(can_id, data) for can_id, data, _ in others] == [(0x80, b""), (0x701, b"\x05")]
    assert others[0][2] <= others[1][2] <= rig.slab.arrival_ns[0]
    assert rig.slab.unpack_counts()[0].tolist() == [0x202] * 4
    assert (rig.slab.fresh_count, rig.slab.repeat_counts.tolist()) == (1, [1, 0, 0])


def test_a_queue_longer_than_a_batch_is_read_whole_and_what_waits_is_reported(rig: Rig) -> None:
    rig.other.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 24)
    sent = 0
    with contextlib.suppress(BlockingIOError):  # as many as the kernel queues
        while True:
            rig.other.send(frame(0x281, sent.to_bytes(8, "little")))
            sent += 1
    assert sent > 0
    while rig.port.counters.samples < sent:
        before = rig.port.counters.samples
        rig.port.drain()
        assert before < rig.port.counters.samples <= before + MAX_DRAIN_FRAMES
    assert int(rig.slab.unpack_counts()[0].astype("<i2").view("<i8")[0]) == sent - 1


def test_samples_without_stamps_arrive_when_they_are_read(rig: Rig) -> None:
    rig.other.send(frame(0x281, bytes(8)))
    rig.port.drain()
    rig.ours.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 0)
    rig.other.send(frame(0x281, bytes(8)))
    before_ns = time.monotonic_ns()
    rig.port.drain()
    assert before_ns <= rig.slab.arrival_ns[0] <= time.monotonic_ns()
    rig.ours.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    rig.other.send(frame(0x281, bytes(8)))
    sent_ns = time.monotonic_ns()
    time.sleep(0.02)
    rig.port.drain()
    assert rig.slab.arrival_ns[0] < sent_ns + 10_000_000


def test_a_closed_peer_is_reported_and_reading_never_raises(rig: Rig) -> None:
    rig.other.close()
    assert rig.port.drain() == []
    assert not rig.port.send(0x80, b"")
    assert rig.port.counters.send_failures == 1


MESSAGES = st.builds(
    can.Message,
    timestamp=st.floats(0, 1e10),
    arbitration_id=st.one_of(
        st.sampled_from([0x281, 0x282, 0x283, 0x383, 0x80, 0x77, 0x711]), st.integers(0, 0x7FF)
    ),
    is_extended_id=st.sampled_from([False] * 4 + [True]),
    is_remote_frame=st.sampled_from([False] * 6 + [True]),
    is_error_frame=st.sampled_from([False] * 6 + [True]),
    is_fd=st.sampled_from([False] * 6 + [True]),
    channel=st.sampled_from([None, None, "can0", 3]),
    data=st.one_of(
        st.binary(min_size=6, max_size=6), st.binary(max_size=8), st.binary(min_size=8, max_size=8)
    ),
)
PACKETS = st.one_of(
    MESSAGES.map(pack_message),
    MESSAGES.map(pack_message),
    MESSAGES.map(lambda message: pack_message(message)[:-1]),
    MESSAGES.map(lambda message: pack_message(message) + b"\x00"),
    st.binary(max_size=400),
    st.integers(0x800, 0xFFFF).map(lambda can_id: _with_identifier(can_id)),
)


def _with_identifier(can_id: int) -> bytes:
    packed = pack_message(can.Message(arbitration_id=0x7FF, data=bytes(8), is_extended_id=False))
    return packed.replace(b"\xcd\x07\xff", b"\xcd" + can_id.to_bytes(2, "big"))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(PACKETS, max_size=19))
def test_a_batch_of_packets_has_the_result_of_python_cans_messages_one_by_one(packets: list[bytes]) -> None:
    rig = Rig(DatagramReceiver)
    for data in packets:
        rig.other.send(data)
    others = rig.port.drain()
    expected_slab = Slab(SLOTS)
    expected_slab.set_layout(2, TWO_PDOS)
    router, expected, failures = Router(expected_slab), [], 0
    set_routes(router)
    for data in packets:
        try:
            message = unpack_message(data, check=True)
        except Exception:  # noqa: BLE001 - whatever it raises is counted
            failures += 1
            continue
        if other := router.accept_message(message, 1):
            expected.append(other)
    router.counters.receive_failures = failures
    assert [other[:2] for other in others] == [other[:2] for other in expected]
    assert rig.port.counters == router.counters
    assert rig.slab.unpack_counts().tolist() == expected_slab.unpack_counts().tolist()
    assert rig.slab.repeat_counts.tolist() == expected_slab.repeat_counts.tolist()
    rig.close()


def test_frames_behind_a_malformed_packet_are_received_with_it() -> None:
    rig = Rig(DatagramReceiver)
    good = pack_message(can.Message(arbitration_id=0x281, data=b"\x01\x00" * 4, is_extended_id=False))
    for data in (msgpack.packb({"arbitration_id": "x"}), good, b"\xc1", good):
        rig.other.send(data)
    rig.port.drain()
    counters = rig.port.counters
    assert (counters.samples, counters.receive_failures) == (2, 2)
    assert rig.slab.unpack_counts()[0].tolist() == [1, 1, 1, 1]
    rig.close()


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_step_of_the_wall_clock_moves_no_stamp_beyond_the_time_of_reading(step_s: int) -> None:
    reader = FrameReader()
    other, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with other, ours:
        enable_stamps(ours)
        earliest_ns = time.monotonic_ns()
        other.send(frame(0x281, bytes(8)))
        assert reader.receive(ours.fileno(), clock_offset_ns() + step_s * 10**9, earliest_ns) == 1
        assert earliest_ns <= reader.frame(0).arrival_ns <= time.monotonic_ns()
