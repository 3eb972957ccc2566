"""Reader of recordings: messages in the order of writing, up to the end of a truncated file.

A recording may come from anybody: nothing is unpacked beyond these limits, and damaged chunks are skipped.

Public names: `Recording`, `RecordedMessage`, `is_recording`.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import msgpack
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Message, Metadata
from mcap.stream_reader import StreamReader

MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
MAX_CHUNK_BYTES = 16 << 20
"""Largest unpacked chunk: the recorder's have half a MiB, and one message more"""
MAX_MESSAGE_BYTES = 8 << 20
"""Largest message: `config` with its EDS and URDF files is the largest of the daemon's"""
_MAX_ITEMS = 1 << 17
"""Items of one list or map: a column of a hand has far fewer"""
_MESSAGE_HEAD_BYTES = 22
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    TypeError,
    OverflowError,
    RuntimeError,
    EOFError,
    MemoryError,
)


def _unpack_msgpack(data: bytes) -> Any:
    return msgpack.unpackb(data, max_array_len=_MAX_ITEMS, max_map_len=_MAX_ITEMS)


_DECODERS = {"json": json.loads, "msgpack": _unpack_msgpack}


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
    `truncation`: reason of an early end, or what was skipped. All are complete after the last message was
    read.
    """

    path: Path
    metadata: dict[str, str] = field(default_factory=dict)
    summary: dict[str, str] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    truncation: str = ""
    damage: list[str] = field(default_factory=list)
    """for each chunk that was skipped, where it is and why"""
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
        self.truncation, self.malformed_messages, self.damage = "", 0, []
        channels: dict[int, tuple[str, Any]] = {}
        for record in self._records():
            if isinstance(record, Message):
                topic, reader = channels.get(record.channel_id, ("", None))
                if reader is None:
                    continue
                try:
                    payload = reader(record.data) if len(record.data) <= MAX_MESSAGE_BYTES else None
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

    @contextmanager
    def checked(self) -> Iterator[None]:
        """Context manager in which a payload of an unexpected form is a ValueError that names the file."""
        try:
            yield
        except (
            LookupError,
            TypeError,
            AttributeError,
            ArithmeticError,
            struct.error,
            RecursionError,
        ) as error:
            why = f"{type(error).__name__}: {error}"
            raise ValueError(
                f"{self.path}: holds a message of an unexpected form ({why:.200}); it is damaged or was not "
                "written by `handtouch record`, so record again, or export what can be read"
            ) from error

    def _records(self) -> Iterator[Any]:
        """Yield records until the end, or until the first incomplete one; without those of damaged chunks."""
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            yield from _summary_channels(file, size)
            file.seek(0)
            record = None
            reader = StreamReader(file, record_size_limit=size, validate_crcs=True, emit_chunks=True)
            try:
                for record in reader.records:
                    if not isinstance(record, Chunk):
                        yield record
                        continue
                    try:
                        data = _unpack_chunk(record)
                    except _DAMAGE as error:
                        self.damage.append(f"a chunk before byte {file.tell()} is damaged ({error})")
                        continue
                    yield from _chunk_records(data)
            except _DAMAGE as error:
                if not isinstance(record, Footer) and not self.damage:
                    why = f" ({error})" if str(error) else ""
                    self.truncation = f"it ends early, at byte {file.tell()} of {size}{why}"
        if self.damage:
            more = f" and {len(self.damage) - 1} more" if len(self.damage) > 1 else ""
            self.truncation = f"{self.damage[0]}{more}; the rest was read"


def _summary_channels(file: Any, size: int) -> Iterator[Channel]:
    """Yield the channels that a complete file's end repeats: the chunk that declares one may be damaged."""
    foot = 9 + 20 + len(MAGIC)  # opcode and length, the footer, the magic
    if size < foot + len(MAGIC):
        return
    file.seek(size - foot)
    opcode, length, start, _, _ = struct.unpack("<BQQQI", file.read(29))
    if (opcode, length) != (Opcode.FOOTER, 20) or not len(MAGIC) <= start < size - foot:
        return
    file.seek(start)
    try:
        for record in StreamReader(file, skip_magic=True, record_size_limit=size).records:
            if isinstance(record, Channel):
                yield record
    except _DAMAGE:
        return


def _unpack_chunk(chunk: Chunk) -> bytes:
    """Return the records of a chunk. Raises ValueError for one that is damaged or unpacks to too much."""
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise ValueError(
            f"it would unpack to {chunk.uncompressed_size} bytes, the limit is {MAX_CHUNK_BYTES}"
        )
    most = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        with decompressor.stream_reader(chunk.data) as reader:
            data: bytes = reader.read(most)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most)
    else:
        data = chunk.data
    if len(data) != chunk.uncompressed_size:
        raise ValueError("it has another size than it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its checksum is wrong")
    return data


def _chunk_records(data: bytes) -> Iterator[Any]:
    """Yield channels and messages of an unpacked chunk. Raises ValueError where it isn't made of records."""
    at = 0
    while at < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        begin, at = at + 9, at + 9 + length
        if not opcode or at > len(data):
            raise ValueError("a chunk isn't made of records")
        stream = ReadDataStream(io.BytesIO(data[begin:at]))
        if opcode == Opcode.MESSAGE and length > _MESSAGE_HEAD_BYTES:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
