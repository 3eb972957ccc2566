"""Objects of a node's four channels, with their integer types, from configuration and EDS.

Public names: `Channel`, `Channels`, `WritableObject`, `STANDARD_CHANNELS`, `ELECTRODES`, `PROFILE_TYPES`,
`resolve_channels`, `order_by_electrode`, `parse_object`, `parse_writable_object`, `full_scale_counts`,
`max_count`, `integer_limits`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from handtouch.config import Node, eds

ELECTRODES = ("x0", "xa", "y0", "yb")
MAX_CHANNEL_BITS = 32
_OBJECT_PATTERN = re.compile(r"0x([0-9A-Fa-f]{4}):(0x[0-9A-Fa-f]{1,2}|\d{1,3})(?::([iu])(8|16|24|32))?")
PROFILE_TYPES = {  # (bits, signed); CiA 401 and CiA 404: read analogue input, process and field values
    0x6400: (8, True),
    0x6401: (16, True),
    0x6402: (32, True),
    0x7100: (16, True),
    0x7130: (16, True),
    0x8100: (24, True),
    0x8130: (24, True),
    0x9100: (32, True),
    0x9130: (32, True),
}


def integer_limits(bits: int, signed: bool) -> tuple[int, int]:
    """Return the minimum and maximum of an integer type."""
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)


@dataclass(frozen=True, slots=True)
class Channel:
    """Object that carries one channel: its address and its integer type."""

    index: int
    sub: int
    bits: int = 16
    signed: bool = True

    @property
    def mapping_entry(self) -> int:
        """Entry of the object in a PDO mapping."""
        return self.index << 16 | self.sub << 8 | self.bits

    @property
    def limits(self) -> tuple[int, int]:
        """Minimum and maximum count."""
        return integer_limits(self.bits, self.signed)

    def __str__(self) -> str:
        return f"0x{self.index:04X}:{self.sub:02X} ({'' if self.signed else 'unsigned '}{self.bits} bit)"


@dataclass(frozen=True, slots=True)
class WritableObject:
    """Object that handtouch writes, of `size_bytes` bytes."""

    index: int
    sub: int
    size_bytes: int


Channels = tuple[Channel, Channel, Channel, Channel]

STANDARD_CHANNELS: Channels = (
    Channel(0x6401, 1),
    Channel(0x6401, 2),
    Channel(0x6401, 3),
    Channel(0x6401, 4),
)
"""CiA 401's analogue inputs."""


def parse_object(text: str) -> tuple[int, int, tuple[int, bool] | None]:
    """Return index, sub-index and type (bits, signed) or None of INDEX:SUB[:TYPE], such as "0x2001:0:u24".

    Raises EdsError for any other form.
    """
    form = _OBJECT_PATTERN.fullmatch(text)
    if form is None or not int(form[1], 16) >= 1 or int(form[2], 0) > 254:
        raise eds.EdsError(
            f'"{text}" is no object; write INDEX:SUB such as "0x6401:1", or with its type "0x2001:1:u24"'
        )
    kind = (int(form[4]), form[3] == "i") if form[3] else None
    return int(form[1], 16), int(form[2], 0), kind


def resolve_channels(objects: Sequence[str], path: Path | str | None) -> Channels:
    """Return the four channels of a kind of node, with types from the text, the EDS or the CiA profiles.

    Raises EdsError for a form unknown to `parse_object`, an object given twice, an unreadable EDS, and a type
    that is unknown, isn't an integer, is wider than 32 bits or contradicts the EDS.
    """
    dictionary = eds.load_eds(path, 1) if path else None
    channels: list[Channel] = []
    for text in objects:
        index, sub, given = parse_object(text)
        listed = eds.integer_type(dictionary, index, sub) if dictionary is not None else None
        if dictionary is not None and listed is None and given is None:
            raise eds.EdsError(f'"{text}": {path} has no such object; correct the object or the EDS')
        if given and listed and given != listed:
            raise eds.EdsError(
                f'"{text}": {path} has {_type_name(*listed)}; leave the type out, or correct the EDS'
            )
        kind = given or listed or PROFILE_TYPES.get(index)
        if kind is None:
            raise eds.EdsError(f'"{text}": its type is unknown; give the EDS, or the type: "{text}:i16"')
        if kind[0] > MAX_CHANNEL_BITS:
            raise eds.EdsError(f'"{text}" has {kind[0]} bits; at most {MAX_CHANNEL_BITS} are supported')
        if any((channel.index, channel.sub) == (index, sub) for channel in channels):
            raise eds.EdsError(f'"{text}" is given twice; each channel needs its own object')
        channels.append(Channel(index, sub, *kind))
    first, second, third, fourth = channels
    return first, second, third, fourth


def parse_writable_object(text: str) -> WritableObject:
    """Parse an object to write, INDEX:SUB:TYPE. Raises EdsError if the type is missing."""
    index, sub, kind = parse_object(text)
    if kind is None:
        raise eds.EdsError(f'"{text}": its type is missing; add it: "{text}:u8"')
    return WritableObject(index, sub, kind[0] // 8)


def order_by_electrode(channels: Channels, electrodes: Sequence[str]) -> Channels:
    """Return the channels of the electrodes x0, xa, y0, yb; `electrodes` lists each channel's electrode."""
    x0, xa, y0, yb = (channels[electrodes.index(name)] for name in ELECTRODES)
    return x0, xa, y0, yb


def _type_name(bits: int, signed: bool) -> str:
    return f"{'i' if signed else 'u'}{bits}"


def full_scale_counts(node: Node) -> int:
    """Return the count of a node's `full_scale_ma`: as configured, else the maximum of its type."""
    return node.full_scale_counts or max_count(node)


def max_count(node: Node) -> int:
    """Return the greatest count that every channel of a node can reach."""
    return min(channel.limits[1] for channel in resolve_channels(node.channels, node.eds))
