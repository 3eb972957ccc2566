"""Behaviour of sheets under constant loads: hysteresis, adaptation, creep, temperature.

Public name: `HistoryStage`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


class HistoryStage:
    """Sheets (n,) of one law. Both arguments are by name, flat memory of what `SheetLaw` and `SheetStates`
    describe; `law` has numbers besides."""

    def __init__(self, law: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
        self.preload_n_per_k, self.gain_per_k = law["preload_n_per_k"], law["gain_per_k"]
        self.instant, self.threshold_n = law["instant"], law["threshold_n"]
        self.recovery_s, self.fatigue_s = law["recovery_s"], law["fatigue_s"]
        self.wipe_fraction, self.has_loops = law["wipe_fraction"], law["has_loops"]
        self.exponent, self.linear, self.play_weight = law["exponent"], law["linear"], law["play_weight"]
        self.plays_n, self.weights, self.times_s = law["plays_n"], law["weights"], law["times_s"]
        self.shares, self.back_times_s = law["shares"], law["back_times_s"]
        self.plays, self.elements, self.speeds = len(self.plays_n), len(self.weights), len(self.shares)
        self.turning_n, self.turns = arrays["turning_n"], arrays["turns"]
        self.back_n, self.creep_n = arrays["back_n"], arrays["creep_n"]
        self.peak_n, self.flow_s = arrays["peak_n"], arrays["flow_s"]
        self.depth = len(self.turning_n) // len(self.turns)

    def advance(
        self,
        sheets: memoryview[int],
        dt_s: memoryview[float],
        load_n: memoryview[float],
        excited: memoryview[int],
        warmer_k: memoryview[float],
        apparent_n: memoryview[float],
    ) -> None:
        """Write the apparent loads at the ends of intervals (k,), one after another, each of one sheet."""
        for k in range(len(sheets)):
            apparent_n[k] = _advance(self, sheets[k], dt_s[k], load_n[k], excited[k], warmer_k[k])


def _advance(
    stage: HistoryStage, sheet: int, dt_s: float, load_n: float, excited: int, warmer_k: float
) -> float:
    """Return the apparent load at the end of an interval."""
    load = max(load_n + stage.preload_n_per_k * warmer_k, 0.0)
    if stage.has_loops:
        load = _apply_loops(stage, sheet, load)
    effective = _adapt(stage, sheet, dt_s, load, excited)
    crept, first = 0.0, sheet * stage.elements
    for i in range(stage.elements):
        part = stage.creep_n[first + i]
        part -= (effective - part) * math.expm1(-dt_s / stage.times_s[i])
        part = min(part, effective)  # a release is abrupt
        stage.creep_n[first + i] = part
        crept += stage.weights[i] * part
    apparent: float = (stage.instant * effective + crept) * (1.0 + stage.gain_per_k * warmer_k)
    return apparent


def _adapt(stage: HistoryStage, sheet: int, dt_s: float, load_n: float, excited: int) -> float:
    """Return the effective load at the end of an interval."""
    first = sheet * stage.speeds
    back = _sum_back(stage, first)
    flows = excited and load_n - back > stage.threshold_n
    if flows:
        speed = 1.0 + (stage.flow_s[sheet] + dt_s / 2.0) / stage.fatigue_s  # integrated over dt
        for i in range(stage.speeds):
            change = stage.shares[i] * load_n - stage.back_n[first + i]
            stage.back_n[first + i] -= change * math.expm1(-dt_s * speed / stage.back_times_s[i])
        stage.flow_s[sheet] += dt_s
        back = _sum_back(stage, first)
    if not excited:
        left = math.exp(-dt_s / stage.recovery_s)
        for i in range(stage.speeds):
            stage.back_n[first + i] *= left
        back = _sum_back(stage, first)
    pressed = load_n > stage.threshold_n
    if not pressed and 0.0 < stage.peak_n[sheet] < stage.wipe_fraction * back:
        for i in range(stage.speeds):
            stage.back_n[first + i] = 0.0
    stage.peak_n[sheet] = max(stage.peak_n[sheet], load_n) if pressed else 0.0
    return load_n - back if flows else 0.0


def _sum_back(stage: HistoryStage, first: int) -> float:
    total = 0.0
    for i in range(stage.speeds):
        total += stage.back_n[first + i]
    return total


def _apply_loops(stage: HistoryStage, sheet: int, load_n: float) -> float:
    """Return the reading of the hysteresis under a load, and update its turning points."""
    first, points = sheet * stage.depth, stage.turning_n
    last = first + stage.turns[sheet] - 1
    while last > first:
        swing = points[last] - points[last - 1]
        is_continued = swing * (load_n - points[last]) >= 0.0
        is_wiped_out = swing * (load_n - points[last - 1]) <= 0.0
        if not (is_continued or is_wiped_out):
            break
        last -= 1
    if load_n != points[last]:
        if last < first + stage.depth - 1:
            last += 1
        points[last] = load_n  # of too many, the last and smallest swing is forgotten
    stage.turns[sheet] = last - first + 1
    total = 0.0
    for at in range(first, last):
        if points[at + 1] > points[at]:
            total += _swing(stage, points[at + 1], points[at])
        else:
            total -= _swing(stage, points[at], points[at + 1])
    return total


def _swing(stage: HistoryStage, high_n: float, low_n: float) -> float:
    """Return the change of the reading between two turning points: the Everett function, of homogeneous loops
    or of plays."""
    if stage.exponent > 0.0:
        if not high_n > low_n:
            return 0.0
        return high_n * math.exp(stage.exponent * math.log(1.0 - low_n / high_n))
    swing = high_n - low_n
    beyond = 0.0
    for i in range(stage.plays):
        if swing > stage.plays_n[i]:
            beyond += swing - stage.plays_n[i]
    reading: float = stage.linear * swing + stage.play_weight * beyond
    return reading
