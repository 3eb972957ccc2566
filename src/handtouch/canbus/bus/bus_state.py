"""How a bus fares: error frames, exceptions and counters to one state in words, with a remedy.

Public names: `BusState`, `Condition`, `Trouble`, `trouble_of`, `is_queue_full`.
"""

from __future__ import annotations

import errno
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any


class Condition(Enum):
    """Fault confinement of ISO 11898-1, and a bus that can't be reached at all."""

    ACTIVE = "active"
    WARNING = "warning"  # an error counter is at 96 or more
    PASSIVE = "passive"  # at 128 or more
    BUS_OFF = "bus-off"  # the transmit error counter has passed 255: the controller takes no part
    DOWN = "down"


@dataclass(frozen=True, slots=True)
class Trouble:
    """What an exception tells of the bus; ACTIVE where it was a bad frame and nothing worse."""

    condition: Condition
    text: str


# <linux/can/error.h>: classes in the identifier, details in the data
_LOST_ARBITRATION, _CONTROLLER, _PROTOCOL, _BUS_OFF, _RESTARTED, _COUNTERS = 0x2, 0x4, 0x8, 0x40, 0x100, 0x200
_CLASSES = {
    0x001: "transmit timeout",
    _LOST_ARBITRATION: "lost arbitration",
    0x010: "transceiver",
    0x020: "no acknowledge",
    _BUS_OFF: "bus-off",
    0x080: "bus error",
    _RESTARTED: "restarted",
}
_CONTROLLER_BITS = {
    0x01: "controller receive overflow",
    0x02: "controller transmit overflow",
    0x04: "receive warning",
    0x08: "transmit warning",
    0x10: "receive passive",
    0x20: "transmit passive",
    0x40: "active again",
}
_WARNING_BITS, _PASSIVE_BITS, _ACTIVE_BIT = 0x0C, 0x30, 0x40
_PROTOCOL_BITS = {
    0x01: "bit error",
    0x02: "form error",
    0x04: "stuff error",
    0x08: "bit error",
    0x10: "bit error",
    0x20: "overload",
}
_LOCATIONS = {0x08: "CRC error", 0x18: "CRC error", 0x19: "no acknowledge", 0x1B: "no acknowledge"}
_KERNEL_LAYOUT = frozenset({"socketcan", "gs_usb"})
_WARNING_LIMIT, _PASSIVE_LIMIT = 96, 128

_CALM_FRAMES = 255
"""Good frames in each direction after which no error counter is at 96: each takes one off (ISO 11898-1)."""
_TOLD_NS = 2_000_000_000
"""How long a full transmit queue stays in the reason."""

_DAMAGED = "check wiring, termination (120 ohm at both ends) and the bit rate of all nodes"
_ALONE = "no other node acknowledges: is one connected, powered and at this bit rate?"
_FAULTS = ("no acknowledge", "bit error", "form error", "stuff error", "CRC error", "bus error")

_OFF_TEXT = re.compile(r"bus[ _-]?off", re.IGNORECASE)
_FULL_TEXT = re.compile(r"(queue|buffer|fifo)[^.]*(full|overflow|overrun)|XMTFULL|TXBUFOFL", re.IGNORECASE)


class BusState:
    """State of one bus. `error_frame` what comes, `look` now and then; times in ns of one monotonic clock.

    `condition` and `since_ns` say how it is, `problem` why and what helps (empty when all is well), `causes`
    how often each cause was told, `transmit_errors` and `receive_errors` the controller's counters.
    `restart_ms` is the kernel's automatic restart after bus-off, 0 for none, None while unknown.
    """

    def __init__(self, interface: str = "socketcan", channel: str = "can0") -> None:
        self.condition = Condition.ACTIVE
        self.since_ns = 0
        self.causes: Counter[str] = Counter()
        self.transmit_errors = self.receive_errors = 0
        self.restart_ms: int | None = None
        self._interface, self._channel = interface, channel
        self._recent: Counter[str] = Counter()  # causes since the bus was active last
        self._trouble: Trouble | None = None
        self._frames_at = self._sent_at = 0  # the counters at the last error frame
        self._full = 0
        self._full_ns: int | None = None
        self._now_ns = 0

    def error_frame(self, classes: int, data: bytes | bytearray, t_ns: int, frames: int, sent: int) -> None:
        """Take an error frame; `frames` and `sent` are how many good ones have come and gone by then."""
        self._frames_at, self._sent_at = frames, sent
        if self._interface not in _KERNEL_LAYOUT:
            self._count(["error frame"])
            return
        data = bytes(data[:8]).ljust(8, b"\0")
        self._count(_causes(classes, data))
        if classes & _COUNTERS or ((data[6] or data[7]) and classes & (_CONTROLLER | _PROTOCOL)):
            self.transmit_errors, self.receive_errors = data[6], data[7]
        condition = _condition(classes, data)
        if condition is not None:
            self._become(condition, t_ns)

    def look(self, t_ns: int, frames: int, sent: int, full: int, trouble: Trouble | None) -> None:
        """Draw conclusions from what has passed since: good frames, a full transmit queue (`full` times so
        far), and what is wrong with the adapter now.
        """
        self._now_ns = t_ns
        if full > self._full:
            self._full, self._full_ns = full, t_ns
        elif self._full_ns is not None and t_ns - self._full_ns > _TOLD_NS:
            self._full_ns = None
        before, self._trouble = self._trouble, trouble
        if trouble is not None and trouble.condition is not Condition.ACTIVE:
            if trouble.condition is Condition.BUS_OFF and self.condition is not Condition.BUS_OFF:
                self._count(["bus-off"])
            self._become(trouble.condition, t_ns)
        elif self.condition is Condition.DOWN or (before is not None and before.condition is self.condition):
            self._become(Condition.ACTIVE, t_ns)
        elif self.condition is Condition.BUS_OFF and frames > self._frames_at:
            self._become(Condition.ACTIVE, t_ns)  # a controller that is off receives nothing
        elif self.condition in (Condition.WARNING, Condition.PASSIVE) and self._is_calm(frames, sent):
            self._become(Condition.ACTIVE, t_ns)

    @property
    def problem(self) -> str:
        """Why the bus isn't well, and what helps; empty when it is."""
        told = [self._why()] if self.condition is not Condition.ACTIVE else []
        if not told and self._trouble is not None:
            told.append(self._trouble.text)
        if self._full_ns is not None and self.condition is not Condition.DOWN:
            told.append(self._queue_full())
        return "; ".join(told)

    def figures(self) -> dict[str, Any]:
        """All of it, for a message."""
        return {
            "state": self.condition.value,
            "since_ns": self.since_ns,
            "problem": self.problem,
            "causes": dict(self.causes),
            "transmit_errors": self.transmit_errors,
            "receive_errors": self.receive_errors,
        }

    def _count(self, causes: Iterable[str]) -> None:
        causes = list(causes)
        self.causes.update(causes)
        self._recent.update(causes)

    def _become(self, condition: Condition, t_ns: int) -> None:
        if condition is Condition.ACTIVE:
            self._recent.clear()
        if condition is not self.condition:
            self.condition, self.since_ns = condition, t_ns

    def _is_calm(self, frames: int, sent: int) -> bool:
        transmit = self._recent["transmit passive"] or self._recent["transmit warning"]
        return frames - self._frames_at >= _CALM_FRAMES and (
            not transmit or sent - self._sent_at >= _CALM_FRAMES
        )

    def _why(self) -> str:
        if self.condition is Condition.DOWN:
            return self._down()
        faults = Counter({cause: self._recent[cause] for cause in _FAULTS if self._recent[cause]})
        most = faults.most_common(1)[0][0] if faults else ""
        seen = [f"mostly {most}"] if most else []
        if self.transmit_errors or self.receive_errors:
            seen.append(f"error counters: transmit {self.transmit_errors}, receive {self.receive_errors}")
        word = "bus-off" if self.condition is Condition.BUS_OFF else f"error-{self.condition.value}"
        told = word + (f" ({', '.join(seen)})" if seen else "")
        remedy = _ALONE if most == "no acknowledge" and self.condition is not Condition.BUS_OFF else _DAMAGED
        return f"{told}: {remedy}" + (f"; {self._recovery()}" if self.condition is Condition.BUS_OFF else "")

    def _recovery(self) -> str:
        if self._interface != "socketcan":
            return "the adapter is closed and opened again until it works"
        if self.restart_ms:
            return f"the kernel restarts {self._channel} after {self.restart_ms} ms"
        name = self._channel
        return (
            f"{name} stays off until `ip link set {name} type can restart`; to have the kernel do it: "
            f"ip link set {name} down && ip link set {name} up type can restart-ms 100"
        )

    def _down(self) -> str:
        text = self._trouble.text if self._trouble is not None else "down"
        if self._interface == "socketcan":
            return f"{text}: ip link set {self._channel} up, or plug the adapter in; it is used again then"
        return f"{text}: plug the adapter in; it is opened again until it works"

    def _queue_full(self) -> str:
        remedy = _ALONE
        if self._interface == "socketcan":
            remedy += f" If so, a longer queue helps: ip link set {self._channel} txqueuelen 128"
        return f"transmit queue full, {self._full} frames not sent: {remedy}"


def trouble_of(error: BaseException) -> Trouble:
    """What an exception of a python-can interface tells of the bus."""
    text = str(error) or type(error).__name__
    if _OFF_TEXT.search(text):
        return Trouble(Condition.BUS_OFF, text)
    gone = code_of(error) in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF)
    return Trouble(Condition.DOWN if gone else Condition.ACTIVE, text)


def is_queue_full(error: BaseException) -> bool:
    """Whether sending failed because the transmit queue had no room, by errno or by the driver's words."""
    return code_of(error) in (errno.ENOBUFS, errno.EAGAIN) or bool(_FULL_TEXT.search(str(error)))


def code_of(error: BaseException) -> int | None:
    """The errno of an exception of python-can or of the system, if it has one."""
    code = getattr(error, "errno", None) or getattr(error, "error_code", None)
    return code if isinstance(code, int) else None


def _causes(classes: int, data: bytes) -> list[str]:
    """Causes that an error frame tells, each once."""
    causes = {name: None for bit, name in _CLASSES.items() if classes & bit}
    if classes & _CONTROLLER:
        causes |= {name: None for bit, name in _CONTROLLER_BITS.items() if data[1] & bit}
    if classes & _PROTOCOL:
        causes |= {name: None for bit, name in _PROTOCOL_BITS.items() if data[2] & bit}
        if data[3] in _LOCATIONS:
            causes[_LOCATIONS[data[3]]] = None
    return list(causes) or ["unspecified"]


def _condition(classes: int, data: bytes) -> Condition | None:
    """The state that an error frame tells; None where it tells none."""
    if classes & _RESTARTED:
        return Condition.ACTIVE
    if classes & _BUS_OFF:
        return Condition.BUS_OFF
    bits = data[1] if classes & _CONTROLLER else 0
    if bits & _PASSIVE_BITS:
        return Condition.PASSIVE
    if bits & _WARNING_BITS:
        return Condition.WARNING
    if bits & _ACTIVE_BIT:
        return Condition.ACTIVE
    if classes & _COUNTERS:
        worst = max(data[6], data[7])
        if worst >= _PASSIVE_LIMIT:
            return Condition.PASSIVE
        return Condition.WARNING if worst >= _WARNING_LIMIT else Condition.ACTIVE
    return None
