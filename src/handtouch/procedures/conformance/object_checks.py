"""Checks over SDO: server, identity, required objects, EDS."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from canopen.sdo import SdoAbortedError
from canopen.sdo.exceptions import SdoError

from handtouch.canbus import cia301
from handtouch.canbus.nodes.boot import check_identity, read_identity
from handtouch.canbus.objects.sdo import SDO_TIMEOUT_S, BootStepError
from handtouch.config import eds
from handtouch.config.eds_file import INTEGER_TYPES, raw_value
from handtouch.procedures.conformance.required_objects import REQUIRED_OBJECTS, RequiredObject
from handtouch.procedures.conformance.session import NodeSession

_NO_OBJECT, _NO_SUB = 0x06020000, 0x06090011
_READ_ONLY_CODES = frozenset({0x06010000, 0x06010002})
_LENGTH_CODES = frozenset({0x06070010, 0x06070012, 0x06070013})
_ABSENT_INDICES = (0x5FFE, 0x1F00, 0x9FFE)
"""Indices that hardly any node has."""
_CHANGED_HEARTBEAT_MS = 250
_MAX_PROBLEMS = 8


def check_server(session: NodeSession) -> bool:
    """Check that the node responds; return False if nothing else can be tested.

    A stopped node, as handtouch leaves its nodes when it ends, is made pre-operational first.
    """
    if not session.link.answers_sdo(round(SDO_TIMEOUT_S * 1e9)):
        session.leave_stopped()
    try:
        session.sdo.read_or_none(cia301.DEVICE_TYPE, 0, "device type")
    except BootStepError as error:
        valid = not session.link.client.violations
        session.report.failed("sdo.response" if valid else "sdo.protocol", str(error))
        return False
    return True


def check_identity_object(session: NodeSession) -> None:
    """Check 0x1018: readable, constant, with a serial number, and as configured."""
    report, sdo = session.report, session.sdo
    try:
        first = read_identity(sdo)
        session.link.settle()
        second = read_identity(sdo)
    except BootStepError as error:
        report.failed("identity.read", str(error))
        return
    report.identity = first
    missing = [name for key, name in cia301.IDENTITY_NAMES.items() if getattr(first, key) is None]
    if first != second:
        report.failed("identity.read", f"read {first}, then {second}: two nodes with this id?")
    elif missing:
        report.failed("identity.read", f"no {', '.join(missing)}")
    else:
        report.passed("identity.read", f"vendor 0x{first.vendor_id:X}, product 0x{first.product_code:X}")
    if not first.serial:
        report.failed("identity.serial", "serial number 0")
    else:
        report.passed("identity.serial", f"serial number {first.serial}")
    if not session.node.name:
        report.not_tested("no deployment; give --config", "identity.configured")
        return
    try:
        check_identity(first, session.node)
        report.passed("identity.configured")
    except BootStepError as error:
        report.failed("identity.configured", str(error))


def check_objects(session: NodeSession) -> None:
    """Check the required objects: read, length, refused writes, writes with values read back."""
    read_problems: list[str] = []
    access_problems: list[str] = []
    count = 0
    for row in _rows_of(session):
        for sub in range(row.last_sub + 1):
            try:
                data = session.link.client.upload(row.index, sub)
            except SdoError as error:
                if not row.optional or getattr(error, "code", 0) not in (_NO_OBJECT, _NO_SUB):
                    read_problems.append(f"0x{row.index:04X}:{sub:02X} {row.name}: {error}")
                break
            count += 1
            if len(data) != row.size_bytes(sub):
                sizes = f"{len(data)} bytes instead of {row.size_bytes(sub)}"
                read_problems.append(f"0x{row.index:04X}:{sub:02X} {row.name}: {sizes}")
            elif row.access == "ro" and row.index != cia301.ANALOGUE_INPUTS:
                access_problems += _write_to_read_only(session, row, sub, data)
    session.report.assess("objects.read", read_problems, f"{count} objects")
    session.report.assess("objects.read_only", access_problems)


def check_writing(session: NodeSession) -> None:
    """Check writing of the heartbeat time, with a wrong length, and of the excitation."""
    report, sdo, client = session.report, session.sdo, session.link.client
    try:
        time_ms = sdo.read_optional(cia301.HEARTBEAT_TIME, 0, "producer heartbeat time")
        if time_ms is None:
            report.not_tested("no 0x1017; see guarding.response", "objects.write")
            report.not_tested("no 0x1017", "sdo.length")
        else:
            sdo.write_verified(cia301.HEARTBEAT_TIME, 0, _CHANGED_HEARTBEAT_MS, "heartbeat time")
            report.passed("objects.write")
            report.assess("sdo.length", list(_write_wrong_length(session)))
            sdo.write_verified(cia301.HEARTBEAT_TIME, 0, time_ms, "heartbeat time")
    except BootStepError as error:
        report.failed("objects.write", str(error))
    excitation = session.node.excitation
    if excitation is None:
        report.not_tested("no excitation_object in the deployment", "excitation.switch")
    else:
        try:
            for value in (0, 1):
                sdo.write_verified(
                    excitation.index, excitation.sub, value, "excitation", excitation.size_bytes
                )
            report.passed("excitation.switch")
        except BootStepError as error:
            report.failed("excitation.switch", str(error))
    problems: list[str] = []
    tested = 0
    absent = [(index, 0, _NO_OBJECT) for index in _ABSENT_INDICES]
    for index, sub, code in (*absent, (cia301.IDENTITY, 5, _NO_SUB)):
        try:
            client.upload(index, sub)
        except SdoError as error:
            tested += isinstance(error, SdoAbortedError)
            problems += _unexpected(error, f"0x{index:04X}:{sub:02X}", code, (code,))
    report.assess("sdo.absent", problems, f"{tested} aborts")


def check_eds(session: NodeSession) -> None:
    """Check that the objects of the EDS exist with its types, and constants with its values."""
    report, path = session.report, session.node.eds
    if path is None:
        report.not_tested("no EDS; give --eds, or eds in the deployment", "eds.objects")
        return
    try:
        dictionary = eds.load_eds(path, session.node.node_id)
    except eds.EdsError as error:
        report.failed("eds.objects", str(error))
        return
    problems, count = [], 0
    for index, sub, variable in _variables(dictionary):
        if not variable.readable:
            continue
        count += 1
        try:
            data = session.link.client.upload(index, sub)
        except SdoError as error:
            if getattr(error, "code", 0) != 0x08000024:  # no data available
                problems.append(f"0x{index:04X}:{sub:02X}: {error}")
            continue
        kind = INTEGER_TYPES.get(variable.data_type)
        if kind is not None and 8 * len(data) != kind[0]:
            problems.append(f"0x{index:04X}:{sub:02X}: {len(data)} bytes instead of {kind[0] // 8}")
        listed = raw_value(dictionary, index, sub) if variable.access_type == "const" and kind else None
        value = int.from_bytes(data, "little")
        if listed is not None and value != listed:
            problems.append(f"0x{index:04X}:{sub:02X}: constant 0x{value:X} instead of 0x{listed:X}")
    more = [f"{len(problems) - _MAX_PROBLEMS} more"] if len(problems) > _MAX_PROBLEMS else []
    report.assess("eds.objects", problems[:_MAX_PROBLEMS] + more, f"{count} objects")


def summarise_transfers(session: NodeSession) -> None:
    """Assess what all transfers have shown: response times, violations, second responses."""
    link, report = session.link, session.report
    if report.identity is not None and (last := read_identity(session.sdo)) != report.identity:
        report.failed("identity.read", f"{report.identity} at first, {last} at the end: node replaced?")
    try:
        name = link.client.upload(cia301.DEVICE_NAME, 0)  # a name of more than four bytes: a segmented upload
        segmented = "" if len(name) <= 4 else ", segmented upload of 0x1008"
    except SdoError:  # the client counts lost responses
        segmented = ""
    link.settle()
    slowest = f"slowest {link.slowest_sdo_ns * 1e-6:.1f} ms of {SDO_TIMEOUT_S * 1e3:.0f} ms"
    lost = link.client.lost
    report.assess("sdo.response", [f"{lost} requests without a response"] if lost else [], slowest)
    violations = list(dict.fromkeys(link.client.violations))[:_MAX_PROBLEMS]
    report.assess("sdo.protocol", violations, f"expedited transfers{segmented}")
    stray = (
        f"{link.stray_responses} responses without a request: a second node with this id, or repeated frames"
    )
    report.assess("sdo.single", [stray] if link.stray_responses else [])


def _rows_of(session: NodeSession) -> Iterator[RequiredObject]:
    """Yield the required objects that don't depend on the mapping."""
    standard = {(channel.index, channel.sub) for channel in session.node.channels} == {
        (cia301.ANALOGUE_INPUTS, sub) for sub in (1, 2, 3, 4)
    }
    for row in REQUIRED_OBJECTS:
        is_pdo = cia301.TPDO_COMMUNICATION <= row.index < cia301.TPDO_MAPPING + cia301.MAX_TPDOS
        is_excitation = row.index >= 0x2000 and row.optional
        if is_pdo or is_excitation or (row.index == cia301.ANALOGUE_INPUTS and not standard):
            continue
        if row.index == cia301.HEARTBEAT_TIME and not session.has_heartbeat:
            continue  # it may be guarded instead
        yield row


def _write_to_read_only(session: NodeSession, row: RequiredObject, sub: int, data: bytes) -> Iterator[str]:
    """Write an object's present value, which changes nothing if it is accepted."""
    try:
        session.link.client.download(row.index, sub, data)
        yield f"0x{row.index:04X}:{sub:02X} {row.name} accepts a write"
    except SdoError as error:
        yield from _unexpected(error, f"0x{row.index:04X}:{sub:02X} {row.name}", 0x06010002, _READ_ONLY_CODES)


def _write_wrong_length(session: NodeSession) -> Iterator[str]:
    try:
        session.link.client.download(cia301.HEARTBEAT_TIME, 0, bytes((100, 0, 0, 0)))
        yield "0x1017:00, two bytes, accepts four"
    except SdoError as error:
        yield from _unexpected(error, "0x1017:00", 0x06070010, _LENGTH_CODES)
    after_ms = session.sdo.read(cia301.HEARTBEAT_TIME, 0, "producer heartbeat time")
    if after_ms != _CHANGED_HEARTBEAT_MS:
        yield f"0x1017:00 is {after_ms} after a write of the wrong length"


def _unexpected(error: SdoError, name: str, expected: int, allowed: Collection[int]) -> Iterator[str]:
    """Yield the problem unless an error is an abort with an allowed code."""
    if not isinstance(error, SdoAbortedError):
        yield f"{name}: {error}"
    elif error.code not in allowed:
        yield f"{name}: abort {error} instead of 0x{expected:08X}"


def _variables(dictionary: Any) -> Iterator[tuple[int, int, Any]]:
    """Yield index, sub-index and variable of every object from 0x1000 on."""
    for index in sorted(dictionary):
        if index < cia301.DEVICE_TYPE:
            continue
        entry = dictionary[index]
        subs = getattr(entry, "subindices", None)
        if subs is None:
            yield index, 0, entry
        else:
            yield from ((index, sub, subs[sub]) for sub in sorted(subs))
