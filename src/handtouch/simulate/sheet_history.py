"""History of a pad's sheet under load: ratio of apparent to true force over time.

Public names: `SimulatedSheetHistory`, `random_factor`. It integrates a `SheetLaw` between knots that are
dense where the load changes and sparse elsewhere; the laws are exact under constant load, so an idle hour is
a single step. It is integrated only as far as requested; results don't depend on the order of requests.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.simulate import noise
from handtouch.simulate.sheet_physics import SheetLaw, SheetStates

_LOOK_AHEAD_S = 0.5  # short, so that a live hand doesn't pause for it
_MAX_SEGMENTS = 64
_SETTLING_KNOTS_S = np.cumsum(0.02 * 1.35 ** np.arange(21.0))  # after a change of the load: 20 ms to 30 s
_MAX_KNOT_INTERVAL_S = 30.0
_MIN_KNOT_INTERVAL_S = 4e-3


class SimulatedSheetHistory:
    """State of one sheet over time.

    total_force_n: (n,) at times (n,) of the scenario; temperature_rise_k: (n,) at times since the start.
    event_times_s: times of the scenario at which the force is sampled; those after which the sheet settles;
    those at which a press begins.
    """

    def __init__(
        self,
        law: SheetLaw,
        key: np.uint64,
        total_force_n: Callable[[FloatArray], FloatArray],
        temperature_rise_k: Callable[[FloatArray], FloatArray],
        event_times_s: tuple[FloatArray, FloatArray, FloatArray],
        repeat_period_s: float,
        begin_s: float = 0.0,
    ) -> None:
        self._law, self._noise_key = law, key
        self._total_force_n, self._temperature_rise_k = total_force_n, temperature_rise_k
        self._begin_s = begin_s
        force_times_s, settling_times_s, press_begins_s = event_times_s
        self._repeat_period_s, self._press_begins_s = repeat_period_s, np.sort(press_begins_s)
        times = np.concatenate([force_times_s, (settling_times_s[:, None] + _SETTLING_KNOTS_S).ravel()])
        self._knots = np.unique(np.ceil(times / _MIN_KNOT_INTERVAL_S) * _MIN_KNOT_INTERVAL_S)
        self._excitation_switches: list[tuple[float, bool]] = []
        self._checkpoints: list[tuple[float, SheetStates]] = [(self._begin_s, SheetStates(self._law))]
        self._segments: list[tuple[FloatArray, FloatArray]] = []  # after each checkpoint: times, ratios
        self._force_ratios: tuple[FloatArray, FloatArray] | None = None

    def switch_excitation(self, t_s: float, on: bool) -> None:
        """Switch the excitation at `t_s`, later than any switch before; it is on from the start.

        Ratios returned earlier for times after `t_s` become invalid.
        """
        keep = max(int(np.searchsorted([time_s for time_s, _ in self._checkpoints], t_s, side="right")), 1)
        del self._checkpoints[keep:], self._segments[keep - 1 :]
        if t_s < self._checkpoints[0][0]:
            self._checkpoints, self._segments = [(self._begin_s, SheetStates(self._law))], []
        self._excitation_switches.append((t_s, on))
        self._force_ratios = None

    def force_ratio(self, times_s: FloatArray, total_force_n: FloatArray | None = None) -> FloatArray:
        """Return apparent over true force at times (n,) of contact.

        total_force_n: (n,), force on the sheet where it is known; left out: that of the touches and faults.
        """
        if len(times_s) == 0:
            return np.ones(0)
        if times_s.min() < self._checkpoints[0][0]:  # before the oldest checkpoint: start again
            self._checkpoints, self._segments = [(self._begin_s, SheetStates(self._law))], []
        self._extend_to(float(times_s.max()))
        if self._force_ratios is None:
            whole = (np.concatenate(parts) for parts in zip(*self._segments, strict=True))
            self._force_ratios = next(whole), next(whole)
        times, ratios = self._force_ratios
        smooth = np.interp(times_s, times, ratios) if len(times) else np.ones(len(times_s))
        if total_force_n is None:
            total_force_n = self._total_force_n(self._scenario_time_s(times_s))
        return smooth * self._random_factor(times_s, smooth * total_force_n)

    def extend_ahead(self, t_s: float) -> None:
        """Integrate in advance, so that times soon after `t_s` need no computation."""
        if t_s + _LOOK_AHEAD_S / 2 > self._checkpoints[-1][0]:
            self._extend_to(t_s + _LOOK_AHEAD_S / 2)

    def _extend_to(self, until_s: float) -> None:
        """Integrate to beyond `until_s`."""
        reached, state = self._checkpoints[-1]
        if self._segments and until_s <= reached:
            return
        end = max(until_s, reached) + _LOOK_AHEAD_S
        times = self._knots_between(reached, end)
        force_n, rise_k = self._total_force_n(self._scenario_time_s(times)), self._temperature_rise_k(times)
        state, steps_s = state.copy(), np.diff(times, prepend=reached).round(6)
        one = np.zeros(len(times), np.intp)
        apparent = state.advance(one, steps_s, force_n, self._excitation_on(times), rise_k)
        pressed = force_n > 0
        self._segments.append((times[pressed], apparent[pressed] / force_n[pressed]))
        self._checkpoints.append((end, state))
        if len(self._segments) > _MAX_SEGMENTS:
            del self._checkpoints[: _MAX_SEGMENTS // 2], self._segments[: _MAX_SEGMENTS // 2]
        self._force_ratios = None

    def _knots_between(self, start: float, end: float) -> FloatArray:
        """Return the knots after `start` up to and including `end`."""
        if np.isfinite(self._repeat_period_s):
            passes = np.arange(start // self._repeat_period_s, end // self._repeat_period_s + 1)
            within = self._knots[self._knots < self._repeat_period_s]
            knots = (passes[:, None] * self._repeat_period_s + within).ravel()
        else:
            knots = self._knots
        even = np.arange(start, end, _MAX_KNOT_INTERVAL_S)[1:]
        switches = [t for t, _ in self._excitation_switches]
        merged = np.concatenate([knots, even, switches])
        merged = np.unique(np.append(merged[(merged > start) & (merged < end)], end).round(4))
        return merged[merged > start]

    def _excitation_on(self, times_s: FloatArray) -> NDArray[np.bool_]:
        """Return whether excitation was on in the intervals that end at times (n,)."""
        index = np.searchsorted([t for t, _ in self._excitation_switches], times_s, side="left")
        return np.array([True, *(on for _, on in self._excitation_switches)])[index]

    def _random_factor(self, times_s: FloatArray, apparent_n: FloatArray) -> FloatArray:
        """Return the random part of the ratio: variation between presses, and contact noise."""
        if not len(self._press_begins_s):
            return random_factor(self._law, self._noise_key, times_s, apparent_n, None)
        press = np.searchsorted(self._press_begins_s, self._scenario_time_s(times_s), side="right")
        if np.isfinite(self._repeat_period_s):
            press = press + (len(self._press_begins_s) + 1) * (times_s // self._repeat_period_s).astype(
                np.int64
            )
        return random_factor(self._law, self._noise_key, times_s, apparent_n, press)

    def _scenario_time_s(self, times_s: FloatArray) -> FloatArray:
        return times_s % self._repeat_period_s if np.isfinite(self._repeat_period_s) else times_s


def random_factor(
    law: SheetLaw,
    key: np.uint64 | NDArray[np.uint64],
    times_s: FloatArray,
    apparent_n: FloatArray,
    press: NDArray[np.int64] | None,
) -> FloatArray:
    """Return the random part of apparent over true force (n,) at times and apparent forces (n,).

    `key`: () or (n,), of each sheet. `press`: (n,), number of the press, for its variation; None: without it.
    """
    factor = np.ones(len(times_s))
    if law.press_std and press is not None:
        factor *= np.exp(law.press_std * noise.standard_normal(key, press))
    if law.noise_std:
        steps = times_s / law.noise_time_s
        before = np.floor(steps)
        part, first = steps - before, before.astype(np.int64)
        low, high = noise.standard_normal(key + np.uint64(1), np.stack([first, first + 1]))
        flicker = ((1 - part) * low + part * high) / np.hypot(part, 1 - part)
        factor *= np.exp(law.noise_std / np.sqrt(np.maximum(apparent_n, 1e-3)) * flicker)
    return factor
