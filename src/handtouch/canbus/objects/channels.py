"""The objects that carry a node's four channels, with their integer types, from configuration and EDS.

Public names: `Channel`, `Channels`, `STANDARD_CHANNELS`, `ELECTRODES`, `channels_of`, `in_order`, `parse`,
`full_scale_counts`, `greatest_count`, `PROFILE_TYPES`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from handtouch.canbus.bus.slab import limits
from handtouch.config import Node

from . import eds

ELECTRODES = ("x0", "xa", "y0", "yb")
WIDEST_BITS = 32
_FORM = re.compile(r"0x([0-9A-Fa-f]{4}):(0x[0-9A-Fa-f]{1,2}|\d{1,3})(?::([iu])(8|16|24|32))?")
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


@dataclass(frozen=True, slots=True)
class Channel:
    """An object that carries one channel: its address and its integer type."""

    index: int
    sub: int
    bits: int = 16
    signed: bool = True

    @property
    def entry(self) -> int:
        """The object as an entry of a PDO mapping."""
        return self.index << 16 | self.sub << 8 | self.bits

    @property
    def limits(self) -> tuple[int, int]:
        """Least and greatest count."""
        return limits(self.bits, self.signed)

    def __str__(self) -> str:
        return f"0x{self.index:04X}:{self.sub:02X} ({'' if self.signed else 'unsigned '}{self.bits} bit)"


@dataclass(frozen=True, slots=True)
class Object:
    """An object of a node's dictionary that we write, `size` bytes."""

    index: int
    sub: int
    size: int


Channels = tuple[Channel, Channel, Channel, Channel]

STANDARD_CHANNELS: Channels = (
    Channel(0x6401, 1),
    Channel(0x6401, 2),
    Channel(0x6401, 3),
    Channel(0x6401, 4),
)
"""CiA 401's analogue inputs."""


def parse(text: str) -> tuple[int, int, tuple[int, bool] | None]:
    """Index, sub-index and, where told, type (bits, signed) of INDEX:SUB[:TYPE]: "0x6401:1", "0x2001:0:u24".

    Raises EdsError for any other form.
    """
    form = _FORM.fullmatch(text)
    if form is None or not int(form[1], 16) >= 1 or int(form[2], 0) > 254:
        raise eds.EdsError(
            f'"{text}" is no object; write INDEX:SUB such as "0x6401:1", or with its type "0x2001:1:u24"'
        )
    told = (int(form[4]), form[3] == "i") if form[3] else None
    return int(form[1], 16), int(form[2], 0), told


def channels_of(objects: Sequence[str], path: Path | str | None) -> Channels:
    """The four channels of a kind of node; types come from the object's text, its EDS or CiA's profiles.

    Raises EdsError for a form that `parse` does not know, an object given twice, an unreadable EDS, and
    a type that isn't known, isn't an integer, is wider than 32 bits or contradicts the EDS.
    """
    dictionary = eds.load(path, 1) if path else None
    made: list[Channel] = []
    for text in objects:
        index, sub, told = parse(text)
        listed = eds.integer_type(dictionary, index, sub) if dictionary is not None else None
        if dictionary is not None and listed is None and told is None:
            raise eds.EdsError(f'"{text}": {path} has no such object; correct the object or the EDS')
        if told and listed and told != listed:
            raise eds.EdsError(
                f'"{text}": {path} says {_type(*listed)}; leave the type out, or correct the EDS'
            )
        kind = told or listed or PROFILE_TYPES.get(index)
        if kind is None:
            raise eds.EdsError(f'"{text}": its type is not known; give the EDS, or write it: "{text}:i16"')
        if kind[0] > WIDEST_BITS:
            raise eds.EdsError(f'"{text}" has {kind[0]} bits; channels of at most {WIDEST_BITS} are known')
        if any((channel.index, channel.sub) == (index, sub) for channel in made):
            raise eds.EdsError(f'"{text}" is given twice; each channel has an object of its own')
        made.append(Channel(index, sub, *kind))
    first, second, third, fourth = made
    return first, second, third, fourth


def written(text: str) -> Object:
    """An object that we write, INDEX:SUB:TYPE. Raises EdsError where the type is left out."""
    index, sub, kind = parse(text)
    if kind is None:
        raise eds.EdsError(f'"{text}": its type is not told; write it: "{text}:u8"')
    return Object(index, sub, kind[0] // 8)


def in_order(channels: Channels, electrodes: Sequence[str]) -> Channels:
    """The channels of the electrodes x0, xa, y0, yb; `electrodes` tells what each channel is wired to."""
    x0, xa, y0, yb = (channels[electrodes.index(name)] for name in ELECTRODES)
    return x0, xa, y0, yb


def _type(bits: int, signed: bool) -> str:
    return f"{'i' if signed else 'u'}{bits}"


def full_scale_counts(node: Node) -> int:
    """Count that stands for a node's `full_scale_ma`: as configured, else the greatest of its type."""
    return node.full_scale_counts or greatest_count(node)


def greatest_count(node: Node) -> int:
    """Count that every channel of a node can reach."""
    return min(channel.limits[1] for channel in channels_of(node.channels, node.eds))
