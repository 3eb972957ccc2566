"""Behaviour of sheets under loads that aren't known in advance.

Public name: `LiveSheets`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.simulate.sheet_history import random_factor
from handtouch.simulate.sheet_physics import SheetLaw, SheetState, advance

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


class LiveSheets:
    """Sheets of one law, sampled with a constant period. In a period that ends or begins with a load a sheet
    has the load of its end; otherwise it has none.

    `keys` (n,): random streams of the sheets.
    """

    def __init__(self, law: SheetLaw, keys: NDArray[np.uint64], period_s: float) -> None:
        self._law, self._keys, self._period_s = law, keys, period_s
        self._states = [SheetState.fresh(law) for _ in keys]
        self._times_s = np.zeros(len(keys))
        self._presses = np.zeros(len(keys), np.int64)
        self._loaded: set[int] = set()

    def reset(self, sheet: int) -> None:
        """Replace a sheet by one that was never pressed."""
        self._states[sheet] = SheetState.fresh(self._law)
        self._loaded.discard(sheet)

    def apparent_force_n(
        self, t_s: float, sheets: IntArray, force_n: FloatArray, warmer_k: float
    ) -> FloatArray:
        """Return the apparent forces (k,) [N] of the sheets (k,) that have a load at a sample, (k,) [N].

        `warmer_k`: temperature above that at the start.
        """
        if not (len(sheets) or self._loaded):
            return np.zeros(0)
        now = set(sheets.tolist())
        for sheet in self._loaded - now:
            self._advance(t_s, sheet, 0.0, warmer_k)
        self._presses[list(now - self._loaded)] += 1
        apparent_n = np.array(
            [
                self._advance(t_s, sheet, load_n, warmer_k)
                for sheet, load_n in zip(sheets.tolist(), force_n.tolist(), strict=True)
            ]
        )
        self._loaded = now
        times_s = np.full(len(sheets), t_s)
        return apparent_n * random_factor(
            self._law, self._keys[sheets], times_s, apparent_n, self._presses[sheets]
        )

    def _advance(self, t_s: float, sheet: int, load_n: float, warmer_k: float) -> float:
        """Return the apparent force at `t_s` without its random part."""
        state, time_s = self._states[sheet], float(self._times_s[sheet])
        if sheet not in self._loaded and (idle_s := t_s - self._period_s - time_s) > 0:
            advance(self._law, state, idle_s, 0.0, True, warmer_k)
            time_s += idle_s
        self._times_s[sheet] = t_s
        return advance(self._law, state, t_s - time_s, load_n, True, warmer_k)
