"""Does what a scan found fit the deployment?

Public names: `judge`, `Verdict`, `names_by_serial`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from handtouch import config
from handtouch.canbus.find.survey import NodeFacts
from handtouch.canbus.objects import channels

from .look import BusReport, pads_on


@dataclass(frozen=True, slots=True)
class Verdict:
    """A node, or one that should be there: the pad it belongs to, and what is wrong, empty if nothing is."""

    bus: str
    node_id: int
    pad: str
    wrong: str = ""
    remark: str = ""


def judge(deployment: config.Deployment | None, reports: Sequence[BusReport]) -> list[Verdict]:
    """Each node that was found against its pad in the deployment, and the pads without their node."""
    serials = {
        node.serial: f"node {node.node_id} on {report.bus.name}"
        for report in reports
        for node in report.nodes
        if node.serial
    }
    return [verdict for report in reports for verdict in _judge_bus(deployment, report, serials)]


def _judge_bus(
    deployment: config.Deployment | None, report: BusReport, serials: Mapping[int, str]
) -> Iterator[Verdict]:
    bus = report.bus.name
    pads = pads_on(deployment, bus)
    nodes = {node.node_id: node for node in report.nodes}
    for node_id in sorted(nodes.keys() | pads.keys()):
        node, (name, pad) = nodes.get(node_id), pads.get(node_id, ("", None))
        if node is None:
            wrong = "missing: not heard" + ("" if "ask" not in report.took_s else ", and no answer")
        elif node.conflict or (node.trouble and pad):
            wrong = node.conflict or node.trouble
        elif pad is None or deployment is None:
            owner = names_by_serial(deployment).get(node.serial or 0)
            remark = f"serial {node.serial} belongs to {owner}" if owner else ""
            remark = remark or ("not in the deployment" if deployment else "")
            yield Verdict(bus, node_id, "", "", "; ".join(filter(None, (remark, node.trouble, _life(node)))))
            continue
        elif not node.answers:
            wrong = "heard, but its SDO server doesn't answer" if "ask" in report.took_s else ""
        else:
            wrong = _difference(node, pad, deployment.nodes[pad.node])
        elsewhere = serials.get(pad.serial) if pad and pad.serial else None
        if wrong and pad and elsewhere and (node is None or node.serial != pad.serial):
            wrong += f"; serial {pad.serial} is that of {elsewhere}"
        yield Verdict(bus, node_id, name, wrong, _life(node) if node else "")


def _life(node: NodeFacts) -> str:
    """What a node told by itself."""
    booted = f"booted {node.boots} times" if node.boots > 1 else ""
    return "; ".join(filter(None, (booted, node.emergency and f"EMCY {node.emergency}")))


def names_by_serial(deployment: config.Deployment | None) -> dict[int, str]:
    """Names of the pads whose serial number is configured."""
    hands = deployment.hands if deployment else ()
    return {pad.serial: f"{hand.name}/{pad.link}" for hand in hands for pad in hand.pads if pad.serial}


def _difference(node: NodeFacts, pad: config.Pad, kind: config.Node) -> str:
    """In what a node isn't as configured, empty if it is."""
    for what, found, wanted in (
        ("vendor id", node.vendor_id, kind.vendor_id),
        ("product code", node.product_code, kind.product_code),
        ("serial number", node.serial, pad.serial),
    ):
        if wanted is not None and found != wanted:
            return f"another device: {what} is {found}, configured is {wanted}"
    carried = {(entry >> 16, entry >> 8 & 0xFF) for tpdo in node.tpdos for entry in tpdo.mapping}
    missing = [text for text in kind.channels if channels.parse(text)[:2] not in carried]
    if missing and not kind.remap:
        return f"no TPDO carries {', '.join(missing)}, and remap = false; map them in the node, or allow it"
    return ""
