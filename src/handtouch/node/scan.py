"""Scans of a buffered ADC: types of scan elements, their layout and decoding (sysfs-bus-iio of the kernel).

Public names: `ScanElement`, `ScanLayout`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

_TYPE_PATTERN = re.compile(r"(be|le):([su])(\d+)/(\d+)(?:X(\d+))?(?:>>(\d+))?")
_STORAGE_BITS = (8, 16, 32, 64)


@dataclass(frozen=True)
class ScanElement:
    """One value of a scan: `bits` of an integer of `storage_bits`, shifted left by `shift`.

    `big_endian`, `signed` : of the integer; `repeat` : number of integers, of which the first is used
    """

    big_endian: bool
    signed: bool
    bits: int
    storage_bits: int
    shift: int = 0
    repeat: int = 1

    @classmethod
    def parse(cls, text: str) -> ScanElement:
        """Parse a type such as "le:s24/32>>8" or "be:u12/16X2>>4". Raises ValueError for any other form."""
        form = _TYPE_PATTERN.fullmatch(text.strip())
        if form is None:
            raise ValueError(f'"{text.strip()}" is no scan element type such as "le:s24/32>>8"')
        bits, storage, repeat, shift = int(form[3]), int(form[4]), int(form[5] or 1), int(form[6] or 0)
        if storage not in _STORAGE_BITS or not 1 <= bits <= storage - shift:
            raise ValueError(f'"{text.strip()}": need storage of 8, 16, 32 or 64 bits that holds the value')
        return cls(form[1] == "be", form[2] == "s", bits, storage, shift, max(repeat, 1))

    @property
    def size_bytes(self) -> int:
        """Number of bytes in a scan, which is also its alignment."""
        return self.storage_bits // 8 * self.repeat

    @property
    def limits(self) -> tuple[int, int]:
        """Minimum and maximum value."""
        if self.signed:
            return -(1 << self.bits - 1), (1 << self.bits - 1) - 1
        return 0, (1 << self.bits) - 1

    def decode(self, stored: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return the values (n,) of stored integers (n,); unsigned values need fewer than 64 bits."""
        left = np.uint64(64 - self.bits - self.shift)
        right = np.uint64(64 - self.bits)
        shifted = stored << left  # drop the bits above, then those below with the sign extended
        return (
            shifted.view(np.int64) >> right.astype(np.int64)
            if self.signed
            else (shifted >> right).view(np.int64)
        )


@dataclass(frozen=True)
class ScanLayout:
    """Layout of a scan: its enabled elements in the order of their indices."""

    elements: tuple[ScanElement, ...]

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """Offset of each element [bytes]: aligned to its own size, as the kernel packs scans."""
        offsets, end = [], 0
        for element in self.elements:
            start = _round_up(end, element.size_bytes)
            offsets.append(start)
            end = start + element.size_bytes
        return tuple(offsets)

    @cached_property
    def size_bytes(self) -> int:
        """Size of a scan: padded to a multiple of the largest element."""
        end = self.offsets[-1] + self.elements[-1].size_bytes
        return _round_up(end, max(element.size_bytes for element in self.elements))

    def decode(self, data: bytes, positions: Sequence[int]) -> NDArray[np.int64]:
        """Return the values (n, len(positions)) of the elements at `positions` in n scans.

        Raises ValueError if `data` isn't a whole number of scans.
        """
        if len(data) % self.size_bytes:
            raise ValueError(f"{len(data)} bytes are no multiple of a scan's {self.size_bytes}")
        scans = np.frombuffer(data, self._dtype)
        columns = [self.elements[at].decode(scans[f"f{at}"].astype(np.uint64)) for at in positions]
        return np.stack(columns, axis=1)

    @cached_property
    def _dtype(self) -> np.dtype[np.void]:
        formats = [
            f"{'>' if element.big_endian else '<'}u{element.storage_bits // 8}" for element in self.elements
        ]
        names = [f"f{at}" for at in range(len(self.elements))]
        return np.dtype(
            {"names": names, "formats": formats, "offsets": self.offsets, "itemsize": self.size_bytes}
        )


def _round_up(value: int, unit: int) -> int:
    return -(-value // unit) * unit
