"""Messages of each tick: contacts, hand frames and raw counts, for the topics with a subscriber.

Public names: `TickMessages`, `MessageSink`, `END_REASONS`, `HandFrameEncoder`, `ContactMessageEncoder`. Bytes
that don't change from tick to tick are encoded once.
"""

from __future__ import annotations

import struct
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from functools import partial
from typing import Any, Protocol

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.core.memory import row_count, slices_of, view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.slab import Slab
from handtouch.core.stages.frames import CONTACT_FRAMES, PART_FRAMES, ContactTransforms
from handtouch.core.stages.publish import CONDITIONS, FIELD_KINDS, INTEGERS, ContactEncoder
from handtouch.core.stages.solve import PART_COUNT, PART_SLICES, VALUE_SLICES
from handtouch.core.state import TickState
from handtouch.core.tick import TickProcessor, TickResult
from handtouch.wire import ContactEvent, EndReason, ForceStatus, FrameStatus, PadState, PositionStatus

END_REASONS: dict[PadState, EndReason] = {
    PadState.STALE: "stale",
    PadState.LOST: "lost",
    PadState.FAULTED: "faulted",
    PadState.STARTING: "restarted",
    PadState.OFF: "off",
}
"""End reason of a contact by the state of its pad; "released" for any other."""
_STOPPED: EndReason = "stopped"
_UINT32_END = 1 << 32
_COUNTER_KEYS = "seq", "t_ns", "tick"
_CHANGING_KEYS = *_COUNTER_KEYS, "retained"
_INT, _LONG = struct.Struct(">I"), struct.Struct(">Q")
_TRUE, _FALSE = b"\xc3", b"\xc2"  # bytes of msgpack
_EVENTS: tuple[ContactEvent, ...] = typing.get_args(ContactEvent)
_END_REASONS: tuple[EndReason, ...] = typing.get_args(EndReason)
_MIN_RAW_CHANNELS = wire.COLUMNS[wire.Raw]["counts"].elements
_KIND = {name: number for number, name in enumerate(FIELD_KINDS)}
_CONDITION = {name: number for number, name in enumerate(CONDITIONS)}
_NAMES: dict[str, tuple[str, ...]] = {
    "event": _EVENTS,
    "end_reason": _END_REASONS,
    "position_status": tuple(status.text for status in PositionStatus),
    "force_status": tuple(status.text for status in ForceStatus),
    "palm_status": tuple(status.text for status in FrameStatus),
    "base_status": tuple(status.text for status in FrameStatus),
    "force_vector_status": tuple(status.text for status in ForceStatus),
}
"""Texts of a field by its number"""
_TRUTHS, _DURATIONS = ("retained", "fresh"), ("duration_s", "age_s")
_PAD_TEXTS = (
    "hand", "link", "frame", "begin_threshold_n", "end_threshold_n", "calibration_id", "diagnoses",
)  # fmt: skip
"""Fields that change with a pad's calibration only"""
_PLACES = {
    **{name: (name[:4], "palm_values", at) for name, at in slices_of(CONTACT_FRAMES).items()},
    **{name: ("located", "values", VALUE_SLICES[name]) for name in ("position_m", "normal", "pad_m")},
    "covariance_m2": ("located", "values", VALUE_SLICES["covariance_m2"]),
    "mount_covariance_m2": ("located", "values", VALUE_SLICES["mount_covariance_m2"]),
    "force_std_n": ("std", "values", VALUE_SLICES["force_std_n"]),
    "joints_age_s": ("frames", "palm_values", slices_of(CONTACT_FRAMES)["joints_age_s"]),
    "uncompensated_force_n": ("modelled", "uncompensated_force_n", slice(0, 1)),
    "force_vector_n": ("vector", "force_vector", slice(0, 3)),
    "force_vector_covariance_n2": ("vector", "force_vector", slice(3, 12)),
    "palm_force_vector_n": ("vector", "frame_force_vector", slice(0, 3)),
    "base_force_vector_n": ("vector", "frame_force_vector", slice(3, 6)),
}
"""Numbers that are known under a condition: that, an array of the state, and their place in its rows. Others
are those of the same name in VALUE_SLICES, or in the state."""
_PART_PLACES = {
    **{name: ("always", "parts", at) for name, at in PART_SLICES.items()},
    **{name: (f"part_{name[:4]}", "part_frames", at) for name, at in slices_of(PART_FRAMES).items()},
}
"""The same of the fields of `wire.ContactPart`"""
_PART_FIELDS = tuple(wire.ContactPart.__annotations__)
_PART_STEPS = {"parts": PART_COUNT, "part_frames": row_count(PART_FRAMES)}
_MAX_VALUE_BYTES = 4096  # numbers and names of statuses


class MessageSink(Protocol):
    """Receiver of messages: the daemon's publisher, or a recorder."""

    def has_subscriber(self, topic: str) -> bool:
        """Return True if a message of this topic has a receiver."""

    def send(self, message: wire.OutgoingMessage) -> None:
        """Send a message."""


class TickMessages:
    """Messages of every tick for the pads of a model; `session` is the daemon's.

    `seq` counts all messages of a topic, sent or not, so that a late subscriber sees the gap.
    """

    def __init__(
        self,
        model: PadModel,
        tick: TickProcessor,
        session: int = 0,
        transforms: ContactTransforms | None = None,
    ) -> None:
        self._model = model
        self._transforms = transforms or ContactTransforms(model.hands, None, tick.state)
        self._tick = tick
        self._session = session
        self._state = tick.state
        self._contact_encoder = ContactMessageEncoder(model, tick, session)
        self._end_reason: EndReason = ""  # reason for the end of all contacts, when the daemon stops
        self._encoders = {hand: self._make_encoder(hand, rows) for hand, rows in model.rows_of_hand.items()}
        self._hand_topics = [(hand, f"hand/{hand}", f"raw/{hand}") for hand in model.rows_of_hand]
        self._topics = [f"contact/{hand}/{link}" for hand, link in zip(model.hands, model.links, strict=True)]

    def send_contacts(self, result: TickResult, now_ns: int, sink: MessageSink) -> None:
        """Send begin, update and end of contacts, and clear those that ended."""
        events: dict[ContactEvent, NDArray[np.intp]] = {
            "begin": result.began,
            "update": np.concatenate([result.updated, result.silent])
            if len(result.silent)
            else result.updated,
            "end": result.ended,
        }
        for event, rows in events.items():
            if len(rows):
                self._state.contact_seq[rows] += 1
            for pad in rows.tolist():
                if sink.has_subscriber(self._topics[pad]):
                    sink.send(self._contact_message(pad, event, result.sync_ns, now_ns))
        if len(result.ended):
            self._tick.clear_ended(result.ended)
            self._transforms.discard(result.ended)

    def replace_model(self, model: PadModel) -> None:
        """Continue with another model of the same pads."""
        self._model = model
        self._contact_encoder = ContactMessageEncoder(model, self._tick, self._session)

    def end_all_contacts(self, now_ns: int, sink: MessageSink) -> None:
        """Send the end of every contact, because the daemon stops."""
        touching = np.flatnonzero(self._tick.contacts.touching)
        self._end_reason = _STOPPED
        none = np.zeros(0, dtype=np.intp)
        self.send_contacts(TickResult(now_ns, none, none, touching, none), now_ns, sink)
        self._tick.contacts.touching[:] = False
        self._tick.columns.state[:] = PadState.STARTING

    def send_hand_frames(self, slab: Slab, tick_number: int, sync_ns: int, sink: MessageSink) -> None:
        """Send the frame and the raw counts of every hand with a subscriber."""
        held = self._state
        held.frame_seq[0] += 1
        held.frame_tick[0], held.frame_sync_ns[0] = tick_number, sync_ns
        for hand, topic, raw in self._hand_topics:
            if sink.has_subscriber(topic):
                sink.send(self._hand_frame(hand))
            if sink.has_subscriber(raw):
                sink.send(self._raw_message(hand, slab))

    def retained_messages(self) -> dict[str, Callable[[int], wire.OutgoingMessage | None]]:
        """Return topic -> function of the time [ns] that makes its retained message: contacts and hands."""
        return {
            **{topic: partial(self._retained_contact, pad) for pad, topic in enumerate(self._topics)},
            **{f"hand/{hand}": partial(self._retained_hand, hand) for hand in self._model.rows_of_hand},
        }

    def _retained_contact(self, pad: int, now_ns: int) -> wire.EncodedMessage | None:
        if not self._tick.contacts.touching[pad]:
            return None
        return self._contact_message(pad, "update", 0, now_ns, retained=True)

    def _retained_hand(self, hand: str, _: int) -> wire.EncodedMessage | None:
        return self._hand_frame(hand, retained=True) if self._state.frame_seq[0] else None

    def _hand_frame(self, hand: str, retained: bool = False) -> wire.EncodedMessage:
        rows = self._model.rows_of_hand[hand]
        optional = self._transforms.hand_columns(rows) if self._transforms.any_requested else {}
        if self._tick.shear.any_configured:
            optional |= self._tick.shear.hand_columns(rows)
        seq, tick_number, sync_ns = self._frame_numbers()
        return self._encoders[hand].encode(seq, sync_ns, tick_number, retained, optional)

    def _frame_numbers(self) -> tuple[int, int, int]:
        """Return seq, number of the tick and its SYNC of the last frames."""
        held = self._state
        return int(held.frame_seq[0]), int(held.frame_tick[0]), int(held.frame_sync_ns[0])

    def frame_columns(self) -> dict[str, NDArray[Any]]:
        """Return the columns of all hand frames, (n, ...) with the rows of the model, in their types.

        These are the values that `send_hand_frames` publishes; the optional columns aren't among them.
        """
        rows, layout = slice(0, self._model.size), wire.COLUMNS[wire.HandFrame]
        return {name: array.astype(layout[name].dtype) for name, array in self._frame_sources(rows).items()}

    def _make_encoder(self, hand: str, rows: slice) -> HandFrameEncoder:
        links = tuple(self._model.links[rows])
        return HandFrameEncoder(self._session, hand, links, self._frame_sources(rows))

    def _frame_sources(self, rows: slice) -> dict[str, NDArray[Any]]:
        """Return the arrays that the columns of hand frames are copied from."""
        columns = self._tick.columns
        return {
            "state": columns.state[rows],
            "contact_id": self._tick.contacts.id[rows],
            "sample_ns": columns.sample_ns[rows],
            "position_status": columns.position_status[rows],
            "force_status": columns.force_status[rows],
            **{name: column[rows] for name, column in columns.published.items()},
        }

    def _raw_message(self, hand: str, slab: Slab) -> wire.Raw:
        rows, counts = self._model.rows_of_hand[hand], self._tick.counts
        most = int(self._model.electrode_counts[rows].max())
        columns = np.zeros((rows.stop - rows.start, max(most, _MIN_RAW_CHANNELS)), "<i8")
        columns[:, :most] = counts[rows, :most]
        seq, tick_number, sync_ns = self._frame_numbers()
        return wire.Raw(
            v=wire.SCHEMA_VERSION,
            session=self._session,
            seq=seq,
            t_ns=sync_ns,
            tick=tick_number,
            hand=hand,
            links=tuple(self._model.links[rows]),
            counts=columns.tobytes(),
            sample_ns=self._tick.columns.sample_ns[rows].astype("<i8").tobytes(),
            fresh=slab.fresh[rows].tobytes(),
            retained=False,
        )

    def _contact_message(
        self, pad: int, event: ContactEvent, sync_ns: int, now_ns: int, retained: bool = False
    ) -> wire.EncodedMessage:
        reason = self._end_reason_of(pad) if event == "end" else ""
        return self._contact_encoder.encode(pad, event, sync_ns, now_ns, reason, retained)

    def _end_reason_of(self, pad: int) -> EndReason:
        state = PadState(int(self._tick.columns.state[pad]))
        return self._end_reason or END_REASONS.get(state, "released")


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
        contact_fields = [field for field in fields(wire.Contact) if field.name not in ("v", "session")]
        names = [name for field in contact_fields for name in _NAMES.get(field.name, ())]
        keys = [pack(name) for name in (*(field.name for field in contact_fields), *_PART_FIELDS)]
        keys[0] = pack("v") + pack(wire.SCHEMA_VERSION) + pack("session") + pack(session) + keys[0]
        self._texts = [*keys, *map(pack, names)]
        self._fields = len(contact_fields)
        self._layout = _contact_layout(tick.state, contact_fields, len(keys))
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
            self._pad_texts[len(_PAD_TEXTS) * pad : len(_PAD_TEXTS) * (pad + 1)] = self._texts_of(pad)
            self._build_stage()
        size = self._stage.encode_contact(
            pad, _EVENTS.index(event), sync_ns, now_ns, _END_REASONS.index(end_reason), retained
        )
        return wire.EncodedMessage(self._topics[pad], bytes(self._message[:size]))

    def _texts_of(self, pad: int) -> list[bytes]:
        """Return the packed fields of a pad that change with its calibration only, empty where absent."""
        model, calibration = self._model, self._model.calibrations[pad]
        values: dict[str, Any] = {
            "hand": model.hands[pad],
            "link": model.links[pad],
            "frame": model.frame_links[pad],
            "begin_threshold_n": float(model.begin_threshold_n[pad]),
            "end_threshold_n": float(model.end_threshold_n[pad]),
            "calibration_id": calibration.calibration_id,
            "diagnoses": calibration.diagnoses,
        }
        return [
            self._pack(name) + self._pack(values[name]) if values[name] != () else b"" for name in _PAD_TEXTS
        ]

    def _build_stage(self) -> None:
        tick, summed = self._tick, np.zeros(9)
        ends, pad_ends = (np.cumsum([0, *map(len, texts)]) for texts in (self._texts, self._pad_texts))
        longest = max(np.diff(pad_ends[:: len(_PAD_TEXTS)]))
        self._message = np.zeros(ends[-1] + longest + _MAX_VALUE_BYTES, np.uint8).data
        arrays = {
            "layout": view_memory(self._layout),
            "state": view_memory(tick.state.block.view("<f8")),
            "state_bits": view_memory(tick.state.block.view("<u8")),
            "position_status": view_memory(tick.columns.position_status),
            "force_status": view_memory(tick.columns.force_status),
            "has_sheet_model": view_memory(tick.sheet_force.modelled),
            "texts": _text_memory(self._texts),
            "text_ends": view_memory(ends),
            "pad_texts": _text_memory(self._pad_texts),
            "pad_text_ends": view_memory(pad_ends),
            "message": self._message,
            "summed": view_memory(summed),
            "summed_bits": view_memory(summed.view("<u8")),
            "integers": view_memory(np.zeros(len(INTEGERS), np.int64)),
            "conditions": view_memory(np.zeros(len(CONDITIONS), np.uint8)),
        }
        self._stage = ContactEncoder(
            self._fields, len(_PAD_TEXTS), tick.state.number_of("values"), tick.state.memory | arrays
        )


def _contact_layout(
    state: TickState, contact_fields: Sequence[Field[Any]], first_name: int
) -> NDArray[np.int64]:
    """Return the rows of `ContactEncoder.layout`, as declared in `wire.Contact` and `ContactPart`.

    `first_name`: number of the first name among the texts.
    """
    rows: list[tuple[int, ...]] = []
    for field in contact_fields:
        name, is_optional = field.name, int(field.default is not MISSING)
        if name == "parts":
            rows.append((_KIND["parts"], 0, 1, 0, 0, 0))
        elif name in _PAD_TEXTS:
            rows.append((_KIND["text"], 0, is_optional, 0, 0, _PAD_TEXTS.index(name)))
        elif name in INTEGERS:
            kind = "seconds" if name in _DURATIONS else "truth" if name in _TRUTHS else "integer"
            kind, default = ("name" if name in _NAMES else kind), int(field.default is True)
            rows.append((_KIND[kind], 0, is_optional, first_name, default, INTEGERS.index(name)))
            first_name += len(_NAMES.get(name, ()))
        else:
            at = VALUE_SLICES.get(name)
            plain = "always", name if at is None else "values", slice(0, 1) if at is None else at
            rows.append(_number_row(state, name, is_optional, _PLACES.get(name, plain)))
    for name in _PART_FIELDS:
        absent = 2 * (name in wire.ContactPart.__optional_keys__)
        rows.append(_number_row(state, name, absent, _PART_PLACES[name]))
    return np.array(rows, np.int64)


def _number_row(state: TickState, name: str, absent: int, place: tuple[str, str, slice]) -> tuple[int, ...]:
    condition, array, at = place
    first, step, count = state.number_of(array), getattr(state, array)[0].size, at.stop - at.start
    kind = {"covariance_m2": "covariance", "id": "whole"}.get(name, "numbers")
    step = _PART_STEPS.get(array, step)
    return _KIND[kind], _CONDITION[condition], absent, first + at.start, step, count if count > 1 else 0


def _text_memory(texts: Sequence[bytes]) -> memoryview:
    return memoryview(bytearray(b"".join(texts)))
