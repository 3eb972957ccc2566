"""Memory of arrays as the stages take it: flat memoryviews, which Python reads as its own numbers, and rows
of named numbers.

Public names: `view_memory`, `number_memory`, `view_rows`, `rows_at`, `rows_by_name`, `number_row`,
`slices_of`, `row_count`, `made_once`, `RowArray`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import NoneType
from typing import Any, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

_Made = TypeVar("_Made")
RowArray = np.recarray[tuple[int], np.dtype[np.void]]
_NUMBERS = {float, int, bool, NoneType}
_SIZE = 8
"""Bytes of a number"""


def view_memory(array: NDArray[Any]) -> memoryview[Any]:
    """Return the memory of an array of numbers or truth values, flat.

    Raises ValueError for an array that isn't contiguous, as a copy would be other memory.
    """
    if not array.flags.c_contiguous:
        raise ValueError(f"an array of shape {array.shape} isn't contiguous")
    memory: memoryview[Any] = (array.view(np.uint8) if array.dtype == np.bool_ else array).reshape(-1).data
    return memory


def number_memory(count: int) -> memoryview[float]:
    """Return memory of numbers (count,), all 0."""
    return view_memory(np.zeros(count))


def view_rows(array: NDArray[Any], row: np.dtype[np.void]) -> RowArray:
    """Return the memory of an array as rows (k,) of named numbers."""
    return array.reshape(-1).view(row).view(np.recarray)


def rows_at(rows: RowArray, number: int) -> RowArray:
    """Return one of the rows, as rows (1,) in the same memory."""
    return rows[number : number + 1].view(np.recarray)


def number_row(table: type[BaseModel]) -> np.dtype[np.void]:
    """Return the row of all keys of a table that are numbers; one that isn't given is NaN in it."""
    found = []
    for name, key in table.model_fields.items():
        kinds = get_args(key.annotation) or (key.annotation,)
        if {get_args(kind)[0] if get_args(kind) else kind for kind in kinds} <= _NUMBERS:
            found.append((name, "<f8"))
    return np.dtype(found)


def rows_by_name(row: np.dtype[np.void], items: Iterable[object]) -> RowArray:
    """Return rows (k,) filled with the attributes of k objects of the same names."""
    names = row.names or ()
    return np.array([tuple(getattr(item, name) for name in names) for item in items], row).view(np.recarray)


def slices_of(row: np.dtype[np.void]) -> dict[str, slice]:
    """Return the place of each named value in a row of numbers; names in a row of rows are joined by _."""
    places = {}
    for name in row.names or ():
        field, offset = row[name], row.fields[name][1] // _SIZE  # type: ignore[index]
        if field.names:
            for inner, at in slices_of(field).items():
                places[f"{name}_{inner}"] = slice(offset + at.start, offset + at.stop)
        else:
            places[name] = slice(offset, offset + row_count(field))
    return places


def row_count(row: np.dtype[Any]) -> int:
    """Return the number of numbers in a row."""
    return row.itemsize // _SIZE


def made_once(make: Callable[..., _Made], rows: Iterable[tuple[Any, ...]]) -> list[_Made]:
    """Return what `make` returns for each row of arguments; rows of the same objects share one result.

    Copies of a hand in many environments then share tables, which otherwise don't fit into a processor's
    caches.
    """
    rows = list(rows)
    made: dict[tuple[int, ...], _Made] = {}
    for row in rows:
        if (key := tuple(map(id, row))) not in made:
            made[key] = make(*row)
    return [made[tuple(map(id, row))] for row in rows]
