"""Errors that a CANopen node reports (CiA 301): EMCY messages, error register 0x1001, error history 0x1003.

Public names: `decode_emergency`, `describe_emergency`, `describe_register`, `ReportedErrors`, `ErrorLog`.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, replace

from handtouch.canbus import cia301
from handtouch.wire.health import Emergency

MAX_EMERGENCIES = 16
_LAYOUT = struct.Struct("<HB5s")
_GENERIC = 1
"""Bit of the error register that is set with every error."""


def decode_emergency(data: bytes, arrival_ns: int) -> Emergency | None:
    """Decode an EMCY message; None unless it has eight bytes."""
    if len(data) != _LAYOUT.size:
        return None
    code, register, manufacturer = _LAYOUT.unpack(data)
    return Emergency(code, register, manufacturer.hex(), describe_emergency(code, register), arrival_ns)


@dataclass(frozen=True, slots=True)
class ReportedErrors:
    """Error objects read from a node; None for a missing one.

    `history` : entries of 0x1003, the latest first: error code, and manufacturer's information in bits 16-31
    `behaviour` : 0x1029 sub 1, the reaction to a communication error
    """

    register: int | None
    history: tuple[int, ...] = ()
    behaviour: int | None = None


class ErrorLog:
    """Errors that one node has reported: the latest EMCY messages, error register and history.

    `register` : error register as last received, None before
    `history` : 0x1003 as last read, the latest error first
    """

    def __init__(self) -> None:
        self.register: int | None = None
        self.history: tuple[int, ...] = ()
        self._behaviour: int | None = None
        self._emergencies: deque[Emergency] = deque(maxlen=MAX_EMERGENCIES)

    @property
    def emergencies(self) -> tuple[Emergency, ...]:
        """The latest EMCY messages, oldest first; without the error resets."""
        return tuple(self._emergencies)

    def add_emergency(self, message: Emergency) -> tuple[Emergency, ...]:
        """Add an EMCY message; return the errors that are new or cleared by it.

        Code 0x00xx resets errors. An error is cleared when the error register, which every message carries,
        has none of its bits any more besides the generic one, or is 0. A repetition is counted.
        """
        is_reset = message.code >> 8 == 0
        latest = self._emergencies[-1] if self._emergencies else None
        is_same = latest is not None and _is_repetition(message, latest) and message.register == self.register
        if latest is not None and is_same and not is_reset:
            self._emergencies[-1] = replace(latest, count=latest.count + 1)
            return ()
        cleared = self._update_register(message.register, message.arrival_ns)
        if is_reset:
            return cleared
        self._emergencies.append(message)
        return (*cleared, message)

    def add_report(self, report: ReportedErrors, read_ns: int) -> tuple[Emergency, ...]:
        """Add what was read from the node at `read_ns`; return the errors that the register clears."""
        self.history = report.history
        if report.behaviour is not None:
            self._behaviour = report.behaviour
        return () if report.register is None else self._update_register(report.register, read_ns)

    def describe(self) -> str:
        """Describe the present errors: register, EMCY messages or else the latest of the history."""
        active = [emergency for emergency in self._emergencies if emergency.cleared_ns is None]
        parts = [describe_register(self.register)] if self.register else []
        parts += [f"EMCY {describe_emergency(error.code, 0)}" for error in reversed(active[-2:])]
        if self.register and not active and self.history:
            parts.append(f"latest in 0x1003: EMCY {describe_emergency(self.history[0] & 0xFFFF, 0)}")
        if parts and self._behaviour is not None:
            reaction = cia301.ERROR_REACTIONS.get(self._behaviour, "manufacturer specific")
            parts.append(f"0x1029:01 = {self._behaviour} ({reaction} after a communication error)")
        return ", ".join(parts)

    def _update_register(self, register: int, now_ns: int) -> tuple[Emergency, ...]:
        """Set the register; return the errors that it clears."""
        self.register = register
        cleared = []
        for number, error in enumerate(self._emergencies):
            specific = error.register & ~_GENERIC
            remains = register & specific if specific else register
            if error.cleared_ns is None and not remains:
                self._emergencies[number] = replace(error, cleared_ns=now_ns)
                cleared.append(self._emergencies[number])
        return tuple(cleared)


def _is_repetition(message: Emergency, latest: Emergency) -> bool:
    fields = (message.code, message.register, message.manufacturer)
    return latest.cleared_ns is None and fields == (latest.code, latest.register, latest.manufacturer)


def describe_emergency(code: int, register: int) -> str:
    """Describe an error code and the set bits of the error register; unknown codes by their class."""
    text = _CODES.get(code) or _CLASSES.get(code >> 8) or _CLASSES.get(code >> 12 << 4) or "unknown error"
    # The generic bit is set with every error; another bit makes it redundant.
    bits = [name for bit, name in enumerate(_REGISTER_BITS) if register >> bit & 1 and (bit or register == 1)]
    return f"0x{code:04X} {text}" + (f" (register: {', '.join(bits)})" if bits else "")


def describe_register(register: int) -> str:
    """Describe the error register, 0x1001, with the names of its bits."""
    bits = [name for bit, name in enumerate(_REGISTER_BITS) if register >> bit & 1]
    return f"error register 0x{register:02X} ({', '.join(bits) or 'no error'})"


_REGISTER_BITS = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "manufacturer",
)

_CLASSES = {
    0x00: "error reset",
    0x10: "generic error",
    0x20: "current",
    0x21: "current at the device's input",
    0x22: "current inside the device",
    0x23: "current at the device's output",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}

_CODES = {
    0x0000: "no error",
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier collision",
    0x8210: "PDO not processed, length error",
    0x8220: "PDO length exceeded",
    0x8230: "destination object of a multiplexed PDO not available",
    0x8240: "unexpected SYNC length",
    0x8250: "RPDO timeout",
}
