"""Drawings of a pad as it is: expected location error as a map, and the effect of other design choices.

Public names: `draw_design`, `draw_map`, `draw_choices`. They need matplotlib, the extra `figures`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.field import ElectrodeNetwork, PlaneSurface
from handtouch.field.figures import (
    ACCENT,
    DPI,
    ERRATUM,
    INK,
    format_axes,
    new_figure,
)
from handtouch.hand.expected_error import FIRM_TOUCH_N, PadDesign, error_summary, expected_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAP_EDGE_FRACTION, _MAP_STEPS = 0.02, 61  # margin of the map, and its points per side


def draw_map(pad: PadDesign) -> Figure:
    """Draw the expected error over the unrolled pad, for a light and a firm touch."""
    figure = new_figure(10.0, 4.6)
    from matplotlib.colors import LogNorm

    steps = np.linspace(_MAP_EDGE_FRACTION, 1 - _MAP_EDGE_FRACTION, _MAP_STEPS)
    x, y = np.meshgrid(steps * pad.network.a, steps * pad.network.b)
    u, v = pad.surface.from_rectangle(x, y)
    _, width = pad.surface.from_rectangle(x, np.full_like(y, pad.surface.b))
    across = v - width / 2
    for axes, force in zip(figure.subplots(1, 2), (pad.light_touch_n, FIRM_TOUCH_N), strict=True):
        error = 1e3 * expected_error(pad, force, x, y)[0]
        scale = LogNorm(error.min(), np.quantile(error, 0.98))
        mesh = axes.pcolormesh(1e3 * u, 1e3 * across, error, norm=scale, cmap="viridis_r", shading="gouraud")
        levels = [level for level in _round_numbers() if error.min() < level < np.quantile(error, 0.95)]
        lines = axes.contour(1e3 * u, 1e3 * across, error, levels, colors="white", linewidths=0.8)
        axes.clabel(lines, fmt=_format_tick, fontsize=8)
        axes.set_aspect("equal")
        bar = figure.colorbar(mesh, ax=axes, shrink=0.9, format=_format_tick)
        bar.ax.minorticks_off()
        bar.set_ticks(levels)
        bar.ax.tick_params(labelsize=8)
        bar.set_label("expected error, mm", fontsize=8)
        middle, worst = (1e3 * value for value in error_summary(pad, force))
        title = f"{force:g} N: median {middle:.2g}, worst {worst:.2g} mm"
        format_axes(axes, title, "from electrode x0, mm", "from the centre line, mm")
        axes.grid(visible=False)
    figure.suptitle(
        f"{pad.name}: expected location error, mm (1 sigma), unrolled surface; numbers: inner 80 %",
        fontsize=10,
    )
    return figure


def draw_choices(pad: PadDesign) -> Figure:
    """Draw the error over aspect, gaps, series resistors and converter bits, one changed at a time."""
    figure = new_figure(9.6, 7.0)
    aspects, gaps, resistors, bits = figure.subplots(2, 2).flat
    network = pad.network
    area, gap = network.a * network.b, _mean_gap(network)
    shorter = min(network.a, network.b)

    def of_aspect(aspect: float) -> PadDesign:
        a, b = math.sqrt(area * aspect), math.sqrt(area / aspect)
        return replace(pad, surface=PlaneSurface(a, b), network=_evenly_gapped_network(a, b, gap, network))

    _plot_error_curve(aspects, pad, np.geomspace(0.25, 4, 17), of_aspect, network.a / network.b)
    aspects.set_xscale("log")
    aspects.set_xticks([0.25, 0.5, 1, 2, 4], ["1:4", "1:2", "1:1", "2:1", "4:1"])
    aspects.minorticks_off()
    format_axes(aspects, "Aspect, flat, area kept", "along x : along y", "expected error, mm")

    def of_gap(percent: float) -> PadDesign:
        return replace(
            pad, network=_evenly_gapped_network(network.a, network.b, percent / 100 * shorter, network)
        )

    _plot_error_curve(gaps, pad, np.linspace(0.5, 25, 15), of_gap, 100 * gap / shorter)
    format_axes(gaps, "Bare corners", "gap, % of the shorter side", "expected error, mm")

    # touching electrodes share their currents, so resistors need a gap
    apart = network if gap > 0 else _evenly_gapped_network(network.a, network.b, 1e-3 * shorter, network)

    def of_resistor(ohm: float) -> PadDesign:
        return replace(pad, network=apart.with_series_ohm((ohm,) * 4))

    alike = len(set(network.series_ohm)) == 1
    _plot_error_curve(
        resistors, pad, np.linspace(0, 1000, 15), of_resistor, network.series_ohm[0] if alike else None
    )
    format_axes(resistors, "Equal series resistors", "ohm", "expected error, mm")

    def of_bits(count: float) -> PadDesign:
        return replace(pad, bits=round(count))

    _plot_error_curve(bits, pad, np.arange(8.0, 19.0), of_bits, pad.bits)
    format_axes(bits, "Bits of the converter, sign included", "bits", "expected error, mm")
    figure.suptitle(f"{pad.name}: one choice varied at a time, inner 80 %; dots: as configured", fontsize=10)
    return figure


def draw_design(pad: PadDesign, out: Path, on_progress: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Write the drawings of a pad into the folder `out`, created if missing; return their paths.

    `on_progress` is called with a description of each drawing before it is made. Raises ImportError naming
    the extra without matplotlib, OSError if `out` cannot be written.
    """
    drawings: dict[str, Callable[[PadDesign], Figure]] = {"error": draw_map, "choices": draw_choices}
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for kind, draw in drawings.items():
        paths.append(out / f"{pad.name}_{kind}.png")
        on_progress(f"drawing {paths[-1]} ({len(paths)} of {len(drawings)})")
        draw(pad).savefig(paths[-1], dpi=DPI)
    return paths


def _plot_error_curve(
    axes: Axes,
    pad: PadDesign,
    values: Sequence[float] | FloatArray,
    variant: Callable[[float], PadDesign],
    configured: float | None,
) -> None:
    """Plot median and worst error over one design choice, for both forces."""
    for force, colour in ((pad.light_touch_n, ACCENT), (FIRM_TOUCH_N, INK)):
        middle, worst = 1e3 * np.array([error_summary(variant(float(v)), force) for v in values]).T
        axes.plot(values, middle, color=colour, label=f"{force:g} N, median")
        axes.plot(values, worst, "--", color=colour, linewidth=1, label=f"{force:g} N, worst")
        if configured is not None:
            axes.plot(
                [configured] * 2,
                1e3 * np.array(error_summary(variant(configured), force)),
                "o",
                color=ERRATUM,
            )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_format_tick)
    axes.legend(fontsize=7, frameon=False)


def _format_tick(value: float, _position: float = 0) -> str:
    return f"{value:g}"


def _round_numbers() -> list[float]:
    """Return 1, 2 and 5 times every power of ten."""
    return [digit * 10.0**decade for decade in range(-6, 3) for digit in (1, 2, 5)]


def _evenly_gapped_network(a: float, b: float, gap: float, like: ElectrodeNetwork) -> ElectrodeNetwork:
    """Return a network of four electrodes with equal gaps, sheet and resistors as of another pad."""
    return ElectrodeNetwork(a, b, gap, like.sheet_ohm_per_square, like.series_ohm)


def _mean_gap(network: ElectrodeNetwork) -> float:
    """Return the mean bare length at the ends of the electrodes, in the unit of the rectangle."""
    arcs = network.arcs
    return float(2 * (network.a + network.b) - np.diff(arcs).sum()) / (2 * len(arcs))
