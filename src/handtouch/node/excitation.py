"""Switch of a sheet's excitation: a GPIO line by the kernel's character device (uAPI v2), or a file.

Public names: `ExcitationSwitch`, `GpioLine`, `FileSwitch`, `make_switch`.

The uAPI is two ioctls, stable since Linux 5.10, so no library is needed; libgpiod's tools (`gpioinfo`) show
the same lines, with the consumer "handtouch".
"""

from __future__ import annotations

import fcntl
import os
import struct
from pathlib import Path
from typing import Protocol

from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.settings import Excitation

LINE_REQUEST = struct.Struct("=64I32sQI20x240sII20xi")
"""struct gpio_v2_line_request: offsets, consumer, flags, attributes and their count, lines, events, fd"""
LINE_VALUES = struct.Struct("=QQ")
"""struct gpio_v2_line_values: bits, mask"""
ACTIVE_LOW, OUTPUT = 1 << 1, 1 << 3
_OUTPUT_VALUES = struct.Struct("=IIQQ")  # attribute: identifier, padding, values, mask
_OUTPUT_VALUES_ID = 2


def ioctl_number(number: int, size_bytes: int) -> int:
    """Return _IOWR(0xB4, number, size)."""
    return 3 << 30 | size_bytes << 16 | 0xB4 << 8 | number


GET_LINE = ioctl_number(0x07, LINE_REQUEST.size)
SET_VALUES = ioctl_number(0x0F, LINE_VALUES.size)


class ExcitationSwitch(Protocol):
    """Switch of the excitation; both methods are callable at any time."""

    def set(self, on: bool) -> None:
        """Switch it. Raises AdcError."""

    def close(self) -> None:
        """Release it."""


class GpioLine:
    """An output line of a GPIO chip, requested at its first use and after a failure."""

    def __init__(self, chip: str, line: int, *, active_low: bool = False) -> None:
        self._chip, self._line = Path(chip), line
        self._flags = OUTPUT | (ACTIVE_LOW if active_low else 0)
        self._file = -1

    def set(self, on: bool) -> None:
        """Set the line active or inactive. Raises AdcError."""
        try:
            if self._file < 0:
                self._file = self._request(on)
            else:
                fcntl.ioctl(self._file, SET_VALUES, LINE_VALUES.pack(on, 1))
        except OSError as error:
            self.close()
            raise AdcError(
                AdcFaultKind.EXCITATION_FAILED,
                f"{self._chip} line {self._line}: {error.strerror}",
                error.errno or 0,
            ) from error

    def close(self) -> None:
        """Release the line; most chips keep its value."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _request(self, on: bool) -> int:
        """Request the line as an output with a value; return its file."""
        attribute = _OUTPUT_VALUES.pack(_OUTPUT_VALUES_ID, 0, on, 1)
        offsets = [self._line] + [0] * 63
        request = bytearray(LINE_REQUEST.pack(*offsets, b"handtouch", self._flags, 1, attribute, 1, 0, 0))
        chip = os.open(self._chip, os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.ioctl(chip, GET_LINE, request)
        finally:
            os.close(chip)
        return int(LINE_REQUEST.unpack(request)[-1])


class FileSwitch:
    """A file that takes 1 and 0, such as /sys/class/leds/excitation/brightness."""

    def __init__(self, path: str) -> None:
        self._path = Path(path)

    def set(self, on: bool) -> None:
        """Write 1 or 0. Raises AdcError."""
        try:
            self._path.write_text(f"{int(on)}\n")
        except OSError as error:
            raise AdcError(
                AdcFaultKind.EXCITATION_FAILED, f"{self._path}: {error.strerror}", error.errno or 0
            ) from error

    def close(self) -> None:
        """Do nothing: no file is open."""


def make_switch(excitation: Excitation | None) -> ExcitationSwitch | None:
    """Return the switch of a pad's excitation, None if it has none; it opens no file."""
    if excitation is None:
        return None
    if excitation.chip is not None and excitation.line is not None:
        return GpioLine(excitation.chip, excitation.line, active_low=excitation.active_low)
    return FileSwitch(str(excitation.file))
