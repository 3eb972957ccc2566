"""Compare reported contacts with the ground truth: errors, their bounds and intervals, missed touches.

Public names: `score_contacts` -> `Score`, `LinkScore`.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from handtouch import wire
from handtouch.arrays import FloatArray
from handtouch.simulate.truth import GroundTruth, Vector

_MAX_DELAY_PERIODS = 5
"""A contact that begins at most this long after its touch has ended is late, not a false positive."""
_95_PERCENT_CHI2 = 0.0, 3.841, 5.991, 7.815  # quantiles by degrees of freedom; two along a pad
_MIN_RELATIVE_VARIANCE = 1e-6  # variance of an axis, over the greatest, to count as one
_95_PERCENT_SIGMA = 1.96


@dataclass(frozen=True)
class LinkScore:
    """Figures of one link, or of all; NaN where nothing was to compare. Lengths in metres."""

    name: str
    samples: int
    """Fresh samples of contacts that have a position."""
    rms_error_m: float
    """Rms error of positions on the link: error on the pad and error of the pad's mount."""
    pad_error_m: float
    """Rms error of positions relative to the pad, as it is stated to be mounted."""
    mount_error_m: float
    """Rms distance that contacts are off because pads aren't mounted as stated."""
    rms_bound_m: float
    median_error_m: float
    max_error_m: float
    position_coverage: float
    """Share of the `valid` positions on the pad within their stated 95 % region."""
    rms_force_error_n: float
    """Of forces that aren't lower bounds."""
    force_coverage: float
    """Share of the forces within 1.96 of their stated standard deviations, `unreliable` ones included."""
    position_valid: float
    """Share of the positions whose status is `valid`."""
    force_valid: float
    """Share of the forces whose status is `valid`."""
    force_bounded: float
    """Share of the forces that are lower bounds."""
    bounds_held: float
    """Share of the lower bounds that are below the force."""
    touches: int
    missed: int
    """Touches without any contact sample."""
    false_positives: int
    """Contacts that began without a touch."""


@dataclass(frozen=True)
class Score:
    """Comparison by link, in the order of the ground truth, and in total; `str` returns the verdict."""

    links: tuple[LinkScore, ...]
    total: LinkScore

    def __str__(self) -> str:
        total = self.total
        lines = [
            f"{total.touches - total.missed} of {total.touches} touches found, "
            f"{total.false_positives or 'no'} contact{'s' * (total.false_positives != 1)} without a touch"
        ]
        if total.samples:
            lines += [
                f"position: {_millimetres(total.pad_error_m)} mm rms error on the pad, "
                f"{_millimetres(total.rms_error_m)} mm on the link",
                f"  (mounts are off by {_millimetres(total.mount_error_m)} mm);",
                _interval_text(total.position_valid, total.position_coverage),
            ]
        if not np.isnan(total.rms_force_error_n):
            held, valid = _percent(total.force_coverage), _percent(total.force_valid)
            bounded, below = _percent(total.force_bounded), _percent(total.bounds_held)
            bounds = [f"  {bounded} are lower bounds, {below} of them true;"] if total.force_bounded else []
            lines += [
                f"force: {total.rms_force_error_n:.2f} N rms error;",
                f"  {held} of values are in their 95 % intervals;",
                *bounds,
                f"  {valid} are valid, the others unreliable: a sheet counts as known",
                "  after three touches of 5 s together",
            ]
        return "\n".join(lines)

    def table(self) -> str:
        """Return a table with a line for each link and the total, at most 72 columns wide for short names."""
        width = max(4, *(len(link.name) for link in self.links)) if self.links else 4
        columns = (width, *(width for _, width in _COLUMNS))
        rows = [
            ("link", *(title for title, _ in _COLUMNS)),
            *(_cells(link) for link in (*self.links, self.total)),
        ]
        return "\n".join(
            [
                _LEGEND,
                *(" ".join(f"{cell:>{w}}" for cell, w in zip(row, columns, strict=True)) for row in rows),
            ]
        )


def score_contacts(contacts: Iterable[wire.Contact], truth: Sequence[GroundTruth]) -> Score:
    """Match contact samples to the ground truth by link and nearest time, within half a period, and compare.

    Samples of the event "end" are left out, and those without position don't count for position errors. The
    period is the median step of the ground truth's times.
    """
    by_link: dict[tuple[str, str], list[GroundTruth]] = defaultdict(list)
    for record in truth:
        by_link[record.hand, record.link].append(record)
    reported: dict[tuple[str, str], list[wire.Contact]] = defaultdict(list)
    for contact in contacts:
        reported[contact.hand, contact.link].append(contact)
    for records in by_link.values():
        records.sort(key=lambda record: record.t_ns)
    period_ns = _period_ns(by_link.values())
    end_ns = max((record.t_ns for record in truth), default=0)
    hands = {hand for hand, _ in (*by_link, *reported)}
    matched = {
        key: _MatchedLink(by_link[key], reported[key], period_ns, end_ns)
        for key in dict.fromkeys((*by_link, *reported))
    }
    links = [
        _score_link(link if len(hands) == 1 else f"{hand}/{link}", [found])
        for (hand, link), found in matched.items()
    ]
    return Score(tuple(links), _score_link("all", list(matched.values()) or [_MatchedLink([], [], 0, 0)]))


class _MatchedLink:
    """Contacts of one link, matched to its ground truth."""

    def __init__(
        self, truth: list[GroundTruth], contacts: list[wire.Contact], period_ns: int, end_ns: int = 0
    ) -> None:
        """`end_ns`: of all ground truth; touches that begin too late to be noticed before it don't count."""
        times = [record.t_ns for record in truth]
        touch_of = _touch_numbers(truth)
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
                pairs.append((contact, truth[nearest], touch_of[nearest]))
        noticed = {touch for _, _, touch in pairs}
        began_ns = dict(zip(reversed(touch_of), reversed(times), strict=True))
        latest_ns = end_ns - _MAX_DELAY_PERIODS * period_ns if end_ns else times[-1] if times else 0
        self.touches = sum(touch in noticed or began_ns[touch] <= latest_ns for touch in began_ns)
        self.missed = self.touches - len(noticed)
        located = [pair for pair in pairs if pair[0].position_m is not None]
        self.error_m = _vectors(np.subtract(_position(c), record.position_m) for c, record, _ in located)
        self.mount_error_m = _vectors(
            np.subtract(record.stated_position_m or record.position_m, record.position_m)
            for _, record, _ in located
        )
        self.pad_error_m = self.error_m - self.mount_error_m
        self.bound_m = np.array([record.bound_m for _, record, _ in located])
        self.position_held = np.array(
            [
                _is_within(error, contact.covariance_m2)
                for (contact, _, _), error in zip(located, self.error_m, strict=True)
                if contact.covariance_m2 is not None and contact.position_status == "valid"
            ]
        )
        forces = [
            (c.force_n - record.force_n, c.force_std_n, c.force_status)
            for c, record, _ in pairs
            if c.force_n is not None
        ]
        self.force_error_n = np.array([error for error, _, status in forces if status != "lower_bound"])
        self.force_held = np.array(
            [abs(error) <= _95_PERCENT_SIGMA * std for error, std, _ in forces if std is not None]
        )
        self.force_valid = np.array([status == "valid" for _, _, status in forces])
        self.force_bounded = np.array([status == "lower_bound" for _, _, status in forces])
        self.bound_held = np.array([error <= 0 for error, _, status in forces if status == "lower_bound"])


def _vectors(rows: Iterable[FloatArray]) -> FloatArray:
    return np.array(list(rows), np.float64).reshape(-1, 3)


def _position(contact: wire.Contact) -> Vector:
    assert contact.position_m is not None
    return contact.position_m


def _is_within(error_m: FloatArray, covariance_m2: Sequence[float]) -> bool:
    """Return whether an error is in the 95 % region of a covariance, which is singular along the normal where
    the pad's mount is exact."""
    covariance = np.reshape(covariance_m2, (3, 3))
    inverse = np.linalg.pinv(covariance, rcond=_MIN_RELATIVE_VARIANCE, hermitian=True)
    rank = int(
        np.linalg.matrix_rank(covariance, _MIN_RELATIVE_VARIANCE * np.trace(covariance), hermitian=True)
    )
    return bool(error_m @ inverse @ error_m <= _95_PERCENT_CHI2[rank])


def _score_link(name: str, matched: Sequence[_MatchedLink]) -> LinkScore:
    error = np.concatenate([found.error_m for found in matched])
    length = np.linalg.norm(error, axis=1)
    has_samples = len(length) > 0
    return LinkScore(
        name=name,
        samples=len(length),
        rms_error_m=_rms(length),
        pad_error_m=_rms(np.linalg.norm(np.concatenate([found.pad_error_m for found in matched]), axis=1)),
        mount_error_m=_rms(
            np.linalg.norm(np.concatenate([found.mount_error_m for found in matched]), axis=1)
        ),
        rms_bound_m=_rms(np.concatenate([found.bound_m for found in matched])),
        median_error_m=float(np.median(length)) if has_samples else np.nan,
        max_error_m=float(length.max()) if has_samples else np.nan,
        position_coverage=_mean(np.concatenate([found.position_held for found in matched])),
        rms_force_error_n=_rms(np.concatenate([found.force_error_n for found in matched])),
        force_coverage=_mean(np.concatenate([found.force_held for found in matched])),
        position_valid=_ratio(sum(len(found.position_held) for found in matched), len(length)),
        force_valid=_mean(np.concatenate([found.force_valid for found in matched])),
        force_bounded=_mean(np.concatenate([found.force_bounded for found in matched])),
        bounds_held=_mean(np.concatenate([found.bound_held for found in matched])),
        touches=sum(found.touches for found in matched),
        missed=sum(found.missed for found in matched),
        false_positives=sum(found.false_positives for found in matched),
    )


def _touch_numbers(truth: list[GroundTruth]) -> list[int]:
    """Return the number of each record's touch; a touch that ended and began again gets a new one."""
    numbers: dict[tuple[int, int], int] = {}
    return [numbers.setdefault((record.touch, record.repetition), len(numbers)) for record in truth]


def _nearest_index(times: list[int], t_ns: int) -> int:
    index = bisect_left(times, t_ns)
    if index > 0 and (index == len(times) or t_ns - times[index - 1] <= times[index] - t_ns):
        return index - 1
    return index


def _period_ns(by_link: Iterable[list[GroundTruth]]) -> int:
    steps = [after.t_ns - before.t_ns for records in by_link for before, after in itertools.pairwise(records)]
    return int(np.median(steps)) if steps else 0


def _ratio(count: int, of: int) -> float:
    return count / of if of else np.nan


def _mean(values: FloatArray) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def _interval_text(valid: float, coverage: float) -> str:
    """Return how many values are `valid`, and whether their intervals held."""
    within = f", {_percent(coverage)} of them in their 95 % intervals" if valid else ""
    return f"  {_percent(valid)} of values are valid{within}"


_LEGEND = """pos: samples with a position; rms errors in mm: pad, on the pad; link,
mounts included; bound, the least possible by noise; max, the largest;
N: rms error of force; in%: share of valid positions, and of forces with
an interval, within 95 %; miss: touches without contact; false: contacts
without touch"""
_COLUMNS = (
    ("pos", 5),
    ("pad", 5),
    ("link", 5),
    ("bound", 5),
    ("max", 5),
    ("in%", 3),
    ("N", 5),
    ("in%", 3),
    ("miss", 5),
    ("false", 5),
)


def _cells(score: LinkScore) -> tuple[str, ...]:
    return (
        score.name,
        str(score.samples),
        _millimetres(score.pad_error_m),
        _millimetres(score.rms_error_m),
        _millimetres(score.rms_bound_m),
        _millimetres(score.max_error_m),
        _percent(score.position_coverage).removesuffix(" %"),
        _number(score.rms_force_error_n, 3),
        _percent(score.force_coverage).removesuffix(" %"),
        f"{score.missed}/{score.touches}",
        str(score.false_positives),
    )


def _millimetres(length_m: float) -> str:
    return _number(1e3 * length_m, 2)


def _percent(share: float) -> str:
    text = _number(100 * share, 0)
    return text if text == "-" else f"{text} %"


def _number(value: float, digits: int) -> str:
    """Return a number, or "-" where nothing was to compare."""
    return "-" if np.isnan(value) else f"{value:.{digits}f}"
