"""Tables of a deployment file that a scan can write: buses, kinds of nodes, and a pad for each node.

Public names: `fragment`, `starting_deployment`, `channel_names`, `FILL_IN`, `CHECK`.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from handtouch import config
from handtouch.canbus.find.survey import NodeFacts, find_channels_of_node
from handtouch.config.channels import PROFILE_TYPES, parse_object

FILL_IN = "FILL IN"
"""Mark of lines to be completed by the user; they are comments until then."""
CHECK = "CHECK"
"""Mark of values of a starting deployment that are usual ones, not this hand's."""

_DEFAULT_CHANNELS = ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4")
_NODE_FILL_INS = (
    ("drive_v = 5.0", "voltage of the conducting layer; see the node's manual"),
    ("full_scale_ma = 10.0", "electrode current at the greatest count; see the node's manual"),
    ("noise_counts = 1.0", "noise of one channel (1 sigma); see the node's manual"),
)
_REAL32_FILL_IN = ("full_scale_counts = 10_000", "count of full_scale_ma: value x counts per unit")
_PAD_FILL_INS = (
    ('sheet = "firm"', "name of the pad's [sheet.NAME] table"),
    ('surface = { kind = "plane", length_mm = 30.0, width_mm = 20.0 }', "shape and size of the pad"),
    ("gap_mm = 0.8", "bare length between corner and electrode on each side"),
)

OpenLines = Callable[[Iterable[tuple[str, str]]], Iterator[str]]
"""Function that writes lines whose values a scan can't know"""
FoundNodes = Sequence[tuple[config.Bus, Sequence[NodeFacts]]]
"""Buses, each with the nodes to write."""


def fragment(found: FoundNodes, deployment: config.Deployment | None = None) -> str:
    """Return TOML for the nodes with four channels; buses and kinds of the deployment are reused.

    Empty if there is none. It is a complete deployment once the lines marked FILL IN are completed and a
    [sheet.NAME] table is added.
    """
    usable = [(bus, [node for node in nodes if channel_names(node)]) for bus, nodes in found]
    if not any(nodes for _, nodes in usable):
        return ""
    return "\n".join(_lines(usable, _NodeKinds(deployment, _fill_in_lines), deployment)).rstrip() + "\n"


def starting_deployment(found: FoundNodes) -> str:
    """Return a complete deployment for the nodes, with usual values on the lines marked CHECK.

    Nodes without four channels get analogue inputs 1 to 4 of CiA 401; a bus without nodes gets no pad.
    """
    return _BEFORE + "\n".join([*_lines(found, _NodeKinds(None, _check_lines), None)]).rstrip() + "\n"


_BEFORE = """\
# A deployment of handtouch. Lines marked CHECK have usual values: replace them by this hand's. All keys
# (mounts, for example) are in docs/configuration.md. Then: handtouch check FILE
# Preview without hardware: handtouch demo --config FILE --view

[daemon]
sync_period_ms = 10.0 # a sample of every pad, 100 times a second

[sheet.firm]
ohm_per_square = 2400.0 # CHECK: of the conductive film, between opposite sides of a square of it
contact_ohm_mm2 = 20_000.0 # CHECK: contact resistance x area at 100 kPa; handtouch calibrate measures it
alpha = 1.5 # CHECK: exponent of pressure; handtouch calibrate measures it
contact_radius_mm = 2.5 # CHECK: radius of usual contacts
contact_radius_std_mm = 0.5 # CHECK: how much it varies (1 sigma)
max_force_n = 20.0 # CHECK: greatest force expected

[touch]
begin_threshold_n = 0.06 # a contact begins at this force
end_threshold_n = 0.03 # and ends below this one

"""


def _lines(usable: FoundNodes, kinds: _NodeKinds, deployment: config.Deployment | None) -> Iterator[str]:
    pads = list(_pad_lines(usable, kinds))
    lines: list[str] = []
    for bus, nodes in usable:
        if nodes and deployment is None:
            lines += ["[[bus]]", *_bus_lines(bus), ""]
    lines += kinds.lines
    if deployment is None:
        lines += ["[[hand]]", 'name = "hand"  # as in topics', ""]
    else:
        hands = ", ".join(hand.name for hand in deployment.hands)
        lines += [f"# Insert below the [[hand]] that the pads belong to: {hands}", ""]
    yield from (*lines, *pads)


def channel_names(node: NodeFacts) -> tuple[str, ...]:
    """Return the objects of a node's four channels as a deployment lists them, empty if there are none.

    A type is added where the object doesn't imply it; its sign is a guess then, and so are the counts per
    unit of REAL32.
    """
    chosen = find_channels_of_node(node)
    if chosen is None:
        return _DEFAULT_CHANNELS if (node.inputs or 0) >= 4 else ()
    return tuple(_object_name(entry) for entry in chosen[0])


def _object_name(entry: int) -> str:
    name = f"0x{entry >> 16:04X}:{entry >> 8 & 0xFF}"
    kind = PROFILE_TYPES.get(entry >> 16)
    if kind is None or kind.bits != entry & 0xFF:
        return f"{name}:i{entry & 0xFF}"
    return f"{name}:f32/1000" if kind.is_real else name


def _addresses(channels: Iterable[str]) -> list[tuple[int, int]]:
    return [parse_object(text)[:2] for text in channels]


class _NodeKinds:
    """`[node.NAME]` tables: those of the deployment, and new ones for nodes that match none."""

    def __init__(self, deployment: config.Deployment | None, open_lines: OpenLines) -> None:
        self.lines: list[str] = []
        self.open_lines = open_lines
        self._existing = dict(deployment.nodes) if deployment else {}
        self._added: dict[tuple[object, ...], str] = {}

    def kind_name(self, node: NodeFacts) -> str:
        """Return the name of a node's kind, adding a table if there is none yet."""
        channels = channel_names(node)
        for name, kind in self._existing.items():
            same = kind.vendor_id in (None, node.vendor_id) and kind.product_code in (None, node.product_code)
            if same and _addresses(kind.channels) == _addresses(channels):
                return name
        key = (node.vendor_id, node.product_code, channels)
        if key not in self._added:
            self._added[key] = self._new_name(node.name)
            self.lines += [f"[node.{self._added[key]}]", *_node_lines(node, channels, self.open_lines), ""]
        return self._added[key]

    def _new_name(self, device_name: str) -> str:
        slug = re.sub(r"[^a-z0-9]+", "_", device_name.lower()).strip("_")[:40]
        stem = slug if slug[:1].isalpha() else f"node_{slug}".strip("_")
        taken = {*self._existing, *self._added.values()}
        return next(n for n in (stem, *(f"{stem}_{i}" for i in range(2, 999))) if n not in taken)


def _bus_lines(bus: config.Bus) -> Iterator[str]:
    yield f'name = "{bus.name}"'
    yield f'interface = "{bus.interface}"'
    yield f"channel = {json.dumps(bus.channel)}"
    yield f"bitrate_bit_s = {bus.bitrate_bit_s}"
    if bus.options:
        options = ", ".join(f"{key} = {json.dumps(value)}" for key, value in bus.options.items())
        yield f"options = {{ {options} }}"


def _node_lines(node: NodeFacts, channels: tuple[str, ...], open_lines: OpenLines) -> Iterator[str]:
    if node.name:
        yield f"# {' '.join(part for part in (node.name, node.hardware, node.software) if part)}"
    if node.vendor_id is not None:
        yield f"vendor_id = 0x{node.vendor_id:X}"
    if node.product_code is not None:
        yield f"product_code = 0x{node.product_code:X}"
    if channels != _DEFAULT_CHANNELS:
        guessed = any(name.count(":") > 1 for name in channels)
        remark = "  # i: signed, u: unsigned, f: REAL32/counts per unit; see its manual" if guessed else ""
        yield f"channels = [{', '.join(map(json.dumps, channels))}]{remark}"
    if any(":f32/" in name for name in channels):
        yield from open_lines([_REAL32_FILL_IN])
    yield from open_lines(_NODE_FILL_INS)


def _pad_lines(found: FoundNodes, kinds: _NodeKinds) -> Iterator[str]:
    serials = Counter(node.serial for _, nodes in found for node in nodes)
    number = 0
    for bus, nodes in found:
        for node in nodes:
            number += 1
            yield "[[hand.pad]]"
            yield f'link = "name_me_{number}"  # link with this pad; handtouch commission finds it'
            yield f'bus = "{bus.name}"'
            yield f"node_id = 0x{node.node_id:02X}"
            if node.serial and serials[node.serial] == 1:
                yield f"serial = {node.serial}"
            else:
                serial = (
                    f"serial number {node.serial} like other nodes" if node.serial else "no serial number"
                )
                yield f"# it has {serial}: its replacement can't be detected"
            yield f'node = "{kinds.kind_name(node)}"'
            yield from kinds.open_lines(_PAD_FILL_INS)
            yield ""


def _fill_in_lines(lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    for line, description in lines:
        yield f"# {line}  # {FILL_IN}: {description}"


def _check_lines(lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    for line, description in lines:
        yield f"{line}  # {CHECK}: {description}"
