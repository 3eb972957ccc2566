"""Behaviour of sheets under loads that aren't known in advance.

Public name: `LiveSheets`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray, IntArray
from handtouch.simulate.sheet_history import random_factor
from handtouch.simulate.sheet_physics import SheetLaw, SheetStates


class LiveSheets:
    """Sheets of one law, sampled with a constant period. In a period that ends or begins with a load a sheet
    has the load of its end; otherwise it has none.

    `keys` (n,): random streams of the sheets.
    """

    def __init__(self, law: SheetLaw, keys: NDArray[np.uint64], period_s: float) -> None:
        self._law, self._keys, self._period_s = law, keys, period_s
        self._states = SheetStates(law, len(keys))
        self._times_s = np.zeros(len(keys))
        self._presses = np.zeros(len(keys), np.int64)
        self._loaded = np.zeros(0, np.intp)

    def reset(self, sheet: int) -> None:
        """Replace a sheet by one that was never pressed."""
        self._states.reset(sheet)
        self._loaded = self._loaded[self._loaded != sheet]

    @property
    def are_loaded(self) -> bool:
        """True if any had a load at the last sample."""
        return len(self._loaded) > 0

    def apparent_force_n(
        self, t_s: float, sheets: IntArray, force_n: FloatArray, warmer_k: float
    ) -> FloatArray:
        """Return the apparent forces (k,) [N] of the sheets (k,), in order, that have a load at a sample,
        (k,) [N].

        `warmer_k`: temperature above that at the start.
        """
        if np.array_equal(sheets, self._loaded):
            began = released = sheets[:0]
        else:
            began = np.setdiff1d(sheets, self._loaded, assume_unique=True)
            released = np.setdiff1d(self._loaded, sheets, assume_unique=True)
        idle = began[t_s - self._period_s - self._times_s[began] > 0]
        idle_s = t_s - self._period_s - self._times_s[idle]
        self._states.advance(idle, idle_s, 0.0, warmer_k=warmer_k)
        self._times_s[idle] += idle_s
        changing, load_n = np.concatenate([sheets, released]), np.zeros(len(sheets) + len(released))
        load_n[: len(sheets)] = force_n
        apparent_n = self._states.advance(changing, t_s - self._times_s[changing], load_n, warmer_k=warmer_k)
        self._times_s[changing], self._loaded = t_s, sheets
        self._presses[began] += 1
        apparent_n = apparent_n[: len(sheets)]
        times_s = np.full(len(sheets), t_s)
        return apparent_n * random_factor(
            self._law, self._keys[sheets], times_s, apparent_n, self._presses[sheets]
        )
