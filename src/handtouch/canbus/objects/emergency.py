"""EMCY messages of CANopen nodes (CiA 301): decoding, and error codes and registers as text."""

from __future__ import annotations

import struct
from dataclasses import dataclass

_LAYOUT = struct.Struct("<HB5s")


@dataclass(frozen=True, slots=True)
class Emergency:
    """One EMCY message: error code, error register (object 0x1001), five manufacturer-specific bytes."""

    arrival_ns: int
    code: int
    register: int
    detail: bytes
    text: str

    def __str__(self) -> str:
        return self.text


def decode_emergency(data: bytes, arrival_ns: int) -> Emergency | None:
    """Decode an EMCY message; None unless it has eight bytes."""
    if len(data) != _LAYOUT.size:
        return None
    code, register, detail = _LAYOUT.unpack(data)
    return Emergency(arrival_ns, code, register, detail, describe_emergency(code, register))


def describe_emergency(code: int, register: int) -> str:
    """Describe an error code and the set bits of the error register; unknown codes by their class."""
    text = _CODES.get(code) or _CLASSES.get(code >> 8) or _CLASSES.get(code >> 12 << 4) or "unknown error"
    # The generic bit is set with every error; another bit makes it redundant.
    bits = [name for bit, name in enumerate(_REGISTER_BITS) if register >> bit & 1 and (bit or register == 1)]
    return f"0x{code:04X} {text}" + (f" (register: {', '.join(bits)})" if bits else "")


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
