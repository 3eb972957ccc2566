"""Owners of the identifiers on each bus: which node sends what, and what is ignored.

Public names: `find_owners`, `IGNORED`, `NMT_COMMAND`, `UNKNOWN_SENDER`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from handtouch.canbus import cia301
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.router import IDENTIFIER_COUNT
from handtouch.canbus.nodes.managed_node import ManagedNode
from handtouch.config.eds import EdsError

UNKNOWN_SENDER, IGNORED, NMT_COMMAND = -1, -2, -3
_SHARED_IDS = (cia301.SYNC, cia301.TIME, cia301.LSS_RESPONSE, cia301.LSS_REQUEST)
_PDO_IDS = range(0x180, 0x501, 0x80)


def find_owners(ports: Mapping[str, Port], nodes: Sequence[ManagedNode]) -> dict[str, list[int]]:
    """Return for each bus and identifier the index in `nodes`, or one of the constants.

    Raises ValueError for nodes that contradict each other, EdsError for an identifier that two of them send.
    """
    owners = {name: [UNKNOWN_SENDER] * IDENTIFIER_COUNT for name in ports}
    for table in owners.values():
        table[cia301.NMT] = NMT_COMMAND
        for can_id in _SHARED_IDS:
            table[can_id] = IGNORED
    slots: set[int] = set()
    senders: dict[tuple[str, int], str] = {}  # nodes on listener buses by the identifiers of their samples
    for number, node in enumerate(nodes):
        spec, table = node.spec, owners[node.spec.bus]
        if table[cia301.NMT_ERROR_CONTROL + spec.node_id] != UNKNOWN_SENDER or spec.slot in slots:
            raise ValueError(f'node "{spec.name}": node id {spec.node_id} or slot {spec.slot} is given twice')
        slots.add(spec.slot)
        for tpdo in node.mapping.tpdos if node.mapping else ():
            other = senders.setdefault((spec.bus, tpdo.cob_id), spec.name)
            if other != spec.name:
                raise EdsError(
                    f'nodes "{other}" and "{spec.name}" both send 0x{tpdo.cob_id:X} by their EDS; '
                    "give each an EDS or DCF with its own COB-IDs"
                )
        for service in (cia301.EMCY, cia301.SDO_RESPONSE, cia301.NMT_ERROR_CONTROL):
            table[service + spec.node_id] = number
        for service in (cia301.SDO_REQUEST, *_PDO_IDS):  # echoes of requests; PDOs before they are routed
            table[service + spec.node_id] = IGNORED
    return owners
