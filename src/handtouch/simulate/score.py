"""Contacts against the truth: location error beside its bound, force error, touches missed and invented.

Public names: `score` -> `Score`, `Tally`, `ContactLike`.
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

from handtouch.simulate.truth import Truth, Vector

FloatArray = NDArray[np.float64]
_SLACK_PERIODS = 5
"""A contact that begins this long after its touch, or outlives it so, is late and not invented."""


class ContactLike(Protocol):
    """What a contact must tell; `handtouch.wire.Contact` does."""

    @property
    def hand(self) -> str: ...
    @property
    def link(self) -> str: ...
    @property
    def t_ns(self) -> int: ...
    @property
    def event(self) -> str: ...
    @property
    def position_m(self) -> Vector | None: ...
    @property
    def force_n(self) -> float | None: ...


@dataclass(frozen=True)
class Tally:
    """Figures of one link, or of all; NaN where there was nothing to compare. Lengths in metres."""

    name: str
    samples: int
    rms_error_m: float
    rms_bound_m: float
    median_error_m: float
    worst_error_m: float
    bias_m: float
    """Rms over samples of the mean error vector of their touch."""
    scatter_m: float
    """Rms of what is left of the error vectors without that mean."""
    force_rms_n: float
    touches: int
    missed: int
    """Touches without a single contact sample."""
    invented: int
    """Contacts that began where nothing touched."""

    @property
    def ratio(self) -> float:
        """Rms error as a multiple of the rms bound."""
        return self.rms_error_m / self.rms_bound_m


@dataclass(frozen=True)
class Score:
    """The comparison by link, in the order of the truth, and in `total`; `str` is a table."""

    links: tuple[Tally, ...]
    total: Tally

    def __str__(self) -> str:
        head = " ".join(f"{title:>{width}}" for title, width in _COLUMNS)
        return "\n".join(["lengths in um, force in mN", head, *map(_line, self.links), _line(self.total)])


def score(contacts: Iterable[ContactLike], truth: Sequence[Truth]) -> Score:
    """Match contact samples to the truth by link and nearest time, within half a period, and compare.

    Samples of the event "end" and without position say nothing of location and are left out. The period is
    the usual step of the truth's times.
    """
    by_link: dict[tuple[str, str], list[Truth]] = defaultdict(list)
    for record in truth:
        by_link[record.hand, record.link].append(record)
    given: dict[tuple[str, str], list[ContactLike]] = defaultdict(list)
    for contact in contacts:
        given[contact.hand, contact.link].append(contact)
    for records in by_link.values():
        records.sort(key=lambda record: record.t_ns)
    period_ns = _period_ns(by_link.values())
    hands = {hand for hand, _ in (*by_link, *given)}
    compared = {
        key: _Compared(by_link[key], given[key], period_ns) for key in dict.fromkeys((*by_link, *given))
    }
    tallies = [
        _tally(link if len(hands) == 1 else f"{hand}/{link}", [found])
        for (hand, link), found in compared.items()
    ]
    return Score(tuple(tallies), _tally("all", list(compared.values()) or [_Compared([], [], 0)]))


class _Compared:
    """One link: what was matched."""

    def __init__(self, truth: list[Truth], contacts: list[ContactLike], period_ns: int) -> None:
        times = [record.t_ns for record in truth]
        touch_of = _touches(truth, period_ns)
        pairs = []
        self.invented = 0
        for contact in contacts:
            at = _nearest(times, contact.t_ns)
            distance_ns = abs(times[at] - contact.t_ns) if times else None
            if contact.event == "begin" and (distance_ns is None or distance_ns > _SLACK_PERIODS * period_ns):
                self.invented += 1
            if distance_ns is not None and 2 * distance_ns <= period_ns and contact.event != "end":
                pairs.append((contact, at))
        self.touches = touch_of[-1] + 1 if touch_of else 0
        self.missed = self.touches - len({touch_of[at] for _, at in pairs})
        placed = [(c.position_m, truth[at], touch_of[at]) for c, at in pairs if c.position_m is not None]
        error = [np.subtract(position, record.position_m) for position, record, _ in placed]
        self.error = np.array(error, np.float64).reshape(-1, 3)
        self.bound = np.array([record.bound_m for _, record, _ in placed])
        self.mean = _mean_by_touch(self.error, np.array([touch for _, _, touch in placed], np.intp))
        self.force = np.array([c.force_n - truth[at].force_n for c, at in pairs if c.force_n is not None])


def _tally(name: str, compared: Sequence[_Compared]) -> Tally:
    error = np.concatenate([found.error for found in compared])
    mean = np.concatenate([found.mean for found in compared])
    length = np.linalg.norm(error, axis=1)
    some = len(length) > 0
    return Tally(
        name,
        len(length),
        _rms(length),
        _rms(np.concatenate([found.bound for found in compared])),
        float(np.median(length)) if some else np.nan,
        float(length.max()) if some else np.nan,
        _rms(np.linalg.norm(mean, axis=1)),
        _rms(np.linalg.norm(error - mean, axis=1)),
        _rms(np.concatenate([found.force for found in compared])),
        sum(found.touches for found in compared),
        sum(found.missed for found in compared),
        sum(found.invented for found in compared),
    )


def _touches(truth: list[Truth], period_ns: int) -> list[int]:
    """Number of the touch of each record; one that comes again, in a scenario that repeats, is another."""
    numbers = [0] if truth else []
    for before, after in itertools.pairwise(truth):
        new = before.touch != after.touch or after.t_ns - before.t_ns > _SLACK_PERIODS * period_ns
        numbers.append(numbers[-1] + new)
    return numbers


def _nearest(times: list[int], t_ns: int) -> int:
    at = bisect_left(times, t_ns)
    if at > 0 and (at == len(times) or t_ns - times[at - 1] <= times[at] - t_ns):
        return at - 1
    return at


def _period_ns(by_link: Iterable[list[Truth]]) -> int:
    steps = [after.t_ns - before.t_ns for records in by_link for before, after in itertools.pairwise(records)]
    return int(np.median(steps)) if steps else 0


def _mean_by_touch(error: FloatArray, touch: NDArray[np.intp]) -> FloatArray:
    """For each row of `error` (n, 3) the mean of the rows of its touch."""
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
    ("worst", 7),
    ("bias", 7),
    ("scatter", 7),
    ("force", 7),
    ("touches", 7),
    ("missed", 6),
    ("invented", 8),
)


def _line(tally: Tally) -> str:
    cells = (
        tally.name,
        tally.samples,
        f"{tally.rms_error_m * 1e6:.1f}",
        f"{tally.rms_bound_m * 1e6:.1f}",
        f"{tally.ratio:.2f}",
        f"{tally.median_error_m * 1e6:.1f}",
        f"{tally.worst_error_m * 1e6:.1f}",
        f"{tally.bias_m * 1e6:.1f}",
        f"{tally.scatter_m * 1e6:.1f}",
        f"{tally.force_rms_n * 1e3:.1f}",
        tally.touches,
        tally.missed,
        tally.invented,
    )
    return " ".join(f"{cell:>{width}}" for cell, (_, width) in zip(cells, _COLUMNS, strict=True))
