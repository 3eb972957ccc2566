"""Stress of the ideal pad: against mpmath, over aspects and to the edges.

For each function and region, the worst error in units of eps times the condition of the problem, its limit,
and where it was. References are sums of images at 420 digits (fifty are left after what cancels in currents
of 1e-290), not the formulas under test. Conditions: of a fraction 1 + |ln f|, the relative change that a
relative rounding of the sides makes in it; of a coordinate |x| + sum over currents of |I dx / dI|, the change
that relative rounding of the currents makes in it; of a conformal radius 1; of a derivative that of its
fraction. Exit status 1 if one is worse.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

import mpmath as mp
import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, options
from handtouch.field import (
    Rectangle,
)

EPS = float(np.finfo(float).eps)


class Worst:
    """Keeps the worst of many errors of one function in one region, in eps x condition."""

    def __init__(self, function: str, region: str, limit: float) -> None:
        self.function, self.region, self.limit = function, region, limit
        self.cases, self.worst, self.where = 0, 0.0, ""

    def add(self, error: Any, condition: Any, where: object) -> None:
        """Compare one error; one that isn't finite is the worst."""
        finite = math.isfinite(float(error))
        ratio = float(abs(error) / (EPS * condition)) if finite else math.inf
        self.cases += 1
        if ratio >= self.worst:
            self.worst, self.where = ratio, str(where) if ratio else ""


def report_worst(report: Report, rows: Iterable[Worst]) -> int:
    """Keep the rows; return the exit status, 1 if one is beyond its limit."""
    table = [
        {
            "function": row.function,
            "region": row.region,
            "cases": row.cases,
            "worst, eps x condition": row.worst,
            "limit": row.limit,
            "met": row.worst <= row.limit,
            "worst input": row.where,
        }
        for row in rows
    ]
    report.table("Worst errors", table)
    report.limit("functions beyond their limit", sum(not row["met"] for row in table), 0)
    return int(not report.keep())


FloatArray = NDArray[np.float64]
LEAST = 1e-290
mp.mp.dps = 420


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


def accuracy(count: int) -> Iterator[Worst]:
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
        yield from (forward, absolute, slopes, radius, place, lost)


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


def main() -> int:
    quick = options(__doc__).parse_args().quick
    size = 2 if quick else 40
    warnings.simplefilter("error")
    with np.errstate(all="raise"):
        rows = list(accuracy(size))
    return report_worst(Report(quick, size=size), rows)


if __name__ == "__main__":
    sys.exit(main())
