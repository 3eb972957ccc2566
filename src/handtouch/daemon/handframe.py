"""Hand frames, written straight into their bytes: what doesn't change from tick to tick is encoded once.

Public names: `HandWriter`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire

_SHORT = 1 << 32
_NUMBERS = "seq", "t_ns", "tick"
_INT, _LONG = struct.Struct(">I"), struct.Struct(">Q")
_TRUE, _FALSE = 0xC3, 0xC2  # of msgpack


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
        for column, source in self._pairs:
            np.copyto(column, source, casting="same_kind")
        buffer, at = self._buffer, self._at
        for name, data in optional.items():
            buffer[at[name] : at[name] + len(data)] = data
        number = self._number
        number.pack_into(buffer, at["seq"], seq)
        number.pack_into(buffer, at["tick"], tick)
        _LONG.pack_into(buffer, at["t_ns"], t_ns)
        buffer[at["repeat"]] = _TRUE if repeat else _FALSE
        return wire.Packed(self._topic, bytes(buffer))

    def _lay_out(self, short: bool, optional: tuple[str, ...]) -> None:
        """Encode a frame with empty columns, and note where everything is."""
        self._number = _INT if short else _LONG
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
        self._buffer, self._at = bytearray(packer.pack_map_header(len(told))), {}
        for name, value in told.items():
            self._buffer += packer.pack(name)
            packed = packer.pack(value)
            size = len(value) if isinstance(value, bytes) else len(packed) - (name in _NUMBERS)
            self._at[name] = len(self._buffer) + len(packed) - size
            self._buffer += packed
        self._pairs = []
        for name, source in self._sources.items():
            kind, elements = kinds[name]
            column = np.frombuffer(self._buffer, kind, rows * elements, self._at[name])
            self._pairs.append((column.reshape(source.shape), source))
