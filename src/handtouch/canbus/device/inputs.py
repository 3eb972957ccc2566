"""The analogue inputs of a node: from what its electrodes collect to what its channels show."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet

CHANNELS = 4
STRAIGHT = (0, 1, 2, 3)
SETTLE_SAMPLES = 3
"""After the excitation has come on, so many samples are wrong."""
_NOISE_COUNTS = 1.0  # standard deviation of an input without a current

Limits = Sequence[tuple[int, int]]
"""Least and greatest count of each channel."""


def read(
    electrodes: Sequence[int],
    limits: Limits,
    noise: random.Random,
    *,
    wired: Sequence[int] = STRAIGHT,
    dead: AbstractSet[int] = frozenset(),
    held: Mapping[int, int] | None = None,
    excited: bool = True,
    settled: int = SETTLE_SAMPLES,
) -> list[int]:
    """Counts of the four channels. `settled`: samples since the excitation came on.

    Without excitation an input reads 0; after it the charging current adds an eighth of the range, halved
    with each sample and gone after SETTLE_SAMPLES.
    """
    values = [0] * CHANNELS
    if excited:
        values = [electrodes[electrode] for electrode in wired]
        if dead:
            values = [
                round(noise.gauss(0.0, _NOISE_COUNTS)) if electrode in dead else value
                for electrode, value in zip(wired, values, strict=True)
            ]
        if settled < SETTLE_SAMPLES:
            values = [v + (high >> 3 + settled) for v, (_, high) in zip(values, limits, strict=True)]
    if held:
        values = [held.get(channel, value) for channel, value in enumerate(values)]
    return [
        v if low <= v <= high else min(max(v, low), high)
        for v, (low, high) in zip(values, limits, strict=True)
    ]
