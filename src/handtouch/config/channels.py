"""Objects of a node's channels, with their types, from configuration and EDS.

A channel is an integer, its count, or REAL32: count = value x counts per unit, rounded.

Public names: `Channel`, `Channels`, `WritableObject`, `STANDARD_CHANNELS`, `PROFILE_TYPES`,
`resolve_channels`, `order_by_electrode`, `order_channels`, `channel_states`, `parse_object`,
`parse_writable_object`, `node_channels`, `full_scale_counts`, `max_count`, `integer_limits`,
`saturation_limits`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from handtouch.config import Node, Pad, eds
from handtouch.config.eds import REAL32, ValueType
from handtouch.config.roles import ELECTRODE, channel_numbers, column_channels

MAX_CHANNEL_BITS = 32
_MIN_CONVERTER_BITS = 8  # no converter of a sensor node has fewer
_OBJECT_PATTERN = re.compile(
    r"0x([0-9A-Fa-f]{4}):(0x[0-9A-Fa-f]{1,2}|\d{1,3})"
    r"(?::(?:([iu])([89]|[12]\d|3[0-2])|f32/(\d+(?:\.\d+)?(?:e[+-]?\d+)?)))?"
)
PROFILE_TYPES = {  # CiA 401 and CiA 404: read analogue input, process and field values
    0x6100: REAL32,
    0x6130: REAL32,
    0x6400: ValueType(8),
    0x6401: ValueType(16),
    0x6402: ValueType(32),
    0x6403: REAL32,
    0x7100: ValueType(16),
    0x7130: ValueType(16),
    0x8100: ValueType(24),
    0x8130: ValueType(24),
    0x9100: ValueType(32),
    0x9130: ValueType(32),
}


def integer_limits(bits: int, signed: bool, max_count: int | None = None) -> tuple[int, int]:
    """Return the minimum and maximum count of an integer type, or of a converter that ends at `max_count`."""
    high = (1 << bits - signed) - 1 if max_count is None else max_count
    return (-high - 1 if signed else 0, high)


def saturation_limits(limits: tuple[int, int], signed: bool) -> tuple[float, float]:
    """Return the counts at and beyond which a reading is saturated, of a channel with these limits.

    An amplifier at its lower limit gives either of the two lowest counts. An unsigned channel has no lower
    limit: it reads zero without a current.
    """
    return (limits[0] + 1 if signed else -math.inf, limits[1])


@dataclass(frozen=True, slots=True)
class Channel:
    """Object that carries one channel: its address and its type.

    `counts_per_unit` : of a REAL32 object, None for an integer; `max_count`: None: that of its type
    """

    index: int
    sub: int
    bits: int = 16
    signed: bool = True
    counts_per_unit: float | None = None
    max_count: int | None = None

    @property
    def mapping_entry(self) -> int:
        """Entry of the object in a PDO mapping."""
        return self.index << 16 | self.sub << 8 | self.bits

    @property
    def limits(self) -> tuple[int, int]:
        """Minimum and maximum count."""
        return integer_limits(self.bits, self.signed, self.max_count)

    @property
    def saturation(self) -> tuple[float, float]:
        """Counts at and beyond which a reading is saturated, see `saturation_limits`."""
        return saturation_limits(self.limits, self.signed)

    def __str__(self) -> str:
        integer = f"{'' if self.signed else 'unsigned '}{self.bits} bit"
        kind = integer if self.counts_per_unit is None else "REAL32"
        return f"0x{self.index:04X}:{self.sub:02X} ({kind})"


@dataclass(frozen=True, slots=True)
class WritableObject:
    """Object that handtouch writes, of `size_bytes` bytes."""

    index: int
    sub: int
    size_bytes: int


Channels = tuple[Channel, ...]

STANDARD_CHANNELS: Channels = (
    Channel(0x6401, 1),
    Channel(0x6401, 2),
    Channel(0x6401, 3),
    Channel(0x6401, 4),
)
"""CiA 401's analogue inputs."""


def parse_object(text: str) -> tuple[int, int, ValueType | None, float | None]:
    """Return index, sub-index, type and counts per unit of INDEX:SUB[:TYPE].

    "0x2001:0:u24" is an integer of 8 to 32 bits, "0x6403:1:f32/1000" REAL32 with 1000 counts per unit; the
    type is None where it is left out, the counts per unit are None for all but REAL32. Raises EdsError for
    any other form.
    """
    form = _OBJECT_PATTERN.fullmatch(text)
    if form is None or not int(form[1], 16) >= 1 or int(form[2], 0) > 254:
        raise eds.EdsError(
            f'"{text}" is no object; write INDEX:SUB such as "0x6401:1", or with its type "0x2001:1:u24"'
        )
    counts_per_unit = float(form[5]) if form[5] else None
    if counts_per_unit is not None and not 0 < counts_per_unit < math.inf:
        raise eds.EdsError(f'"{text}": the counts per unit must be above 0 and finite')
    kind = ValueType(int(form[4]), form[3] == "i") if form[3] else REAL32 if form[5] else None
    return int(form[1], 16), int(form[2], 0), kind, counts_per_unit


def resolve_channels(objects: Sequence[str], path: Path | str | None) -> Channels:
    """Return the four channels of a kind of node, with types from the text, the EDS or the CiA profiles.

    A type may be narrower than that in the EDS: a PDO carries the low bits. Raises EdsError for a form
    unknown to `parse_object`, an object given twice, an unreadable EDS, and a type that is unknown, neither
    an integer nor REAL32, wider than 32 bits or contradicts the EDS.
    """
    dictionary = eds.load_eds(path, 1) if path else None
    channels: list[Channel] = []
    for text in objects:
        index, sub, given, counts_per_unit = parse_object(text)
        listed = eds.value_type(dictionary, index, sub) if dictionary is not None else None
        if dictionary is not None and listed is None and given is None:
            raise eds.EdsError(f'"{text}": {path} has no such object; correct the object or the EDS')
        if given and listed and given != listed and not _is_low_part(given, listed):
            raise eds.EdsError(f'"{text}": {path} has {listed}; leave the type out, or correct the EDS')
        kind = given or listed or PROFILE_TYPES.get(index)
        if kind is None:
            raise eds.EdsError(f'"{text}": its type is unknown; give the EDS, or the type: "{text}:i16"')
        if kind.bits > MAX_CHANNEL_BITS:
            raise eds.EdsError(f'"{text}" has {kind.bits} bits; at most {MAX_CHANNEL_BITS} are supported')
        if kind.is_real and counts_per_unit is None:
            raise eds.EdsError(f'"{text}" is REAL32; add its counts per unit: "{text}:f32/1000"')
        if any((channel.index, channel.sub) == (index, sub) for channel in channels):
            raise eds.EdsError(f'"{text}" is given twice; each channel needs its own object')
        channels.append(Channel(index, sub, kind.bits, kind.signed, counts_per_unit))
    return tuple(channels)


def _is_low_part(given: ValueType, whole: ValueType) -> bool:
    """Return True for the low bits of a wider integer, which a PDO may carry instead of all."""
    integers = not given.is_real and not whole.is_real and given.signed == whole.signed
    return integers and given.bits < whole.bits


def parse_writable_object(text: str) -> WritableObject:
    """Parse an object to write, INDEX:SUB:TYPE. Raises EdsError if the type is missing."""
    index, sub, kind, _ = parse_object(text)
    if kind is None:
        raise eds.EdsError(f'"{text}": its type is missing; add it: "{text}:u8"')
    if kind.is_real:
        raise eds.EdsError(f'"{text}" is REAL32; only integers are written')
    if kind.bits % 8:
        raise eds.EdsError(f'"{text}" has {kind.bits} bits; objects of 8, 16, 24 and 32 bits are written')
    return WritableObject(index, sub, kind.bits // 8)


def order_by_electrode(channels: Channels, pad: Pad) -> Channels:
    """Return the channels of a pad's electrodes, in their order; `channels` are those of its node."""
    return tuple(channels[number] for number in channel_numbers(pad, ELECTRODE))


def order_channels(channels: Channels, pad: Pad) -> Channels:
    """Return the channels of a pad by their roles, each in the order of the core's columns."""
    return tuple(channels[number] for number in column_channels(pad))


def channel_states(pad: Pad) -> tuple[int, ...]:
    """Return the state of `switch_states` in which each electrode's channel is measured; () without."""
    if not pad.switch_states:
        return ()
    return tuple(
        next(number for number, state in enumerate(pad.switch_states) if name in state)
        for name in pad.electrode_names
    )


def node_channels(node: Node) -> Channels:
    """Return the channels of a kind of node, with the range of its converters. Raises EdsError."""
    channels = resolve_channels(node.channels, node.eds)
    return tuple(replace(channel, max_count=_converter_max_count(node, channel)) for channel in channels)


def _converter_max_count(node: Node, channel: Channel) -> int | None:
    """Return the greatest count of a channel's converter; None: that of its type.

    Without `max_count`, a `full_scale_counts` of 2^k or 2^k - 1 is that of a converter of k bits.
    """
    most = channel.limits[1]
    full = node.full_scale_counts or 0
    if node.max_count is None and channel.counts_per_unit is None and full > 1:
        bits = full.bit_length() - (full & (full - 1) == 0)
        if bits >= _MIN_CONVERTER_BITS and full + 1 >= 1 << bits and (1 << bits) - 1 < most:
            return (1 << bits) - 1
    return node.max_count if node.max_count is not None and node.max_count < most else None


def full_scale_counts(node: Node) -> int:
    """Return the count of a node's `full_scale_ma`: as configured, else the maximum of its channels."""
    return node.full_scale_counts or max_count(node)


def max_count(node: Node) -> int:
    """Return the greatest count that every channel of a node can reach."""
    return min(channel.limits[1] for channel in node_channels(node))
