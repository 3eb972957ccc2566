"""What a pad will be able to tell: its expected location error as a map, and what other choices would make of
it.

Public names: `PadDesign`, `expected_error`, `draw_map`, `draw_choices`, `design_of`, `run`. Drawing needs
matplotlib, the extra `figures`.

Errors are Cramer-Rao bounds (which the estimator reaches) for the noise of the converter, quantisation
included, at the current that a given force makes flow there.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handtouch import config
from handtouch.field import ContactLaw, ElectrodeNetwork, Plane, Surface
from handtouch.figures import ACCENT, DPI, ERRATUM, INK, new_figure, tidy
from handtouch.hand import network_of, surface_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]

FIRM_N = 1.0
MARGIN = 0.1  # of each side, left out of medians and worst cases
_EDGE, _STEPS = 0.02, 61  # of the map
_WORD_BITS = 16  # of the wire: counts are int16


@dataclass(frozen=True)
class PadDesign:
    """One pad: its surface, its electrodes on the surface's rectangle, its contact law and its electronics.

    noise_counts: standard deviation of a channel's reading besides quantisation, in counts of 16 bits. bits:
    of the converter. light_n: the force of a light touch.
    """

    name: str
    surface: Surface
    network: ElectrodeNetwork
    law: ContactLaw
    drive_v: float
    full_scale_a: float
    noise_counts: float
    light_n: float
    bits: int = _WORD_BITS

    @property
    def noise_a(self) -> float:
        """Standard deviation of a channel's current [A]."""
        per_count = self.full_scale_a / 2 ** (_WORD_BITS - 1)
        step = self.full_scale_a / 2 ** (self.bits - 1)
        return math.hypot(self.noise_counts * per_count, step / math.sqrt(12))


def expected_error(
    pad: PadDesign, force_n: float, x: npt.ArrayLike, y: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Root of the sum of both variances of location on the surface [m], and total current [A], shape (...).

    x, y: places on the rectangle of the pad.
    """
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    outer = pad.network.spreading_radius(x, y) * pad.surface.scale(x, y)
    total = pad.law.current(
        force_n, pad.drive_v, pad.network.sheet_ohm_per_square, outer, pad.network.series_resistance(x, y)
    )
    fractions, jacobian = pad.network.fractions_with_jacobian(x, y)
    slopes = jacobian / pad.surface.scales(x, y)
    columns = np.moveaxis(np.concatenate([slopes, fractions[:, None]], axis=1), (0, 1), (-2, -1))
    covariance = np.linalg.inv(np.swapaxes(columns, -1, -2) @ columns)
    spread = np.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])
    return np.asarray(spread * pad.noise_a / total), np.asarray(total)


def summary_of(pad: PadDesign, force_n: float) -> tuple[float, float]:
    """Median and worst expected error [m], `MARGIN` of each side left out."""
    steps = np.linspace(MARGIN, 1 - MARGIN, 25)
    x, y = np.meshgrid(steps * pad.network.a, steps * pad.network.b)
    error, _ = expected_error(pad, force_n, x, y)
    return float(np.median(error)), float(error.max())


def draw_map(pad: PadDesign) -> Figure:
    """The expected error over the pad, unrolled, for a light and a firm touch."""
    from matplotlib.colors import LogNorm

    figure = new_figure(10.0, 4.6)
    steps = np.linspace(_EDGE, 1 - _EDGE, _STEPS)
    x, y = np.meshgrid(steps * pad.network.a, steps * pad.network.b)
    u, v = pad.surface.from_rectangle(x, y)
    _, width = pad.surface.from_rectangle(x, np.full_like(y, pad.surface.b))
    across = v - width / 2
    for axes, force in zip(figure.subplots(1, 2), (pad.light_n, FIRM_N), strict=True):
        error = 1e3 * expected_error(pad, force, x, y)[0]
        scale = LogNorm(error.min(), np.quantile(error, 0.98))
        mesh = axes.pcolormesh(1e3 * u, 1e3 * across, error, norm=scale, cmap="viridis_r", shading="gouraud")
        levels = [level for level in _round_numbers() if error.min() < level < np.quantile(error, 0.95)]
        lines = axes.contour(1e3 * u, 1e3 * across, error, levels, colors="white", linewidths=0.8)
        axes.clabel(lines, fmt=_plainly, fontsize=8)
        axes.set_aspect("equal")
        bar = figure.colorbar(mesh, ax=axes, shrink=0.9, format=_plainly)
        bar.ax.minorticks_off()
        bar.set_ticks(levels)
        bar.ax.tick_params(labelsize=8)
        bar.set_label("expected error, mm", fontsize=8)
        middle, worst = (1e3 * value for value in summary_of(pad, force))
        title = f"{force:g} N: median {middle:.2g}, worst {worst:.2g} mm"
        tidy(axes, title, "from electrode x0, mm", "from the middle, mm")
        axes.grid(visible=False)
    figure.suptitle(
        f"{pad.name}: expected location error, mm (1 sigma), surface unrolled; figures: inner 80 %",
        fontsize=10,
    )
    return figure


def draw_choices(pad: PadDesign) -> Figure:
    """What aspect, gaps, series resistors and bits would make of the error, one at a time."""
    figure = new_figure(9.6, 7.0)
    aspects, gaps, resistors, bits = figure.subplots(2, 2).flat
    network = pad.network
    area, gap = network.a * network.b, _mean_gap(network)
    shorter = min(network.a, network.b)

    def of_aspect(aspect: float) -> PadDesign:
        a, b = math.sqrt(area * aspect), math.sqrt(area / aspect)
        return replace(pad, surface=Plane(a, b), network=_plain(a, b, gap, network))

    _curve(aspects, pad, np.geomspace(0.25, 4, 17), of_aspect, network.a / network.b)
    aspects.set_xscale("log")
    aspects.set_xticks([0.25, 0.5, 1, 2, 4], ["1:4", "1:2", "1:1", "2:1", "4:1"])
    aspects.minorticks_off()
    tidy(aspects, "Aspect, flat, area kept", "along x : along y", "expected error, mm")

    def of_gap(percent: float) -> PadDesign:
        return replace(pad, network=_plain(network.a, network.b, percent / 100 * shorter, network))

    _curve(gaps, pad, np.linspace(0.5, 25, 15), of_gap, 100 * gap / shorter)
    tidy(gaps, "Bare corners", "gap, % of the shorter side", "expected error, mm")

    # electrodes that touch share their currents, so resistors need some gap
    apart = network if gap > 0 else _plain(network.a, network.b, 1e-3 * shorter, network)

    def of_resistor(ohm: float) -> PadDesign:
        return replace(pad, network=apart.with_series((ohm,) * 4))

    alike = len(set(network.series_ohm)) == 1
    _curve(resistors, pad, np.linspace(0, 1000, 15), of_resistor, network.series_ohm[0] if alike else None)
    tidy(resistors, "Equal series resistors", "ohm", "expected error, mm")

    def of_bits(count: float) -> PadDesign:
        return replace(pad, bits=round(count))

    _curve(bits, pad, np.arange(8.0, 19.0), of_bits, pad.bits)
    tidy(bits, "Bits of the converter, sign included", "bits", "expected error, mm")
    figure.suptitle(f"{pad.name}: one choice changed at a time, inner 80 %; dots: as configured", fontsize=10)
    return figure


def design_of(deployment: config.Deployment, link: str | None = None) -> PadDesign:
    """The pad on a link, or the first one. Raises ValueError naming the links there are."""
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    chosen = next((pad for pad in pads if link in (None, pad.link)), None)
    if chosen is None:
        raise ValueError(f"no pad on link {link}; there are {', '.join(pad.link for pad in pads)}")
    sheet, node = deployment.sheets[chosen.sheet], deployment.nodes[chosen.node]
    law = ContactLaw(
        sheet.contact_ohm_mm2 * 1e-6,
        sheet.alpha,
        sheet.contact_radius_mm * 1e-3,
        sheet.contact_radius_std_mm * 1e-3,
        sheet.reference_kpa * 1e3,
    )
    return PadDesign(
        chosen.link,
        surface_of(chosen),
        network_of(chosen, sheet),
        law,
        node.drive_v,
        node.full_scale_ma * 1e-3,
        node.noise_counts,
        (chosen.touch or deployment.touch).on_n,
    )


def run(config_path: Path, out: Path, *, link: str | None = None) -> int:
    """`handtouch design CONFIG`: draw one pad and say where; exit status.

    2 for a file or a link that is wrong, 1 without matplotlib or where `out` cannot be written.
    """
    try:
        pad = design_of(config.load(config_path), link)
    except (config.ConfigError, ValueError) as problem:
        print(f"handtouch design: {problem}", file=sys.stderr)
        return 2
    drawings: dict[str, Callable[[PadDesign], Figure]] = {"error": draw_map, "choices": draw_choices}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for kind, draw in drawings.items():
            path = out / f"{pad.name}_{kind}.png"
            draw(pad).savefig(path, dpi=DPI)
            print(path)
    except (ImportError, OSError) as problem:
        print(f"handtouch design: {problem}", file=sys.stderr)
        return 1
    for force in (pad.light_n, FIRM_N):
        middle, worst = (1e3 * value for value in summary_of(pad, force))
        print(f"{force:g} N: expected location error {middle:.3g} mm median, {worst:.3g} mm at worst")
    return 0


def _curve(
    axes: Axes,
    pad: PadDesign,
    values: Sequence[float] | FloatArray,
    variant: Callable[[float], PadDesign],
    configured: float | None,
) -> None:
    """Median and worst error against one choice, for both forces."""
    for force, colour in ((pad.light_n, ACCENT), (FIRM_N, INK)):
        middle, worst = 1e3 * np.array([summary_of(variant(float(v)), force) for v in values]).T
        axes.plot(values, middle, color=colour, label=f"{force:g} N, median")
        axes.plot(values, worst, "--", color=colour, linewidth=1, label=f"{force:g} N, worst")
        if configured is not None:
            axes.plot(
                [configured] * 2, 1e3 * np.array(summary_of(variant(configured), force)), "o", color=ERRATUM
            )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_plainly)
    axes.legend(fontsize=7, frameon=False)


def _plainly(value: float, _position: float = 0) -> str:
    return f"{value:g}"


def _round_numbers() -> list[float]:
    """1, 2 and 5 of every decade."""
    return [digit * 10.0**decade for decade in range(-6, 3) for digit in (1, 2, 5)]


def _plain(a: float, b: float, gap: float, like: ElectrodeNetwork) -> ElectrodeNetwork:
    """Four electrodes with equal gaps, sheet and resistors as of another pad."""
    return ElectrodeNetwork(a, b, gap, like.sheet_ohm_per_square, like.series_ohm)


def _mean_gap(network: ElectrodeNetwork) -> float:
    """Mean bare length at the ends of the electrodes, in units of the rectangle."""
    lengths = {"x0": network.b, "xa": network.b, "y0": network.a, "yb": network.a}
    return float(np.mean([(lengths[e.side] - (e.stop - e.start)) / 2 for e in network.electrodes]))
