"""Writer of one MCAP file: complete records only, so that a truncated file is readable up to its end.

Public name: `RecordingFile`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO, Any, cast

from mcap.writer import CompressionType, Writer

from handtouch import __version__
from handtouch.record.schemas import MessageFormat, wire_format

_CHUNK_BYTES = 512 * 1024


class RecordingFile:
    """A new recording; raises FileExistsError or another OSError naming it.

    Times are ns since 1970 UTC. Every method may raise OSError, as when the disk is full: then `abandon` it.
    """

    def __init__(self, path: Path, about: dict[str, str]) -> None:
        self.path = path
        self.messages = 0
        self._stream = _AtomicFile(path)
        self._writer = Writer(cast(IO[Any], self._stream), _CHUNK_BYTES, CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._writer.start(profile="", library=f"handtouch {__version__}")
        self._writer.add_metadata("handtouch.recording", about)

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self._stream.tell()

    def write(
        self, topic: str, data: bytes, t_ns: int, seq: int = 0, form: MessageFormat | None = None
    ) -> None:
        """Add a message; without `form` a wire message, encoded as in ENCODING."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._register(topic, form or wire_format(topic.split("/")[0]))
        self.messages += 1
        self._writer.add_message(channel, t_ns, data, t_ns, seq & 0xFFFFFFFF)

    def attach(self, name: str, media_type: str, data: bytes, t_ns: int) -> None:
        """Attach a file."""
        self._writer.add_attachment(t_ns, t_ns, name, media_type, data)

    def flush(self) -> None:
        """Write all messages to the operating system: they survive the end of this process."""
        self._writer.flush()

    def finish(self, summary: dict[str, str]) -> None:
        """Write the summary and the indexes, and close."""
        self._writer.flush()
        self._writer.add_metadata("handtouch.summary", summary)
        self._writer.finish()
        self._stream.close(sync=True)

    def abandon(self) -> None:
        """Truncate after the last complete record and close; raises nothing."""
        self._stream.truncate()

    def _register(self, topic: str, form: MessageFormat) -> int:
        name = form.schema_name
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, form.schema_encoding, form.schema)
        self._channels[topic] = self._writer.register_channel(topic, form.encoding, self._schemas[name])
        return self._channels[topic]


class _AtomicFile:
    """An unbuffered new file; each `write` is of complete records, and all or nothing."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._complete_bytes = 0

    def write(self, data: bytes) -> int:
        pending = memoryview(data)
        while pending:
            pending = pending[os.write(self._file, pending) :]
        self._complete_bytes += len(data)
        return len(data)

    def tell(self) -> int:
        return self._complete_bytes

    def flush(self) -> None:
        """Do nothing: the file is unbuffered."""

    def close(self, sync: bool = False) -> None:
        if self._file >= 0:
            try:
                if sync:
                    os.fsync(self._file)
            finally:
                os.close(self._file)
                self._file = -1

    def truncate(self) -> None:
        try:
            if self._file >= 0:
                os.ftruncate(self._file, self._complete_bytes)
            self.close()
        except OSError:  # complete records are readable; readers skip a torn one at the end
            return
