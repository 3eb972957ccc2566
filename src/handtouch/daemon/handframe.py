"""Hand frames, put together from their bytes: what doesn't change from tick to tick is encoded once.

Public names: `HandWriter`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire

_SHORT = 1 << 32
_NUMBERS = "seq", "t_ns", "tick"
_CHANGING = *_NUMBERS, "repeat"
_INT, _LONG = struct.Struct(">I"), struct.Struct(">Q")
_TRUE, _FALSE = b"\xc3", b"\xc2"  # of msgpack


class HandWriter:
    """The hand frame of one hand of a daemon's `run`; `sources`: column -> what it is copied from, (n, …).

    Columns that aren't among the sources are given at each call. The bytes are those of `wire.encode`, but
    that seq, t_ns and tick always take the room of their greatest values.
    """

    def __init__(
        self, run: int, hand: str, links: tuple[str, ...], sources: Mapping[str, NDArray[np.generic]]
    ):
        self._run, self._hand, self._links, self._sources = run, hand, links, sources
        self._topic = f"hand/{hand}"
        self._layout: tuple[bool, tuple[str, ...]] | None = None

    def write(
        self, seq: int, t_ns: int, tick: int, repeat: bool, optional: Mapping[str, bytes]
    ) -> wire.Packed:
        """The frame with the sources as they are now."""
        layout = max(seq, tick) < _SHORT, tuple(optional)
        if layout != self._layout:
            self._lay_out(*layout)
            self._layout = layout
        parts, at = self._parts, self._at
        for column, tell in self._columns:
            parts[column] = tell()
        for name, data in optional.items():
            parts[at[name]] = data
        number = self._number
        parts[at["seq"]], parts[at["tick"]], parts[at["t_ns"]] = number(seq), number(tick), _LONG.pack(t_ns)
        parts[at["repeat"]] = _TRUE if repeat else _FALSE
        return wire.Packed(self._topic, b"".join(parts))

    def _lay_out(self, short: bool, optional: tuple[str, ...]) -> None:
        """Encode a frame with empty columns, in parts: what stays, and by name what changes."""
        self._number = (_INT if short else _LONG).pack
        some = 1 << 31 if short else 1 << 62
        rows, kinds = len(self._links), wire.COLUMNS[wire.HandFrame]
        columns = {
            name: bytes(rows * elements * int(kind[-1]))
            for name, (kind, elements) in kinds.items()
            if name in self._sources or name in optional
        }
        frame = wire.HandFrame(
            wire.SCHEMA_VERSION, self._run, some, 1 << 62, some, self._hand, self._links,
            **columns, repeat=False,
        )  # fmt: skip
        told = wire.plain(frame)
        packer = msgpack.Packer()
        self._parts: list[bytes] = []
        self._at: dict[str, int] = {}
        fixed = bytearray(packer.pack_map_header(len(told)))
        for name, value in told.items():
            fixed += packer.pack(name)
            packed = packer.pack(value)
            if name not in columns and name not in _CHANGING:
                fixed += packed
                continue
            size = len(value) if name in columns else len(packed) - (name in _NUMBERS)
            fixed += packed[: len(packed) - size]
            self._at[name] = len(self._parts) + 1
            self._parts += [bytes(fixed), b""]
            fixed = bytearray()
        self._parts.append(bytes(fixed))
        self._columns = [
            (self._at[name], _teller(source, kinds[name][0])) for name, source in self._sources.items()
        ]


def _teller(source: NDArray[np.generic], kind: str) -> Callable[[], bytes]:
    """What tells the bytes of an array as it is at each call."""
    if source.dtype == np.dtype(kind):
        return source.tobytes
    return lambda: source.astype(kind).tobytes()
