"""Encoding of hand frames and contacts: bytes that don't change from tick to tick are encoded once.

Public names: `HandFrameEncoder`, `ContactMessageEncoder`.
"""

from __future__ import annotations

import struct
import typing
from collections.abc import Mapping, Sequence
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.core.memory import view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.encode import WRITTEN_FIELDS, ContactEncoder
from handtouch.core.tick import TickProcessor
from handtouch.wire import ContactEvent, EndReason, ForceStatus, FrameStatus, PositionStatus

_UINT32_END = 1 << 32
_COUNTER_KEYS = "seq", "t_ns", "tick"
_CHANGING_KEYS = *_COUNTER_KEYS, "retained"
_INT, _LONG = struct.Struct(">I"), struct.Struct(">Q")
_TRUE, _FALSE = b"\xc3", b"\xc2"  # of msgpack
_EVENTS: tuple[ContactEvent, ...] = typing.get_args(ContactEvent)
_END_REASONS: tuple[EndReason, ...] = typing.get_args(EndReason)
_PAD_TEXTS = 4  # the last is empty
_MAX_VALUE_BYTES = 1024  # numbers and names of statuses


class HandFrameEncoder:
    """Encoder of one hand's frames; `sources`: column -> array that it is copied from, (n, …), of its type.

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
        self._parts: list[bytes | memoryview] = []
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
        for name, source in self._sources.items():
            assert source.dtype == np.dtype(layout[name].dtype)
            self._parts[self._part_index[name]] = source.reshape(-1).view(np.uint8).data


class ContactMessageEncoder:
    """Encoder of the contacts of a model's pads from the arrays of a tick; `session` is the daemon's."""

    def __init__(self, model: PadModel, tick: TickProcessor, session: int) -> None:
        self._model, self._tick = model, tick
        pack = self._pack = msgpack.Packer().pack
        keys = [pack(name) for name in WRITTEN_FIELDS]
        keys[0] = pack("v") + pack(wire.SCHEMA_VERSION) + pack("session") + pack(session) + keys[0]
        statuses = [status.text for kind in (PositionStatus, ForceStatus, FrameStatus) for status in kind]
        self._texts = [*keys, *map(pack, (*_EVENTS, *statuses, *_END_REASONS))]
        self._topics = [f"contact/{hand}/{link}" for hand, link in zip(model.hands, model.links, strict=True)]
        self._calibrations = list(model.calibrations)
        self._pad_texts = [text for pad in range(model.size) for text in self._texts_of(pad)]
        self._build_stage()

    def encode(
        self, pad: int, event: ContactEvent, sync_ns: int, now_ns: int, end_reason: EndReason, retained: bool
    ) -> wire.EncodedMessage:
        """Encode the contact on a pad; `sync_ns`: of the tick in which it ended."""
        calibration = self._model.calibrations[pad]
        if calibration is not self._calibrations[pad]:
            self._calibrations[pad] = calibration
            self._pad_texts[_PAD_TEXTS * pad : _PAD_TEXTS * (pad + 1)] = self._texts_of(pad)
            self._build_stage()
        size = self._stage.encode_contact(
            pad, _EVENTS.index(event), sync_ns, now_ns, _END_REASONS.index(end_reason), retained
        )
        return wire.EncodedMessage(self._topics[pad], bytes(self._message[:size]))

    def _texts_of(self, pad: int) -> tuple[bytes, ...]:
        """Return the packed fields of a pad that change with its calibration only, for the stage."""
        model, calibration = self._model, self._model.calibrations[pad]
        groups: tuple[dict[str, Any], ...] = (
            {"hand": model.hands[pad], "link": model.links[pad], "frame": model.frame_links[pad]},
            {
                "begin_threshold_n": float(model.begin_threshold_n[pad]),
                "end_threshold_n": float(model.end_threshold_n[pad]),
                "calibration_id": calibration.calibration_id,
            },
            {"diagnoses": calibration.diagnoses} if calibration.diagnoses else {},
            {},
        )
        return tuple(
            b"".join(self._pack(item) for pair in group.items() for item in pair) for group in groups
        )

    def _build_stage(self) -> None:
        tick, number = self._tick, np.zeros(1)
        ends = np.cumsum([0, *map(len, self._texts)])
        pad_ends = np.cumsum([0, *map(len, self._pad_texts[:-1])])
        longest = max(np.diff([*pad_ends[::_PAD_TEXTS], len(b"".join(self._pad_texts))]))
        message = np.zeros(ends[-1] + longest + _MAX_VALUE_BYTES, np.uint8)
        self._message = message.data
        self._stage = ContactEncoder(
            tick.state.memory(),
            *(view_memory(tick.columns.position_status), view_memory(tick.columns.force_status)),
            view_memory(tick.sheet_force.modelled),
            *(_text_memory(self._texts), view_memory(ends)),
            *(_text_memory(self._pad_texts), view_memory(pad_ends)),
            view_memory(number),
            *(view_memory(number.view(np.uint8)), self._message),
        )


def _text_memory(texts: Sequence[bytes]) -> memoryview:
    return memoryview(bytearray(b"".join(texts)))
