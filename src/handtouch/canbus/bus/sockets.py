"""Receivers for buses with a socket, read without python-can's `recv`: SocketCAN and udp_multicast.

Public names: `SocketcanReceiver`, `DatagramReceiver`.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import time
from typing import Any

import can
import msgpack
from can.interfaces.udp_multicast.utils import unpack_message

from .bus_state import Trouble, trouble_of
from .receivers import (
    DRAIN_LIMIT,
    CyclicSender,
    Opener,
    Retry,
    clock_offset_ns,
    given_up,
    grow_receive_buffer,
    is_hopeless,
    message,
    within,
)
from .router import IDENTIFIERS, Frame, Router

_SO_TIMESTAMPNS, _SO_MEMINFO = 35, 55
_MEMINFO_DROPS = 8  # index into SO_MEMINFO's words
_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of <linux/can.h>
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size)
_LONGEST_BYTES = 4096  # of a datagram, as python-can has it
_FLAGS = ("is_extended_id", "is_remote_frame", "is_error_frame", "is_fd")
_REMOTE, _ERROR_FRAME, _IDENTIFIER = 0x40000000, 0x20000000, 0x1FFFFFFF


class _SocketReceiver:
    """A bus with a socket, read in the caller's thread; behind an epoll, so its descriptor never changes."""

    def __init__(self, opener: Opener) -> None:
        self._opener = opener
        self._epoll = select.epoll()
        self._retry = Retry()
        self._errors = 0
        self._bus: can.BusABC | None = None
        self._dropped = 0
        self.trouble: Trouble | None = None
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
            self._count_dropped(router)
            failure = None
        except Exception as error:  # noqa: BLE001 - drivers raise anything on bad input; here it is counted
            failure = error
        if router.counters.frames > before:
            self.trouble = None
            self._errors = 0
            self._retry.reset()
        if failure is not None:
            self._failed(router, failure)
        return others

    def send(self, can_id: int, data: bytes, remote: bool = False) -> None:
        if self._bus is None:
            raise OSError(errno.ENODEV, self.trouble.text if self.trouble else "closed")
        self._send(self._bus, can_id, data, remote)

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:  # noqa: ARG002
        return None

    def _read(self, bus: can.BusABC, router: Router, others: list[Frame]) -> None:
        raise NotImplementedError

    def _send(self, bus: can.BusABC, can_id: int, data: bytes, remote: bool) -> None:
        bus.send(message(can_id, data, remote))

    def _use(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._socket = socket.socket(fileno=os.dup(bus.fileno()))  # python-can has none for udp_multicast
        self._dropped = _drops(self._socket)
        grow_receive_buffer(self._socket)
        self._epoll.register(self._socket, select.EPOLLIN)

    def _drop(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        self._epoll.unregister(self._socket)
        self._socket.close()
        try:
            bus.shutdown()
        except Exception as error:  # noqa: BLE001 - as above
            self.trouble = trouble_of(error)

    def _failed(self, router: Router, error: Exception) -> None:
        router.counters.receive_failures += 1
        self.trouble = trouble_of(error)
        self._errors += 1
        if is_hopeless(error, self._errors):
            self._drop()
            self.trouble = given_up(error)

    def _reopen(self, router: Router) -> can.BusABC | None:
        if not self._retry.due(time.monotonic_ns()):
            return None
        try:
            self._use(self._opener())
        except Exception as error:  # noqa: BLE001 - as above
            router.counters.receive_failures += 1
            self.trouble = given_up(error)
            return None
        self._errors = 0
        self.trouble = None
        return self._bus

    def _count_dropped(self, router: Router) -> None:
        """The kernel tells how many frames this socket has lost since it was opened."""
        total = _drops(self._socket)
        if total != self._dropped:
            router.counters.overflow += total - self._dropped & 0xFFFFFFFF
            self._dropped = total


class SocketcanReceiver(_SocketReceiver):
    """SocketCAN by its socket: kernel stamps, and a third of the cost of python-can's `recv`."""

    def __init__(self, opener: Opener, channel: str) -> None:
        self._channel = channel
        super().__init__(opener)

    def _reopen(self, router: Router) -> can.BusABC | None:
        # Asked by name, the kernel looks for a module to load: milliseconds that the other buses lose.
        if all(name != self._channel for _, name in socket.if_nameindex()):
            return None
        return super()._reopen(router)

    def _read(self, bus: can.BusABC, router: Router, others: list[Frame]) -> None:  # noqa: ARG002
        recvmsg, unpack, accept = self._socket.recvmsg, _FRAME.unpack_from, router.accept
        stamp = _TIMESPEC.unpack_from
        offset_ns = clock_offset_ns()
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
            can_id, size, data = unpack(frame)
            if can_id >= 0x800:
                if can_id & _ERROR_FRAME:
                    router.error(can_id & _IDENTIFIER, data, t_ns)
                elif can_id & ~_REMOTE < 0x800:
                    router.remote(can_id & ~_REMOTE)
                else:
                    router.counters.foreign += 1  # extended
                continue
            if size != 8:
                data = data[:size]
            if not accept(can_id, data, t_ns):
                others.append((can_id, data, t_ns))

    def _send(self, bus: can.BusABC, can_id: int, data: bytes, remote: bool) -> None:  # noqa: ARG002
        frame = _FRAME.pack(can_id | _REMOTE if remote else can_id, len(data), data)
        self._socket.send(frame, socket.MSG_DONTWAIT)

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:
        if self._bus is None:
            raise OSError(errno.ENODEV, self.trouble.text if self.trouble else "closed")
        # Not stored: python-can's shutdown would fail with the task of a gone device, and close nothing.
        return _KernelSender(self._bus.send_periodic(message(can_id, data), period_s, store_task=False))


class _KernelSender:
    """A task of the kernel's broadcast manager; it ends with the process at the latest."""

    def __init__(self, task: Any) -> None:
        self._task = task

    def set_period(self, period_s: float) -> None:
        self._task.period = period_s
        self._task.start()  # changes the task in place: there is never a second one

    def stop(self) -> None:
        self._task.stop()


class DatagramReceiver(_SocketReceiver):
    """udp_multicast by its socket: python-can's `recv` asks select for each frame and checks all of it."""

    def _read(self, bus: can.BusABC, router: Router, others: list[Frame]) -> None:  # noqa: ARG002
        recvmsg, unpack, accept, stamp = (
            self._socket.recvmsg,
            msgpack.unpackb,
            router.accept,
            _TIMESPEC.unpack,
        )
        offset_ns = clock_offset_ns()
        for _ in range(DRAIN_LIMIT):
            try:
                packet, ancillary, _, _ = recvmsg(_LONGEST_BYTES, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            t_ns = now_ns = time.monotonic_ns()
            for _, kind, value in ancillary:
                if kind == _SO_TIMESTAMPNS:
                    seconds, nanoseconds = stamp(value)
                    t_ns = within(seconds * 1_000_000_000 + nanoseconds + offset_ns, now_ns)
            told = unpack(packet)
            if _is_data_frame(told):
                can_id, data = told["arbitration_id"], told["data"]
                if not accept(can_id, data, t_ns):
                    others.append((can_id, data, t_ns))
            elif (frame := router.accept_message(unpack_message(packet, check=True), t_ns)) is not None:
                others.append(frame)


def _is_data_frame(told: Any) -> bool:
    """Whether it is what almost all are; python-can judges the rest, and raises if it is no frame at all."""
    if type(told) is not dict or type(can_id := told.get("arbitration_id")) is not int:
        return False
    if type(data := told.get("data")) is not bytes or told.get("dlc") != len(data):
        return False
    flags = map(told.get, _FLAGS)
    return 0 <= can_id < IDENTIFIERS and len(data) <= 8 and not any(flags)


def _drops(target: socket.socket) -> int:
    """Frames that a socket's receive queue had no room for; 0 where the kernel is too old to tell (4.12)."""
    try:
        words = target.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1))
    except OSError:
        return 0
    return int.from_bytes(words[4 * _MEMINFO_DROPS :], "little")
