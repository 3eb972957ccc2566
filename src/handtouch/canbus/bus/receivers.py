"""Reading a CAN bus without blocking: what a receiver is; one for any python-can bus, one for in-process.

A receiver has a file descriptor that becomes readable when frames wait and stays the same when the bus is
opened anew, and `drain`, which hands all that waits to a router. None ever raises for what the bus does:
errors are counted, told in `trouble`, and the bus is opened again with growing pauses. Two more: `sockets`.

Public names: `Receiver`, `CyclicSender`, `QueuedReceiver`, `ThreadReceiver`, `InProcessReceiver`, `Retry`,
`RECEIVE_BUFFER_BYTES`, `DRAIN_LIMIT`, `QUEUE_FRAMES`.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from queue import Queue
from time import monotonic_ns
from typing import Protocol

import can
from can.interfaces import virtual

from .bus_state import Condition, Trouble, code_of, trouble_of
from .router import Frame, Router

RECEIVE_BUFFER_BYTES = 4 << 20
"""Socket receive buffer asked for; the kernel doubles it and books 768 bytes a frame: 10,900 frames, 1.3 s of
a full 1 Mbit/s bus. After a pause of that length every heartbeat is overdue: nothing longer need be bridged.
"""
DRAIN_LIMIT = 4096
"""Frames read in one go at most, so that a flood can't keep the caller from its tick."""
QUEUE_FRAMES = 16384
"""Frames that wait for `drain` at most, 1.9 s of a full bus; older ones are dropped and counted."""

_TELLS_STATE = frozenset({"ixxat", "etas"})  # elsewhere python-can's `state` is what was asked for
_SEND_TIMEOUT_S = 0.01  # an adapter that hangs must not hold up the other buses for longer
_RETRY_FIRST_S, _RETRY_LAST_S = 0.1, 2.0
_ERRORS_TO_REOPEN = 20  # in a row; a few bad datagrams or serial lines are no reason to lose what waits
_SO_RCVBUFFORCE = 33
_GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.EBADF})  # the socket is of no more use
_OLDEST_STAMP_NS = 10_000_000_000
_OFFSET_NS = 5_000

# Unlike os.eventfd_write these keep the GIL: no other thread is let in amid a burst.
_LIBC = ctypes.PyDLL(None)
_eventfd_write = _LIBC.eventfd_write
_eventfd_write.argtypes = [ctypes.c_int, ctypes.c_uint64]
_eventfd_read = _LIBC.eventfd_read
_eventfd_read.argtypes = [ctypes.c_int, ctypes.POINTER(ctypes.c_uint64)]

Opener = Callable[[], can.BusABC]


class CyclicSender(Protocol):
    """A frame that somebody else, such as the kernel, sends again and again."""

    def set_period(self, period_s: float) -> None:
        """Send it now, and with this period from now on. Raises CanError or OSError."""
        ...

    def stop(self) -> None:
        """Raises CanError or OSError."""
        ...


class Receiver(Protocol):
    """What a port needs of a receiver."""

    trouble: Trouble | None  # what is wrong with the bus now, if anything

    def fileno(self) -> int: ...

    def drain(self, router: Router) -> list[Frame]: ...

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Raises whatever the driver raises."""
        ...

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:
        """None where nobody but us could do it. Raises CanError or OSError."""
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


def within(t_ns: int, now_ns: int) -> int:
    """A stamp made monotonic; `now_ns` where it can't be one of the last seconds."""
    return t_ns if now_ns - _OLDEST_STAMP_NS < t_ns <= now_ns else now_ns


def clock_offset_ns() -> int:
    """Monotonic minus wall clock; taken again where something came between the readings."""
    for _ in range(3):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < _OFFSET_NS:
            break
    return (before + after) // 2 - wall


class QueuedReceiver:
    """Frames wait in a bounded queue that other threads fill; the first of a burst signals an eventfd."""

    def __init__(self, opener: Opener) -> None:
        self._queue: deque[tuple[can.Message, int]] = deque(maxlen=QUEUE_FRAMES)  # with their arrival
        self._lost = 0
        self._errors = 0
        self._counted = (0, 0)
        self.trouble: Trouble | None = None
        self._bus: can.BusABC | None = opener()
        self._eventfd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._signalled = False
        self._read_value = ctypes.c_uint64()
        self._owed = False  # a signal whose flag has been lowered already

    def fileno(self) -> int:
        return self._eventfd

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        bus = self._bus
        if bus is None:
            raise OSError(errno.ENODEV, self.trouble.text if self.trouble else "closed")
        bus.send(message(can_id, data, remote), _SEND_TIMEOUT_S)

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:  # noqa: ARG002
        return None  # python-can would do it in a thread of its own, which is worse than our loop

    def drain(self, router: Router) -> list[Frame]:
        others: list[Frame] = []
        self._lower_signal()
        popleft, accept = self._queue.popleft, router.accept_message
        count = min(len(self._queue), DRAIN_LIMIT)
        for _ in range(count):
            frame = accept(*popleft())
            if frame is not None:
                others.append(frame)
        if count == DRAIN_LIMIT:
            self._raise_signal()
        lost, errors = self._lost, self._errors
        router.counters.overflow += lost - self._counted[0]
        router.counters.receive_failures += errors - self._counted[1]
        self._counted = (lost, errors)
        return others

    def _lower_signal(self) -> None:
        # Before the queue is read: what comes meanwhile is either read there or raises the signal again.
        if self._signalled or self._owed:
            # it fails where the reader is just about to raise it
            self._owed = _eventfd_read(self._eventfd, ctypes.byref(self._read_value)) != 0
            self._signalled = False

    def _raise_signal(self) -> None:
        if not self._signalled:
            self._signalled = True
            _eventfd_write(self._eventfd, 1)

    def _put(self, message: can.Message) -> None:
        queue = self._queue
        if len(queue) == queue.maxlen:
            self._lost += 1
        queue.append((message, monotonic_ns()))  # its own stamp may be of the adapter's clock
        if not self._signalled:
            self._raise_signal()


class ThreadReceiver(QueuedReceiver):
    """Any python-can bus: a thread waits in its `recv`."""

    def __init__(self, opener: Opener, interface: str) -> None:
        super().__init__(opener)
        self._opener = opener
        self._tells_state = interface in _TELLS_STATE
        self._closing = threading.Event()
        self._open = True  # the same, cheaper to look at
        self._thread = threading.Thread(target=self._run, name=f"can-{interface}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._open = False
        self._closing.set()
        self._thread.join(timeout=5)
        if self._bus is not None:
            self._drop(self._bus)
        os.close(self._eventfd)

    def _run(self) -> None:
        retry = Retry()
        in_a_row = 0
        while not self._closing.is_set():
            bus = self._bus
            if bus is None:
                in_a_row = 0
                self._reopen(retry)
                continue
            if self.trouble is not None and self.trouble.condition is Condition.BUS_OFF:  # told by `send`
                self._drop(bus)
                continue
            try:
                came = self._read(bus)
            except Exception as error:  # noqa: BLE001 - drivers raise anything on bad input; here it is counted
                in_a_row += 1
                self._failed(trouble_of(error))
                _forget_line(bus)
                if is_hopeless(error, in_a_row):
                    self._drop(bus)
                    self.trouble = given_up(error)
                continue
            if came:
                in_a_row = 0
                retry.reset()
                self.trouble = None

    def _read(self, bus: can.BusABC) -> bool:
        """Take frames until none come for a while, or one has although there is trouble. Whether one came."""
        recv, put, came = bus.recv, self._put, False
        while self._open:
            message = recv(0.1)
            if message is None:
                if self._tells_state and bus.state is can.BusState.ERROR:
                    raise can.CanOperationError("bus-off")
                break
            put(message)
            came = True
            if self.trouble is not None:
                break
        return came

    def _failed(self, trouble: Trouble) -> None:
        self._errors += 1
        self.trouble = trouble
        self._raise_signal()  # so that the count is taken

    def _drop(self, bus: can.BusABC) -> None:
        self._bus = None
        try:
            bus.shutdown()
        except Exception as error:  # noqa: BLE001 - as above
            self._failed(trouble_of(error))

    def _reopen(self, retry: Retry) -> None:
        if not retry.due(time.monotonic_ns()):
            self._closing.wait(_RETRY_FIRST_S / 2)
            return
        try:
            self._bus = self._opener()
        except Exception as error:  # noqa: BLE001 - as above
            self._failed(given_up(error))
        else:
            self.trouble = None


class InProcessReceiver(QueuedReceiver):
    """python-can's virtual bus: who sends a frame puts it into our queue; there is no thread."""

    def __init__(self, opener: Opener) -> None:
        super().__init__(opener)
        bus = self._bus
        if not isinstance(bus, virtual.VirtualBus):
            raise TypeError(f"{bus} is no virtual bus")
        if bus.queue.maxsize:  # the bus's option rx_queue_size
            self._queue = deque(maxlen=bus.queue.maxsize)
        self._several = threading.Lock()  # senders at once
        with virtual.channels_lock:
            bus.channel.remove(bus.queue)
            bus.queue = _Inbox(self._take)
            bus.channel.append(bus.queue)

    def close(self) -> None:
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
        with self._several:  # a sender may be about to signal
            os.close(self._eventfd)

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """As python-can does it, but without a deep copy for everyone, which costs five times as much."""
        bus = self._bus
        if not isinstance(bus, virtual.VirtualBus):
            raise OSError(errno.ENODEV, "closed")
        for inbox in bus.channel:
            if inbox is not bus.queue or bus.receive_own_messages:
                sent = message(can_id, data, remote)
                sent.timestamp, sent.channel, sent.is_rx = time.time(), bus.channel_id, inbox is not bus.queue
                inbox.put(sent, timeout=_SEND_TIMEOUT_S)

    def _take(self, message: can.Message) -> None:
        with self._several:
            if self._bus is not None:
                self._put(message)


class _Inbox(Queue[can.Message]):
    """A queue of a virtual channel that hands on what is put to it."""

    def __init__(self, take: Callable[[can.Message], None]) -> None:
        super().__init__()
        self._take = take

    def put(self, item: can.Message, block: bool = True, timeout: float | None = None) -> None:  # noqa: ARG002
        self._take(item)


def message(can_id: int, data: bytes, remote: bool = False) -> can.Message:
    """python-can's message; a remote frame asks for as many bytes as `data` has."""
    if remote:
        return can.Message(arbitration_id=can_id, dlc=len(data), is_remote_frame=True, is_extended_id=False)
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def _forget_line(bus: can.BusABC) -> None:
    """slcan keeps a line that is no text, and fails on it again with every line to come."""
    buffer = getattr(bus, "_buffer", None)
    if isinstance(buffer, bytearray):
        buffer.clear()


def given_up(error: Exception) -> Trouble:
    """What to tell of a bus that has been given up with this error, until it is open again."""
    told = trouble_of(error)
    return told if told.condition is Condition.BUS_OFF else Trouble(Condition.DOWN, told.text)


def is_hopeless(error: Exception, in_a_row: int) -> bool:
    """Whether a bus that has failed so many times in a row, last with this, has to be opened again."""
    if code_of(error) == errno.ENETDOWN:  # the same socket works again when the interface is up
        return False
    off = trouble_of(error).condition is Condition.BUS_OFF
    return off or code_of(error) in _GONE or in_a_row >= _ERRORS_TO_REOPEN


def grow_receive_buffer(target: socket.socket) -> int:
    """Ask for RECEIVE_BUFFER_BYTES on a socket, past the system's limit where allowed; bytes granted."""
    try:
        target.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
    except PermissionError:  # needs CAP_NET_ADMIN
        target.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    return target.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
