"""The dialogue with the person who sets weights on a pad: zero, then one weight after another.

No clock, socket, file or terminal: samples come in with their times, words go out by a `Dialogue`.

Public names: `Session`, `Sample`, `Hand`, `Settling`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from handtouch.calibrate.readings import Place, Reading, Weight
from handtouch.dialogue import Dialogue, Key

_SECOND_NS = 1_000_000_000
_CREEP_NS = _SECOND_NS  # a sheet tells all of a load after about a second
_MEAN_NS = _SECOND_NS  # that a reading is the mean of
_BATCHES = 10  # a contact flickers for some 50 ms: means of batches are independent, samples aren't
_SETTLED, _SURE = 0.005, 3.0  # more change than this part of it, or standard errors, is creep
_LEAST_SAMPLES = 2 * _BATCHES
_OFF_NS = 300_000_000
_TRIES = 3
_UNSETTLED_NS = 15 * _SECOND_NS


@dataclass(frozen=True)
class Sample:
    """The pad at one instant: whether it delivers and is touched, its total current [A], and where touched
    its place as arc lengths [m] and the force that the daemon tells [N], NaN where it tells none."""

    t_ns: int
    alive: bool
    touched: bool = False
    current_a: float = 0.0
    place_m: tuple[float, float] = (math.nan, math.nan)
    force_n: float = math.nan


class Hand(Protocol):
    """The pad, as a daemon serves it."""

    def samples(self) -> Iterator[Sample]:
        """Without end, whether or not the pad delivers."""

    def tare(self) -> str:
        """Take what the pad reads for zero; why not, empty if it was done."""


class _Said(Exception):  # noqa: N818 - no error: a key that ends what is being done
    def __init__(self, key: Key) -> None:
        self.key = key


class _NoReading(Exception):  # noqa: N818
    """There was no reading in time, or none that could be used; `str` says why."""


class Session:
    """Reads known weights on one pad, in the order given.

    patience_s: how long to wait for a weight, or a key. `readings` are those taken so far.
    """

    def __init__(
        self,
        name: str,
        weights: Sequence[Weight],
        place: Place,
        hand: Hand,
        dialogue: Dialogue,
        *,
        patience_s: float = 60.0,
    ) -> None:
        self.readings: list[Reading] = []
        self._name, self._weights, self._place = name, weights, place
        self._hand, self._dialogue = hand, dialogue
        self._patience_ns = round(patience_s * 1e9)
        self._samples = hand.samples()

    def run(self) -> Iterator[Reading]:
        """Zero, then every weight, each told when it was read; ends early when the person quits."""
        try:
            self._zero()
            left_out: set[Weight] = set()
            for number, weight in enumerate(self._weights, 1):
                if weight in left_out:
                    continue
                if self._take(f"[{number}/{len(self._weights)}]", weight):
                    yield self.readings[-1]
                else:
                    left_out.add(weight)
        except _Said:  # quit; skip and again were taken care of
            self._say("Left; what was read is kept.")

    def confirm(self, question: str) -> bool:
        """Whether the person answers with Enter."""
        return self._ask(question) is Key.ENTER

    def _zero(self) -> None:
        while True:
            self._say(f"Touch nothing: taking zero of {self._name} ...", "ask")
            why = self._hand.tare()
            if not why:
                self._say("  zero taken.", "good")
                return
            self._say(f"  not taken: {why}", "bad")
            if self._ask("Enter or a: again, q: quit") not in (Key.ENTER, Key.AGAIN):
                raise _Said(Key.QUIT)

    def _take(self, title: str, weight: Weight) -> bool:
        """Read a weight once; False if it is to be left out from now on. Raises _Said for quit."""
        while True:
            try:
                reading = self._read(title, weight)
            except _NoReading as failed:
                self._say(f"  {failed}.", "bad")
                key = self._ask(f"Enter or a: again, s: leave {weight.name} out, q: quit")
            except _Said as said:
                key = said.key
            else:
                self.readings.append(reading)
                self._tell(reading)
                return True
            if key is Key.QUIT:
                raise _Said(key)
            if key is Key.SKIP:
                return False

    def _read(self, title: str, weight: Weight) -> Reading:
        complaint = ""
        for _ in range(_TRIES):
            self._await_off()
            self._say(f"{title} put {weight.name} on the middle of {self._name}", "ask")
            reading, complaint = self._await_reading(weight)
            if not complaint:
                return reading
            self._say(f"  {complaint}; take it off, and do it again.", "bad")
        raise _NoReading(complaint)

    def _await_reading(self, weight: Weight) -> tuple[Reading, str]:
        """What settles, with what is wrong with it. Raises _NoReading, _Said."""
        settling = Settling()
        begun_ns: int | None = None
        for sample in self._samples:
            begun_ns = begun_ns if begun_ns is not None else sample.t_ns
            self._raise_key()
            settled = settling.feed(sample)
            self._show(sample, settling)
            if settled is not None:
                reading = Reading(weight, *settled)
                return reading, self._place.complaint(reading.place_m, reading.current_a)
            since = settling.begun_ns
            if since is not None and sample.t_ns - since > _UNSETTLED_NS:
                drift = f"{settling.drift:.1%} a second"
                raise _NoReading(f"the reading doesn't settle ({drift}): does the weight stand still?")
            if since is None and sample.t_ns - begun_ns > self._patience_ns:
                raise _NoReading(
                    f"{self._name} delivers no samples: is its node there? `handtouch status` tells"
                    if not sample.alive
                    else "nothing was felt: is the weight on this pad, and heavier than its on_n?"
                )
        raise _NoReading("the samples ended")

    def _await_off(self) -> None:
        """Wait until nothing stands on the pad. Raises _NoReading, _Said."""
        off_ns: int | None = None
        begun_ns: int | None = None
        for sample in self._samples:
            begun_ns = begun_ns if begun_ns is not None else sample.t_ns
            self._raise_key()
            if sample.touched or not sample.alive:
                off_ns = None
            elif off_ns is None:
                off_ns = sample.t_ns
            elif sample.t_ns - off_ns >= _OFF_NS:
                return
            if sample.t_ns - begun_ns > self._patience_ns:
                why = (
                    "is still loaded" if sample.alive else "delivers no samples: `handtouch status` tells why"
                )
                raise _NoReading(f"{self._name} {why}")

    def _tell(self, reading: Reading) -> None:
        same = [other.current_a for other in self.readings if other.weight == reading.weight]
        x, y = (1e3 * value for value in reading.place_m)
        text = f"  {reading.weight.name}: {1e3 * reading.current_a:.4g} mA at ({x:.1f}, {y:.1f}) mm"
        if len(same) > 1:
            text += f", {len(same)} readings scatter by {np.std(same, ddof=1) / np.mean(same):.1%}"
        self._say(f"{text}; take it off.", "good")

    def _show(self, sample: Sample, settling: Settling) -> None:
        def draw() -> Text:
            state = "no samples" if not sample.alive else "settling" if sample.touched else "waiting"
            text = Text(f"  {1e3 * sample.current_a:8.4f} mA  {state}")
            if settling.begun_ns is not None and math.isfinite(settling.drift):
                text.append(f", {settling.drift:+.2%} a second")
            text.append("   a: again, s: leave it out, q: quit", "dim")
            return text

        self._dialogue.show(sample.t_ns, draw)

    def _ask(self, question: str) -> Key:
        """Wait for a key; q when nobody can press one, or nobody does."""
        self._say(f"  {question}", "ask")
        begun_ns: int | None = None
        for sample in self._samples:
            begun_ns = begun_ns if begun_ns is not None else sample.t_ns
            key = self._dialogue.key()
            if key is not None:
                return key
            if not self._dialogue.listens or sample.t_ns - begun_ns > self._patience_ns:
                break
        return Key.QUIT

    def _raise_key(self) -> None:
        key = self._dialogue.key()
        if key is not None and key is not Key.ENTER:
            raise _Said(key)

    def _say(self, text: str, style: str = "") -> None:
        self._dialogue.say(text, style)


class Settling:
    """Tells when a load that was set down reads steadily: a second for the sheet's creep, then a mean.

    `begun_ns`: when it was set down, None without one; `drift`: change over the time of the mean, as a
    part of it, NaN before there is any.
    """

    def __init__(self) -> None:
        self.begun_ns: int | None = None
        self.drift = math.nan
        self._kept: deque[Sample] = deque()

    def feed(self, sample: Sample) -> tuple[float, float, int, tuple[float, float], float] | None:
        """Take a sample; once settled: mean current and its std [A], samples, place [m], force told [N]."""
        if not sample.alive:
            return None
        if not sample.touched:
            self.begun_ns, self.drift = None, math.nan
            self._kept.clear()
            return None
        if self.begun_ns is None:
            self.begun_ns = sample.t_ns
        if sample.t_ns - self.begun_ns < _CREEP_NS:
            return None
        self._kept.append(sample)
        while sample.t_ns - self._kept[0].t_ns > _MEAN_NS:
            self._kept.popleft()
        if sample.t_ns - self.begun_ns < _CREEP_NS + _MEAN_NS or len(self._kept) < _LEAST_SAMPLES:
            return None
        return self._judge()

    def _judge(self) -> tuple[float, float, int, tuple[float, float], float] | None:
        current = np.array([sample.current_a for sample in self._kept])
        mean = float(current.mean())
        batches = np.array([part.mean() for part in np.array_split(current, _BATCHES)])
        trend, doubt = _trend(batches)
        self.drift = trend / mean
        if abs(trend) > max(_SETTLED * abs(mean), _SURE * doubt):
            return None
        places = np.array([sample.place_m for sample in self._kept])
        if not np.isfinite(places).all(axis=1).any():
            return None
        x, y = np.nanmedian(places, axis=0).tolist()
        told = np.array([sample.force_n for sample in self._kept])
        force = float(np.nanmean(told)) if np.isfinite(told).any() else math.nan
        noise = float(batches.std(ddof=1)) / math.sqrt(_BATCHES)
        return mean, noise, len(current), (x, y), force


def _trend(values: NDArray[np.float64]) -> tuple[float, float]:
    """Change from the first to the last of even values, by a line through them, and its standard error."""
    at = np.linspace(-0.5, 0.5, len(values))
    slope = float(at @ values / (at @ at))
    rest = values - values.mean() - slope * at
    return slope, math.sqrt(float(rest @ rest) / (len(values) - 2) / float(at @ at))
