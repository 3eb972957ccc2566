"""Sampling of all ADCs and other sources at SYNC: counts of every pad, timing, failures and recovery.

Public names: `AdcInput`, `Sampling`, `SampleTiming`, `make_inputs`.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.device import UnconfiguredDevice
from handtouch.node.adc_fault import AdcError
from handtouch.node.buffered import BufferedReader
from handtouch.node.iio import AdcReader, AdcReading, OneShotReader
from handtouch.node.pad_input import PadInput
from handtouch.node.settings import Adc, NodeFile

_WINDOW_SAMPLES = 2000
_MIN_RETRY_NS, _MAX_RETRY_NS = 100_000_000, 1_000_000_000
_MAX_DRAIN_PERIOD_S = 0.02  # between two readings of a queue: less than what a source takes for a pause


@dataclass(frozen=True)
class TimingSummary:
    """Times of the latest samples relative to the arrival of their SYNC [s].

    `mean_s`, `jitter_s` (standard deviation), `first_s`, `last_s` : of the sample; `span_s` : greatest time
    between the conversions of one sample; `samples` : their number; `is_timed` : False where a sample's time
    is that of reading it
    """

    mean_s: float
    jitter_s: float
    first_s: float
    last_s: float
    span_s: float
    samples: int
    is_timed: bool

    def __str__(self) -> str:
        mean, jitter, first, last, span = (
            1e3 * value for value in (self.mean_s, self.jitter_s, self.first_s, self.last_s, self.span_s)
        )
        text = f"sampled {mean:+.2f} ms from SYNC, jitter {jitter:.2f} ms ({first:+.2f} to {last:+.2f})"
        text += f", channels within {span:.2f} ms" if span >= 0.005 else ""
        return text + ("" if self.is_timed else ", times of reading, as there are no time stamps")


class SampleTiming:
    """Times of an ADC's latest samples relative to SYNC."""

    def __init__(self) -> None:
        self._latencies_ns: deque[int] = deque(maxlen=_WINDOW_SAMPLES)
        self._spans_ns: deque[int] = deque(maxlen=_WINDOW_SAMPLES)
        self._is_timed = True

    def add(self, sync_ns: int, sample_ns: int, span_ns: int, is_timed: bool) -> None:
        """Add a sample."""
        self._latencies_ns.append(sample_ns - sync_ns)
        self._spans_ns.append(span_ns)
        self._is_timed = is_timed

    def summary(self) -> TimingSummary | None:
        """Return the summary, None before the first sample."""
        if not self._latencies_ns:
            return None
        times_s = 1e-9 * np.array(self._latencies_ns)
        return TimingSummary(
            mean_s=float(times_s.mean()),
            jitter_s=float(times_s.std()),
            first_s=float(times_s.min()),
            last_s=float(times_s.max()),
            span_s=max(self._spans_ns) * 1e-9,
            samples=len(times_s),
            is_timed=self._is_timed,
        )


class AdcInput:
    """One ADC, or another source, with its pads; a failure closes it; it is reopened after growing delays.

    `rows` : of its pads in the counts of all; `failures` : failed samples; `timing` : of its samples
    """

    def __init__(self, name: str, reader: AdcReader, pads: Sequence[PadInput], rows: Sequence[int]) -> None:
        self.name, self.pads, self.rows = name, tuple(pads), tuple(rows)
        self.failures = 0
        self.timing = SampleTiming()
        self._reader = reader
        self._is_open = False
        self._ends_ma: list[FloatArray] = []  # of the pads' channels, each (2, c)
        self._retry_ns, self._due_ns = 0, 0

    def sample(self, counts: NDArray[np.int64], now_ns: int, sync_ns: int | None) -> None:
        """Write the counts of its pads into their rows of `counts` (pads, c); report failures by EMCY."""
        if not self._is_open and now_ns < self._due_ns:
            self.failures += 1
            return
        try:
            reading = self._read()
        except AdcError as error:
            self._fail(error, now_ns)
            return
        if reading is None:
            for pad in self.pads:
                pad.record_no_sample()
            return
        self._retry_ns = 0
        if sync_ns is not None:
            self.timing.add(sync_ns, reading.sample_ns, reading.span_ns, reading.is_timed)
        currents = self._currents_ma(reading.raw)
        for pad, row, current_ma, ends_ma in zip(self.pads, self.rows, currents, self._ends_ma, strict=True):
            own = counts[row, : len(current_ma)]
            own[:] = pad.counts(current_ma, ends_ma)
            pad.record_sample((own >= pad.max_count) | (own < -pad.max_count), now_ns)

    def read_currents_ma(self) -> list[FloatArray] | None:
        """Return the currents (c,) of each pad [mA], None without a recent conversion. Raises AdcError."""
        reading = self._read()
        return None if reading is None else self._currents_ma(reading.raw)

    def wait(self, period_s: float, sleep: Callable[[float], None]) -> None:
        """Let time pass without missing what arrives. Raises AdcError."""
        steps = max(math.ceil(period_s / _MAX_DRAIN_PERIOD_S), 1)
        for step in range(steps):
            if step and self._is_open:
                self._reader.drain()
            sleep(period_s / steps)

    def maintain(self, now_ns: int) -> None:
        """Keep the buffer from filling; reopen a closed ADC when due."""
        if self._is_open:
            self.drain(now_ns)
        else:
            most = max(len(pad.columns) for pad in self.pads)
            self.sample(np.zeros((max(self.rows) + 1, most), np.int64), now_ns, None)

    @property
    def file(self) -> int | None:
        """File that is to be drained as soon as it is readable, None without."""
        return self._reader.fileno()

    def drain(self, now_ns: int) -> None:
        """Read what has arrived."""
        try:
            self._reader.drain()
        except AdcError as error:
            self._fail(error, now_ns)

    def describe(self) -> str:
        """Return what the reader tells of itself; empty for nothing."""
        return self._reader.describe()

    def close(self) -> None:
        """Close the ADC."""
        self._reader.close()
        self._is_open = False

    def _read(self) -> AdcReading | None:
        if not self._is_open:
            self._reader.open()
            self._is_open = True
            self._ends_ma = self._currents_ma(self._reader.limits.T)
        return self._reader.read()

    def _currents_ma(self, raw: FloatArray) -> list[FloatArray]:
        """Return the currents of each pad (..., c) for raw values of all channels (..., channels)."""
        scale, offset = self._reader.millivolts
        return [
            pad.currents_ma(raw[..., pad.columns], scale[pad.columns], offset[pad.columns])
            for pad in self.pads
        ]

    def _fail(self, error: AdcError, now_ns: int) -> None:
        self.failures += 1
        self.close()
        self._due_ns = now_ns + self._retry_ns
        self._retry_ns = min(max(2 * self._retry_ns, _MIN_RETRY_NS), _MAX_RETRY_NS)
        for pad in self.pads:
            pad.record_failure(error)


class Sampling:
    """Sampler of `DeviceBus` for all pads; `sync_ns`: arrival of the SYNC being handled, or None."""

    def __init__(self, adcs: Sequence[AdcInput]) -> None:
        self.adcs = tuple(adcs)
        self.sync_ns: int | None = None
        rows = sum(len(adc.rows) for adc in self.adcs)
        most = max(len(pad.columns) for adc in self.adcs for pad in adc.pads)
        self._counts = np.zeros((rows, most), np.int64)

    def __call__(self, now_ns: int) -> NDArray[np.int64]:
        """Return counts (pads, c), c of the pad with most channels.

        Those of a pad whose ADC has failed are the last ones, and aren't sent.
        """
        for adc in self.adcs:
            adc.sample(self._counts, now_ns, self.sync_ns)
        return self._counts

    @property
    def files(self) -> list[int]:
        """Files that are to be drained as soon as they are readable."""
        return [adc.file for adc in self.adcs if adc.file is not None]

    def drain(self, now_ns: int) -> None:
        """Read what has arrived of the ADCs with such a file."""
        for adc in self.adcs:
            if adc.file is not None:
                adc.drain(now_ns)

    def maintain(self, now_ns: int) -> None:
        """Maintain the ADCs, and bring the nodes' state up to date; to be called every 20 ms or so."""
        for adc in self.adcs:
            adc.maintain(now_ns)
            for pad in adc.pads:
                pad.update_device()

    def close(self) -> None:
        """Close the ADCs."""
        for adc in self.adcs:
            adc.close()


def make_inputs(
    file: NodeFile,
    nodes: Sequence[UnconfiguredDevice | None],
    clock: Callable[[], int] = time.monotonic_ns,
) -> list[AdcInput]:
    """Return ADCs and other sources that pads have, with these pads, each with its node; opens no file."""
    settings, inputs = file.settings, []
    for name, adc in settings.adcs.items():
        rows = [row for row, pad in enumerate(settings.pads) if pad.adc == name]
        pads, channels = _connect(file, rows, nodes)
        if rows:
            reader = _make_reader(adc, channels, Path(settings.sysfs), Path(settings.devices), clock)
            inputs.append(AdcInput(name, reader, pads, rows))
    for name, source in settings.sources.items():
        rows = [row for row, pad in enumerate(settings.pads) if pad.source == name]
        for group in [rows] if source.is_shared and rows else [[row] for row in rows]:
            pads, channels = _connect(file, group, nodes)
            reader = source.make_reader(channels, file.folder, clock)
            shown = name if source.is_shared else f"{name} of {pads[0].pad.name}"
            inputs.append(AdcInput(shown, reader, pads, group))
    return inputs


def _connect(
    file: NodeFile, rows: Sequence[int], nodes: Sequence[UnconfiguredDevice | None]
) -> tuple[list[PadInput], list[str]]:
    """Return the pads of these rows, and the channels of all of them in the order of a reading's columns."""
    channels: list[str] = []
    pads = []
    for row in rows:
        pad = file.settings.pads[row]
        columns = list(range(len(channels), len(channels) + len(pad.channels)))
        pads.append(PadInput(pad, file.trims[row], columns, nodes[row]))
        channels += pad.channels
    return pads, channels


def _make_reader(
    adc: Adc, channels: Sequence[str], sysfs: Path, devices: Path, clock: Callable[[], int]
) -> AdcReader:
    """Return the reader of an ADC's channels; it opens no file."""
    if adc.mode == "one-shot":
        return OneShotReader(adc.device, channels, rate_hz=adc.rate_hz, iio=sysfs, clock=clock)
    return BufferedReader(adc, channels, iio=sysfs, devices=devices, clock=clock)
