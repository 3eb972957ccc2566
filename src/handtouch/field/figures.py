"""Theoretical figures 2 to 7 of the paper, computed by `handtouch.field`, with its errata marked in red.

Public names: `draw_figures`, `log_ratio` (eq. 8). Needs matplotlib, the extra `figures`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field import (
    ContactLaw,
    ElectrodeNetwork,
    Rectangle,
    contact_stack_resistance,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


INK, FAINT, ACCENT, ERRATUM = "#1a1a1a", "#8a8a8a", "#1f6fb4", "#c0392b"
DPI = 150

UNIT = Rectangle(1.0, 1.0)
SHEET_OHM = 2400.0  # the paper's conducting polymer, ohm per square
SQUARE_M, GAP_M = 0.125, 0.007  # side of the large square; bare length at its corners
PLUG_OHM = 200.0  # contact resistance under the banana plug, as assumed by the paper
RESISTOR_OHM = 336.0


def log_ratio(pad: Rectangle, currents: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return x_obs, y_obs of eq. 8, shape (...), from currents (4, ...) of x0, xa, y0, yb.

    x_obs = a/2 + b/(2 pi) ln(I_xa / I_x0). On a square it is off by 0.12 of the side rms and 0.53 at worst,
    5 % from the edges. NaN where a current is negative, infinite where one is zero.
    """
    currents = np.asarray(currents, dtype=np.float64)
    with np.errstate(all="ignore"):
        x = pad.a / 2 + pad.b / (2 * math.pi) * np.log(currents[1] / currents[0])
        y = pad.b / 2 + pad.a / (2 * math.pi) * np.log(currents[3] / currents[2])
    return x, y


def draw_figures(out_dir: Path, on_progress: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Write figure_2.png ... figure_7.png into `out_dir`, created if missing; return their paths.

    `on_progress` is called with a description of each figure before it is drawn. Raises
    ImportError where matplotlib isn't installed.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    draw: dict[int, Callable[[], Figure]] = {
        2: _observed_position,
        3: _linearised_errors,
        4: _current_against_area,
        5: _current_against_force,
        6: _along_the_centre_line,
        7: _resistance_of_the_plane,
    }
    paths: list[Path] = []
    for number, make in draw.items():
        path = out_dir / f"figure_{number}.png"
        on_progress(f"drawing {path} ({len(paths) + 1} of {len(draw)})")
        make().savefig(path, dpi=DPI)
        paths.append(path)
    return paths


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure [inch] in the common style, tied to no window."""
    try:
        from matplotlib.figure import Figure
    except ImportError as problem:
        raise ImportError("figures need matplotlib") from problem
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def format_axes(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Set title and labels; no box, a faint grid."""
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)
    axes.tick_params(labelsize=8, colors=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)


def _observed_position() -> Figure:
    """Fig. 2: x_obs against x on the unit square."""
    figure = new_figure(5.2, 5.0)
    axes = figure.subplots()
    x = np.linspace(0.004, 0.996, 400)
    for y, shade in ((0.5, INK), (0.7, "#4a7fae"), (0.9, "#7fb2d9")):
        axes.plot(x, log_ratio(UNIT, UNIT.side_fractions(x, y))[0], color=shade, label=f"y = {y}")
    axes.plot([0, 1], [0, 1], "--", color=FAINT, linewidth=1, label="x_obs = x")
    here = float(log_ratio(UNIT, UNIT.side_fractions(0.6, 0.5))[0])
    axes.plot(0.6, here, "o", color=ERRATUM, markersize=5)
    axes.annotate(
        f"point at x = 0.6: x_obs = {here:.4f},\nnot 0.608 (paper, section 3.3)",
        (0.6, here),
        (0.42, 0.22),
        color=ERRATUM,
        fontsize=8,
        arrowprops={"arrowstyle": "-", "color": ERRATUM, "linewidth": 0.8},
    )
    axes.set(xlim=(0, 1), ylim=(-0.1, 1.1), aspect="equal")
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    format_axes(axes, "Fig. 2  Observed against true position, unit square", "x", "x_obs (eq. 8)")
    return figure


def _linearised_errors() -> Figure:
    """Fig. 3: displacements of a scaled log-ratio, and of the exact inverse."""
    figure = new_figure(9.6, 5.0)
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 9), np.linspace(0.1, 0.9, 9))
    fractions = UNIT.side_fractions(x, y)
    seen_x, seen_y = (observed - 0.5 for observed in log_ratio(UNIT, fractions))
    scale = 0.5 / np.abs(seen_x).max()
    exact = UNIT.locate(fractions)
    answers = (
        ("log-ratio, eq. 8, scaled into the pad", 0.5 + scale * seen_x, 0.5 + scale * seen_y),
        ("exact inverse", exact.x, exact.y),
    )
    for axes, (name, found_x, found_y) in zip(figure.subplots(1, 2), answers, strict=True):
        error = np.hypot(found_x - x, found_y - y)
        axes.plot(
            np.stack([x.ravel(), found_x.ravel()]), np.stack([y.ravel(), found_y.ravel()]), color=ACCENT
        )
        axes.plot(x, y, "o", color=INK, markersize=3.5, markerfacecolor="white", linestyle="none")
        axes.plot([0, 1, 1, 0, 0], [0, 0, 1, 1, 0], color=INK, linewidth=1)
        axes.set(xlim=(-0.06, 1.06), ylim=(-0.06, 1.06), aspect="equal")
        format_axes(axes, f"{name}: worst {error.max():.2g}, rms {np.sqrt((error**2).mean()):.2g}", "x", "y")
    figure.suptitle("Fig. 3  From true locations (circles) to found ones (ends of the lines)", fontsize=10)
    return figure


def _current_against_area() -> Figure:
    """Fig. 4: eq. 11 over four decades of radius."""
    figure = new_figure(5.6, 5.6)
    axes = figure.subplots()
    outer = 1.0
    radius = np.geomspace(0.4e-4, 0.4, 300) * outer
    area = np.pi * radius**2
    axes.loglog(area, 1 / contact_stack_resistance(1.0, 1e-3, radius, outer), color=INK, label="eq. 11")
    axes.loglog(area, area / 1e-3, "--", color=FAINT, linewidth=1, label="contact alone: unit slope")
    limit = 2 * np.pi / np.log(outer / radius)
    axes.loglog(area, limit, ":", color=FAINT, linewidth=1.2, label="sheet alone")
    axes.set(xlim=(area[0], area[-1]), ylim=(3e-6, 30))
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    format_axes(
        axes,
        "Fig. 4  Current against contact area",
        "area / B²",
        "current, V w / rho (sigma = 10⁻³ B² rho / w)",
    )
    return figure


def _current_against_force() -> Figure:
    """Fig. 5: eqs. 11 and 12 at alpha = 1.5, with eq. 13 as printed and as it should be."""
    figure = new_figure(6.0, 6.4)
    upper, lower = figure.subplots(2, 1, height_ratios=(3, 2), sharex=True)
    law = ContactLaw(2e-2, 1.5, 3e-3)
    outer, force = 0.0175, np.geomspace(1e-3, 100, 300)
    current = law.current(force, 1.0, SHEET_OHM, outer)
    layer = law.resistivity(force) / (np.pi * 3e-3**2)

    def approximate(constant: float) -> FloatArray:
        return np.asarray(1 / (layer + SHEET_OHM / (4 * np.pi) * (2 * np.log(outer / 3e-3) + constant)))

    upper.loglog(force, current, color=INK, label="eqs. 11 and 12, alpha = 1.5")
    upper.loglog(
        force, current[0] * (force / force[0]) ** 1.5, "--", color=FAINT, linewidth=1, label="slope 1.5"
    )
    upper.set_ylim(current[0] / 2, current[-1] * 4)
    upper.legend(fontsize=8, frameon=False, loc="lower right")
    format_axes(upper, "Fig. 5  Current against force, constant area", "", "current / V, siemens")
    for constant, colour, text in (
        (1.0, ERRATUM, "eq. 13 as printed: 2 ln(B/A) + 1"),
        (0.5, ACCENT, "erratum: 2 ln(B/A) + 1/2, the expansion of eq. 11"),
    ):
        lower.semilogx(force, 100 * (approximate(constant) / current - 1), color=colour, label=text)
    lower.axhline(0, color=INK, linewidth=0.6)
    lower.legend(fontsize=8, frameon=False, loc="lower left")
    format_axes(
        lower, "Error of the low-force formula", "force, N (contact of 3 mm radius on S1's sheet)", "error, %"
    )
    return figure


def _along_the_centre_line() -> Figure:
    """Fig. 6: the large square, as built and with resistors."""
    figure = new_figure(6.0, 5.0)
    axes = figure.subplots()
    position, measured = np.linspace(-0.0585, 0.0585, 300), np.linspace(-0.055, 0.055, 45)
    for ohm, colour, text in (
        (0.0, INK, "as built: gaps of 7 mm at the corners"),
        (RESISTOR_OHM, ACCENT, "and 336 ohm from every electrode to ground"),
    ):
        pad = ElectrodeNetwork(SQUARE_M, SQUARE_M, GAP_M, SHEET_OHM, (ohm,) * 4)
        drawn, sampled = (
            log_ratio(UNIT, pad.currents(SQUARE_M / 2 + at, SQUARE_M / 2))[0] - 0.5
            for at in (position, measured)
        )
        bend = np.abs(sampled - np.polyval(np.polyfit(measured, sampled, 1), measured)).max()
        axes.plot(100 * position, drawn, color=colour, label=f"{text}; bend {bend:.3f}")
    axes.plot(100 * position, position / SQUARE_M, "--", color=FAINT, linewidth=1, label="x_obs = x")
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    axes.annotate(
        "336 ohm: 4 times straighter, 2.6 times in\nposition (paper: about 3); the total falls by\n"
        "4 to 11 %, not by half as the paper says",
        (0.98, 0.04),
        xycoords="axes fraction",
        ha="right",
        color=ERRATUM,
        fontsize=8,
    )
    format_axes(
        axes, "Fig. 6  The 12.5 cm square, along its centre line", "position, cm", "ln(I_xa / I_x0) / 2 pi"
    )
    return figure


def _resistance_of_the_plane() -> Figure:
    """Fig. 7: the truncated double sum, and the logarithm of the spreading radius that replaces it."""
    figure = new_figure(6.0, 5.0)
    axes = figure.subplots()
    position = np.linspace(-0.0585, 0.0585, 241)
    fraction = 0.5 + position / SQUARE_M
    pad = ElectrodeNetwork(SQUARE_M, SQUARE_M, GAP_M, SHEET_OHM)
    radius = pad.spreading_radius(fraction * SQUARE_M, np.full_like(fraction, SQUARE_M / 2))
    for limit, colour, shade_of_sum in ((45, INK, "#c9c9c9"), (531, ACCENT, "#bcd9ef")):
        plane = truncated_double_sum(fraction, limit)
        contact = radius[120] * np.exp(-2 * np.pi * plane[120])  # the disc of equal resistance at the centre
        closed = np.log(radius / contact) / (2 * np.pi)
        for curve, shade, width, text in (
            (plane, shade_of_sum, 4.0, f"eq. 2, cut off at {limit} terms"),
            (closed, colour, 1.2, f"ln(R / A) / 2 pi, A = {1e3 * contact:.2f} mm"),
        ):
            kohm = (SHEET_OHM * curve + PLUG_OHM) / 1e3
            axes.plot(100 * position, kohm, color=shade, linewidth=width, label=text)
    axes.legend(fontsize=8, frameon=False, loc="lower center")
    axes.set_ylim(0.4, 3.0)
    axes.annotate(
        "the cut-off is the contact's radius in disguise:\nR, the spreading radius, needs none",
        (0.5, 0.64),
        xycoords="axes fraction",
        ha="center",
        color=ERRATUM,
        fontsize=8,
    )
    format_axes(axes, "Fig. 7  Resistance along the centre line, 0.2 kohm of contact", "position, cm", "kohm")
    return figure


def truncated_double_sum(fraction: FloatArray, limit: int) -> FloatArray:
    """U / J0 of eq. 2 at the source, per ohm per square, mid-line of a square, both sums to `limit`."""
    order = np.arange(1, limit + 1)
    along = np.sin(np.pi * np.outer(fraction, order)) ** 2
    across = np.sin(np.pi * order / 2) ** 2
    weights = 1 / (order[:, None] ** 2 + order[None, :] ** 2)
    return np.asarray(4 / np.pi**2 * along @ (weights @ across))
