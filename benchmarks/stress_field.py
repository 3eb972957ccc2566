"""Stress the ideal pad and the estimators: against mpmath, and with arguments of every kind.

Prints and writes to docs/benchmarks/stress_field.md, for each function and region, the worst error in units
of eps times the condition of the problem, its limit, and where it was. Exit status 1 if one is worse.

References are sums of images at 420 digits (fifty are left after what cancels in currents of 1e-290), not the
formulas under test. Conditions: of a fraction 1 + |ln f|, the relative change that a relative rounding of the
sides makes in it; of a coordinate |x| + sum over currents of |I dx / dI|, the change that relative rounding
of the currents makes in it; of a conformal radius 1; of a derivative that of its fraction.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mpmath as mp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.page import made_by, options, output_folder
from benchmarks.ratio_table import RatioTable
from handtouch.field import (
    Rectangle,
    estimate,
    point_test,
    resolvable_separation,
)
from handtouch.field.paper_methods import (
    LogRatioTable,
    double_sum_fractions,
    log_ratio,
    single_sum_fractions,
)

FloatArray = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
LEAST = 1e-290
ROOT = Path(__file__).parent.parent
mp.mp.dps = 420


class Row(NamedTuple):
    """The worst of one function in one region, in eps x condition."""

    function: str
    region: str
    cases: int
    worst: float
    limit: float
    where: str


class Worst:
    """Keeps the worst of many errors."""

    def __init__(self, function: str, region: str, limit: float) -> None:
        self.row = Row(function, region, 0, 0.0, limit, "")

    def add(self, error: Any, condition: Any, where: object) -> None:
        ratio = float(abs(error) / (EPS * condition)) if math.isfinite(float(error)) else math.inf
        if ratio >= self.row.worst:
            self.row = self.row._replace(worst=ratio, where=str(where))
        self.row = self.row._replace(cases=self.row.cases + 1)


# References


def long_fractions(a: Any, b: Any, x: Any, y: Any) -> list[Any]:
    """Fractions of x0, xa, y0, yb of a pad at least as long as wide, by images along it."""
    unit = mp.pi / b
    sine, cosine = mp.sin(unit * y), mp.cos(unit * y)
    count = int(440 / (2.7 * float(a / b))) + 3
    ends = [mp.mpf(0), mp.mpf(0)]
    for j in range(count):
        for end, distance in enumerate((x, a - x)):
            near, far = distance + 2 * j * a, 2 * (j + 1) * a - distance
            ends[end] += mp.atan2(sine, mp.sinh(unit * near)) - mp.atan2(sine, mp.sinh(unit * far))
    below = above = mp.mpf(0)
    for j in range(2 * count):
        for distance in (x + j * a, (j + 1) * a - x):
            growth = mp.exp(unit * distance)
            below += (-1) ** j * mp.atan2(sine, growth - cosine)
            above += (-1) ** j * mp.atan2(sine, growth + cosine)
    sides = [1 - y / b - 2 / mp.pi * below, y / b - 2 / mp.pi * above]
    return [2 / mp.pi * ends[0], 2 / mp.pi * ends[1], *sides]


def exact_fractions(a: float, b: float, x: Any, y: Any) -> list[Any]:
    a_, b_, x_, y_ = mp.mpf(a), mp.mpf(b), mp.mpf(x), mp.mpf(y)
    if a >= b:
        return long_fractions(a_, b_, x_, y_)
    y0, yb, x0, xa = long_fractions(b_, a_, y_, x_)
    return [x0, xa, y0, yb]


def exact_jacobian(a: float, b: float, x: float, y: float) -> list[list[Any]]:
    """Central differences with 420 digits; the step leaves 100 of them right."""
    rows = []
    for d in range(2):
        h = mp.mpf(10) ** -60 * min(x, a - x, y, b - y)
        ahead = exact_fractions(a, b, mp.mpf(x) + h * (1 - d), mp.mpf(y) + h * d)
        behind = exact_fractions(a, b, mp.mpf(x) - h * (1 - d), mp.mpf(y) - h * d)
        rows.append([(p - m) / (2 * h) for p, m in zip(ahead, behind, strict=True)])
    return rows


# Accuracy

REGIONS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    # exponents of ten: of the aspect, and of the distance from the nearest edge in sides
    "1:4 to 4:1, inside": ((-0.6, 0.6), (-1.5, -0.3)),
    "1:4 to 4:1, to 1e-12 of a side": ((-0.6, 0.6), (-12, -0.3)),
    "1:1000 to 1000:1, inside": ((-3, 3), (-1.5, -0.3)),
    "1:1000 to 1000:1, to 1e-12 of a side": ((-3, 3), (-12, -0.3)),
    "300:1 to 1000:1, near the middle": ((2.48, 3), (-0.36, -0.302)),
}


def cases(region: str, count: int) -> Iterator[tuple[float, float, float, float]]:
    generator = np.random.default_rng(len(region))
    aspects, places = REGIONS[region]
    for _ in range(count):
        aspect = 10.0 ** generator.uniform(*aspects)
        unit = 10.0 ** generator.uniform(-3, 3)
        sides = (unit * math.sqrt(aspect), unit / math.sqrt(aspect))
        near = 10.0 ** generator.uniform(*places, size=2)
        flip = generator.random(2) < 0.5
        x, y = (s - s * n if f else s * n for s, n, f in zip(sides, near, flip, strict=True))
        yield *sides, float(x), float(y)


def accuracy(count: int) -> Iterator[Row]:
    """Rectangle against the sums of images."""
    for region in REGIONS:
        forward = Worst("Rectangle.side_fractions", region, 20)
        absolute = Worst("Rectangle.side_fractions, absolute", region, 4)
        slopes = Worst("Rectangle.fractions_with_jacobian", region, 60)
        radius = Worst("Rectangle.conformal_radius", region, 20)
        place = Worst("Rectangle.locate", region, 20)
        lost = Worst("Rectangle.locate, lost coordinates not NaN", region, 0.5)
        for where in cases(region, count):
            a, b, x, y = where
            pad, exact, gradient = Rectangle(a, b), exact_fractions(*where), exact_jacobian(*where)
            jacobian = pad.fractions_with_jacobian(x, y)[1]
            for i, value in enumerate(pad.side_fractions(x, y)):
                absolute.add(mp.mpf(float(value)) - exact[i], 1, where)
                if exact[i] < LEAST:
                    continue
                condition = 1 + abs(mp.log(exact[i]))
                forward.add(mp.mpf(float(value)) / exact[i] - 1, condition, where)
                size = mp.hypot(gradient[0][i], gradient[1][i])
                for d in range(2):
                    error = mp.mpf(float(jacobian[i, d])) - gradient[d][i]
                    slopes.add(error / size, condition, where)
            i = max(range(4), key=lambda k: -abs(exact[k] - 0.5))
            size = mp.hypot(gradient[0][i], gradient[1][i])
            expected = 2 * mp.sin(mp.pi * exact[i]) / (mp.pi * size)
            radius.add(mp.mpf(float(pad.conformal_radius(x, y))) / expected - 1, 1, where)
            _locate(pad, exact, gradient, where, place, lost)
        yield from (forward.row, absolute.row, slopes.row, radius.row, place.row, lost.row)


def _locate(
    pad: Rectangle,
    exact: list[Any],
    gradient: list[list[Any]],
    where: tuple[float, float, float, float],
    place: Worst,
    lost: Worst,
) -> None:
    """Locate the rounded exact currents; a coordinate with both currents below LEAST is let off."""
    found = pad.locate([float(f) for f in exact])
    for d, (coordinate, true) in enumerate(((found.x, where[2]), (found.y, where[3]))):
        pair = exact[2 * d : 2 * d + 2]
        if max(pair) < mp.mpf(float(np.finfo(float).tiny)):
            lost.add(0 if math.isnan(coordinate) else EPS, 1, where)
        elif max(pair) >= LEAST:
            sensitivity = _sensitivity(exact, 2 * d, gradient[d])
            place.add(mp.mpf(float(coordinate)) - true, true + sensitivity, where)


def _sensitivity(f: list[Any], first: int, slope: list[Any]) -> Any:
    """Sum over currents of |I dx / dI|, for x found from ln(T0 / T1) of the pair that begins at `first`."""
    sides = (first, first + 1)
    lead = [mp.pi / mp.sin(mp.pi * f[i]) for i in sides]
    by_place = lead[0] * slope[sides[0]] - lead[1] * slope[sides[1]]
    total = mp.mpf(0)
    for j in range(4):
        moved = [lead[n] * f[i] * ((i == j) - f[j]) for n, i in enumerate(sides)]
        total += abs((moved[0] - moved[1]) / by_place)
    return total


# Arguments of every kind

PAD = Rectangle(1.5, 1.0)
TABLE, CORRECTED = RatioTable(PAD), LogRatioTable(PAD)
Call = Callable[..., Any]

OF_PLACES: dict[str, Call] = {
    "side_fractions": PAD.side_fractions,
    "fractions_with_jacobian": lambda x, y: PAD.fractions_with_jacobian(x, y)[1].reshape(8, *np.shape(x)),
    "conformal_radius": PAD.conformal_radius,
    "single_sum_fractions": lambda x, y: single_sum_fractions(PAD, x, y),
    "double_sum_fractions": lambda x, y: double_sum_fractions(PAD, x, y, terms=9),
    "resolvable_separation": lambda x, y: resolvable_separation(PAD, x, y, 1e-3),
}
OF_CURRENTS: dict[str, Call] = {
    "locate": lambda i: _columns(PAD.locate(i)),
    "estimate": lambda i: _columns(PAD.estimate(i, 1e-3)),
    "estimate, generic": lambda i: _columns(estimate(PAD, i, 1e-3)),
    "RatioTable.locate": lambda i: np.stack(TABLE.locate(i)),
    "LogRatioTable.locate": lambda i: np.stack(CORRECTED.locate(i)),
    "log_ratio": lambda i: np.stack(log_ratio(PAD, i)),
    "point_test": lambda i: np.asarray(point_test(PAD, i, 1e-3).score),
}


def _columns(found: Any) -> FloatArray:
    return np.stack([np.asarray(found.x), np.asarray(found.y), np.asarray(found.total)])


def arguments() -> Iterator[Row]:
    """Every function, arrays of every kind: the same numbers, NaN in its own element, no complaint."""
    generator = np.random.default_rng(5)
    x, y = generator.uniform(0.1, 0.9, (2, 6, 4)) * np.array([1.5, 1.0])[:, None, None]
    currents = PAD.side_fractions(x, y) + 1e-3 * generator.normal(size=(4, 6, 4))
    for name, call in OF_PLACES.items():
        yield _kinds(name, lambda p, call=call: call(p[0], p[1]), np.stack([x, y]))
    for name, call in OF_CURRENTS.items():
        yield _kinds(name, call, currents)


def _kinds(name: str, call: Call, given_: FloatArray) -> Row:
    """Largest difference from the plain call over kinds of array, in eps of the value."""
    worst = Worst(name, "kinds of array, NaN, infinity", 1e6 if "stimate" in name or "sep" in name else 64)
    plain = call(given_)

    def compare(kind: str, value: Any, expected: Any) -> None:
        if np.shape(value) != np.shape(expected) or (np.isnan(value) != np.isnan(expected)).any():
            worst.add(math.inf, 1, kind)
        elif np.size(value):
            same = np.equal(value, expected) | np.isnan(expected)
            with np.errstate(invalid="ignore"):
                error = np.where(same, 0.0, np.abs(value - expected))
            worst.add(float(error.max()), max(1.0, float(np.nanmax(np.abs(expected), initial=0))), kind)

    wide = np.zeros((*given_.shape[:-1], 2 * given_.shape[-1]))
    wide[..., ::2] = given_
    compare("strided", call(wide[..., ::2]), plain)
    frozen = given_.copy()
    frozen.flags.writeable = False
    compare("read only", call(frozen), plain)
    compare("Fortran order", call(np.asfortranarray(given_)), plain)
    single = given_.astype(np.float32)
    compare("float32", call(single), call(single.astype(np.float64)))
    compare("integers", call(np.ones(given_.shape, dtype=np.int16)), call(np.ones(given_.shape)))
    compare("empty", call(given_[..., :0]), plain[..., :0])
    for bad in (np.nan, np.inf, -np.inf):
        spoilt = given_.copy()
        spoilt[(0, *(1,) * (given_.ndim - 1))] = bad
        value, place = call(spoilt), (..., *(1,) * (given_.ndim - 1))
        expected = plain.copy()
        expected[place] = value[place]
        compare(str(bad), value, expected)
    return worst.row


# Search

magnitudes = st.floats(-300, 300).map(lambda e: 10.0**e)
anything = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)


def search(examples: int) -> Iterator[Row]:
    """Hypothesis looks for an argument that complains, leaves the pad or does not come back."""
    yield _search_places(examples)
    yield _search_currents(examples)
    yield _search_round_trips(examples)


def _search_places(examples: int) -> Row:
    worst = Worst("Rectangle, forward", "any sides, any numbers (hypothesis)", 4)

    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(magnitudes, st.floats(-3, 3), st.floats(0, 1) | anything, st.floats(0, 1) | anything)
    def attempt(side: float, aspect: float, u: float, v: float) -> None:
        pad = Rectangle(side, side * 10**aspect)
        x, y = pad.a * u, pad.b * v
        f = pad.side_fractions(x, y)
        inside = 0 <= x <= pad.a and 0 <= y <= pad.b
        assert np.isnan(f).all() != inside
        radius = float(pad.conformal_radius(x, y))
        assert math.isnan(radius) != inside
        assert not inside or 0 <= radius <= 1.1 * min(pad.a, pad.b)
        pad.fractions_with_jacobian(x, y)
        if inside:
            assert (f >= 0).all()
            worst.add(float(f.sum()) - 1, 1, (pad.a, pad.b, x, y))

    attempt()
    return worst.row


def _search_currents(examples: int) -> Row:
    worst = Worst("locate, estimate, tables", "any currents, any noise (hypothesis)", 0.5)

    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(st.lists(anything, min_size=4, max_size=4), anything)
    def attempt(readings: list[float], noise: float) -> None:
        currents = np.array([readings, [1.0, 2.0, 1.0, 1.0]]).T
        for call in OF_CURRENTS.values():
            call(currents)
        for found in (
            PAD.locate(currents),
            PAD.estimate(currents, noise),
        ):
            for coordinate, side in ((found.x, PAD.a), (found.y, PAD.b)):
                off = ~(((coordinate >= 0) & (coordinate <= side)) | np.isnan(coordinate))
                worst.add(EPS * float(off.sum()), 1, (readings, noise))

    attempt()
    return worst.row


def _search_round_trips(examples: int) -> Row:
    worst = Worst("locate after side_fractions", "any scale, 1e-12 from edges (hypothesis)", 100)
    near = st.tuples(st.floats(-12, math.log10(0.5)), st.booleans())

    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(magnitudes, st.floats(-2, 2), near, near, magnitudes)
    def attempt(
        side: float, aspect: float, u: tuple[float, bool], v: tuple[float, bool], current: float
    ) -> None:
        pad = Rectangle(side, side * 10**aspect)
        x, y = (
            s * 10.0 ** n[0] if n[1] else s - s * 10.0 ** n[0]
            for s, n in zip((pad.a, pad.b), (u, v), strict=True)
        )
        with np.errstate(under="ignore"):
            currents = pad.side_fractions(x, y) * current
        if currents.min() > 1e-290:
            found = pad.locate(currents)
            worst.add((found.x - x) / pad.a, max(x / pad.a, 1e-3), (pad.a, pad.b, x, y, current))
            worst.add((found.y - y) / pad.b, max(y / pad.b, 1e-3), (pad.a, pad.b, x, y, current))

    attempt()
    return worst.row


def main() -> int:
    parser = options(__doc__)
    parser.add_argument(
        "--size", type=int, default=40, help="cases of a region; 20 times as many of a search"
    )
    asked = parser.parse_args()
    size = 2 if asked.quick else asked.size
    warnings.simplefilter("error")
    with np.errstate(all="raise"):
        rows = [*accuracy(size), *arguments(), *search(20 * size)]
    lines = [
        "| function | region | cases | worst, eps x condition | limit | worst input |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        figures = f"{r.cases} | {r.worst:.3g} | {r.limit:g}"
        lines.append(f"| {r.function} | {r.region} | {figures} | {r.where} |")
    page = ["# Stress of the ideal pad and the estimators", "", f"{made_by()}.", ""]
    page += (__doc__ or "").split("\n\n", 1)[1].strip().splitlines()
    print("\n".join(lines))
    (output_folder(asked.quick) / "stress_field.md").write_text("\n".join([*page, "", *lines]) + "\n")
    failed = [r for r in rows if not r.worst <= r.limit]
    print(f"{len(failed)} of {len(rows)} beyond their limit")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
