"""Encoding of hand frames: bytes that don't change from tick to tick are encoded once.

Public name: `HandFrameEncoder`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire

_UINT32_END = 1 << 32
_COUNTER_KEYS = "seq", "t_ns", "tick"
_CHANGING_KEYS = *_COUNTER_KEYS, "retained"
_INT, _LONG = struct.Struct(">I"), struct.Struct(">Q")
_TRUE, _FALSE = b"\xc3", b"\xc2"  # of msgpack


class HandFrameEncoder:
    """Encoder of one hand's frames; `sources`: column -> array that it is copied from, (n, …).

    Columns without a source are arguments of each call. The bytes are those of `wire.encode`, except that
    seq, t_ns and tick are always encoded in the size of their greatest values.
    """

    def __init__(
        self, session: int, hand: str, links: tuple[str, ...], sources: Mapping[str, NDArray[np.generic]]
    ):
        self._session, self._hand, self._links, self._sources = session, hand, links, sources
        self._topic = f"hand/{hand}"
        self._layout: tuple[bool, tuple[str, ...]] | None = None

    def encode(
        self, seq: int, t_ns: int, tick: int, retained: bool, optional: Mapping[str, bytes]
    ) -> wire.EncodedMessage:
        """Encode a frame of the sources' present values."""
        layout = max(seq, tick) < _UINT32_END, tuple(optional)
        if layout != self._layout:
            self._build_layout(*layout)
            self._layout = layout
        parts, index = self._parts, self._part_index
        for column, read in self._columns:
            parts[column] = read()
        for name, data in optional.items():
            parts[index[name]] = data
        number = self._pack_counter
        parts[index["seq"]], parts[index["tick"]] = number(seq), number(tick)
        parts[index["t_ns"]] = _LONG.pack(t_ns)
        parts[index["retained"]] = _TRUE if retained else _FALSE
        return wire.EncodedMessage(self._topic, b"".join(parts))

    def _build_layout(self, short: bool, optional: tuple[str, ...]) -> None:
        """Encode a frame with empty columns in parts: constant bytes, and by name the changing ones."""
        self._pack_counter = (_INT if short else _LONG).pack
        some = 1 << 31 if short else 1 << 62
        rows, layout = len(self._links), wire.COLUMNS[wire.HandFrame]
        columns = {
            name: bytes(rows * column.row_bytes)
            for name, column in layout.items()
            if name in self._sources or name in optional
        }
        frame = wire.HandFrame(
            wire.SCHEMA_VERSION, self._session, some, 1 << 62, some, self._hand, self._links,
            **columns, retained=False,
        )  # fmt: skip
        payload = wire.to_map(frame)
        packer = msgpack.Packer()
        self._parts: list[bytes] = []
        self._part_index: dict[str, int] = {}
        fixed = bytearray(packer.pack_map_header(len(payload)))
        for name, value in payload.items():
            fixed += packer.pack(name)
            packed = packer.pack(value)
            if name not in columns and name not in _CHANGING_KEYS:
                fixed += packed
                continue
            size = len(value) if name in columns else len(packed) - (name in _COUNTER_KEYS)
            fixed += packed[: len(packed) - size]
            self._part_index[name] = len(self._parts) + 1
            self._parts += [bytes(fixed), b""]
            fixed = bytearray()
        self._parts.append(bytes(fixed))
        self._columns = [
            (self._part_index[name], _column_reader(source, layout[name].dtype))
            for name, source in self._sources.items()
        ]


def _column_reader(source: NDArray[np.generic], kind: str) -> Callable[[], bytes]:
    """Return a function that reads the present bytes of an array."""
    if source.dtype == np.dtype(kind):
        return source.tobytes
    return lambda: source.astype(kind).tobytes()
