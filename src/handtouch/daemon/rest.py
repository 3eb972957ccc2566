"""Fading sheets rest in turns: without potential they recover, and feel nothing meanwhile.

Public name: `Turns`. Pure; times in ns.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
FADED = 3.0
"""Thresholds of touch that a sheet has got used to: it is fading."""
_TURN_NS = 600_000_000_000
_LOOK_NS = 1_000_000_000


class Turns:
    """Of the pads of several hands; `hands` are their rows, `after_s` how long a hand must be untouched.

    `resting` (n,): never more than half of the pads of a hand, and none once anything touches the hand.
    """

    def __init__(self, hands: Iterable[slice], pads: int, after_s: float | None) -> None:
        self.resting: BoolArray = np.zeros(pads, np.bool_)
        self._hands = list(hands)
        self._after_ns = None if after_s is None else round(after_s * 1e9)
        self._touched_ns = np.full(len(self._hands), -1, np.int64)
        self._look_ns = 0

    def due(self, now_ns: int, touching: BoolArray) -> bool:
        """Whether it is time for a `step`."""
        if self._after_ns is None:
            return False
        return now_ns >= self._look_ns or bool(self.resting.any() and touching.any())

    def step(
        self, now_ns: int, touching: BoolArray, needed: BoolArray, back_n: FloatArray, on_n: FloatArray
    ) -> bool:
        """See who is to rest, of the pads (n,) that are `needed`; whether that has changed.

        back_n: what sheets have got used to, NaN where nobody knows; on_n: thresholds of touch.
        """
        if self._after_ns is None or not self.due(now_ns, touching):
            return False
        self._look_ns = now_ns + _LOOK_NS
        before = self.resting.copy()
        for hand, rows in enumerate(self._hands):
            if touching[rows].any() or self._touched_ns[hand] < 0:
                self._touched_ns[hand] = now_ns
            self.resting[rows] = False
            if now_ns - self._touched_ns[hand] >= self._after_ns:
                fading = needed[rows] & (back_n[rows] > FADED * on_n[rows])
                self.resting[rows] = _half(fading, needed[rows], back_n[rows], now_ns // _TURN_NS)
        return bool((before != self.resting).any())


def _half(fading: BoolArray, needed: BoolArray, back_n: FloatArray, turn: int) -> BoolArray:
    """Those of the fading pads (n,) whose turn it is: at most half of the needed ones."""
    chosen = np.zeros(len(fading), np.bool_)
    most = np.count_nonzero(needed) // 2
    rows = np.flatnonzero(fading)
    worst_first = rows[np.argsort(-back_n[rows], kind="stable")]
    if most and len(rows):
        first = (turn * most) % len(rows) if len(rows) > most else 0
        chosen[np.roll(worst_first, -first)[:most]] = True
    return chosen
