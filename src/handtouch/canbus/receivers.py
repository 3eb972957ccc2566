"""Three ways to read a CAN bus without blocking: SocketCAN's socket, a bus that can be polled, any other.

Each has a file descriptor that becomes readable when frames wait and stays the same when the bus is opened
anew, and `drain`, which hands all that waits to a router. None of them ever raises for what the bus does:
errors are counted, told in `problem`, and the bus is opened again with growing pauses.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

import can

from .router import Frame, Router

RECEIVE_BUFFER_BYTES = 4 << 20
"""Socket receive buffer asked for. The kernel books about 800 bytes a frame: half a second of a full bus."""
DRAIN_LIMIT = 4096
"""Frames read in one go at most, so that a flood can't keep the caller from its tick."""
QUEUE_FRAMES = 16384
"""Frames that a reader thread holds at most; older ones are dropped and counted."""

_WALL_STAMPED = frozenset({"socketcan", "udp_multicast", "virtual"})
_RETRY_FIRST_S, _RETRY_LAST_S = 0.1, 2.0
_ERRORS_TO_REOPEN = 20  # in a row; a few bad datagrams or serial lines are no reason to lose what waits
_SO_TIMESTAMPNS, _SO_RXQ_OVFL, _SO_RCVBUFFORCE = 35, 40, 33
_GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.EBADF})  # the socket is of no more use
_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of <linux/can.h>
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(4)
_EXTENDED_OR_REMOTE, _ERROR_FRAME = 0xC0000000, 0x20000000
_OLDEST_STAMP_NS = 10_000_000_000

Opener = Callable[[], can.BusABC]


class Receiver(Protocol):
    """What a port needs of a receiver."""

    problem: str  # what is wrong with the bus now, empty when nothing is

    def fileno(self) -> int: ...

    def drain(self, router: Router) -> list[Frame]: ...

    def send(self, can_id: int, data: bytes) -> None:
        """Raises CanError or OSError."""
        ...

    def close(self) -> None: ...


class Retry:
    """Growing pauses between attempts to open a bus again."""

    def __init__(self) -> None:
        self._pause_s = _RETRY_FIRST_S
        self._due_ns = 0

    def due(self, t_ns: int) -> bool:
        """Whether to try at this time; if so, the next pause is longer."""
        if t_ns < self._due_ns:
            return False
        self._due_ns = t_ns + int(self._pause_s * 1e9)
        self._pause_s = min(2 * self._pause_s, _RETRY_LAST_S)
        return True

    def reset(self) -> None:
        """It worked."""
        self._pause_s = _RETRY_FIRST_S
        self._due_ns = 0


def monotonic_from_wall(stamp_s: float, now_ns: int, offset_ns: int) -> int:
    """A wall-clock stamp on the monotonic clock; `now_ns` where it can't be a stamp of the last seconds."""
    t_ns = int(stamp_s * 1e9) + offset_ns
    return t_ns if now_ns - _OLDEST_STAMP_NS < t_ns <= now_ns else now_ns


class _SocketReceiver:
    """A bus with a socket, read in the caller's thread; behind an epoll, so its descriptor never changes."""

    def __init__(self, opener: Opener) -> None:
        self._opener = opener
        self._epoll = select.epoll()
        self._retry = Retry()
        self._errors = 0
        self._bus: can.BusABC | None = None
        self.problem = ""
        try:
            self._use(opener())
        except BaseException:
            self._epoll.close()
            raise

    def fileno(self) -> int:
        return self._epoll.fileno()

    def close(self) -> None:
        self._drop()
        self._epoll.close()

    def drain(self, router: Router) -> list[Frame]:
        others: list[Frame] = []
        bus = self._bus or self._reopen(router)
        if bus is None:
            return others
        before = router.counters.frames
        try:
            self._read(bus, router, others)
            failure = None
        except Exception as error:  # noqa: BLE001 - drivers raise anything on bad input; here it is counted
            failure = error
        if self.problem and router.counters.frames > before:
            self.problem = ""
            self._errors = 0
        if failure is not None:
            self._failed(router, failure)
        return others

    def send(self, can_id: int, data: bytes) -> None:
        if self._bus is None:
            raise OSError(errno.ENODEV, self.problem)
        self._send(self._bus, can_id, data)

    def _read(self, bus: can.BusABC, router: Router, others: list[Frame]) -> None:
        raise NotImplementedError

    def _send(self, bus: can.BusABC, can_id: int, data: bytes) -> None:
        bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def _use(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._epoll.register(bus.fileno(), select.EPOLLIN)

    def _drop(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        try:
            bus.shutdown()  # closing the socket takes it out of the epoll
        except Exception as error:  # noqa: BLE001 - as above
            self.problem = str(error) or type(error).__name__

    def _failed(self, router: Router, error: Exception) -> None:
        router.counters.receive_errors += 1
        self.problem = str(error) or type(error).__name__
        self._errors += 1
        if _is_hopeless(error, self._errors):
            self._drop()

    def _reopen(self, router: Router) -> can.BusABC | None:
        if not self._retry.due(time.monotonic_ns()):
            return None
        try:
            self._use(self._opener())
        except Exception as error:  # noqa: BLE001 - as above
            router.counters.receive_errors += 1
            self.problem = str(error) or type(error).__name__
            return None
        self._errors = 0
        self.problem = ""
        self._retry.reset()
        return self._bus


class SocketcanReceiver(_SocketReceiver):
    """SocketCAN by its socket: kernel stamps and drop counts, a third of the cost of python-can's `recv`."""

    def _use(self, bus: can.BusABC) -> None:
        self._socket: socket.socket = bus.socket  # type: ignore[attr-defined]  # SocketcanBus has it; BusABC not
        grow_receive_buffer(self._socket)
        self._dropped = 0
        super()._use(bus)

    def _read(self, bus: can.BusABC, router: Router, others: list[Frame]) -> None:  # noqa: ARG002
        recvmsg, unpack, accept = self._socket.recvmsg, _FRAME.unpack_from, router.accept
        stamp = _TIMESPEC.unpack_from
        offset_ns = time.monotonic_ns() - time.time_ns()
        for _ in range(DRAIN_LIMIT):
            try:
                frame, ancillary, _, _ = recvmsg(16, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            t_ns = 0
            for _, kind, value in ancillary:
                if kind == _SO_TIMESTAMPNS:
                    seconds, nanoseconds = stamp(value)
                    t_ns = seconds * 1_000_000_000 + nanoseconds + offset_ns
                elif kind == _SO_RXQ_OVFL:
                    self._count_dropped(router, int.from_bytes(value[:4], "little"))
            can_id, size, data = unpack(frame)
            if can_id >= 0x800:
                self._count_odd(router, can_id)
                continue
            if size != 8:
                data = data[:size]
            if not accept(can_id, data, t_ns):
                others.append((can_id, data, t_ns))

    def _send(self, bus: can.BusABC, can_id: int, data: bytes) -> None:  # noqa: ARG002
        self._socket.send(_FRAME.pack(can_id, len(data), data), socket.MSG_DONTWAIT)

    def _count_dropped(self, router: Router, total: int) -> None:
        """The kernel tells how many frames this socket has lost since it was opened."""
        router.counters.overflow += total - self._dropped & 0xFFFFFFFF
        self._dropped = total

    def _count_odd(self, router: Router, can_id: int) -> None:
        if can_id & _ERROR_FRAME:
            router.counters.errors += 1
        elif can_id & _EXTENDED_OR_REMOTE:
            router.counters.foreign += 1


class PolledReceiver(_SocketReceiver):
    """A bus whose `recv(0)` never blocks and whose descriptor tells when frames wait: udp_multicast."""

    def _use(self, bus: can.BusABC) -> None:
        grow_receive_buffer(bus.fileno())
        super()._use(bus)

    def _read(self, bus: can.BusABC, router: Router, others: list[Frame]) -> None:
        now_ns = time.monotonic_ns()
        offset_ns = now_ns - time.time_ns()
        for _ in range(DRAIN_LIMIT):
            message = bus.recv(0)
            if message is None:
                return
            now_ns = time.monotonic_ns()
            frame = router.accept_message(message, monotonic_from_wall(message.timestamp, now_ns, offset_ns))
            if frame is not None:
                others.append(frame)


class ThreadReceiver:
    """Any python-can bus: a thread waits in its `recv`, fills a bounded queue and signals an eventfd."""

    def __init__(self, opener: Opener, interface: str) -> None:
        self._opener = opener
        self._stamped = interface in _WALL_STAMPED
        self._queue: deque[can.Message] = deque(maxlen=QUEUE_FRAMES)
        self._lost = 0
        self._errors = 0
        self._counted = (0, 0)
        self.problem = ""
        self._bus: can.BusABC | None = opener()
        self._eventfd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._signalled = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"can-{interface}", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        return self._eventfd

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=5)
        if self._bus is not None:
            self._bus.shutdown()
        os.close(self._eventfd)

    def send(self, can_id: int, data: bytes) -> None:
        bus = self._bus
        if bus is None:
            raise OSError(errno.ENODEV, self.problem)
        bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def drain(self, router: Router) -> list[Frame]:
        others: list[Frame] = []
        self._lower_signal()
        popleft, accept = self._queue.popleft, router.accept_message
        count = min(len(self._queue), DRAIN_LIMIT)
        now_ns = time.monotonic_ns()
        offset_ns = now_ns - time.time_ns()
        for _ in range(count):
            message = popleft()
            frame = accept(message, monotonic_from_wall(message.timestamp, now_ns, offset_ns))
            if frame is not None:
                others.append(frame)
        if count == DRAIN_LIMIT:
            self._raise_signal()
        lost, errors = self._lost, self._errors
        router.counters.overflow += lost - self._counted[0]
        router.counters.receive_errors += errors - self._counted[1]
        self._counted = (lost, errors)
        return others

    def _lower_signal(self) -> None:
        # In this order, and before the queue is read: a frame that comes meanwhile is either read below or
        # raises the signal again. The other way round its signal could be taken and never raised any more.
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._eventfd)
        self._signalled = False

    def _raise_signal(self) -> None:
        if not self._signalled:
            self._signalled = True
            os.eventfd_write(self._eventfd, 1)

    def _run(self) -> None:
        retry = Retry()
        in_a_row = 0
        while not self._closing.is_set():
            if self._bus is None:
                self._reopen(retry)
                continue
            try:
                message = self._bus.recv(0.1)
            except Exception as error:  # noqa: BLE001 - drivers raise anything on bad input; here it is counted
                in_a_row += 1
                self._failed(error)
                if _is_hopeless(error, in_a_row):
                    self._drop(self._bus)
                    in_a_row = 0
                continue
            if message is None:
                continue
            self._put(message)
            if self.problem:
                in_a_row = 0
                retry.reset()
                self.problem = ""

    def _put(self, message: can.Message) -> None:
        if not self._stamped:  # its stamps may be of the adapter's own clock
            message.timestamp = time.time()
        if len(self._queue) == QUEUE_FRAMES:
            self._lost += 1
        self._queue.append(message)
        if not self._signalled:
            self._raise_signal()

    def _failed(self, error: Exception) -> None:
        self._errors += 1
        self.problem = str(error) or type(error).__name__
        self._raise_signal()  # so that the count is taken

    def _drop(self, bus: can.BusABC) -> None:
        self._bus = None
        try:
            bus.shutdown()
        except Exception as error:  # noqa: BLE001 - as above
            self._failed(error)

    def _reopen(self, retry: Retry) -> None:
        if not retry.due(time.monotonic_ns()):
            self._closing.wait(_RETRY_FIRST_S / 2)
            return
        try:
            self._bus = self._opener()
        except Exception as error:  # noqa: BLE001 - as above
            self._failed(error)
        else:
            self.problem = ""


def _is_hopeless(error: Exception, in_a_row: int) -> bool:
    """Whether a bus that has failed so many times in a row, last with this, has to be opened again."""
    code = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if code == errno.ENETDOWN:  # the same socket works again when the interface is up
        return False
    return code in _GONE or in_a_row >= _ERRORS_TO_REOPEN


def grow_receive_buffer(target: socket.socket | int) -> int:
    """Ask for RECEIVE_BUFFER_BYTES on a socket (or its descriptor), past the system's limit where allowed.

    Returns what the kernel granted, bytes.
    """
    if isinstance(target, int):
        with socket.socket(fileno=os.dup(target)) as same:
            return grow_receive_buffer(same)
    try:
        target.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
    except PermissionError:  # needs CAP_NET_ADMIN
        target.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    target.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
    return target.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
