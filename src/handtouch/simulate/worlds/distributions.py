"""Distributions of hidden quantities.

Public names: `Distribution` and its kinds `Fixed`, `Uniform`, `Normal`, `LogNormal`, `LogUniform`, `OneOf`.
Their
text, as in docs/worlds.md, is `str(distribution)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from handtouch.arrays import FloatArray

Name = TypeVar("Name", bound=str)


class Distribution(Protocol):
    """Distribution of independent real numbers."""

    @property
    def mean(self) -> float: ...
    @property
    def std(self) -> float: ...
    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return independent draws (count,)."""


@dataclass(frozen=True)
class Fixed:
    """Always the same value."""

    value: float

    @property
    def mean(self) -> float:
        return self.value

    @property
    def std(self) -> float:
        return 0.0

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:  # noqa: ARG002
        """Return the value `count` times."""
        return np.full(count, self.value)

    def __str__(self) -> str:
        return f"{self.value:g}"


@dataclass(frozen=True)
class Uniform:
    """Uniform from `low` to `high`."""

    low: float
    high: float

    @property
    def mean(self) -> float:
        return (self.low + self.high) / 2

    @property
    def std(self) -> float:
        return (self.high - self.low) / math.sqrt(12)

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return independent draws (count,)."""
        return rng.uniform(self.low, self.high, count)

    def __str__(self) -> str:
        return f"U({self.low:g}, {self.high:g})"


@dataclass(frozen=True)
class Normal:
    """Normal."""

    mean: float
    std: float

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return independent draws (count,)."""
        return rng.normal(self.mean, self.std, count)

    def __str__(self) -> str:
        return f"N({self.mean:g}, {self.std:g})"


@dataclass(frozen=True)
class LogNormal:
    """Log-normal: the logarithm is normal around that of `median`, with standard deviation `log_std`."""

    median: float
    log_std: float

    @property
    def mean(self) -> float:
        return self.median * math.exp(self.log_std**2 / 2)

    @property
    def std(self) -> float:
        return self.mean * math.sqrt(math.expm1(self.log_std**2))

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return independent draws (count,)."""
        return np.asarray(self.median * np.exp(self.log_std * rng.standard_normal(count)))

    def __str__(self) -> str:
        return f"LN({self.median:g}, {self.log_std:g})"


@dataclass(frozen=True)
class LogUniform:
    """Log-uniform: the logarithm is uniform between those of `low` and `high`."""

    low: float
    high: float

    @property
    def mean(self) -> float:
        return (self.high - self.low) / math.log(self.high / self.low)

    @property
    def std(self) -> float:
        square = (self.high**2 - self.low**2) / (2 * math.log(self.high / self.low))
        return math.sqrt(square - self.mean**2)

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return independent draws (count,)."""
        return np.asarray(np.exp(rng.uniform(math.log(self.low), math.log(self.high), count)))

    def __str__(self) -> str:
        return f"LU({self.low:g}, {self.high:g})"


@dataclass(frozen=True)
class OneOf(Generic[Name]):
    """Number of one of some names, all equally likely."""

    names: tuple[Name, ...]

    @property
    def mean(self) -> float:
        return (len(self.names) - 1) / 2

    @property
    def std(self) -> float:
        return math.sqrt((len(self.names) ** 2 - 1) / 12)

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return independent draws (count,)."""
        return rng.integers(len(self.names), size=count).astype(np.float64)

    def __str__(self) -> str:
        return ", ".join(self.names)
