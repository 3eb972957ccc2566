"""Decides what goes into a recording: every message in its order, losses counted, a file that stands alone.

Public names: `Recorder`, `Limits`, `Full`. Touches no socket and no clock.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import msgpack

from handtouch import wire
from handtouch.record.foxglove import Foxglove
from handtouch.record.schemas import ENCODING

_FLUSH_NS = 1_000_000_000
_ASK_AGAIN_NS = 2_000_000_000
_PARTS = {topic.prefix: topic.parts for topic in wire.TOPICS}
_LASTING = ("config", "service", "health")
"""Whose latest message begins every file, so that it explains itself."""
_MOST_WAITING = 100_000


class File(Protocol):
    """Where messages go: `RecordingFile`."""

    @property
    def size(self) -> int: ...

    def write(self, topic: str, data: bytes, t_ns: int, seq: int = 0, foxglove: str = "") -> None: ...

    def flush(self) -> None: ...

    def finish(self, summary: dict[str, str]) -> None: ...


@dataclass(frozen=True)
class Limits:
    """When to go on in another file."""

    bytes: int = 1 << 62
    ns: int = 1 << 62


class Recorder:
    """Takes messages as they come off the wire; times are ns since 1970 UTC, but for `now_ns`, a clock's.

    `open_file` opens the next file, once the first message can be dated. `asks` says that the state of the
    daemon is wanted: unsubscribe from it and subscribe. `lost` counts messages by topic that gaps tell of,
    `malformed` what doesn't keep the contract. What files raise, is raised.
    """

    def __init__(self, open_file: Callable[[int], File], limits: Limits) -> None:
        self.lost: Counter[str] = Counter()
        self.malformed = 0
        self.messages: Counter[str] = Counter()
        self.contacts = 0
        self.bytes = 0
        """in the files that are done"""
        self.asks = False
        self.file: File | None = None
        self._open_file, self._limits = open_file, limits
        self._foxglove = Foxglove()
        self._run: int | None = None
        self._offset_ns: int | None = None
        self._waiting: list[tuple[str, bytes, dict[str, Any]]] = []
        self._lasting: dict[str, tuple[bytes, int]] = {}
        self._seq: dict[str, int] = {}
        self._asked_ns = self._flushed_ns = self._since_ns = 0
        self._needs_state = True
        self._file_lost = 0

    @property
    def size(self) -> int:
        """Bytes written, in all files."""
        return self.bytes + (self.file.size if self.file else 0)

    def take(self, parts: list[bytes], now_ns: int) -> None:
        """A message of the wire."""
        read = _read(parts)
        if read is None:
            self.malformed += 1
            return
        topic, payload = read
        if payload["run"] != self._run:
            self._begin_run(payload["run"])
        if not self._is_new(topic, payload):
            return
        if topic == "service" and self._offset_ns is None:
            self._offset_ns = payload["wall_offset_ns"]
        if self._offset_ns is None:
            self._waiting = [*self._waiting[-_MOST_WAITING:], (topic, parts[1], payload)]
            return
        waiting, self._waiting = self._waiting, []
        for held in waiting:
            self._keep(*held, now_ns)
        self._keep(topic, parts[1], payload, now_ns)

    def poll(self, now_ns: int) -> None:
        """Flush, and ask for the state where it is due; call it some times a second."""
        if self.file is None:
            return
        if now_ns - self._flushed_ns >= _FLUSH_NS:
            self._flushed_ns = now_ns
            self.file.flush()
        full = self.file.size >= self._limits.bytes or now_ns - self._since_ns >= self._limits.ns
        if (full or self._needs_state) and now_ns - self._asked_ns >= _ASK_AGAIN_NS:
            self._asked_ns = now_ns
            self.asks = True

    def finish(self) -> None:
        """End the file, if there is one."""
        if self.file is not None:
            self.file.finish(self.summary())
            self.bytes += self.file.size
            self.file = None

    def summary(self) -> dict[str, str]:
        """What was counted since the beginning, in all files; `lost` is a map of topic to messages."""
        return {
            "messages": str(sum(self.messages.values())),
            "contacts": str(self.contacts),
            "ticks": str(self.messages["tick"]),
            "lost": json.dumps(dict(self.lost)),
            "malformed": str(self.malformed),
        }

    def _begin_run(self, run: int) -> None:
        self._run, self._offset_ns = run, None
        self._seq.clear()
        self._lasting.clear()
        self._waiting.clear()
        self._foxglove = Foxglove()
        self._needs_state = True

    def _is_new(self, topic: str, payload: dict[str, Any]) -> bool:
        """Follow the topic; whether the message is to be kept."""
        last, seq = self._seq.get(topic), payload["seq"]
        self._seq[topic] = max(seq, last or 0)
        if last is None or topic == "state":
            return True
        if payload["repeat"] and seq <= last:
            return False
        if gap := max(0, seq - last - 1):
            self.lost[topic] += gap
            self._needs_state |= topic in ("tick", "config")
        return True

    def _keep(self, topic: str, data: bytes, payload: dict[str, Any], now_ns: int) -> None:
        t_ns = payload["t_ns"] + (self._offset_ns or 0)
        if self.file is None:
            self._open(t_ns, now_ns)
        elif topic == "state" and self._is_full(now_ns):
            self.finish()
            self._open(t_ns, now_ns)
            for of, (kept, kept_ns) in self._lasting.items():
                self._write(of, kept, kept_ns)
        if topic == "state":
            self._needs_state = False
        prefix = topic.split("/")[0]
        if ENCODING[prefix] == "json":
            try:
                data = json.dumps(payload, separators=(",", ":"), allow_nan=False).encode()
            except (TypeError, ValueError):  # a later version of the daemon may send anything
                self.malformed += 1
                return
        if prefix in _LASTING:
            self._lasting[topic] = data, t_ns
        self.messages[prefix] += 1
        self.contacts += prefix == "contact" and payload.get("event") == "begin"
        self._write(topic, data, t_ns, payload["seq"])
        try:
            shown = self._foxglove.take(topic, payload, t_ns)
        except (KeyError, TypeError, ValueError, AttributeError):  # a key of it is not what it should be
            self.malformed += 1
            return
        for made in shown:
            self._write(made.topic, made.data, t_ns, foxglove=made.schema)

    def _write(self, topic: str, data: bytes, t_ns: int, seq: int = 0, foxglove: str = "") -> None:
        assert self.file is not None
        self.file.write(topic, data, max(0, t_ns), seq, foxglove)

    def _is_full(self, now_ns: int) -> bool:
        assert self.file is not None
        return self.file.size >= self._limits.bytes or now_ns - self._since_ns >= self._limits.ns

    def _open(self, t_ns: int, now_ns: int) -> None:
        self.file = self._open_file(t_ns)
        self._since_ns = self._flushed_ns = now_ns


_ENVELOPE = {"v": int, "run": int, "seq": int, "t_ns": int, "repeat": bool}


def _read(parts: list[bytes]) -> tuple[str, dict[str, Any]] | None:
    """Topic and payload; None for what doesn't keep the contract. Keys that aren't known are kept."""
    if len(parts) != 2:
        return None
    topic = parts[0].decode("utf-8", "replace")
    prefix, *rest = topic.split("/")
    if _PARTS.get(prefix) != len(rest):
        return None
    try:
        payload = msgpack.unpackb(parts[1])
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException):
        return None
    if not isinstance(payload, dict) or payload.get("v") != wire.SCHEMA_VERSION:
        return None
    if not all(type(payload.get(key)) is kind for key, kind in _ENVELOPE.items()):
        return None
    if prefix == "service" and type(payload.get("wall_offset_ns")) is not int:
        return None
    return topic, payload
