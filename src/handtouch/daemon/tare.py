"""Tare: what the channels of a pad read that nothing touches, measured over a second and then taken off.

Public names: `Tare`. A job of the control endpoint: it looks at every tick, and never waits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.daemon.model import PadModel
from handtouch.daemon.pacer import Pacer
from handtouch.daemon.tick import Tick
from handtouch.wire import PadState

_SECOND_NS = 1_000_000_000
_LEAST_SAMPLES = 8
_NOISY = 3.0
"""Times its noise that a channel may scatter."""
_OFF = 3.0
"""Standard deviations that a mean may be from the baseline, besides what drift may have done."""


class Tare:
    """Measures the pads `chosen` (n,) and tares those that prove to be unloaded."""

    def __init__(
        self,
        names: list[tuple[str, str]],
        chosen: NDArray[np.bool_],
        tick: Tick,
        pacer: Pacer,
        now_ns: int,
        tared: Callable[[int], None] = lambda _: None,
    ) -> None:
        """tared: is called with the row of each pad that was tared."""
        self._names, self._chosen, self._tick, self._pacer = names, chosen, tick, pacer
        self._tared = tared
        self._end_ns = now_ns + max(_SECOND_NS, 10 * int(tick.period_ns.max()))
        self._samples = tick.samples.copy()
        self._count = np.zeros(len(names), dtype=np.int64)
        self._sum = np.zeros((len(names), 4))
        self._squares = np.zeros((len(names), 4))
        self._first = tick.counts.astype(np.float64)  # sums are of what differs from it: no digits are lost
        self._touched = np.zeros(len(names), dtype=np.bool_)
        pacer.attend(chosen, now_ns)

    def poll(self, now_ns: int) -> dict[str, Any] | None:
        """Take in the tick's samples; after a second, the result of every pad."""
        tick, chosen = self._tick, self._chosen
        self._pacer.attend(chosen, now_ns)
        new = chosen & (tick.samples != self._samples)
        self._samples[:] = tick.samples
        self._count += new
        differs = np.where(new[:, None], tick.counts - self._first, 0.0)
        self._sum += differs
        self._squares += differs**2
        self._touched |= tick.contacts.touching
        if now_ns < self._end_ns:
            return None
        return {"pads": [self._finish(pad, tick.model) for pad in np.flatnonzero(chosen).tolist()]}

    def _finish(self, pad: int, model: PadModel) -> dict[str, Any]:
        hand, link = self._names[pad]
        before = self._tick.baseline.expected[pad].copy()
        told = {
            "hand": hand,
            "link": link,
            "samples": int(self._count[pad]),
            "offset_counts": before.tolist(),
        }
        count = int(self._count[pad])
        if count < _LEAST_SAMPLES:
            state = PadState(int(self._tick.columns.state[pad])).name.lower()
            why = f"{count} samples came in a second, it takes {_LEAST_SAMPLES}; the pad is {state}"
            return {**told, "tared": False, "reason": why}
        part = self._sum[pad] / count
        mean = self._first[pad] + part
        std = np.sqrt(np.maximum(self._squares[pad] / count - part**2, 0.0))
        told |= {"mean_counts": mean.tolist(), "std_counts": std.tolist()}
        if why := self._trouble(pad, model, mean, std):
            return {**told, "tared": False, "reason": why}
        self._tick.assume(pad, mean, std / np.sqrt(count))
        self._tick.forget(np.array([pad]))
        self._tared(pad)
        return {**told, "tared": True, "reason": "", "offset_counts": mean.tolist()}

    def _trouble(self, pad: int, model: PadModel, mean: NDArray[np.float64], std: NDArray[np.float64]) -> str:
        """Why the pad can't be tared; empty if it can."""
        if self._touched[pad]:
            return "it was touched; take the load off and tare again"
        noise = float(model.noise_counts[pad])
        worst = int(np.argmax(std))
        if std[worst] > _NOISY * noise:
            return (
                f"channel {ELECTRODES[worst]} scatters by {std[worst]:.1f} counts, its noise is {noise:.1f}: "
                "something moves on it or disturbs it"
            )
        # whatever adds up to less than what ends a contact could be no contact that is to be kept
        baseline = self._tick.baseline
        moved = np.abs(mean - baseline.expected[pad]).sum()
        allowed = model.off_counts[pad] + _OFF * np.hypot(noise, baseline.std[pad])
        if moved > allowed:
            return (
                f"its channels are {moved:.0f} counts from their baseline, noise and drift explain "
                f"{allowed:.0f}: take the load off; if there is none, look at the pad, and give its offsets "
                "by `handtouch calibrate`"
            )
        return ""
