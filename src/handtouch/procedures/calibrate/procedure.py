"""Guided procedure with an operator who places weights on a pad: tare, then one weight after another.

No clock, socket, file or terminal: samples carry their times, texts go to a `Dialogue`.

Public names: `WeightProcedure`, `PadSample`, `SampledPad`, `SettlingDetector`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from handtouch.procedures.calibrate.readings import PadCircuitModel, Weight, WeightReading
from handtouch.procedures.dialogue import Dialogue, DialogueCancelled, GuidedProcedure, Key

_SECOND_NS = 1_000_000_000
_CREEP_DELAY_NS = _SECOND_NS  # after about a second a sheet carries its full current
_MEAN_DURATION_NS = _SECOND_NS  # averaged for a reading
_BATCH_COUNT = 10  # noise is correlated for some 50 ms: means of batches are independent, samples aren't
_MAX_SETTLED_DRIFT, _MAX_SETTLED_DRIFT_SIGMA = (
    0.005,
    3.0,
)  # more drift than this fraction, or standard errors, is creep
_MIN_SAMPLES = 2 * _BATCH_COUNT
_MIN_UNLOADED_NS = 300_000_000
_MAX_ATTEMPTS = 3
_SETTLING_TIMEOUT_NS = 15 * _SECOND_NS


@dataclass(frozen=True)
class PadSample:
    """Sample of a pad. alive: the pad delivers samples; total current [A]; if touched, contact position as
    arc lengths [m] and the daemon's force [N], NaN without one; current of a second sheet [A], NaN without
    one."""

    sync_ns: int
    alive: bool
    touched: bool = False
    current_a: float = 0.0
    position_m: tuple[float, float] = (math.nan, math.nan)
    force_n: float = math.nan
    second_current_a: float = math.nan


class SettledMeans(NamedTuple):
    """Means of a settled load as `WeightReading` has them."""

    current_a: float
    current_std_a: float
    samples: int
    position_m: tuple[float, float]
    reported_force_n: float
    second_current_a: float
    second_std_a: float
    loaded_s: float
    measured_s: float


class SampledPad(Protocol):
    """Pad as served by a daemon."""

    def samples(self) -> Iterator[PadSample]:
        """Yield samples endlessly, also while the pad delivers none."""

    def tare(self) -> str:
        """Zero the pad; return the reason of a refusal, empty if it was done."""


class _NoReading(Exception):  # noqa: N818
    """No usable reading in time; `str` is the reason."""


class WeightProcedure(GuidedProcedure[PadSample]):
    """Measures known weights on one pad, in the given order.

    timeout_s: of waiting for a weight or a key. `readings`: those so far.
    """

    def __init__(
        self,
        name: str,
        weights: Sequence[Weight],
        circuit_model: PadCircuitModel,
        pad: SampledPad,
        dialogue: Dialogue,
        *,
        timeout_s: float = 60.0,
    ) -> None:
        super().__init__(pad.samples(), dialogue, timeout_s)
        self.readings: list[WeightReading] = []
        self._name, self._weights, self._circuit_model = name, weights, circuit_model
        self._pad = pad

    def run(self) -> Iterator[WeightReading]:
        """Tare, then yield a reading of every weight; ends early when the operator quits."""
        try:
            self._tare_pad()
            skipped: set[Weight] = set()
            for number, weight in enumerate(self._weights, 1):
                if weight in skipped:
                    continue
                if self._measure_weight(f"[{number}/{len(self._weights)}]", weight):
                    yield self.readings[-1]
                else:
                    skipped.add(weight)
        except DialogueCancelled:  # quit; skip and again are handled per weight
            self.print_line("Quit; the readings so far are kept." if self.readings else "Quit.")

    def confirm(self, question: str) -> bool:
        """Return whether the operator confirms with Enter."""
        return self.ask_key(question) is Key.ENTER

    def _tare_pad(self) -> None:
        while True:
            self.print_line(f"Don't touch {self._name}: taring ...", "ask")
            reason = self._pad.tare()
            if not reason:
                self.print_line("  tared.", "good")
                return
            self.print_line(f"  not tared: {reason}", "bad")
            if self.ask_key("Enter or a: repeat, q: quit") not in (Key.ENTER, Key.AGAIN):
                raise DialogueCancelled(Key.QUIT)

    def _measure_weight(self, title: str, weight: Weight) -> bool:
        """Measure a weight once; return False to skip it from now on. Raises DialogueCancelled to quit."""
        while True:
            try:
                reading = self._measure_with_retries(title, weight)
            except _NoReading as failed:
                self.print_line(f"  {failed}.", "bad")
                key = self.ask_key(f"Enter or a: repeat, s: skip {weight.name}, q: quit")
            except DialogueCancelled as pressed:
                key = pressed.key
            else:
                self.readings.append(reading)
                self._report_reading(reading)
                return True
            if key is Key.QUIT:
                raise DialogueCancelled(key)
            if key is Key.SKIP:
                return False

    def _measure_with_retries(self, title: str, weight: Weight) -> WeightReading:
        rejection, unloaded_s = "", math.nan
        for _ in range(_MAX_ATTEMPTS):
            later_s = self._await_unloaded()
            unloaded_s = later_s if math.isnan(unloaded_s) else unloaded_s
            self.print_line(f"{title} place {weight.name} on the middle of {self._name}", "ask")
            reading, rejection = self._await_reading(weight)
            if not rejection:
                return replace(reading, unloaded_s=unloaded_s)
            self.print_line(f"  {rejection}; remove it and place it again.", "bad")
        raise _NoReading(rejection)

    def _await_reading(self, weight: Weight) -> tuple[WeightReading, str]:
        """Return the settled reading and its problem, if any. Raises _NoReading, DialogueCancelled."""
        settling = SettlingDetector()
        for sample, waited_ns in self.timed_samples():
            self.raise_on_key()
            settled = settling.add_sample(sample)
            self._show_progress(sample, settling)
            if settled is not None:
                reading = WeightReading(weight, **settled._asdict())
                return reading, self._circuit_model.rejection_reason(reading)
            since, has_mean = settling.loaded_ns, math.isfinite(settling.relative_drift)
            if since is not None and has_mean and sample.sync_ns - since > _SETTLING_TIMEOUT_NS:
                drift = f"{settling.relative_drift:.1%} a second"
                raise _NoReading(f"the reading doesn't settle ({drift}): is the weight stable?")
            if not has_mean and waited_ns > self._timeout_ns:
                raise _NoReading(self._reason_without_mean(sample))
        raise _NoReading("the samples ended")

    def _reason_without_mean(self, sample: PadSample) -> str:
        """Return why there is no mean of a load in time, by the last sample."""
        if not sample.alive:
            return f"{self._name} delivers no samples: is its node connected? See `handtouch status`"
        if sample.touched:
            return f"{self._name} delivers too few samples for a mean: is the computer overloaded?"
        return "no contact: is the weight on this pad, and heavier than its begin_threshold_n?"

    def _await_unloaded(self) -> float:
        """Wait until the pad is unloaded; return since when [s]. Raises _NoReading, DialogueCancelled."""
        unloaded_ns: int | None = None
        for sample, waited_ns in self.timed_samples():
            self.raise_on_key()
            if sample.touched or not sample.alive:
                unloaded_ns = None
            elif unloaded_ns is None:
                unloaded_ns = sample.sync_ns
            elif sample.sync_ns - unloaded_ns >= _MIN_UNLOADED_NS:
                return 1e-9 * unloaded_ns
            if waited_ns > self._timeout_ns:
                reason = "is still loaded" if sample.alive else "delivers no samples: see `handtouch status`"
                raise _NoReading(f"{self._name} {reason}")
        raise _NoReading("the samples ended")

    def _report_reading(self, reading: WeightReading) -> None:
        same = [other.current_a for other in self.readings if other.weight == reading.weight]
        x, y = (1e3 * value for value in reading.position_m)
        text = f"  {reading.weight.name}: {1e3 * reading.current_a:.4g} mA at ({x:.1f}, {y:.1f}) mm"
        if len(same) > 1:
            text += f", {len(same)} readings scatter by {np.std(same, ddof=1) / np.mean(same):.1%}"
        self.print_line(f"{text}; remove it.", "good")

    def _show_progress(self, sample: PadSample, settling: SettlingDetector) -> None:
        def draw() -> Text:
            state = "no samples" if not sample.alive else "settling" if sample.touched else "waiting"
            text = Text(f"  {1e3 * sample.current_a:8.4f} mA  {state}")
            if settling.loaded_ns is not None and math.isfinite(settling.relative_drift):
                text.append(f", {settling.relative_drift:+.2%} a second")
            text.append("   a: repeat, s: skip, q: quit", "dim")
            return text

        self._dialogue.show_live(sample.sync_ns, draw)


class SettlingDetector:
    """Detects when a placed load has settled: a second for the sheet's creep, then a mean of a second.

    `loaded_ns`: begin of the load, None without one; `relative_drift`: change over the time of the mean, as a
    fraction of it, NaN before there is any.
    """

    def __init__(self) -> None:
        self.loaded_ns: int | None = None
        self.relative_drift = math.nan
        self._samples: deque[PadSample] = deque()

    def add_sample(self, sample: PadSample) -> SettledMeans | None:
        """Add a sample; once settled, return the means."""
        if not sample.alive:
            return None
        if not sample.touched:
            self.loaded_ns, self.relative_drift = None, math.nan
            self._samples.clear()
            return None
        if self.loaded_ns is None:
            self.loaded_ns = sample.sync_ns
        if sample.sync_ns - self.loaded_ns < _CREEP_DELAY_NS:
            return None
        self._samples.append(sample)
        # where samples are few, as while the computer is busy, the mean is of more time
        while (
            len(self._samples) > _MIN_SAMPLES
            and sample.sync_ns - self._samples[0].sync_ns > _MEAN_DURATION_NS
        ):
            self._samples.popleft()
        is_whole = sample.sync_ns - self.loaded_ns >= _CREEP_DELAY_NS + _MEAN_DURATION_NS
        if not is_whole or len(self._samples) < _MIN_SAMPLES:
            return None
        return self._mean_if_settled(1e-9 * self.loaded_ns)

    def _mean_if_settled(self, loaded_s: float) -> SettledMeans | None:
        means = [
            _mean_of_settled(np.array([getattr(sample, name) for sample in self._samples]))
            for name in ("current_a", "second_current_a")
        ]
        self.relative_drift = means[0][2]
        if not all(is_settled for *_, is_settled in means):
            return None
        positions = np.array([sample.position_m for sample in self._samples])
        if not np.isfinite(positions).all(axis=1).any():
            return None
        x, y = np.nanmedian(positions, axis=0).tolist()
        forces = np.array([sample.force_n for sample in self._samples])
        force = float(np.nanmean(forces)) if np.isfinite(forces).any() else math.nan
        measured_s = 1e-9 * float(np.mean([sample.sync_ns for sample in self._samples]))
        settled = *means[0][:2], len(self._samples), (x, y), force, *means[1][:2]
        return SettledMeans(*settled, loaded_s, measured_s)


def _mean_of_settled(current: NDArray[np.float64]) -> tuple[float, float, float, bool]:
    """Return mean of currents, its standard deviation, relative drift, and True if that is no creep, or if
    there are none."""
    mean = float(current.mean())
    batches = np.array([part.mean() for part in np.array_split(current, _BATCH_COUNT)])
    trend, standard_error = _trend(batches)
    is_creep = abs(trend) > max(_MAX_SETTLED_DRIFT * abs(mean), _MAX_SETTLED_DRIFT_SIGMA * standard_error)
    noise = float(batches.std(ddof=1)) / math.sqrt(_BATCH_COUNT)
    return mean, noise, trend / mean if mean else 0.0, not is_creep


def _trend(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the change over equally spaced values, by a line through them, and its standard error."""
    abscissa = np.linspace(-0.5, 0.5, len(values))
    slope = float(abscissa @ values / (abscissa @ abscissa))
    residual = values - values.mean() - slope * abscissa
    return slope, math.sqrt(float(residual @ residual) / (len(values) - 2) / float(abscissa @ abscissa))
