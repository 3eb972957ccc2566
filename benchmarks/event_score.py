"""Compare begins and ends of reported contacts with a grasp's: delays, missed touches, false positives.

Public names: `touch_spans`, `ideal_contact_spans`, `merge_spans`, `compare_contacts`, `EventScore`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Span = tuple[float, float]
"""Begin and end [s]."""
EventTimes = tuple[list[float], list[float], list[float]]
"""Times at which touches, short touches and contacts began, or ended."""
_MAX_DELAY_S = 0.025
MIN_TOUCH_S = 0.02
"""Shorter touches are counted separately: at 200 Hz a begin and an end take two samples each."""


@dataclass
class EventScore:
    """Figures of one or several pads."""

    touches: int = 0
    """Touches long enough to be detected."""
    short_touches: int = 0
    """Shorter touches."""
    below_threshold: int = 0
    """Presses that never reached `begin_threshold_n`."""
    missed: int = 0
    """Touches without a reported contact."""
    false_positives: int = 0
    """Contacts reported while nothing touched the pad."""
    late: int = 0
    """Touches reported more than 25 ms after their begin."""
    begin_delays_s: list[float] = field(default_factory=list)
    """Delays of begins, unless a contact was already in progress."""
    end_delays_s: list[float] = field(default_factory=list)
    """Delays of ends, unless the contact continued."""
    begins: list[EventTimes] = field(default_factory=list)
    """By pad."""
    ends: list[EventTimes] = field(default_factory=list)

    def f1(self, window_s: float, of: str = "begins") -> float:
        """Return the F1 score of `begins` or `ends` within a window; short touches are optional."""
        hits = missed = false = 0
        for true, short, reported in getattr(self, of):
            hit = _count_matches(true, reported, window_s)
            hits, missed = hits + hit, missed + len(true) - hit
            false += len(reported) - _count_matches(sorted([*true, *short]), reported, window_s)
        return 2 * hits / (2 * hits + missed + false) if hits + missed + false else float("nan")

    def add(self, other: EventScore) -> None:
        """Add the figures of other pads."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


def touch_spans(
    total_n: FloatArray, step_s: float, begin_threshold_n: float, end_threshold_n: float, min_gap_s: float
) -> list[Span]:
    """Return the touches of a pad with force total_n (n,), sampled every `step_s`.

    A touch begins above `begin_threshold_n`, and ends below `end_threshold_n` for at least `min_gap_s`.
    """
    spans: list[Span] = []
    begun: int | None = None
    for step in np.flatnonzero((total_n > begin_threshold_n) | (total_n < end_threshold_n)).tolist():
        if begun is None and total_n[step] > begin_threshold_n:
            begun = step
        elif begun is not None and total_n[step] < end_threshold_n:
            spans.append((begun * step_s, step * step_s))
            begun = None
    if begun is not None:
        spans.append((begun * step_s, len(total_n) * step_s))
    return merge_spans(spans, min_gap_s)


def ideal_contact_spans(
    total_n: FloatArray, period_s: float, begin_threshold_n: float, end_threshold_n: float, in_a_row: int
) -> list[Span]:
    """Return the contacts that a pad with exact samples total_n (n,) would report.

    `in_a_row` consecutive samples above `begin_threshold_n` begin a contact, at the first of them; as many
    below `end_threshold_n` end it, at the last of them.
    """
    spans: list[Span] = []
    begun: int | None = None
    against = 0
    for number, force in enumerate(total_n.tolist()):
        against = (
            against + 1 if (force > begin_threshold_n if begun is None else force < end_threshold_n) else 0
        )
        if against == in_a_row:
            against = 0
            if begun is None:
                begun = number + 1 - in_a_row
            else:
                spans.append((begun * period_s, number * period_s))
                begun = None
    if begun is not None:
        spans.append((begun * period_s, len(total_n) * period_s))
    return spans


def merge_spans(spans: Sequence[Span], min_gap_s: float) -> list[Span]:
    """Return the spans, merging those less than `min_gap_s` apart."""
    found: list[Span] = []
    for begin, end in spans:
        if found and begin - found[-1][1] < min_gap_s:
            found[-1] = found[-1][0], end
        else:
            found.append((begin, end))
    return found


def compare_contacts(
    score: EventScore,
    touches: Sequence[Span],
    any_force: Sequence[Span],
    contacts: Sequence[Span],
    min_touch_s: float = MIN_TOUCH_S,
) -> None:
    """Add a pad to a score: its touches, the spans with any force at all, and the reported contacts.

    Touches shorter than `min_touch_s` count as short, spans of force without a touch as below threshold.
    """
    true = [span for span in touches if span[1] - span[0] >= min_touch_s]
    short = [span for span in touches if span[1] - span[0] < min_touch_s]
    pressed = merge_spans(any_force, MIN_TOUCH_S)
    score.below_threshold += sum(not any(_overlap(span, other) for other in touches) for span in pressed)
    for end, times in enumerate((score.begins, score.ends)):
        times.append(tuple([span[end] for span in spans] for spans in (true, short, contacts)))  # type: ignore[arg-type]
    score.touches, score.short_touches = score.touches + len(true), score.short_touches + len(short)
    for begin, end_s in true:
        during = [span for span in contacts if span[0] < end_s + _MAX_DELAY_S and span[1] > begin]
        if not during:
            score.missed += 1
            continue
        first, last = during[0], during[-1]
        if not any(_overlap(first, span) and span[0] < begin for span in touches):
            score.begin_delays_s.append(first[0] - begin)
            score.late += first[0] - begin > _MAX_DELAY_S
        if not any(_overlap(last, span) and span[1] > end_s for span in touches):
            score.end_delays_s.append(last[1] - end_s)
    score.false_positives += sum(
        not any(begin < span[1] + _MAX_DELAY_S and end_s > span[0] for span in any_force)
        for begin, end_s in contacts
    )


def _overlap(one: Span, other: Span) -> bool:
    return one[0] < other[1] and one[1] > other[0]


def _count_matches(true: list[float], reported: list[float], window_s: float) -> int:
    """Return the largest number of disjoint pairs within the window; both lists are in order."""
    hits = index = 0
    for time_s in true:
        while index < len(reported) and reported[index] < time_s - window_s:
            index += 1
        if index < len(reported) and reported[index] <= time_s + window_s:
            hits, index = hits + 1, index + 1
    return hits
