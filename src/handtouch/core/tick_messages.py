"""Messages of each tick: contacts, hand frames and raw counts, for the topics with a subscriber."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.core.encoders import ContactMessageEncoder, HandFrameEncoder
from handtouch.core.pad_model import PadModel
from handtouch.core.slab import Slab
from handtouch.core.tick import TickProcessor, TickResult
from handtouch.core.transforms import ContactTransforms
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
        self._transforms = transforms or ContactTransforms(model.hands)
        self._tick = tick
        self._session = session
        self._state = tick.state
        self._contact_encoder = ContactMessageEncoder(model, tick, session)
        self._end_reason: EndReason = ""  # of all contacts, when the daemon stops
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
        optional = self._transforms.hand_columns(rows)
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
        rows = self._model.rows_of_hand[hand]
        seq, tick_number, sync_ns = self._frame_numbers()
        return wire.Raw(
            v=wire.SCHEMA_VERSION,
            session=self._session,
            seq=seq,
            t_ns=sync_ns,
            tick=tick_number,
            hand=hand,
            links=tuple(self._model.links[rows]),
            counts=self._tick.counts[rows].astype("<i8").tobytes(),
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
