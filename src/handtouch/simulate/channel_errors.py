"""Errors of channels that a deployment doesn't state: crosstalk, non-linearity, hum, and noise in common.

Public name: `ChannelErrors`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.simulate import noise
from handtouch.simulate.worlds import DrawnWorld

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
