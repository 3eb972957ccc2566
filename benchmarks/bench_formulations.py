"""Measure formulations of the exact location that were tried for Rectangle.locate, and what they lost by.

Prints its table and writes docs/benchmarks/formulations.md and formulations.json. All take currents of an
ideal pad, shape (4, n), and return x and y.
"""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.special import elliprf

from benchmarks.page import made_by, options, output_folder, progress
from benchmarks.ratio_table import RatioTable
from handtouch.field import Rectangle

FloatArray = NDArray[np.float64]
Locator = Callable[[FloatArray], tuple[FloatArray, FloatArray]]

ROOT = Path(__file__).parent.parent
PADS = {"1:1": (1.0, 1.0), "1.77:1": (1.77, 1.0), "1:1.77": (1.0, 1.77), "10:1": (10.0, 1.0)}
MARGIN = 1e-3  # of a side
BULK = 100_000


def half_plane(pad: Rectangle) -> Locator:
    """Circles in the half plane, sent to lines from the corner (a, 0), and a complex R_F; as written."""
    k, quarter, _ = _moduli(pad)

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        f = currents / currents.sum(axis=0)
        x, y = _half_plane(k, f)
        return pad.a / 2 + x * (pad.a / 2 / quarter), y * (pad.a / 2 / quarter)

    return locate


def half_plane_long_side(pad: Rectangle) -> Locator:
    """The same with the longer side always on the real axis."""
    if pad.a >= pad.b:
        return half_plane(pad)
    turned = half_plane(Rectangle(pad.b, pad.a))

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        y, x = turned(currents[[2, 3, 1, 0]])
        return pad.a - x, y

    return locate


def _moduli(pad: Rectangle) -> tuple[float, float, float]:
    """k, K and K' of the rectangle whose K' / K is 2 b / a, from the nome."""
    q = math.exp(-2 * math.pi * pad.b / pad.a)
    three = 1.0 + 2 * sum(math.pow(q, n * n) for n in range(1, 30))
    two = 2 * math.pow(q, 0.25) * sum(math.pow(q, n * (n + 1)) for n in range(30))
    k = (two / three) ** 2
    return k, math.pi / 2 * three * three, math.pi * three * three * pad.b / pad.a


def _half_plane(k: float, f: FloatArray) -> tuple[FloatArray, FloatArray]:
    """z = sn^-1(w), w on the circles that see [-1, 1] under pi f_y0 and [1, 1 / k] under pi f_xa."""
    with np.errstate(all="ignore"):
        # Seen from the corner 1, zeta = 1 / (w - 1): the ends -1 and 1 / k lie at -1 / 2 and k / (1 - k), and
        # the angles of the two sides become directions of lines through them.
        left, right = -0.5, k / (1 - k)
        slope_left, slope_right = np.tan(np.pi * f[2]), np.tan(np.pi * f[1])
        real = (slope_left * left + slope_right * right) / (slope_left + slope_right)
        imaginary = -np.abs((real - left) * slope_left)
        w = 1 + 1 / (real + 1j * imaginary)
        z = w * elliprf(1 - w * w, 1 - (k * w) ** 2, np.ones_like(w))
    return z.real, z.imag


def real_integral(pad: Rectangle) -> Locator:
    """The separable form, its last step by scipy's real Carlson R_F."""
    k = np.array([[_moduli(pad)[0]], [_moduli(Rectangle(pad.b, pad.a))[0]]])[::-1]
    scale = np.array([[pad.a / 1.0], [pad.b / 1.0]])
    whole = np.array([[_moduli(Rectangle(pad.b, pad.a))[2]], [_moduli(pad)[2]]])

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        tangents = np.tan(np.pi / 2 / currents.sum(axis=0) * currents)
        squared = k * tangents[::2] / tangents[1::2]
        x, y = elliprf(squared, squared + k * k, squared + 1) * (scale / whole)
        return x, y

    return locate


def newton_on_images(pad: Rectangle) -> Locator:
    """Newton on the sums of images (theory.md, section 2), from the ratio of half-angle tangents."""

    def image_sums(x: FloatArray, y: FloatArray) -> FloatArray:
        a, b = pad.a, pad.b
        sides = ((a, b, x, y), (a, b, a - x, y), (b, a, y, x), (b, a, b - y, x))
        return np.stack([_images(*side) for side in sides])

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        f = currents / currents.sum(axis=0)
        logs = np.log(np.tan(np.pi / 2 * f))
        target = logs[1::2] - logs[::2]
        sides, other = np.array([[pad.a], [pad.b]]), np.array([[pad.b], [pad.a]])
        place = np.clip(sides / 2 + other / (2 * np.pi) * target, 0.02 * sides, 0.98 * sides)
        h = 1e-6
        for _ in range(8):
            value, ahead = (_log_ratio(image_sums(*(place + d))) for d in (0.0, np.array([[h], [h]])))
            step = (target - value) / ((ahead - value) / h)  # each ratio depends on its own coordinate alone
            place = np.clip(place + step, place * 0.1, sides - (sides - place) * 0.1)
        return place[0], place[1]

    return locate


def _log_ratio(fractions: FloatArray) -> FloatArray:
    logs = np.log(np.tan(np.pi / 2 * fractions))
    return np.asarray(logs[1::2] - logs[::2])


def _images(depth: float, length: float, distance: FloatArray, along: FloatArray) -> FloatArray:
    """Fraction of one side by images beyond the sides at 0 and `depth`."""
    sine, unit = np.sin(np.pi * along / length), np.pi / length
    total = np.zeros_like(distance)
    for j in range(max(3, math.ceil(6 * length / depth))):
        near, far = distance + 2 * j * depth, 2 * (j + 1) * depth - distance
        total += np.arctan2(sine, np.sinh(unit * near)) - np.arctan2(sine, np.sinh(unit * far))
    return 2 / np.pi * total


def polynomial(degree: int, pad: Rectangle) -> Locator:
    """The separable form, its last step a Chebyshev polynomial in the bounded ratio u of RatioTable."""
    nodes = np.cos(np.pi * (np.arange(2 * degree) + 0.5) / (2 * degree))
    k = [_moduli(Rectangle(pad.b, pad.a)), _moduli(pad)]
    coefficients = []
    for (modulus, _, whole), side in zip(k, (pad.a, pad.b), strict=True):
        squared = modulus * ((1 + nodes) / (1 - nodes)) ** 2
        exact = side / whole * elliprf(squared, squared + modulus * modulus, squared + 1)
        coefficients.append(chebyshev.chebfit(nodes, exact, degree))

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        roots = np.sqrt(np.tan(np.pi / 2 / currents.sum(axis=0) * currents))
        u = (roots[::2] - roots[1::2]) / (roots[::2] + roots[1::2])
        x, y = (chebyshev.chebval(u[i], coefficients[i]) for i in range(2))
        return x, y

    return locate


def adopted(pad: Rectangle) -> Locator:
    """The separable form, its last step by Landen's transformation: Rectangle.locate, residual included."""

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = pad.locate(currents)
        return found.x, found.y

    return locate


FORMULATIONS: dict[str, Callable[[Rectangle], Locator]] = {
    "half plane, complex R_F": half_plane,
    "half plane, long side on the axis": half_plane_long_side,
    "Newton on image sums": newton_on_images,
    "separable, real R_F": real_integral,
    "separable, Chebyshev 24": partial(polynomial, 24),
    "separable, Chebyshev 48": partial(polynomial, 48),
    "separable, cubic table": lambda pad: RatioTable(pad).locate,
    "separable, Landen (adopted)": adopted,
}


@dataclass(frozen=True)
class Row:
    """One formulation on one pad: worst error in shorter sides, microseconds of processor time."""

    pad: str
    formulation: str
    worst: float
    sixteen_us: float
    bulk_us: float


def microseconds(call: Callable[[], Any]) -> float:
    """Median processor time of a call."""
    begin = time.process_time()
    call()
    number = max(1, int(0.02 / max(time.process_time() - begin, 1e-6)))
    samples = []
    for _ in range(9 if number > 1 else 3):
        begin = time.process_time()
        for _ in range(number):
            call()
        samples.append((time.process_time() - begin) / number * 1e6)
    return statistics.median(samples)


def measure(label: str, pad: Rectangle, name: str, bulk: int) -> Row | None:
    if name == "separable, cubic table" and max(pad.a, pad.b) > RatioTable.LONGEST_ASPECT * min(pad.a, pad.b):
        return None
    locate = FORMULATIONS[name](pad)
    x, y = np.random.default_rng(0).uniform(MARGIN, 1 - MARGIN, (2, bulk)) * np.array([[pad.a], [pad.b]])
    currents = pad.side_fractions(x, y)
    with np.errstate(all="ignore"):
        found = locate(currents)
        error = np.hypot(found[0] - x, found[1] - y) / min(pad.a, pad.b)
        sixteen = np.ascontiguousarray(currents[:, :16])
        times = microseconds(partial(locate, sixteen)), microseconds(partial(locate, currents)) / bulk
    progress(f"pad {label}: {name}")
    return Row(label, name, float(np.where(np.isnan(error), np.inf, error).max()), *times)


def main() -> None:
    quick = options(__doc__).parse_args().quick
    bulk = 100 if quick else BULK
    rows = [
        measure(label, Rectangle(*sides), name, bulk)
        for label, sides in PADS.items()
        for name in FORMULATIONS
    ]
    lines = ["| pad | formulation | worst error | 16 contacts | each of 1e5 |", "|---|---|---|---|---|"]
    kept = [row for row in rows if row is not None]
    for r in kept:
        times = f"{r.sixteen_us:.3g} us | {r.bulk_us:.3g} us"
        lines.append(f"| {r.pad} | {r.formulation} | {r.worst:.1e} | {times} |")
    print("\n".join(lines))
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, "
        f"numpy {np.__version__}, scipy {scipy.__version__}; load average {os.getloadavg()[0]:.1f}"
    )
    head = [
        "# Formulations of the exact location",
        "",
        f"{made_by()}; {machine}.",
        "Contacts 0.1 % of a side and farther from the edges; errors in shorter sides against the positions",
        "that produced the currents; medians of processor time. Only the adopted one returns the residual",
        "as well, and only it is designed for aspect ratios from 1e-3 to 1e3 (`make stress`). The separable",
        "form itself, in which each coordinate has a ratio of its own, is new here; it has a smaller error",
        "than the half plane of theory.md and is faster in bulk, whatever its last step.",
        "",
    ]
    out = output_folder(quick)
    (out / "formulations.md").write_text("\n".join(head + lines) + "\n")
    record = {"machine": machine, "rows": [asdict(row) for row in kept]}
    (out / "formulations.json").write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
