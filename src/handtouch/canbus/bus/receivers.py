"""Non-blocking reception from a CAN bus: the `Receiver` protocol, and receivers with a queue.

A receiver has a file descriptor, which is readable while frames are waiting and stays the same when the bus
is reopened, and `drain`, which passes the waiting frames to a router. Receiving never raises for bus errors:
they are counted and reported in `fault`, and the bus is reopened with growing delays. `sockets` has two more
receivers.

Public names: `Receiver`, `CyclicSender`, `QueuedReceiver`, `ThreadReceiver`, `InProcessReceiver`,
`ReopenBackoff`, `RECEIVE_BUFFER_BYTES`, `MAX_DRAIN_FRAMES`, `MAX_QUEUE_FRAMES`.
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
from typing import Protocol, Self

import can
from can.interfaces import virtual

from handtouch.canbus.bus.bus_state import (
    BusFault,
    ErrorState,
    errno_from_exception,
    fault_from_exception,
)
from handtouch.canbus.bus.router import CanFrame, Router

RECEIVE_BUFFER_BYTES = 4 << 20
"""Requested receive buffer of a socket. The kernel doubles it and accounts 768 bytes per frame: 10,900 frames
or 1.3 s of a fully loaded 1 Mbit/s bus. After a longer pause the newest frames are lost, and counted.
"""
MAX_DRAIN_FRAMES = 4096
"""Most frames read by one `drain`, so that a flood of frames doesn't delay the caller's tick."""
MAX_QUEUE_FRAMES = 16384
"""Most frames waiting for `drain`, 1.9 s of a fully loaded bus; older ones are dropped and counted."""

_INTERFACES_REPORTING_STATE = frozenset({"ixxat", "etas"})
"""Interfaces whose python-can `state` is the controller's; elsewhere it is the last value set."""
_SEND_TIMEOUT_S = 0.01  # an adapter that hangs must not delay the other buses longer than this
_MIN_RETRY_S, _MAX_RETRY_S = 0.1, 2.0
_MAX_CONSECUTIVE_ERRORS = 20
"""Reopening loses the waiting frames; a few bad datagrams or lines don't justify it."""
_SO_RCVBUFFORCE = 33
_DISCONNECTED_ERRNOS = frozenset({errno.ENODEV, errno.ENXIO, errno.EBADF})  # the socket is unusable
_MAX_STAMP_AGE_NS = 1_000_000_000  # of a frame; an older stamp is of another clock
_MAX_CLOCK_READ_NS = 5_000

# Unlike os.eventfd_write these keep the GIL, so no other thread runs in the middle of a burst.
_LIBC = ctypes.PyDLL(None)
_eventfd_write = _LIBC.eventfd_write
_eventfd_write.argtypes = [ctypes.c_int, ctypes.c_uint64]
_eventfd_read = _LIBC.eventfd_read
_eventfd_read.argtypes = [ctypes.c_int, ctypes.POINTER(ctypes.c_uint64)]

Opener = Callable[[], can.BusABC]


class CyclicSender(Protocol):
    """Cyclic transmission of a frame by the kernel."""

    def set_period(self, period_s: float) -> None:
        """Send the frame now, and with this period from now on. Raises CanError or OSError."""
        ...

    def stop(self) -> None:
        """Stop sending. Raises CanError or OSError."""
        ...


class Receiver(Protocol):
    """Interface of an open receiver to its port."""

    fault: BusFault | None  # present fault of the bus, if any
    backlog_ns: int | None  # arrival of the last frame that `drain` read if more are waiting, else None

    def fileno(self) -> int:
        """Return a descriptor that is readable while frames are waiting."""
        ...

    def drain(self, router: Router) -> list[CanFrame]:
        """Pass the waiting frames to the router; return those that it doesn't store or drop."""
        ...

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame. Raises the driver's exceptions."""
        ...

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:
        """Have the kernel send a frame cyclically; None where it can't. Raises CanError or OSError."""
        ...

    def close(self) -> None:
        """Close the bus."""
        ...


class ReopenBackoff:
    """Growing delays between attempts to reopen a bus."""

    def __init__(self) -> None:
        self._retry_s = _MIN_RETRY_S
        self._due_ns = 0

    def due(self, now_ns: int) -> bool:
        """Return True if an attempt is due now; the next delay is then longer."""
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + int(self._retry_s * 1e9)
        self._retry_s = min(2 * self._retry_s, _MAX_RETRY_S)
        return True

    def reset(self) -> None:
        """Return to the shortest delay after a success."""
        self._retry_s = _MIN_RETRY_S
        self._due_ns = 0


def clock_offset_ns() -> int:
    """Return monotonic minus wall clock; read again if the process was interrupted between the readings."""
    for _ in range(3):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < _MAX_CLOCK_READ_NS:
            break
    return (before + after) // 2 - wall


def arrival_ns(frame: can.Message, now_ns: int) -> int:
    """Return a frame's kernel stamp on the monotonic clock; `now_ns` without one, or if it is of another."""
    stamp_ns = round(frame.timestamp * 1e9) + clock_offset_ns()
    return stamp_ns if 0 <= now_ns - stamp_ns <= _MAX_STAMP_AGE_NS else now_ns


class QueuedReceiver:
    """Receiver whose bounded queue is filled by other threads; the first frame signals an eventfd."""

    def __init__(self, opener: Opener) -> None:
        self.fault: BusFault | None = None
        self.backlog_ns: int | None = None
        self._opener = opener
        self._queue: deque[tuple[can.Message, int]] = deque(maxlen=MAX_QUEUE_FRAMES)  # with arrival_ns
        self._lost = 0
        self._errors = 0
        self._reported_counts = (0, 0)
        self._bus: can.BusABC | None = None
        self._eventfd = -1
        self._signalled = False
        self._read_value = ctypes.c_uint64()
        self._signal_pending = False  # a signal whose flag has been cleared already

    def open(self) -> Self:
        """Open the bus and the eventfd."""
        self._bus = self._opener()
        self._eventfd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        return self

    def fileno(self) -> int:
        return self._eventfd

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        bus = self._bus
        if bus is None:
            raise OSError(errno.ENODEV, self.fault.text if self.fault else "closed")
        bus.send(make_message(can_id, data, remote), _SEND_TIMEOUT_S)

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:  # noqa: ARG002
        return None  # python-can would send from a thread of its own, with more jitter than the loop

    def drain(self, router: Router) -> list[CanFrame]:
        others: list[CanFrame] = []
        self._lower_signal()
        popleft, accept = self._queue.popleft, router.accept_message
        count = min(len(self._queue), MAX_DRAIN_FRAMES)
        self.backlog_ns = None
        for _ in range(count):
            message, arrival_ns = popleft()
            frame = accept(message, arrival_ns)
            if frame is not None:
                others.append(frame)
        if count == MAX_DRAIN_FRAMES:
            self.backlog_ns = arrival_ns
            self._raise_signal()
        lost, errors = self._lost, self._errors
        router.counters.overflow += lost - self._reported_counts[0]
        router.counters.receive_failures += errors - self._reported_counts[1]
        self._reported_counts = (lost, errors)
        return others

    def _lower_signal(self) -> None:
        # Before the queue is read: a frame that arrives meanwhile is either read or raises the signal again.
        if self._signalled or self._signal_pending:
            # fails where another thread has set the flag but not yet written
            self._signal_pending = _eventfd_read(self._eventfd, ctypes.byref(self._read_value)) != 0
            self._signalled = False

    def _raise_signal(self) -> None:
        if not self._signalled:
            self._signalled = True
            _eventfd_write(self._eventfd, 1)

    def _enqueue(self, message: can.Message) -> None:
        queue = self._queue
        if len(queue) == queue.maxlen:
            self._lost += 1
        queue.append((message, monotonic_ns()))  # the message's own stamp may be of the adapter's clock
        if not self._signalled:
            self._raise_signal()


class ThreadReceiver(QueuedReceiver):
    """Receiver for any python-can bus: a thread waits in `recv`."""

    def __init__(self, opener: Opener, interface: str) -> None:
        super().__init__(opener)
        self._reports_state = interface in _INTERFACES_REPORTING_STATE
        self._closing = threading.Event()
        self._running = False  # as `_closing`, but cheaper to read
        self._thread = threading.Thread(target=self._receive_loop, name=f"can-{interface}", daemon=True)

    def open(self) -> Self:
        """Open the bus and start the thread."""
        super().open()
        self._running = True
        self._thread.start()
        return self

    def close(self) -> None:
        self._running = False
        self._closing.set()
        self._thread.join(timeout=5)
        if self._bus is not None:
            self._close_bus(self._bus)
        os.close(self._eventfd)

    def _receive_loop(self) -> None:
        backoff = ReopenBackoff()
        consecutive_errors = 0
        while not self._closing.is_set():
            bus = self._bus
            if bus is None:
                consecutive_errors = 0
                self._reopen(backoff)
                continue
            if self.fault is not None and self.fault.error_state is ErrorState.BUS_OFF:  # found by `send`
                self._close_bus(bus)
                continue
            try:
                received = self._receive(bus)
            except Exception as error:  # noqa: BLE001 - drivers raise anything on bad input; it is counted here
                consecutive_errors += 1
                self._record_fault(fault_from_exception(error))
                _clear_line_buffer(bus)
                if must_reopen(error, consecutive_errors):
                    self._close_bus(bus)
                    self.fault = closed_bus_fault(error)
                continue
            if received:
                consecutive_errors = 0
                backoff.reset()
                self.fault = None

    def _receive(self, bus: can.BusABC) -> bool:
        """Enqueue frames until 0.1 s pass without one, or one arrives during a fault; True if any arrived."""
        recv, enqueue, received = bus.recv, self._enqueue, False
        while self._running:
            message = recv(0.1)
            if message is None:
                if self._reports_state and bus.state is can.BusState.ERROR:
                    raise can.CanOperationError("bus-off")
                break
            enqueue(message)
            received = True
            if self.fault is not None:
                break
        return received

    def _record_fault(self, fault: BusFault) -> None:
        self._errors += 1
        self.fault = fault
        self._raise_signal()  # so that `drain` counts it

    def _close_bus(self, bus: can.BusABC) -> None:
        self._bus = None
        try:
            bus.shutdown()
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            self._record_fault(fault_from_exception(error))

    def _reopen(self, backoff: ReopenBackoff) -> None:
        if not backoff.due(time.monotonic_ns()):
            self._closing.wait(_MIN_RETRY_S / 2)
            return
        try:
            self._bus = self._opener()
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            self._record_fault(closed_bus_fault(error))
        else:
            self.fault = None


class InProcessReceiver(QueuedReceiver):
    """Receiver for python-can's virtual bus; frames are enqueued by the sender's thread."""

    def __init__(self, opener: Opener) -> None:
        super().__init__(opener)
        self._senders_lock = threading.Lock()

    def open(self) -> Self:
        """Open the bus and replace its queue on the channel."""
        super().open()
        bus = self._bus
        if not isinstance(bus, virtual.VirtualBus):
            raise TypeError(f"{bus} is not a virtual bus")
        if bus.queue.maxsize:  # the bus's option rx_queue_size
            self._queue = deque(maxlen=bus.queue.maxsize)
        with virtual.channels_lock:
            bus.channel.remove(bus.queue)
            bus.queue = _Inbox(self._receive)
            bus.channel.append(bus.queue)
        return self

    def close(self) -> None:
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
        with self._senders_lock:  # a sender may be about to signal
            os.close(self._eventfd)

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send as python-can does, without a deep copy per receiver, which costs five times as much."""
        bus = self._bus
        if not isinstance(bus, virtual.VirtualBus):
            raise OSError(errno.ENODEV, "closed")
        for inbox in bus.channel:
            if inbox is not bus.queue or bus.receive_own_messages:
                sent = make_message(can_id, data, remote)
                sent.timestamp, sent.channel, sent.is_rx = time.time(), bus.channel_id, inbox is not bus.queue
                inbox.put(sent, timeout=_SEND_TIMEOUT_S)

    def _receive(self, message: can.Message) -> None:
        with self._senders_lock:
            if self._bus is not None:
                self._enqueue(message)


class _Inbox(Queue[can.Message]):
    """Queue of a virtual channel that passes each message to a function."""

    def __init__(self, deliver: Callable[[can.Message], None]) -> None:
        super().__init__()
        self._deliver = deliver

    def put(self, item: can.Message, block: bool = True, timeout: float | None = None) -> None:  # noqa: ARG002
        self._deliver(item)


def make_message(can_id: int, data: bytes, remote: bool = False) -> can.Message:
    """Return a python-can message; a remote frame requests as many bytes as `data` has."""
    if remote:
        return can.Message(arbitration_id=can_id, dlc=len(data), is_remote_frame=True, is_extended_id=False)
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def _clear_line_buffer(bus: can.BusABC) -> None:
    """Clear slcan's buffer: it keeps a line that isn't text and fails on it with every further line."""
    buffer = getattr(bus, "_buffer", None)
    if isinstance(buffer, bytearray):
        buffer.clear()


def closed_bus_fault(error: Exception) -> BusFault:
    """Return the fault of a bus that was closed after this error, until it is reopened."""
    fault = fault_from_exception(error)
    return fault if fault.error_state is ErrorState.BUS_OFF else BusFault(ErrorState.DOWN, fault.text)


def must_reopen(error: Exception, consecutive_errors: int) -> bool:
    """Return True if a bus must be reopened after so many consecutive errors, `error` being the last."""
    code = errno_from_exception(error)
    if code == errno.ENETDOWN:  # the same socket works again when the interface is up
        return False
    is_off = fault_from_exception(error).error_state is ErrorState.BUS_OFF
    return is_off or code in _DISCONNECTED_ERRNOS or consecutive_errors >= _MAX_CONSECUTIVE_ERRORS


def grow_receive_buffer(target: socket.socket) -> int:
    """Request RECEIVE_BUFFER_BYTES, past the system's limit if permitted; return the bytes granted."""
    try:
        target.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
    except PermissionError:  # needs CAP_NET_ADMIN
        target.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    return target.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
