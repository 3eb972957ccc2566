"""Sources of a pad's values that aren't ADCs of this computer: tables `[source.NAME]`, each of a `kind`.

Public names: `Source`, `SourceReader` (base of their readers). The kinds are found by
`handtouch.node.source_kinds`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from handtouch.config.base import Table
from handtouch.config.tables import Positive
from handtouch.node.adc_fault import AdcError, AdcFaultKind

if TYPE_CHECKING:
    from handtouch.node.iio import AdcReader, AdcReading, FloatArray

_MIN_SILENCE_NS = 50_000_000
"""Shortest silence that is a failure, as that of a buffered ADC: what an ordinary host may delay a read by"""
_SILENT_PERIODS = 3
"""As many missing samples make a pad stale"""


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
        description="lowest and highest value of a channel, at which it is reported as saturated; default: "
        "those of 16-bit counts",
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

    def limit_rows(self, channels: Sequence[str]) -> FloatArray:
        """Return the lowest and highest values (channels, 2); infinite where they are unknown."""
        return np.tile(self.limits or (-np.inf, np.inf), (len(channels), 1))

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

    A subclass opens and closes what it reads from, and `drain` gives `_keep` each sample that has arrived.
    `samples`, `malformed`: since the start; `unit`: what may be malformed. Implements `AdcReader`.
    """

    unit: ClassVar[str]

    def __init__(self, source: Source, channels: Sequence[str], clock: Callable[[], int]) -> None:
        self._channels, self._clock, self._max_silence_ns = tuple(channels), clock, source.max_silence_ns
        self.limits = source.limit_rows(channels)
        self.millivolts = np.ones(len(channels)), np.zeros(len(channels))
        self.samples = self.malformed = 0
        self._newest: AdcReading | None = None
        self._kept_ns = 0

    @abstractmethod
    def open(self) -> None:
        """Open the source. Raises AdcError."""

    @abstractmethod
    def drain(self) -> None:
        """Read what has arrived. Raises AdcError."""

    @abstractmethod
    def close(self) -> None:
        """Close the source."""

    @abstractmethod
    def describe(self) -> str:
        """Return the samples so far, for the log."""

    @abstractmethod
    def _missing(self) -> str:
        """Return what of a sample doesn't come."""

    def read(self) -> AdcReading | None:
        """Return the newest sample if there is a new one. Raises AdcError after a silence."""
        self.drain()
        if self._newest is not None:
            newest, self._newest = self._newest, None
            return newest
        if self._clock() - self._kept_ns <= self._max_silence_ns:
            return None
        text = f"{self._missing()} for {self._max_silence_ns / 1e6:g} ms"
        text += f"; {self.malformed} {self.unit} were anything else" if self.malformed else ""
        raise AdcError(AdcFaultKind.NO_CONVERSION, text)

    def _begin(self) -> None:
        """Forget what was kept before the source was opened."""
        self._newest, self._kept_ns = None, self._clock()

    def _keep(self, reading: AdcReading) -> None:
        self._newest, self._kept_ns = reading, self._clock()
        self.samples += 1
