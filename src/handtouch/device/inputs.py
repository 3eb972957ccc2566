"""Analogue inputs of a node: from electrode currents to channel counts."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet

from handtouch.config.base import MAX_CHANNELS

CHANNELS = 4
STRAIGHT_WIRING = tuple(range(MAX_CHANNELS))
SETTLE_SAMPLES = 3
"""Number of wrong samples after the excitation is switched on."""
_NOISE_COUNTS = 1.0  # standard deviation of an input without a current

ChannelLimits = Sequence[tuple[int, int]]
"""Minimum and maximum count of each channel."""


def read_channels(
    electrodes: Sequence[int],
    limits: ChannelLimits,
    noise: random.Random,
    *,
    wiring: Sequence[int] = STRAIGHT_WIRING,
    open_electrodes: AbstractSet[int] = frozenset(),
    stuck_counts: Mapping[int, int] | None = None,
    excited: bool = True,
    settled: int = SETTLE_SAMPLES,
) -> list[int]:
    """Return the counts of the channels; `settled`: samples since the excitation was switched on.

    Without excitation an input reads 0. After switching on, the charging current adds an eighth of the range,
    halved with each sample, for SETTLE_SAMPLES.
    """
    values = [0] * len(limits)
    if excited:
        values = [electrodes[electrode] for electrode in wiring[: len(limits)]]
        if open_electrodes:
            values = [
                round(noise.gauss(0.0, _NOISE_COUNTS)) if electrode in open_electrodes else value
                for electrode, value in zip(wiring, values, strict=False)
            ]
        if settled < SETTLE_SAMPLES:
            values = [v + (high >> 3 + settled) for v, (_, high) in zip(values, limits, strict=True)]
    if stuck_counts:
        values = [stuck_counts.get(channel, value) for channel, value in enumerate(values)]
    return [
        v if low <= v <= high else min(max(v, low), high)
        for v, (low, high) in zip(values, limits, strict=True)
    ]
