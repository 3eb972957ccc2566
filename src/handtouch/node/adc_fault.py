"""Failures of an ADC or an excitation switch, and their EMCY messages.

Public names: `AdcFaultKind`, `AdcError`, `emergency_of`.
"""

from __future__ import annotations

import errno
from enum import IntEnum


class AdcFaultKind(IntEnum):
    """Kind of a failure: the first manufacturer-specific byte of its EMCY message."""

    FILE_MISSING = 1
    SHORT_READ = 2
    BUSY = 3
    OVERRUN = 4
    NO_CONVERSION = 5
    READ_FAILED = 6
    EXCITATION_FAILED = 7
    SATURATED = 16

    @property
    def text(self) -> str:
        """Name in log lines."""
        return self.name.lower().replace("_", " ")

    @classmethod
    def of_os_error(cls, error: OSError) -> AdcFaultKind:
        """Return the kind of a failed system call."""
        if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            return cls.FILE_MISSING
        return cls.BUSY if error.errno == errno.EBUSY else cls.READ_FAILED


_HARDWARE_ERROR, _HARDWARE_BITS = 0x5000, 0x81  # device hardware; generic and manufacturer's bits of 0x1001
_INPUT_CURRENT_ERROR, _CURRENT_BITS = 0x2100, 0x03


class AdcError(Exception):
    """An ADC that can't be read now: the kind of failure, and text with file and cause.

    `number` : errno, 0 without
    """

    exit_status = 1

    def __init__(self, kind: AdcFaultKind, text: str, number: int = 0) -> None:
        super().__init__(f"{kind.text}: {text}")
        self.kind, self.number = kind, number

    @classmethod
    def of_os_error(cls, path: object, error: OSError) -> AdcError:
        """Return the failure of a system call on a file."""
        return cls(AdcFaultKind.of_os_error(error), f"{path}: {error.strerror}", error.errno or 0)


def emergency_of(kind: AdcFaultKind) -> tuple[int, int]:
    """Return error code and bits of the error register."""
    if kind is AdcFaultKind.SATURATED:
        return _INPUT_CURRENT_ERROR, _CURRENT_BITS
    return _HARDWARE_ERROR, _HARDWARE_BITS
