"""State of the channels of shear pads, from their counts at each report of a pad's health.

Public name: `ShearChannels`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.wire import ShearStatusName

_MAX_DEAD_SHARE = 0.03
"""Current of an open channel over the mean of the others; a displacement within the travel leaves more."""
_MAX_EQUAL_SIGMA = 4.0
_MIN_EQUAL_REPORTS, _MIN_EQUAL_TOUCHES = 10, 3
"""Reports of equal currents, and those of them under touches, of two channels that are shorted. Currents that
are equal by chance at rest differ under tangential forces."""


class ShearChannels:
    """Remembers, for each pad above a shear pad, which of its channels had equal currents."""

    def __init__(self) -> None:
        self._equal: dict[int, NDArray[np.int64]] = {}
        """(2, 4, 4) by pad: reports with equal currents of two channels, and those under touches"""
        self._sample_ns: dict[int, int] = {}

    def update(
        self,
        pad: int,
        sample_ns: int,
        counts: NDArray[np.int64],
        saturated: NDArray[np.bool_],
        noise_counts: float,
        *,
        touched: bool,
        rest_known: bool,
    ) -> ShearStatusName:
        """Process counts (4,) of a shear pad at a time, with flags of those at a limit; return its status."""
        if (counts == 0).all():
            return "no_rest" if not rest_known else "operational"  # no sample yet, or excitation off
        if saturated.any():
            return "saturated"
        others = (counts.sum() - counts) / (len(counts) - 1)
        if (counts < _MAX_DEAD_SHARE * others).any():
            return "dead"
        bound = _MAX_EQUAL_SIGMA * np.sqrt(2) * max(noise_counts, 1.0)
        equal = np.abs(counts[:, None] - counts[None, :]) <= bound
        np.fill_diagonal(equal, False)
        known = self._equal.setdefault(pad, np.zeros((2, len(counts), len(counts)), np.int64))
        if sample_ns != self._sample_ns.get(pad):
            known += np.array([1, touched])[:, None, None]
        self._sample_ns[pad] = sample_ns
        known *= equal
        if ((known[0] >= _MIN_EQUAL_REPORTS) & (known[1] >= _MIN_EQUAL_TOUCHES)).any():
            return "shorted"
        return "operational" if rest_known else "no_rest"
