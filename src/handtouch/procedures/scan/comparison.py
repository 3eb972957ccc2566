"""Comparison of the nodes that a scan found with a deployment.

Public names: `compare_nodes`, `NodeComparison`, `nodes_without_pad`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from handtouch import config
from handtouch.canbus import cia301
from handtouch.canbus.find.survey import NodeFacts
from handtouch.config import channels
from handtouch.procedures.scan.bus_scan import BusReport
from handtouch.procedures.scan.fragment import FoundNodes


@dataclass(frozen=True, slots=True)
class NodeComparison:
    """A node that was found or expected, with its pad and its problem; both empty if there is none."""

    bus: str
    node_id: int
    pad: str
    problem: str = ""
    remark: str = ""


def compare_nodes(deployment: config.Deployment | None, reports: Sequence[BusReport]) -> list[NodeComparison]:
    """Compare each node found with its pad in the deployment; pads without a node are included."""
    serials = {
        node.serial: f"node {node.node_id} on {report.bus.name}"
        for report in reports
        for node in report.nodes
        if node.serial
    }
    return [comparison for report in reports for comparison in _compare_bus(deployment, report, serials)]


def nodes_without_pad(
    reports: Sequence[BusReport],
    comparisons: Sequence[NodeComparison],
    deployment: config.Deployment | None,
) -> FoundNodes:
    """Return the nodes that no pad of the deployment has by node id or serial number, but for duplicates."""
    known = {(comparison.bus, comparison.node_id) for comparison in comparisons if comparison.pad}
    serials = set(_names_by_serial(deployment))

    def is_new(bus: str, node: NodeFacts) -> bool:
        return (bus, node.node_id) not in known and node.serial not in serials and not node.conflict

    return [
        (report.bus, [node for node in report.nodes if is_new(report.bus.name, node)]) for report in reports
    ]


def _compare_bus(
    deployment: config.Deployment | None, report: BusReport, serials: Mapping[int, str]
) -> Iterator[NodeComparison]:
    bus = report.bus.name
    queried = "query" in report.durations_s
    pads = {entry.pad.node_id: entry for entry in deployment.pads_on(bus)} if deployment else {}
    nodes = {node.node_id: node for node in report.nodes}
    for node_id in sorted(nodes.keys() | pads.keys()):
        node, entry = nodes.get(node_id), pads.get(node_id)
        if node is None:
            problem = "missing: no frame received" + (", no SDO response" if queried else "")
        elif node.conflict or (node.error and entry):
            problem = node.conflict or node.error
        elif entry is None or deployment is None:
            owner = _names_by_serial(deployment).get(node.serial or 0)
            remark = f"serial {node.serial} belongs to {owner}" if owner else ""
            remark = remark or ("not in the deployment" if deployment else "")
            remarks = (remark, node.error, _describe_events(node))
            yield NodeComparison(bus, node_id, "", "", "; ".join(filter(None, remarks)))
            continue
        elif not node.answers:
            problem = "frames received, but no SDO response" if queried else ""
        else:
            problem = _describe_mismatch(node, entry.pad, deployment.nodes[entry.pad.node])
        serial = entry.pad.serial if entry else None
        elsewhere = serials.get(serial) if serial else None
        if problem and elsewhere and (node is None or node.serial != serial):
            problem += f"; serial {serial} is that of {elsewhere}"
        name = entry.name if entry else ""
        yield NodeComparison(bus, node_id, name, problem, _describe_events(node) if node else "")


def _describe_events(node: NodeFacts) -> str:
    """Describe a node's boot-ups during the scan."""
    return f"booted {node.boots} times" if node.boots > 1 else ""


def _names_by_serial(deployment: config.Deployment | None) -> dict[int, str]:
    """Return the names of the pads with a configured serial number."""
    entries = deployment.pads if deployment else ()
    return {entry.pad.serial: entry.name for entry in entries if entry.pad.serial}


def _describe_mismatch(node: NodeFacts, pad: config.Pad, kind: config.Node) -> str:
    """Describe in what a node differs from its configuration; empty if it doesn't."""
    for sub, (key, quantity) in enumerate(cia301.IDENTITY_NAMES.items(), 1):
        found, configured = getattr(node, key), getattr(pad if key == "serial" else kind, key)
        if configured is None or found == configured:
            continue
        if found is None:
            return (
                f"identity unknown: {quantity} (0x1018:{sub:02}): {node.refused.get(key, 'not read')}; "
                f"configured is {configured}"
            )
        return f"identity mismatch: {quantity} is {found}, configured is {configured}"
    carried = {(entry >> 16, entry >> 8 & 0xFF) for tpdo in node.tpdos for entry in tpdo.mapping}
    missing = [text for text in kind.channels if channels.parse_object(text)[:2] not in carried]
    if missing and not kind.allow_pdo_remapping:
        return (
            f"no TPDO carries {', '.join(missing)}, and allow_pdo_remapping = false; map them in the node, "
            "or allow it"
        )
    return ""
