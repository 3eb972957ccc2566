"""Fluctuations, which no model can compensate: variation between presses, and flicker of the resistance.

Public names: `Fluctuation`, `FluctuationState`.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray


@dataclass(frozen=True)
class Fluctuation:
    """Relative standard deviations of a reading.

    press_std: from one press to the next, log-normal, kept while the press lasts. noise_std: of flicker at
    1 N; it goes as force^(-1/2), as the number of conducting spots goes as force. noise_time_s: its
    correlation time (Ornstein-Uhlenbeck). Raises ValueError for a negative standard deviation, or a time
    that isn't positive.
    """

    press_std: float = 0.0
    noise_std: float = 0.0
    noise_time_s: float = 0.05

    def __post_init__(self) -> None:
        if not (self.press_std >= 0 and self.noise_std >= 0 and self.noise_time_s > 0):
            raise ValueError(f"standard deviations must be at least 0, times positive, got {self}")

    def initial_state(self, pads: int, seed: int) -> FluctuationState:
        """Return the state of sheets without load."""
        return FluctuationState(
            np.random.default_rng(seed), np.zeros(pads, np.bool_), np.ones(pads), np.zeros(pads)
        )

    def apply_to(self, state: FluctuationState, reading_n: FloatArray, dt_s: float) -> FloatArray:
        """Return the reading (n,) with fluctuations; update `state` in place."""
        touched = reading_n > 0
        if self.press_std:
            new = touched & ~state.touched
            if count := int(np.count_nonzero(new)):
                state.press_factor[new] = np.exp(self.press_std * state.generator.standard_normal(count))
        state.touched[:] = touched
        if not self.noise_std:
            return reading_n * state.press_factor
        kept = np.exp(-dt_s / self.noise_time_s)
        state.flicker *= kept
        state.flicker += np.sqrt(1 - kept**2) * state.generator.standard_normal(len(touched))
        std = self.noise_std / np.sqrt(np.where(touched, reading_n, 1.0))
        return reading_n * state.press_factor * np.exp(std * state.flicker)


@dataclass
class FluctuationState:
    """Fluctuation state of n pads; arrays (n,)."""

    generator: np.random.Generator
    touched: npt.NDArray[np.bool_]
    press_factor: FloatArray
    """Factor of the present press."""
    flicker: FloatArray
    """Standard normal."""

    def copy(self) -> FluctuationState:
        return copy.deepcopy(self)
