"""Sources of a pad's values that aren't ADCs of this computer: tables `[source.NAME]`, each of a `kind`.

Public names: `Source`, `SourceReader` (base of their readers). The kinds are found by
`handtouch.node.settings`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from handtouch.config.base import Positive, Table
from handtouch.node.adc_fault import AdcError, AdcFaultKind

if TYPE_CHECKING:
    from handtouch.node.iio import AdcReader, AdcReading

_MIN_SILENCE_NS = 50_000_000
"""Shortest silence that is a failure, as that of a buffered ADC: what an ordinary host may delay a read by"""
_MIN_AGE_NS = 5_000_000
"""Age up to which a sample is used at any rate, as that of a buffered ADC"""
_SILENT_PERIODS = 3
"""As many missing samples make a pad stale; a sample older than that isn't used"""


class Source(Table):
    """Base of the tables `[source.NAME]`, which are frozen and checked by pydantic.

    A subclass has a `kind` of its own, `problem_of` and `make_reader`. `is_shared`: one reader serves all
    pads of the source; else each pad has its own, so that one that fails costs no other.
    """

    is_shared: ClassVar[bool] = True

    kind: str
    rate_hz: Positive = Field(
        description="samples a second, as the source sends them; after three missing ones, and 50 ms, the "
        "pad has none",
        examples=[100.0],
    )
    limits: Annotated[tuple[float, float], Field(strict=False)] | None = Field(
        None,
        description="lowest and highest value of a channel, at which it is saturated; default: that of a DBC "
        "signal, else unknown",
        examples=[(0.0, 4095.0)],
    )

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise ValueError(f"limits = {list(self.limits)} must be the lowest and the highest value")
        return self

    @property
    def max_silence_ns(self) -> int:
        """Time without a sample that is a failure."""
        return max(round(_SILENT_PERIODS * 1e9 / self.rate_hz), _MIN_SILENCE_NS)

    @property
    def max_age_ns(self) -> int:
        """Age up to which a sample is used."""
        return max(round(_SILENT_PERIODS * 1e9 / self.rate_hz), _MIN_AGE_NS)

    def limits_of(self, channel: str, folder: Path) -> tuple[float, float]:  # noqa: ARG002
        """Return the lowest and highest value of a channel without a problem; infinite where unknown."""
        return self.limits or (-np.inf, np.inf)

    def problem_of(self, channel: str, folder: Path) -> str:
        """Return why a pad can't have this channel, and a remedy; empty if it can.

        `folder`: that paths are relative to
        """
        raise NotImplementedError

    def make_reader(self, channels: Sequence[str], folder: Path, clock: Callable[[], int]) -> AdcReader:
        """Return a reader of these channels, which opens nothing yet; `clock` returns the monotonic time."""
        raise NotImplementedError


class SourceReader(ABC):
    """Reads the newest sample of a source once, so that an old one is never taken for new.

    A subclass opens and closes what it reads from, and `receive` gives `_keep` each sample that has arrived.
    `start_ns`: time after opening that the first sample may take. `samples`, `malformed`, and `skipped`, as a
    newer sample came before the next SYNC: since the start; `unit`: what may be malformed. Implements
    `AdcReader`.
    """

    unit: ClassVar[str]

    def __init__(
        self,
        source: Source,
        channels: Sequence[str],
        folder: Path,
        clock: Callable[[], int],
        start_ns: int = 0,
    ) -> None:
        self._channels, self._clock = tuple(channels), clock
        self._max_silence_ns, self._max_age_ns = source.max_silence_ns, source.max_age_ns
        self._start_ns = max(start_ns, self._max_silence_ns)
        self.limits = np.array([source.limits_of(channel, folder) for channel in channels])
        self.millivolts = np.ones(len(channels)), np.zeros(len(channels))
        self.samples = self.malformed = self.skipped = 0
        self._newest: AdcReading | None = None
        self._opened_ns = self._first_ns = self._kept_ns = self._pause_ns = self._samples_before = 0

    @abstractmethod
    def open(self) -> None:
        """Open the source. Raises AdcError."""

    @abstractmethod
    def receive(self) -> None:
        """Read what has arrived. Raises AdcError."""

    @abstractmethod
    def close(self) -> None:
        """Close the source."""

    def _missing(self) -> str:
        """Return what of a sample doesn't come."""
        return "no sample"

    def fileno(self) -> int | None:
        """Return a file that is readable when a sample may have come, None without; while it is open."""
        return None

    def read(self) -> AdcReading | None:
        """Return the newest sample if there is a new one. Raises AdcError, also after a silence."""
        self.drain()
        newest, self._newest = self._newest, None
        is_new = newest is not None and self._clock() - newest.sample_ns <= self._max_age_ns
        return newest if is_new else None

    def drain(self) -> None:
        """Read what has arrived. Raises AdcError, also after a silence."""
        self.receive()
        limit_ns = self._max_silence_ns if self._kept_ns else self._start_ns
        if self._clock() - self._pause_ns - (self._kept_ns or self._opened_ns) <= limit_ns:
            return
        text = f"{self._missing()} for {limit_ns / 1e6:g} ms"
        text += f"; {self.malformed} {self.unit} were anything else" if self.malformed else ""
        raise AdcError(AdcFaultKind.NO_CONVERSION, text)

    def describe(self) -> str:
        """Return the samples so far, for the log."""
        text = f"{self.samples} samples"
        count, span_ns = self.samples - self._samples_before, self._kept_ns - self._first_ns
        text += f" ({(count - 1) / span_ns * 1e9:.4g} a second)" if span_ns > 0 else ""
        return f"{text}, {self.skipped} replaced by newer ones, {self.malformed} malformed {self.unit}"

    def _begin(self) -> None:
        """Forget what was kept before the source was opened."""
        self._newest, self._opened_ns, self._samples_before = None, self._clock(), self.samples
        self._first_ns = self._kept_ns = self._pause_ns = 0

    def _excuse(self, pause_ns: int) -> None:
        """Don't count a pause of this process as a silence of the source."""
        self._pause_ns += pause_ns

    def _keep(self, reading: AdcReading) -> None:
        self.skipped += self._newest is not None
        self._newest, self._kept_ns, self._pause_ns = reading, self._clock(), 0
        self._first_ns = self._first_ns or self._kept_ns
        self.samples += 1
