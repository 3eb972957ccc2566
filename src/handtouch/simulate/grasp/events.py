"""Contacts that begin and end, against those of a grasp: how late, how many missed, invented.

Public names: `touches`, `sampled`, `joined`, `compare`, `Events`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Span = tuple[float, float]
"""from, until [s]"""
Moments = tuple[list[float], list[float], list[float]]
"""when touches, short touches and contacts began, or ended"""
_LATE_S = 0.025
SHORT_S = 0.02
"""Touches shorter than this are counted apart: at 200 Hz a begin and an end take two samples each."""


@dataclass
class Events:
    """Figures of some pads, added up."""

    touches: int = 0
    """that last long enough to be told"""
    short: int = 0
    """the others"""
    faint: int = 0
    """what pressed and never became a touch: below `on_n`"""
    missed: int = 0
    """touches during which no contact was told"""
    invented: int = 0
    """contacts while nothing touched the pad"""
    late: int = 0
    """of the touches that weren't missed, those told more than 25 ms after they began"""
    begin_s: list[float] = field(default_factory=list)
    """delays of begins, where a contact hadn't begun before"""
    end_s: list[float] = field(default_factory=list)
    """delays of ends, where a contact didn't go on"""
    begins: list[Moments] = field(default_factory=list)
    """of each pad"""
    ends: list[Moments] = field(default_factory=list)

    def f1(self, window_s: float, of: str = "begins") -> float:
        """F1 of all pads' `begins` or `ends`, told within a window; short touches may be told or not."""
        hits = missed = false = 0
        for true, short, told in getattr(self, of):
            hit = _hits(true, told, window_s)
            hits, missed = hits + hit, missed + len(true) - hit
            false += len(told) - _hits(sorted([*true, *short]), told, window_s)
        return 2 * hits / (2 * hits + missed + false) if hits + missed + false else float("nan")

    def add(self, other: Events) -> None:
        """Those of more pads."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


def touches(total_n: FloatArray, step_s: float, on_n: float, off_n: float, apart_s: float) -> list[Span]:
    """When a pad is touched: above `on_n`, until below `off_n` for `apart_s`; total_n (n,) at even times."""
    spans: list[Span] = []
    begun: int | None = None
    for step in np.flatnonzero((total_n > on_n) | (total_n < off_n)).tolist():
        if begun is None and total_n[step] > on_n:
            begun = step
        elif begun is not None and total_n[step] < off_n:
            spans.append((begun * step_s, step * step_s))
            begun = None
    if begun is not None:
        spans.append((begun * step_s, len(total_n) * step_s))
    return joined(spans, apart_s)


def sampled(total_n: FloatArray, period_s: float, on_n: float, off_n: float, in_a_row: int) -> list[Span]:
    """What a pad could tell at best that feels total_n (n,) exactly, a period apart: `in_a_row` samples above
    `on_n` begin a contact, from the first of them on, as many below `off_n` end it, at the last of them."""
    spans: list[Span] = []
    begun: int | None = None
    against = 0
    for number, force in enumerate(total_n.tolist()):
        against = against + 1 if (force > on_n if begun is None else force < off_n) else 0
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


def joined(spans: Sequence[Span], apart_s: float) -> list[Span]:
    """Spans, those closer together than `apart_s` made one."""
    found: list[Span] = []
    for begin, end in spans:
        if found and begin - found[-1][1] < apart_s:
            found[-1] = found[-1][0], end
        else:
            found.append((begin, end))
    return found


def compare(
    events: Events,
    every: Sequence[Span],
    any_force: Sequence[Span],
    told: Sequence[Span],
    least_s: float = SHORT_S,
) -> None:
    """Add a pad: its touches, the times at which anything pressed at all, and the contacts told.

    Touches shorter than `least_s` count as short; what never was one, as faint."""
    true = [span for span in every if span[1] - span[0] >= least_s]
    short = [span for span in every if span[1] - span[0] < least_s]
    pressed = joined(any_force, SHORT_S)
    events.faint += sum(not any(_overlap(span, other) for other in every) for span in pressed)
    for end, moments in enumerate((events.begins, events.ends)):
        moments.append(tuple([span[end] for span in spans] for spans in (true, short, told)))  # type: ignore[arg-type]
    events.touches, events.short = events.touches + len(true), events.short + len(short)
    for begin, end_s in true:
        during = [span for span in told if span[0] < end_s + _LATE_S and span[1] > begin]
        if not during:
            events.missed += 1
            continue
        first, last = during[0], during[-1]
        if not any(_overlap(first, span) and span[0] < begin for span in every):
            events.begin_s.append(first[0] - begin)
            events.late += first[0] - begin > _LATE_S
        if not any(_overlap(last, span) and span[1] > end_s for span in every):
            events.end_s.append(last[1] - end_s)
    events.invented += sum(
        not any(begin < span[1] + _LATE_S and end_s > span[0] for span in any_force) for begin, end_s in told
    )


def _overlap(one: Span, other: Span) -> bool:
    return one[0] < other[1] and one[1] > other[0]


def _hits(true: list[float], told: list[float], window_s: float) -> int:
    """How many pairs of both within the window there are at most, each used once; both in order."""
    hits = at = 0
    for when in true:
        while at < len(told) and told[at] < when - window_s:
            at += 1
        if at < len(told) and told[at] <= when + window_s:
            hits, at = hits + 1, at + 1
    return hits
