"""Electronic data sheets (CiA 306): a node's objects, its default TPDOs and the types of objects.

Public names: `load_eds`, `default_tpdos`, `TpdoDefault`, `ValueType`, `REAL32`, `value_type`, `EdsError`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from canopen import ObjectDictionary
from canopen.objectdictionary import datatypes

from handtouch.config.eds_file import (
    INTEGER_TYPES,
    TPDO_INDICES,
    TPDO_MAPPING_INDICES,
    TYPE_NAMES,
    EdsError,
    mapping_entries,
    parse_eds,
    raw_value,
    variable_at,
)

__all__ = ["REAL32", "EdsError", "TpdoDefault", "ValueType", "default_tpdos", "load_eds", "value_type"]

_PREDEFINED_TPDO_COUNT = 4
_EVENT_DRIVEN = 255


class ValueType(NamedTuple):
    """Type of an object: an integer, or REAL32 (`is_real`)."""

    bits: int
    signed: bool = True
    is_real: bool = False

    def __str__(self) -> str:
        return f"{'f' if self.is_real else 'i' if self.signed else 'u'}{self.bits}"


REAL32 = ValueType(32, is_real=True)


@dataclass(frozen=True, slots=True)
class TpdoDefault:
    """Default of a TPDO, after power-on.

    `number` : from 1
    `cob_id` : 11-bit identifier; 0 if neither the EDS nor CiA 301 has one for this number
    `enabled` : valid, with an 11-bit identifier
    `transmission_type` : transmission type as in CiA 301; 255, event-driven, where the EDS is silent
    `mapping_entries` : (index, sub-index, bits) in the order of transfer, up to the first that the EDS
    leaves empty;
        indices 1 to 7 are dummy entries, gaps of that length
    `extended_cob_id` : its 29-bit COB-ID, with bit 29; 0 if it has an 11-bit one
    """

    number: int
    cob_id: int
    enabled: bool
    transmission_type: int
    entries: tuple[tuple[int, int, int], ...]
    extended_cob_id: int = 0


def load_eds(path: Path | str, node_id: int) -> ObjectDictionary:
    """Load the object dictionary of an EDS or DCF file for one node id (1-127).

    UTF-8, Latin-1 and UTF-16. Of keys and sections that come twice the first counts, as in Windows' own INI
    functions, with which most vendors' tools read them. Raises EdsError.
    """
    try:
        raw = Path(path).read_bytes()
    except (OSError, ValueError) as error:  # ValueError: no path at all, as with a NUL in it
        raise EdsError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    return parse_eds(str(path), raw, node_id)


def default_tpdos(dictionary: ObjectDictionary) -> tuple[TpdoDefault, ...]:
    """Return the TPDOs of an object dictionary by number; values of a DCF precede defaults."""
    return tuple(
        _default_tpdo(dictionary, index - TPDO_INDICES.start + 1)
        for index in TPDO_INDICES
        if index in dictionary
    )


def value_type(dictionary: ObjectDictionary, index: int, sub: int) -> ValueType | None:
    """Return the type of a number; None if the dictionary doesn't have the object.

    Integers of 8 to 64 bits in steps of 8, and REAL32. Raises EdsError for any other type, with file, line,
    object and type.
    """
    variable = variable_at(dictionary, index, sub)
    if variable is None:
        return None
    kind = variable.data_type
    if kind == datatypes.REAL32:
        return REAL32
    if kind not in INTEGER_TYPES:
        name = TYPE_NAMES.get(kind, f"of type {kind}")
        raise EdsError(
            f'{variable.location}: object 0x{index:04X} sub {sub} "{variable.name}" is {name}; an integer or '
            "REAL32 is needed here"
        )
    return ValueType(*INTEGER_TYPES[kind])


def _default_tpdo(dictionary: ObjectDictionary, number: int) -> TpdoDefault:
    communication, mapping = TPDO_INDICES[number - 1], TPDO_MAPPING_INDICES[number - 1]
    node_id = dictionary.node_id or 0
    predefined = 0x80 + 0x100 * number if number <= _PREDEFINED_TPDO_COUNT else 0
    cob_id = raw_value(dictionary, communication, 1)
    if cob_id is None:
        cob_id = predefined
    if predefined and cob_id & 0x7FF == predefined:  # in some files the firmware adds the node id
        cob_id += node_id
    transmission = raw_value(dictionary, communication, 2)
    return TpdoDefault(
        number=number,
        cob_id=cob_id & 0x7FF,
        enabled=bool(cob_id & 0x7FF) and not cob_id & (1 << 31 | 1 << 29),
        transmission_type=_EVENT_DRIVEN if transmission is None else transmission,
        entries=tuple(mapping_entries(dictionary, mapping)),
        extended_cob_id=cob_id & 0x3FFF_FFFF if cob_id & 1 << 29 else 0,
    )
