"""A touch as of a firm grip: the hand trembles, the fingertip rolls as it presses, and then it may slip.

Public names: `Grip`, for scenarios that are made by programs.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from handtouch.config.tables import NonNegative, Positive
from handtouch.simulate.scenario import Touch

FloatArray = NDArray[np.float64]
_TONES, _BAND_HZ = 8, (1.0, 10.0)


class Grip(Touch):
    """A touch on one place, with force ripple and sway of 1 to 10 Hz drawn by `seed`, and a slip.

    The centroid is at the place of `path`, plus what the force moves it, plus sway, plus the slip, which
    keeps its speed from the first moment on until it has gone its way.
    """

    size_mm: tuple[Positive, Positive] = Field(description="of the pad, along x and y")
    seed: int = Field(0, ge=0, description="of ripple, sway and directions")
    ripple: NonNegative = Field(0.1, description="standard deviation of the force, as a part of it")
    sway_mm: NonNegative = Field(
        0.015, description="standard deviation of the centroid that force doesn't tell"
    )
    roll_mm_per_n: NonNegative = Field(0.1, description="how far a newton more moves the centroid")
    slip_from_s: float | None = Field(None, description="when it begins to slip; left out: never")
    slip_mm_per_s: NonNegative = Field(10.0, description="how fast")
    slip_mm: NonNegative = Field(4.0, description="and how far")
    slip_load: NonNegative = Field(1.0, description="force while it slips, as a part of that before")

    def place(self, t_s: float) -> tuple[float, float]:
        """As `Touch.place`."""
        (x,), (y,) = self.places(np.array([t_s]))
        return float(x), float(y)

    def force(self, t_s: float) -> float:
        """As `Touch.force`."""
        return float(self.forces(np.array([t_s]))[0])

    def places(self, times_s: FloatArray) -> FloatArray:
        """As `Touch.places`."""
        force = self.forces(times_s)
        rolled = self.roll_mm_per_n * force * _unit(self._angles[0])
        sway = self.sway_mm * self._tremble(times_s)[1:]
        slipped = self.slipped_mm(times_s) * _unit(self._angles[1])
        moved = (rolled + sway + slipped) / np.array(self.size_mm)[:, None]
        return np.asarray(np.array(self.path[0])[:, None] + moved)

    def forces(self, times_s: FloatArray) -> FloatArray:
        """As `Touch.forces`."""
        force = super().forces(times_s) * (1 + self.ripple * self._tremble(times_s)[0])
        if self.slip_from_s is not None:
            part = np.clip((times_s - self.slip_from_s) / 0.02, 0.0, 1.0)
            force = force * (1 + (self.slip_load - 1) * part)
        return np.asarray(np.maximum(force, 0.0))

    def slipped_mm(self, times_s: FloatArray) -> FloatArray:
        """How far it has slipped (n,)."""
        if self.slip_from_s is None:
            return np.zeros(len(times_s))
        return np.asarray(np.clip(self.slip_mm_per_s * (times_s - self.slip_from_s), 0.0, self.slip_mm))

    def knots(self) -> FloatArray:
        """As `Touch.knots`; ripple needs many."""
        return np.arange(self.from_s, self.until_s, 0.02)

    @cached_property
    def _angles(self) -> FloatArray:
        return np.asarray(np.random.default_rng((self.seed, 1)).uniform(0, 2 * np.pi, 2))

    @cached_property
    def _tones(self) -> tuple[FloatArray, FloatArray]:
        """Frequencies [Hz] and phases (3, tones) of force, and of sway along x and y."""
        drawn = np.random.default_rng((self.seed, 2))
        low, high = _BAND_HZ
        return drawn.uniform(low, high, (3, _TONES)), drawn.uniform(0, 2 * np.pi, (3, _TONES))

    def _tremble(self, times_s: FloatArray) -> FloatArray:
        """Three tremors (3, n) of standard deviation 1."""
        hertz, phases = self._tones
        waves = np.sin(2 * np.pi * hertz[:, :, None] * times_s + phases[:, :, None])
        return np.asarray(waves.sum(axis=1) * np.sqrt(2 / _TONES))


def _unit(angle: float) -> FloatArray:
    return np.array([[np.cos(angle)], [np.sin(angle)]])
