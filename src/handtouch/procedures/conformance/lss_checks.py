"""Checks of the LSS slave (CiA 305) of a node that has an id; nothing is configured or stored."""

from __future__ import annotations

import struct

from handtouch.canbus import cia305
from handtouch.canbus.cia305 import LssAddress
from handtouch.canbus.find.lss import LssError, LssMaster
from handtouch.procedures.conformance.session import NodeSession

_WAIT_S = 0.05
_CONTRADICTION = 0x5A5A5A5A


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
    if not _select(session, address):
        _deselect(session)
        report.not_tested("no response to LSS; needed only where LSS is to assign the node id", *names)
        return
    compares = not _answers_other_scan(session)
    _deselect(session)
    try:
        node_id = LssMaster(session.link.exchange_lss).inquire_node_id(address)
        problems = [] if node_id == session.node.node_id else [f"returns node id {node_id}"]
        report.assess("lss.select", problems)
    except LssError as error:
        report.failed("lss.select", str(error))
    other = LssAddress(*address.parts[:3], address.serial ^ 1)
    is_wrong = _select(session, other)
    _deselect(session)
    detail = (
        "" if compares else "in configuration state it responds to any fast scan, which `scan` copes with"
    )
    report.assess("lss.compares", [f"responds to serial number {other.serial}"] if is_wrong else [], detail)


def _select(session: NodeSession, address: LssAddress) -> bool:
    """Select by an address from the waiting state; return True if there is a response."""
    _deselect(session)
    answer = None
    for command, value in zip(cia305.SELECT, address.parts, strict=True):
        last = command == cia305.SELECT[-1]
        answer = session.link.exchange_lss(struct.pack("<BI3x", command, value), _WAIT_S if last else 0.002)
    return answer is not None and answer[:1] == bytes((cia305.SELECTED,))


def _answers_other_scan(session: NodeSession) -> bool:
    request = struct.pack("<BIBBB", cia305.FAST_SCAN, _CONTRADICTION, 0, 3, 3)
    return session.link.exchange_lss(request, _WAIT_S) is not None


def _deselect(session: NodeSession) -> None:
    session.link.exchange_lss(struct.pack("<BB6x", cia305.SWITCH_GLOBAL, cia305.WAITING_STATE), 0.005)
