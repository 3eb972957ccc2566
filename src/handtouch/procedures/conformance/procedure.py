"""The procedure: wait for a silent bus, find the nodes, test each, restore it.

Public names: `run_checks`, `compare_serials`, `find_nodes`, `check_bus_is_free`, `BusInUseError`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from handtouch.canbus import cia301
from handtouch.canbus.objects.sdo import BootStepError
from handtouch.procedures.conformance import (
    network_checks,
    object_checks,
    operator_checks,
    pdo_checks,
)
from handtouch.procedures.conformance.line import Line
from handtouch.procedures.conformance.node_link import MS, NodeLink, is_from_master
from handtouch.procedures.conformance.results import NodeReport
from handtouch.procedures.conformance.session import ConformanceOptions, NodeSession, NodeUnderTest
from handtouch.procedures.dialogue import Dialogue

LISTEN_NS = 1000 * MS
_PROBE_NS = 300 * MS
_MASTER_NAMES = {
    cia301.NMT: "an NMT master",
    cia301.SYNC: "a SYNC producer",
    cia301.LSS_REQUEST: "an LSS master",
}


class BusInUseError(Exception):
    """Another master is active on the bus; `str` names it, with a remedy."""

    exit_status = 1


def check_bus_is_free(line: Line, name: str, listen_ns: int = LISTEN_NS) -> set[int]:
    """Listen before the first frame is sent; return the node ids of the heartbeats received.

    Raises BusInUseError if another master is active.
    """
    end_ns = line.now_ns() + listen_ns
    found: set[int] = set()
    heard: set[int] = set()
    while (frame := line.receive(end_ns)) is not None:
        if 0 < frame[0] - cia301.NMT_ERROR_CONTROL < 128:
            heard.add(frame[0] - cia301.NMT_ERROR_CONTROL)
        if is_from_master(frame[0]):
            found.add(frame[0])
        if frame[2] > end_ns:
            break
    if found:
        raise BusInUseError(_describe_masters(name, found))
    return heard


def find_nodes(line: Line, ids: Iterable[int] = range(1, 128)) -> list[int]:
    """Return the node ids that respond to a request for 0x1000, with its value or an abort."""
    requested = set(ids)
    for node_id in sorted(requested):
        line.send(cia301.SDO_REQUEST + node_id, cia301.DEVICE_TYPE_REQUEST)
    found: set[int] = set()
    end_ns = line.now_ns() + _PROBE_NS
    while found < requested and (frame := line.receive(end_ns)) is not None:
        if 0 < frame[0] - cia301.SDO_RESPONSE < 128:
            found.add(frame[0] - cia301.SDO_RESPONSE)
        if frame[2] > end_ns:
            break
    return sorted(found & requested)


def run_checks(
    line: Line,
    node: NodeUnderTest,
    options: ConformanceOptions,
    progress: Callable[[str], None] = lambda _: None,
    operator: Dialogue | None = None,
) -> NodeReport:
    """Test one node and set back what was changed.

    Raises BusInUseError if another master sends frames meanwhile (not on buses that echo sent frames).
    """
    link = NodeLink(line, node.node_id)
    session = NodeSession(link, node, options, progress, operator)
    report = session.report
    progress("SDO server")
    if not object_checks.check_server(session):
        report.complete("the node doesn't respond to SDO requests")
        return report
    try:
        _run_stages(session)
    finally:
        progress("restoring")
        report.restore_problem = session.restore()
    if link.foreign:
        raise BusInUseError(_describe_masters(node.bus, link.foreign))
    report.complete("an earlier check failed")
    return report


def compare_serials(reports: Sequence[NodeReport]) -> None:
    """Fail the check of the serial number where several nodes have the same."""
    users: dict[tuple[int, int | None, int], list[NodeReport]] = {}
    for report in reports:
        identity = report.identity
        if identity is not None and identity.serial:
            key = (identity.vendor_id, identity.product_code, identity.serial)
            users.setdefault(key, []).append(report)
    for (_, _, serial), same in users.items():
        ids = [report.node_id for report in same]
        for report in same:
            others = [str(node_id) for node_id in ids if node_id != report.node_id]
            if others:
                report.failed("identity.serial", f"{serial} is also that of node {', '.join(others)}")


def _run_stages(session: NodeSession) -> None:
    """Run the checks in an order in which none spoils the next."""
    session.start_heartbeat()
    session.enter_preoperational()
    stages: tuple[tuple[str, Callable[[NodeSession], None]], ...] = (
        ("identity", object_checks.check_identity_object),
        ("objects", object_checks.check_objects),
        ("writing", object_checks.check_writing),
        ("EDS", object_checks.check_eds),
        ("mapping", pdo_checks.check_mapping),
        ("PDO configuration", pdo_checks.configure),
        ("heartbeat", network_checks.check_heartbeat),
        ("NMT states", network_checks.check_states),
        ("TPDOs", pdo_checks.check_stream),
        ("LSS", network_checks.check_lss),
        ("NMT reset communication", _reset_communication),
        ("errors", network_checks.summarise_errors),
        ("operator", operator_checks.check_with_operator),
        ("NMT reset node", _reset_node),
        ("SDO protocol", object_checks.summarise_transfers),
    )
    for name, check in stages:
        session.progress(name)
        try:
            check(session)
        except BootStepError as error:  # in a step that is not itself a check
            session.report.failed("sdo.response", f"{name}: {error}")


def _reset_communication(session: NodeSession) -> None:
    network_checks.check_reset(session, "nmt.reset_communication", cia301.RESET_COMMUNICATION)


def _reset_node(session: NodeSession) -> None:
    network_checks.check_reset(session, "nmt.reset_node", cia301.RESET_NODE)


def _describe_masters(bus: str, found: set[int]) -> str:
    names = ", ".join(
        sorted({_MASTER_NAMES.get(can_id, f"an SDO client of node {can_id & 0x7F}") for can_id in found})
    )
    return (
        f"{bus}: {names} is active on this bus; stop it first: the daemon (Ctrl-C, or systemctl stop "
        "handtouch), another master, a configuration tool"
    )
