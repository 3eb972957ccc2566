"""ADCs of the kernel's IIO interface: their folders in sysfs, and one-shot reading.

Public names: `IioDevice`, `find_trigger`, `AdcReading`, `AdcReader`, `OneShotReader`, `IIO_FOLDER`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.scan import ScanElement

IIO_FOLDER = Path("/sys/bus/iio/devices")
_MAX_ATTRIBUTE_BYTES = 4096  # size of a page in memory, which limits a file of sysfs


@dataclass(frozen=True)
class AdcReading:
    """One sample of an ADC.

    `raw` : (channels,) raw values; `sample_ns` : its time on the monotonic clock, for channels that are
    converted one after another the middle; `span_ns` : from the first conversion to the last; `is_timed` :
    False where the driver has no time stamps, and `sample_ns` is the time of reading
    """

    raw: FloatArray
    sample_ns: int
    span_ns: int = 0
    is_timed: bool = True


class AdcReader(Protocol):
    """An ADC: opened, read, and closed again after a failure. All methods but `close` raise AdcError.

    `read` returns None without a recent conversion of an ADC that runs freely.
    """

    @property
    def limits(self) -> FloatArray:
        """Lowest and highest raw values (channels, 2); infinite where they are unknown."""

    @property
    def millivolts(self) -> tuple[FloatArray, FloatArray]:
        """Scale (channels,) [mV] and offset (channels,) [raw]: mV = (raw + offset) scale; 1 and 0 without."""

    def open(self) -> None: ...

    def read(self) -> AdcReading | None: ...

    def drain(self) -> None: ...

    def close(self) -> None: ...

    def fileno(self) -> int | None:
        """Return a file to be drained as soon as it is readable, so that times of reading are right; None
        without, or while it is closed."""

    def describe(self) -> str:
        """Return what the log tells of it besides its timing; empty for nothing."""


class IioDevice:
    """Folder of a device in sysfs, such as /sys/bus/iio/devices/iio:device0."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def find(cls, name: str, iio: Path = IIO_FOLDER) -> IioDevice:
        """Return the device of a path, or the one whose `name` or `label` this is.

        Raises AdcError, naming the devices present.
        """
        if "/" in name:
            return cls(Path(name))
        return cls(_find(name, iio, "iio:device*"))

    def read(self, attribute: str) -> str:
        """Return an attribute. Raises AdcError, also for an empty one."""
        path = self.folder / attribute
        try:
            file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            try:
                text = os.read(file, _MAX_ATTRIBUTE_BYTES).decode("ascii", "replace").strip()
            finally:
                os.close(file)
        except OSError as error:
            raise AdcError.of_os_error(path, error) from error
        if not text:
            raise AdcError(AdcFaultKind.SHORT_READ, f"{path}: is empty")
        return text

    def read_number(self, attribute: str) -> float:
        """Return the value of an attribute. Raises AdcError, also for text that isn't a number."""
        text = self.read(attribute)
        try:
            return float(text)
        except ValueError as error:
            raise AdcError(
                AdcFaultKind.READ_FAILED, f'{self.folder / attribute}: "{text}" is no number'
            ) from error

    def write(self, attribute: str, value: object) -> None:
        """Write an attribute. Raises AdcError."""
        path = self.folder / attribute
        try:
            file = os.open(path, os.O_WRONLY | os.O_TRUNC | os.O_CLOEXEC)
            try:
                os.write(file, str(value).encode())
            finally:
                os.close(file)
        except OSError as error:
            raise AdcError.of_os_error(path, error) from error

    def has(self, attribute: str) -> bool:
        """Return True if there is such an attribute."""
        return (self.folder / attribute).exists()

    def read_channel(self, channel: str, kind: str, missing: float) -> float:
        """Return `scale` or `offset` of a channel, or that of all channels of its type, else `missing`."""
        shared = re.sub(r"\d+", "", channel)  # in_voltage_scale, in_voltage-voltage_scale
        for name in (f"in_{channel}_{kind}", f"in_{shared}_{kind}"):
            if self.has(name):
                return self.read_number(name)
        return missing

    def millivolts(self, channels: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return scales [mV] and offsets [raw] of channels. Raises AdcError."""
        scale = [self.read_channel(channel, "scale", 1.0) for channel in channels]
        return np.array(scale), np.array([self.read_channel(channel, "offset", 0.0) for channel in channels])

    @property
    def elements_folder(self) -> str:
        """Folder of the scan elements' attributes: since kernel 5.11 that of the first buffer."""
        return "buffer0" if self.has("buffer0") else "scan_elements"

    @property
    def buffer_folder(self) -> str:
        """Folder of the buffer's attributes."""
        return "buffer0" if self.has("buffer0") else "buffer"

    def read_element(self, channel: str) -> ScanElement:
        """Return a channel's scan element. Raises AdcError."""
        name = f"{self.elements_folder}/in_{channel}_type"
        try:
            return ScanElement.parse(self.read(name))
        except ValueError as error:
            raise AdcError(AdcFaultKind.READ_FAILED, f"{self.folder / name}: {error}") from error


def find_trigger(name: str, iio: Path = IIO_FOLDER) -> IioDevice:
    """Return the folder of the trigger of a name. Raises AdcError, naming the triggers present."""
    return IioDevice(_find(name, iio, "trigger*"))


class OneShotReader:
    """Reads in_CHANNEL_raw of one channel after another: for any driver, at its conversion time each."""

    def __init__(
        self,
        device: str,
        channels: Sequence[str],
        *,
        rate_hz: float | None = None,
        iio: Path = IIO_FOLDER,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._name, self._channels, self._rate_hz, self._iio = device, tuple(channels), rate_hz, iio
        self._clock = clock
        self._device = IioDevice(iio)

    def open(self) -> None:
        """Find the device; read scales, offsets and limits."""
        device = IioDevice.find(self._name, self._iio)
        if self._rate_hz is not None:
            device.write("sampling_frequency", f"{self._rate_hz:g}")
        self.millivolts = device.millivolts(self._channels)
        known = [device.has(f"{device.elements_folder}/in_{channel}_type") for channel in self._channels]
        self.limits = np.array(
            [
                device.read_element(channel).limits if is_known else (-np.inf, np.inf)
                for channel, is_known in zip(self._channels, known, strict=True)
            ],
            np.float64,
        )
        self._device = device

    def read(self) -> AdcReading:
        """Convert all channels, one after another."""
        begin_ns = self._clock()
        raw = [self._device.read_number(f"in_{channel}_raw") for channel in self._channels]
        end_ns = self._clock()
        return AdcReading(np.array(raw), (begin_ns + end_ns) // 2, end_ns - begin_ns)

    def drain(self) -> None:
        """Do nothing: no sample is queued."""

    def close(self) -> None:
        """Do nothing: no file is open."""

    def fileno(self) -> int | None:
        """Return None: it is read when asked."""
        return None

    def describe(self) -> str:
        """Return nothing."""
        return ""


def _find(name: str, iio: Path, pattern: str) -> Path:
    found: dict[str, set[Path]] = {}
    for folder in iio.glob(pattern):
        for attribute in ("label", "name"):
            with contextlib.suppress(AdcError):  # a device may have no label, or vanish
                found.setdefault(IioDevice(folder).read(attribute), set()).add(folder)
    matches = sorted(found.get(name, ()))
    if len(matches) == 1:
        return matches[0]
    if matches:
        shared = " and ".join(folder.name for folder in matches)
        problem = f'"{name}" is the name of {shared}; give the label of one, or its folder'
    else:
        problem = f'none has the name "{name}"; present: {", ".join(sorted(found)) or "none"}'
    raise AdcError(AdcFaultKind.FILE_MISSING, f"{iio}/{pattern}: {problem}", errno.ENOENT)
