"""Current against force on logarithmic axes, with the law and its band: for a terminal, and as PNG.

Public names: `sketch`, `draw`. `draw` needs matplotlib, the extra `figures`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.procedures.calibrate.fit import LawFit
from handtouch.procedures.calibrate.readings import ContactCircuit, WeightReading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH, _HEIGHT = 60, 15
_FORCE_MARGIN = 1.3  # range of the plot beyond the lightest and heaviest weight
_INK, _FIT, _BAND, _FAINT = "#1a1a1a", "#1f6fb4", "#1f6fb4", "#8a8a8a"
_MARKS = ("o", "s", "^", "D")
_DPI = 150


def sketch(fit: LawFit, readings: Sequence[WeightReading], circuits: Sequence[ContactCircuit]) -> str:
    """Return a sketch: o for a reading, dots for the band, dashes for the law of the first indenter."""
    radius = readings[0].weight.radius_m
    force = np.array([reading.apparent_n for reading in readings])
    current = np.log([reading.current_a for reading in readings])
    grid = np.geomspace(force.min() / _FORCE_MARGIN, force.max() * _FORCE_MARGIN, _WIDTH)
    law, half = fit.band(grid, _median_circuit(circuits), radius)
    low, high = min((law - half).min(), current.min()), max((law + half).max(), current.max())
    low, high = max(low, current.min() - 1.5), min(high, current.max() + 1.5)
    page = [[" "] * _WIDTH for _ in range(_HEIGHT)]

    def row(value: float) -> int:
        return round(float((high - value) / (high - low)) * (_HEIGHT - 1))

    for column in range(_WIDTH):
        for line in range(row(law[column] + half[column]), row(law[column] - half[column]) + 1):
            if 0 <= line < _HEIGHT:
                page[line][column] = "."
        if 0 <= row(law[column]) < _HEIGHT:
            page[row(law[column])][column] = "-"
    columns = np.log(force / grid[0]) / math.log(grid[-1] / grid[0]) * (_WIDTH - 1)
    for column, value in zip(columns, current, strict=True):
        page[row(value)][round(float(column))] = "o"
    lines = [f"{_axis_label(row_, low, high):>9} |{''.join(cells)}" for row_, cells in enumerate(page)]
    ends = f"{grid[0]:.2g} N", f"{grid[-1]:.2g} N"
    gap = " " * (_WIDTH - len(ends[0]) - len(ends[1]))
    return "\n".join([*lines, f"{'':>9} +{'-' * _WIDTH}", f"{'':>11}{ends[0]}{gap}{ends[1]}"])


def draw(
    path: Path, pad: str, fit: LawFit, readings: Sequence[WeightReading], circuits: Sequence[ContactCircuit]
) -> None:
    """Write a PNG: current against force, and the contact's part of the resistance, as in the paper's 4.3.

    Raises ImportError without matplotlib, OSError.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure = Figure(figsize=(10, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    radii = sorted({reading.weight.radius_m for reading in readings})
    for number, radius in enumerate(radii):
        chosen = [k for k, reading in enumerate(readings) if reading.weight.radius_m == radius]
        mine, around = [readings[k] for k in chosen], [circuits[k] for k in chosen]
        mark = _MARKS[number % len(_MARKS)]
        label = f"readings, radius {1e3 * radius:g} mm" if len(radii) > 1 else "readings"
        _plot_current(left, fit, mine, around, mark, label)
        _plot_contact_resistance(right, fit, mine, around, mark, label)
    law, intervals = fit.law, fit.intervals
    left.set(xlabel="force [N]", ylabel="total current [mA]", title="Current")
    left.legend(frameon=False, fontsize=9)
    right.set(xlabel="force [N]", ylabel="V / I - plane [kΩ]", title="Resistance of the contact")
    right.legend(frameon=False, fontsize=9)
    for axes in (left, right):
        axes.grid(visible=True, which="both", color="#e4e4e4", linewidth=0.6)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    sheet = f"sheet {law.ohm_per_square:.0f} Ω/sq" + ("" if fit.sheet_observed else " (the file's)")
    alpha = intervals["alpha"]
    figure.suptitle(
        f"{pad}: k = {law.contact_ohm_mm2:.5g} Ω mm², alpha = {law.alpha:.3f} "
        f"({alpha.low:.2f} to {alpha.high:.2f}), {sheet}, scatter {fit.scatter:.1%} of the load",
        fontsize=11,
    )
    figure.savefig(path, dpi=_DPI)


def _plot_current(
    axes: Axes,
    fit: LawFit,
    readings: Sequence[WeightReading],
    circuits: Sequence[ContactCircuit],
    mark: str,
    label: str,
) -> None:
    force = np.array([reading.apparent_n for reading in readings])
    grid = np.geomspace(force.min() / _FORCE_MARGIN, force.max() * _FORCE_MARGIN, 200)
    law, half = fit.band(grid, _median_circuit(circuits), readings[0].weight.radius_m)
    axes.fill_between(grid, 1e3 * np.exp(law - half), 1e3 * np.exp(law + half), color=_BAND, alpha=0.2, lw=0)
    axes.loglog(grid, 1e3 * np.exp(law), color=_FIT, label=_unique_label(axes, "law, with its 95 % band"))
    current = [1e3 * reading.current_a for reading in readings]
    axes.loglog(force, current, mark, color=_INK, markersize=5, fillstyle="none", label=label)


def _plot_contact_resistance(
    axes: Axes,
    fit: LawFit,
    readings: Sequence[WeightReading],
    circuits: Sequence[ContactCircuit],
    mark: str,
    label: str,
) -> None:
    """Plot V / I less the plane's part, a line of slope -alpha (if A is constant)."""
    stated_m, circuit = readings[0].weight.radius_m, _median_circuit(circuits)
    force = np.array([reading.apparent_n for reading in readings])
    radii = fit.radius_m(force, stated_m)
    plane = np.array([_sheet_resistance(fit, *one) for one in zip(circuits, radii, strict=True)])
    drive = np.array([one.drive_v for one in circuits])
    contact = drive / np.array([reading.current_a for reading in readings]) - plane
    grid = np.geomspace(force.min() / _FORCE_MARGIN, force.max() * _FORCE_MARGIN, 200)
    law, _ = fit.band(grid, circuit, readings[0].weight.radius_m)
    line = circuit.drive_v / np.exp(law) - _sheet_resistance(fit, circuit, fit.radius_m(grid, stated_m))
    slope = fit.law.alpha if fit.law.hertz_force_n is None else (fit.law.alpha + 2) / 3
    legend = f"law, slope -{slope:.2f} where it is straight"
    axes.loglog(grid, line / 1e3, color=_FIT, label=_unique_label(axes, legend))
    above = contact > 0
    kiloohm = contact[above] / 1e3
    axes.loglog(force[above], kiloohm, mark, color=_INK, markersize=5, fillstyle="none", label=label)
    if lost := int((contact <= 0).sum()):
        axes.text(0.03, 0.03, f"{lost} readings lie below the plane", transform=axes.transAxes, color=_FAINT)


def _unique_label(axes: Axes, label: str) -> str:
    """Return the label, or none if it exists already."""
    return "_" if label in axes.get_legend_handles_labels()[1] else label


def _sheet_resistance(fit: LawFit, circuit: ContactCircuit, radius_m: FloatArray) -> FloatArray:
    """Return the resistance [ohm] of sheet and resistors under contacts of no resistance."""
    sheet = fit.law.ohm_per_square / (2 * math.pi)
    return np.asarray(sheet * np.log(circuit.spreading_m / radius_m) + circuit.series_ohm)


def _median_circuit(circuits: Sequence[ContactCircuit]) -> ContactCircuit:
    """Return the circuit of median spreading radius."""
    return sorted(circuits, key=lambda circuit: circuit.spreading_m)[len(circuits) // 2]


def _axis_label(line: int, low: float, high: float) -> str:
    if line % 7:
        return ""
    return f"{1e3 * math.exp(high - line / (_HEIGHT - 1) * (high - low)):.3g} mA"
