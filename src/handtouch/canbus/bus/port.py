"""One CAN bus: open it by python-can's interface name and channel, receive, send, count.

Public names: `Port`, `open_bus`, `BusError`.
"""

from __future__ import annotations

import errno
import json
import subprocess
import threading
from collections.abc import Callable
from typing import Any

import can

from handtouch.config import Bus

from .bus_state import BusState, Condition, code_of, is_queue_full, trouble_of
from .load import frame_bits
from .receivers import CyclicSender, InProcessReceiver, QueuedReceiver, Receiver, ThreadReceiver
from .router import Counters, Frame, Router
from .slab import Slab
from .sockets import DatagramReceiver, SocketcanReceiver

_ECHOES = frozenset({"udp_multicast"})  # what we send comes back and is counted there
_OWN_BIT_RATE = frozenset({"socketcan", "udp_multicast", "virtual"})  # python-can can't set it there


class BusError(OSError):
    """A bus that can't be opened; `str` names the bus, its interface and channel, and a remedy."""


class Port:
    """A bus in use. Receive in one thread; `send` is safe from any.

    `echoes` says whether frames that we send are received, too.
    """

    def __init__(self, bus: Bus, receiver: Receiver, slab: Slab) -> None:
        """Use a receiver that is open already; `Port.open` makes one from a bus's description."""
        self.name = bus.name
        self.bus = bus
        self.router = Router(slab)
        self.router.state = BusState(bus.interface, str(bus.channel))
        self.echoes = bus.interface in _ECHOES
        self._receiver = receiver
        self._send_lock = threading.Lock()
        self._was_off = False

    @classmethod
    def open(cls, bus: Bus, slab: Slab) -> Port:
        """Open a bus; samples will be written to `slab`. Raises BusError if it can't be opened."""

        def opener() -> can.BusABC:
            return open_bus(bus)

        try:
            receiver = _receiver(bus, opener)
        except BusError:
            raise
        except Exception as error:  # as in `open_bus`: it is there, but can't be received from
            raise _unopened(bus, error) from error
        return cls(bus, receiver, slab)

    @property
    def is_queue(self) -> bool:
        """Whether frames wait in this process, so that to `drain` asks nobody else."""
        return isinstance(self._receiver, QueuedReceiver)

    @property
    def slab(self) -> Slab:
        """Where samples go; several ports may share one."""
        return self.router.slab

    @property
    def counters(self) -> Counters:
        """What this bus has carried."""
        return self.router.counters

    @property
    def state(self) -> BusState:
        """How the bus fares, as of the last `look`."""
        return self.router.state

    @property
    def problem(self) -> str:
        """What is wrong with the bus (interface down, bus-off …) and what helps; empty when nothing is."""
        return self.state.problem

    def look(self, t_ns: int) -> BusState:
        """Take in what has happened to the bus since the last look; cheap enough for every tick."""
        counters, state = self.router.counters, self.router.state
        state.look(t_ns, counters.frames, counters.sent, counters.queue_full, self._receiver.trouble)
        off = state.condition is Condition.BUS_OFF
        if off and not self._was_off and self.bus.interface == "socketcan":
            threading.Thread(target=self._ask_restart, name="can-restart-ms", daemon=True).start()
        self._was_off = off
        return state

    def fileno(self) -> int:
        """Descriptor that is readable while frames wait; the same for the port's whole life."""
        return self._receiver.fileno()

    def route(self, can_id: int, slot: int) -> None:
        """Samples with this identifier go straight to that slot of the slab; see `Router.route`."""
        self.router.route(can_id, slot)

    def drain(self) -> list[Frame]:
        """Read what waits, at most a few thousand frames, without blocking.

        Samples are in the slab then; all other data frames are returned. Call it when `fileno` is readable
        and at least once a tick: a bus that is gone is opened again from here.
        """
        return self._receiver.drain(self.router)

    def send(self, can_id: int, data: bytes, remote: bool = False) -> bool:
        """Send a frame; a full queue or a bus that is down is counted, never raised. True if it went out.

        A remote frame asks for as many bytes as `data` has, whatever they are.
        """
        counters, receiver = self.router.counters, self._receiver
        with self._send_lock:
            try:
                receiver.send(can_id, data, remote)
            except Exception as error:  # noqa: BLE001 - drivers raise anything; it is counted, and told in `look`
                self._not_sent(error)
                return False
            counters.sent += 1
            if not self.echoes:
                counters.bits += frame_bits(0 if remote else len(data))
        if receiver.trouble is not None and receiver.trouble.condition is Condition.DOWN:
            receiver.trouble = None  # where nobody sends, no frame will show that the interface is up again
        return True

    def send_cyclically(self, can_id: int, data: bytes, period_s: float) -> CyclicSender | None:
        """Have the kernel send a frame now and every `period_s` seconds, if there is a kernel that can.

        None if not; then `problem` may say why.
        """
        try:
            return self._receiver.send_cyclically(can_id, data, period_s)
        except Exception as error:  # noqa: BLE001 - as above
            self._not_sent(error)
            return None

    def close(self) -> None:
        """Give the bus back."""
        self._receiver.close()

    def _not_sent(self, error: Exception) -> None:
        """Count it; a send also shows sooner than `recv` that the bus is down."""
        if is_queue_full(error):
            self.router.counters.queue_full += 1
            return
        self.router.counters.send_failures += 1
        told = trouble_of(error)
        if told.condition is not Condition.ACTIVE and self._receiver.trouble is None:
            self._receiver.trouble = told

    def _ask_restart(self) -> None:
        """In a thread of its own: starting a program takes milliseconds."""
        self.state.restart_ms = restart_ms(str(self.bus.channel))


def open_bus(bus: Bus) -> can.BusABC:
    """python-can's bus for a bus of the deployment. Raises BusError if it can't be opened."""
    options: dict[str, Any] = dict(bus.options)
    if bus.interface not in _OWN_BIT_RATE:
        options.setdefault("bitrate", bus.bitrate_bit_s)
    try:
        return can.Bus(channel=bus.channel, interface=bus.interface, ignore_config=True, **options)
    except Exception as error:  # drivers raise anything; all of it means that the bus is not there
        raise _unopened(bus, error) from error


def restart_ms(channel: str) -> int | None:
    """After how long the kernel restarts a SocketCAN interface by itself after bus-off, ms; 0: never.

    None where that isn't known: without iproute2, or an interface that can't go bus-off.
    """
    command = ["ip", "-details", "-json", "link", "show", "dev", channel]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        link = json.loads(done.stdout)[0]["linkinfo"]
        return int(link["info_data"].get("restart_ms", 0)) if link["info_kind"] == "can" else None
    except (OSError, ValueError, LookupError, TypeError, subprocess.SubprocessError):
        return None


def _receiver(bus: Bus, opener: Callable[[], can.BusABC]) -> Receiver:
    if bus.interface == "socketcan":
        return SocketcanReceiver(opener, str(bus.channel))
    if bus.interface == "udp_multicast":
        return DatagramReceiver(opener)
    if bus.interface == "virtual":
        return InProcessReceiver(opener)
    return ThreadReceiver(opener, bus.interface)


def _unopened(bus: Bus, error: Exception) -> BusError:
    return BusError(
        f'bus "{bus.name}" (interface {bus.interface}, channel {bus.channel}) can\'t be opened: '
        f"{error}; {_remedy(bus, error)}"
    )


def _remedy(bus: Bus, error: Exception) -> str:
    if isinstance(error, NotImplementedError | ImportError):
        known = ", ".join(sorted(can.VALID_INTERFACES))
        return f"interface must be one of python-can's, with its driver installed: {known}"
    code = code_of(error)
    if bus.interface == "socketcan":
        if code == errno.EAFNOSUPPORT:
            return "this kernel has no CAN support (modprobe can can_raw); udp_multicast works without"
        return (
            "plug in the adapter, or bring the interface up: "
            f"ip link set {bus.channel} up type can bitrate {bus.bitrate_bit_s} (ip link lists what there is)"
        )
    if code in (errno.EACCES, errno.EPERM):
        return "this user may not open it; add it to the device's group (dialout for serial lines)"
    if bus.interface == "udp_multicast":
        return "give a multicast address as channel, e.g. 239.74.163.2, and options = { port = 43113 }"
    return "is the channel right, the adapter plugged in, and no other program using it?"
