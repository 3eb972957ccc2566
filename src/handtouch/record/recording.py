"""Reader of recordings: messages in the order of writing, up to the end of a truncated file.

Public names: `Recording`, `RecordedMessage`, `is_recording`.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Footer, Message, Metadata
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
_DECODERS = {"json": json.loads, "msgpack": msgpack.unpackb}


class RecordedMessage(NamedTuple):
    """A message of a recording; its payload is that of the wire, with lists for tuples."""

    topic: str
    wall_ns: int
    """ns since 1970 UTC"""
    payload: dict[str, Any]


def is_recording(path: Path) -> bool:
    """Return True for an MCAP file, by its name or its first bytes."""
    if path.suffix == ".mcap" or not path.is_file():
        return path.suffix == ".mcap"
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


@dataclass
class Recording:
    """A recording on disk; iterate over its messages. Raises ValueError for other files, OSError.

    `metadata` and `summary` were written by the recorder at begin and end; `files` are its attachments;
    `truncation`: reason of an early end. All are complete after the last message was read.
    """

    path: Path
    metadata: dict[str, str] = field(default_factory=dict)
    summary: dict[str, str] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    truncation: str = ""
    malformed_messages: int = 0
    """messages that couldn't be decoded"""

    def __post_init__(self) -> None:
        if self.path.is_dir():
            raise ValueError(f"{self.path}: is a folder; give one recording in it")
        with self.path.open("rb") as file:
            start = file.read(len(MAGIC))
        if not MAGIC.startswith(start):
            raise ValueError(f"{self.path}: isn't an MCAP file, as written by `handtouch record`")

    def __iter__(self) -> Iterator[RecordedMessage]:
        return self.read()

    def read(self, *prefixes: str) -> Iterator[RecordedMessage]:
        """Yield messages of handtouch's topics, or of the given prefixes: "contact", "tick"."""
        self.truncation, self.malformed_messages = "", 0
        channels: dict[int, tuple[str, Any]] = {}
        for record in self._records():
            if isinstance(record, Message):
                topic, reader = channels.get(record.channel_id, ("", None))
                if reader is None:
                    continue
                try:
                    payload = reader(record.data)
                except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException):
                    payload = None
                if isinstance(payload, dict):
                    yield RecordedMessage(topic, record.log_time, payload)
                else:
                    self.malformed_messages += 1
            elif isinstance(record, Channel):
                topic = record.topic
                requested = not topic.startswith("/") and (not prefixes or topic.split("/")[0] in prefixes)
                channels[record.id] = topic, _DECODERS.get(record.message_encoding) if requested else None
            elif isinstance(record, Metadata):
                known = {"handtouch.recording": self.metadata, "handtouch.summary": self.summary}
                known.get(record.name, {}).update(record.metadata)
            elif isinstance(record, Attachment):
                self.files[record.name] = record.data

    def _records(self) -> Iterator[Any]:
        """Yield records until the end, or until the first incomplete one."""
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            record = None
            try:
                for record in StreamReader(file, record_size_limit=size, validate_crcs=True).records:
                    yield record
            except (McapError, ZstdError, struct.error, ValueError, TypeError, OverflowError) as error:
                if not isinstance(record, Footer):
                    why = f" ({error})" if str(error) else ""
                    self.truncation = f"it ends early, at byte {file.tell()} of {size}{why}"
