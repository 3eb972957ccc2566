"""Pictures of a design: electrodes and the goal's map, before and after.

Public name: `draw_before_and_after`. Needs matplotlib, the extra `figures`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from handtouch.design.flat_pattern import FlatPattern
from handtouch.design.layout import ElectrodeLayout
from handtouch.design.optimise import DesignResult
from handtouch.design.pad_task import PadTask
from handtouch.field.figures import DPI, INK, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ELECTRODE = "#b8741a"
_BAND_MM = 1.2
_MAX_SCALE_QUANTILE = 0.98


def draw_before_and_after(task: PadTask, result: DesignResult, title: str, stem: Path) -> list[Path]:
    """Write STEM.png and STEM.svg; return their paths.

    Raises ImportError naming the extra without matplotlib, OSError if they cannot be written.
    """
    figure = new_figure(10.0, 4.8)
    points = result.map_after.shape[0]
    task = task.with_points(points)
    pattern = FlatPattern(task.surface, task.boundary)
    across = pattern.points(*task.grid).T.reshape(2, points, points)
    both = np.concatenate([result.map_before, result.map_after])
    limits = float(both.min()), float(np.quantile(both, _MAX_SCALE_QUANTILE))
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (
        ("before", result.before, result.map_before, result.value_before),
        ("after", result.after, result.map_after, result.value_after),
    )
    for axes, (name, layout, values, value) in zip(panels, cases, strict=True):
        mesh = axes.pcolormesh(
            *across, values, vmin=limits[0], vmax=limits[1], cmap="viridis_r", shading="gouraud"
        )
        axes.plot(*pattern.outline.T, color=INK, linewidth=0.6)
        _draw_electrodes(axes, pattern, layout)
        axes.set_aspect("equal")
        axes.set_title(f"{name}: {result.statistic} {value:.3g} {result.goal.unit}", loc="left", fontsize=10)
        axes.set_xlabel("from electrode x0, mm", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("from the centre line, mm", fontsize=9)
    bar = figure.colorbar(mesh, ax=list(panels), shrink=0.85)
    bar.set_label(f"{result.goal.description}, {result.goal.unit}", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    figure.suptitle(title, fontsize=10)
    paths = [stem.with_suffix(suffix) for suffix in (".png", ".svg")]
    for path in paths:
        figure.savefig(path, dpi=DPI)
    return paths


def _draw_electrodes(axes: Axes, pattern: FlatPattern, layout: ElectrodeLayout) -> None:
    """Draw the electrodes as strips, with their resistors."""
    for (start, stop), ohm in zip(layout.stretches_m, layout.series_ohm, strict=True):
        band = pattern.band(start, stop, _BAND_MM)
        axes.fill(*band.T, color=_ELECTRODE, linewidth=0)
        if ohm:
            middle = pattern.stretch((start + stop) / 2 - 1e-6, (start + stop) / 2 + 1e-6)[0]
            axes.annotate(f"{ohm:g} ohm", middle, fontsize=8, ha="center", va="center", color=INK)
