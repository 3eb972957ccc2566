"""Lines of numbers, as microcontroller boards print them: from a serial port, TCP, UDP or standard input.

Public names: `LinesSource`, `LinesReader`, `parse_line`.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import math
import os
import re
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar, Literal, Protocol
from urllib.parse import urlsplit

import numpy as np
from pydantic import Field, field_validator

from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.iio import AdcReading
from handtouch.node.source import Source, SourceReader

MAX_LINE_BYTES = 4096
_MAX_READ_BYTES = 65_536  # at a time: more than comes between two readings
_SEPARATORS = re.compile(r"[\s,;]+")
_LABELLED = re.compile(r"([A-Za-z_]\w*)[:=](.+)")
_CHANNEL = re.compile(r"[1-9]\d{0,2}|[A-Za-z_]\w*")
_log = logging.getLogger("handtouch.node")


class LinesSource(Source):
    """`[source.NAME]` with `kind = "lines"`: a line of numbers for each sample."""

    kind: Literal["lines"] = Field(description="lines of numbers, as boards print them")
    url: str = Field(
        min_length=1,
        description="serial port, socket://HOST:PORT (TCP, of the board), udp://HOST:PORT (an address of "
        "this computer), or - for standard input",
        examples=["/dev/ttyACM0"],
    )
    baud: int = Field(115_200, ge=50, le=10_000_000, description="bit rate of a serial port")

    @field_validator("url")
    @classmethod
    def _check_url(cls, url: str) -> str:
        parts = urlsplit(url)
        if parts.scheme == "udp":
            host = _host_and_port(url)[0]
            if host in ("", "0.0.0.0", "::"):
                raise ValueError("any computer could send: give this one's address in the board's network")
        elif parts.scheme == "socket":
            _host_and_port(url)
        elif parts.scheme:
            raise ValueError("must be a serial port, socket://HOST:PORT, udp://HOST:PORT or -")
        return url

    def problem_of(self, channel: str, folder: Path) -> str:  # noqa: ARG002
        """Return why a pad can't have this channel; empty if it can."""
        if _CHANNEL.fullmatch(channel):
            return ""
        return 'must be the number of a value in the line, from "1", or its label where lines have "x0:12"'

    def make_reader(self, channels: Sequence[str], folder: Path, clock: Callable[[], int]) -> LinesReader:  # noqa: ARG002
        """Return a reader of these channels."""
        return LinesReader(self, channels, clock)


def _host_and_port(url: str) -> tuple[str, int]:
    """Return both of a URL. Raises ValueError without them."""
    parts = urlsplit(url)
    if parts.port is None or parts.hostname is None:
        raise ValueError(f"must be {parts.scheme}://HOST:PORT")
    return parts.hostname, parts.port


def parse_line(line: bytes, channels: Sequence[str]) -> list[float] | None:
    """Return the values of channels in a line, None if it lacks one or has anything but finite numbers.

    Values are separated by commas, semicolons, spaces or tabs; each may have a label: `x0:12 xa:3`.
    """
    try:
        tokens = _SEPARATORS.split(line.decode("ascii").strip())
        values: dict[str, float] = {}
        for number, token in enumerate(tokens, 1):
            labelled = _LABELLED.fullmatch(token)
            value = float(labelled[2] if labelled else token)
            values[str(number)] = value
            if labelled:
                values[labelled[1]] = value
        found = [values[channel] for channel in channels]
    except (ValueError, KeyError):
        return None
    return found if all(map(math.isfinite, values.values())) else None


class _Stream(Protocol):
    """What lines are read from; both methods may raise OSError."""

    def read(self) -> bytes:
        """Return what has arrived, without waiting."""

    def close(self) -> None: ...


class LinesReader(SourceReader):
    """Reads the newest line; each line is one sample.

    A line's time is that of reading it, which is after the reading before.
    """

    unit: ClassVar[str] = "lines"

    def __init__(self, source: LinesSource, channels: Sequence[str], clock: Callable[[], int]) -> None:
        super().__init__(source, channels, clock)
        self._url, self._baud = source.url, source.baud
        self._stream: _Stream | None = None
        self._rest = b""
        self._skips_line = False
        self._drained_ns = 0

    def open(self) -> None:
        """Open the source. Raises AdcError."""
        self._stream = _open_stream(self._url, self._baud)
        self._rest = b""
        self._skips_line = self._url != "-"  # the first may be the rest of one
        self._begin()
        self._drained_ns = self._clock()

    def drain(self) -> None:
        """Read what has arrived, keeping the newest line. Raises AdcError."""
        if self._stream is None:
            return
        try:
            data = self._stream.read()
        except OSError as error:
            raise _failure(self._url, error) from error
        before_ns, self._drained_ns = self._drained_ns, self._clock()
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_BYTES:
            self._rest, self._skips_line = b"", True
            self._count_malformed(f"a longer line than {MAX_LINE_BYTES} bytes".encode())
        for line in lines:
            if self._skips_line:
                self._skips_line = False
            elif line.strip():
                self._take(line, self._drained_ns - before_ns)

    def close(self) -> None:
        """Close the source."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def describe(self) -> str:
        """Return the lines so far, for the log."""
        return f"{self.samples} lines, {self.malformed} malformed"

    def _missing(self) -> str:
        return f"{self._url}: no line with {', '.join(self._channels)}"

    def _take(self, line: bytes, span_ns: int) -> None:
        values = parse_line(line, self._channels)
        if values is None:
            self._count_malformed(line)
        else:
            self._keep(AdcReading(np.array(values), self._drained_ns, span_ns, is_timed=False))

    def _count_malformed(self, line: bytes) -> None:
        self.malformed += 1
        if math.log10(self.malformed).is_integer():
            _log.warning(
                "%s: %d lines without numbers for channels %s, the last: %r",
                self._url, self.malformed, ", ".join(self._channels), line[:80],
            )  # fmt: skip


class _StandardInput:
    """Standard input, which isn't closed."""

    def __init__(self) -> None:
        self._file = 0
        os.set_blocking(self._file, False)

    def read(self) -> bytes:
        try:
            data = os.read(self._file, _MAX_READ_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.EPIPE, "it has ended")
        return data

    def close(self) -> None:
        os.set_blocking(self._file, True)


class _Datagrams:
    """UDP: a datagram has one line or more."""

    def __init__(self, host: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            if ipaddress.ip_address(host).is_multicast:
                raise OSError(errno.EADDRNOTAVAIL, "multicast isn't supported")
            self._socket.bind((host, port))
        except (OSError, ValueError) as error:
            self._socket.close()
            raise error if isinstance(error, OSError) else OSError(errno.EINVAL, str(error)) from error

    def read(self) -> bytes:
        datagrams: list[bytes] = []
        while sum(map(len, datagrams)) < _MAX_READ_BYTES:
            try:
                datagrams.append(self._socket.recv(_MAX_READ_BYTES))
            except BlockingIOError:
                break
        return b"".join(data.rstrip(b"\n") + b"\n" for data in datagrams)

    def close(self) -> None:
        self._socket.close()


class _SerialPort:
    """A serial port or a TCP connection, by pyserial."""

    def __init__(self, url: str, baud: int) -> None:
        try:
            import serial
        except ImportError as error:
            text = "needs pyserial: pip install pyserial, or handtouch with the extra `serial`"
            raise OSError(errno.ENOPKG, text) from error
        self._port = serial.serial_for_url(url, baudrate=baud, timeout=0)

    def read(self) -> bytes:
        return bytes(self._port.read(_MAX_READ_BYTES))

    def close(self) -> None:
        self._port.close()


def _open_stream(url: str, baud: int) -> _Stream:
    try:
        if url == "-":
            return _StandardInput()
        if url.startswith("udp:"):
            return _Datagrams(*_host_and_port(url))
        return _SerialPort(url, baud)
    except OSError as error:
        raise _failure(url, error) from error


def _failure(url: str, error: OSError) -> AdcError:
    """Return a failure with its cause: pyserial's errors hold that of the system."""
    return AdcError(AdcFaultKind.of_os_error(error), f"{url}: {error.strerror or error}", error.errno or 0)
