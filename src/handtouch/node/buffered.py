"""Buffered reading of an ADC: scans of all channels from /dev/iio:deviceN, with the kernel's time stamps.

Public name: `BufferedReader`.
"""

from __future__ import annotations

import os
import select
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.iio import IIO_FOLDER, AdcReading, IioDevice, find_trigger
from handtouch.node.scan import ScanLayout
from handtouch.node.settings import Adc

DEVICES_FOLDER = Path("/dev")
_MAX_AGE_NS, _MAX_AGE_PERIODS = 5_000_000, 3  # age of a scan used for a sample, the longer of both
_MAX_SILENCE_NS = 50_000_000  # without a scan, before that is a failure
_CLOCK = "current_timestamp_clock"


class BufferedReader:
    """Reads scans, in one of two ways.

    With a trigger that has the file `trigger_now` (iio-trig-sysfs) each `read` starts a conversion and waits
    for it, up to `timeout_ms`. With any other trigger the ADC runs freely; `read` returns the mean of the
    newest `average_scans` scans, at the mean of their times.
    """

    def __init__(
        self,
        adc: Adc,
        channels: Sequence[str],
        *,
        iio: Path = IIO_FOLDER,
        devices: Path = DEVICES_FOLDER,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._adc, self._channels = adc, tuple(channels)
        self._iio, self._devices, self._clock = iio, devices, clock
        self._max_age_ns = max(round(_MAX_AGE_PERIODS * 1e9 / adc.rate_hz) if adc.rate_hz else 0, _MAX_AGE_NS)
        self._max_silence_ns = max(self._max_age_ns, _MAX_SILENCE_NS)
        self._recent: deque[tuple[FloatArray, int]] = deque(maxlen=adc.average_scans)
        self._file = -1
        self._opened_ns = 0
        self._trigger_now: IioDevice | None = None
        self._device = IioDevice(iio)

    def open(self) -> None:
        """Set up scan elements, trigger, time stamps and buffer, and start it."""
        self._device = device = IioDevice.find(self._adc.device, self._iio)
        elements = device.elements_folder
        device.write(f"{device.buffer_folder}/enable", 0)
        self.millivolts = device.millivolts(self._channels)
        self._has_time = device.has(f"{elements}/in_timestamp_en")
        enabled = [*self._channels, *(["timestamp"] if self._has_time else [])]
        for path in sorted((device.folder / elements).glob("in_*_en")):
            channel = path.name.removeprefix("in_").removesuffix("_en")
            device.write(f"{elements}/{path.name}", int(channel in enabled))
        enabled.sort(key=lambda channel: device.read_number(f"{elements}/in_{channel}_index"))
        self._layout = ScanLayout(tuple(device.read_element(channel) for channel in enabled))
        self._positions = [enabled.index(channel) for channel in self._channels]
        self._time_position = enabled.index("timestamp") if self._has_time else None
        self.limits = np.array(
            [self._layout.elements[position].limits for position in self._positions], np.float64
        )
        if self._adc.rate_hz is not None:
            device.write("sampling_frequency", f"{self._adc.rate_hz:g}")
        if self._has_time and device.has(_CLOCK):
            device.write(_CLOCK, "monotonic")
        if self._adc.trigger is not None:
            trigger = find_trigger(self._adc.trigger, self._iio)
            device.write("trigger/current_trigger", self._adc.trigger)
            self._trigger_now = trigger if trigger.has("trigger_now") else None
        device.write(f"{device.buffer_folder}/length", self._adc.buffer_scans)
        path = self._devices / device.folder.name
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise AdcError.of_os_error(path, error) from error
        self._discard_queued()
        device.write(f"{device.buffer_folder}/enable", 1)
        self._opened_ns = self._clock()

    def read(self) -> AdcReading | None:
        """Return a sample: a new conversion, or the mean of the newest scans; None without a recent scan.

        Raises AdcError, also for an ADC that runs freely and gives no more scans.
        """
        if self._trigger_now is not None:
            self._discard_queued()
            self._recent.clear()
            self._trigger_now.write("trigger_now", 1)
            ready = select.poll()
            ready.register(self._file, select.POLLIN)
            if not ready.poll(self._adc.timeout_ms):
                raise AdcError(AdcFaultKind.NO_CONVERSION, f"{self._path} within {self._adc.timeout_ms:g} ms")
        self.drain()
        now_ns = self._clock()
        newest_ns = self._recent[-1][1] if self._recent else self._opened_ns
        if now_ns - newest_ns > self._max_silence_ns:
            raise AdcError(
                AdcFaultKind.NO_CONVERSION, f"{self._path}: no scan for {self._max_silence_ns / 1e6:g} ms"
            )
        if not self._recent or now_ns - newest_ns > self._max_age_ns:
            return None
        raw = np.mean([values for values, _ in self._recent], axis=0)
        times = [sample_ns for _, sample_ns in self._recent]
        return AdcReading(raw, sum(times) // len(times), times[-1] - times[0], self._has_time)

    def drain(self) -> None:
        """Read the queued scans, keeping the newest. Raises AdcError, also for a buffer that was full."""
        data = self._read_queued()
        if len(data) % self._layout.size_bytes:
            raise AdcError(
                AdcFaultKind.SHORT_READ,
                f"{self._path}: {len(data)} bytes are no multiple of a scan's {self._layout.size_bytes}",
            )
        count = len(data) // self._layout.size_bytes
        if count >= self._adc.buffer_scans:
            raise AdcError(AdcFaultKind.OVERRUN, f"{self._path}: all {count} scans of the buffer were filled")
        newest = data[-self._layout.size_bytes * (self._recent.maxlen or 1) :]
        values = self._layout.decode(newest, self._positions).astype(np.float64)
        if self._time_position is None:
            times = [self._clock()] * len(values)
        else:
            times = self._layout.decode(newest, [self._time_position])[:, 0].tolist()
        self._recent.extend(zip(values, times, strict=True))

    def close(self) -> None:
        """Stop the buffer."""
        self._recent.clear()
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            try:
                self._device.write(f"{self._device.buffer_folder}/enable", 0)
            except AdcError:
                return  # it has vanished

    def fileno(self) -> int | None:
        """Return None: scans have time stamps."""
        return None

    def describe(self) -> str:
        """Return nothing: timing says all."""
        return ""

    @property
    def _path(self) -> Path:
        return self._devices / self._device.folder.name

    def _read_queued(self) -> bytes:
        """Return the queued bytes, at most those of a full buffer."""
        full = self._layout.size_bytes * self._adc.buffer_scans
        data = b""
        try:
            while len(data) < full and (part := os.read(self._file, full - len(data))):
                data += part
        except BlockingIOError:
            pass
        except OSError as error:
            raise AdcError.of_os_error(self._path, error) from error
        return data

    def _discard_queued(self) -> None:
        while self._read_queued():
            pass
