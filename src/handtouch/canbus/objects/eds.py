"""Electronic data sheets (CiA 306): a node's objects, its TPDOs and the types of what these carry.

Public names: `load`, `tpdos`, `TpdoDefault`, `integer_type`, `EdsError`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from canopen import ObjectDictionary

from .eds_file import INTEGERS, MAPPINGS, PDOS, TYPE_NAMES, EdsError, entries, parse, raw_value, variable_at

__all__ = ["EdsError", "TpdoDefault", "integer_type", "load", "tpdos"]

_PREDEFINED_TPDOS = 4
_EVENT_DRIVEN = 255


@dataclass(frozen=True, slots=True)
class TpdoDefault:
    """A TPDO as the node has it after power-on.

    `number` : from 1
    `cob_id` : identifier, 11 bits; 0 where the EDS gives none and CiA 301 has none for this number
    `enabled` : the node sends it, with an 11-bit identifier
    `transmission` : transmission type as in CiA 301; 255, event-driven, where the EDS is silent
    `entries` : (index, sub-index, bits) in the order of transfer, up to the first that the EDS leaves empty;
        indices 1 to 7 are dummy entries, gaps of that length
    `remappable` : its mapping may be written
    """

    number: int
    cob_id: int
    enabled: bool
    transmission: int
    entries: tuple[tuple[int, int, int], ...]
    remappable: bool


def load(path: Path | str, node_id: int) -> ObjectDictionary:
    """Object dictionary of an EDS or DCF file for one node id (1-127), as `canopen.LocalNode` takes it.

    UTF-8, Latin-1 and UTF-16. Of keys and sections that come twice the first counts, as in Windows' own INI
    functions, with which most vendors' tools read them. Raises EdsError.
    """
    try:
        raw = Path(path).read_bytes()
    except (OSError, ValueError) as error:  # ValueError: no path at all, as with a NUL in it
        raise EdsError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    return parse(str(path), raw, node_id)


def tpdos(dictionary: ObjectDictionary) -> tuple[TpdoDefault, ...]:
    """All TPDOs of an object dictionary from `load`, by number; a DCF's values count before defaults."""
    return tuple(_tpdo(dictionary, index - PDOS.start + 1) for index in PDOS if index in dictionary)


def integer_type(dictionary: ObjectDictionary, index: int, sub: int) -> tuple[int, bool] | None:
    """(bits, signed) of an integer object; None where the dictionary hasn't the object.

    8 to 64 bits in steps of 8. Raises EdsError for any other type, naming object and type.
    """
    variable = variable_at(dictionary, index, sub)
    if variable is None:
        return None
    kind = variable.data_type
    if kind not in INTEGERS:
        name = TYPE_NAMES.get(kind, f"of type {kind}")
        raise EdsError(
            f'object 0x{index:04X} sub {sub} "{variable.name}" is {name}; an integer is needed here'
        )
    return INTEGERS[kind]


def _tpdo(dictionary: ObjectDictionary, number: int) -> TpdoDefault:
    communication, mapping = PDOS[number - 1], MAPPINGS[number - 1]
    node_id = dictionary.node_id or 0
    predefined = 0x80 + 0x100 * number if number <= _PREDEFINED_TPDOS else 0
    cob_id = raw_value(dictionary, communication, 1)
    if cob_id is None:
        cob_id = predefined
    if predefined and cob_id & 0x7FF == predefined:  # some files leave the node id to the firmware
        cob_id += node_id
    transmission = raw_value(dictionary, communication, 2)
    subs = [variable_at(dictionary, mapping, sub) for sub in (0, 1)]
    writable = [bool(variable.writable) for variable in subs if variable is not None]
    return TpdoDefault(
        number=number,
        cob_id=cob_id & 0x7FF,
        enabled=bool(cob_id & 0x7FF) and not cob_id & (1 << 31 | 1 << 29),
        transmission=_EVENT_DRIVEN if transmission is None else transmission,
        entries=tuple(entries(dictionary, mapping)),
        remappable=bool(writable) and all(writable),
    )
