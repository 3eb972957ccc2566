"""Checks of the LSS slave (CiA 305) of a node that has an id; nothing is configured or stored."""

from __future__ import annotations

from handtouch.canbus.cia305 import LssAddress
from handtouch.canbus.find.lss import LssError, LssMaster
from handtouch.procedures.conformance.session import NodeSession


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
