"""PDO mapping of a node's channels: read from the node, taken from its EDS, or written to the node.

Public names: `NodeTpdo`, `PdoMapping`, `find_channels`, `mapping_from_eds`, `tpdo_numbers`, `read_mapping`,
`write_entries`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from handtouch.canbus import cia301
from handtouch.canbus.objects.sdo import BootStepError, NodeSdoClient
from handtouch.config import eds
from handtouch.config.channels import Channel, Channels
from handtouch.config.eds import ValueType
from handtouch.core.slab import PDO_BYTES, ChannelField, ChannelLayout

DEFAULT_TPDO_NUMBERS = (2, 1, 3, 4)
"""Without an EDS: those of the predefined connection set, that of CiA 401's analogue inputs first."""
_FURTHER_TPDOS = 12
"""TPDOs 5 to 16 are searched, too, in nodes without an EDS, until one is missing."""
_MULTIPLEXED = (254, 255)
LENGTH_BIT_7 = 0x80
"""A length is 64 bits at most; some nodes set this bit, which means nothing."""
_PDO_IDENTIFIERS = frozenset({*range(0x181, 0x581), 0x600, *range(0x680, 0x6E0)})
"""Identifiers that CANopen doesn't reserve for other services."""
_PDO_BITS = 8 * PDO_BYTES


@dataclass(frozen=True, slots=True)
class NodeTpdo:
    """A TPDO of a node; `entries` are the mapped objects in the format of 0x1A00 + n.

    `no_rtr_bit`: bit 30 of its identifier, which is read-only in many nodes.
    """

    number: int
    cob_id: int
    enabled: bool
    transmission_type: int
    entries: tuple[int, ...]
    no_rtr_bit: int = 0

    @property
    def enabled_entry(self) -> int:
        """Value of 0x1800 + n sub 1 that enables the TPDO."""
        return self.cob_id | self.no_rtr_bit

    @property
    def disabled_entry(self) -> int:
        """Value of 0x1800 + n sub 1 that disables the TPDO."""
        return self.enabled_entry | cia301.INVALID_BIT

    @property
    def size_bytes(self) -> int:
        """Length of its data."""
        return (sum(entry & 0xFF for entry in self.entries) + 7) // 8


@dataclass(frozen=True, slots=True)
class PdoMapping:
    """TPDOs that carry the channels, and the layout of the channels in them.

    `states` : of a pad with a schedule, the state that each TPDO carries
    """

    tpdos: tuple[NodeTpdo, ...]
    layout: ChannelLayout
    states: tuple[int, ...] = ()


def find_channels(
    tpdos: Sequence[NodeTpdo], channels: Channels, states: Sequence[int] = ()
) -> PdoMapping | None:
    """Return the mapping of the channels, to a single TPDO if one has all; None if a channel isn't mapped.

    states: of a schedule, that of each channel; None unless each state has a TPDO of its own.

    Raises BootStepError for a channel that is mapped with another width than that of its type.
    """
    offsets = [dict(_channel_offsets(tpdo, channels)) for tpdo in tpdos]
    order = sorted(range(len(tpdos)), key=lambda row: -len(offsets[row]))
    rows = [next((row for row in order if channel in offsets[row]), None) for channel in channels]
    if any(row is None for row in rows):
        return None
    used = sorted({row for row in rows if row is not None})
    fields = [
        ChannelField(
            used.index(row),
            offsets[row][channel],
            channel.bits,
            channel.signed,
            channel.counts_per_unit,
            channel.max_count,
        )
        for row, channel in zip(rows, channels, strict=True)
        if row is not None
    ]
    found = tuple(tpdos[row] for row in used)
    if not states:
        return PdoMapping(found, tuple(fields))
    carried = {(field.pdo, state) for field, state in zip(fields, states, strict=True)}
    if not len(carried) == len(used) == len(set(states)):
        return None
    return PdoMapping(found, tuple(fields), tuple(state for _, state in sorted(carried)))


def mapping_from_eds(
    path: Path | str | None, node_id: int, channels: Channels, states: Sequence[int] = ()
) -> PdoMapping:
    """Return the default mapping by a node's EDS; without an EDS that of CiA 401, in TPDO2.

    states: see `find_channels`.

    Raises EdsError if no TPDO of the EDS carries the channels.
    """
    if path is None:
        entries = tuple(channel.mapping_entry for channel in channels)
        standard = NodeTpdo(2, cia301.tpdo_identifier(2) + node_id, True, cia301.SYNCHRONOUS, entries)
        mapping = find_channels((standard,), channels)
        if mapping is None or standard.size_bytes > PDO_BYTES:
            raise eds.EdsError("channels of more than 64 bits need several PDOs; give the node's eds")
        return mapping
    listed = eds.default_tpdos(eds.load_eds(path, node_id))
    cob_ids = {t.number: t.extended_cob_id or t.cob_id for t in listed}
    defaults = [
        NodeTpdo(
            t.number,
            t.cob_id,
            t.enabled,
            t.transmission_type,
            tuple(i << 16 | s << 8 | b for i, s, b in t.entries),
        )
        for t in listed
        if cob_ids[t.number]
    ]
    try:
        mapping = find_channels(defaults, channels, states)
        for tpdo in mapping.tpdos if mapping else ():
            _check_identifier(tpdo.number, cob_ids[tpdo.number], tpdo.cob_id)
    except BootStepError as error:
        raise eds.EdsError(f"{path}: {error}") from error
    if mapping is None:
        raise eds.EdsError(
            f"{path}: no TPDO carries {_channel_names(channels)}{_by_states(states)}; "
            f"{_describe_tpdos(defaults)}; correct channels"
        )
    return mapping


def tpdo_numbers(path: Path | str | None, channels: Channels) -> tuple[int, ...]:
    """Return the TPDOs to search for the channels; first those that carry some by the EDS."""
    if path is None:
        return DEFAULT_TPDO_NUMBERS
    objects = {(channel.index, channel.sub) for channel in channels}
    defaults = eds.default_tpdos(eds.load_eds(path, 1))
    channel_counts = {
        t.number: len(objects & {(index, sub) for index, sub, _ in t.entries}) for t in defaults
    }
    return tuple(sorted(channel_counts, key=lambda number: -channel_counts[number]))


def read_mapping(
    sdo: NodeSdoClient,
    node_id: int,
    numbers: Sequence[int],
    channels: Channels,
    enter_preoperational: Callable[[], None] | None = None,
    states: Sequence[int] = (),
) -> PdoMapping:
    """Read the TPDOs with these numbers, in this order, until all channels are found.

    states: see `find_channels`.

    If a channel isn't mapped and `enter_preoperational` is given, the channels are mapped to TPDOs that carry
    nothing else. Raises BootStepError, with the mappings read, where neither is possible.
    """
    candidates: list[NodeTpdo] = []
    further = range(cia301.PREDEFINED_TPDOS + 1, cia301.PREDEFINED_TPDOS + 1 + _FURTHER_TPDOS)
    for number in (*numbers, *(further if tuple(numbers) == DEFAULT_TPDO_NUMBERS else ())):
        entries = _read_entries(sdo, number)
        if entries is None and number in further:
            break
        if entries is None:
            continue
        candidates.append(NodeTpdo(number, 0, False, 0, entries))
        mapping = find_channels(candidates, channels, states)
        if mapping is not None:
            tpdos = tuple(_read_communication(sdo, tpdo) for tpdo in mapping.tpdos)
            return replace(mapping, tpdos=tpdos)
    if enter_preoperational is None:
        raise BootStepError(
            f"no TPDO carries {_channel_names(channels)}{_by_states(states)}; "
            f"{_describe_tpdos(candidates)}; "
            "map them in the node and store the mapping, or correct channels in the deployment"
        )
    return _remap(sdo, node_id, candidates, channels, enter_preoperational, states)


def _channel_offsets(tpdo: NodeTpdo, channels: Channels) -> list[tuple[Channel, int]]:
    """Return the channels in a TPDO, with the first bit of each."""
    offsets, bit = [], 0
    by_object = {channel.mapping_entry >> 8: channel for channel in channels}
    for entry in tpdo.entries:
        channel = by_object.get(entry >> 8)
        if channel is not None and entry & 0xFF != channel.bits:
            raise BootStepError(
                f"TPDO{tpdo.number} carries {channel} with {entry & 0xFF} bits; write its type, "
                f"0x{channel.index:04X}:{channel.sub}:{ValueType(entry & 0xFF, channel.signed)}"
            )
        if channel is not None:
            offsets.append((channel, bit))
        bit += entry & 0xFF
    return offsets if bit <= _PDO_BITS else []


def _read_entries(sdo: NodeSdoClient, number: int) -> tuple[int, ...] | None:
    """Read the entries of a TPDO's mapping; None if the node doesn't have that TPDO."""
    index, name = cia301.TPDO_MAPPING + number - 1, f"mapping of TPDO{number}"
    count = sdo.read_optional(index, 0, name)
    if count is None:
        return None
    if count in _MULTIPLEXED:
        return ()
    if count > _PDO_BITS:
        raise BootStepError(f"{name}, 0x{index:04X}:00, has {count} objects: an invalid SDO response")
    entries = (sdo.read(index, sub, name) for sub in range(1, count + 1))
    return tuple(entry & ~LENGTH_BIT_7 for entry in entries if entry)


def _read_communication(sdo: NodeSdoClient, tpdo: NodeTpdo) -> NodeTpdo:
    cob_id = sdo.read_tpdo(tpdo.number, 1)
    identifier = _check_identifier(tpdo.number, cob_id, cob_id & cia301.IDENTIFIER_MASK)
    transmission = sdo.read_tpdo(tpdo.number, 2)
    enabled = not cob_id & cia301.INVALID_BIT
    return NodeTpdo(tpdo.number, identifier, enabled, transmission, tpdo.entries, cob_id & cia301.NO_RTR_BIT)


def _check_identifier(number: int, cob_id: int, identifier: int) -> int:
    """Return the identifier of a TPDO. Raises BootStepError if CANopen reserves it."""
    entry = f"(0x{cia301.TPDO_COMMUNICATION + number - 1:04X}:01 is 0x{cob_id:08X})"
    if cob_id & cia301.EXTENDED_BIT or not identifier:
        raise BootStepError(f"TPDO{number} has no 11-bit COB-ID {entry}")
    if identifier not in _PDO_IDENTIFIERS:
        raise BootStepError(
            f"TPDO{number} has COB-ID 0x{identifier:X}, which CANopen reserves for another service "
            f"{entry}; give it another one and store it"
        )
    return identifier


def _remap(
    sdo: NodeSdoClient,
    node_id: int,
    candidates: Sequence[NodeTpdo],
    channels: Channels,
    enter_preoperational: Callable[[], None],
    states: Sequence[int],
) -> PdoMapping:
    """Map the channels, in order, to as few TPDOs as can hold them; those of a schedule by state."""
    objects = {channel.mapping_entry >> 8 for channel in channels}
    free = [tpdo for tpdo in candidates if all(entry >> 8 in objects for entry in tpdo.entries)]
    groups = [
        group
        for state in sorted({*states}) or [-1]
        for group in _group_by_pdo([c for k, c in enumerate(channels) if state < 0 or states[k] == state])
    ]
    if len(free) < len(groups):
        raise BootStepError(
            f"no TPDO carries {_channel_names(channels)}; TPDOs without other objects: {len(free)}, needed "
            f"to map them: {len(groups)}; {_describe_tpdos(candidates)}; map them in the node and store the "
            "mapping"
        )
    enter_preoperational()
    mapped = [
        _map_channels(sdo, node_id, tpdo.number, tuple(channel.mapping_entry for channel in group))
        for tpdo, group in zip(free, groups, strict=False)
    ]
    mapping = find_channels(mapped, channels, states)
    if mapping is None:
        raise BootStepError(
            f"mapped, but no TPDO carries {_channel_names(channels)}{_by_states(states)}; "
            f"{_describe_tpdos(mapped)}"
        )
    return mapping


def _map_channels(sdo: NodeSdoClient, node_id: int, number: int, entries: tuple[int, ...]) -> NodeTpdo:
    """Map a TPDO as CiA 301 requires: disable it, then clear, write and count its entries."""
    cob_id = sdo.read_tpdo(number, 1)
    identifier = cob_id & cia301.IDENTIFIER_MASK
    if not identifier and number <= cia301.PREDEFINED_TPDOS:
        identifier = cia301.tpdo_identifier(number) + node_id
    no_rtr_bit = cob_id & cia301.NO_RTR_BIT
    tpdo = NodeTpdo(number, _check_identifier(number, cob_id, identifier), False, 0, entries, no_rtr_bit)
    before = _read_entries(sdo, number) or ()
    if sdo.read_tpdo(number, 1) != tpdo.disabled_entry:
        sdo.write_tpdo(number, 1, tpdo.disabled_entry)
    try:
        write_entries(sdo, number, entries)
    except BootStepError as error:
        if not error.timed_out:  # as it was: the node doesn't accept the change
            with contextlib.suppress(BootStepError):
                write_entries(sdo, number, before)
                sdo.write_tpdo(number, 1, cob_id)
        raise
    return replace(tpdo, transmission_type=sdo.read_tpdo(number, 2))


def write_entries(sdo: NodeSdoClient, number: int, entries: Sequence[int]) -> None:
    """Map objects to a disabled TPDO."""
    index, name = cia301.TPDO_MAPPING + number - 1, f"mapping of TPDO{number}"
    sdo.write_if_different(index, 0, 0, name)
    for sub, entry in enumerate(entries, 1):
        sdo.write_verified(index, sub, entry, name)
    sdo.write_verified(index, 0, len(entries), name)


def _group_by_pdo(channels: Sequence[Channel]) -> list[list[Channel]]:
    groups: list[list[Channel]] = [[]]
    for channel in channels:
        if sum(c.bits for c in groups[-1]) + channel.bits > _PDO_BITS:
            groups.append([])
        groups[-1].append(channel)
    return groups


def _by_states(states: Sequence[int]) -> str:
    return f", {len({*states})} states of switch_states in a TPDO each" if states else ""


def _channel_names(channels: Channels) -> str:
    return ", ".join(map(str, channels))


def _describe_tpdos(tpdos: Sequence[NodeTpdo]) -> str:
    if not tpdos:
        return "the node has no TPDO"
    return "; ".join(
        f"TPDO{t.number} has {', '.join(map(_describe_entry, t.entries)) or 'nothing'}" for t in tpdos
    )


def _describe_entry(entry: int) -> str:
    return f"0x{entry >> 16:04X}:{entry >> 8 & 0xFF:02X} ({entry & 0xFF} bit)"
