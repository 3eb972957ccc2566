"""Lines of numbers, as microcontroller boards print them: from a serial port, TCP, UDP or standard input.

Public names: `LinesSource`, `LinesReader`, `parse_line`.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import logging
import math
import os
import re
import socket
import termios
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal, Protocol
from urllib.parse import urlsplit

import numpy as np
from pydantic import Field, field_validator

from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.iio import AdcReading
from handtouch.node.source import Source, SourceReader

MAX_LINE_BYTES = 4096
_MAX_READ_BYTES = 65_536  # at a time
_MAX_QUEUED_BYTES = 4 << 20  # that are read before others are served: what a sender's queue may hold
_SEPARATORS = re.compile(r"\s*[,;]\s*|\s+")
_LABEL = re.compile(r"[\"']?([A-Za-z_]\w*)[\"']?\s*[:=]\s*")
_BRACKETS = " \t\r[](){}"  # around a list, tuple or object that Python or JSON prints
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_COMMENTS = (b"#", b"//")
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
    start_s: float = Field(
        5.0,
        ge=0,
        le=60,
        description="time after opening that the first line may take: many boards restart when their port is "
        "opened, and a boot loader waits",
    )

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

    def make_reader(self, channels: Sequence[str], folder: Path, clock: Callable[[], int]) -> LinesReader:
        """Return a reader of these channels."""
        return LinesReader(self, channels, folder, clock)


def _host_and_port(url: str) -> tuple[str, int]:
    """Return both of a URL. Raises ValueError without them."""
    parts = urlsplit(url)
    if parts.port is None or parts.hostname is None:
        raise ValueError(f"must be {parts.scheme}://HOST:PORT")
    return parts.hostname, parts.port


def parse_line(line: bytes) -> Mapping[str, float] | None:
    """Return the numbers of a line by their places, from "1", and by their labels; None for anything else.

    They are separated by commas, semicolons, spaces or tabs, and finite; each may have a label: `x0:12 xa:3`.
    """
    try:
        text = _LABEL.sub(r"\1:", line.decode("ascii").strip(_BRACKETS))
    except UnicodeDecodeError:
        return None
    values: dict[str, float] = {}
    for place, token in enumerate(_SEPARATORS.split(text.rstrip().removesuffix(",").removesuffix(";")), 1):
        label, _, number = token.rpartition(":")
        if not _NUMBER.fullmatch(number) or label in values or not (label + "_").isidentifier():
            return None
        values[str(place)] = float(number)
        if label:
            values[label] = values[str(place)]
    return values if all(map(math.isfinite, values.values())) else None


class _Stream(Protocol):
    """What lines are read from; `read` and `close` may raise OSError.

    `cuts_lines`: it may be opened within a line
    """

    cuts_lines: ClassVar[bool]

    def read(self) -> bytes:
        """Return some of what has arrived, nothing without; never wait."""

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class LinesReader(SourceReader):
    """Reads the newest line; each line is one sample, and its time is that of reading it.

    Of a line that lacks a number, or was joined with the next, the others would be misplaced: a line with
    another count of numbers than most is dropped.
    """

    unit: ClassVar[str] = "lines"

    def __init__(
        self, source: LinesSource, channels: Sequence[str], folder: Path, clock: Callable[[], int]
    ) -> None:
        super().__init__(source, channels, folder, clock, round(source.start_s * 1e9))
        self._url, self._baud = source.url, source.baud
        self._stream: _Stream | None = None
        self._rest = b""
        self._skips_line = False
        self._usual_count = self._last_count = 0
        self._drained_ns = 0

    def open(self) -> None:
        """Open the source. Raises AdcError."""
        self._stream = _open_stream(self._url, self._baud)
        self._rest, self._skips_line = b"", self._stream.cuts_lines
        self._usual_count = self._last_count = 0
        self._begin()
        self._drained_ns = self._clock()

    def fileno(self) -> int | None:
        """Return the file of the source while it is open."""
        return None if self._stream is None else self._stream.fileno()

    def receive(self) -> None:
        """Read what has arrived, keeping the newest line. Raises AdcError."""
        if self._stream is None:
            return
        try:
            data = _read_queued(self._stream)
        except OSError as error:
            raise _failure(self._url, error) from error
        before_ns, self._drained_ns = self._drained_ns, self._clock()
        pause_ns = self._drained_ns - before_ns
        if pause_ns > self._max_silence_ns:
            self._excuse(pause_ns)
            self._skip_late(data)
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_BYTES:
            self._rest, self._skips_line = b"", True
            self._count_malformed(f"a longer line than {MAX_LINE_BYTES} bytes".encode())
        for line in lines:
            if self._skips_line:
                self._skips_line = False
            elif line.strip() and not line.lstrip().startswith(_COMMENTS):
                self._take(line)

    def close(self) -> None:
        """Close the source."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _missing(self) -> str:
        return f"{self._url}: no line with {', '.join(self._channels)}"

    def _skip_late(self, data: bytes) -> None:
        """Skip what arrived in a pause of this process: nobody knows when."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        self.skipped += len(lines)
        self._rest, self._skips_line = b"", bool(self._rest) or self._skips_line

    def _take(self, line: bytes) -> None:
        values = parse_line(line)
        has_all = values is not None and all(channel in values for channel in self._channels)
        if values is None or not has_all or not self._is_usual(sum(map(str.isdigit, values))):
            self._count_malformed(line)
            return
        numbers = np.array([values[channel] for channel in self._channels])
        self._keep(AdcReading(numbers, self._drained_ns, is_timed=False))

    def _is_usual(self, count: int) -> bool:
        """Return True for the usual count of numbers: that of the first line, or of two in a row since."""
        if not self._usual_count or count == self._last_count:
            self._usual_count = count
        self._last_count = count
        return count == self._usual_count

    def _count_malformed(self, line: bytes) -> None:
        self.malformed += 1
        if math.log10(self.malformed).is_integer():
            _log.warning(
                "%s: %d lines dropped; each must have a number for channels %s, and as many as others: %r",
                self._url,
                self.malformed,
                ", ".join(self._channels),
                line[:80],
            )


def _read_queued(stream: _Stream) -> bytes:
    """Return what has arrived: all of it, so that the last line is the newest. Raises OSError."""
    data = bytearray()
    while len(data) < _MAX_QUEUED_BYTES and (part := stream.read()):
        data += part
    return bytes(data)


class _StandardInput:
    """Standard input, which isn't closed."""

    cuts_lines: ClassVar[bool] = False

    def __init__(self) -> None:
        os.set_blocking(self.fileno(), False)

    def read(self) -> bytes:
        try:
            data = os.read(self.fileno(), _MAX_READ_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.EPIPE, "it has ended")
        return data

    def fileno(self) -> int:
        return 0

    def close(self) -> None:
        os.set_blocking(self.fileno(), True)


class _Datagrams:
    """UDP: a datagram has one line or more."""

    cuts_lines: ClassVar[bool] = False

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
        try:
            return self._socket.recv(_MAX_READ_BYTES).rstrip(b"\n") + b"\n"
        except BlockingIOError:
            return b""

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class _SerialPort:
    """A serial port or a TCP connection, by pyserial."""

    cuts_lines: ClassVar[bool] = True

    def __init__(self, url: str, baud: int) -> None:
        try:
            import serial
        except ImportError as error:
            text = "needs pyserial: pip install pyserial, or handtouch with the extra `serial`"
            raise OSError(errno.ENOPKG, text) from error
        self._port = serial.serial_for_url(url, baudrate=baud, timeout=0)
        if not url.startswith("socket:"):
            self._set_up_terminal()

    def read(self) -> bytes:
        return bytes(self._port.read(_MAX_READ_BYTES))

    def fileno(self) -> int:
        return int(self._port.fileno())

    def close(self) -> None:
        self._port.close()

    def _set_up_terminal(self) -> None:
        """Keep a board that restarts when its port is opened from doing so again, and bytes from waiting in
        the adapter, 16 ms in many; another program that reads the port is an error."""
        self._port.exclusive = True
        with contextlib.suppress(ValueError, NotImplementedError):  # a port without that setting
            self._port.set_low_latency_mode(True)
        with contextlib.suppress(termios.error):
            attributes = termios.tcgetattr(self.fileno())
            attributes[2] &= ~termios.HUPCL
            termios.tcsetattr(self.fileno(), termios.TCSANOW, attributes)


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
    """Return a failure with its cause, and a remedy: pyserial's errors hold that of the system."""
    remedies = {
        errno.EACCES: "; add yourself to the port's group (usermod -aG dialout NAME), and log in again",
        errno.EBUSY: "; close the program that has it, such as a serial monitor",
        errno.EAGAIN: "; close the program that has it, such as a serial monitor",
    }
    text = f"{url}: {error.strerror or error}{remedies.get(error.errno or 0, '')}"
    return AdcError(AdcFaultKind.of_os_error(error), text, error.errno or 0)
