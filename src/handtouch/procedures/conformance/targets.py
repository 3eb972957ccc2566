"""Selection of the nodes to test: by id, by pad, or all, on the buses of a deployment or on given ones.

Public names: `Targets`, `select_targets`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields

from handtouch import config
from handtouch.canbus.nodes.spec import node_specs
from handtouch.canbus.objects.mapping import tpdo_numbers
from handtouch.config.channels import resolve_channels
from handtouch.config.eds import EdsError
from handtouch.procedures.conformance.session import NodeUnderTest

_ID = re.compile(r"(?:(?P<bus>[A-Za-z][\w\-]*):)?(?P<id>0x[0-9A-Fa-f]+|\d+)")
_COMMAND = "handtouch conformance"


@dataclass(frozen=True)
class Targets:
    """Nodes to test on each bus; `find_all`: on a bus without any, all nodes that respond."""

    buses: tuple[config.Bus, ...]
    nodes: tuple[NodeUnderTest, ...]
    find_all: bool
    eds: str | None

    def nodes_on(self, bus: str) -> list[NodeUnderTest]:
        """Return the selected nodes on a bus."""
        return [node for node in self.nodes if node.bus == bus]

    def describe_found(self, bus: str, node_id: int) -> NodeUnderTest:
        """Return a node that was found on a bus and that no deployment describes."""
        return NodeUnderTest(bus, node_id, eds=self.eds)


def select_targets(
    deployment: config.Deployment | None, bus_texts: Sequence[str], names: Sequence[str], eds: str | None
) -> Targets:
    """Select nodes: `names` are ids, BUS:ID, or patterns of pads; none of them: all.

    `bus_texts` as for --bus; `eds` replaces the EDS of the deployment. Raises ConfigError.
    """
    if deployment is not None:
        for text in bus_texts:
            deployment = config.with_bus(deployment, text)
        buses = deployment.buses
        for bus in buses:
            if bus.role != "master":
                raise _error(
                    f'[[bus]] "{bus.name}": role',
                    f" = {bus.role}",
                    "the test sends NMT commands and SYNC; connect the node to a bus without another master",
                )
        known = _nodes_of(deployment, eds)
    else:
        if not bus_texts:
            raise _error("no bus", "", "give --config hand.toml, or a bus such as --bus can0=socketcan:can0")
        buses, known = config.parse_buses(bus_texts), {}
    if not names:
        return Targets(buses, tuple(known.values()), deployment is None, eds)
    nodes: dict[tuple[str, int], NodeUnderTest] = {}
    for name in names:
        for key in _keys_of(name, deployment, buses):
            nodes[key] = known.get(key) or NodeUnderTest(*key, eds=eds)
    used = {bus for bus, _ in nodes}
    return Targets(tuple(bus for bus in buses if bus.name in used), tuple(nodes.values()), False, eds)


def _keys_of(
    name: str, deployment: config.Deployment | None, buses: Sequence[config.Bus]
) -> list[tuple[str, int]]:
    """Return bus and node id of each node that a name stands for."""
    form = _ID.fullmatch(name)
    if form is None:
        rows = deployment.rows_matching(name) if deployment is not None else []
        if not rows or deployment is None:
            pads = ", ".join(deployment.pad_names) if deployment is not None else "only with --config"
            raise _error("NODE", f" {name}", f"give an id, BUS:ID, or a pad: {pads}")
        return [(deployment.pads[row].pad.bus, deployment.pads[row].pad.node_id) for row in rows]
    node_id = int(form["id"], 0)
    bus_names = [bus.name for bus in buses]
    if not 1 <= node_id <= 127:
        raise _error("NODE", f" {name}", "must be 1 to 127 (0x01 to 0x7F)")
    if form["bus"] is not None and form["bus"] not in bus_names:
        raise _error("NODE", f" {name}", f"no such bus; buses: {', '.join(bus_names)}")
    if form["bus"] is None and len(buses) > 1:
        raise _error("NODE", f" {name}", f"give the bus, too: {bus_names[0]}:{node_id}")
    return [(form["bus"] or bus_names[0], node_id)]


def _nodes_of(deployment: config.Deployment, eds: str | None) -> dict[tuple[str, int], NodeUnderTest]:
    """Return the nodes of a deployment by bus and id; channels in each node's own order."""
    nodes = {}
    try:
        for spec, (_, pad) in zip(node_specs(deployment), deployment.pads, strict=True):
            kind = deployment.nodes[pad.node]
            path = eds or kind.eds
            channels = resolve_channels(kind.channels, path)
            same = {field.name: getattr(spec, field.name) for field in fields(spec)}
            own = {"channels": channels, "eds": path, "channel_states": (), "sync_overflow": 0}
            nodes[spec.bus, spec.node_id] = NodeUnderTest(
                **(same | own), tpdo_numbers=tpdo_numbers(path, channels), noise_counts=kind.noise_counts
            )
    except EdsError as error:
        raise _error("channels", "", str(error)) from error
    return nodes


def _error(location: str, value: str, remedy: str) -> config.ConfigError:
    return config.ConfigError(_COMMAND, (config.Problem(location, value, remedy),))
