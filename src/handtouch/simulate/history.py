"""What a pad's sheet makes of its load in the course of time: apparent over true force.

Public name: `History`. It goes along knots that are dense where the load changes and sparse where it
doesn't; the laws of `handtouch.sheet` are exact under a constant load, so an hour at rest is one step. Asked
for a time it goes as far as needed and no further: the same time gives the same answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from handtouch.sheet import Fluctuation, SheetModel, SheetState
from handtouch.sheet.behaviour import SheetStep
from handtouch.simulate import noise

FloatArray = NDArray[np.float64]

_AHEAD_S = 0.5  # no further than needed: a live hand must not pause for it
_MOST_PIECES = 64
_LATER_S = np.cumsum(0.02 * 1.35 ** np.arange(21.0))  # knots after the load has changed: 20 ms to 30 s
_LONGEST_S = 30.0
_SHORTEST_S = 4e-3


class History:
    """A sheet under a load.

    load: (n,) total force [N] at times (n,) of a round; warmer_k: (n,) at times from the start. changes:
    times of a round at which the load is looked at; settles: those after which the sheet has to settle;
    begins: those at which a press begins.
    """

    def __init__(
        self,
        model: SheetModel,
        key: np.uint64,
        load: Callable[[FloatArray], FloatArray],
        warmer_k: Callable[[FloatArray], FloatArray],
        changes: FloatArray,
        settles: FloatArray,
        begins: FloatArray,
        round_s: float,
    ) -> None:
        self._fluctuation, self._key = model.fluctuation, key
        self._model = replace(model, fluctuation=Fluctuation())
        self._step = lru_cache(maxsize=4096)(self._model.at)
        self._load, self._warmer_k, self._round_s = load, warmer_k, round_s
        spread = np.concatenate([changes, (settles[:, None] + _LATER_S).ravel()])
        self._knots, self._begins = np.unique(np.ceil(spread / _SHORTEST_S) * _SHORTEST_S), np.sort(begins)
        self._power: list[tuple[float, bool]] = []
        self._marks: list[tuple[float, SheetState]] = [(0.0, self._model.start(1))]
        self._pieces: list[tuple[FloatArray, FloatArray]] = []  # after each mark: times, apparent over true
        self._all: tuple[FloatArray, FloatArray] | None = None

    def switch(self, t_s: float, on: bool) -> None:
        """The potential goes on or off at `t_s`, later than any switch before; what was said of times after
        it no longer holds. On from the start."""
        keep = max(int(np.searchsorted([mark for mark, _ in self._marks], t_s, side="right")), 1)
        del self._marks[keep:], self._pieces[keep - 1 :]
        if t_s < self._marks[0][0]:
            self._marks, self._pieces = [(0.0, self._model.start(1))], []
        self._power.append((t_s, on))
        self._all = None

    def yields(self, times_s: FloatArray) -> FloatArray:
        """Apparent over true force at times (n,) at which something presses."""
        if len(times_s) == 0:
            return np.ones(0)
        if times_s.min() < self._marks[0][0]:  # long forgotten: all over again
            self._marks, self._pieces = [(0.0, self._model.start(1))], []
        self._extend(float(times_s.max()))
        if self._all is None:
            whole = (np.concatenate(parts) for parts in zip(*self._pieces, strict=True))
            self._all = next(whole), next(whole)
        times, ratios = self._all
        smooth = np.interp(times_s, times, ratios) if len(times) else np.ones(len(times_s))
        return smooth * self._chance(times_s, smooth * self._load(self._since(times_s)))

    def prepare(self, t_s: float) -> None:
        """Go on, if need be, so that times soon after `t_s` cost nothing."""
        if t_s + _AHEAD_S / 2 > self._marks[-1][0]:
            self._extend(t_s + _AHEAD_S / 2)

    def _extend(self, until_s: float) -> None:
        """Go on to beyond `until_s`."""
        reached, state = self._marks[-1]
        if self._pieces and until_s <= reached:
            return
        end = max(until_s, reached) + _AHEAD_S
        times = self._between(reached, end)
        loads, warmth = self._load(self._since(times)), self._warmer_k(times)
        powered = self._powered(times)
        state = state.copy()
        apparent = np.empty(len(times))
        for i, dt_s in enumerate(np.diff(times, prepend=reached).round(6).tolist()):
            step: SheetStep = self._step(dt_s)
            apparent[i] = step.forward(state, loads[i : i + 1], powered[i], warmth[i])[0]
        pressed = loads > 0
        self._pieces.append((times[pressed], apparent[pressed] / loads[pressed]))
        self._marks.append((end, state))
        if len(self._pieces) > _MOST_PIECES:
            del self._marks[: _MOST_PIECES // 2], self._pieces[: _MOST_PIECES // 2]
        self._all = None

    def _between(self, start: float, end: float) -> FloatArray:
        """Knots after `start` up to `end`, which is one of them."""
        if np.isfinite(self._round_s):
            rounds = np.arange(start // self._round_s, end // self._round_s + 1)
            within = self._knots[self._knots < self._round_s]
            knots = (rounds[:, None] * self._round_s + within).ravel()
        else:
            knots = self._knots
        even = np.arange(start, end, _LONGEST_S)[1:]
        switched = [t for t, _ in self._power]
        every = np.concatenate([knots, even, switched])
        every = np.unique(np.append(every[(every > start) & (every < end)], end).round(4))
        return every[every > start]

    def _powered(self, times_s: FloatArray) -> NDArray[np.bool_]:
        """Whether there was potential in the intervals that end at times (n,)."""
        at = np.searchsorted([t for t, _ in self._power], times_s, side="left")
        return np.array([True, *(on for _, on in self._power)])[at]

    def _chance(self, times_s: FloatArray, reading_n: FloatArray) -> FloatArray:
        """What no model undoes: one press differs from another, and contacts flicker."""
        of = self._fluctuation
        factor = np.ones(len(times_s))
        if of.press_std and len(self._begins):
            press = np.searchsorted(self._begins, self._since(times_s), side="right")
            if np.isfinite(self._round_s):
                press = press + (len(self._begins) + 1) * (times_s // self._round_s).astype(np.int64)
            factor *= np.exp(of.press_std * noise.normal(self._key, press))
        if of.noise_std:
            at = times_s / of.noise_time_s
            before = np.floor(at)
            part, first = at - before, before.astype(np.int64)
            low, high = (noise.normal(self._key + np.uint64(1), first + i) for i in (0, 1))
            flicker = ((1 - part) * low + part * high) / np.hypot(part, 1 - part)
            factor *= np.exp(of.noise_std / np.sqrt(np.maximum(reading_n, 1e-3)) * flicker)
        return factor

    def _since(self, times_s: FloatArray) -> FloatArray:
        return times_s % self._round_s if np.isfinite(self._round_s) else times_s
