"""Constants and addresses of CiA 305, layer setting services (LSS)."""

from __future__ import annotations

from dataclasses import dataclass

UNCONFIGURED = 0xFF
"""Node id of an unconfigured node."""

# command specifiers
SWITCH_GLOBAL, SELECTED = 0x04, 0x44
SELECT = (0x40, 0x41, 0x42, 0x43)
CONFIGURE_ID, BIT_TIMING, STORE = 0x11, 0x13, 0x17
IDENTIFY = (0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B)
IDENTIFY_UNCONFIGURED, IS_SLAVE, IS_UNCONFIGURED = 0x4C, 0x4F, 0x50
FAST_SCAN, INQUIRE, INQUIRE_ID = 0x51, (0x5A, 0x5B, 0x5C, 0x5D), 0x5E

WAITING_STATE, CONFIGURATION_STATE = 0, 1
CONFIRM_BIT = 0x80
"""Bit number of a fast scan to which all unconfigured nodes respond, returning to the first part."""


@dataclass(frozen=True, order=True, slots=True)
class LssAddress:
    """Address of a node, object 0x1018: 128 bits that no two nodes share."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int

    @property
    def parts(self) -> tuple[int, int, int, int]:
        """Its four parts in the order of a fast scan."""
        return self.vendor_id, self.product_code, self.revision, self.serial

    def __str__(self) -> str:
        return (
            f"vendor 0x{self.vendor_id:X} product 0x{self.product_code:X} revision 0x{self.revision:X} "
            f"serial {self.serial}"
        )
