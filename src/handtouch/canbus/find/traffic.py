"""What the frames on a bus tell a listener: who is there, how often what comes, whose it is.

Public names: `Traffic`, `Stream`, `meaning`, `NMT_STATES`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from handtouch.canbus.objects.emergency import decode

NMT_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}

_FIXED = {0x000: "NMT command", 0x080: "SYNC", 0x100: "TIME", 0x7E4: "LSS answer", 0x7E5: "LSS request"}
_FUNCTIONS = {  # the predefined connection set of CiA 301: first identifier, whether its node sends it
    0x080: ("EMCY", True),
    0x180: ("TPDO1", True),
    0x200: ("RPDO1", False),
    0x280: ("TPDO2", True),
    0x300: ("RPDO2", False),
    0x380: ("TPDO3", True),
    0x400: ("RPDO3", False),
    0x480: ("TPDO4", True),
    0x500: ("RPDO4", False),
    0x580: ("SDO answer", True),
    0x600: ("SDO request", False),
    0x700: ("heartbeat", True),
}


@dataclass(slots=True)
class Stream:
    """Frames with one identifier: how many came, when the first and the last, the lengths of their data."""

    first_ns: int
    last_ns: int
    count: int = 0
    sizes: set[int] = field(default_factory=set)

    def rate_hz(self, seconds: float) -> float:
        """Mean rate; by the spacing of the frames where several came, over `seconds` of listening else."""
        if self.count > 1 and self.last_ns > self.first_ns:
            return (self.count - 1) / (self.last_ns - self.first_ns) * 1e9
        return self.count / seconds


class Traffic:
    """Takes every frame; only those of 11-bit identifiers come here.

    `streams` : identifier -> its frames; `states` : node id -> NMT state that its latest heartbeat told;
    `boots` : node id -> boot-up messages; `emergencies` : node id -> its latest EMCY message in words
    """

    def __init__(self) -> None:
        self.streams: dict[int, Stream] = {}
        self.states: dict[int, int] = {}
        self.boots: dict[int, int] = {}
        self.emergencies: dict[int, str] = {}

    def handle(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take a frame."""
        stream = self.streams.get(can_id)
        if stream is None:
            stream = self.streams[can_id] = Stream(t_ns, t_ns)
        stream.count += 1
        stream.last_ns = t_ns
        stream.sizes.add(len(data))
        if 0x700 < can_id < 0x780 and len(data) == 1:
            state = data[0] & 0x7F  # bit 7 toggles in answers to node guarding
            self.states[can_id - 0x700] = state
            if data[0] == 0:
                self.boots[can_id - 0x700] = self.boots.get(can_id - 0x700, 0) + 1
        elif 0x80 < can_id < 0x100 and (emergency := decode(data, t_ns)) is not None:
            self.emergencies[can_id - 0x80] = emergency.text

    def nodes(self) -> set[int]:
        """Ids of which something came that only the node itself sends, by the predefined connection set."""
        return {node_id for can_id in self.streams for node_id, sent in [_node_of(can_id)] if sent}


def meaning(can_id: int, owners: dict[int, str], present: set[int]) -> str:
    """What frames with this identifier are; empty where nobody is known who would use it.

    `owners` are identifiers that nodes were found to use, each in words; `present` the ids that are there.
    """
    if can_id in _FIXED:
        return _FIXED[can_id]
    if can_id in owners:
        return owners[can_id]
    node_id, function = can_id & 0x7F, _FUNCTIONS.get(can_id & 0x780)
    if function is None or node_id not in present:
        return ""
    name, sent = function
    return f"{name} {'of' if sent else 'to'} node {node_id}"


def _node_of(can_id: int) -> tuple[int, bool]:
    """Node id in an identifier, and whether frames with it come from that node and nobody else."""
    node_id, function = can_id & 0x7F, _FUNCTIONS.get(can_id & 0x780)
    # a PDO's identifier may have been given to any other node, so only heartbeat, EMCY and SDO prove an id
    sure = function is not None and function[1] and not function[0].startswith("TPDO")
    return node_id, sure and node_id != 0
