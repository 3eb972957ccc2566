"""From columns to messages: what a tick changed, as payloads of `wire`, for the topics that are wanted."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.canbus.bus.slab import Slab
from handtouch.daemon.frames import Frames
from handtouch.daemon.handframe import HandWriter
from handtouch.daemon.model import PadModel
from handtouch.daemon.tick import LOCATED, Tick, Ticked
from handtouch.wire import PadState

REASONS = {
    PadState.STALE: "stale",
    PadState.LOST: "lost",
    PadState.FAULTED: "faulted",
    PadState.STARTING: "restarted",
    PadState.OFF: "off",
}
"""Why a contact ended, by what became of its pad; any other is released."""
_STOPPED = "stopped"
_ALL = slice(None)
_WITH_STD = ("valid", "unestimated")


class Outlet(Protocol):
    """What messages are given to: `Publisher`, or a recorder."""

    def wants(self, topic: str) -> bool:
        """Whether a message of this topic is of use to anybody."""

    def send(self, message: wire.Outgoing) -> None:
        """Take a message."""


class Messages:
    """Writes the messages of every tick for the pads of a model; `run` is the daemon's.

    `seq` counts what there was to tell, whether anybody wanted it or not: who was away sees a gap.
    """

    def __init__(self, model: PadModel, tick: Tick, run: int = 0, frames: Frames | None = None) -> None:
        self._model = model
        self._placing = frames or Frames(model.hands)
        self._tick = tick
        self._run = run
        self._seq: NDArray[np.int64] = np.zeros(model.size, dtype=np.int64)
        self._frames = 0
        self._frame_of = 0, 0  # number and time of the tick that the last frames were of
        self._reason = ""  # why all contacts end, once the daemon stops
        self._writers = {hand: self._writer(hand, rows) for hand, rows in model.rows_of_hand.items()}
        self._hand_topics = [(hand, f"hand/{hand}", f"raw/{hand}") for hand in model.rows_of_hand]
        self._topics = [f"contact/{hand}/{link}" for hand, link in zip(model.hands, model.links, strict=True)]

    def send_contacts(self, ticked: Ticked, now_ns: int, outlet: Outlet) -> None:
        """Send begin, update and end of the contacts that a tick touched, and forget those that ended."""
        for event, rows in (("begin", ticked.began), ("update", ticked.updated), ("end", ticked.ended)):
            if len(rows):
                self._seq[rows] += 1
            for pad in rows.tolist():
                if outlet.wants(self._topics[pad]):
                    outlet.send(self._contact(pad, event, ticked.t_ns, now_ns))
        self._tick.contacts.forget(ticked.ended)
        self._placing.forget(ticked.ended)

    def adopt(self, model: PadModel) -> None:
        """Tell of another model of the same pads from now on."""
        self._model = model

    def end_all(self, t_ns: int, outlet: Outlet) -> None:
        """Send the end of every contact, for the daemon stops."""
        touching = np.flatnonzero(self._tick.contacts.touching)
        self._reason = _STOPPED
        none = np.zeros(0, dtype=np.intp)
        self.send_contacts(Ticked(t_ns, none, none, touching), t_ns, outlet)
        self._tick.contacts.touching[:] = False
        self._tick.columns.located.view("<f4")[:] = np.nan
        self._tick.columns.state[:] = PadState.STARTING

    def send_frames(self, slab: Slab, tick_number: int, t_ns: int, outlet: Outlet) -> None:
        """Send the columns of every hand, and their raw counts, where somebody wants them."""
        self._frames += 1
        self._frame_of = tick_number, t_ns
        unestimated = self._tick.unestimated(_ALL)
        for hand, topic, raw in self._hand_topics:
            if outlet.wants(topic):
                outlet.send(self._hand(hand, unestimated))
            if outlet.wants(raw):
                outlet.send(self._raw(hand, slab))

    def rehearse(self, outlet: Outlet) -> None:
        """Encode the frames of the hands that somebody wants, and throw them away."""
        for hand, topic, _ in self._hand_topics:
            if outlet.wants(topic):
                wire.encode(self._hand(hand, self._tick.unestimated(_ALL)))

    def present(self) -> dict[str, Callable[[int], wire.Outgoing | None]]:
        """Topic -> what there is to repeat of it, at a time [ns]: contacts under way, and hands."""
        return {
            **{topic: partial(self._under_way, pad) for pad, topic in enumerate(self._topics)},
            **{f"hand/{hand}": partial(self._last_hand, hand) for hand in self._model.rows_of_hand},
        }

    def _under_way(self, pad: int, now_ns: int) -> wire.Contact | None:
        if not self._tick.contacts.touching[pad]:
            return None
        return self._contact(pad, "update", 0, now_ns, repeat=True)

    def _last_hand(self, hand: str, _: int) -> wire.Packed | None:
        return self._hand(hand, self._tick.unestimated(_ALL), repeat=True) if self._frames else None

    def _hand(self, hand: str, unestimated: NDArray[np.bool_], repeat: bool = False) -> wire.Packed:
        rows = self._model.rows_of_hand[hand]
        optional = self._placing.columns(rows)
        if np.count_nonzero(unestimated) and np.count_nonzero(unestimated[rows]):
            optional["unestimated"] = unestimated[rows].tobytes()
        if np.count_nonzero(vague := self._model.vague[rows]):
            optional["doubtful"] = vague.tobytes()
        tick_number, t_ns = self._frame_of
        return self._writers[hand].write(self._frames, t_ns, tick_number, repeat, optional)

    def _writer(self, hand: str, rows: slice) -> HandWriter:
        columns = self._tick.columns
        sources: dict[str, NDArray[Any]] = {
            "state": columns.state[rows],
            "contact": self._tick.contacts.id[rows],
            "sample_ns": columns.sample_ns[rows],
            "current_a": columns.current_a[rows],
            "saturated": columns.saturated[rows],
            **{name: columns.located[name][rows] for name in LOCATED.names or ()},
        }
        return HandWriter(self._run, hand, tuple(self._model.links[rows]), sources)

    def _raw(self, hand: str, slab: Slab) -> wire.Raw:
        rows = self._model.rows_of_hand[hand]
        return wire.Raw(
            v=wire.SCHEMA_VERSION,
            run=self._run,
            seq=self._frames,
            t_ns=self._frame_of[1],
            tick=self._frame_of[0],
            hand=hand,
            links=tuple(self._model.links[rows]),
            counts=self._tick.counts[rows].astype("<i8").tobytes(),
            sample_ns=self._tick.columns.sample_ns[rows].astype("<i8").tobytes(),
            fresh=slab.fresh[rows].tobytes(),
            repeat=False,
        )

    def _contact(self, pad: int, event: str, t_ns: int, now_ns: int, repeat: bool = False) -> wire.Contact:
        model, columns, contacts = self._model, self._tick.columns, self._tick.contacts
        sample_ns = int(columns.sample_ns[pad])
        begin_ns = int(contacts.begin_ns[pad])
        position, normal, on_pad = (
            column[pad].tolist() for column in (columns.position_m, columns.normal, columns.pad_m)
        )
        located = all(map(math.isfinite, (*position, *normal, *on_pad)))
        location = "doubtful" if model.vague[pad] else "valid"
        covariance = columns.covariance_m2[pad].ravel().tolist()
        certain = located and all(map(math.isfinite, covariance))  # at a corner nothing may bound it
        force_n = _finite(columns.force_n[pad])
        strength = "invalid" if force_n is None else "saturated" if columns.saturated[pad] else "valid"
        if strength == "valid" and self._tick.unestimated(pad):
            strength = "unestimated"
        if not self._tick.follower.weighed[pad]:
            strength = "skipped"
        modelled = self._tick.strength.modelled[pad]
        state = PadState(int(columns.state[pad]))
        return wire.Contact(
            v=wire.SCHEMA_VERSION,
            run=self._run,
            seq=int(self._seq[pad]),
            t_ns=sample_ns if event != "end" else t_ns,
            event=event,
            id=int(contacts.id[pad]),
            hand=model.hands[pad],
            link=model.links[pad],
            frame=model.frames[pad],
            begin_ns=begin_ns,
            duration_s=((sample_ns if event != "end" else t_ns) - begin_ns) * 1e-9,
            age_s=(now_ns - sample_ns) * 1e-9,
            position_m=tuple(position) if located else None,
            normal=tuple(normal) if located else None,
            covariance_m2=tuple(covariance) if certain else None,
            pad_m=tuple(on_pad) if located else None,
            location=location if located else "invalid" if self._tick.wanted[pad] else "skipped",
            force_n=force_n,
            force_std_n=_finite(columns.force_std_n[pad]) if strength in _WITH_STD else None,
            peak_force_n=_finite(contacts.peak_n[pad]),
            strength=strength,
            current_a=float(columns.current_a[pad]),
            residual=_finite(columns.residual[pad]),
            residual_std=_finite(columns.residual_std[pad]),
            on_n=float(model.on_n[pad]),
            off_n=float(model.off_n[pad]),
            calibration=model.calibration[pad],
            reason=self._reason or REASONS.get(state, "released") if event == "end" else "",
            repeat=repeat,
            raw_force_n=_finite(columns.raw_force_n[pad]) if modelled else None,
            findings=model.findings[pad],
            **self._placing.tell(pad),
        )


def _finite(value: np.float64) -> float | None:
    return float(value) if math.isfinite(value) else None
