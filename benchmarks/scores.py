"""Scores of estimates with stated covariance, and of detected events; used by every benchmark of accuracy.

Public names: `Share`, `ClusterShare`, `Rate`; `Estimates` -> `EstimateScore`, `slices`, `bin_labels`,
`laplace_covariance`; `score_events` -> `EventScore`.

Rows of `Estimates` are independent touches, one sample of each: samples of one touch share its hidden
quantities, and binomial intervals of all of them would be too narrow.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr
from scipy.stats import beta, chi2

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""Probabilities of the regions whose coverage is counted."""
MIN_TOUCHES = 400
"""Touches of a slice from which its coverage is known to 5 % or better."""
MANY_SIGMA = 5.0
"""Mahalanobis distance beyond which an estimate is simply wrong: stated less than once in 250,000."""
_CONFIDENCE = 0.95
_DIRECTIONS = 64


@dataclass(frozen=True)
class Share:
    """Number of hits among independent trials; `interval` is that of Clopper and Pearson, 95 %.

    Raises ValueError unless 0 <= count <= total.
    """

    count: int
    total: int

    def __post_init__(self) -> None:
        if not 0 <= self.count <= self.total:
            raise ValueError(f"{self.count} of {self.total}")

    @classmethod
    def of_mask(cls, mask: BoolArray) -> Share:
        return cls(int(np.count_nonzero(mask)), mask.size)

    @property
    def value(self) -> float:
        """Fraction; NaN without trials."""
        return self.count / self.total if self.total else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper limit of the probability."""
        tail = (1 - _CONFIDENCE) / 2
        low = beta.ppf(tail, self.count, self.total - self.count + 1) if self.count else 0.0
        high = beta.isf(tail, self.count + 1, self.total - self.count) if self.count < self.total else 1.0
        return float(low), float(high)

    def as_plain(self) -> dict[str, float]:
        return {"count": self.count, "total": self.total}

    def __str__(self) -> str:
        if not self.total:
            return "-"
        low, high = (f"{100 * limit:.1f}" for limit in self.interval)
        return f"{100 * self.value:.1f} ({low}-{high})"


@dataclass(frozen=True)
class ClusterShare:
    """Share of hits where trials of one cluster (a pad's touches, an hour's contacts) aren't independent.

    `interval` (95 %) is normal, from the scatter between clusters. Raises ValueError for fewer than two.
    """

    value: float
    std: float

    @classmethod
    def of_mask(cls, hits: BoolArray, cluster: NDArray[Any]) -> ClusterShare:
        """Return the share of a mask (n,) with the clusters of its rows (n,)."""
        _, row, total = np.unique(cluster, return_inverse=True, return_counts=True)
        if len(total) < 2:
            raise ValueError(f"{len(total)} clusters")
        value = float(hits.mean())
        excess = np.bincount(row, weights=hits) - value * total
        scale = len(total) / (len(total) - 1)
        return cls(value, float(np.sqrt(scale * np.sum(np.square(excess))) / total.sum()))

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper limit of the probability."""
        reach = 1.96 * self.std
        return max(self.value - reach, 0.0), min(self.value + reach, 1.0)

    def as_plain(self) -> dict[str, float]:
        return {"value": self.value, "std": self.std}

    def __str__(self) -> str:
        low, high = (f"{100 * limit:.1f}" for limit in self.interval)
        return f"{100 * self.value:.1f} ({low}-{high})"


@dataclass(frozen=True)
class Rate:
    """Number of events in a time; `interval` is exact for Poisson's distribution, 95 %, per hour.

    Raises ValueError for a negative count or a time of 0 or less.
    """

    count: int
    hours: float

    def __post_init__(self) -> None:
        if self.count < 0 or not self.hours > 0:
            raise ValueError(f"{self.count} in {self.hours} h")

    @property
    def per_hour(self) -> float:
        return self.count / self.hours

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper limit of the rate per hour."""
        tail = (1 - _CONFIDENCE) / 2
        low = chi2.ppf(tail, 2 * self.count) / 2 if self.count else 0.0
        return float(low) / self.hours, float(chi2.isf(tail, 2 * self.count + 2)) / 2 / self.hours

    def as_plain(self) -> dict[str, float]:
        return {"count": self.count, "hours": self.hours}

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.per_hour:.2g} ({low:.2g}-{high:.2g})"


def from_plain(plain: Mapping[str, Any]) -> Share | ClusterShare | Rate:
    """Return the share or rate that JSON holds."""
    kind = Share if "total" in plain else Rate if "hours" in plain else ClusterShare
    return kind(**plain)


@dataclass(frozen=True)
class Estimates:
    """Estimates of a quantity of d components (1 or 2) and their ground truth, one row per touch.

    `error` (n, d), stated `covariance` (n, d, d), `valid` (n,): status of the estimate; rows that aren't
    valid count in the share of valid ones only. `bound` (n,): least rms error of an unbiased estimate from
    the row's noise. `oracle_covariance` (n, d, d): see `laplace_covariance`. `columns`: label or number of
    each row, by name. Raises ValueError for shapes that don't fit.
    """

    error: FloatArray
    covariance: FloatArray
    valid: BoolArray
    bound: FloatArray
    oracle_covariance: FloatArray
    columns: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, d = self.error.shape
        shapes = {
            "covariance": (n, d, d), "valid": (n,), "bound": (n,), "oracle_covariance": (n, d, d),
        }  # fmt: skip
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} of shape {getattr(self, name).shape}, not {shape}")
        for name, column in self.columns.items():
            if column.shape != (n,):
                raise ValueError(f"column {name} of shape {column.shape}, not {(n,)}")

    def __len__(self) -> int:
        return len(self.error)

    def where(self, mask: BoolArray) -> Estimates:
        """Return the rows of a mask (n,)."""
        columns = {name: column[mask] for name, column in self.columns.items()}
        return Estimates(
            self.error[mask], self.covariance[mask], self.valid[mask], self.bound[mask],
            self.oracle_covariance[mask], columns,
        )  # fmt: skip

    def distances(self) -> FloatArray:
        """Return Mahalanobis distances (n,): errors in stated standard deviations."""
        solved = np.linalg.solve(self.covariance, self.error[..., None])[..., 0]
        return np.asarray(np.sqrt(np.maximum((self.error * solved).sum(axis=1), 0.0)))

    def stated_levels(self) -> FloatArray:
        """Return the probability (n,) of the smallest region around each estimate that holds the truth."""
        return np.asarray(chi2.cdf(self.distances() ** 2, self.error.shape[1]))


def concatenate(parts: Sequence[Estimates]) -> Estimates:
    """Return the rows of several tables with the same columns."""
    error, covariance, valid, bound, oracle = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("error", "covariance", "valid", "bound", "oracle_covariance")
    )
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
    return Estimates(error, covariance, valid, bound, oracle, columns)


@dataclass(frozen=True)
class EstimateScore:
    """Scores of estimates; all but `touches` and `valid` are of the valid ones. NaN without any."""

    touches: int
    valid: Share
    coverage: Mapping[float, Share]
    """Truths within the stated region, by its probability."""
    beyond_5_sigma: Share
    ratio_rms: float
    """Rms over touches of error / bound, each with its own bound."""
    ratio_quantiles: tuple[float, float, float]
    """Quantiles 50, 95 and 99 % of error / bound."""
    rms_error: float
    median_std: float
    """Sharpness: median of the stated standard deviation per component."""
    oracle_std: float
    """The same of the oracle."""
    crps: float
    """Mean continuous ranked probability score; see `mean_crps`."""

    @classmethod
    def of_estimates(cls, every: Estimates) -> EstimateScore:
        some = every.where(every.valid)
        distance, level = some.distances(), some.stated_levels()
        error = np.linalg.norm(some.error, axis=1)
        ratio = error / some.bound
        low, middle, high = _quantiles(ratio, (0.5, 0.95, 0.99))
        return cls(
            touches=len(every),
            valid=Share.of_mask(every.valid),
            coverage={stated: Share.of_mask(level <= stated) for stated in LEVELS},
            beyond_5_sigma=Share.of_mask(distance > MANY_SIGMA),
            ratio_rms=_rms(ratio),
            ratio_quantiles=(low, middle, high),
            rms_error=_rms(error),
            median_std=_quantiles(_component_std(some.covariance), (0.5,))[0],
            oracle_std=_quantiles(_component_std(some.oracle_covariance), (0.5,))[0],
            crps=mean_crps(some),
        )

    def row(self, unit: float = 1.0, *, bounds: bool = True) -> dict[str, Any]:
        """Return cells of a table: shares in %, with intervals; lengths or forces times `unit`.

        `bounds`: with oracle and bound.
        """
        few = f", fewer than {MIN_TOUCHES}" if self.touches < MIN_TOUCHES else ""
        cells = {
            "touches": f"{self.touches}{few}",
            "valid, %": self.valid,
            **{f"in {100 * level:g} %": share for level, share in self.coverage.items()},
            "> 5 sigma, %": self.beyond_5_sigma,
            "rms error": unit * self.rms_error,
            "median std": unit * self.median_std,
            "oracle": unit * self.oracle_std,
            "CRPS": unit * self.crps,
            "error / bound, rms": self.ratio_rms,
            "50 / 95 / 99 %": self.ratio_quantiles,
        }
        if not bounds:
            for head in ("oracle", "error / bound, rms", "50 / 95 / 99 %"):
                del cells[head]
        return cells


def slices(every: Estimates, by: str) -> Iterator[tuple[Any, Estimates]]:
    """Yield each value of a column, sorted, with its rows. Raises KeyError for an unknown column."""
    column = every.columns[by]
    for value in np.unique(column):
        yield value, every.where(column == value)


def bin_labels(values: ArrayLike, edges: Sequence[float], unit: str = "") -> NDArray[Any]:
    """Return a label (n,) for each value by the bin it is in; `edges` rise and bound the inner bins.

    Labels sort as the bins do: they begin with the bin's number.
    """
    ends = [f"{edge:g}" for edge in edges]
    names = [
        f"below {ends[0]}",
        *(f"{a} to {b}" for a, b in itertools.pairwise(ends)),
        f"{ends[-1]} and more",
    ]
    labels = np.array([f"{number}: {name} {unit}".strip() for number, name in enumerate(names, 1)])
    return np.asarray(labels[np.searchsorted(np.asarray(edges), np.asarray(values), side="right")])


def mean_crps(some: Estimates) -> float:
    """Mean continuous ranked probability score of normal estimates, in the unit of the quantity.

    For one component in closed form; for two its generalisation, the energy score E|X - x| - E|X - X'| / 2:
    pi / 2 times the mean over all directions of the score of the projections, as a length is pi / 2 times
    the mean of its projections' lengths. Literature: T. Gneiting and A. Raftery 2007, 4.2 and 4.3.
    """
    if not len(some):
        return np.nan
    if some.error.shape[1] == 1:
        return float(normal_crps(some.error[:, 0], np.sqrt(some.covariance[:, 0, 0])).mean())
    angle = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    direction = np.stack([np.cos(angle), np.sin(angle)])
    variance = np.einsum("ik,nij,jk->nk", direction, some.covariance, direction)
    return float(np.pi / 2 * normal_crps(some.error @ direction, np.sqrt(variance)).mean())


def normal_crps(error: ArrayLike, std: ArrayLike) -> FloatArray:
    """Return the score of normal distributions of standard deviation `std` whose means are off by `error`."""
    std = np.asarray(std, np.float64)
    z = np.asarray(error, np.float64) / std
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    return np.asarray(std * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi)))


def laplace_covariance(
    design: FloatArray, noise_std: ArrayLike, prior_std: ArrayLike, prior_information: ArrayLike = 0.0
) -> FloatArray:
    """Return the oracle's covariance (n, p, p): of a normal posterior about the true parameters.

    `design` (n, m, p): derivatives of m readings by p parameters at their true values; `noise_std`
    broadcasts to (n, m); `prior_std` (p,): of the world's own distribution, inf for what is estimated alone;
    `prior_information` (p, p): of other readings, beside it.
    No estimator that knows the distributions of hidden quantities, but not their values, can honestly state
    less.
    """
    weighted = design / np.broadcast_to(np.asarray(noise_std, np.float64), design.shape[:2])[..., None]
    information = np.swapaxes(weighted, 1, 2) @ weighted
    information += np.diag(np.asarray(prior_std, np.float64) ** -2.0) + np.asarray(
        prior_information, np.float64
    )
    scale = 1 / np.sqrt(np.diagonal(information, axis1=1, axis2=2))  # parameters differ by many orders
    scaled = information * scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :])


@dataclass(frozen=True)
class EventScore:
    """Detected events against true ones."""

    recall: Share
    precision: Share
    """Detections that match an event, of all but the repeated ones."""
    false_alarms: Rate
    repeated: int
    """Further detections of an event that was detected already."""
    delays_s: FloatArray
    """Of each matched event, sorted."""

    def delay_s(self, quantile: float) -> float:
        """Return a quantile of the delay; NaN if nothing was detected."""
        return _quantiles(self.delays_s, (quantile,))[0]

    def row(self) -> dict[str, Any]:
        """Return cells of a table, with intervals."""
        return {
            "events": self.recall.total,
            "recall, %": self.recall,
            "precision, %": self.precision,
            "delay, median / 95 % [ms]": " / ".join(f"{1e3 * self.delay_s(q):.0f}" for q in (0.5, 0.95))
            if len(self.delays_s)
            else "-",
            "repeated": self.repeated,
            "false alarms per hour": self.false_alarms,
        }


def score_events(
    truth: Iterable[tuple[Any, float]],
    detected: Iterable[tuple[Any, float]],
    *,
    hours: float,
    early_s: float = 0.0,
    late_s: float,
) -> EventScore:
    """Match detections to true events of the same key, each with its time [s], one to one.

    A detection matches an event from `early_s` before to `late_s` after it; as many as possible are matched,
    earlier ones first. One that matches no event is a false alarm, except within the window of a matched
    event. `hours`: observed time. Raises ValueError for a negative window.
    """
    if early_s < 0 or late_s < 0:
        raise ValueError(f"a window from -{early_s} to {late_s} s")
    events, alarms = _times_by_key(truth), _times_by_key(detected)
    delays: list[float] = []
    repeated = false = 0
    for key in {*events, *alarms}:
        at, waiting = events.get(key, []), alarms.get(key, [])
        matched: list[float] = []
        left: list[float] = []
        index = 0
        for time_s in waiting:
            while index < len(at) and at[index] + late_s < time_s:
                index += 1
            if index < len(at) and at[index] - early_s <= time_s:
                delays.append(time_s - at[index])
                matched.append(at[index])
                index += 1
            else:
                left.append(time_s)
        for time_s in left:
            first = bisect_left(matched, time_s - late_s)
            again = first < len(matched) and matched[first] - early_s <= time_s
            repeated += again
            false += not again
    return EventScore(
        Share(len(delays), sum(map(len, events.values()))),
        Share(len(delays), len(delays) + false),
        Rate(false, hours),
        repeated,
        np.sort(np.array(delays, np.float64)),
    )


def _times_by_key(events: Iterable[tuple[Any, float]]) -> dict[Any, list[float]]:
    found: dict[Any, list[float]] = defaultdict(list)
    for key, time_s in events:
        found[key].append(time_s)
    return {key: sorted(times) for key, times in found.items()}


def _component_std(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / covariance.shape[1]))


def _quantiles(values: FloatArray, at: Sequence[float]) -> list[float]:
    return np.quantile(values, at).tolist() if len(values) else [np.nan] * len(at)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
