"""The newest state of a hand for a control loop.

    with handtouch.Hand("right") as hand:
        while hand.wait(0.1):
            if hand.touched["index_distal"]:  # raises an error where the pad isn't sampled
                print(hand.force_n["index_distal"], hand.age_s["index_distal"])

Public names: `Hand`.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import zmq
from zmq import zmq_poll

from handtouch import wire
from handtouch.client.connection import Connection
from handtouch.client.control import DaemonControl, Scenes, TareResult
from handtouch.client.daemon_clock import DaemonClock, age_limit_s
from handtouch.client.hand_arrays import FrameName, HandArrays, LinkColumns
from handtouch.client.hand_state import HandState
from handtouch.client.link_column import LinkColumn
from handtouch.client.listener import Listener
from handtouch.client.names import UnknownNameError, unknown_name
from handtouch.client.socket_options import RECONNECT_OPTIONS
from handtouch.client.subscriber import SERVICE_TIMEOUT_S, connect, request
from handtouch.client.window import HandWindow
from handtouch.client.wrench import Wrench
from handtouch.host.closing import AsyncClosing
from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT
from handtouch.wire.contact import Output

QUEUE_MESSAGES = 10_000
"""Messages that wait in this process: those of 4 s with 10 contacts at 200 Hz. Further ones are lost."""
MAX_WINDOW_S = 60.0
"""Longest window: 12,000 frames at 200 Hz, of some 2 kB for 15 pads"""
_WINDOW_MARGIN_NS = 1_000_000_000  # of receptions: frames that waited in queues are older
_POLL_S = 0.02
"""Longest time until an iterator notices that the daemon is gone"""
_CLOCK_PERIOD_S = 5.0
"""Time between two round trips to a daemon on another machine: clocks drift 2.5 ms apart in it at most"""
T = TypeVar("T")
_LOCAL = ("ipc://", "inproc://", "tcp://127.", "tcp://localhost", "tcp://[::1]")


class Hand(LinkColumns, AsyncClosing):
    """The newest state of a hand: a control loop calls `latest` or `wait`, and reads arrays by link.

        hand.latest()                              # never blocks; drops all frames but the newest
        hand.force_n["index_distal"], hand.touched["palm_heel"], hand.age_s["thumb_tip"]
        for link, contact in hand.contacts.items(): ...

    The attributes are those of the frame that `latest` or `wait` returned last, so they belong to one tick.
    They raise LookupError while there is none: before the first frame, without a daemon, and while the newest
    frame is older than `max_age_s`. A frame's age is by its own time, not by when it was received.

    `name`: the hand's in the deployment. `endpoint`, `control` and `key` as for `connect` and `request`.
    `window_s`: how far back `window` reaches; 0: frames that `latest` skips aren't kept.
    `max_age_s`: None: three of the periods of its frames as `service` states them, or MIN_AGE_LIMIT_S if that
    is longer. Frames of a replay, whose `service` says so, have the age since their reception.
    Raises ValueError for an invalid name or endpoint and for an unusable key file; receiving raises
    PermissionError when the daemon rejects this client, and UnknownNameError while it has no hand of this
    name. Nothing received for 2 s is logged once, with the reason. Not thread-safe; callbacks have a thread
    and a connection of their own (`on_contact`, `on_frame`).
    """

    def __init__(
        self,
        name: str,
        *,
        endpoint: str = LIVE_ENDPOINT,
        control: str = CONTROL_ENDPOINT,
        key: Path | str | None = None,
        max_age_s: float | None = None,
        window_s: float = 0.0,
    ) -> None:
        if not 0 <= window_s <= MAX_WINDOW_S:
            raise ValueError(f"window_s is {window_s}; it must be from 0 to {MAX_WINDOW_S:g}")
        if max_age_s is not None and not max_age_s > 0:
            raise ValueError(f"max_age_s is {max_age_s}; it must be positive")
        if not name or set(name) & set("/*?["):
            raise ValueError(f"{name!r} is no name of a hand; give one of the deployment, such as 'right'")
        self.name = name
        self.control = DaemonControl(control, key)
        self.malformed_messages = 0
        """messages dropped because they violate the wire contract"""
        self._settings = (endpoint, control, key)
        self._given_age_s = max_age_s
        options = {zmq.RCVHWM: QUEUE_MESSAGES, zmq.LINGER: 0, **RECONNECT_OPTIONS}
        self._connection = Connection.open(zmq.SUB, endpoint, key, options)
        self._items = self._connection.items
        self._frame_topic, self._contact_prefix = f"hand/{name}".encode(), f"contact/{name}/".encode()
        for prefix in (self._frame_topic, self._contact_prefix, b"service"):
            self._connection.socket.subscribe(prefix)
        self._unknown = ""
        self._state = HandState()
        self._arrays: HandArrays | None = None
        self._window_ns = round(1e9 * window_s)
        self._kept = deque[tuple[int, list[bytes]]]()  # frames with their reception, for `window`
        self._window_frames = deque[wire.HandFrame]()
        self._undecoded: dict[bytes, tuple[int, list[bytes]]] = {}  # newest of each contact topic
        self._received = 0
        self._last_receive_ns = self._frame_ns = 0  # receptions
        self._disconnects, self._void_order = 0, -1  # frames up to this order are of a lost connection
        self._clock = DaemonClock(endpoint.startswith(_LOCAL))
        self._round_trips = deque[tuple[int, int, int]](maxlen=100)
        self._closed = threading.Event()
        self._listeners: list[Listener[Any]] = []
        if not self._clock.is_local:
            threading.Thread(target=self._measure_clock, name="daemon clock", daemon=True).start()

    def latest(self) -> HandArrays | None:
        """Return the newest frame that has arrived, the same object while there is no newer one.

        Never blocks. None before the first frame, without a daemon, and while the newest is older than
        `max_age_s`. Raises PermissionError when the daemon rejects this client, and UnknownNameError while it
        has no hand of this name.
        """
        if zmq_poll(self._items, 0):
            self._drain()
            self._connection.check()
        else:
            self._connection.warn_of_silence()
        if self._unknown:
            raise UnknownNameError(self._unknown)
        if self._connection.disconnects != self._disconnects:
            self._disconnects, self._void_order = self._connection.disconnects, self._received
        self._arrays = self._state.arrays if self.alive else None
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

    def window(self, seconds: float | None = None) -> HandWindow:
        """Return the frames of the last seconds, as arrays (n, pads); by default all that are kept.

        For loops that are slower than touch: between two calls no frame is left out, whichever `latest`
        returned. Raises LookupError while there is no frame, or it is too old, and ValueError for more
        seconds than `window_s`.
        """
        seconds = 1e-9 * self._window_ns if seconds is None else seconds
        if not 0 < seconds <= 1e-9 * self._window_ns:
            raise ValueError(
                f"a window of {seconds:g} s, and {1e-9 * self._window_ns:g} s are kept: "
                f"make it Hand({self.name!r}, window_s={max(seconds, 0.1):g})"
            )
        if self.latest() is None:
            self._arrays = None
        newest = self._require_arrays().frame
        while self._kept:
            frame = self._decode(self._kept.popleft()[1])
            if isinstance(frame, wire.HandFrame):
                self._window_frames.append(frame)
        since_ns = newest.t_ns - round(1e9 * seconds)
        frames = {
            frame.seq: frame
            for frame in self._window_frames
            if frame.session == newest.session and frame.links == newest.links and frame.t_ns > since_ns
        }
        while self._window_frames and self._window_frames[0].t_ns < newest.t_ns - self._window_ns:
            self._window_frames.popleft()
        return HandWindow([frames[seq] for seq in sorted(frames)])

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
        """True while the newest frame is at most `max_age_s` old, and the connection wasn't lost since."""
        arrays = self._state.arrays
        if arrays is None or self._state.frame_order <= self._void_order:
            return False
        now_ns = self._daemon_ns()
        return now_ns is not None and now_ns - arrays.frame.t_ns <= 1e9 * self.max_age_s

    @property
    def max_age_s(self) -> float:
        """Age [s] of the newest frame up to which it counts, of the planned rate unless it was given."""
        return age_limit_s(self._state.period_s) if self._given_age_s is None else self._given_age_s

    @property
    def clock_uncertainty_s(self) -> float:
        """Half the range [s] of what ages may be: 0 for a daemon on this machine.

        Infinite while no round trip to the control endpoint has succeeded: ages are lower bounds then, by the
        smallest delay seen.
        """
        return self._clock.uncertainty_s

    @property
    def links(self) -> tuple[str, ...]:
        """Links of the hand, in the order of the rows of all arrays."""
        return self._require_arrays().links

    @property
    def age_s(self) -> LinkColumn[float]:
        """Age of each pad's sample now [s], by `now_ns`; infinite before the first, never negative."""
        return self._require_arrays().age_at(self.now_ns())

    def now_ns(self) -> int:
        """Return the present time on the daemon's monotonic clock [ns].

        For a daemon on another machine from round trips to its control endpoint, see `clock_uncertainty_s`;
        raises LookupError there until a message was received.
        """
        now_ns = self._daemon_ns()
        if now_ns is None:
            raise LookupError("the daemon's clock isn't known before its first message")
        return now_ns

    def _daemon_ns(self) -> int | None:
        here_ns, state = time.monotonic_ns(), self._state
        if state.is_replay and state.arrays is not None:
            return here_ns - self._frame_ns + state.arrays.frame.t_ns
        return self._clock.daemon_ns(here_ns)

    def column(self, name: str) -> LinkColumn[Any]:
        """Return a column of the newest frame by its name; `sampled` and `touched` depend on its age.

        Raises LookupError while there is no frame.
        """
        return self._believed(name in ("touched", "sampled")).column(name)

    def require(self, links: str | Sequence[str] = "*") -> None:
        """Raise NotSampledError naming a pad on links that match the patterns and isn't sampled now."""
        self._believed().require(links)

    def wrench(self, links: str = "*", frame: FrameName = "palm") -> Wrench:
        """Return the sum as `HandArrays.wrench`, NaN where one of its pads isn't sampled now."""
        return self._believed().wrench(links, frame)

    def total_force_n(self, links: str = "*") -> tuple[float, float]:
        """Return the sum as `HandArrays.total_force_n`, NaN where one of its pads isn't sampled now."""
        return self._believed().total_force_n(links)

    def _believed(self, judge: bool = True) -> HandArrays:
        """Return the newest frame; as an old one if it is judged to be."""
        arrays = self._arrays or self._require_arrays()
        return arrays if not judge or self.alive else arrays.as_old()

    @property
    def arrays(self) -> HandArrays:
        """The frame that `latest` or `wait` returned last. Raises LookupError while there is none."""
        return self._require_arrays()

    def on_contact(
        self, callback: Callable[[wire.Contact], object], on_lost: Callable[[], object] | None = None
    ) -> Listener[wire.Contact]:
        """Call a function for every begin, update and end of a contact, in a thread; until `close`.

        `on_lost` is called when the daemon is gone, which is logged in any case.
        """
        endpoint, _, key = self._settings
        pattern = f"contact/{self.name}/*"
        contacts = connect(pattern, kind=wire.Contact, endpoint=endpoint, key=key)
        name = f"on_contact of {self.name}"

        def is_lost() -> bool:
            return contacts.has_received and not contacts.alive

        return self._start(Listener(contacts.recv, contacts.close, callback, name, is_lost, on_lost))

    def on_frame(
        self, callback: Callable[[HandArrays], object], on_lost: Callable[[], object] | None = None
    ) -> Listener[HandArrays]:
        """Call a function for the newest frame, in a thread; frames that arrive meanwhile are skipped.

        `on_lost` is called when frames are older than `max_age_s`, which is logged in any case.
        """
        endpoint, control, key = self._settings
        hand = Hand(self.name, endpoint=endpoint, control=control, key=key, max_age_s=self._given_age_s)
        name = f"on_frame of {self.name}"

        def is_lost() -> bool:
            return hand._frame_ns != 0 and not hand.alive

        return self._start(Listener(hand.wait, hand.close, callback, name, is_lost, on_lost))

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

    def __repr__(self) -> str:
        """Return the newest frame as a table, or why there is none."""
        if self._arrays is None:
            return f"hand {self.name} at {self._connection.endpoint}: no frame"
        return repr(self._arrays) + ("" if self.alive else "\n  too old: the daemon is silent or gone")

    def close(self) -> None:
        """Disconnect, and stop callbacks; raises what one of them raised."""
        self._closed.set()
        self._connection.close()
        while self._listeners:
            self._listeners.pop().close()

    def __iter__(self) -> Iterator[HandArrays]:
        """Yield the newest frames from the first on. Raises ConnectionError when the daemon is gone."""
        seen = None
        while True:
            if (arrays := self.wait(_POLL_S)) is not None:
                self._check_session(seen, arrays)
                yield (seen := arrays)
            else:
                self._check_lost(seen)

    async def __aiter__(self) -> AsyncIterator[HandArrays]:
        """Yield as `__iter__`."""
        seen = None
        while True:
            try:
                async with asyncio.timeout(_POLL_S):
                    arrays = await self._next_arrays(seen)
            except TimeoutError:
                self._check_lost(seen)
                continue
            self._check_session(seen, arrays)
            yield (seen := arrays)

    def _check_lost(self, seen: HandArrays | None) -> None:
        """Raise ConnectionError if the daemon is gone, or silent for SERVICE_TIMEOUT_S."""
        if seen is None:
            return
        silent_s = 1e-9 * (time.monotonic_ns() - self._last_receive_ns)
        if self._state.frame_order <= self._void_order or silent_s >= SERVICE_TIMEOUT_S:
            raise ConnectionError(f"the daemon at {self._connection.endpoint} is gone; iterate again to wait")

    def _check_session(self, seen: HandArrays | None, arrays: HandArrays) -> None:
        if seen is not None and arrays.frame.session != seen.frame.session:
            raise ConnectionError(f"the daemon at {self._connection.endpoint} was restarted; iterate again")

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

    def _measure_clock(self) -> None:
        """Measure round trips to the control endpoint until `close`, in a thread of its own."""
        _, control, key = self._settings
        while not self._closed.is_set():
            sent_ns = time.monotonic_ns()
            try:
                answer = request("status", endpoint=control, key=key, timeout_s=1.0)
            except (OSError, RuntimeError, ValueError):
                answer = {}
            if isinstance(t_ns := answer.get("now_ns"), int):
                self._round_trips.append((sent_ns, t_ns, time.monotonic_ns()))
            self._closed.wait(_CLOCK_PERIOD_S)

    def _drain(self) -> None:
        """Receive all waiting messages; decode the newest of each topic, of a contact once it is read."""
        receive, newest = self._connection.socket.recv_multipart, dict[bytes, tuple[int, list[bytes]]]()
        try:
            while True:
                parts = receive(zmq.NOBLOCK)
                self._received += 1
                newest[parts[0]] = self._received, parts
                if self._window_ns and parts[0] == self._frame_topic:
                    self._keep(parts)
        except zmq.Again:
            pass
        if newest:
            self._connection.note_message()
        self._last_receive_ns = time.monotonic_ns()
        while self._round_trips:
            self._clock.measure(*self._round_trips.popleft())
        for topic, (order, parts) in newest.items():
            if topic.startswith(self._contact_prefix):
                self._undecoded[topic] = order, parts
            elif topic in (self._frame_topic, b"service"):  # not hand/right_arm by its prefix
                self._feed(order, parts)
        self._connection.wake_waiting()

    def _keep(self, parts: list[bytes]) -> None:
        """Keep a frame for `window`, and none that is older than it reaches."""
        now_ns = time.monotonic_ns()
        self._kept.append((now_ns, parts))
        while now_ns - self._kept[0][0] > self._window_ns + _WINDOW_MARGIN_NS:
            self._kept.popleft()

    def _decode(self, parts: list[bytes]) -> wire.Message | None:
        try:
            return wire.decode(parts)
        except wire.WireError:
            return None

    def _feed(self, order: int, parts: list[bytes]) -> None:
        message = self._decode(parts)
        if message is None:
            self.malformed_messages += 1
            return
        before, session = self._state.arrays, self._state.session
        self._state.feed(message, order)
        if self._state.session != session:
            self._clock.reset()
        if self._state.arrays is not before:
            self._frame_ns = self._last_receive_ns
        if isinstance(message, wire.Service):
            self._unknown = unknown_name(f"hand/{self.name}", message.hands)
        if isinstance(message, wire.HandFrame | wire.Service) and not message.retained:
            self._clock.observe(message.t_ns, self._last_receive_ns)
