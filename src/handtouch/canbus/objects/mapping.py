"""Which PDOs carry a node's four channels, and where: read from the node, taken from its EDS, or mapped anew.

Public names: `Tpdo`, `Mapping`, `arrange`, `from_eds`, `read_mapping`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from handtouch.canbus.bus.slab import PDO_BYTES, Field, Layout

from . import eds
from .channels import Channel, Channels
from .sdo import Sdo, StepError

DEFAULT_TPDOS = (2, 1, 3, 4)
"""Without an EDS: the four of the predefined connection set, that of CiA 401's analogue inputs first."""
NOT_VALID = 1 << 31
"""Bit of a PDO's identifier in 0x1800 + n sub 1 that switches it off."""
COMMUNICATION, MAPPING = 0x1800, 0x1A00
_NO_REMOTE, _EXTENDED, _IDENTIFIER = 1 << 30, 1 << 29, 0x7FF
_FOR_PDOS = frozenset({*range(0x181, 0x581), 0x600, *range(0x680, 0x6E0)})  # others have a use in CANopen
_PREDEFINED = 4
_PDO_BITS = 8 * PDO_BYTES


@dataclass(frozen=True, slots=True)
class Tpdo:
    """A TPDO as the node has it; `entries` are the mapped objects, as 0x1A00 + n holds them.

    `no_remote`: bit 30 of its identifier, which many nodes don't let anybody change.
    """

    number: int
    cob_id: int
    enabled: bool
    transmission: int
    entries: tuple[int, ...]
    no_remote: int = 0

    @property
    def on(self) -> int:
        """0x1800 + n sub 1 while it is sent."""
        return self.cob_id | self.no_remote

    @property
    def off(self) -> int:
        """0x1800 + n sub 1 while it isn't."""
        return self.on | NOT_VALID

    @property
    def size(self) -> int:
        """Bytes of data."""
        return (sum(entry & 0xFF for entry in self.entries) + 7) // 8


@dataclass(frozen=True, slots=True)
class Mapping:
    """The TPDOs that carry the four channels, and where in them each is."""

    tpdos: tuple[Tpdo, ...]
    layout: Layout


def arrange(tpdos: Sequence[Tpdo], channels: Channels) -> Mapping | None:
    """Find the channels in TPDOs, in one of them if one has all; None where some are in none.

    Raises StepError for a channel that is mapped with another width than its type's.
    """
    places = [dict(_places(tpdo, channels)) for tpdo in tpdos]
    order = sorted(range(len(tpdos)), key=lambda number: -len(places[number]))
    where = [next((n for n in order if channel in places[n]), None) for channel in channels]
    if any(number is None for number in where):
        return None
    used = sorted({number for number in where if number is not None})
    fields = [
        Field(used.index(number), places[number][channel], channel.bits, channel.signed)
        for number, channel in zip(where, channels, strict=True)
        if number is not None
    ]
    x0, xa, y0, yb = fields
    return Mapping(tuple(tpdos[number] for number in used), (x0, xa, y0, yb))


def from_eds(path: Path | str | None, node_id: int, channels: Channels) -> Mapping:
    """The mapping that a node has from the factory, by its EDS; without one CiA 401's, in TPDO2.

    Raises EdsError where no TPDO of the EDS carries the channels.
    """
    if path is None:
        standard = Tpdo(2, 0x280 + node_id, True, 1, tuple(channel.entry for channel in channels))
        found = arrange((standard,), channels)
        if found is None or standard.size > PDO_BYTES:
            raise eds.EdsError("channels of more than 64 bits come in several PDOs; give the node's eds")
        return found
    listed = [
        Tpdo(
            t.number,
            t.cob_id,
            t.enabled,
            t.transmission,
            tuple(i << 16 | s << 8 | b for i, s, b in t.entries),
        )
        for t in eds.tpdos(eds.load(path, node_id))
        if t.cob_id
    ]
    try:
        found = arrange(listed, channels)
        for tpdo in found.tpdos if found else ():
            _checked(tpdo.number, tpdo.cob_id, tpdo.cob_id)
    except StepError as error:
        raise eds.EdsError(f"{path}: {error}") from error
    if found is None:
        raise eds.EdsError(f"{path}: no TPDO carries {_names(channels)}; {_seen(listed)}; correct channels")
    return found


def tpdo_numbers(path: Path | str | None, channels: Channels) -> tuple[int, ...]:
    """TPDOs in which to look for the channels, those first that carry some of them by the EDS."""
    if path is None:
        return DEFAULT_TPDOS
    wanted = {(channel.index, channel.sub) for channel in channels}
    listed = eds.tpdos(eds.load(path, 1))
    carries = {t.number: len(wanted & {(index, sub) for index, sub, _ in t.entries}) for t in listed}
    return tuple(sorted(carries, key=lambda number: -carries[number]))


def read_mapping(
    sdo: Sdo,
    node_id: int,
    numbers: Sequence[int],
    channels: Channels,
    halt: Callable[[], None] | None = None,
) -> Mapping:
    """Find the TPDOs that carry the channels, among those numbers in this order.

    Where none do and `halt` is given, which makes the node pre-operational, the channels are mapped to TPDOs
    that carry nothing else. Raises StepError telling what there is where that can't be.
    """
    seen: list[Tpdo] = []
    for number in numbers:
        entries = _entries(sdo, number)
        if entries is None:
            continue
        seen.append(Tpdo(number, 0, False, 0, entries))
        found = arrange(seen, channels)
        if found is not None:
            tpdos = tuple(_communication(sdo, tpdo) for tpdo in found.tpdos)
            return Mapping(tpdos, found.layout)
    if halt is None:
        raise StepError(
            f"no TPDO carries {_names(channels)}; {_seen(seen)}; map them in the node and store the mapping, "
            "or correct channels in the deployment"
        )
    return _remap(sdo, node_id, seen, channels, halt)


def _places(tpdo: Tpdo, channels: Channels) -> list[tuple[Channel, int]]:
    """Channels in a TPDO, with the first bit of each."""
    found, bit = [], 0
    by_object = {channel.entry >> 8: channel for channel in channels}
    for entry in tpdo.entries:
        channel = by_object.get(entry >> 8)
        if channel is not None and entry & 0xFF != channel.bits:
            raise StepError(f"TPDO{tpdo.number} carries {channel} with {entry & 0xFF} bits; correct its type")
        if channel is not None:
            found.append((channel, bit))
        bit += entry & 0xFF
    return found if bit <= _PDO_BITS else []


def _entries(sdo: Sdo, number: int) -> tuple[int, ...] | None:
    """Objects mapped to a TPDO; None where the node hasn't got it."""
    index, what = MAPPING + number - 1, f"mapping of TPDO{number}"
    count = sdo.read_optional(index, 0, what)
    if count is None:
        return None
    if count > _PDO_BITS:  # 254 and 255 are multiplexed PDOs
        return ()
    return tuple(filter(None, (sdo.read(index, sub, what) for sub in range(1, count + 1))))


def _communication(sdo: Sdo, tpdo: Tpdo) -> Tpdo:
    index = COMMUNICATION + tpdo.number - 1
    cob_id = sdo.read(index, 1, f"identifier of TPDO{tpdo.number}")
    identifier = _checked(tpdo.number, cob_id, cob_id & _IDENTIFIER)
    transmission = sdo.read(index, 2, f"transmission type of TPDO{tpdo.number}")
    enabled = not cob_id & NOT_VALID
    return Tpdo(tpdo.number, identifier, enabled, transmission, tpdo.entries, cob_id & _NO_REMOTE)


def _checked(number: int, cob_id: int, identifier: int) -> int:
    """The identifier of a TPDO, if it can have that one."""
    told = f"(0x{COMMUNICATION + number - 1:04X}:01 is 0x{cob_id:08X})"
    if cob_id & _EXTENDED or not identifier:
        raise StepError(f"TPDO{number} has no 11-bit identifier {told}")
    if identifier not in _FOR_PDOS:
        raise StepError(
            f"TPDO{number} has identifier 0x{identifier:X}, which CANopen uses otherwise {told}; "
            "give it another, and store it"
        )
    return identifier


def _remap(
    sdo: Sdo, node_id: int, seen: Sequence[Tpdo], channels: Channels, halt: Callable[[], None]
) -> Mapping:
    """Map the channels, in order, to as few TPDOs as hold them."""
    ours = {channel.entry >> 8 for channel in channels}
    free = [tpdo for tpdo in seen if all(entry >> 8 in ours for entry in tpdo.entries)]
    groups = _groups(channels)
    if len(free) < len(groups):
        raise StepError(
            f"no TPDO carries {_names(channels)}, and {len(groups)} that carry nothing else are needed to "
            f"map them; {_seen(seen)}; map them in the node and store the mapping"
        )
    halt()
    made = [
        _map(sdo, node_id, tpdo.number, tuple(channel.entry for channel in group))
        for tpdo, group in zip(free, groups, strict=False)
    ]
    found = arrange(made, channels)
    if found is None:
        raise StepError(f"mapped, but no TPDO carries {_names(channels)}; {_seen(made)}")
    return found


def _map(sdo: Sdo, node_id: int, number: int, entries: tuple[int, ...]) -> Tpdo:
    """As CiA 301 has it: the PDO off, its mapping emptied, filled and counted; `configure` switches it on."""
    communication, mapping = COMMUNICATION + number - 1, MAPPING + number - 1
    what, name = f"mapping of TPDO{number}", f"identifier of TPDO{number}"
    cob_id = sdo.read(communication, 1, name)
    identifier = cob_id & _IDENTIFIER
    if not identifier and number <= _PREDEFINED:
        identifier = 0x80 + 0x100 * number + node_id
    no_remote = cob_id & _NO_REMOTE
    made = Tpdo(number, _checked(number, cob_id, identifier), False, 0, entries, no_remote)
    sdo.set(communication, 1, made.off, 4, name)
    sdo.set(mapping, 0, 0, 1, what)
    for sub, entry in enumerate(entries, 1):
        sdo.write(mapping, sub, entry, 4, what)
    sdo.write(mapping, 0, len(entries), 1, what)
    transmission = sdo.read(communication, 2, f"transmission type of TPDO{number}")
    return replace(made, transmission=transmission)


def _groups(channels: Channels) -> list[list[Channel]]:
    groups: list[list[Channel]] = [[]]
    for channel in channels:
        if sum(c.bits for c in groups[-1]) + channel.bits > _PDO_BITS:
            groups.append([])
        groups[-1].append(channel)
    return groups


def _names(channels: Channels) -> str:
    return ", ".join(map(str, channels))


def _seen(tpdos: Sequence[Tpdo]) -> str:
    if not tpdos:
        return "the node has no TPDO"
    return "; ".join(f"TPDO{t.number} has {', '.join(map(_entry, t.entries)) or 'nothing'}" for t in tpdos)


def _entry(entry: int) -> str:
    return f"0x{entry >> 16:04X}:{entry >> 8 & 0xFF:02X} ({entry & 0xFF} bit)"
