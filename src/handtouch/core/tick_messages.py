"""Messages of each tick: contacts, hand frames and raw counts, for the topics with a subscriber.

Public names: `TickMessages`, `MessageSink`, `END_REASONS`, `HandFrameEncoder`. Bytes
that don't change from tick to tick are encoded once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.core.columns import TickResult
from handtouch.core.pad_model import PadModel
from handtouch.core.slab import Slab
from handtouch.core.stages.frames import ContactTransforms
from handtouch.core.stages.publish import ContactEncoder
from handtouch.core.tick import TickProcessor
from handtouch.wire import ContactEvent, EndReason, PadState

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
_MIN_RAW_CHANNELS = wire.COLUMNS[wire.Raw]["counts"].elements


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
        self._contact_encoder = self._make_contact_encoder(model)
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
        subscribed, topics = sink.has_subscriber, self._topics
        for event, rows in events.items():
            if len(rows):
                self._state.contact_seq[rows] += 1
            for pad in rows.tolist():
                if subscribed(topics[pad]):
                    sink.send(self._contact_message(pad, event, result.sync_ns, now_ns))
        if len(result.ended):
            self._tick.clear_ended(result.ended)
            self._transforms.discard(result.ended)

    def replace_model(self, model: PadModel) -> None:
        """Continue with another model of the same pads."""
        self._model = model
        self._contact_encoder = self._make_contact_encoder(model)

    def end_all_contacts(self, now_ns: int, sink: MessageSink) -> None:
        """Send the end of every contact, because the daemon stops."""
        touching = np.flatnonzero(self._tick.state.touching)
        self._end_reason = _STOPPED
        none = np.zeros(0, dtype=np.intp)
        self.send_contacts(TickResult(now_ns, none, none, touching, none), now_ns, sink)
        self._tick.state.touching[:] = False
        self._tick.columns.state[:] = PadState.STARTING

    def send_hand_frames(self, slab: Slab, tick_number: int, sync_ns: int, sink: MessageSink) -> None:
        """Send the frame and the raw counts of every hand with a subscriber."""
        held = self._state
        held.frame_seq[0] += 1
        held.frame_tick[0], held.frame_sync_ns[0] = tick_number, sync_ns
        subscribed = sink.has_subscriber
        for hand, topic, raw in self._hand_topics:
            if subscribed(topic):
                sink.send(self._hand_frame(hand))
            if subscribed(raw):
                sink.send(self._raw_message(hand, slab))

    def retained_messages(self) -> dict[str, Callable[[int], wire.OutgoingMessage | None]]:
        """Return topic -> function of the time [ns] that makes its retained message: contacts and hands."""
        return {
            **{topic: partial(self._retained_contact, pad) for pad, topic in enumerate(self._topics)},
            **{f"hand/{hand}": partial(self._retained_hand, hand) for hand in self._model.rows_of_hand},
        }

    def _retained_contact(self, pad: int, now_ns: int) -> wire.EncodedMessage | None:
        if not self._tick.state.touching[pad]:
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

    def copy_frame_columns(self, into: Mapping[str, NDArray[Any]]) -> None:
        """Copy `frame_columns` into arrays of these shapes and types."""
        for name, array in self._frame_sources(slice(0, self._model.size)).items():
            into[name][:] = array

    def _make_contact_encoder(self, model: PadModel) -> ContactEncoder:
        tick = self._tick
        return ContactEncoder(model, tick.state, tick.columns, tick.sheet_force.modelled, self._session)

    def _make_encoder(self, hand: str, rows: slice) -> HandFrameEncoder:
        links = tuple(self._model.links[rows])
        return HandFrameEncoder(self._session, hand, links, self._frame_sources(rows))

    def _frame_sources(self, rows: slice) -> dict[str, NDArray[Any]]:
        """Return the arrays that the columns of hand frames are copied from."""
        columns = self._tick.columns
        return {
            "state": columns.state[rows],
            "contact_id": self._tick.state.contact_id[rows],
            "sample_ns": columns.sample_ns[rows],
            "position_status": columns.position_status[rows],
            "force_status": columns.force_status[rows],
            "contact_radius_status": columns.contact_radius_status[rows],
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
            second_counts=self._tick.second.counts(rows, self._tick.channel_counts).tobytes(),
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
            wire.SCHEMA_VERSION,
            self._session,
            some,
            1 << 62,
            some,
            self._hand,
            self._links,
            **columns,
            retained=False,
        )
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
