"""What the master does to a node over SDO when it boots it, besides its mapping: identify and configure.

These block until the node answers, so they run in a worker thread of the master.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .mapping import COMMUNICATION, NOT_VALID, Mapping
from .sdo import Sdo, StepError

SYNCHRONOUS = 1
"""Transmission type: with every SYNC."""
LIFE_TIME_FACTOR = 3
"""Guard times that a guarded node waits for our remote frame before it tells an error."""

_IDENTITY, _HEARTBEAT, _GUARD_TIME, _LIFE_TIME = 0x1018, 0x1017, 0x100C, 0x100D


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 0x1018; None where the node hasn't the sub-index."""

    vendor_id: int
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class Expected:
    """What the configuration says of a node; None is not checked."""

    vendor_id: int | None = None
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class Configured:
    """What a node was made to do."""

    guarded: bool
    """it has no heartbeat and has to be asked for its state"""


def identify(sdo: Sdo, expected: Expected) -> Identity:
    """Read 0x1018. Raises StepError where it differs from what is expected."""
    identity = Identity(
        sdo.read(_IDENTITY, 1, "vendor id"),
        sdo.read_optional(_IDENTITY, 2, "product code"),
        sdo.read_optional(_IDENTITY, 3, "revision"),
        sdo.read_optional(_IDENTITY, 4, "serial number"),
    )
    for what, key, found, wanted in (
        ("vendor id", "vendor_id", identity.vendor_id, expected.vendor_id),
        ("product code", "product_code", identity.product_code, expected.product_code),
        ("revision", "revision", identity.revision, expected.revision),
        ("serial number", "serial", identity.serial, expected.serial),
    ):
        if wanted is not None and found != wanted:
            told = "none" if found is None else f"{found} (0x{found:X})"
            raise StepError(
                f"another device: {what} is {told}, configured is {wanted} (0x{wanted:X}); "
                f"put the right node there, or correct {key} in the deployment",
                stranger=True,
            )
    return identity


def configure(sdo: Sdo, mapping: Mapping, heartbeat_ms: int, halt: Callable[[], None]) -> Configured:
    """Set what differs: PDOs enabled and synchronous, heartbeat time; each is read back.

    A node without heartbeat gets it as guard time. `halt` makes the node pre-operational; called only if a
    PDO must be changed, which many nodes refuse while they run.
    """
    if any(not tpdo.enabled or tpdo.transmission != SYNCHRONOUS for tpdo in mapping.tpdos):
        halt()
    for tpdo in mapping.tpdos:
        index = COMMUNICATION + tpdo.number - 1
        if tpdo.transmission != SYNCHRONOUS:
            _set_transmission(sdo, index, tpdo.number, tpdo.cob_id, tpdo.enabled)
        if not tpdo.enabled or tpdo.transmission != SYNCHRONOUS:
            sdo.set(index, 1, tpdo.cob_id, 4, f"identifier of TPDO{tpdo.number}")
    return Configured(_supervise(sdo, heartbeat_ms))


def _set_transmission(sdo: Sdo, index: int, number: int, cob_id: int, enabled: bool) -> None:
    """Some nodes let it be changed only while the PDO is off."""
    what = f"transmission type of TPDO{number}"
    try:
        sdo.write(index, 2, SYNCHRONOUS, 1, what)
    except StepError as error:
        if error.silent or not enabled:
            raise
        sdo.write(index, 1, NOT_VALID | cob_id, 4, f"identifier of TPDO{number}")
        sdo.write(index, 2, SYNCHRONOUS, 1, what)


def _supervise(sdo: Sdo, period_ms: int) -> bool:
    """Set the heartbeat; where there is none, guarding. Returns whether it is guarding."""
    heartbeat = sdo.read_optional(_HEARTBEAT, 0, "heartbeat time")
    if heartbeat is not None:
        if heartbeat != period_ms:
            sdo.write(_HEARTBEAT, 0, period_ms, 2, "heartbeat time")
        return False
    if sdo.read_optional(_GUARD_TIME, 0, "guard time") is not None:
        sdo.set(_GUARD_TIME, 0, period_ms, 2, "guard time")
        sdo.set(_LIFE_TIME, 0, LIFE_TIME_FACTOR, 1, "life time factor")
    return True
