"""The newest state of a hand for a control loop.

    with handtouch.Hand("right") as hand:
        while hand.wait(0.1):
            if hand.touched["index_distal"]:
                print(hand.force_n["index_distal"], hand.age_s["index_distal"])

Public names: `Hand`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar

import zmq
from zmq import zmq_poll

from handtouch import wire
from handtouch.client.connection import RECONNECT_OPTIONS, Connection
from handtouch.client.control import DaemonControl, Output, Scenes, TareResult
from handtouch.client.hand_state import HandState
from handtouch.client.link_columns import HandArrays, LinkColumn, LinkColumns
from handtouch.client.listener import Listener
from handtouch.client.subscriber import SERVICE_TIMEOUT_S, connect
from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT

QUEUE_MESSAGES = 10_000
"""Messages that wait in this process: those of 4 s with 10 contacts at 200 Hz. Further ones are lost."""
T = TypeVar("T")
_LOCAL = ("ipc://", "inproc://", "tcp://127.", "tcp://localhost", "tcp://[::1]")


class Hand(LinkColumns):
    """The newest state of a hand: a control loop calls `latest` or `wait`, and reads arrays by link.

        hand.latest()                              # never blocks; drops all frames but the newest
        hand.force_n["index_distal"], hand.touched["palm_heel"], hand.age_s["thumb_tip"]
        for link, contact in hand.contacts.items(): ...

    The attributes are those of the frame that `latest` or `wait` returned last, so they belong to one tick.
    They raise LookupError while there is none: before the first frame, and without a daemon.

    `name`: the hand's in the deployment. `endpoint`, `control` and `key` as for `connect` and `request`.
    Raises ValueError for an invalid name or endpoint and for an unusable key file; receiving raises
    PermissionError when the daemon rejects this client. Not thread-safe; callbacks have a thread and a
    connection of their own (`on_contact`, `on_frame`).
    """

    def __init__(
        self,
        name: str,
        *,
        endpoint: str = LIVE_ENDPOINT,
        control: str = CONTROL_ENDPOINT,
        key: Path | str | None = None,
    ) -> None:
        if not name or set(name) & set("/*?["):
            raise ValueError(f"{name!r} is no name of a hand; give one of the deployment, such as 'right'")
        self.name = name
        self.control = DaemonControl(control, key)
        self.malformed_messages = 0
        """messages dropped because they violate the wire contract"""
        self._settings = (endpoint, control, key)
        options = {zmq.RCVHWM: QUEUE_MESSAGES, zmq.LINGER: 0, **RECONNECT_OPTIONS}
        self._connection = Connection.open(zmq.SUB, endpoint, key, options)
        self._items = [(self._connection.socket, int(zmq.POLLIN))]
        self._frame_topic, self._contact_prefix = f"hand/{name}".encode(), f"contact/{name}/".encode()
        for prefix in (self._frame_topic, self._contact_prefix, b"service"):
            self._connection.socket.subscribe(prefix)
        self._state = HandState()
        self._arrays: HandArrays | None = None
        self._undecoded: dict[bytes, tuple[int, list[bytes]]] = {}  # newest of each contact topic
        self._received = 0
        self._last_receive_s = 0.0
        self._listeners: list[Listener[Any]] = []

    def latest(self) -> HandArrays | None:
        """Return the newest frame that has arrived, the same object while there is no newer one.

        Never blocks. None before the first frame, and without a daemon, whose last state is void. Raises
        PermissionError when the daemon rejects this client.
        """
        if zmq_poll(self._items, 0):
            self._drain()
        elif not self.alive:
            self._connection.poll(0)  # rejected?
            self._arrays = None
            return None
        self._arrays = self._state.arrays
        return self._arrays

    def wait(self, timeout_s: float | None = None) -> HandArrays | None:
        """Return the newest frame, as soon as it isn't the one returned before; None after the timeout.

        Raises PermissionError when the daemon rejects this client.
        """
        seen = self._arrays
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while (arrays := self.latest()) is None or arrays is seen:
            left_ms = None if end_s is None else max(0, round((end_s - time.monotonic()) * 1000))
            if not self._connection.poll(left_ms) and left_ms is not None:
                return None
        return arrays

    async def wait_async(self, timeout_s: float | None = None) -> HandArrays | None:
        """Do as `wait`, for asyncio: several tasks may wait, and each gets the frame."""
        seen = self._arrays
        try:
            async with asyncio.timeout(timeout_s):
                return await self._next_arrays(seen)
        except TimeoutError:
            return None

    @property
    def contacts(self) -> Mapping[str, wire.Contact]:
        """Active contacts by link, by the newest message of each; empty without a daemon (see `alive`)."""
        if not self.alive:
            return {}
        for order, parts in self._undecoded.values():
            self._feed(order, parts)
        self._undecoded.clear()
        return self._state.contacts

    @property
    def alive(self) -> bool:
        """True if any message, the daemon's heartbeat at least, was received within SERVICE_TIMEOUT_S."""
        return time.monotonic() - self._last_receive_s < SERVICE_TIMEOUT_S

    @property
    def links(self) -> tuple[str, ...]:
        """Links of the hand, in the order of the rows of all arrays."""
        return self._require_arrays().links

    @property
    def age_s(self) -> LinkColumn[float]:
        """Age of each pad's sample now [s], by `now_ns`; infinite before the first."""
        return self._require_arrays().age_at(self.now_ns())

    def now_ns(self) -> int:
        """Return the present time on the daemon's monotonic clock [ns].

        For a daemon on another machine by the wall clocks of both, which NTP or PTP must synchronise; raises
        LookupError there until the daemon's offset is received, within half a second.
        """
        if self._connection.endpoint.startswith(_LOCAL):
            return time.monotonic_ns()
        if self._state.service is None:
            raise LookupError("the daemon's clock isn't known yet; wait half a second")
        return time.time_ns() - self._state.service.wall_offset_ns

    def column(self, name: str) -> LinkColumn[Any]:
        """Return a column of the newest frame by its name. Raises LookupError while there is none."""
        return (self._arrays or self._require_arrays()).column(name)

    @property
    def arrays(self) -> HandArrays:
        """The frame that `latest` or `wait` returned last. Raises LookupError while there is none."""
        return self._require_arrays()

    def on_contact(self, callback: Callable[[wire.Contact], object]) -> Listener[wire.Contact]:
        """Call a function for every begin, update and end of a contact, in a thread; until `close`."""
        endpoint, _, key = self._settings
        pattern = f"contact/{self.name}/*"
        contacts = connect(pattern, kind=wire.Contact, endpoint=endpoint, key=key)
        return self._start(Listener(contacts.recv, contacts.close, callback, f"on_contact of {self.name}"))

    def on_frame(self, callback: Callable[[HandArrays], object]) -> Listener[HandArrays]:
        """Call a function for the newest frame, in a thread; frames that arrive meanwhile are skipped."""
        endpoint, control, key = self._settings
        hand = Hand(self.name, endpoint=endpoint, control=control, key=key)
        return self._start(Listener(hand.wait, hand.close, callback, f"on_frame of {self.name}"))

    def tare(self, *links: str) -> list[TareResult]:
        """Zero the pads on links that match the patterns, by default all; errors as for `DaemonControl`."""
        return self.control.tare(*self._pads_on(links or ("*",)))

    def scene(
        self,
        *,
        outputs: Sequence[Output] | None = None,
        rate_hz: float | None = None,
        links: Sequence[str] | None = None,
        name: str | None = None,
        lease_s: float | None = None,
    ) -> Scenes:
        """Change the base scene, or a client's, as `DaemonControl.scene`; `links`: patterns, of this hand."""
        pads = None if links is None else self._pads_on(links)
        return self.control.scene(links=pads, outputs=outputs, rate_hz=rate_hz, name=name, lease_s=lease_s)

    def disable(self, *links: str, name: str | None = None) -> dict[str, str]:
        """Switch off the pads on links that match the patterns, as `DaemonControl.disable`."""
        return self.control.disable(*self._pads_on(links), name=name)

    def enable(self, *links: str, name: str | None = None) -> dict[str, str]:
        """Switch on the pads on links that match the patterns, as `DaemonControl.enable`."""
        return self.control.enable(*self._pads_on(links), name=name)

    def close(self) -> None:
        """Disconnect, and stop callbacks; raises what one of them raised."""
        self._connection.close()
        while self._listeners:
            self._listeners.pop().close()

    def __iter__(self) -> Iterator[HandArrays]:
        while True:
            if (arrays := self.wait()) is not None:
                yield arrays

    async def __aiter__(self) -> AsyncIterator[HandArrays]:
        seen = None
        while True:
            yield (seen := await self._next_arrays(seen))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def _require_arrays(self) -> HandArrays:
        if self._arrays is None:
            raise LookupError(
                f"there is no frame of hand {self.name!r}: call latest() or wait() until it returns one; "
                "check the name, and that `handtouch run` is running"
            )
        return self._arrays

    async def _next_arrays(self, seen: HandArrays | None) -> HandArrays:
        await asyncio.sleep(0)  # let other tasks run even while the stream never pauses
        while (arrays := self.latest()) is None or arrays is seen:
            await self._connection.wait()
        return arrays

    def _pads_on(self, links: Sequence[str]) -> list[str]:
        if isinstance(links, str):
            raise ValueError(f"{links!r} is one string; give a list, [{links!r}]")
        return [f"{self.name}/{link}" for link in links]

    def _start(self, listener: Listener[T]) -> Listener[T]:
        self._listeners.append(listener)
        return listener

    def _drain(self) -> None:
        """Receive all waiting messages; decode the newest of each topic, of a contact once it is read."""
        receive, newest = self._connection.socket.recv_multipart, dict[bytes, tuple[int, list[bytes]]]()
        try:
            while True:
                parts = receive(zmq.NOBLOCK)
                self._received += 1
                newest[parts[0]] = self._received, parts
        except zmq.Again:
            pass
        self._last_receive_s = time.monotonic()
        for topic, (order, parts) in newest.items():
            if topic.startswith(self._contact_prefix):
                self._undecoded[topic] = order, parts
            elif topic in (self._frame_topic, b"service"):  # not hand/right_arm by its prefix
                self._feed(order, parts)
        self._connection.wake_waiting()

    def _feed(self, order: int, parts: list[bytes]) -> None:
        try:
            self._state.feed(wire.decode(parts), order)
        except wire.WireError:
            self.malformed_messages += 1
