"""Objects that a node needs: the table of docs/firmware.md.

Public names: `RequiredObject`, `REQUIRED_OBJECTS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from handtouch.canbus import cia301

Access = Literal["ro", "rw", "ro or rw", "rw or const"]
SIZES = {"u8": 1, "u16": 2, "u32": 4, "i16": 2}


@dataclass(frozen=True, slots=True)
class RequiredObject:
    """A row of the table: an object with sub-indices 0 to `last_sub`.

    `types`, `defaults` : of sub 0, 1 ...; the last one holds for all that follow
    `optional` : handtouch does without it
    """

    index: int
    name: str
    last_sub: int
    types: tuple[str, ...]
    access: Access
    defaults: tuple[str, ...]
    remark: str
    optional: bool = False

    def size_bytes(self, sub: int) -> int:
        """Return the length of a sub-index."""
        return SIZES[self.types[min(sub, len(self.types) - 1)]]


REQUIRED_OBJECTS = (
    RequiredObject(
        cia301.DEVICE_TYPE,
        "device type",
        0,
        ("u32",),
        "ro",
        ("0x00020191",),
        "CiA 401, analogue inputs; not compared",
    ),
    RequiredObject(
        cia301.ERROR_REGISTER, "error register", 0, ("u8",), "ro", ("0",), "read at boot; 0: no error"
    ),
    RequiredObject(
        cia301.EMCY_COB_ID,
        "COB-ID EMCY",
        0,
        ("u32",),
        "ro or rw",
        ("0x80 + id",),
        "only with EMCY",
        optional=True,
    ),
    RequiredObject(
        cia301.HEARTBEAT_TIME,
        "producer heartbeat time",
        0,
        ("u16",),
        "rw",
        ("0 or any",),
        "written by handtouch [ms]; without it node guarding, 0x100C and 0x100D",
    ),
    RequiredObject(
        cia301.IDENTITY,
        "identity",
        4,
        ("u8", "u32"),
        "ro",
        ("4", "vendor id", "product code", "revision", "serial number"),
        "a serial number for each node",
    ),
    RequiredObject(
        cia301.ERROR_BEHAVIOUR,
        "error behaviour",
        1,
        ("u8", "u8"),
        "rw",
        ("1", "0 or 1"),
        "1: errors don't change the NMT state",
        optional=True,
    ),
    RequiredObject(
        cia301.TPDO_COMMUNICATION + 1,
        "TPDO2 communication",
        2,
        ("u8", "u32", "u8"),
        "rw",
        ("2", "0x280 + id", "1 or 255"),
        "bit 31 of sub 1 disables; transmission types 1 and, for idling, 255",
    ),
    RequiredObject(
        cia301.TPDO_MAPPING + 1,
        "TPDO2 mapping",
        4,
        ("u8", "u32"),
        "rw or const",
        ("4", "0x64010110", "0x64010210", "0x64010310", "0x64010410"),
        "constant, or writable in the order below",
    ),
    RequiredObject(
        cia301.ANALOGUE_INPUTS,
        "analogue inputs",
        4,
        ("u8", "i16"),
        "ro",
        ("4", "counts"),
        "any order; `electrodes` of the pad orders them",
    ),
    RequiredObject(
        0x2100,
        "excitation",
        0,
        ("u8",),
        "rw",
        ("1",),
        "only with `excitation_object`: 1 on, 0 off",
        optional=True,
    ),
)
