"""A CAN bus, opened by python-can's interface name and channel: receive, send, counters, state.

Public names: `Port`, `open_bus`, `BusError`.
"""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable
from typing import Any

import can

from handtouch.canbus.bus.bus_state import (
    BusState,
    ErrorState,
    errno_from_exception,
    fault_from_exception,
    is_queue_full,
)
from handtouch.canbus.bus.load import frame_bits
from handtouch.canbus.bus.receivers import (
    CyclicSender,
    InProcessReceiver,
    QueuedReceiver,
    Receiver,
    ThreadReceiver,
)
from handtouch.canbus.bus.router import BusCounters, CanFrame, Router
from handtouch.canbus.bus.sockets import DatagramReceiver, SocketcanReceiver
from handtouch.config import Bus
from handtouch.config.tables import CABLELESS_INTERFACES
from handtouch.core.slab import Slab
from handtouch.host.machine import Machine, NoRouteError, check_multicast_route

_SEND_ATTEMPTS, _SEND_RETRY_S = 100, 0.002
_ECHOING_INTERFACES = frozenset({"udp_multicast"})
"""Interfaces on which sent frames are received, and counted, again."""
_INTERFACES_WITHOUT_BITRATE = CABLELESS_INTERFACES | {"socketcan"}
"""Interfaces whose bit rate python-can can't set."""


class BusError(OSError):
    """A bus can't be opened; `str` names the bus, its interface and channel, and a remedy."""

    exit_status = 1


class Port:
    """A bus in use. Receive in one thread; `send` may be called from any thread.

    `echoes`: sent frames are received, too.
    `last_sync_ns` : time of the last SYNC sent or received, 0 before the first; `Sync` sets it
    `other_syncs` : SYNCs of other producers than this host; `Sync` counts them once a second
    `received_until_ns` : all frames that arrived before this time have been read by `drain`
    """

    def __init__(self, bus: Bus, receiver: Receiver, slab: Slab) -> None:
        """Use an open receiver; `Port.open` makes one from a bus of the deployment."""
        self.name = bus.name
        self.bus = bus
        self.router = Router(slab, BusState(bus.interface, str(bus.channel)))
        self.echoes = bus.interface in _ECHOING_INTERFACES
        self.last_sync_ns = self.received_until_ns = self.other_syncs = 0
        self._receiver = receiver
        self._send_lock = threading.Lock()
        self._was_bus_off = False

    @classmethod
    def open(cls, bus: Bus, slab: Slab) -> Port:
        """Open a bus whose samples are written to `slab`. Raises BusError if it can't be opened."""

        def opener() -> can.BusABC:
            return open_bus(bus)

        try:
            receiver = _open_receiver(bus, opener)
        except BusError:
            raise
        except Exception as error:  # drivers raise anything; the bus exists, but can't be received from
            raise _open_error(bus, error) from error
        return cls(bus, receiver, slab)

    @property
    def has_local_queue(self) -> bool:
        """True if received frames wait in a queue of this process, so that `drain` makes no system call."""
        return isinstance(self._receiver, QueuedReceiver)

    @property
    def slab(self) -> Slab:
        """Slab that samples are written to; several ports may share one."""
        return self.router.slab

    @property
    def counters(self) -> BusCounters:
        """Counters of this bus."""
        return self.router.counters

    @property
    def bus_state(self) -> BusState:
        """State of the bus as of the last `update_state`."""
        return self.router.bus_state

    @property
    def problem(self) -> str:
        """Problem of the bus (interface down, bus-off ...) and its remedy; empty if there is none."""
        return self.bus_state.problem

    def update_state(self, now_ns: int) -> BusState:
        """Update the bus state from counters and the receiver's fault; cheap enough for every tick."""
        counters, state = self.router.counters, self.router.bus_state
        state.update(now_ns, counters.frames, counters.sent, counters.queue_full, self._receiver.fault)
        is_off = state.error_state is ErrorState.BUS_OFF
        if is_off and not self._was_bus_off and self.bus.interface == "socketcan":
            threading.Thread(target=self._query_restart_ms, name="can-restart-ms", daemon=True).start()
        self._was_bus_off = is_off
        return state

    def fileno(self) -> int:
        """Return a descriptor that is readable while frames are waiting; it never changes."""
        return self._receiver.fileno()

    def route(self, can_id: int, slot: int) -> None:
        """Write samples with this identifier to a slot of the slab; see `Router.route`."""
        self.router.route(can_id, slot)

    def drain(self) -> list[CanFrame]:
        """Read the waiting frames, at most MAX_DRAIN_FRAMES, without blocking.

        Samples are written to the slab; all other data frames are returned. Call it when `fileno` is readable
        and at least once a tick, since it also reopens a disconnected bus.
        """
        now_ns = time.monotonic_ns()
        frames = self._receiver.drain(self.router)
        backlog_ns = self._receiver.backlog_ns
        self.received_until_ns = now_ns if backlog_ns is None else min(backlog_ns, now_ns)
        return frames

    def send(self, can_id: int, data: bytes, remote: bool = False) -> bool:
        """Send a frame; return False, and count it, if the queue is full or the bus is down.

        A remote frame requests as many bytes as `data` has.
        """
        counters, receiver = self.router.counters, self._receiver
        with self._send_lock:
            try:
                receiver.send(can_id, data, remote)
            except Exception as error:  # noqa: BLE001 - drivers raise anything; `update_state` reports it
                self._count_send_failure(error)
                return False
            counters.sent += 1
            if not self.echoes:
                counters.bits += frame_bits(0 if remote else len(data))
        if receiver.fault is not None and receiver.fault.error_state is ErrorState.DOWN:
            receiver.fault = None  # on a silent bus no received frame would show that the interface is up
        return True

    def send_patiently(self, can_id: int, data: bytes, remote: bool = False) -> bool:
        """Send a frame as `send` does, repeated for up to 0.2 s while the queue is full."""
        for _ in range(_SEND_ATTEMPTS):
            if self.send(can_id, data, remote):
                return True
            time.sleep(_SEND_RETRY_S)
        return False

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:
        """Have the kernel send a frame now and every `period_s` seconds.

        None where it can't; `problem` may then have the cause.
        """
        try:
            return self._receiver.send_cyclically(can_id, data, period_s)
        except Exception as error:  # noqa: BLE001 - drivers raise anything
            self._count_send_failure(error)
            return None

    def close(self) -> None:
        """Close the bus."""
        self._receiver.close()

    def _count_send_failure(self, error: Exception) -> None:
        """Count a failed send and keep its fault: sending detects a down bus sooner than receiving."""
        if is_queue_full(error):
            self.router.counters.queue_full += 1
            return
        self.router.counters.send_failures += 1
        fault = fault_from_exception(error)
        if fault.error_state is not ErrorState.ACTIVE and self._receiver.fault is None:
            self._receiver.fault = fault

    def _query_restart_ms(self) -> None:
        """Query the kernel's restart delay; in a thread, since starting a program takes milliseconds."""
        self.bus_state.restart_ms = Machine().restart_ms(str(self.bus.channel))


def open_bus(bus: Bus) -> can.BusABC:
    """Open the python-can bus for a bus of the deployment. Raises BusError if it can't be opened."""
    options: dict[str, Any] = dict(bus.options)
    if bus.interface not in _INTERFACES_WITHOUT_BITRATE:
        options.setdefault("bitrate", bus.bitrate_bit_s)
    try:
        if bus.interface == "udp_multicast":
            check_multicast_route(str(bus.channel))
        return can.Bus(channel=bus.channel, interface=bus.interface, ignore_config=True, **options)
    except Exception as error:  # drivers raise anything
        raise _open_error(bus, error) from error


def _open_receiver(bus: Bus, opener: Callable[[], can.BusABC]) -> Receiver:
    if bus.interface == "socketcan":
        return SocketcanReceiver(opener, str(bus.channel)).open()
    if bus.interface == "udp_multicast":
        return DatagramReceiver(opener).open()
    if bus.interface == "virtual":
        return InProcessReceiver(opener).open()
    return ThreadReceiver(opener, bus.interface).open()


def _open_error(bus: Bus, error: Exception) -> BusError:
    return BusError(
        f'bus "{bus.name}" (interface {bus.interface}, channel {bus.channel}) can\'t be opened: '
        f"{error}; {_open_remedy(bus, error)}"
    )


def _open_remedy(bus: Bus, error: Exception) -> str:
    if isinstance(error, NoRouteError):
        return error.remedy
    if isinstance(error, NotImplementedError | ImportError):
        known = ", ".join(sorted(can.VALID_INTERFACES))
        return f"interface must be one of python-can's with its driver installed: {known}"
    code = errno_from_exception(error)
    if bus.interface == "socketcan":
        if code == errno.EAFNOSUPPORT:
            return "this kernel has no CAN support (modprobe can can_raw); udp_multicast works without"
        return (
            "plug in the adapter, or bring the interface up: "
            f"ip link set {bus.channel} up type can bitrate {bus.bitrate_bit_s} (see `ip link`)"
        )
    if code in (errno.EACCES, errno.EPERM):
        return "this user may not open it; add the user to the device's group (dialout for serial adapters)"
    if bus.interface == "udp_multicast":
        return "give a multicast address as channel, e.g. 239.74.163.2, and options = { port = 43113 }"
    return "is the channel right, the adapter plugged in, and no other program using it?"
