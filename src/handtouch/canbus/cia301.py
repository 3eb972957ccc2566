"""Constants of CiA 301: identifiers, NMT, object indices, PDO parameters.

Indices and identifiers that depend on a PDO's number or on a node id are given by their first value.
"""

from __future__ import annotations

# COB-IDs of the predefined connection set; those for a node id are added to it
NMT = 0x000
SYNC = 0x080
EMCY = 0x080
TIME = 0x100
SDO_RESPONSE = 0x580
SDO_REQUEST = 0x600
NMT_ERROR_CONTROL = 0x700
"""Boot-up, heartbeat and node guarding."""
LSS_RESPONSE = 0x7E4
LSS_REQUEST = 0x7E5

# NMT states, as in heartbeats, and commands
BOOT_UP, STOPPED, OPERATIONAL, PREOPERATIONAL = 0, 4, 5, 127
NMT_NAMES = {
    BOOT_UP: "boot-up",
    STOPPED: "stopped",
    OPERATIONAL: "operational",
    PREOPERATIONAL: "pre-operational",
}
START_NODE, STOP_NODE, ENTER_PREOPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130

# communication profile area
DEVICE_TYPE = 0x1000
DEVICE_TYPE_REQUEST = bytes((0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0))
"""SDO upload of the device type, which every node has."""
ERROR_REGISTER = 0x1001
ERROR_HISTORY = 0x1003
"""Pre-defined error field; sub-index 0: number of errors, 1: the latest."""
SYNC_COB_ID = 0x1005
DEVICE_NAME, HARDWARE_VERSION, SOFTWARE_VERSION = 0x1008, 0x1009, 0x100A
GUARD_TIME = 0x100C
LIFE_TIME_FACTOR = 0x100D
EMCY_COB_ID = 0x1014
HEARTBEAT_TIME = 0x1017
IDENTITY = 0x1018
IDENTITY_NAMES = {
    "vendor_id": "vendor id",
    "product_code": "product code",
    "revision": "revision",
    "serial": "serial number",
}
"""Fields of IDENTITY, sub-indices 1 to 4, with their names."""
SERIAL_SUB = 4
SYNC_OVERFLOW = 0x1019
"""Synchronous counter overflow value: SYNC carries a counter from 1 to it; 0: no counter."""
ERROR_BEHAVIOUR = 0x1029
"""Sub-index 1: reaction to a communication error."""
ERROR_REACTIONS = {0: "pre-operational", 1: "no change", 2: "stopped"}
"""Values of 0x1029: the NMT state that a node enters by itself upon an error."""
TPDO_COMMUNICATION = 0x1800
"""Sub-indices 1 to 5: identifier, transmission type, inhibit time, (reserved), event timer, SYNC
start value."""
SYNC_START_SUB = 6
"""Counter of the first SYNC that a TPDO with a counter counts its transmission type from."""
TPDO_MAPPING = 0x1A00
MAX_TPDOS = 512
PREDEFINED_TPDOS = 4
"""TPDO1 to TPDO4 have identifiers in the predefined connection set."""
ANALOGUE_INPUTS = 0x6401
"""CiA 401: read analogue input, 16 bit."""

# an identifier in an object such as 0x1800 sub 1
INVALID_BIT = 1 << 31
NO_RTR_BIT = 1 << 30
EXTENDED_BIT = 1 << 29
IDENTIFIER_MASK = 0x7FF

# transmission types
SYNCHRONOUS = 1
"""With every SYNC."""
SYNCHRONOUS_TYPES = range(241)
EVENT_DRIVEN = 255
"""By the events of the device profile; 254: by those of the manufacturer."""
EVENT_DRIVEN_TYPES = (254, EVENT_DRIVEN)
DUMMY_ENTRIES = range(1, 0x20)
"""Indices of data types: mapping entries that only fill a PDO."""
PDO_BYTES = SDO_BYTES = 8


def tpdo_identifier(number: int) -> int:
    """Return the first identifier of TPDO `number` (1 to 4) in the predefined connection set."""
    return 0x80 + 0x100 * number


def object_bytes(index: int, sub: int) -> int | None:
    """Return the size of an object of the communication profile, None for others.

    A response may leave it out (CiA 301: e = 1, s = 0), and then carries bytes that mean nothing behind the
    value.
    """
    if TPDO_MAPPING <= index < TPDO_MAPPING + MAX_TPDOS:
        return 4 if sub else 1
    if TPDO_COMMUNICATION <= index < TPDO_COMMUNICATION + MAX_TPDOS:
        return {0: 1, 1: 4, 2: 1, 3: 2, 4: 1, 5: 2, SYNC_START_SUB: 1}.get(sub)
    if index in (ERROR_HISTORY, IDENTITY):
        return 4 if sub else 1
    return {
        DEVICE_TYPE: 4,
        ERROR_REGISTER: 1,
        SYNC_COB_ID: 4,
        GUARD_TIME: 2,
        LIFE_TIME_FACTOR: 1,
        EMCY_COB_ID: 4,
        HEARTBEAT_TIME: 2,
        SYNC_OVERFLOW: 1,
        ERROR_BEHAVIOUR: 1,
    }.get(index)
