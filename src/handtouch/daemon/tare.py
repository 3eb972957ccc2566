"""Tare: measure the offsets of unloaded pads over one second and set their baselines to them.

Public names: `TareJob`. A job of the control endpoint that reads every tick and never blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.core.baseline import TRACKING_TIME_S
from handtouch.core.events import BaselineEvent
from handtouch.core.least_threshold import begin_samples, least_begin_counts, level_scatter
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.stages.rows import SHEAR_CHANNELS
from handtouch.daemon.sampling import SamplingController
from handtouch.daemon.shear_channels import ShearChannels
from handtouch.wire import PadState

_MIN_DURATION_NS = 1_000_000_000
_MIN_SAMPLES = 8
_MAX_STD_PER_NOISE = 3.0
"""Largest standard deviation of a channel, in multiples of its noise"""
_MAX_OFFSET_SIGMA = 3.0
"""Largest offset of a mean from the baseline, in standard deviations"""


class TareJob:
    """Measures the `selected` pads (n,) and tares those that are unloaded."""

    def __init__(
        self,
        names: list[tuple[str, str]],
        selected: NDArray[np.bool_],
        pipeline: Pipeline,
        pacer: SamplingController,
        now_ns: int,
        on_tared: Callable[[int, tuple[float, ...]], None] = lambda _, __: None,
    ) -> None:
        """Start measuring; `on_tared` is called with the row and the offsets (c,) of each tared pad."""
        self._names, self._selected, self._sampling = names, selected, pacer
        self._pipeline, self._tick = pipeline, pipeline.tick
        tick = self._tick
        self._on_tared = on_tared
        self._end_ns = now_ns + max(_MIN_DURATION_NS, 10 * int(tick.state.max_sample_period_ns.max()))
        self._samples = tick.state.sample_counts.copy()
        self._count = np.zeros(len(names), dtype=np.int64)
        self._sum = np.zeros(tick.counts.shape)
        self._sum_of_squares = np.zeros(tick.counts.shape)
        self._reference_counts = tick.counts.astype(
            np.float64
        )  # sums are of differences from it, to keep precision
        self._touched = np.zeros(len(names), dtype=np.bool_)
        self._levels: list[list[int]] = [[] for _ in names]
        """sums of the channels of each pad's samples"""
        self._all_sum = np.zeros(tick.channel_counts.shape)
        self._saturated = np.zeros(tick.channel_counts.shape, dtype=np.bool_)
        pacer.request_full_rate(selected, now_ns)

    def poll(self, now_ns: int) -> dict[str, Any] | None:
        """Add the tick's samples; after a second, return the result of every pad."""
        tick, selected = self._tick, self._selected
        self._sampling.request_full_rate(selected, now_ns)
        new = selected & (tick.state.sample_counts != self._samples)
        self._samples[:] = tick.state.sample_counts
        self._count += new
        difference = np.where(new[:, None], tick.counts - self._reference_counts, 0.0)
        self._sum += difference
        self._sum_of_squares += difference**2
        for pad in np.flatnonzero(new).tolist():
            self._levels[pad].append(int(tick.counts[pad].sum()))
        # a load since the start, of unknown zeros, is what the user says it is: none
        self._touched |= tick.state.touching & tick.state.known
        self._all_sum += tick.channel_counts * new[:, None]
        self._saturated |= self._pipeline.slab.saturated(tick.channel_counts) & new[:, None]
        if now_ns < self._end_ns:
            return None
        return {"pads": [self._finish_pad(pad, tick.model) for pad in np.flatnonzero(selected).tolist()]}

    def _finish_pad(self, pad: int, model: PadModel) -> dict[str, Any]:
        hand, link = self._names[pad]
        own = slice(int(model.electrode_counts[pad]))
        before = self._tick.baseline.expected_counts[pad, own].copy()
        result = {
            "hand": hand,
            "link": link,
            "samples": int(self._count[pad]),
            "offset_counts": before.tolist(),
        }
        count = int(self._count[pad])
        if count < _MIN_SAMPLES:
            state = PadState(int(self._tick.columns.state[pad])).name.lower()
            why = f"{count} samples in one second, at least {_MIN_SAMPLES} needed; the pad is {state}"
            return {**result, "tared": False, "reason": why}
        part = self._sum[pad, own] / count
        mean = self._reference_counts[pad, own] + part
        std = np.sqrt(np.maximum(self._sum_of_squares[pad, own] / count - part**2, 0.0))
        result |= {"mean_counts": mean.tolist(), "std_counts": std.tolist()}
        if why := self._refusal_reason(pad, model, mean, std):
            return {**result, "tared": False, "reason": why}
        offsets, spread = tuple(mean.tolist()), tuple((std / np.sqrt(count)).tolist())
        at_rest: tuple[float, ...] = ()
        if self._tick.shear.has_shear(pad):
            at_rest = tuple((self._all_sum[pad, self._shear_columns(pad)] / count).tolist())
        second: tuple[float, ...] = ()
        if self._tick.second.has_second(pad):
            mean_count = float(self._all_sum[pad, self._tick.second.column(pad)]) / count
            second = mean_count, float(model.noise_counts[pad]) / math.sqrt(count)
        self._pipeline.add_event(BaselineEvent(pad, offsets, spread, at_rest, second))
        self._on_tared(pad, offsets)
        return {
            **result,
            "tared": True,
            "reason": "",
            "offset_counts": mean.tolist(),
            "second_offset_counts": second[0] if second else None,
            "begin_threshold_n": float(model.touch.begin_threshold_n[pad]),
            "least_begin_threshold_n": self._least_begin_n(pad, model),
        }

    def _shear_columns(self, pad: int) -> slice:
        """Return the columns of the channels of the shear pad beneath a pad."""
        first = next(shear.column for shear in self._tick.model.shear_pads if shear.pad == pad)
        return slice(first, first + SHEAR_CHANNELS)

    def _least_begin_n(self, pad: int, model: PadModel) -> float | None:
        """Return the least threshold of a pad by its noise now and its drift so far [N]; None for too few
        samples."""
        period_ns = self._pipeline.cycle.period_ns
        count = begin_samples(float(model.touch.begin_ms[pad]), period_ns)
        noise = level_scatter(np.array(self._levels[pad], np.float64), count)
        lag = TRACKING_TIME_S * float(self._tick.baseline.drift_speed[pad])
        least = least_begin_counts(math.hypot(noise, lag), 1e9 / period_ns)
        return None if math.isnan(least) else model.centre_force(pad, least)

    def _refusal_reason(
        self, pad: int, model: PadModel, mean: NDArray[np.float64], std: NDArray[np.float64]
    ) -> str:
        """Return why the pad can't be tared; empty if it can."""
        if self._touched[pad]:
            return "touched during the measurement; remove the load and tare again"
        noise = float(model.noise_counts[pad])
        if self._tick.shear.has_shear(pad):
            columns = self._shear_columns(pad)
            status = ShearChannels().update(
                pad,
                0,
                np.rint(self._all_sum[pad, columns] / self._count[pad]).astype(np.int64),
                self._saturated[pad, columns],
                noise,
                touched=False,
                rest_known=True,
            )
            if status != "operational":
                return f"a channel of its shear pad is {status}, so that it has no rest position; inspect it"
        worst = int(np.argmax(std))
        if std[worst] > _MAX_STD_PER_NOISE * noise:
            return (
                f"channel {model.electrodes[pad][worst]}: standard deviation {std[worst]:.1f} counts, noise "
                f"{noise:.1f}: varying load or electrical interference; remove it and tare again"
            )
        # an offset below the end threshold can't hide a contact
        baseline = self._tick.baseline
        moved = np.abs(mean - baseline.expected_counts[pad, : len(mean)]).sum()
        allowed = model.end_threshold_counts[pad] + _MAX_OFFSET_SIGMA * np.hypot(noise, baseline.std[pad])
        if moved > allowed and self._tick.state.known[pad]:
            return (
                f"offset of {moved:.0f} counts from the baseline, noise and drift explain {allowed:.0f}: "
                "remove the load; if there is none, inspect the pad and set its offsets with "
                "`handtouch calibrate`"
            )
        return ""
