"""Chooser: the cheapest method that locates well enough on this pad and noise, by its measured error map.

Public: `choose`, `Choice`, `ErrorMap`, `Cost`, `methods_for`, `method_for`. Each method is tried on currents
of the pad's own forward model with noise drawn on a grid of contacts, so that what a method leaves out
(corner gaps, resistors, the other two currents) counts as much as its arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from handtouch.field.bank import LocatorBank
from handtouch.field.classic import LogRatioTable, log_ratio
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.model import FloatArray, ForwardModel
from handtouch.field.ratio_table import RatioTable
from handtouch.field.rectangle import Location, Rectangle

Locator = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

_RATIOS = "ratio table"
_DRAWS = 48  # of the noise at each place
_PLACES = 19  # a side
_AS_GOOD = 1.05  # times the least error of any method counts as reaching it


@dataclass(frozen=True)
class Cost:
    """Microseconds of a call and of each contact in it."""

    call_us: float
    contact_us: float

    def of(self, contacts: int) -> float:
        """Microseconds of one call with so many contacts."""
        return self.call_us + self.contact_us * contacts


# Medians of benchmarks/bench_field.py (docs/benchmarks/field.md); only their order decides.
COSTS: Mapping[str, Cost] = {
    "log-ratio": Cost(4.1, 0.002),
    "log-ratio, adjusted": Cost(4.5, 0.003),
    "ratio table": Cost(15.0, 0.026),
    "log-ratio, corrected": Cost(26.0, 0.062),
    "exact": Cost(31.0, 0.07),
    "likelihood, tabulated": Cost(130.0, 3.2),
    "likelihood": Cost(2000.0, 4.5),
}


@dataclass(frozen=True)
class ErrorMap:
    """What a method was measured to be off by on a pad; unit of its sides.

    x, y: places, (n, n). error: root mean square distance between true and located, over draws of the noise
    there, (n, n); infinite where a draw gave no location. cost_us: of a call, as asked for.
    """

    method: str
    x: FloatArray
    y: FloatArray
    error: FloatArray
    cost_us: float

    @property
    def worst(self) -> float:
        """The largest error on the map."""
        return float(self.error.max())


@dataclass(frozen=True)
class Choice:
    """The method chosen. locate: currents (4, n) and noise (4, n), one unit, to x (n,) and y (n,).

    meets: whether its error is within the tolerance everywhere; if no method's is, the choice is the cheapest
    of those that come within 5 % of the best. maps: of every method tried, cheapest first.
    """

    method: str
    locate: Locator
    meets: bool
    error: float
    maps: tuple[ErrorMap, ...]


def choose(
    model: ForwardModel,
    tolerance: float,
    noise: ArrayLike,
    contacts: int = 1,
    margin: float = 0.05,
    costs: Mapping[str, Cost] = COSTS,
    seed: int = 0,
) -> Choice:
    """Return the cheapest method whose error stays within `tolerance` all over the pad.

    tolerance: root mean square error allowed at any place, unit of the sides. noise: standard deviation of
    each channel per total current, broadcastable against (4,). contacts: located in one call. margin: of a
    side, where contacts are not expected. Raises ValueError for a tolerance or margin that cannot be.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance = {tolerance!r}: an error allowed is positive")
    if not 0 <= margin < 0.5:
        raise ValueError(f"margin = {margin!r}: it is at least 0 and less than half a side")
    sigma = np.broadcast_to(np.asarray(noise, dtype=np.float64), (4,))
    methods = sorted(methods_for(model).items(), key=lambda item: costs[item[0]].of(contacts))
    maps = tuple(
        _measure(name, locate, model, sigma, margin, costs[name].of(contacts), seed)
        for name, locate in methods
    )
    allowed = max(tolerance, _AS_GOOD * min(m.worst for m in maps))
    chosen = next((m for m in maps if m.worst <= allowed), maps[-1])
    return Choice(chosen.method, dict(methods)[chosen.method], chosen.worst <= tolerance, chosen.worst, maps)


def methods_for(model: ForwardModel) -> dict[str, Locator]:
    """The methods that a pad of this shape allows, by name; all but the likelihoods take it for ideal."""
    return {name: method_for(model, name) for name in COSTS if name != _RATIOS or _has_ratios(model)}


def method_for(model: ForwardModel, name: str) -> Locator:
    """One of the methods in `COSTS`. Raises ValueError where there is none, or none for a pad so long."""
    pad = Rectangle(model.a, model.b)
    if name == "log-ratio":
        return _without_noise(lambda currents: log_ratio(pad, currents))
    if name == "log-ratio, adjusted":
        return _without_noise(LogRatioTable(pad, cells=0).locate)
    if name == "log-ratio, corrected":
        return _without_noise(LogRatioTable(pad).locate)
    if name == _RATIOS and _has_ratios(model):
        return _without_noise(RatioTable(pad).locate)
    if name == "exact":
        return _without_noise(lambda currents: _place(pad.locate(currents)))
    if name == "likelihood":
        return lambda currents, noise: _place(estimate(model, currents, noise))
    if name != "likelihood, tabulated":
        raise ValueError(
            f'no method "{name}" for a pad of {model.a:.4g} x {model.b:.4g}; there are {[*COSTS]}'
        )
    bank = LocatorBank([model])
    return lambda currents, noise: _place(
        bank.estimate(np.zeros(currents.shape[1], dtype=np.intp), currents, noise)
    )


def _has_ratios(model: ForwardModel) -> bool:
    return max(model.a / model.b, model.b / model.a) <= RatioTable.LONGEST_ASPECT


def _place(found: Location | PointEstimate) -> tuple[FloatArray, FloatArray]:
    return found.x, found.y


def _without_noise(locate: Callable[[FloatArray], tuple[FloatArray, FloatArray]]) -> Locator:
    """A locator that makes no use of the noise."""
    return lambda currents, _noise: locate(currents)


def _measure(
    name: str,
    locate: Locator,
    model: ForwardModel,
    sigma: FloatArray,
    margin: float,
    cost_us: float,
    seed: int,
) -> ErrorMap:
    """Try one method all over the pad; the same noise for every method."""
    side = np.linspace(margin, 1 - margin, _PLACES)
    x, y = np.meshgrid(model.a * side, model.b * side)
    draws = np.random.default_rng(seed).normal(size=(4, _DRAWS, x.size))
    currents = model.fractions(x.ravel(), y.ravel())[:, None] + sigma[:, None, None] * draws
    levels = np.broadcast_to(sigma[:, None], (4, _DRAWS * x.size))
    with np.errstate(all="ignore"):
        found = locate(currents.reshape(4, -1), levels)
        squared = sum((f.reshape(_DRAWS, -1) - p.ravel()) ** 2 for f, p in zip(found, (x, y), strict=True))
        error = np.sqrt(np.mean(squared, axis=0)).reshape(x.shape)
    return ErrorMap(name, x, y, np.where(np.isnan(error), np.inf, error), cost_us)
