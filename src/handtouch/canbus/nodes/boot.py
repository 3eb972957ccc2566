"""What the master does to a node over SDO when it boots it, besides its mapping: identify and configure.

These block until the node answers, so they run in a worker thread of the master.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from handtouch.canbus.objects.channels import Object
from handtouch.canbus.objects.mapping import COMMUNICATION, Mapping, Tpdo
from handtouch.canbus.objects.sdo import Sdo, StepError

SYNCHRONOUS = 1
"""Transmission type: with every SYNC."""
EVENT_DRIVEN = 255
"""Transmission type: by the device profile's events."""
LIFE_TIME_FACTOR = 3
"""Guard times that a guarded node waits for our remote frame before it tells an error."""

_EVENT_DRIVEN = (254, EVENT_DRIVEN)  # by the maker's events, or the profile's
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
    """What the configuration says of a node; None is not checked. `foreign`: of other pads."""

    vendor_id: int | None = None
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None
    foreign: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class Idle:
    """What a node does while nothing touches its pad: sends when a channel moved, and now and then."""

    delta_counts: int
    period_ms: int
    inhibit_100us: int
    deltas: tuple[Object, ...]
    enable: Object | None


class Settings(Protocol):
    """What a node is configured with."""

    @property
    def heartbeat_ms(self) -> int: ...

    @property
    def idle(self) -> Idle | None: ...

    @property
    def excitation(self) -> Object | None: ...

    @property
    def event_timer_ms(self) -> int: ...


@dataclass(frozen=True, slots=True)
class Paced:
    """A node was made event-driven, or synchronous again."""

    idle: bool


@dataclass(frozen=True, slots=True)
class Configured:
    """What a node was made to do."""

    guarded: bool
    """it has no heartbeat and has to be asked for its state"""
    may_idle: bool
    """it can be made event-driven"""
    refusal: str = ""
    """what it refused, and what it does instead"""


def identify(sdo: Sdo) -> Identity:
    """Read 0x1018."""
    return Identity(
        sdo.read(_IDENTITY, 1, "vendor id"),
        sdo.read_optional(_IDENTITY, 2, "product code"),
        sdo.read_optional(_IDENTITY, 3, "revision"),
        sdo.read_optional(_IDENTITY, 4, "serial number"),
    )


def check_identity(identity: Identity, expected: Expected) -> None:
    """Raises StepError where a node is another than expected."""
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
    if identity.serial in expected.foreign:
        raise StepError(
            f"another pad's device: serial number {identity.serial} is configured for another pad; "
            "plug the nodes where they belong, or correct serial in the deployment",
            stranger=True,
        )


def configure(
    sdo: Sdo, mapping: Mapping, wanted: Settings, halt: Callable[[], None], booted: bool = False
) -> Configured:
    """Set what differs: PDOs enabled and synchronous, heartbeat time; each is read back.

    A node that can't follow SYNC sends as often by its event timer, if all its channels come in one PDO.
    A node without heartbeat gets it as guard time. One that has just `booted` is told its heartbeat time
    anyhow: another with its id may have answered in its place, and is known by its heartbeats alone. `halt`
    makes the node pre-operational; called only if a PDO must be changed, which many nodes refuse while they
    run.
    """
    if any(not tpdo.enabled or tpdo.transmission != SYNCHRONOUS for tpdo in mapping.tpdos):
        halt()
    refusal, single = "", len(mapping.tpdos) == 1  # several would come one by one
    for tpdo in mapping.tpdos:
        if tpdo.transmission != SYNCHRONOUS:
            try:
                _set_transmission(sdo, tpdo, SYNCHRONOUS)
            except StepError as error:
                if error.silent or not single or tpdo.transmission not in _EVENT_DRIVEN:
                    raise
                _set_event_timer(sdo, tpdo, wanted.event_timer_ms)
                refusal = f"sends every {wanted.event_timer_ms} ms by its event timer, not with SYNC: {error}"
        if not tpdo.enabled:
            _switch_on(sdo, tpdo)
    may_idle = wanted.idle is not None and single and not refusal
    if wanted.idle is not None and may_idle:
        try:
            prepare_idle(sdo, mapping.tpdos[0], wanted.idle, halt)
        except StepError as error:  # it does without
            if error.silent:
                raise
            may_idle, refusal = False, f"stays synchronous while idle: {error}"
            _switch_on(sdo, mapping.tpdos[0])
    excite(sdo, wanted.excitation, True)
    return Configured(_supervise(sdo, wanted.heartbeat_ms, booted), may_idle, refusal)


def prepare_idle(sdo: Sdo, tpdo: Tpdo, idle: Idle, halt: Callable[[], None]) -> None:
    """Set what an event-driven TPDO goes by: inhibit time, event timer, and the channels' deltas."""
    index = COMMUNICATION + tpdo.number - 1
    wanted = ((3, idle.inhibit_100us, "inhibit time"), (5, idle.period_ms, "event timer"))
    changes = [
        (sub, value, f"{what} of TPDO{tpdo.number}")
        for sub, value, what in wanted
        if sdo.read(index, sub, f"{what} of TPDO{tpdo.number}") != value
    ]
    if changes:  # CiA 301: not while the PDO is valid
        halt()
        with _switched_off(sdo, tpdo):
            for sub, value, what in changes:
                sdo.write(index, sub, value, 2, what)
    for delta in idle.deltas:
        sdo.set(delta.index, delta.sub, idle.delta_counts, delta.size, "delta of a channel")
    if idle.enable is not None:
        sdo.set(idle.enable.index, idle.enable.sub, 1, idle.enable.size, "sending of changes")


def set_pace(sdo: Sdo, tpdo: Tpdo, idle: bool) -> None:
    """Make a running node's TPDO event-driven (`idle`) or synchronous."""
    _set_transmission(sdo, tpdo, EVENT_DRIVEN if idle else SYNCHRONOUS)


def synchronous_request(tpdo: Tpdo) -> bytes:
    """The SDO request by which `set_pace` makes a TPDO synchronous: an expedited download of one byte."""
    return struct.pack("<BHBB3x", 0x2F, COMMUNICATION + tpdo.number - 1, 2, SYNCHRONOUS)


def excite(sdo: Sdo, excitation: Object | None, on: bool) -> None:
    """Switch the potential of a pad on or off, where the node can."""
    if excitation is not None:
        sdo.set(excitation.index, excitation.sub, int(on), excitation.size, "excitation")


def _set_transmission(sdo: Sdo, tpdo: Tpdo, kind: int) -> None:
    """Some nodes let it be changed only while the PDO is off."""
    index = COMMUNICATION + tpdo.number - 1
    what = f"transmission type of TPDO{tpdo.number}"
    try:
        sdo.write(index, 2, kind, 1, what)
    except StepError as error:
        if error.silent or not tpdo.enabled:
            raise
        with _switched_off(sdo, tpdo):
            sdo.write(index, 2, kind, 1, what)


def _set_event_timer(sdo: Sdo, tpdo: Tpdo, period_ms: int) -> None:
    """CiA 301: not while the PDO is valid."""
    index, what = COMMUNICATION + tpdo.number - 1, f"event timer of TPDO{tpdo.number}"
    if sdo.read(index, 5, what) != period_ms:
        with _switched_off(sdo, tpdo):
            sdo.write(index, 5, period_ms, 2, what)


@contextmanager
def _switched_off(sdo: Sdo, tpdo: Tpdo) -> Iterator[None]:
    """A TPDO isn't sent meanwhile; it is again afterwards, also if what was tried is refused."""
    try:
        sdo.write(COMMUNICATION + tpdo.number - 1, 1, tpdo.off, 4, _identifier(tpdo))
        yield
        _switch_on(sdo, tpdo)
    except StepError as error:
        if not error.silent:
            _switch_on(sdo, tpdo)
        raise


def _switch_on(sdo: Sdo, tpdo: Tpdo) -> None:
    sdo.set(COMMUNICATION + tpdo.number - 1, 1, tpdo.on, 4, _identifier(tpdo))


def _identifier(tpdo: Tpdo) -> str:
    return f"identifier of TPDO{tpdo.number}"


def _supervise(sdo: Sdo, period_ms: int, booted: bool) -> bool:
    """Set the heartbeat; where there is none, guarding. Returns whether it is guarding."""
    heartbeat = sdo.read_optional(_HEARTBEAT, 0, "heartbeat time")
    if heartbeat is not None:
        if booted or heartbeat != period_ms:
            sdo.write(_HEARTBEAT, 0, period_ms, 2, "heartbeat time")
        return False
    if sdo.read_optional(_GUARD_TIME, 0, "guard time") is not None:
        sdo.set(_GUARD_TIME, 0, period_ms, 2, "guard time")
        sdo.set(_LIFE_TIME, 0, LIFE_TIME_FACTOR, 1, "life time factor")
    return True
