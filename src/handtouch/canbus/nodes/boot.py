"""Boot steps of a node over SDO, besides its mapping: identification and configuration.

They block until the node responds, so they run in a worker thread of the master.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from handtouch.canbus import cia301
from handtouch.canbus.nodes.spec import Identity, IdleSettings, NodeSpec
from handtouch.canbus.objects.emergency import ReportedErrors
from handtouch.canbus.objects.mapping import LENGTH_BIT_7, NodeTpdo, PdoMapping
from handtouch.canbus.objects.sdo import BootStepError, NodeSdoClient
from handtouch.config.channels import WritableObject

LIFE_TIME_FACTOR = 30
"""Guard times without a guarding request after which a guarded node leaves OPERATIONAL; longer than a pause
of the host.
"""

MAX_HISTORY = 8
"""Entries of the error history that are read; the latest come first."""


@dataclass(frozen=True, slots=True)
class Identification:
    """Result of `identify_node`."""

    identity: Identity
    errors: ReportedErrors


@dataclass(frozen=True, slots=True)
class NodeConfigured:
    """Result of `configure_node`."""

    guarded: bool
    """the node has no heartbeat and needs guarding requests"""
    can_idle: bool
    """it can be made event-driven"""
    refusal: str = ""
    """setting that it refused, and the one used instead"""
    event_timed: bool = False
    """it is sent by its event timer, not with SYNC"""


def read_identity(sdo: NodeSdoClient, expected: NodeSpec | None = None) -> Identity:
    """Read 0x1018; raises BootStepError where the node doesn't answer what is expected."""
    (_, first), *further = cia301.IDENTITY_NAMES.items()
    optional = (
        sdo.read_if_present(cia301.IDENTITY, sub, name, needed=getattr(expected, key, None) is not None)
        for sub, (key, name) in enumerate(further, 2)
    )
    return Identity(sdo.read(cia301.IDENTITY, 1, first), *optional)


def identify_node(sdo: NodeSdoClient, expected: NodeSpec) -> Identification:
    """Read 0x1018, and the errors that the node reports.

    Raises BootStepError where the node doesn't answer what tells whether it is the expected one: it may be
    busy, or frames may be lost.
    """
    return Identification(read_identity(sdo, expected), read_errors(sdo))


def check_identity(identity: Identity, expected: NodeSpec) -> None:
    """Raise BootStepError unless a node is the expected one, and none of another pad."""
    owner = expected.serials_of_other_pads.get(identity.serial or 0)
    for sub, (key, name) in enumerate(cia301.IDENTITY_NAMES.items(), 1):
        actual, configured = getattr(identity, key), getattr(expected, key)
        if configured is not None and actual != configured and not (owner and key == "serial"):
            refused = f"none, as 0x1018:{sub:02} is refused by the node"
            value = refused if actual is None else f"{actual} (0x{actual:X})"
            raise BootStepError(
                f"identity mismatch: {name} is {value}, configured is {configured} (0x{configured:X}); "
                f"connect the configured node, or correct {key} in the deployment",
                wrong_device=True,
            )
    if owner:
        raise BootStepError(
            f"identity mismatch: serial number is {identity.serial} (0x{identity.serial:X}), which is "
            f"configured for {owner}; connect nodes and CAN adapters as configured: are two swapped? "
            "Or correct serial in the deployment",
            wrong_device=True,
        )


def read_errors(sdo: NodeSdoClient, with_behaviour: bool = False) -> ReportedErrors:
    """Read error register and history, and `with_behaviour` 0x1029; refusals count as missing objects."""
    register = sdo.read_if_present(cia301.ERROR_REGISTER, 0, "error register")
    count = sdo.read_if_present(cia301.ERROR_HISTORY, 0, "error history") or 0
    entries = (
        sdo.read_or_none(cia301.ERROR_HISTORY, sub, "error history")
        for sub in range(1, min(count, MAX_HISTORY) + 1)
    )
    history = tuple(entry for entry in entries if entry is not None)
    behaviour = sdo.read_or_none(cia301.ERROR_BEHAVIOUR, 1, "error behaviour") if with_behaviour else None
    return ReportedErrors(register, history, behaviour)


def check_settings(
    sdo: NodeSdoClient, mapping: PdoMapping, heartbeat_ms: int | None, event_driven: bool
) -> None:
    """Raise BootStepError with the object that isn't as configured: mapping, PDO parameters, heartbeat time.

    `heartbeat_ms` is None for a guarded node; `event_driven` if its TPDO isn't sent with SYNC.
    """
    for tpdo in mapping.tpdos:
        index, number = cia301.TPDO_MAPPING + tpdo.number - 1, tpdo.number
        _check_value(sdo, index, 0, len(tpdo.entries), f"number of objects mapped in TPDO{number}")
        for sub, entry in enumerate(tpdo.entries, 1):
            same = (entry, entry | LENGTH_BIT_7)
            _check_value(sdo, index, sub, entry, f"mapping of TPDO{number}", same, form="0x{:08X}")
        _check_cob_id(sdo, tpdo)
        index = cia301.TPDO_COMMUNICATION + number - 1
        allowed = cia301.EVENT_DRIVEN_TYPES if event_driven else (_synchronous_type(mapping),)
        _check_value(sdo, index, 2, allowed[-1], f"transmission type of TPDO{number}", allowed)
    for tpdo, state in zip(mapping.tpdos, mapping.states, strict=False):
        index, name = cia301.TPDO_COMMUNICATION + tpdo.number - 1, f"SYNC start value of TPDO{tpdo.number}"
        _check_value(sdo, index, cia301.SYNC_START_SUB, state + 1, name)
    if not event_driven:
        _check_sync_identifier(sdo)
    if heartbeat_ms is not None:
        _check_value(sdo, cia301.HEARTBEAT_TIME, 0, heartbeat_ms, "heartbeat time")


def _check_sync_identifier(sdo: NodeSdoClient) -> None:
    """Check the identifier that a node takes for SYNC; another one is replaced before the error is raised."""
    name = "COB-ID of SYNC"
    entry = sdo.read_if_present(cia301.SYNC_COB_ID, 0, name)
    if entry is None or entry & cia301.IDENTIFIER_MASK == cia301.SYNC:
        return
    sent = f"0x{cia301.SYNC:X}"
    difference = (
        f"0x1005:00, {name}, is 0x{entry & cia301.IDENTIFIER_MASK:X}, and SYNC is sent with {sent}; "
        f"write {sent} and store it"
    )
    try:
        sdo.write_verified(cia301.SYNC_COB_ID, 0, cia301.SYNC, name)
    except BootStepError as error:
        if error.timed_out:
            raise
        raise BootStepError(f"{difference}, which the node refuses now: {error}") from error
    raise BootStepError(difference)


def _check_cob_id(sdo: NodeSdoClient, tpdo: NodeTpdo) -> None:
    """Check a COB-ID; another identifier is replaced by the former one before the error is raised.

    CiA 301 allows that only while the PDO is disabled, which it stays until the node is configured.
    """
    index, name = cia301.TPDO_COMMUNICATION + tpdo.number - 1, f"COB-ID of TPDO{tpdo.number}"
    try:
        _check_value(sdo, index, 1, tpdo.enabled_entry, name, form="0x{:X}")
    except BootStepError as error:
        entry = sdo.read_tpdo(tpdo.number, 1)
        if not error.timed_out and entry & cia301.IDENTIFIER_MASK != tpdo.cob_id:
            sdo.write_if_different(index, 1, entry | cia301.INVALID_BIT, name)
            sdo.write_tpdo(tpdo.number, 1, tpdo.disabled_entry)
        raise


def _check_value(
    sdo: NodeSdoClient,
    index: int,
    sub: int,
    expected: int,
    name: str,
    allowed: tuple[int, ...] = (),
    form: str = "{}",
) -> None:
    value = sdo.read(index, sub, name)
    if value != expected and value not in allowed:
        raise BootStepError(
            f"0x{index:04X}:{sub:02X}, {name}, is {form.format(value)} instead of {form.format(expected)}"
        )


def configure_node(
    sdo: NodeSdoClient,
    mapping: PdoMapping,
    settings: NodeSpec,
    enter_preoperational: Callable[[], None],
    booted: bool = False,
) -> NodeConfigured:
    """Write what differs, and read it back: PDOs enabled and synchronous, heartbeat time.

    A node that can't follow SYNC sends at the same rate by its event timer if all its channels are in one
    PDO. A node without heartbeat gets the heartbeat time as its guard time. The heartbeat time is always
    written to a node that has just `booted`: another node with the same id may have responded instead, and
    only its heartbeats reveal it. `enter_preoperational` is called only if a PDO must be changed, which many
    nodes refuse in state operational.
    """
    synchronous = _synchronous_type(mapping)
    if any(not tpdo.enabled or tpdo.transmission_type != synchronous for tpdo in mapping.tpdos):
        enter_preoperational()
    _set_up_schedule(sdo, mapping, settings.sync_overflow, enter_preoperational)
    refusal, event_timed = "", False
    single = len(mapping.tpdos) == 1  # several event-driven PDOs would not form one sample
    for tpdo in mapping.tpdos:
        if tpdo.transmission_type != synchronous:
            try:
                _set_type_while_disabled(sdo, tpdo, synchronous)
            except BootStepError as error:
                if error.timed_out or not single or tpdo.transmission_type not in cia301.EVENT_DRIVEN_TYPES:
                    raise
                _set_event_timer(sdo, tpdo, settings.event_timer_ms)
                event_timed = True
                refusal = (
                    f"sends every {settings.event_timer_ms} ms by its event timer, not with SYNC: {error}"
                )
        if settings.idle is None:
            _end_inhibition(sdo, tpdo, enter_preoperational)
        if not tpdo.enabled:
            _enable_tpdo(sdo, tpdo)
    can_idle = settings.idle is not None and single and not refusal
    if settings.idle is not None and can_idle:
        try:
            prepare_idle(sdo, mapping.tpdos[0], settings.idle, enter_preoperational)
        except BootStepError as error:
            if error.timed_out:
                raise
            can_idle, refusal = False, f"stays synchronous while idle: {error}"
            _enable_tpdo(sdo, mapping.tpdos[0])
    set_excitation(sdo, settings.excitation, True)
    guarded = _set_up_supervision(sdo, settings.heartbeat_ms, booted)
    return NodeConfigured(guarded, can_idle, refusal, event_timed)


def prepare_idle(
    sdo: NodeSdoClient, tpdo: NodeTpdo, idle: IdleSettings, enter_preoperational: Callable[[], None]
) -> None:
    """Write the settings of an event-driven TPDO: inhibit time, event timer, and the channels' deltas."""
    settings = ((3, idle.inhibit_100us), (5, idle.period_ms))
    changes = [(sub, value) for sub, value in settings if sdo.read_tpdo(tpdo.number, sub) != value]
    if changes:  # CiA 301: not while the PDO is valid
        enter_preoperational()
        with _tpdo_disabled(sdo, tpdo):
            for sub, value in changes:
                sdo.write_tpdo(tpdo.number, sub, value)
    for delta in idle.delta_objects:
        sdo.set_object(delta, idle.delta_counts, "delta of a channel")
    if idle.enable_object is not None:
        sdo.set_object(idle.enable_object, 1, "enabling of events")


def set_transmission(sdo: NodeSdoClient, tpdo: NodeTpdo, idle: bool) -> None:
    """Make a running node's TPDO event-driven (`idle`) or synchronous."""
    _set_transmission_type(sdo, tpdo, cia301.EVENT_DRIVEN if idle else cia301.SYNCHRONOUS)


def synchronous_request(tpdo: NodeTpdo) -> bytes:
    """Return the SDO request that makes a TPDO synchronous: an expedited download of one byte."""
    return struct.pack("<BHBB3x", 0x2F, cia301.TPDO_COMMUNICATION + tpdo.number - 1, 2, cia301.SYNCHRONOUS)


def set_excitation(sdo: NodeSdoClient, excitation: WritableObject | None, on: bool) -> None:
    """Switch the excitation of a pad on or off, where the node supports it."""
    if excitation is not None:
        sdo.set_object(excitation, int(on), "excitation")


def _set_transmission_type(sdo: NodeSdoClient, tpdo: NodeTpdo, kind: int) -> None:
    """Write a running node's TPDO's transmission type, with the TPDO disabled where the node requires
    that."""
    try:
        sdo.write_tpdo(tpdo.number, 2, kind)
    except BootStepError as error:
        if error.timed_out or not tpdo.enabled:
            raise
        with _tpdo_disabled(sdo, tpdo):
            sdo.write_tpdo(tpdo.number, 2, kind)


def _set_type_while_disabled(sdo: NodeSdoClient, tpdo: NodeTpdo, kind: int) -> None:
    """Write a TPDO's transmission type while the TPDO is disabled: some nodes take it over when it is
    enabled."""
    if tpdo.enabled:
        try:
            with _tpdo_disabled(sdo, tpdo):
                sdo.write_tpdo(tpdo.number, 2, kind)
        except BootStepError as error:
            if error.timed_out:
                raise
        else:
            return
    sdo.write_tpdo(tpdo.number, 2, kind)


def _end_inhibition(sdo: NodeSdoClient, tpdo: NodeTpdo, enter_preoperational: Callable[[], None]) -> None:
    """Set a TPDO's inhibit time to 0: some nodes omit synchronous samples within it."""
    index, name = cia301.TPDO_COMMUNICATION + tpdo.number - 1, f"inhibit time of TPDO{tpdo.number}"
    if sdo.read_if_present(index, 3, name):
        enter_preoperational()
        with _tpdo_disabled(sdo, tpdo):
            sdo.write_tpdo(tpdo.number, 3, 0)


def _synchronous_type(mapping: PdoMapping) -> int:
    """Return the transmission type of TPDOs sent with SYNC: with each, or once in a schedule."""
    return len(mapping.states) or cia301.SYNCHRONOUS


def _set_up_schedule(
    sdo: NodeSdoClient, mapping: PdoMapping, sync_overflow: int, enter_preoperational: Callable[[], None]
) -> None:
    """Have the node expect the counter in SYNC, and send the TPDO of each state at its counts alone.

    Raises BootStepError for a node with a schedule that doesn't have the objects; others may lack the first.
    """
    if not sync_overflow:
        return
    name = "SYNC counter overflow"
    overflow = sdo.read_optional(cia301.SYNC_OVERFLOW, 0, name)
    if overflow is None and mapping.states:
        raise BootStepError(
            "has no 0x1019, SYNC counter overflow, so that it can't follow switch_states; use a node that "
            "counts SYNCs, or leave switch_states out of the deployment"
        )
    if overflow is not None and overflow != sync_overflow:
        enter_preoperational()
        sdo.write_verified(cia301.SYNC_OVERFLOW, 0, sync_overflow, name)
    for tpdo, state in zip(mapping.tpdos, mapping.states, strict=False):
        if sdo.read_tpdo(tpdo.number, cia301.SYNC_START_SUB) != state + 1:
            enter_preoperational()
            with _tpdo_disabled(sdo, tpdo):  # CiA 301: not while the PDO is valid
                sdo.write_tpdo(tpdo.number, cia301.SYNC_START_SUB, state + 1)


def _set_event_timer(sdo: NodeSdoClient, tpdo: NodeTpdo, period_ms: int) -> None:
    """Write a TPDO's event timer, with the TPDO disabled as CiA 301 requires."""
    if sdo.read_tpdo(tpdo.number, 5) != period_ms:
        with _tpdo_disabled(sdo, tpdo):
            sdo.write_tpdo(tpdo.number, 5, period_ms)


@contextmanager
def _tpdo_disabled(sdo: NodeSdoClient, tpdo: NodeTpdo) -> Iterator[None]:
    """Disable a TPDO, and enable it again afterwards, even if the node refuses a write in between."""
    try:
        sdo.write_tpdo(tpdo.number, 1, tpdo.disabled_entry)
        yield
        _enable_tpdo(sdo, tpdo)
    except BootStepError as error:
        if not error.timed_out:
            _enable_tpdo(sdo, tpdo)
        raise


def _enable_tpdo(sdo: NodeSdoClient, tpdo: NodeTpdo) -> None:
    if sdo.read_tpdo(tpdo.number, 1) != tpdo.enabled_entry:
        sdo.write_tpdo(tpdo.number, 1, tpdo.enabled_entry)


def _set_up_supervision(sdo: NodeSdoClient, period_ms: int, booted: bool) -> bool:
    """Set the heartbeat time, or the guard time of a node without heartbeat; return True for guarding."""
    heartbeat = sdo.read_optional(cia301.HEARTBEAT_TIME, 0, "heartbeat time")
    if heartbeat is not None:
        if booted or heartbeat != period_ms:
            sdo.write_verified(cia301.HEARTBEAT_TIME, 0, period_ms, "heartbeat time")
        return False
    if sdo.read_optional(cia301.GUARD_TIME, 0, "guard time") is not None:
        sdo.write_if_different(cia301.GUARD_TIME, 0, period_ms, "guard time")
        sdo.write_if_different(cia301.LIFE_TIME_FACTOR, 0, LIFE_TIME_FACTOR, "life time factor")
    return True
