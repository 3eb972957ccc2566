"""A port receives and sends on any python-can bus and survives its faults."""

from __future__ import annotations

import errno
import itertools
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from handtouch.canbus.bus import receivers
from handtouch.canbus.bus.bus_state import ErrorState
from handtouch.canbus.bus.frame_reader import PacketReader
from handtouch.canbus.bus.port import BusError, Port
from handtouch.canbus.bus.receivers import ReopenBackoff, ThreadReceiver
from handtouch.canbus.bus.router import Router
from handtouch.canbus.bus.sockets import DatagramReceiver
from handtouch.config import Bus
from handtouch.core.slab import Slab

_channels = itertools.count()


def frame(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def eventually(what: Callable[[], bool], seconds: float = 2.0) -> bool:
    """Wait for a reader thread."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if what():
            return True
        time.sleep(0.001)
    return what()


def readable(port: Port | ThreadReceiver | DatagramReceiver, seconds: float = 0.0) -> bool:
    return bool(select.select([port.fileno()], [], [], seconds)[0])


@pytest.fixture
def channel() -> str:
    return f"port-{next(_channels)}"


@pytest.fixture
def port(channel: str) -> Iterator[Port]:
    port = Port.open(Bus(name="palm", interface="virtual", channel=channel), Slab(2))
    yield port
    port.close()


@pytest.fixture
def other(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


def test_samples_go_to_the_slab_and_the_rest_is_returned_in_order(port: Port, other: can.BusABC) -> None:
    port.route(0x281, 1)
    before = time.monotonic_ns()
    for can_id, data in ((0x701, b"\x05"), (0x281, b"\x01\x00" * 4), (0x80, b""), (0x281, b"\x01")):
        other.send(frame(can_id, data))
    got: list[tuple[int, bytes, int]] = []

    def all_came() -> bool:
        got.extend(port.drain())
        return port.counters.frames == 4

    assert eventually(all_came)
    assert [(can_id, data) for can_id, data, _ in got] == [(0x701, b"\x05"), (0x80, b"")]
    assert all(before - 10**6 <= t_ns <= time.monotonic_ns() for _, _, t_ns in got)
    assert before - 10**6 <= port.slab.arrival_ns[1] <= time.monotonic_ns()
    assert port.slab.unpack_counts()[1].tolist() == [1] * 4
    assert (port.counters.samples, port.counters.wrong_length) == (1, 1)


def test_descriptor_is_readable_exactly_while_frames_wait(port: Port, other: can.BusABC) -> None:
    assert not readable(port)
    other.send(frame(0x701, b"\x05"))
    assert readable(port, 1.0)
    port.drain()
    assert not readable(port)
    other.send(frame(0x701, b"\x05"))
    assert readable(port, 1.0)


@pytest.mark.parametrize("when", ["before", "after"])
def test_frame_received_while_the_signal_is_cleared_is_not_lost(
    port: Port, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read in another order, the signal of the second frame was taken and the third raised none."""
    receiver: Any = port._receiver
    lower = receivers._eventfd_read

    def meanwhile(descriptor: int, value: Any) -> int:
        if when == "before":
            receiver._enqueue(frame(0x701, b"\x02"))
        failed: int = lower(descriptor, value)
        if when == "after":
            receiver._enqueue(frame(0x701, b"\x02"))
        return failed

    receiver._enqueue(frame(0x701, b"\x01"))
    with monkeypatch.context() as patch:
        patch.setattr(receivers, "_eventfd_read", meanwhile)
        got = port.drain()
    receiver._enqueue(frame(0x701, b"\x03"))
    assert readable(port)
    assert [data for _, data, _ in got + port.drain()] == [b"\x01", b"\x02", b"\x03"]


def test_frames_beyond_one_drain_are_not_lost(
    port: Port, other: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receivers, "MAX_DRAIN_FRAMES", 10)
    for _ in range(25):
        other.send(frame(0x701, b"\x05"))
    assert eventually(lambda: len(port._receiver._queue) == 25)  # type: ignore[attr-defined]  # the reader's
    sizes = []
    while readable(port):
        sizes.append(len(port.drain()))
    assert [size for size in sizes if size] == [10, 10, 5]


def test_overflow_keeps_the_newest_and_is_counted(
    channel: str, other: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receivers, "MAX_QUEUE_FRAMES", 8)
    port = Port.open(Bus(name="palm", interface="virtual", channel=channel), Slab(1))
    for number in range(20):
        other.send(frame(0x700, bytes((number,))))
    assert eventually(lambda: port._receiver._lost == 12)  # type: ignore[attr-defined]  # the reader's
    assert [data[0] for _, data, _ in port.drain()] == list(range(12, 20))
    assert port.counters.overflow == 12
    port.close()


def test_bus_in_this_process_holds_as_many_frames_as_its_option_says(channel: str, other: can.BusABC) -> None:
    bus = Bus(name="palm", interface="virtual", channel=channel, options={"rx_queue_size": 3})
    port = Port.open(bus, Slab(1))
    for number in range(5):
        other.send(frame(0x700, bytes((number,))))
    assert [data[0] for _, data, _ in port.drain()] == [2, 3, 4]
    assert port.counters.overflow == 2
    port.close()
    other.send(frame(0x700, b""))  # received by no node


def test_senders_at_once_on_a_bus_in_this_process_lose_nothing(channel: str) -> None:
    """Each has a thread, the receiver none: `drain` is all there is."""
    before = threading.active_count()
    port = Port.open(Bus(name="palm", interface="virtual", channel=channel), Slab(1))
    assert threading.active_count() == before
    buses = [can.Bus(interface="virtual", channel=channel) for _ in range(4)]

    def send(bus: can.BusABC) -> None:
        for number in range(200):
            bus.send(frame(0x700, bytes((number,))))

    threads = [threading.Thread(target=send, args=(bus,)) for bus in buses]
    for thread in threads:
        thread.start()
    got: list[int] = []
    while any(thread.is_alive() for thread in threads) or readable(port):
        if readable(port, 0.1):
            got += [data[0] for _, data, _ in port.drain()]
    assert sorted(got) == sorted(4 * list(range(200)))
    assert port.counters.overflow == 0
    for bus in buses:
        bus.shutdown()
    port.close()


def test_sent_frames_arrive_and_count_as_load(port: Port, other: can.BusABC) -> None:
    assert port.send(0x601, b"\x40\x00\x10\x00\x00\x00\x00\x00")
    received = other.recv(1.0)
    assert received is not None
    assert (received.arbitration_id, len(received.data), received.is_extended_id) == (0x601, 8, False)
    assert (port.counters.sent, port.counters.bits) == (1, 135)


def test_two_ports_may_share_a_slab() -> None:
    slab = Slab(2)
    names = [f"port-{next(_channels)}" for _ in range(2)]
    ports = [Port.open(Bus(name=name, interface="virtual", channel=name), slab) for name in names]
    for slot, (port, name) in enumerate(zip(ports, names, strict=True)):
        port.route(0x281, slot)  # the same identifier on both buses
        with can.Bus(interface="virtual", channel=name) as bus:
            bus.send(frame(0x281, bytes((slot + 1, 0)) * 4))
    assert eventually(lambda: not any(port.drain() for port in ports) and slab.fresh_count == 2)
    assert slab.unpack_counts()[:, 0].tolist() == [1, 2]
    for port in ports:
        port.close()


@pytest.mark.parametrize(
    ("interface", "channel", "expected"),
    [
        ("nonsense", "1", "must be one of python-can's"),
        ("udp_multicast", "10.0.0.1", "multicast address"),
        ("socketcan", "nocan7", "ip link set nocan7 up|no CAN support"),
        ("slcan", "/dev/no-such-tty", "adapter plugged in|one of python-can's"),
    ],
)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # python-can's half-made buses
def test_bus_that_cannot_be_opened_is_named_with_a_remedy(
    interface: str, channel: str, expected: str
) -> None:
    with pytest.raises(BusError, match=expected) as caught:
        Port.open(Bus(name="palm", interface=interface, channel=channel), Slab(1))
    assert str(caught.value).startswith(f'bus "palm" (interface {interface}, channel {channel})')


class FakeBus(can.BusABC):
    """A bus that gives what `script` holds: frames, exceptions; then nothing. Readable all the time."""

    def __init__(self, script: list[Any]) -> None:
        self.script = script
        self.ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.ends[1].send(b"x")
        self.closed = False
        self.send_error: Exception = can.CanOperationError("Transmit buffer full")
        super().__init__("fake")

    def fileno(self) -> int:
        return self.ends[0].fileno()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self.script:
            time.sleep(min(timeout or 0, 0.001))
            return None, False
        item = self.script.pop(0)
        if isinstance(item, Exception):
            raise item
        return item, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        raise self.send_error

    def shutdown(self) -> None:
        self.closed = True
        for end in self.ends:
            end.close()
        super().shutdown()


class Opener:
    """Opens a new FakeBus for each script; a script that is an exception is an opening that fails."""

    def __init__(self, *scripts: Any) -> None:
        self.scripts = list(scripts)
        self.opened: list[FakeBus] = []

    def __call__(self) -> can.BusABC:
        script = self.scripts.pop(0) if self.scripts else []
        if isinstance(script, Exception):
            raise script
        self.opened.append(FakeBus(script))
        return self.opened[-1]


class ScriptedReader(PacketReader):
    """Reads a FakeBus's script: frames as datagrams of python-can, other things as garbage."""

    def __init__(self, bus: FakeBus) -> None:
        super().__init__()
        self._bus = bus

    def receive(self, descriptor: int, offset_ns: int, earliest_ns: int) -> int:
        if not self._bus.script:
            return 0
        item = self._bus.script.pop(0)
        if isinstance(item, can.Message):
            packet = pack_message(item)
        elif item is MALFORMED or isinstance(item, ValueError):
            packet = b"no such thing as a frame"
        else:
            raise item
        ours, other = self._bus.ends
        ours.recv(1)  # what makes it readable
        other.send(packet)
        count = super().receive(descriptor, offset_ns, earliest_ns)
        other.send(b"x")
        return count


class ScriptedDatagrams(DatagramReceiver):
    """Reads a FakeBus's script as datagrams."""

    def _attach_bus(self, bus: can.BusABC) -> None:
        assert isinstance(bus, FakeBus)
        super()._attach_bus(bus)
        self._reader = ScriptedReader(bus)


GONE = OSError(errno.ENODEV, "No such device")
DOWN = can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN)
MALFORMED = can.CanOperationError("could not unpack received message")
SAMPLE = frame(0x281, bytes(8))


@pytest.fixture(params=["datagram", "thread"])
def start(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Both receivers, with short pauses."""
    monkeypatch.setattr(receivers, "_MIN_RETRY_S", 0.002)
    made: list[ThreadReceiver | DatagramReceiver] = []

    def start(opener: Opener) -> ThreadReceiver | DatagramReceiver:
        receiver: ThreadReceiver | DatagramReceiver = (
            ScriptedDatagrams(opener).open()
            if request.param == "datagram"
            else ThreadReceiver(opener, "fake").open()
        )
        made.append(receiver)
        return receiver

    yield start
    for receiver in made:
        receiver.close()


@pytest.fixture
def router() -> Router:
    router = Router(Slab(1))
    router.route(0x281, 0)
    return router


def drain_until(receiver: Any, router: Router, what: Callable[[], bool]) -> bool:
    return eventually(lambda: not receiver.drain(router) and what())


def test_malformed_datagrams_are_counted_and_the_rest_is_received(start: Any, router: Router) -> None:
    opener = Opener([MALFORMED, SAMPLE, ValueError("bad hex"), SAMPLE, *[MALFORMED] * 9, SAMPLE])
    receiver = start(opener)
    assert drain_until(receiver, router, lambda: router.counters.samples == 3)
    assert router.counters.receive_failures == 11
    assert len(opener.opened) == 1


def test_constantly_failing_bus_is_reopened(start: Any, router: Router) -> None:
    opener = Opener([MALFORMED] * 1000, [SAMPLE])
    assert drain_until(start(opener), router, lambda: router.counters.samples == 1)
    assert opener.opened[0].closed


def test_interface_that_goes_down_and_up_is_used_again(start: Any, router: Router) -> None:
    receiver = start(Opener([SAMPLE, DOWN, SAMPLE]))
    assert drain_until(receiver, router, lambda: router.counters.samples == 2)
    assert router.counters.receive_failures == 1
    assert drain_until(receiver, router, lambda: receiver.fault is None)


def test_unplugged_adapter_is_reopened_when_it_is_back(start: Any, router: Router) -> None:
    opener = Opener([SAMPLE, GONE, GONE, GONE], GONE, GONE, [SAMPLE])
    receiver = start(opener)
    descriptor = receiver.fileno()
    assert drain_until(receiver, router, lambda: router.counters.samples == 2)
    assert receiver.fileno() == descriptor
    assert opener.opened[0].closed
    assert router.counters.receive_failures >= 3


def test_problem_is_reported_while_the_bus_is_disconnected(start: Any, router: Router) -> None:
    receiver = start(Opener([GONE, GONE, GONE], *[GONE] * 1000))
    assert drain_until(receiver, router, lambda: "No such device" in str(receiver.fault))
    with pytest.raises((OSError, can.CanError)):
        receiver.send(0x80, b"")


def test_full_transmit_queue_is_counted_never_raised(start: Any) -> None:
    port = Port(Bus(name="palm", interface="fake", channel="1"), start(Opener()), Slab(1))
    assert not port.send(0x80, b"")
    assert (port.counters.sent, port.counters.queue_full, port.counters.bits) == (0, 1, 0)


def test_other_send_failures_are_distinguished_from_a_full_queue(start: Any) -> None:
    opener = Opener()
    port = Port(Bus(name="palm", interface="fake", channel="1"), start(opener), Slab(1))
    assert not port.send(0x80, b"")
    assert "transmit queue full, 1 frames not sent" in port.update_state(time.monotonic_ns()).problem
    opener.opened[0].send_error = ValueError("whatever drivers raise")
    assert not port.send(0x80, b"")
    assert (port.counters.queue_full, port.counters.send_failures) == (1, 1)
    assert port.bus_state.error_state is ErrorState.ACTIVE
    assert port.send_cyclically(0x80, b"", 0.01) is None  # no kernel here


@pytest.mark.parametrize("detected_by", ["recv", "send"])
def test_bus_off_adapter_is_reopened(detected_by: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receivers, "_MIN_RETRY_S", 0.002)
    off = can.CanOperationError("The controller is bus-off")
    opener = Opener([off] if detected_by == "recv" else [], OSError("still busy"), [SAMPLE])
    receiver = ThreadReceiver(opener, "fake").open()
    port = Port(Bus(name="palm", interface="fake", channel="1"), receiver, Slab(1))
    opener.opened[0].send_error = off
    if detected_by == "send":
        assert not port.send(0x80, b"")
        assert port.update_state(time.monotonic_ns()).error_state is ErrorState.BUS_OFF
        assert "reopened until it works" in port.problem
    assert eventually(lambda: port.drain() == [(0x281, bytes(8), mock.ANY)])
    assert opener.opened[0].closed
    assert len(opener.opened) == 2
    assert port.update_state(time.monotonic_ns()).error_state is ErrorState.ACTIVE
    port.close()


def test_error_frame_in_the_kernels_layout_sets_the_state() -> None:
    bus_off = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True)
    receiver = ThreadReceiver(Opener([bus_off]), "gs_usb").open()
    port = Port(Bus(name="palm", interface="gs_usb", channel="1"), receiver, Slab(1))
    assert eventually(lambda: port.drain() == [] and port.counters.error_frames == 1)
    assert port.update_state(time.monotonic_ns()).error_state is ErrorState.BUS_OFF
    assert port.bus_state.causes == {"bus-off": 1}
    port.close()


@pytest.mark.parametrize("can_id", [0x800, 0xFFF, -1])
def test_invalid_identifier_is_dropped(router: Router, can_id: int) -> None:
    """A garbled line of slcan may have an identifier beyond 11 bits, which is the router's index."""
    odd = frame(0, b"")
    odd.arbitration_id = can_id
    receiver = ThreadReceiver(Opener([odd, SAMPLE]), "fake").open()
    assert drain_until(receiver, router, lambda: router.counters.samples == 1)
    assert router.counters.unknown_frames == 1
    receiver.close()


def _packet(**other: Any) -> bytes:
    """A datagram of python-can with other fields."""
    sample = {"arbitration_id": 0x281, "dlc": 8, "data": bytes(8), "timestamp": 0.0, "channel": None}
    flags = dict.fromkeys(
        ("is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch"), False
    )
    packed: bytes = msgpack.packb(sample | flags | {"error_state_indicator": False} | other)
    return packed


@pytest.mark.parametrize(
    ("packet", "count"),
    [
        (_packet(), "samples"),
        (_packet(dlc=4, data=bytes(4)), "wrong_length"),
        (_packet(is_extended_id=True), "unknown_frames"),
        (_packet(is_fd=True, dlc=12, data=bytes(12)), "unknown_frames"),
        (_packet(is_error_frame=True), "error_frames"),
        (_packet(is_remote_frame=True, arbitration_id=0x701, dlc=1, data=b""), "frames"),
        (_packet(dlc=7), "receive_failures"),
        (_packet(data="text"), "receive_failures"),
        (_packet(arbitration_id="1"), "receive_failures"),
        (_packet(arbitration_id=0x800), "receive_failures"),
        (_packet(more=1), "receive_failures"),
        (msgpack.packb(5), "receive_failures"),
        (msgpack.packb({}), "unknown_frames"),
        (b"", "receive_failures"),
        (b"\xc1", "receive_failures"),
    ],
)
def test_datagrams_are_decoded_as_by_python_can(packet: bytes, count: str, router: Router) -> None:
    opener = Opener()
    receiver = DatagramReceiver(opener).open()
    opener.opened[0].ends[0].recv(1)
    opener.opened[0].ends[1].send(packet)
    assert receiver.drain(router) == []
    assert getattr(router.counters, count) == 1
    assert router.counters.samples + router.counters.receive_failures <= 1
    receiver.close()


def test_remote_frame_is_sent_as_one(port: Port, other: can.BusABC) -> None:
    assert port.send(0x701, bytes(1), remote=True)
    got = other.recv(1.0)
    assert got is not None
    assert (got.arbitration_id, got.is_remote_frame, got.dlc) == (0x701, True, 1)
    assert port.counters.bits == 55
    other.send(got)
    assert eventually(lambda: port.drain() == [] and port.counters.frames == 1)  # guarding is nothing foreign


def test_adapter_that_fails_to_close_is_released() -> None:
    class Stuck(FakeBus):
        def shutdown(self) -> None:
            super().shutdown()
            raise can.CanOperationError("Could not write to serial device")

    ThreadReceiver(lambda: Stuck([]), "fake").open().close()
    DatagramReceiver(lambda: Stuck([])).open().close()


def test_closing_releases_all_descriptors() -> None:
    """Descriptors are counted, as a leak of one per reconnection would end a long run."""
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        receiver = ThreadReceiver(Opener(), "fake").open()
        receiver.close()
        DatagramReceiver(Opener()).open().close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_delays_between_attempts_grow_to_a_limit() -> None:
    retry, t_ns, tries = ReopenBackoff(), 0, []
    for t_ns in range(0, 20_000_000_000, 10_000_000):
        if retry.due(t_ns):
            tries.append(t_ns / 1e9)
    pauses = [b - a for a, b in itertools.pairwise(tries)]
    assert pauses[:3] == pytest.approx([0.1, 0.2, 0.4])
    assert max(pauses) == pytest.approx(2.0)
    retry.reset()
    assert retry.due(t_ns)


OVERFLOW = """
import can
from handtouch.canbus.bus import receivers
from handtouch.canbus.bus.port import Port
from handtouch.core.slab import Slab
from handtouch.config import Bus
receivers.RECEIVE_BUFFER_BYTES = 1  # the kernel's least: a few frames
port = Port.open(Bus(name="palm", interface="udp_multicast", channel="239.74.163.3"), Slab(1))
other = can.Bus(interface="udp_multicast", channel="239.74.163.3")
for number in range(200):
    other.send(can.Message(arbitration_id=0x701, data=bytes(8), is_extended_id=False))
port.drain()
c = port.counters
assert 0 < c.frames < 200 and c.overflow == 200 - c.frames, c
port.close(); other.shutdown()
"""


def test_frames_dropped_by_udp_multicast_are_counted(network: list[str]) -> None:
    done = subprocess.run(
        [*network, sys.executable, "-c", OVERFLOW], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr


UDP = """
import time, can
from handtouch.canbus.bus.port import Port
from handtouch.core.slab import Slab
from handtouch.config import Bus
bus = Bus(name="palm", interface="udp_multicast", channel="239.74.163.2")
port = Port.open(bus, Slab(1))
port.route(0x281, 0)
other = can.Bus(interface="udp_multicast", channel="239.74.163.2")
other.send(can.Message(arbitration_id=0x281, data=b"\\x01\\x00" * 4, is_extended_id=False))
other._multicast.send(b"no such thing as a frame")
other.send(can.Message(arbitration_id=0x281, data=b"\\x02\\x00" * 4, is_extended_id=False))
port.send(0x80, b"")
others = []
deadline = time.monotonic() + 5
while not others and time.monotonic() < deadline:
    others += port.drain()
assert [(i, d) for i, d, _ in others] == [(0x80, b"")], others  # our own SYNC comes back
assert port.slab.unpack_counts()[0].tolist() == [2] * 4, port.slab.unpack_counts()
assert 0 <= time.monotonic_ns() - port.slab.arrival_ns[0] < 10**9
c = port.counters
assert (c.samples, c.receive_failures, c.sent, c.bits) == (2, 1, 1, 135 + 135 + 55), c
port.close(); other.shutdown()
"""


def test_udp_multicast_between_two_buses(network: list[str]) -> None:
    done = subprocess.run([*network, sys.executable, "-c", UDP], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


UDP_DOWN = """
import subprocess, time
from handtouch.canbus.bus.port import Port
from handtouch.config import Bus
from handtouch.core.slab import Slab

UP = "ip link set lo up multicast on && ip route add 239.0.0.0/8 dev lo"
subprocess.run(UP, shell=True, check=True)
port = Port.open(Bus(name="palm", interface="udp_multicast", channel="239.74.163.2"), Slab(1))

def wait_for(state):
    end_s = time.monotonic() + 20
    while port.bus_state.error_state.value != state:
        assert time.monotonic() < end_s, port.bus_state.report()
        port.send(0x80, b"")
        port.drain()
        port.update_state(time.monotonic_ns())

wait_for("active")
subprocess.run("ip link set lo down", shell=True, check=True)
wait_for("down")
assert "bring the network interface up" in port.problem, port.problem
subprocess.run(UP, shell=True, check=True)
wait_for("active")
assert port.problem == ""
port.close()
"""


def test_udp_multicast_without_its_network_interface_is_down(network: list[str]) -> None:
    own = [*network, "unshare", "--net", sys.executable, "-c", UDP_DOWN]
    done = subprocess.run(own, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
