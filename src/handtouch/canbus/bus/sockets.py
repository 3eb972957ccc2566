"""Receivers that read a bus's socket without python-can's `recv`: SocketCAN and udp_multicast.

Public names: `SocketcanReceiver`, `DatagramReceiver`.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import time
from typing import Any, Self

import can
from can.interfaces.udp_multicast.utils import unpack_message

from handtouch.canbus.bus.bus_state import BusFault, fault_from_exception
from handtouch.canbus.bus.frame_reader import (
    BATCH_FRAMES,
    CAN_FRAME,
    FrameReader,
    PacketReader,
    RawFrame,
    enable_stamps,
)
from handtouch.canbus.bus.receivers import (
    MAX_DRAIN_FRAMES,
    CyclicSender,
    Opener,
    ReopenBackoff,
    clock_offset_ns,
    closed_bus_fault,
    grow_receive_buffer,
    make_message,
    must_reopen,
)
from handtouch.canbus.bus.router import IDENTIFIER_COUNT, CanFrame, Router
from handtouch.core.stages.receive import frame_arrival_ns

_SO_MEMINFO = 55
_MEMINFO_DROPS_INDEX = 8  # index among 32-bit words
_DROPPED_PERIOD_NS = 50_000_000
_DROPPED_FRAMES = 32
"""Dropped frames are counted that often, and whenever so many were waiting: only a full queue drops any."""
_REMOTE_FLAG, _ERROR_FLAG, _IDENTIFIER_MASK = 0x40000000, 0x20000000, 0x1FFFFFFF


class _SocketReceiver:
    """A bus whose socket is read in the caller's thread, behind an epoll with a constant descriptor."""

    def __init__(self, opener: Opener, reader: FrameReader) -> None:
        self.fault: BusFault | None = None
        self.backlog_ns: int | None = None
        self._opener, self._reader = opener, reader
        self._epoll: select.epoll | None = None
        self._backoff = ReopenBackoff()
        self._consecutive_errors = 0
        self._newest_ns = self._failure_ns = 0  # arrival of the newest frame, and the last failure
        self._bus: can.BusABC | None = None
        self._dropped = 0
        self._dropped_checked_ns = 0
        self._emptied_ns = 0  # begin of the last `drain` that emptied the queue

    def open(self) -> Self:
        """Open the bus and the epoll."""
        self._epoll = select.epoll()
        try:
            self._attach_bus(self._opener())
        except BaseException:
            self._epoll.close()
            raise
        return self

    def fileno(self) -> int:
        return -1 if self._epoll is None else self._epoll.fileno()

    def close(self) -> None:
        self._close_bus()
        if self._epoll is not None:
            self._epoll.close()

    def drain(self, router: Router) -> list[CanFrame]:
        others: list[CanFrame] = []
        self.backlog_ns = None
        bus = self._bus or self._reopen(router)
        if bus is None:
            return others
        before = router.counters.frames
        try:
            self._receive(bus, router, others)
            waited_ns = self._emptied_ns - self._dropped_checked_ns
            if waited_ns > _DROPPED_PERIOD_NS or router.counters.frames - before >= _DROPPED_FRAMES:
                self._count_dropped(router)
            failure = None
        except Exception as error:  # noqa: BLE001 - drivers raise anything on bad input; it is counted here
            failure = error
        # frames that were waiting at a failure don't show that the bus works again
        if router.counters.frames > before and self._newest_ns > self._failure_ns:
            self.fault = None
            self._consecutive_errors = 0
            self._backoff.reset()
        if failure is not None:
            self._fail(router, failure)
        return others

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        if self._bus is None:
            raise OSError(errno.ENODEV, self.fault.text if self.fault else "closed")
        self._send(self._bus, can_id, data, remote)

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:  # noqa: ARG002
        return None

    def _receive(self, bus: can.BusABC, router: Router, others: list[CanFrame]) -> None:
        reader, descriptor = self._reader, self._socket.fileno()
        offset_ns, read = clock_offset_ns(), 0
        while bus is self._bus:  # a failure may close it
            before_ns = time.monotonic_ns()
            count = reader.receive(descriptor, offset_ns, self._emptied_ns)
            self._accept_batch(router, count, others)
            if count:
                self._newest_ns = frame_arrival_ns(reader.batch, count - 1)
            if count < BATCH_FRAMES:
                self._emptied_ns = before_ns
                return
            read += count
            if read >= MAX_DRAIN_FRAMES:
                self.backlog_ns = self._newest_ns
                return

    def _accept_batch(self, router: Router, count: int, others: list[CanFrame]) -> None:
        """Accept the first frames of the reader's batch."""
        _accept_frames(self._reader, router, 0, count, others)

    def _send(self, bus: can.BusABC, can_id: int, data: bytes, remote: bool) -> None:
        bus.send(make_message(can_id, data, remote))

    def _attach_bus(self, bus: can.BusABC) -> None:
        self._bus, self._emptied_ns = bus, time.monotonic_ns()
        self._socket = socket.socket(fileno=os.dup(bus.fileno()))  # udp_multicast doesn't expose its socket
        self._dropped = _dropped_frames(self._socket)
        grow_receive_buffer(self._socket)
        if self._epoll is not None:
            self._epoll.register(self._socket, select.EPOLLIN)

    def _close_bus(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        if self._epoll is not None:
            self._epoll.unregister(self._socket)
        self._socket.close()
        try:
            bus.shutdown()
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            self.fault = fault_from_exception(error)

    def _fail(self, router: Router, error: Exception) -> None:
        self._failure_ns = time.monotonic_ns()
        router.counters.receive_failures += 1
        self.fault = fault_from_exception(error)
        self._consecutive_errors += 1
        if must_reopen(error, self._consecutive_errors):
            self._close_bus()
            self.fault = closed_bus_fault(error)

    def _reopen(self, router: Router) -> can.BusABC | None:
        if not self._backoff.due(time.monotonic_ns()):
            return None
        try:
            self._attach_bus(self._opener())
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            router.counters.receive_failures += 1
            self.fault = closed_bus_fault(error)
            return None
        self._consecutive_errors = 0
        self.fault = None
        return self._bus

    def _count_dropped(self, router: Router) -> None:
        """Count the frames that the kernel has dropped for this socket since the last call."""
        self._dropped_checked_ns = self._emptied_ns
        total = _dropped_frames(self._socket)
        if total != self._dropped:
            router.counters.overflow += total - self._dropped & 0xFFFFFFFF
            self._dropped = total


class SocketcanReceiver(_SocketReceiver):
    """Receiver for SocketCAN: batches of frames with kernel receive stamps, samples straight to the slab."""

    def __init__(self, opener: Opener, channel: str) -> None:
        self._channel = channel
        super().__init__(opener, FrameReader())

    def _reopen(self, router: Router) -> can.BusABC | None:
        # To open an unknown name, the kernel searches for a module to load, which takes milliseconds.
        if all(name != self._channel for _, name in socket.if_nameindex()):
            return None
        return super()._reopen(router)

    def _attach_bus(self, bus: can.BusABC) -> None:
        super()._attach_bus(bus)
        enable_stamps(self._socket)

    def _send(self, bus: can.BusABC, can_id: int, data: bytes, remote: bool) -> None:  # noqa: ARG002
        frame = CAN_FRAME.pack(can_id | _REMOTE_FLAG if remote else can_id, len(data), data)
        self._socket.send(frame, socket.MSG_DONTWAIT)

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:
        if self._bus is None:
            raise OSError(errno.ENODEV, self.fault.text if self.fault else "closed")
        # Not stored: with the task of a removed device python-can's shutdown would fail and close nothing.
        return _KernelSender(self._bus.send_periodic(make_message(can_id, data), period_s, store_task=False))


def _accept_frames(reader: FrameReader, router: Router, first: int, end: int, others: list[CanFrame]) -> None:
    """Pass frames `first` to `end` of a batch to the router."""
    first = router.accept_samples(reader.batch, first, end)
    while first < end:
        _accept_other(router, reader.frame(first), others)
        first = router.accept_samples(reader.batch, first + 1, end)


def _accept_other(router: Router, frame: RawFrame, others: list[CanFrame]) -> None:
    """Count a frame that is no plain sample; append it to `others` if it is a data frame without a route."""
    can_id = frame.can_id
    if frame.datagram_bytes != CAN_FRAME.size or frame.size > 8:
        router.counters.unknown_frames += 1  # CAN FD
    elif can_id & _ERROR_FLAG:
        router.handle_error_frame(can_id & _IDENTIFIER_MASK, frame.data, frame.arrival_ns)
    elif can_id & ~_REMOTE_FLAG >= IDENTIFIER_COUNT:
        router.counters.unknown_frames += 1  # extended
    elif can_id & _REMOTE_FLAG:
        router.handle_remote_frame(can_id & ~_REMOTE_FLAG)
    else:
        data = frame.data[: frame.size]
        if not router.accept_frame(can_id, data, frame.arrival_ns):
            others.append((can_id, data, frame.arrival_ns))


class _KernelSender:
    """Task of the kernel's broadcast manager; ends with the process at the latest."""

    def __init__(self, task: Any) -> None:
        self._task = task

    def set_period(self, period_s: float) -> None:
        self._task.period = period_s
        self._task.start()  # updates the existing task

    def stop(self) -> None:
        self._task.stop()


class DatagramReceiver(_SocketReceiver):
    """Receiver for udp_multicast, in batches; python-can's `recv` calls select and checks every key for each
    frame."""

    _reader: PacketReader

    def __init__(self, opener: Opener) -> None:
        super().__init__(opener, PacketReader())

    def _accept_batch(self, router: Router, count: int, others: list[CanFrame]) -> None:
        first = 0
        while first < count:
            end = self._reader.unpack(first, count)
            _accept_frames(self._reader, router, first, end, others)
            if end < count:
                self._accept_packet(router, *self._reader.packet(end), others)
            first = end + 1

    def _accept_packet(self, router: Router, packet: bytes, arrival_ns: int, others: list[CanFrame]) -> None:
        """Accept a packet that isn't packed as plain data frames are; count what python-can can't unpack."""
        try:
            message = unpack_message(packet, check=True)
        except Exception as error:  # noqa: BLE001 - msgpack and python-can raise anything on bad input
            self._fail(router, error)
            return
        frame = router.accept_message(message, arrival_ns)
        if frame is not None:
            others.append(frame)


def _dropped_frames(target: socket.socket) -> int:
    """Return the number of frames lost to a full receive queue of the socket; 0 before Linux 4.12."""
    try:
        words = target.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS_INDEX + 1))
    except OSError:
        return 0
    return int.from_bytes(words[4 * _MEMINFO_DROPS_INDEX :], "little")
