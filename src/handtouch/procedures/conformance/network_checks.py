"""Checks of NMT, heartbeat or node guarding, EMCY, and the LSS slave (CiA 305) of a node that has an id.

LSS is read only: nothing is configured or stored.
"""

from __future__ import annotations

import statistics
from itertools import pairwise

from handtouch.canbus import cia301
from handtouch.canbus.cia305 import LssAddress
from handtouch.canbus.find.lss import LssError, LssMaster
from handtouch.canbus.nodes.boot import read_errors
from handtouch.canbus.objects.emergency import ErrorLog
from handtouch.canbus.objects.sdo import BootStepError
from handtouch.procedures.conformance.node_link import MS
from handtouch.procedures.conformance.session import BOOT_TIMEOUT_NS, NodeSession

_HEARTBEATS = 10
_PERIOD_TOLERANCE = 0.1
_MAX_GAP_PERIODS = 2.0
_SILENCE_NS = 100 * MS
_SYNC_PERIOD_NS = 10 * MS
_GUARD_REQUESTS = 4


def check_heartbeat(session: NodeSession) -> None:
    """Check period, format and switching off of the heartbeat, or else node guarding."""
    link, report = session.link, session.report
    if not session.has_heartbeat:
        _check_guarding(session)
        return
    report.not_tested("the node sends heartbeats", "guarding.response")
    period_ms = session.node.heartbeat_ms
    before = len(link.heartbeats)
    link.wait(_HEARTBEATS * period_ms * MS + period_ms * MS // 2)
    beats = [beat for beat in link.heartbeats[before:] if beat.data != b"\0"]
    gaps_ms = [(b.arrival_ns - a.arrival_ns) / MS for a, b in pairwise(beats)]
    if len(gaps_ms) < 2:
        report.failed("heartbeat.period", f"{len(beats)} heartbeats in {_HEARTBEATS} periods")
    else:
        mean, worst = statistics.fmean(gaps_ms), max(gaps_ms)
        text = f"0x1017 = {period_ms} ms: mean {mean:.1f} ms, longest gap {worst:.1f} ms"
        off = abs(mean - period_ms) > _PERIOD_TOLERANCE * period_ms or worst > _MAX_GAP_PERIODS * period_ms
        hint = "; twice as often: two nodes with this id?" if mean < 0.7 * period_ms else ""
        report.assess("heartbeat.period", [text + hint] if off else [], text)
    try:
        session.sdo.write_verified(cia301.HEARTBEAT_TIME, 0, 0, "heartbeat time")
        link.wait(2 * MS)
        before = len(link.heartbeats)
        link.wait(3 * period_ms * MS)
        more = len(link.heartbeats) - before
        report.assess("heartbeat.off", [f"{more} heartbeats with 0x1017 = 0"] if more else [])
        session.sdo.write_verified(cia301.HEARTBEAT_TIME, 0, period_ms, "heartbeat time")
    except BootStepError as error:
        report.failed("heartbeat.off", str(error))


def check_states(session: NodeSession) -> None:
    """Check the NMT states and what the node sends in each; it ends in pre-operational."""
    link, report = session.link, session.report
    if not session.shows_state:
        why = "neither heartbeat nor guarding, so its NMT state can't be observed"
        report.not_tested(why, "nmt.preoperational", "nmt.operational", "nmt.stopped", "nmt.addressed")
        return
    state = session.enter(cia301.ENTER_PREOPERATIONAL, cia301.PREOPERATIONAL)
    problems = _describe_state(state, cia301.PREOPERATIONAL)
    pdos = sum(len(cycle.pdos) for cycle in link.send_syncs(_SYNC_PERIOD_NS, 10))
    if pdos:
        problems.append(f"{pdos} TPDOs in pre-operational")
    report.assess("nmt.preoperational", problems)

    state = session.enter(cia301.START_NODE, cia301.OPERATIONAL)
    problems = _describe_state(state, cia301.OPERATIONAL)
    if problems:
        problems += _describe_errors(session)
    report.assess("nmt.operational", problems)

    other = link.find_unused_id()
    sent_ns = link.send_nmt(cia301.STOP_NODE, other)
    later = session.observe_state(sent_ns + MS // 10, cia301.STOPPED)
    changed = later is not None and later != state
    report.assess("nmt.addressed", [f"a command to node {other} changes its state"] if changed else [])

    state = session.enter(cia301.STOP_NODE, cia301.STOPPED)
    problems = _describe_state(state, cia301.STOPPED)
    pdos = sum(len(cycle.pdos) for cycle in link.send_syncs(_SYNC_PERIOD_NS, 10))
    if pdos:
        problems.append(f"{pdos} TPDOs when stopped")
    if link.answers_sdo(_SILENCE_NS):
        problems.append("SDO responses when stopped")
    report.assess("nmt.stopped", problems)
    session.enter_preoperational()


def check_reset(session: NodeSession, name: str, command: int) -> None:
    """Check a reset; the node's power-on state is left by `start_heartbeat`."""
    link, report = session.link, session.report
    if not session.options.resets:
        report.not_tested("left out by --no-reset", name)
        return
    before = len(link.boot_ups)
    if not link.reset(command, BOOT_TIMEOUT_NS):
        report.failed(name, f"no boot-up message within {BOOT_TIMEOUT_NS // MS} ms")
        return
    link.wait(_SILENCE_NS)
    boots = len(link.boot_ups) - before
    problems = [f"{boots} boot-up messages"] if boots > 1 else []
    link.commanded_boots += boots - 1
    remark = ""
    try:
        time_ms = session.sdo.read_or_none(cia301.HEARTBEAT_TIME, 0, "heartbeat time")
        before_ms, _ = session.sdo.originals.get((cia301.HEARTBEAT_TIME, 0), (time_ms, 2))
        if time_ms != before_ms:
            remark = f"0x1017 is {time_ms} ms, {before_ms} ms at first; handtouch writes it after each boot"
    except BootStepError as error:
        problems.append(str(error))
    report.assess(name, problems, remark)
    session.start_heartbeat()


def summarise_errors(session: NodeSession) -> None:
    """Assess EMCY messages, error register, heartbeat format and unexpected boot-up messages."""
    link, report = session.link, session.report
    malformed = [f"{link.malformed_emergencies} EMCY messages without eight bytes"]
    problems = malformed if link.malformed_emergencies else []
    try:
        register = read_errors(session.sdo).register
        if link.emergencies and register is not None and link.emergencies[-1].register != register:
            latest = link.emergencies[-1].register
            problems.append(f"error register 0x{register:02X}, but 0x{latest:02X} in the latest EMCY message")
        if link.emergencies or problems:
            report.assess("emcy.format", problems)
        else:
            report.not_tested("the node sent no EMCY message", "emcy.format")
        report.assess("emcy.none", _describe_errors(session))
    except BootStepError as error:
        report.failed("emcy.none", str(error))
    legal = cia301.NMT_NAMES.keys()
    wrong = sorted({beat.data.hex() or "no data" for beat in link.heartbeats if beat.state not in legal})
    if link.heartbeats:
        report.assess("heartbeat.format", [f"heartbeats with {', '.join(wrong)}"] if wrong else [])
    boots = len(link.boot_ups) - link.commanded_boots
    report.assess("nmt.no_reboot", [f"{boots} boot-up messages without a reset"] if boots > 0 else [])


def _check_guarding(session: NodeSession) -> None:
    link, report = session.link, session.report
    report.not_tested("no heartbeat", "heartbeat.off")
    if _has_heartbeat_object(session):
        report.failed("heartbeat.period", "no heartbeat after 0x1017 was written")
        report.not_tested("the node has 0x1017", "guarding.response")
        return
    report.not_tested("no 0x1017", "heartbeat.period")
    start = len(link.heartbeats)
    for number in range(1, _GUARD_REQUESTS + 1):
        link.send_guard_request()
        expected = start + number
        link.wait(_SILENCE_NS, lambda expected=expected: len(link.heartbeats) >= expected)  # type: ignore[misc]
    toggles = [beat.data[0] >> 7 for beat in link.heartbeats[start:] if len(beat.data) == 1]
    problems = []
    if len(toggles) != _GUARD_REQUESTS:
        problems.append(f"{len(toggles)} responses to {_GUARD_REQUESTS} requests")
    elif any(a == b for a, b in pairwise(toggles)):
        problems.append("the toggle bit doesn't alternate")
    report.assess("guarding.response", problems)
    session.is_guarded = not problems


def _has_heartbeat_object(session: NodeSession) -> bool:
    try:
        return session.sdo.read_optional(cia301.HEARTBEAT_TIME, 0, "heartbeat time") is not None
    except BootStepError:
        return True


def _describe_state(state: int | None, expected: int) -> list[str]:
    if state == expected:
        return []
    name = "no NMT state" if state is None else cia301.NMT_NAMES.get(state, f"illegal NMT state {state}")
    return [f"{name} instead of {cia301.NMT_NAMES[expected]}"]


def _describe_errors(session: NodeSession) -> list[str]:
    """Describe the errors that the node reports, as the daemon does."""
    log = ErrorLog()
    for emergency in session.link.emergencies:
        log.add_emergency(emergency)
    log.add_report(read_errors(session.sdo, with_behaviour=True), session.link.now_ns())
    texts = [log.describe()] if log.register else []
    passing = [error.text for error in log.emergencies if error.cleared_ns is not None]
    return texts + [f"EMCY {text}, cleared" for text in passing]


def check_lss(session: NodeSession) -> None:
    """Check selection by 0x1018, the id returned, and deselection."""
    report, identity = session.report, session.report.identity
    names = ("lss.select", "lss.compares")
    why = ""
    if not session.options.lss:
        why = "left out by --no-lss"
    elif identity is None or None in (identity.product_code, identity.revision, identity.serial):
        why = "the identity is incomplete"
    if why or identity is None:
        report.not_tested(why, *names)
        return
    address = LssAddress(
        identity.vendor_id, identity.product_code or 0, identity.revision or 0, identity.serial or 0
    )
    master = LssMaster(session.link.exchange_lss, clock=session.link.now_ns)
    master.deselect_all()
    if not master.request_selection(address):
        master.deselect_all()
        report.not_tested("no response to LSS; needed only where LSS is to assign the node id", *names)
        return
    compares = not master.answers_contradiction()
    try:
        node_id = master.inquire_node_id(address)
        problems = [] if node_id == session.node.node_id else [f"returns node id {node_id}"]
        report.assess("lss.select", problems)
    except LssError as error:
        report.failed("lss.select", str(error))
    other = LssAddress(*address.parts[:3], address.serial ^ 1)
    is_wrong = master.request_selection(other)
    master.deselect_all()
    detail = (
        "" if compares else "in configuration state it responds to any fast scan, which `scan` copes with"
    )
    report.assess("lss.compares", [f"responds to serial number {other.serial}"] if is_wrong else [], detail)
