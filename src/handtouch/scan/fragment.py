"""The part of a deployment file that a scan can write: buses, kinds of nodes, and a pad for each node.

Public names: `fragment`, `channel_names`, `FILL_IN`.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from handtouch import config
from handtouch.canbus.find.survey import NodeFacts, four_channels
from handtouch.canbus.objects.channels import PROFILE_TYPES

FILL_IN = "FILL IN"
"""Marks the lines that a person has to complete; they are comments until then."""

_STANDARD = ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4")
_KIND = (
    ("drive_v = 5.0", "potential of the conducting layer; the node's manual tells"),
    ("full_scale_ma = 10.0", "electrode current at the greatest count; the node's manual tells"),
    ("noise_counts = 1.0", "standard deviation of a reading; the node's manual tells"),
)
_PAD = (
    ('sheet = "firm"', "the [sheet.NAME] that the pad is made of"),
    ('surface = { kind = "plane", length_mm = 30.0, width_mm = 20.0 }', "shape and size of the pad"),
    ("gap_mm = 0.8", "bare length of each side next to its corners"),
)

Found = Sequence[tuple[config.Bus, Sequence[NodeFacts]]]
"""Buses, each with the nodes to be written."""


def fragment(found: Found, deployment: config.Deployment | None = None) -> str:
    """TOML for the nodes that carry four channels; buses and kinds that the deployment has are used.

    Empty if there is none. It is a whole deployment once its lines marked FILL IN are, and a [sheet.NAME] is
    there.
    """
    usable = [(bus, [node for node in nodes if channel_names(node)]) for bus, nodes in found]
    if not any(nodes for _, nodes in usable):
        return ""
    kinds = _Kinds(deployment)
    pads = list(_pads(usable, kinds))
    lines: list[str] = []
    for bus, nodes in usable:
        if nodes and deployment is None:
            lines += ["[[bus]]", *_bus(bus), ""]
    lines += kinds.lines
    if deployment is None:
        lines += ["[[hand]]", 'name = "hand"  # as in topics', ""]
    else:
        lines += [
            f"# Below the [[hand]] that they belong to: {', '.join(h.name for h in deployment.hands)}",
            "",
        ]
    return "\n".join([*lines, *pads]).rstrip() + "\n"


def channel_names(node: NodeFacts) -> tuple[str, ...]:
    """Objects of a node's four channels as a deployment names them, empty if there are none.

    A type stands where the object alone doesn't tell it; whether it is signed is a guess then.
    """
    chosen = four_channels(node.tpdos)
    if chosen is None:
        return _STANDARD if (node.inputs or 0) >= 4 else ()
    return tuple(_object_name(entry) for entry in chosen[0])


def _object_name(entry: int) -> str:
    name = f"0x{entry >> 16:04X}:{entry >> 8 & 0xFF}"
    bits, _ = PROFILE_TYPES.get(entry >> 16, (0, True))
    return name if bits == entry & 0xFF else f"{name}:i{entry & 0xFF}"


class _Kinds:
    """`[node.NAME]` tables: those of the deployment, and new ones for nodes that fit none."""

    def __init__(self, deployment: config.Deployment | None) -> None:
        self.lines: list[str] = []
        self._known = dict(deployment.nodes) if deployment else {}
        self._made: dict[tuple[object, ...], str] = {}

    def name(self, node: NodeFacts) -> str:
        """Name of the kind of a node; a table is added if there is none yet."""
        channels = channel_names(node)
        for name, kind in self._known.items():
            same = kind.vendor_id in (None, node.vendor_id) and kind.product_code in (None, node.product_code)
            if same and kind.channels == channels:
                return name
        key = (node.vendor_id, node.product_code, channels)
        if key not in self._made:
            self._made[key] = self._new_name(node.name)
            self.lines += [f"[node.{self._made[key]}]", *_kind(node, channels), ""]
        return self._made[key]

    def _new_name(self, told: str) -> str:
        slug = re.sub(r"[^a-z0-9]+", "_", told.lower()).strip("_")[:40]
        stem = slug if slug[:1].isalpha() else f"node_{slug}".strip("_")
        taken = {*self._known, *self._made.values()}
        return next(n for n in (stem, *(f"{stem}_{i}" for i in range(2, 999))) if n not in taken)


def _bus(bus: config.Bus) -> Iterator[str]:
    yield f'name = "{bus.name}"'
    yield f'interface = "{bus.interface}"'
    yield f"channel = {json.dumps(bus.channel)}"
    yield f"bitrate_bit_s = {bus.bitrate_bit_s}"
    if bus.options:
        options = ", ".join(f"{key} = {json.dumps(value)}" for key, value in bus.options.items())
        yield f"options = {{ {options} }}"


def _kind(node: NodeFacts, channels: tuple[str, ...]) -> Iterator[str]:
    if node.name:
        yield f"# {' '.join(part for part in (node.name, node.hardware, node.software) if part)}"
    if node.vendor_id is not None:
        yield f"vendor_id = 0x{node.vendor_id:X}"
    if node.product_code is not None:
        yield f"product_code = 0x{node.product_code:X}"
    if channels != _STANDARD:
        guessed = any(name.count(":") > 1 for name in channels)
        remark = "  # i: signed, u: unsigned; its manual or EDS tells" if guessed else ""
        yield f"channels = [{', '.join(map(json.dumps, channels))}]{remark}"
    yield from _to_fill_in(_KIND)


def _pads(found: Found, kinds: _Kinds) -> Iterator[str]:
    serials = Counter(node.serial for _, nodes in found for node in nodes)
    number = 0
    for bus, nodes in found:
        for node in nodes:
            number += 1
            yield "[[hand.pad]]"
            yield f'link = "name_me_{number}"  # the link that carries it; press the pad to see which'
            yield f'bus = "{bus.name}"'
            yield f"node_id = 0x{node.node_id:02X}"
            if node.serial and serials[node.serial] == 1:
                yield f"serial = {node.serial}"
            else:
                told = "no serial number" if not node.serial else f"serial number {node.serial}, as others do"
                yield f"# it has {told}: if it is replaced, that goes unnoticed"
            yield f'node = "{kinds.name(node)}"'
            yield from _to_fill_in(_PAD)
            yield ""


def _to_fill_in(lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    for line, what in lines:
        yield f"# {line}  # {FILL_IN}: {what}"
