"""Fault confinement state of a bus from error frames, exceptions and counters, with a problem text and
remedy.

Public names: `BusState`, `ErrorState`, `BusTransition`, `BusFault`, `fault_from_exception`,
`errno_from_exception`, `is_queue_full`.
"""

from __future__ import annotations

import errno
import re
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any


class ErrorState(Enum):
    """Error state as in ISO 11898-1, plus DOWN for an interface that can't be reached."""

    ACTIVE = "active"
    WARNING = "warning"  # an error counter is 96 or more
    PASSIVE = "passive"  # 128 or more
    BUS_OFF = "bus-off"  # transmit error counter above 255: the controller neither sends nor receives
    DOWN = "down"


@dataclass(frozen=True, slots=True)
class BusFault:
    """Bus state implied by an exception; ACTIVE if only a frame was bad."""

    error_state: ErrorState
    text: str


@dataclass(frozen=True, slots=True)
class BusTransition:
    """A change of a bus's state, `lasted_ns` after the one before, with the problem of the new state."""

    old: ErrorState
    new: ErrorState
    lasted_ns: int
    problem: str


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
_FAULT_LOCATIONS = {0x08: "CRC error", 0x18: "CRC error", 0x19: "no acknowledge", 0x1B: "no acknowledge"}
_KERNEL_LAYOUT = frozenset({"socketcan", "gs_usb"})
_WARNING_LIMIT, _PASSIVE_LIMIT = 96, 128

_MIN_RECOVERY_FRAMES = 255
"""Good frames in each direction that bring every error counter below 96: each decrements it (ISO 11898-1)."""
_QUEUE_FULL_HOLD_NS = 2_000_000_000
"""Time for which a full transmit queue stays in `problem`."""

_MAX_TRANSITIONS = 64
_WIRING_REMEDY = "check wiring, termination (120 ohm at both ends) and the bit rate of all nodes"
_NO_ACKNOWLEDGE_REMEDY = "no other node acknowledges: is one connected, powered and at this bit rate?"
_FAULT_CAUSES = ("no acknowledge", "bit error", "form error", "stuff error", "CRC error", "bus error")

_DOWN_ERRNOS = frozenset({errno.ENETDOWN, errno.ENETUNREACH, errno.ENODEV, errno.ENXIO, errno.EBADF})
_BUS_OFF_PATTERN = re.compile(r"bus[ _-]?off", re.IGNORECASE)
_QUEUE_FULL_PATTERN = re.compile(
    r"(queue|buffer|fifo)[^.]*(full|overflow|overrun)|XMTFULL|TXBUFOFL", re.IGNORECASE
)


_WITHOUT_FRAMES = (ErrorState.DOWN, ErrorState.BUS_OFF)


class BusState:
    """State of one bus: call `handle_error_frame` for each error frame and `update` regularly.

    `error_state` : current state, since `since_ns` on the clock of the calls
    `problem` : cause and remedy, empty if there is no problem
    `recovered_ns` : end of the last time in which the bus was down or bus-off, 0 if there was none
    `causes` : number of error frames by cause
    `transmit_errors`, `receive_errors` : the controller's error counters
    `restart_ms` : the kernel's automatic restart after bus-off, 0 for none, None while unknown
    """

    def __init__(self, interface: str = "socketcan", channel: str = "can0") -> None:
        self.error_state = ErrorState.ACTIVE
        self.since_ns = self.recovered_ns = 0
        self.causes: Counter[str] = Counter()
        self.transmit_errors = self.receive_errors = 0
        self.restart_ms: int | None = None
        self._interface, self._channel = interface, channel
        self._transitions: deque[BusTransition] = deque(maxlen=_MAX_TRANSITIONS)
        self._recent_causes: Counter[str] = Counter()  # since the bus was error-active last
        self._fault: BusFault | None = None
        self._frames_at_error = self._sent_at_error = 0  # the counters at the last error frame
        self._queue_full_count = 0
        self._queue_full_ns: int | None = None

    def handle_error_frame(
        self, classes: int, data: bytes | bytearray, arrival_ns: int, frames: int, sent: int
    ) -> None:
        """Evaluate an error frame; `frames` and `sent` count the good frames received and sent so far."""
        self._frames_at_error, self._sent_at_error = frames, sent
        if self._interface not in _KERNEL_LAYOUT:
            self._count_causes(["error frame"])
            return
        data = bytes(data[:8]).ljust(8, b"\0")
        self._count_causes(_causes(classes, data))
        if classes & _COUNTERS or ((data[6] or data[7]) and classes & (_CONTROLLER | _PROTOCOL)):
            self.transmit_errors, self.receive_errors = data[6], data[7]
        error_state = _error_state(classes, data)
        if error_state is not None:
            self._set_error_state(error_state, arrival_ns)

    def update(self, now_ns: int, frames: int, sent: int, queue_full: int, fault: BusFault | None) -> None:
        """Update the state from counters of good frames and full transmit queues, and the present fault."""
        if queue_full > self._queue_full_count:
            self._queue_full_count, self._queue_full_ns = queue_full, now_ns
        elif self._queue_full_ns is not None and now_ns - self._queue_full_ns > _QUEUE_FULL_HOLD_NS:
            self._queue_full_ns = None
        previous, self._fault = self._fault, fault
        state = self.error_state
        if fault is not None and fault.error_state is not ErrorState.ACTIVE:
            if fault.error_state is ErrorState.BUS_OFF and state is not ErrorState.BUS_OFF:
                self._count_causes(["bus-off"])
            self._set_error_state(fault.error_state, now_ns)
        elif state is ErrorState.DOWN or (previous is not None and previous.error_state is state):
            self._set_error_state(ErrorState.ACTIVE, now_ns)
        elif state is ErrorState.BUS_OFF and frames > self._frames_at_error:
            self._set_error_state(ErrorState.ACTIVE, now_ns)  # a bus-off controller receives nothing
        elif state in (ErrorState.WARNING, ErrorState.PASSIVE) and self._has_recovered(frames, sent):
            self._set_error_state(ErrorState.ACTIVE, now_ns)

    @property
    def problem(self) -> str:
        """Cause of a bad state and its remedy; empty if there is no problem."""
        problems = [self._describe_error_state()] if self.error_state is not ErrorState.ACTIVE else []
        if not problems and self._fault is not None:
            problems.append(self._fault.text)
        if self._queue_full_ns is not None and self.error_state is not ErrorState.DOWN:
            problems.append(self._describe_queue_full())
        return "; ".join(problems)

    def drain_transitions(self) -> list[BusTransition]:
        """Return the changes of state since the last call, oldest first; at most the latest 64."""
        transitions = list(self._transitions)
        self._transitions.clear()
        return transitions

    def report(self) -> dict[str, Any]:
        """Return the state as a map for the service message."""
        return {
            "state": self.error_state.value,
            "since_ns": self.since_ns,
            "problem": self.problem,
            "causes": dict(self.causes),
            "transmit_errors": self.transmit_errors,
            "receive_errors": self.receive_errors,
        }

    def _count_causes(self, causes: Iterable[str]) -> None:
        causes = list(causes)
        self.causes.update(causes)
        self._recent_causes.update(causes)

    def _set_error_state(self, error_state: ErrorState, now_ns: int) -> None:
        if error_state is ErrorState.ACTIVE:
            self._recent_causes.clear()
        if error_state is not self.error_state:
            old, lasted_ns = self.error_state, now_ns - self.since_ns
            if old in _WITHOUT_FRAMES and error_state not in _WITHOUT_FRAMES:
                self.recovered_ns = now_ns
            self.error_state, self.since_ns = error_state, now_ns
            self._transitions.append(BusTransition(old, error_state, lasted_ns, self.problem))

    def _has_recovered(self, frames: int, sent: int) -> bool:
        transmit = self._recent_causes["transmit passive"] or self._recent_causes["transmit warning"]
        return frames - self._frames_at_error >= _MIN_RECOVERY_FRAMES and (
            not transmit or sent - self._sent_at_error >= _MIN_RECOVERY_FRAMES
        )

    def _describe_error_state(self) -> str:
        if self.error_state is ErrorState.DOWN:
            return self._describe_down()
        faults = Counter(
            {cause: self._recent_causes[cause] for cause in _FAULT_CAUSES if self._recent_causes[cause]}
        )
        most_frequent = faults.most_common(1)[0][0] if faults else ""
        details = [f"mostly {most_frequent}"] if most_frequent else []
        if self.transmit_errors or self.receive_errors:
            details.append(f"error counters: transmit {self.transmit_errors}, receive {self.receive_errors}")
        is_off = self.error_state is ErrorState.BUS_OFF
        state = "bus-off" if is_off else f"error-{self.error_state.value}"
        if details:
            state += f" ({', '.join(details)})"
        alone = most_frequent == "no acknowledge" and not is_off
        remedy = _NO_ACKNOWLEDGE_REMEDY if alone else _WIRING_REMEDY
        return f"{state}: {remedy}" + (f"; {self._describe_recovery()}" if is_off else "")

    def _describe_recovery(self) -> str:
        if self._interface != "socketcan":
            return "the adapter is reopened until it works"
        if self.restart_ms:
            return f"the kernel restarts {self._channel} after {self.restart_ms} ms"
        name = self._channel
        return (
            f"{name} stays off until `ip link set {name} type can restart`; for automatic restart: "
            f"ip link set {name} down && ip link set {name} up type can restart-ms 100"
        )

    def _describe_down(self) -> str:
        text = self._fault.text if self._fault is not None else "down"
        if self._interface == "socketcan":
            return f"{text}: ip link set {self._channel} up, or plug the adapter in; reception then resumes"
        if self._interface == "udp_multicast":
            return f"{text}: bring the network interface up; reception then resumes"
        return f"{text}: plug the adapter in; it is reopened until it works"

    def _describe_queue_full(self) -> str:
        remedy = _NO_ACKNOWLEDGE_REMEDY
        if self._interface == "socketcan":
            remedy += f" If so, a longer queue helps: ip link set {self._channel} txqueuelen 128"
        return f"transmit queue full, {self._queue_full_count} frames not sent: {remedy}"


def fault_from_exception(error: BaseException) -> BusFault:
    """Return the fault that an exception of a python-can interface stands for."""
    text = str(error) or type(error).__name__
    if _BUS_OFF_PATTERN.search(text):
        return BusFault(ErrorState.BUS_OFF, text)
    is_down = errno_from_exception(error) in _DOWN_ERRNOS
    return BusFault(ErrorState.DOWN if is_down else ErrorState.ACTIVE, text)


def is_queue_full(error: BaseException) -> bool:
    """Return True if sending failed because the transmit queue was full, by errno or by the driver's text."""
    return errno_from_exception(error) in (errno.ENOBUFS, errno.EAGAIN) or bool(
        _QUEUE_FULL_PATTERN.search(str(error))
    )


def errno_from_exception(error: BaseException) -> int | None:
    """Return the errno of an exception of python-can or of the system, or of its cause; None without one."""
    code = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if isinstance(code, int):
        return code
    return None if error.__cause__ is None else errno_from_exception(error.__cause__)


def _causes(classes: int, data: bytes) -> list[str]:
    """Return the causes in an error frame, each once."""
    causes = {name: None for bit, name in _CLASSES.items() if classes & bit}
    if classes & _CONTROLLER:
        causes |= {name: None for bit, name in _CONTROLLER_BITS.items() if data[1] & bit}
    if classes & _PROTOCOL:
        causes |= {name: None for bit, name in _PROTOCOL_BITS.items() if data[2] & bit}
        if data[3] in _FAULT_LOCATIONS:
            causes[_FAULT_LOCATIONS[data[3]]] = None
    return list(causes) or ["unspecified"]


def _error_state(classes: int, data: bytes) -> ErrorState | None:
    """Return the state reported by an error frame, None if it reports none."""
    if classes & _RESTARTED:
        return ErrorState.ACTIVE
    if classes & _BUS_OFF:
        return ErrorState.BUS_OFF
    bits = data[1] if classes & _CONTROLLER else 0
    if bits & _PASSIVE_BITS:
        return ErrorState.PASSIVE
    if bits & _WARNING_BITS:
        return ErrorState.WARNING
    if bits & _ACTIVE_BIT:
        return ErrorState.ACTIVE
    if classes & _COUNTERS:
        worst = max(data[6], data[7])
        if worst >= _PASSIVE_LIMIT:
            return ErrorState.PASSIVE
        return ErrorState.WARNING if worst >= _WARNING_LIMIT else ErrorState.ACTIVE
    return None
