"""Compare reported contacts with the ground truth: position error and bound, force error, missed touches.

Public names: `score_contacts` -> `Score`, `LinkScore`, `ContactLike`.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch.simulate.truth import GroundTruth, Vector

FloatArray = NDArray[np.float64]
_MAX_DELAY_PERIODS = 5
"""A contact that begins at most this long after its touch has ended is late, not a false positive."""


class ContactLike(Protocol):
    """Attributes that a contact needs; `handtouch.wire.Contact` has them."""

    @property
    def hand(self) -> str: ...
    @property
    def link(self) -> str: ...
    @property
    def t_ns(self) -> int: ...
    @property
    def event(self) -> str: ...
    @property
    def fresh(self) -> bool: ...
    @property
    def position_m(self) -> Vector | None: ...
    @property
    def force_n(self) -> float | None: ...


@dataclass(frozen=True)
class LinkScore:
    """Figures of one link, or of all; NaN where nothing was to compare. Lengths in metres."""

    name: str
    samples: int
    rms_error_m: float
    rms_bound_m: float
    median_error_m: float
    max_error_m: float
    bias_m: float
    """Rms over samples of the mean error vector of each touch."""
    scatter_m: float
    """Rms of the error vectors without that mean."""
    rms_force_error_n: float
    touches: int
    missed: int
    """Touches without any contact sample."""
    false_positives: int
    """Contacts that began without a touch."""

    @property
    def bound_ratio(self) -> float:
        """Rms error relative to the rms bound."""
        return self.rms_error_m / self.rms_bound_m


@dataclass(frozen=True)
class Score:
    """Comparison by link, in the order of the ground truth, and in total; `str` returns a table."""

    links: tuple[LinkScore, ...]
    total: LinkScore

    def __str__(self) -> str:
        head = " ".join(f"{title:>{width}}" for title, width in _COLUMNS)
        return "\n".join(
            ["lengths in um, force in mN", head, *map(_format_row, self.links), _format_row(self.total)]
        )


def score_contacts(contacts: Iterable[ContactLike], truth: Sequence[GroundTruth]) -> Score:
    """Match contact samples to the ground truth by link and nearest time, within half a period, and compare.

    Samples of the event "end" are left out, and those without position don't count for position errors. The
    period is the median step of the ground truth's times.
    """
    by_link: dict[tuple[str, str], list[GroundTruth]] = defaultdict(list)
    for record in truth:
        by_link[record.hand, record.link].append(record)
    reported: dict[tuple[str, str], list[ContactLike]] = defaultdict(list)
    for contact in contacts:
        reported[contact.hand, contact.link].append(contact)
    for records in by_link.values():
        records.sort(key=lambda record: record.t_ns)
    period_ns = _period_ns(by_link.values())
    hands = {hand for hand, _ in (*by_link, *reported)}
    matched = {
        key: _MatchedLink(by_link[key], reported[key], period_ns)
        for key in dict.fromkeys((*by_link, *reported))
    }
    links = [
        _score_link(link if len(hands) == 1 else f"{hand}/{link}", [found])
        for (hand, link), found in matched.items()
    ]
    return Score(tuple(links), _score_link("all", list(matched.values()) or [_MatchedLink([], [], 0)]))


class _MatchedLink:
    """Contacts of one link, matched to its ground truth."""

    def __init__(self, truth: list[GroundTruth], contacts: list[ContactLike], period_ns: int) -> None:
        times = [record.t_ns for record in truth]
        touch_of = _touch_numbers(truth, period_ns)
        pairs = []
        self.false_positives = 0
        for contact in contacts:
            nearest = _nearest_index(times, contact.t_ns)
            distance_ns = abs(times[nearest] - contact.t_ns) if times else None
            if contact.event == "begin" and (
                distance_ns is None or distance_ns > _MAX_DELAY_PERIODS * period_ns
            ):
                self.false_positives += 1
            measured = contact.event != "end" and contact.fresh
            if distance_ns is not None and 2 * distance_ns <= period_ns and measured:
                pairs.append((contact, nearest))
        self.touches = touch_of[-1] + 1 if touch_of else 0
        self.missed = self.touches - len({touch_of[row] for _, row in pairs})
        located = [(c.position_m, truth[row], touch_of[row]) for c, row in pairs if c.position_m is not None]
        error = [np.subtract(position, record.position_m) for position, record, _ in located]
        self.error_m = np.array(error, np.float64).reshape(-1, 3)
        self.bound_m = np.array([record.bound_m for _, record, _ in located])
        self.mean_error_m = _mean_error_by_touch(
            self.error_m, np.array([touch for _, _, touch in located], np.intp)
        )
        self.force_error_n = np.array(
            [c.force_n - truth[row].force_n for c, row in pairs if c.force_n is not None]
        )


def _score_link(name: str, matched: Sequence[_MatchedLink]) -> LinkScore:
    error = np.concatenate([found.error_m for found in matched])
    mean = np.concatenate([found.mean_error_m for found in matched])
    length = np.linalg.norm(error, axis=1)
    has_samples = len(length) > 0
    return LinkScore(
        name,
        len(length),
        _rms(length),
        _rms(np.concatenate([found.bound_m for found in matched])),
        float(np.median(length)) if has_samples else np.nan,
        float(length.max()) if has_samples else np.nan,
        _rms(np.linalg.norm(mean, axis=1)),
        _rms(np.linalg.norm(error - mean, axis=1)),
        _rms(np.concatenate([found.force_error_n for found in matched])),
        sum(found.touches for found in matched),
        sum(found.missed for found in matched),
        sum(found.false_positives for found in matched),
    )


def _touch_numbers(truth: list[GroundTruth], period_ns: int) -> list[int]:
    """Return the number of each record's touch; a touch that repeats gets a new number each time."""
    numbers = [0] if truth else []
    for before, after in itertools.pairwise(truth):
        new = before.touch != after.touch or after.t_ns - before.t_ns > _MAX_DELAY_PERIODS * period_ns
        numbers.append(numbers[-1] + new)
    return numbers


def _nearest_index(times: list[int], t_ns: int) -> int:
    index = bisect_left(times, t_ns)
    if index > 0 and (index == len(times) or t_ns - times[index - 1] <= times[index] - t_ns):
        return index - 1
    return index


def _period_ns(by_link: Iterable[list[GroundTruth]]) -> int:
    steps = [after.t_ns - before.t_ns for records in by_link for before, after in itertools.pairwise(records)]
    return int(np.median(steps)) if steps else 0


def _mean_error_by_touch(error: FloatArray, touch: NDArray[np.intp]) -> FloatArray:
    """Return for each row of `error` (n, 3) the mean of the rows of its touch."""
    count = np.maximum(np.bincount(touch), 1)
    sums = np.stack([np.bincount(touch, weights=column) for column in error.T], axis=1)
    return np.asarray((sums / count[:, None])[touch])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


_COLUMNS = (
    ("link", 18),
    ("samples", 7),
    ("rms", 7),
    ("bound", 7),
    ("ratio", 5),
    ("median", 7),
    ("max", 7),
    ("bias", 7),
    ("scatter", 7),
    ("force", 7),
    ("touches", 7),
    ("missed", 6),
    ("false", 6),
)


def _format_row(score: LinkScore) -> str:
    cells = (
        score.name,
        score.samples,
        f"{score.rms_error_m * 1e6:.1f}",
        f"{score.rms_bound_m * 1e6:.1f}",
        f"{score.bound_ratio:.2f}",
        f"{score.median_error_m * 1e6:.1f}",
        f"{score.max_error_m * 1e6:.1f}",
        f"{score.bias_m * 1e6:.1f}",
        f"{score.scatter_m * 1e6:.1f}",
        f"{score.rms_force_error_n * 1e3:.1f}",
        score.touches,
        score.missed,
        score.false_positives,
    )
    return " ".join(f"{cell:>{width}}" for cell, (_, width) in zip(cells, _COLUMNS, strict=True))
