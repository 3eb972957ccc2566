"""Content of recordings: every message in order, losses counted, each file complete in itself.

Public names: `MessageRecorder`, `RotationLimits`, `MessageFile`, `SceneConverter`, `NoScenes`. Free of
sockets and clocks.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from handtouch import wire
from handtouch.record.schemas import ENCODING, MARK, MARK_FORMAT, MessageFormat, SceneMessage
from handtouch.wire.codec import check_fields, unpack

_FLUSH_PERIOD_NS = 1_000_000_000
_STATE_REQUEST_PERIOD_NS = 2_000_000_000
_STATE_PERIOD_NS = 60_000_000_000
"""Time after which configuration and state are recorded again, so that damage costs no more than that"""
_TOPIC_OF_PREFIX = {topic.prefix: topic for topic in wire.TOPICS}
_REPEATED_PREFIXES = ("config", "service", "health")
"""Topics whose latest message begins every file, so that each can be read alone."""
_MAX_WAITING_MESSAGES = 100_000


class MessageFile(Protocol):
    """Output of messages: `RecordingFile`, or Foxglove's live server."""

    @property
    def size(self) -> int: ...

    def write(
        self, topic: str, data: bytes, t_ns: int, seq: int = 0, form: MessageFormat | None = None
    ) -> None: ...

    def flush(self) -> None: ...

    def finish(self, summary: dict[str, str]) -> None: ...


class SceneConverter(Protocol):
    """Maker of scenes and logs from the messages of a session: `FoxgloveConverter`."""

    def convert(self, topic: str, payload: dict[str, Any], t_ns: int) -> list[SceneMessage]: ...


class NoScenes:
    """A `SceneConverter` that makes nothing."""

    def convert(self, topic: str, payload: dict[str, Any], t_ns: int) -> list[SceneMessage]:  # noqa: ARG002
        """Return no message."""
        return []


@dataclass(frozen=True)
class RotationLimits:
    """Limits of a file, after which the next one begins."""

    max_bytes: int = 1 << 62
    max_duration_ns: int = 1 << 62


class MessageRecorder:
    """Recorder of messages in the order of arrival; times are ns since 1970 UTC, except `now_ns`, monotonic.

    `open_file` opens the next file, when the time of its first message is known; `make_converter` makes the
    converter of a session. `state_requested`: subscribe
    to `state` again, to get the daemon's retained state. `lost` counts messages missing in sequences, by
    topic; `malformed` those that violate the wire contract. Exceptions of files are passed on.
    """

    def __init__(
        self,
        open_file: Callable[[int], MessageFile],
        limits: RotationLimits,
        make_converter: Callable[[], SceneConverter] = NoScenes,
    ) -> None:
        self.lost: Counter[str] = Counter()
        self.malformed = 0
        self.messages: Counter[str] = Counter()
        self.contacts = 0
        self.finished_bytes = 0
        """in completed files"""
        self.state_requested = False
        self.file: MessageFile | None = None
        self._open_file, self._limits = open_file, limits
        self._make_converter, self._converter = make_converter, make_converter()
        self._session: int | None = None
        self._wall_offset_ns: int | None = None
        self._waiting: list[tuple[str, bytes, dict[str, Any]]] = []
        self._repeated: dict[str, tuple[bytes, int]] = {}
        self._seq: dict[str, int] = {}
        self._state_requested_ns = self._state_ns = self._flushed_ns = self._file_opened_ns = 0
        self._needs_state = True
        self._state_tick: int | None = None  # tick of a state since which no tick was recorded

    @property
    def size(self) -> int:
        """Bytes written, in all files."""
        return self.finished_bytes + (self.file.size if self.file else 0)

    def add_message(self, parts: list[bytes], now_ns: int) -> None:
        """Record a received message."""
        try:
            topic, payload = _checked_message(parts)
        except wire.WireError:
            self.malformed += 1
            return
        if payload["session"] != self._session:
            self._begin_session(payload["session"])
        if not self._is_new(topic, payload):
            return
        if topic == "service" and self._wall_offset_ns is None:
            self._wall_offset_ns = payload["wall_offset_ns"]
        if self._wall_offset_ns is None:
            self._waiting = [*self._waiting[-_MAX_WAITING_MESSAGES:], (topic, parts[1], payload)]
            return
        waiting, self._waiting = self._waiting, []
        for held in waiting:
            self._store_message(*held, now_ns)
        self._store_message(topic, parts[1], payload, now_ns)

    def add_mark(self, text: str, wall_ns: int) -> None:
        """Record a mark at a time since 1970 UTC; before the first message of a daemon there is none."""
        if self.file is None or self._wall_offset_ns is None:
            return
        mark = {"t_ns": wall_ns - self._wall_offset_ns, "text": text}
        self.messages[MARK] += 1
        self._write(MARK, json.dumps(mark).encode(), wall_ns, form=MARK_FORMAT)

    def poll(self, now_ns: int) -> None:
        """Flush, and request the state if it is due; call this about once a second."""
        if self.file is None:
            return
        if now_ns - self._flushed_ns >= _FLUSH_PERIOD_NS:
            self._flushed_ns = now_ns
            self.file.flush()
        due = self._is_full(now_ns) or self._needs_state or now_ns - self._state_ns >= _STATE_PERIOD_NS
        if due and now_ns - self._state_requested_ns >= _STATE_REQUEST_PERIOD_NS:
            self._state_requested_ns = now_ns
            self.state_requested = True

    def finish(self) -> None:
        """Complete the present file, if any."""
        if self.file is not None:
            self.file.finish(self.summary())
            self.finished_bytes += self.file.size
            self.file = None

    def summary(self) -> dict[str, str]:
        """Return the counts of all files; `lost` is a map of topic to messages."""
        return {
            "messages": str(sum(self.messages.values())),
            "contacts": str(self.contacts),
            "ticks": str(self.messages["tick"]),
            "lost": json.dumps(dict(self.lost)),
            "malformed": str(self.malformed),
        }

    def _begin_session(self, session: int) -> None:
        self._session, self._wall_offset_ns = session, None
        self._seq.clear()
        self._repeated.clear()
        self._waiting.clear()
        self._converter = self._make_converter()
        self._needs_state = True

    def _is_new(self, topic: str, payload: dict[str, Any]) -> bool:
        """Track the topic's sequence; return True if the message is to be recorded."""
        last, seq = self._seq.get(topic), payload["seq"]
        self._seq[topic] = max(seq, last or 0)
        if last is None or topic == "state":
            return True
        if payload["retained"] and seq <= last:
            return False
        if gap := max(0, seq - last - 1):
            self.lost[topic] += gap
            self._needs_state |= topic in ("tick", "config")
        return True

    def _store_message(self, topic: str, data: bytes, payload: dict[str, Any], now_ns: int) -> None:
        t_ns = payload["t_ns"] + (self._wall_offset_ns or 0)
        if self.file is None:
            self._start_file(t_ns, now_ns)
        elif topic == "state" and self._is_full(now_ns):
            self.finish()
            self._start_file(t_ns, now_ns)
            for repeated, (kept, kept_ns) in self._repeated.items():
                self._write(repeated, kept, kept_ns)
        elif topic == "state" and not self._needs_state and "config" in self._repeated:
            self._write("config", *self._repeated["config"])
        if topic == "state":
            self._state_ns = now_ns
            self._needs_state, self._state_tick = False, payload.get("tick")
        elif topic == "tick" and self._state_tick is not None:
            # a state before the ticks that reach this recorder is of no use
            self._needs_state |= payload.get("tick") != self._state_tick + 1
            self._state_tick = None
        prefix = topic.split("/")[0]
        if ENCODING[prefix] == "json":
            try:
                data = json.dumps(payload, separators=(",", ":"), allow_nan=False).encode()
            except (TypeError, ValueError):  # a state of a later version of the daemon
                self.malformed += 1
                return
        if prefix in _REPEATED_PREFIXES:
            self._repeated[topic] = data, t_ns
        self.messages[prefix] += 1
        self.contacts += prefix == "contact" and payload.get("event") == "begin"
        self._write(topic, data, t_ns, payload["seq"])
        try:
            shown = self._converter.convert(topic, payload, t_ns)
        except (KeyError, TypeError, ValueError, AttributeError):  # an unexpected type
            self.malformed += 1
            return
        for made in shown:
            self._write(made.topic, made.data, t_ns, form=made.format)

    def _write(
        self, topic: str, data: bytes, t_ns: int, seq: int = 0, form: MessageFormat | None = None
    ) -> None:
        assert self.file is not None
        self.file.write(topic, data, max(0, t_ns), seq, form)

    def _is_full(self, now_ns: int) -> bool:
        assert self.file is not None
        return (
            self.file.size >= self._limits.max_bytes
            or now_ns - self._file_opened_ns >= self._limits.max_duration_ns
        )

    def _start_file(self, t_ns: int, now_ns: int) -> None:
        self.file = self._open_file(t_ns)
        self._file_opened_ns = self._flushed_ns = now_ns


@dataclass
class _Envelope:
    """Keys of every payload, which the recorder needs; the others are recorded unchecked."""

    v: int
    session: int
    seq: int
    t_ns: int
    retained: bool


@dataclass
class _ServiceEnvelope(_Envelope):
    wall_offset_ns: int


def _checked_message(parts: list[bytes]) -> tuple[str, dict[str, Any]]:
    """Return topic and payload of a message; unknown keys are kept. Raises WireError."""
    received = unpack(parts, _TOPIC_OF_PREFIX)
    envelope = _ServiceEnvelope if received.topic.prefix == "service" else _Envelope
    check_fields(received.name, received.payload, envelope)
    return received.name, received.payload
