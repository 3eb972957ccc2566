"""A recording read back, in the order in which it was written, up to where it was cut off if it was.

Public names: `Recording`, `Entry`.
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
_READERS = {"json": json.loads, "msgpack": msgpack.unpackb}


class Entry(NamedTuple):
    """A message of a recording: its payload as the wire has it, with lists for tuples."""

    topic: str
    t_ns: int
    """ns since 1970 UTC"""
    payload: dict[str, Any]


@dataclass
class Recording:
    """A recording on disk; iterate for its messages. Raises ValueError for what is none, OSError.

    `about` and `summary` are what the recorder wrote at the beginning and at the end, `files` what it
    attached, `cut` why it ends early: complete once all messages are read.
    """

    path: Path
    about: dict[str, str] = field(default_factory=dict)
    summary: dict[str, str] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    cut: str = ""
    damaged: int = 0
    """messages that can't be read"""

    def __post_init__(self) -> None:
        if self.path.is_dir():
            raise ValueError(f"{self.path}: is a folder; give one recording in it")
        with self.path.open("rb") as file:
            start = file.read(len(MAGIC))
        if not MAGIC.startswith(start):
            raise ValueError(f"{self.path}: is no MCAP file, which `handtouch record` makes")

    def __iter__(self) -> Iterator[Entry]:
        return self.read()

    def read(self, *prefixes: str) -> Iterator[Entry]:
        """Messages of our topics, of these only where they are given: "contact", "tick"."""
        self.cut, self.damaged = "", 0
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
                    yield Entry(topic, record.log_time, payload)
                else:
                    self.damaged += 1
            elif isinstance(record, Channel):
                topic = record.topic
                wanted = not topic.startswith("/") and (not prefixes or topic.split("/")[0] in prefixes)
                channels[record.id] = topic, _READERS.get(record.message_encoding) if wanted else None
            elif isinstance(record, Metadata):
                known = {"handtouch.recording": self.about, "handtouch.summary": self.summary}
                known.get(record.name, {}).update(record.metadata)
            elif isinstance(record, Attachment):
                self.files[record.name] = record.data

    def _records(self) -> Iterator[Any]:
        """Until the end, or the first that isn't whole."""
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            record = None
            try:
                for record in StreamReader(file, record_size_limit=size, validate_crcs=True).records:
                    yield record
            except (McapError, ZstdError, struct.error, ValueError, TypeError, OverflowError) as error:
                if not isinstance(record, Footer):
                    why = f" ({error})" if str(error) else ""
                    self.cut = f"it ends early, at byte {file.tell()} of {size}{why}"
