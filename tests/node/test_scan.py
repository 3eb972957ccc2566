"""Scans of buffered ADCs are decoded as the kernel packs them."""

from __future__ import annotations

import ctypes
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.node.scan import ScanElement, ScanLayout


@st.composite
def elements(draw: st.DrawFn) -> ScanElement:
    storage = draw(st.sampled_from((8, 16, 32, 64)))
    bits = draw(st.integers(1, storage if storage < 64 else 63))
    shift = draw(st.integers(0, storage - bits))
    return ScanElement(
        draw(st.booleans()), draw(st.booleans()), bits, storage, shift, draw(st.sampled_from((1, 2, 4)))
    )


def _text(element: ScanElement) -> str:
    repeat = f"X{element.repeat}" if element.repeat > 1 else ""
    return (
        f"{'be' if element.big_endian else 'le'}:{'s' if element.signed else 'u'}{element.bits}/"
        f"{element.storage_bits}{repeat}>>{element.shift}"
    )


@given(elements())
def test_a_type_is_read_as_the_kernel_writes_it(element: ScanElement) -> None:
    assert ScanElement.parse(_text(element) + "\n") == element


@given(st.lists(elements(), min_size=1, max_size=6))
def test_elements_lie_where_a_c_compiler_puts_them(chosen: list[ScanElement]) -> None:
    """The kernel aligns each element to its own size, as a struct of arrays of it, aligned to these."""
    layout = ScanLayout(tuple(chosen))
    wide = {1: ctypes.c_uint8, 2: ctypes.c_uint16, 4: ctypes.c_uint32, 8: ctypes.c_uint64}
    if any(element.size_bytes > 8 for element in chosen):
        return  # no C type has the alignment of a repeated long value
    fields = [(f"f{at}", wide[element.size_bytes]) for at, element in enumerate(chosen)]
    packed: Any = type("packed", (ctypes.Structure,), {"_fields_": fields})
    assert layout.offsets == tuple(getattr(packed, name).offset for name, _ in fields)
    assert layout.size_bytes == ctypes.sizeof(packed)


@given(st.lists(elements(), min_size=1, max_size=6), st.data())
def test_values_survive_packing_whatever_the_unused_bits_hold(
    chosen: list[ScanElement], data: st.DataObject
) -> None:
    layout = ScanLayout(tuple(chosen))
    count = data.draw(st.integers(0, 3))
    values = [[data.draw(st.integers(*element.limits)) for element in chosen] for _ in range(count)]
    packed = b""
    for row in values:
        scan = bytearray(data.draw(st.binary(min_size=layout.size_bytes, max_size=layout.size_bytes)))
        for element, start, value in zip(chosen, layout.offsets, row, strict=True):
            size = element.storage_bits // 8
            order: Literal["big", "little"] = "big" if element.big_endian else "little"
            mask = ((1 << element.bits) - 1) << element.shift
            old = int.from_bytes(scan[start : start + size], order)
            stored = old & ~mask | value << element.shift & mask
            scan[start : start + size] = stored.to_bytes(size, order)
        packed += bytes(scan)
    decoded = layout.decode(packed, range(len(chosen)))
    assert decoded.shape == (count, len(chosen))
    np.testing.assert_array_equal(decoded, np.array(values, np.int64).reshape(count, len(chosen)))


def test_known_scans_of_drivers() -> None:
    """le:s24/32>>8 and be:u12/16>>4 from their definition, with a time stamp aligned to 8 bytes."""
    parts = ("le:s24/32>>8", "be:u12/16>>4", "le:s64/64>>0")
    layout = ScanLayout(tuple(map(ScanElement.parse, parts)))
    assert (layout.offsets, layout.size_bytes) == ((0, 4, 8), 16)
    data = bytes.fromhex("AAFEFFFF ABCF 0000 0100000000000000")
    assert layout.decode(data, (0, 1, 2)).tolist() == [[-2, 0xABC, 1]]


@pytest.mark.parametrize("text", ["", "s24/32", "le:s24/24>>0", "le:s33/32>>0", "le:s24/32>>9", "le:f32/32"])
def test_other_types_are_refused_by_name(text: str) -> None:
    with pytest.raises(ValueError, match=r"le:s24/32>>8|need storage"):
        ScanElement.parse(text)


def test_part_of_a_scan_is_refused() -> None:
    layout = ScanLayout((ScanElement.parse("le:s16/16>>0"),))
    with pytest.raises(ValueError, match="3 bytes"):
        layout.decode(bytes(3), (0,))
