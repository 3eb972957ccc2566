"""Rotation of excitation: sheets whose sensitivity fades under load recover with excitation off.

Public name: `ExcitationSchedule`. Pure logic; times in ns. A pad with excitation off detects nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from handtouch.arrays import BoolArray, FloatArray

MIN_FADING_THRESHOLD_RATIO = 3.0
"""Force hidden by sheet adaptation, in begin thresholds, from which a sheet counts as fading"""
_ROTATION_PERIOD_NS = 600_000_000_000
_CHECK_PERIOD_NS = 1_000_000_000


class ExcitationSchedule:
    """Selects the pads of several hands whose excitation is off, so that their sheets recover.

    `hands` are the rows of each hand's pads; `after_s` is how long a hand must be untouched first.

    `off` (n,): at most half of the pads of a hand, and none once anything touches the hand.
    """

    def __init__(self, hands: Iterable[slice], pads: int, after_s: float | None) -> None:
        self.off: BoolArray = np.zeros(pads, np.bool_)
        self._hands = list(hands)
        self.set_after(after_s)
        self._last_touch_ns = np.full(len(self._hands), -1, np.int64)
        self._next_check_ns = 0

    def set_after(self, after_s: float | None) -> None:
        """Set how long a hand must be untouched first; None: no excitation is switched off."""
        self._off_after_ns = None if after_s is None else round(after_s * 1e9)

    def is_due(self, now_ns: int, touching: BoolArray) -> bool:
        """Return True if `update_schedule` is due."""
        if self._off_after_ns is None:
            return bool(self.off.any())
        return now_ns >= self._next_check_ns or bool(self.off.any() and touching.any())

    def update_schedule(
        self, now_ns: int, touching: BoolArray, needed: BoolArray, back_n: FloatArray, threshold_n: FloatArray
    ) -> bool:
        """Select among the `needed` pads (n,) those to switch off; return True if the selection changed.

        back_n: force hidden by sheet adaptation, NaN if unknown; threshold_n: begin thresholds of contacts.
        """
        if not self.is_due(now_ns, touching):
            return False
        self._next_check_ns = now_ns + _CHECK_PERIOD_NS
        before = self.off.copy()
        for hand, rows in enumerate(self._hands):
            if touching[rows].any() or self._last_touch_ns[hand] < 0:
                self._last_touch_ns[hand] = now_ns
            self.off[rows] = False
            if self._off_after_ns is not None and now_ns - self._last_touch_ns[hand] >= self._off_after_ns:
                fading = needed[rows] & (back_n[rows] > MIN_FADING_THRESHOLD_RATIO * threshold_n[rows])
                self.off[rows] = _choose_pads_off(
                    fading, needed[rows], back_n[rows], now_ns // _ROTATION_PERIOD_NS
                )
        return bool((before != self.off).any())


def _choose_pads_off(fading: BoolArray, needed: BoolArray, back_n: FloatArray, turn: int) -> BoolArray:
    """Return the fading pads (n,) to switch off in this turn: at most half of the needed ones."""
    chosen = np.zeros(len(fading), np.bool_)
    max_off = np.count_nonzero(needed) // 2
    rows = np.flatnonzero(fading)
    worst_first = rows[np.argsort(-back_n[rows], kind="stable")]
    if max_off and len(rows):
        first = (turn * max_off) % len(rows) if len(rows) > max_off else 0
        chosen[np.roll(worst_first, -first)[:max_off]] = True
    return chosen
