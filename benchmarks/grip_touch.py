"""Touch of a firm grip: force tremor, rolling of the fingertip under force, and an optional slip.

Public name: `GripTouch`, for scenarios that programs generate.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from handtouch.config.base import NonNegative, Positive
from handtouch.simulate.touch import ScenarioTouch

FloatArray = NDArray[np.float64]
_TREMOR_TONES, _TREMOR_BAND_HZ = 8, (1.0, 10.0)
_BURST_S, _BURST_INTERVAL_S = 0.6, 2.0  # duration of a burst; one in each interval


class GripTouch(ScenarioTouch):
    """Touch at one position, with tremor of force and position of 1 to 10 Hz drawn by `seed`, and a slip.

    The centroid is the position of `path` plus a shift proportional to the force, plus sway, plus bursts of
    chatter, one every 2 s, plus the slip, which has constant speed from its begin to its full length.
    """

    size_mm: tuple[Positive, Positive] = Field(description="size of the pad along x and y")
    seed: int = Field(0, ge=0, description="seed of ripple, sway and directions")
    ripple: NonNegative = Field(0.1, description="standard deviation of the force, relative to its mean")
    sway_mm: NonNegative = Field(
        0.015, description="standard deviation of the centroid, uncorrelated with the force"
    )
    roll_mm_per_n: NonNegative = Field(0.1, description="shift of the centroid per newton")
    burst_mm: NonNegative = Field(
        0.0, description="amplitude of bursts of chatter, each of 0.6 s along a direction of its own"
    )
    burst_hz: Positive = Field(9.0, description="frequency of the bursts")
    slip_from_s: float | None = Field(None, description="begin of the slip; left out: no slip")
    slip_mm_per_s: NonNegative = Field(10.0, description="speed of the slip")
    slip_mm: NonNegative = Field(4.0, description="length of the slip")
    slip_load: NonNegative = Field(1.0, description="force during the slip, relative to that before")

    def position_at(self, t_s: float) -> tuple[float, float]:
        """Return the position at `t_s`, as `ScenarioTouch.position_at`."""
        (x,), (y,) = self.positions(np.array([t_s]))
        return float(x), float(y)

    def force_at(self, t_s: float) -> float:
        """Return the force at `t_s`, as `ScenarioTouch.force_at`."""
        return float(self.forces(np.array([t_s]))[0])

    def positions(self, times_s: FloatArray) -> FloatArray:
        """Return positions (2, n), as `ScenarioTouch.positions`."""
        force = self.forces(times_s)
        rolling = self.roll_mm_per_n * force * _unit(self._directions_rad[0])
        sway = self.sway_mm * self._tremor(times_s)[1:]
        slip = self.slipped_mm(times_s) * _unit(self._directions_rad[1])
        bursts = self.burst_mm * self._bursts(times_s)
        shift = (rolling + sway + slip + bursts) / np.array(self.size_mm)[:, None]
        return np.asarray(np.array(self.path[0])[:, None] + shift)

    def forces(self, times_s: FloatArray) -> FloatArray:
        """Return forces (n,), as `ScenarioTouch.forces`."""
        force = super().forces(times_s) * (1 + self.ripple * self._tremor(times_s)[0])
        if self.slip_from_s is not None:
            fraction = np.clip((times_s - self.slip_from_s) / 0.02, 0.0, 1.0)
            force = force * (1 + (self.slip_load - 1) * fraction)
        return np.asarray(np.maximum(force, 0.0))

    def slipped_mm(self, times_s: FloatArray) -> FloatArray:
        """Return the slipped distance (n,)."""
        if self.slip_from_s is None:
            return np.zeros(len(times_s))
        return np.asarray(np.clip(self.slip_mm_per_s * (times_s - self.slip_from_s), 0.0, self.slip_mm))

    def _bursts(self, times_s: FloatArray) -> FloatArray:
        """Return the chatter (2, n) of amplitude 1."""
        if self.burst_mm == 0.0:
            return np.zeros((2, len(times_s)))
        interval = np.floor((times_s - self.from_s) / _BURST_INTERVAL_S).astype(np.intp)
        number, drawn = np.maximum(interval, 0), np.random.default_rng((self.seed, 3))
        begins, turns = drawn.uniform(size=(int(number.max(initial=0)) + 1, 2)).T
        since_s = times_s - self.from_s - interval * _BURST_INTERVAL_S
        since_s = since_s - begins[number] * (_BURST_INTERVAL_S - _BURST_S)
        on = (since_s >= 0.0) & (since_s < _BURST_S) & (interval >= 0)
        wave = np.where(on, np.sin(2 * np.pi * self.burst_hz * since_s), 0.0)
        return np.asarray(wave * np.concatenate(_unit(2 * np.pi * turns))[:, number])

    def force_times_s(self) -> FloatArray:
        """Return times dense enough for the ripple, as `ScenarioTouch.force_times_s`."""
        return np.arange(self.from_s, self.until_s, 0.02)

    @cached_property
    def _directions_rad(self) -> FloatArray:
        return np.asarray(np.random.default_rng((self.seed, 1)).uniform(0, 2 * np.pi, 2))

    @cached_property
    def _tones(self) -> tuple[FloatArray, FloatArray]:
        """Frequencies [Hz] and phases, (3, tones) each, of the force and of the sway along x and y."""
        drawn = np.random.default_rng((self.seed, 2))
        low, high = _TREMOR_BAND_HZ
        return drawn.uniform(low, high, (3, _TREMOR_TONES)), drawn.uniform(0, 2 * np.pi, (3, _TREMOR_TONES))

    def _tremor(self, times_s: FloatArray) -> FloatArray:
        """Return three tremor signals (3, n) of standard deviation 1."""
        hertz, phases = self._tones
        waves = np.sin(2 * np.pi * hertz[:, :, None] * times_s + phases[:, :, None])
        return np.asarray(waves.sum(axis=1) * np.sqrt(2 / _TREMOR_TONES))


def _unit(angle: float) -> FloatArray:
    return np.array([[np.cos(angle)], [np.sin(angle)]])
