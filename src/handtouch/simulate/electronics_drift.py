"""Electronics of a simulated hand: drift, and errors of channels that a deployment doesn't state.

Public names: `ElectronicsDrift`; `ChannelErrors`: crosstalk, non-linearity, hum, and noise in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.simulate import noise
from handtouch.simulate.worlds import DrawnWorld

WARM_UP_S: Final = 120.0


class ElectronicsDrift:
    """Zeros of each channel, and temperature and supply of the whole hand.

    Rows are pads. All methods are functions of times (n,) since the start. `is_constant`: nothing drifts, and
    zeros are 0.
    """

    def __init__(
        self,
        world: DrawnWorld,
        names: Sequence[tuple[str, str]],
        channels: Sequence[Sequence[str]] | None = None,
    ) -> None:
        """names: hand and link of each row. channels: names of each pad's; c is their greatest number."""
        channels = [SIDE_ELECTRODES] * len(names) if channels is None else channels
        count = max(map(len, channels))
        electronics, pads = world.world.electronics, ["/".join(name) for name in names]
        self._zero_counts_per_s, self._temperature_k_per_s, self._supply_per_s = (
            world.hand_rate(getattr(electronics, rate), rate)
            for rate in ("zero_drift_counts_per_s", "temperature_drift_k_per_s", "supply_drift_per_s")
        )
        self._warm_up_k = world.hand_rate(electronics.warm_up_k, "warm_up_k")
        self._first_zeros = np.array([world.zero_counts(pad, count) for pad in pads])
        rates = self._zero_counts_per_s, self._temperature_k_per_s, self._supply_per_s
        self.is_constant = not (any(rates) or self._warm_up_k or self._first_zeros.any())
        self._zero_keys = np.array(
            [
                noise.stream_key(world.seed, "zero", *name, channel)
                for name, own in zip(names, channels, strict=True)
                for channel in (*own, *[""] * (count - len(own)))
            ],
            np.uint64,
        )
        self._offset_counts_per_k = np.array([world.offset_counts_per_k(pad, count) for pad in pads])
        self._gain_per_k = np.array([world.gain_per_k(pad, count) for pad in pads])
        self._temperature_key, self._supply_key = (
            np.array([noise.stream_key(world.seed, name)]) for name in ("warmth", "supply")
        )

    def temperature_rise_k(self, times_s: FloatArray) -> FloatArray:
        """Return the hand's temperature (n,) relative to that at the start."""
        walk = self._bounded_walk(self._temperature_k_per_s, self._temperature_key, times_s)[0]
        return np.asarray(walk + self._warm_up_k * np.minimum(times_s / WARM_UP_S, 1.0))

    def supply_ratio(self, times_s: FloatArray) -> FloatArray:
        """Return the supply voltage (n,) relative to the nominal one."""
        return np.asarray(1 + self._bounded_walk(self._supply_per_s, self._supply_key, times_s)[0])

    def gain_ratio(self, times_s: FloatArray) -> FloatArray:
        """Return the gains of the channels (n, rows, c) relative to those at the start."""
        return 1 + self._gain_per_k * self.temperature_rise_k(times_s)[:, None, None]

    def zero_counts(self, times_s: FloatArray) -> FloatArray:
        """Return the counts (n, rows, c) of channels without current."""
        walk = self._bounded_walk(self._zero_counts_per_s, self._zero_keys, times_s)
        zeros = self._first_zeros + walk.T.reshape(len(times_s), *self._gain_per_k.shape)
        return np.asarray(zeros + self._offset_counts_per_k * self.temperature_rise_k(times_s)[:, None, None])

    @staticmethod
    def _bounded_walk(rate: float, keys: NDArray[np.uint64], times_s: FloatArray) -> FloatArray:
        """Return random walks (keys, n) that start at 0 and never exceed the rate."""
        if not rate:
            return np.zeros((len(keys), len(times_s)))
        if len(keys) == len(times_s) == 1:
            return rate * _single_walk(int(keys[0]), float(times_s[0]))
        return np.asarray(rate * (noise.random_walk(keys, times_s) - _walk_at_start(keys.tobytes())))


@lru_cache(maxsize=64)
def _single_walk(key: int, t_s: float) -> FloatArray:
    """Return a walk (1, 1) at a time, which zeros, gains and sheets of a sample ask for."""
    keys = np.array([key], np.uint64)
    return np.asarray(noise.random_walk(keys, t_s) - _walk_at_start(keys.tobytes()))


@lru_cache(maxsize=1024)
def _walk_at_start(keys: bytes) -> FloatArray:
    return noise.random_walk(np.frombuffer(keys, np.uint64), 0.0)


HUM_HZ: Final = 49.97
"""Of the mains, a little off its nominal value, as it usually is."""
_BENDS = 4  # waves of the non-linearity over the converter's range


class ChannelErrors:
    """Errors of the channels of pads (rows), in counts; `is_none`: there are none.

    Crosstalk: each channel reads a share of the channel that was converted before it. Non-linearity: a sine
    of the reading, each channel with its own amplitude. Hum and common noise are the same in all channels of
    a pad.
    """

    def __init__(
        self,
        world: DrawnWorld,
        names: Sequence[tuple[str, str]],
        channels: Sequence[int],
        top_counts: Sequence[float],
    ) -> None:
        """names: hand and link of each row. channels: numbers of each pad's; c is the greatest. top_counts:
        at the top of each pad's range."""
        pads, count = ["/".join(name) for name in names], max(channels)
        hidden = [world.channel_errors(pad, count) for pad in pads]
        self._crosstalk = np.array([one.crosstalk for one in hidden])
        self._bend = np.array([one.nonlinearity_counts for one in hidden])
        self._hum = np.array([one.hum_counts for one in hidden])
        self._common = np.array([one.common_noise_counts for one in hidden])
        first = count * np.arange(len(pads))[:, None]
        columns = np.arange(count)
        before = np.where(columns > 0, columns - 1, np.array(channels)[:, None] - 1)
        self._before = (first + before).ravel()  # of all channels, row by row: that which is converted before
        self._per_count = 2 * np.pi * _BENDS / np.array(top_counts)[:, None]
        self._keys = np.array([noise.stream_key(world.seed, "common", *name) for name in names])
        self._phase = 2 * np.pi * (self._keys.astype(np.float64) % 4093) / 4093
        self.distorts = bool(self._crosstalk.any() or self._bend.any())
        self.disturbs = bool(self._hum.any() or self._common.any())

    def disturbance(self, times_s: FloatArray) -> FloatArray:
        """Return hum and common noise (n, rows, 1) at times (n,)."""
        hum = self._hum * np.sin(2 * np.pi * HUM_HZ * times_s[:, None] + self._phase)
        sample_ns = np.rint(times_s * 1e9).astype(np.int64)
        return np.asarray(hum + self._common * noise.standard_normal(self._keys, sample_ns[:, None]))[
            ..., None
        ]

    def distorted(self, counts: FloatArray) -> FloatArray:
        """Return what channels read (..., rows, c) for these counts, before rounding."""
        before = counts.reshape(*counts.shape[:-2], -1).take(self._before, axis=-1).reshape(counts.shape)
        mixed = counts + self._crosstalk[:, None] * before
        bend = np.sin(mixed * self._per_count)
        bend *= self._bend
        mixed += bend
        return np.asarray(mixed)
