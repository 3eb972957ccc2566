"""Passive analysis of a bus's frames: nodes present, rates, and the meaning of identifiers.

Public names: `Traffic`, `FrameStatistics`, `describe_identifier`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from handtouch.canbus import cia301
from handtouch.canbus.objects.emergency import decode_emergency

_FIXED_IDENTIFIERS = {
    cia301.NMT: "NMT command",
    cia301.SYNC: "SYNC",
    cia301.TIME: "TIME",
    cia301.LSS_RESPONSE: "LSS response",
    cia301.LSS_REQUEST: "LSS request",
}
_FUNCTIONS = {  # predefined connection set: first identifier -> name, sent by the node
    cia301.EMCY: ("EMCY", True),
    0x180: ("TPDO1", True),
    0x200: ("RPDO1", False),
    0x280: ("TPDO2", True),
    0x300: ("RPDO2", False),
    0x380: ("TPDO3", True),
    0x400: ("RPDO3", False),
    0x480: ("TPDO4", True),
    0x500: ("RPDO4", False),
    cia301.SDO_RESPONSE: ("SDO response", True),
    cia301.SDO_REQUEST: ("SDO request", False),
    cia301.NMT_ERROR_CONTROL: ("heartbeat", True),
}


@dataclass(slots=True)
class FrameStatistics:
    """Statistics of the frames with one identifier."""

    first_ns: int
    last_ns: int
    count: int = 0
    data_lengths: set[int] = field(default_factory=set)

    def rate_hz(self, seconds: float) -> float:
        """Return the mean rate: by the spacing of several frames, or for a single one over `seconds`."""
        if self.count > 1 and self.last_ns > self.first_ns:
            return (self.count - 1) / (self.last_ns - self.first_ns) * 1e9
        return self.count / seconds


class Traffic:
    """Statistics of all frames with 11-bit identifiers on a bus.

    `frame_statistics` : by identifier
    `nmt_states` : node id -> NMT state in its latest heartbeat
    `boot_up_counts` : node id -> number of boot-up messages
    `emergencies` : node id -> text of its latest EMCY message
    """

    def __init__(self) -> None:
        self.frame_statistics: dict[int, FrameStatistics] = {}
        self.nmt_states: dict[int, int] = {}
        self.boot_up_counts: dict[int, int] = {}
        self.emergencies: dict[int, str] = {}

    def handle_frame(self, can_id: int, data: bytes, arrival_ns: int) -> None:
        """Add a frame."""
        statistics = self.frame_statistics.get(can_id)
        if statistics is None:
            statistics = self.frame_statistics[can_id] = FrameStatistics(arrival_ns, arrival_ns)
        statistics.count += 1
        statistics.last_ns = arrival_ns
        statistics.data_lengths.add(len(data))
        if 0x700 < can_id < 0x780 and len(data) == 1:
            state = data[0] & 0x7F  # bit 7 toggles in answers to node guarding
            self.nmt_states[can_id - 0x700] = state
            if data[0] == 0:
                self.boot_up_counts[can_id - 0x700] = self.boot_up_counts.get(can_id - 0x700, 0) + 1
        elif 0x80 < can_id < 0x100 and (emergency := decode_emergency(data, arrival_ns)) is not None:
            self.emergencies[can_id - 0x80] = emergency.text

    def detected_nodes(self) -> set[int]:
        """Return the ids of which a frame was received that only the node itself sends."""
        return {node_id for can_id in self.frame_statistics for node_id, sent in [_sender_of(can_id)] if sent}


def describe_identifier(can_id: int, owners: dict[int, str], present: set[int]) -> str:
    """Describe the use of an identifier; empty if no known node uses it.

    `owners` describes identifiers that nodes were found to use; `present` are the ids of the nodes present.
    """
    if can_id in _FIXED_IDENTIFIERS:
        return _FIXED_IDENTIFIERS[can_id]
    if can_id in owners:
        return owners[can_id]
    node_id, function = can_id & 0x7F, _FUNCTIONS.get(can_id & 0x780)
    if function is None or node_id not in present:
        return ""
    name, sent = function
    return f"{name} {'of' if sent else 'to'} node {node_id}"


def _sender_of(can_id: int) -> tuple[int, bool]:
    """Return the node id in an identifier, and True if only that node sends such frames."""
    node_id, function = can_id & 0x7F, _FUNCTIONS.get(can_id & 0x780)
    # a PDO's identifier may have been given to any other node, so only heartbeat, EMCY and SDO prove an id
    is_sender = function is not None and function[1] and not function[0].startswith("TPDO")
    return node_id, is_sender and node_id != 0
