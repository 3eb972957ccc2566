"""Measure location on an ideal pad, run time against error: ours, the paper's, and what else one would take.

Prints its tables and writes docs/benchmarks/field.md, field.json and field.png.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
import scipy
import skfem
from numpy.typing import NDArray
from page import made_by, options, output_folder
from ratio_table import RatioTable
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares
from skfem.models.poisson import laplace

from handtouch.field import (
    LocatorBank,
    Rectangle,
    estimate,
)
from handtouch.field.paper_methods import LogRatioTable, log_ratio, single_sum_fractions

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
Locator = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
Maker = Callable[[Rectangle], Locator]
Price = Callable[["Row"], float]

ROOT = Path(__file__).parent.parent
MARGIN = 0.05  # of a side, for the errors
CALLS = (1, 16, 60)
BULK = 100_000
BATCH_S = 0.02
BATCHES = 15
NOISE = 1e-7  # given to the likelihoods, which are timed without noise in the data


@dataclass(frozen=True)
class Row:
    """One method on one pad. Errors in shorter sides; call_us for 1, 16, 60 contacts; spread of them in %."""

    pad: str
    method: str
    worst: float
    rms: float
    permille: float
    call_us: tuple[float, float, float]
    bulk_us: float
    spread_percent: float


# What a user would take instead


def least_squares_on_sums(pad: Rectangle) -> Locator:
    """scipy's least_squares on eqs. 4-5, ten terms, one contact after the other."""
    return _one_by_one(pad, lambda x, y: single_sum_fractions(pad, x, y))


def finite_elements(pad: Rectangle) -> Locator:
    """scipy's least_squares on a forward model of quadratic elements, 64 a side."""
    sides = [np.linspace(0, side, 65) for side in (pad.a, pad.b)]
    mesh = skfem.MeshTri.init_tensor(*sides)
    basis = skfem.Basis(mesh, skfem.ElementTriP2())
    stiffness = skfem.asm(laplace, basis)
    x, y = basis.doflocs
    on = [x == 0, x == pad.a, y == 0, y == pad.b]
    boundary = np.flatnonzero(on[0] | on[1] | on[2] | on[3])
    count = np.sum(on, axis=0)
    potentials = []
    for side in on:
        values = np.where(side, 1.0 / np.maximum(count, 1), 0.0)
        potentials.append(skfem.solve(*skfem.condense(stiffness, x=values, D=boundary)))
    columns = np.stack(potentials, axis=1)

    def forward(px: float, py: float) -> FloatArray:
        found: FloatArray = np.asarray(basis.probes(np.array([[px], [py]])) @ columns)[0]
        return found

    return _one_by_one(pad, forward)


def _one_by_one(pad: Rectangle, forward: Callable[[float, float], FloatArray]) -> Locator:
    low, high = (1e-3 * pad.a, 1e-3 * pad.b), (0.999 * pad.a, 0.999 * pad.b)
    centre = (pad.a / 2, pad.b / 2)

    def misfit(point: FloatArray, fractions: FloatArray) -> FloatArray:
        return forward(float(point[0]), float(point[1])) - fractions

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = []
        for column in currents.T:
            fractions = column / column.sum()
            fit = least_squares(
                misfit, centre, bounds=(low, high), args=(fractions,), xtol=1e-12, ftol=1e-12, gtol=1e-12
            )
            found.append(fit.x)
        x, y = np.array(found).T
        return x, y

    return locate


def grid_interpolator(kind: Literal["linear", "cubic"], cells: int) -> Maker:
    """RegularGridInterpolator over eq. 8, as in a look-up table of one's own."""

    def make(pad: Rectangle) -> Locator:
        adjusted, table = LogRatioTable(pad, cells=0), LogRatioTable(pad, cells)
        places, origin, steps = table.correction_table
        axes = [origin[i] + steps[i] * np.arange(cells + 1) for i in range(2)]
        interpolator = RegularGridInterpolator(axes, places, method=kind, bounds_error=False, fill_value=None)

        def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
            found = interpolator(np.stack(adjusted.locate(currents), axis=-1))
            return found[..., 0], found[..., 1]

        return locate

    return make


# Ours


def exact(pad: Rectangle) -> Locator:
    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = pad.locate(currents)
        return found.x, found.y

    return locate


def likelihood(pad: Rectangle) -> Locator:
    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = estimate(pad, currents, NOISE)
        return found.x, found.y

    return locate


def tabulated_likelihood(pad: Rectangle) -> Locator:
    bank = LocatorBank([pad])

    def locate(currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = bank.estimate(np.zeros(currents.shape[1], dtype=np.intp), currents, NOISE)
        return found.x, found.y

    return locate


METHODS: dict[str, Maker] = {
    "log-ratio (eq. 8)": lambda pad: lambda currents: log_ratio(pad, currents),
    "log-ratio, adjusted (fig. 3)": lambda pad: LogRatioTable(pad, cells=0).locate,
    "log-ratio, corrected, 32 cells": lambda pad: LogRatioTable(pad).locate,
    "ratio table": lambda pad: RatioTable(pad).locate,
    "exact": exact,
    "likelihood, tabulated": tabulated_likelihood,
    "likelihood": likelihood,
}
PEERS: dict[str, Maker] = {
    "RegularGridInterpolator, linear 64": grid_interpolator("linear", 64),
    "RegularGridInterpolator, cubic 64": grid_interpolator("cubic", 64),
    "least_squares on eqs. 4-5": least_squares_on_sums,
    "least_squares on finite elements": finite_elements,
}
SLOW = {"least_squares on eqs. 4-5": 200, "least_squares on finite elements": 40}


def contacts(pad: Rectangle, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    x, y = np.random.default_rng(seed).uniform(MARGIN, 1 - MARGIN, (2, count)) * np.array([[pad.a], [pad.b]])
    return x, y, pad.side_fractions(x, y)


def microseconds(call: Callable[[], Any]) -> tuple[float, float]:
    """Median processor time of a call and the quartiles' distance from it in per cent."""
    begin = time.process_time()
    call()
    number = max(1, int(BATCH_S / (time.process_time() - begin)))
    samples = []
    for _ in range(BATCHES if number > 1 else 3):
        begin = time.process_time()
        for _ in range(number):
            call()
        samples.append((time.process_time() - begin) / number * 1e6)
    middle = statistics.median(samples)
    low, high = np.percentile(samples, [25, 75])
    return middle, 100 * float(high - low) / 2 / middle


def measure(label: str, pad: Rectangle, name: str, make: Maker, quick: bool) -> Row:
    locate = make(pad)
    x, y, currents = contacts(pad, CALLS[-1] if quick else SLOW.get(name, 20_000))
    found = locate(currents)
    error = np.hypot(found[0] - x, found[1] - y) / min(pad.a, pad.b)
    timed = [microseconds(partial(locate, np.ascontiguousarray(currents[:, :n]))) for n in CALLS]
    if quick or name in SLOW:
        bulk = timed[1][0] / CALLS[1], timed[1][1]
    else:
        bulk = microseconds(partial(locate, contacts(pad, BULK, seed=1)[2]))
        bulk = bulk[0] / BULK, bulk[1]
    spread = max(t[1] for t in (*timed, bulk))
    call_us = (timed[0][0], timed[1][0], timed[2][0])
    rms = float(np.sqrt(np.mean(error**2)))
    return Row(
        label, name, float(error.max()), rms, float(np.quantile(error, 0.999)), call_us, bulk[0], spread
    )


def table(rows: list[Row]) -> list[str]:
    lines = [
        "| method | worst | 99.9 % | rms | 1 contact | 16 | 60 | each of 1e5 | spread |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        calls = " | ".join(f"{t:.3g} us" for t in row.call_us)
        lines.append(
            f"| {row.method} | {row.worst:.1e} | {row.permille:.1e} | {row.rms:.1e} | {calls} "
            f"| {row.bulk_us:.3g} us | {row.spread_percent:.0f} % |"
        )
    return lines


def for_sixteen(row: Row) -> float:
    return row.call_us[1]


def in_bulk(row: Row) -> float:
    return row.bulk_us


def pareto(rows: list[Row], cost: Price) -> list[Row]:
    """Rows that no other beats in both cost and worst error."""
    return [r for r in rows if not any(cost(o) < cost(r) and o.worst <= r.worst for o in rows)]


def plot(rows: list[Row], path: Path) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(13, 6), sharey=True, layout="constrained")
    for axis, cost, label in (
        (axes[0], for_sixteen, "microseconds for 16 contacts in one call"),
        (axes[1], in_bulk, "microseconds for each of 100 000 contacts"),
    ):
        front = sorted(pareto(rows, cost), key=cost)
        axis.plot([cost(r) for r in front], [r.worst for r in front], color="0.7", zorder=1)
        for row in rows:
            ours = row.method in METHODS
            axis.scatter(cost(row), row.worst, color="tab:blue" if ours else "tab:orange", zorder=2)
            slow = cost(row) > 1e3
            axis.annotate(
                row.method,
                (cost(row), row.worst),
                textcoords="offset points",
                xytext=(-5 if slow else 5, 4),
                ha="right" if slow else "left",
                fontsize=8,
            )
        axis.set(xscale="log", yscale="log", xlabel=label)
        axis.margins(x=0.25)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("worst location error, sides of the square (5 % margin)")
    figure.suptitle(
        "Location on a square pad: blue in handtouch, orange what one would take instead; grey the front"
    )
    figure.savefig(path, dpi=110)


def verdicts(rows: list[Row]) -> list[str]:
    """The aims, and what was measured for them on the square."""
    by_name = {row.method: row for row in rows if row.pad == "1:1"}
    best, quick, rival = by_name["exact"], by_name["ratio table"], by_name["least_squares on eqs. 4-5"]
    square = list(by_name.values())
    fronts = [best in pareto(square, cost) for cost in (for_sixteen, in_bulk)]
    return [
        f"* exact, 16 contacts: {best.call_us[1]:.0f} us (aim 45), in bulk {best.bulk_us:.3f} us each "
        f"(aim 0.5), worst error {best.worst:.0e} of the side (aim 1e-11).",
        f"* table, 16 contacts: {quick.call_us[1]:.0f} us (aim 25), in bulk {quick.bulk_us:.3f} us each "
        f"(aim 0.12), worst error {quick.worst:.0e} (aim 1e-6).",
        f"* in bulk the exact method is {rival.bulk_us / best.bulk_us:.0f} times faster than least_squares "
        f"(aim 1000), at {best.worst:.0e} against {rival.worst:.0e}.",
        f"* the exact method is on the Pareto front: {fronts[0]} for 16 contacts, {fronts[1]} in bulk.",
    ]


def main() -> None:
    quick = options(__doc__).parse_args().quick
    rows: list[Row] = []
    page: list[str] = []
    for label, pad in (
        ("1:1", Rectangle(1.0, 1.0)),
        ("1.77:1", Rectangle(1.77, 1.0)),
        ("3:1", Rectangle(3.0, 1.0)),
    ):
        here = [measure(label, pad, name, make, quick) for name, make in {**METHODS, **PEERS}.items()]
        rows += here
        page += [f"## Pad {label}", "", *table(here), ""]
        print("\n".join(page[-len(here) - 5 :]), flush=True)
    aims = verdicts(rows)
    print("\n".join(aims))
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, {platform.system()}, "
        f"Python {platform.python_version()}, numpy {np.__version__}, scipy {scipy.__version__}, "
        f"scikit-fem {skfem.__version__}; load average {os.getloadavg()[0]:.1f}"
    )
    head = [
        "# Run time against error of location on an ideal pad",
        "",
        f"{made_by()}; {machine}.",
        "Errors are distances in shorter sides, over random contacts 5 % of a side and farther from the",
        "edges, without noise. Times are medians of processor time; the spread",
        "is half the distance between their quartiles, the largest of the four columns. Formulations of the",
        "exact method that were tried and rejected are in [formulations.md](formulations.md).",
        "",
        *aims,
        "",
        "![Pareto plot](field.png)",
        "",
    ]
    out = output_folder(quick)
    (out / "field.md").write_text("\n".join(head + page))
    record = {"machine": machine, "rows": [asdict(row) for row in rows]}
    (out / "field.json").write_text(json.dumps(record, indent=1) + "\n")
    plot([row for row in rows if row.pad == "1:1"], out / "field.png")


if __name__ == "__main__":
    main()
