"""Columns: fields of a payload that hold one row per pad, as packed little-endian binary.

Public names: `Column`, `HandColumn`, `columns_of`, `is_array`, `vector_length`.

A payload declares a column by annotating a `bytes` field: `force_n: Annotated[bytes, Column("<f4")]`.
"""

from __future__ import annotations

import typing
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray


_TYPE_NAMES = {"<u1": "uint8", "<u4": "uint32", "<i8": "int64", "<f4": "float32", "<f8": "float64"}


@dataclass(frozen=True)
class Column:
    """Layout of a column."""

    dtype: str
    """numpy name of the element type, little-endian: <u1, <u4, <i8, <f4 or <f8"""
    elements: int = 1
    """per row"""
    codes: type[IntEnum] | None = None
    """meaning of the values, for a column of status codes"""
    is_least: bool = False
    """rows may have more elements"""

    @property
    def type_name(self) -> str:
        """Name of the element type: uint8, uint32, int64, float32 or float64."""
        return _TYPE_NAMES[self.dtype]

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return self.elements * int(self.dtype[-1])

    def fits(self, size: int, rows: int) -> bool:
        """Return whether so many bytes are as many rows."""
        expected = rows * self.row_bytes
        more = self.is_least and size > expected > 0 and size % (rows * int(self.dtype[-1])) == 0
        return size == expected or more

    def to_array(self, data: bytes, rows: int | None = None) -> NDArray[Any]:
        """Return a read-only array of the column, (n,) or (n, elements).

        rows: n, needed where a row may have more elements. Raises ValueError for bytes that are no
        whole number of rows.
        """
        import numpy as np  # costs 0.1 s, and a plain subscriber needs no arrays

        values = np.frombuffer(data, dtype=self.dtype)
        if rows is not None:
            return values.reshape(rows, -1)
        return values if self.elements == 1 else values.reshape(-1, self.elements)


@dataclass(frozen=True)
class HandColumn:
    """Mark of a field of `Contact` that is a column of hand frames, too."""

    meaning: str = "as in `contact`"


def is_array(hint: Any) -> bool:
    """Return True for the type of a numpy array, without importing numpy (2.5 has an alias)."""
    return getattr(typing.get_origin(hint), "__name__", "") in ("ndarray", "NDArray")


def vector_length(hint: Any) -> int:
    """Return the number of elements of a vector of numbers, which may be None; 0 of another type."""
    for option in (hint, *typing.get_args(hint)):
        items = typing.get_args(option)
        if typing.get_origin(option) is tuple and set(items) == {float}:
            return len(items)
    return 0


def columns_of(payload: type[Any]) -> dict[str, Column]:
    """Return the columns that a payload declares, by name."""
    hints = typing.get_type_hints(payload, include_extras=True)
    declared = {
        field.name: [
            extra for extra in getattr(hints[field.name], "__metadata__", ()) if isinstance(extra, Column)
        ]
        for field in fields(payload)
    }
    return {name: found[0] for name, found in declared.items() if found}
