"""EMCY messages of CANopen nodes as text (CiA 301, error codes and error register)."""

from __future__ import annotations

import struct
from dataclasses import dataclass

_LAYOUT = struct.Struct("<HB5s")


@dataclass(frozen=True, slots=True)
class Emergency:
    """One EMCY message: error code, error register (object 0x1001), five bytes of the manufacturer's own."""

    t_ns: int
    code: int
    register: int
    detail: bytes
    text: str


def decode(data: bytes, t_ns: int) -> Emergency | None:
    """An EMCY message from its eight bytes of data; None if there aren't eight."""
    if len(data) != _LAYOUT.size:
        return None
    code, register, detail = _LAYOUT.unpack(data)
    return Emergency(t_ns, code, register, detail, describe(code, register))


def describe(code: int, register: int) -> str:
    """Words for an error code and the set bits of the error register; unknown codes by their class."""
    text = _CODES.get(code) or _CLASSES.get(code >> 8) or _CLASSES.get(code >> 12 << 4) or "unknown error"
    # The generic bit is set with every error and says nothing beside another.
    bits = [name for bit, name in enumerate(_REGISTER) if register >> bit & 1 and (bit or register == 1)]
    return f"0x{code:04X} {text}" + (f" (register: {', '.join(bits)})" if bits else "")


_REGISTER = (
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
    0x00: "error gone",
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
    0x8250: "RPDO time-out",
}
