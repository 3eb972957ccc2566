"""Friction ratio of contacts, tangential over normal force: learned limit, incipient slip before motion.

Public names: `FrictionLimit`, `FrictionMonitor` -> `FrictionState`.

A contact sticks while the ratio of tangential to normal force is below the limit of friction. Sticking raises
a lower bound of the limit, and a slip that was observed otherwise, by position, states it. The limit is
learned in ratios as they are measured: what is wrong with a pad's stiffness is the same in both and cancels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

FloatArray = NDArray[np.float64]

PRIOR_LOG_STD = 0.35
"""Standard deviation of ln(limit) before anything is known: objects differ by that, and so do pads."""
_SLIP_LOG_STD = 0.08  # of one observed slip: the limit varies over an object and between pads
_STICK_LOG_STD = 0.05  # noise of the ratio of a contact that sticks
_STUCK_SHARE = 0.7  # of the ratio of a slip: what stuck above it, stuck on another spot
_RATE_TIME_S = 0.02  # smoothing of the ratio's rate
_HORIZON_S = 0.03
_MIN_NORMAL_SIGMA = 3.0  # normal force in its standard deviations, below which there is no ratio
_STICK_S = 0.1  # a ratio that a contact held for so long stuck; a faster rise teaches nothing yet
_ALARM, _CLEAR = 0.3, 0.15  # probability of incipient slip that raises and clears it
_MAX_GAP_S = 0.1


_NOTHING_HELD = (math.nan, math.nan)


@dataclass(frozen=True)
class FrictionLimit:
    """Belief about the limit of friction: ln(limit) is normal, above the greatest ratio that stuck.

    mean, log_std: of the normal part. stuck: greatest ratio without slip, 0 at first.
    """

    mean: float = 0.8
    log_std: float = PRIOR_LOG_STD
    stuck: float = 0.0

    def after_sticking(self, ratio: float) -> FrictionLimit:
        """Return the belief after a contact stuck at a ratio."""
        return replace(self, stuck=max(self.stuck, ratio))

    def after_slip(self, ratio: float) -> FrictionLimit:
        """Return the belief after a contact began to slip at a ratio; earlier bounds above it are dropped.

        Raises ValueError for a ratio that isn't positive.
        """
        if not ratio > 0:
            raise ValueError(f"ratio must be positive, got {ratio}")
        before, now = self.log_std**-2, _SLIP_LOG_STD**-2
        mean = (before * math.log(self.mean) + now * math.log(ratio)) / (before + now)
        spread = max((before + now) ** -0.5, _SLIP_LOG_STD / 2)
        return FrictionLimit(math.exp(mean), spread, min(self.stuck, _STUCK_SHARE * ratio))

    def probability_below(self, ratio: float) -> float:
        """Return the probability that the limit is below a ratio, given that `stuck` stuck."""
        if ratio <= 0:
            return 0.0
        width = math.hypot(self.log_std, _STICK_LOG_STD)
        above = float(log_ndtr((math.log(self.mean) - math.log(ratio)) / width))
        if self.stuck > 0:
            above -= float(log_ndtr((math.log(self.mean) - math.log(self.stuck)) / width))
        return -math.expm1(min(above, 0.0))


@dataclass(frozen=True, slots=True)
class FrictionState:
    """Friction of one contact at one sample.

    ratio, ratio_std: tangential over normal force. rate_per_s: of the ratio. margin: 1 - ratio / limit, below
    0 beyond the mean limit. probability: that the limit is reached within 30 ms at this rate. label:
    "unknown" without a ratio, "sticking" or "incipient".
    """

    ratio: float
    ratio_std: float
    rate_per_s: float
    margin: float
    probability: float
    label: str


_UNKNOWN = FrictionState(math.nan, math.nan, 0.0, math.nan, 0.0, "unknown")


class FrictionMonitor:
    """Friction of the contacts on n pads of one hand, which hold one object with one limit.

    `limit` is what is known of it; assign a new `FrictionLimit` for another object.
    """

    def __init__(self, pads: int, limit: FrictionLimit | None = None) -> None:
        self.limit = limit or FrictionLimit()
        self._time_s = [math.nan] * pads
        self._ratio = [math.nan] * pads
        self._rate = [0.0] * pads
        self._alarmed = [False] * pads
        self._held: list[tuple[float, float]] = [_NOTHING_HELD] * pads

    def end_contact(self, pad: int) -> None:
        """Forget the contact on a pad."""
        self._time_s[pad] = self._ratio[pad] = math.nan
        self._rate[pad], self._alarmed[pad], self._held[pad] = 0.0, False, _NOTHING_HELD

    def confirm_slip(self, pad: int) -> None:
        """Learn from a slip on a pad that was observed by its motion: the ratio there is the limit."""
        if self._ratio[pad] > 0:
            self.limit = self.limit.after_slip(self._ratio[pad])

    def update(
        self,
        pad: int,
        t_s: float,
        force_n: Sequence[float] | FloatArray,
        covariance_n2: FloatArray,
        normal_n: float,
        normal_std_n: float,
        *,
        slips: bool = False,
    ) -> FrictionState:
        """Process a sample: tangential force (2,) with covariance (2, 2), normal force with its standard
        deviation; `slips`: its motion shows a slip, so that it teaches no bound.
        """
        fx, fy = np.asarray(force_n, np.float64).tolist()
        if not (normal_n > _MIN_NORMAL_SIGMA * normal_std_n and math.isfinite(fx + fy)):
            self.end_contact(pad)
            return _UNKNOWN
        size = math.hypot(fx, fy)
        ratio = size / normal_n
        way = np.array([fx, fy]) / size if size > 0 else np.array([1.0, 0.0])
        spread = math.hypot(
            math.sqrt(float(way @ covariance_n2 @ way)) / normal_n, ratio * normal_std_n / normal_n
        )
        elapsed = t_s - self._time_s[pad]
        if 0 < elapsed < _MAX_GAP_S:
            share = -math.expm1(-elapsed / _RATE_TIME_S)
            self._rate[pad] += share * ((ratio - self._ratio[pad]) / elapsed - self._rate[pad])
        else:
            self._rate[pad] = 0.0
        self._time_s[pad], self._ratio[pad] = t_s, ratio
        ahead = ratio + _HORIZON_S * max(self._rate[pad], 0.0)
        probability = self.limit.probability_below(ahead)
        self._alarmed[pad] = probability > (_CLEAR if self._alarmed[pad] else _ALARM)
        self._learn_sticking(pad, t_s, ratio, sticks=not (slips or self._alarmed[pad]))
        label = "incipient" if self._alarmed[pad] else "sticking"
        return FrictionState(ratio, spread, self._rate[pad], 1 - ratio / self.limit.mean, probability, label)

    def _learn_sticking(self, pad: int, t_s: float, ratio: float, *, sticks: bool) -> None:
        """Learn the least ratio of each span of `_STICK_S` in which a contact sticks."""
        begin_s, least = self._held[pad]
        if not sticks or math.isnan(begin_s):
            self._held[pad] = (t_s, ratio) if sticks else _NOTHING_HELD
        elif t_s - begin_s < _STICK_S:
            self._held[pad] = begin_s, min(least, ratio)
        else:
            self.limit = self.limit.after_sticking(least)
            self._held[pad] = t_s, ratio
