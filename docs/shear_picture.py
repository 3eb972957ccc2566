"""Make docs/shear_patterns.png: the electrodes of the four shear patterns, and sections of a displaced bar.

Usage: shear_picture.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from handtouch.field.shear import BarPattern, overlap_ratio

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import Circle, Rectangle

PICTURE = Path(__file__).parent / "shear_patterns.png"
MM = 1e3
FILM_MM, OVERLAP_MM, GAP_MM, LENGTH_MM, PITCH_MM, ARM_MM = 0.15, 0.6, 0.4, 6.0, 3.4, 5.0
ELECTRODE_MM = 1.1
"""Width of an electrode, drawn."""
CHANNELS = ("#1f6fb4", "#c23b22", "#2e8b57", "#e0a030")
NAMES = ("x0", "xa", "y0", "yb")


def draw_bars(axes: Axes, pattern: BarPattern, paired: bool) -> None:
    """Draw electrodes by channel, and over them the outlines of the upper bars."""
    for cell in pattern.cells:
        way = np.array([np.cos(cell.direction_rad), np.sin(cell.direction_rad)])
        along = np.array([-way[1], way[0]])
        edge = MM * np.array([cell.x_m, cell.y_m])
        half, length = pattern.length_m * MM / 2, pattern.length_m * MM
        inside, outside = edge, edge + way * ELECTRODE_MM
        low = np.minimum(inside, outside) - np.abs(along) * half
        size = np.abs(way) * ELECTRODE_MM + np.abs(along) * length
        axes.add_patch(Rectangle(low, *size, color=CHANNELS[cell.channel], lw=0))
        overlap = pattern.overlap_m * MM
        tail = edge - way * (GAP_MM / 2 if paired else overlap)
        low = np.minimum(tail, edge + way * overlap) - np.abs(along) * (half + overlap)
        size = np.abs(way) * (overlap + np.abs(tail - edge).sum()) + np.abs(along) * (length + 2 * overlap)
        axes.add_patch(Rectangle(low, *size, fill=True, color="black", alpha=0.25, lw=0))


def draw_discs(axes: Axes) -> None:
    """Draw nine discs over sectors."""
    radius, pitch = 2.0, 4.6
    angle = np.linspace(-np.pi / 4, np.pi / 4, 30)
    for centre in np.stack(np.meshgrid(*[pitch * np.arange(-1, 2)] * 2), axis=-1).reshape(-1, 2):
        for channel, middle in enumerate((np.pi, 0.0, -np.pi / 2, np.pi / 2)):
            corner = GAP_MM / np.sqrt(2) * np.array([np.cos(middle), np.sin(middle)])
            rim = 1.1 * radius * np.stack([np.cos(angle + middle), np.sin(angle + middle)], axis=1)
            points = np.vstack([corner, rim]) + centre
            axes.fill(points[:, 0], points[:, 1], color=CHANNELS[channel], lw=0)
        axes.add_patch(Circle(tuple(centre), radius, color="black", alpha=0.25, lw=0))


def draw_section(axes: Axes, moved_mm: float) -> None:
    """Draw the section of a bar over its pair of electrodes, and their conductances."""
    half = GAP_MM / 2
    axes.add_patch(Rectangle((-2, 0), 4, FILM_MM, color="#dddddd", lw=0))
    for channel, side in ((0, -1), (1, 1)):
        left = half if side > 0 else -half - ELECTRODE_MM
        axes.add_patch(Rectangle((left, -0.12), ELECTRODE_MM, 0.12, color=CHANNELS[channel], lw=0))
        s = (OVERLAP_MM + side * moved_mm) / FILM_MM
        axes.text(
            side * 0.8, -0.34, f"{NAMES[channel]}: {float(overlap_ratio(s)[0]):.1f}", ha="center", fontsize=8
        )
    bar = (moved_mm - half - OVERLAP_MM, FILM_MM)
    axes.add_patch(Rectangle(bar, GAP_MM + 2 * OVERLAP_MM, 0.12, color="#555555", lw=0))
    axes.set_xlim(-1.6, 1.6)
    axes.set_ylim(-0.45, 0.4)
    axes.set_title(
        f"section of a bar, moved by {moved_mm:g} mm;\nconductance of edges, S/m of film", fontsize=8
    )


def main() -> None:
    figure, grid = plt.subplots(2, 3, figsize=(10, 6.6))
    sizes = (PITCH_MM / MM, OVERLAP_MM / MM, LENGTH_MM / MM, GAP_MM / MM, FILM_MM / MM)
    pinwheel = BarPattern.pinwheel(ARM_MM / MM, OVERLAP_MM / MM, LENGTH_MM / MM, FILM_MM / MM)
    draw_bars(grid[0, 0], BarPattern.single(4, *sizes), True)
    draw_bars(grid[0, 1], BarPattern.crossed(2, *sizes), True)
    draw_bars(grid[1, 0], pinwheel, False)
    draw_discs(grid[1, 1])
    titles = {
        (0, 0): "bars: x",
        (0, 1): "crossed_bars: x, y",
        (1, 0): "pinwheel: x, y, twist",
        (1, 1): "discs: x, y",
    }
    for at, title in titles.items():
        grid[at].set_title(title, fontsize=9)
        grid[at].set_xlim(-8.5, 8.5)
        grid[at].set_ylim(-8.5, 8.5)
    draw_section(grid[0, 2], 0.0)
    draw_section(grid[1, 2], 0.2)
    for axes in grid.flat:
        axes.set_aspect("equal")
        axes.set_axis_off()
    handles = [Rectangle((0, 0), 1, 1, color=color) for color in CHANNELS]
    handles.append(Rectangle((0, 0), 1, 1, color="black", alpha=0.25))
    figure.legend(handles, [*NAMES, "upper plates"], loc="lower center", ncol=5, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.04, 1, 1))
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main()
