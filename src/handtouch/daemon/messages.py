"""From columns to messages: what a tick changed, as payloads of `wire`, for the topics that are wanted."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from handtouch import wire
from handtouch.canbus.slab import Slab
from handtouch.daemon.model import PadModel
from handtouch.daemon.tick import Tick, Ticked
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


class Outlet(Protocol):
    """What messages are given to: `Publisher`, or a recorder."""

    def wants(self, topic: str) -> bool:
        """Whether a message of this topic is of use to anybody."""

    def next_seq(self, topic: str) -> int:
        """Number of the topic's next message."""

    def send(self, message: wire.Message) -> None:
        """Take a message."""


class Messages:
    """Writes the messages of every tick for the pads of a model."""

    def __init__(self, model: PadModel, tick: Tick) -> None:
        self._model = model
        self._tick = tick
        self._reason = ""  # why all contacts end, once the daemon stops
        self._topics = [f"contact/{hand}/{link}" for hand, link in zip(model.hands, model.links, strict=True)]

    def send_contacts(self, ticked: Ticked, now_ns: int, outlet: Outlet) -> None:
        """Send begin, update and end of the contacts that a tick touched, and forget those that ended."""
        for event, rows in (("begin", ticked.began), ("update", ticked.updated), ("end", ticked.ended)):
            for pad in rows.tolist():
                if outlet.wants(self._topics[pad]):
                    outlet.send(self._contact(pad, event, ticked.t_ns, now_ns, outlet))
        self._tick.contacts.forget(ticked.ended)

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
        columns, ids = self._tick.columns, self._tick.contacts.id
        for hand, rows in self._model.rows_of_hand.items():
            links = tuple(self._model.links[rows])
            if outlet.wants(topic := f"hand/{hand}"):
                located = columns.located[rows]
                outlet.send(
                    wire.HandFrame(
                        v=wire.SCHEMA_VERSION,
                        seq=outlet.next_seq(topic),
                        t_ns=t_ns,
                        tick=tick_number,
                        hand=hand,
                        links=links,
                        state=columns.state[rows].tobytes(),
                        contact=ids[rows].astype("<u4").tobytes(),
                        sample_ns=columns.sample_ns[rows].astype("<i8").tobytes(),
                        current_a=columns.current_a[rows].astype("<f4").tobytes(),
                        position_m=located["position_m"].tobytes(),
                        normal=located["normal"].tobytes(),
                        force_n=located["force_n"].tobytes(),
                        force_std_n=located["force_std_n"].tobytes(),
                        repeat=False,
                    )
                )
            if outlet.wants(topic := f"raw/{hand}"):
                outlet.send(
                    wire.Raw(
                        v=wire.SCHEMA_VERSION,
                        seq=outlet.next_seq(topic),
                        t_ns=t_ns,
                        tick=tick_number,
                        hand=hand,
                        links=links,
                        counts=self._tick.counts[rows].astype("<i8").tobytes(),
                        sample_ns=columns.sample_ns[rows].astype("<i8").tobytes(),
                        fresh=slab.fresh[rows].tobytes(),
                        repeat=False,
                    )
                )

    def _contact(self, pad: int, event: str, t_ns: int, now_ns: int, outlet: Outlet) -> wire.Contact:
        model, columns, contacts = self._model, self._tick.columns, self._tick.contacts
        sample_ns = int(columns.sample_ns[pad])
        begin_ns = int(contacts.begin_ns[pad])
        position = columns.position_m[pad].tolist()
        located = all(map(math.isfinite, position))
        force_n = _finite(columns.force_n[pad])
        strength = "invalid" if force_n is None else "saturated" if columns.saturated[pad] else "valid"
        state = PadState(int(columns.state[pad]))
        return wire.Contact(
            v=wire.SCHEMA_VERSION,
            seq=outlet.next_seq(self._topics[pad]),
            t_ns=sample_ns if event != "end" else t_ns,
            event=event,
            id=int(contacts.id[pad]),
            hand=model.hands[pad],
            link=model.links[pad],
            frame=model.links[pad],
            begin_ns=begin_ns,
            duration_s=((sample_ns if event != "end" else t_ns) - begin_ns) * 1e-9,
            age_s=(now_ns - sample_ns) * 1e-9,
            position_m=tuple(position) if located else None,
            normal=tuple(columns.normal[pad].tolist()) if located else None,
            covariance_m2=tuple(columns.covariance_m2[pad].ravel().tolist()) if located else None,
            pad_m=tuple(columns.pad_m[pad].tolist()) if located else None,
            location="valid" if located else "invalid",
            force_n=force_n,
            force_std_n=_finite(columns.force_std_n[pad]) if strength == "valid" else None,
            peak_force_n=_finite(contacts.peak_n[pad]),
            strength=strength,
            current_a=float(columns.current_a[pad]),
            residual=_finite(columns.residual[pad]),
            residual_std=_finite(columns.residual_std[pad]),
            on_n=float(model.on_n[pad]),
            off_n=float(model.off_n[pad]),
            calibration=model.calibration[pad],
            reason=self._reason or REASONS.get(state, "released") if event == "end" else "",
            repeat=False,
        )


def _finite(value: np.float64) -> float | None:
    return float(value) if math.isfinite(value) else None
