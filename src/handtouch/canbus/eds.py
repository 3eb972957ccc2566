"""Electronic data sheets: which PDOs of a node may carry its four channels.

Public names: `load`, `tpdo_numbers`, `EdsError`.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from canopen.objectdictionary.eds import import_eds

ANALOGUE_INPUT = 0x6401
"""CiA 401: read analogue input, 16 bit."""
DEFAULT_TPDOS = (2, 1, 3, 4)
"""Without an EDS: the four of the predefined connection set, that of CiA 401's analogue inputs first."""
_COMMUNICATION, _MAPPING, _TPDOS = 0x1800, 0x1A00, 512


class EdsError(ValueError):
    """An EDS file that can't be used; `str` names the file and what is wrong."""


def load(path: Path | str, node_id: int) -> Mapping[int, Any]:
    """Object dictionary of an EDS file, `canopen.ObjectDictionary`, for one node id.

    Vendors' files come in UTF-8 and in Latin-1. Raises EdsError.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise EdsError(f"{path}: {error.strerror}") from error
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    try:
        dictionary: Mapping[int, Any] = import_eds(io.StringIO(text), node_id)
    except Exception as error:  # the parser raises whatever its input makes it stumble over
        raise EdsError(f"{path}: is no EDS that can be read: {error}") from error
    return dictionary


def tpdo_numbers(dictionary: Mapping[int, Any]) -> tuple[int, ...]:
    """Numbers (from 1) of the TPDOs in an object dictionary; first those with analogue inputs by default."""
    numbers = [n for n in range(1, _TPDOS + 1) if _COMMUNICATION + n - 1 in dictionary]
    return tuple(sorted(numbers, key=lambda n: not _carries_inputs(dictionary.get(_MAPPING + n - 1))))


def _carries_inputs(mapping: Any) -> bool:
    """Whether a mapping record's defaults name object 0x6401."""
    if mapping is None or not hasattr(mapping, "values"):
        return False
    entries = (entry for entry in mapping.values() if entry.subindex)
    return any(isinstance(e.default, int) and e.default >> 16 == ANALOGUE_INPUT for e in entries)
