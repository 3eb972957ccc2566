"""Figures of a recording for papers, as PDF (vectors) and PNG.

Public names: `draw`, `read_plot_data`, `spans_of_states`. Seconds are from the recording's first message.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import cycle, groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment
from handtouch.hand import pad_surface
from handtouch.record.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE_COLOR, _GRID_COLOR = "#222222", "#d9d9d9"
_BLUE, _RED = "#0072b2", "#d55e00"
_COLOR_OF_STATE = {
    "clear": "#e3efe3",
    "touched": "#56b4e9",
    "stale": "#f0e442",
    "lost": "#d55e00",
    "faulted": "#cc79a7",
    "starting": "#bbbbbb",
    "off": "#eeeeee",
}
_END_MARKERS = "x+*1^"
_COLOR_MAP = "viridis"
_EDGE_CELLS = 40
_DPI = 200
_WIDTH_IN = 7.2
_STYLE = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _LINE_COLOR,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,
    "legend.frameon": False,
}


@dataclass
class ContactHistory:
    """One contact: columns of its samples, and its end reason."""

    times_s: list[float] = field(default_factory=list)
    pad_mm: list[tuple[float, float]] = field(default_factory=list)
    force_n: list[float] = field(default_factory=list)
    force_std_n: list[float] = field(default_factory=list)
    is_lower_bound: list[bool] = field(default_factory=list)
    end_reason: str = ""
    begin_threshold_n: float = 0.0

    def add_message(self, t_s: float, contact: Mapping[str, Any]) -> None:
        """Add a payload of `contact`."""
        self.begin_threshold_n, self.end_reason = contact["begin_threshold_n"], contact["end_reason"]
        if contact["event"] == "end" and self.times_s:
            self._add_sample(
                t_s, self.pad_mm[-1], self.force_n[-1], self.force_std_n[-1], self.is_lower_bound[-1]
            )
            return
        unknown = float("nan")
        x, y = contact["pad_m"] or (unknown, unknown)
        force_n = unknown if contact["force_n"] is None else contact["force_n"]
        saturated = contact["force_status"] == "lower_bound"
        self._add_sample(t_s, (x * 1e3, y * 1e3), force_n, contact["force_std_n"] or 0.0, saturated)

    def _add_sample(
        self, t_s: float, pad_mm: tuple[float, float], force_n: float, std_n: float, at_end: bool
    ) -> None:
        self.times_s.append(t_s)
        self.pad_mm.append(pad_mm)
        self.force_n.append(force_n)
        self.force_std_n.append(std_n)
        self.is_lower_bound.append(at_end)


@dataclass
class PlotData:
    """Data of a recording's figures; pads by "hand/link"."""

    pads: dict[str, NDArray[Any] | None] = field(default_factory=dict)
    """edge of the unrolled pad [mm], (k, 2) as `Surface.edge_m`, of the deployment's pads in its order; None
    where the recording doesn't describe the pad"""
    contacts: dict[str, dict[tuple[int, int], ContactHistory]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    health: dict[str, list[tuple[float, str]]] = field(default_factory=lambda: defaultdict(list))
    service: list[tuple[float, float, int, int]] = field(default_factory=list)
    """time [s], ticks per second, overruns and congestion episodes so far"""
    end_s: float = 0.0

    @property
    def touched_pads(self) -> list[str]:
        """Touched pads."""
        return [pad for pad in self.pads if self.contacts.get(pad)]


def read_plot_data(recording: Recording, from_s: float = 0.0, to_s: float | None = None) -> PlotData:
    """Read the data between two times. Raises ValueError if there are none."""
    data = PlotData()
    first_ns: int | None = None
    for topic, t_ns, payload in recording.read("config", "contact", "health", "service"):
        first_ns = t_ns if first_ns is None else first_ns
        t_s = (t_ns - first_ns) * 1e-9
        prefix, _, pad = topic.partition("/")
        if prefix == "config":
            data.pads |= _pad_edges(Deployment.model_validate_json(payload["deployment"]))
        if not from_s <= t_s <= (float("inf") if to_s is None else to_s):
            continue
        data.end_s = max(data.end_s, t_s)
        if prefix == "contact" and not payload["retained"]:
            key = payload["session"], payload["id"]
            data.contacts[pad].setdefault(key, ContactHistory()).add_message(t_s, payload)
        elif prefix == "health":
            state = payload["state"].replace("touched", "clear")  # contacts say when, to the sample
            data.health[pad].append((t_s, state))
        elif prefix == "service":
            episodes = sum(payload["congestion_episodes"].values())
            data.service.append((t_s, payload["rate_hz"], payload["overruns"], episodes))
    for pad in [*data.contacts, *data.health]:
        data.pads.setdefault(pad, None)
    if not data.service and not data.contacts:
        raise ValueError(f"{recording.path}: holds no message of a daemon in that time")
    return data


def draw(data: PlotData, folder: Path, on_progress: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Draw all figures into a folder; return the files. `on_progress` is called before each figure."""
    import matplotlib

    folder.mkdir(parents=True, exist_ok=True)
    made: list[Path] = []
    figures: dict[str, Callable[[PlotData], Figure]] = {"timeline": _draw_timeline, "health": _draw_health}
    if data.touched_pads:
        figures |= {"forces": _draw_forces, "pads": _draw_pads}
    with matplotlib.rc_context(_STYLE):
        for number, (name, make) in enumerate(figures.items(), 1):
            on_progress(f"drawing {name} ({number} of {len(figures)})")
            figure = make(data)
            for suffix in ("pdf", "png"):
                made.append(folder / f"{name}.{suffix}")
                figure.savefig(made[-1], dpi=_DPI)
    return made


def _pad_edges(deployment: Deployment) -> dict[str, NDArray[Any] | None]:
    return {
        f"{hand.name}/{pad.link}": 1e3 * pad_surface(pad).edge_m(_EDGE_CELLS)
        for hand in deployment.hands
        for pad in hand.pads
    }


def _figure(rows: int, columns: int, height_in: float, **shared: Any) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, **shared)
    return figure, list(grid.ravel())


def _pad_label(pad: str, data: PlotData) -> str:
    """Return the label of a pad; without the hand's name if there is only one."""
    hands = {name.split("/")[0] for name in data.pads}
    return pad if len(hands) > 1 else pad.split("/")[1]


def _max_force_n(data: PlotData) -> float:
    forces = [
        f for pad in data.touched_pads for contact in data.contacts[pad].values() for f in contact.force_n
    ]
    known = [force for force in forces if np.isfinite(force)]
    return max(known, default=1.0)


def _draw_timeline(data: PlotData) -> Figure:
    """Draw contacts as bars, a row for each pad, coloured by force; the legend explains unusual ends."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize

    pads = list(data.pads)
    figure, (axes,) = _figure(1, 1, 0.8 + 0.2 * len(pads))
    scale = Normalize(0, _max_force_n(data))
    bars = None
    ends_by_reason: dict[str, list[tuple[float, int]]] = defaultdict(list)
    for row, pad in enumerate(pads):
        axes.axhline(row, color=_GRID_COLOR, linewidth=0.5, zorder=0)
        for contact in data.contacts.get(pad, {}).values():
            t_s = np.array(contact.times_s)
            force = np.array(contact.force_n)
            ends = np.stack([t_s[:-1], t_s[1:]], axis=1)
            lines = np.stack([ends, np.full_like(ends, row)], axis=2)
            bars = LineCollection(list(lines), cmap=_COLOR_MAP, norm=scale, linewidth=5, capstyle="butt")
            bars.set_array(force[:-1])
            bars.set_rasterized(True)
            axes.add_collection(bars)
            if contact.end_reason not in ("", "released"):
                ends_by_reason[contact.end_reason].append((t_s[-1], row))
    for marker, (reason, ends_at) in zip(cycle(_END_MARKERS), sorted(ends_by_reason.items())):
        label = f"ended: {reason} ({len(ends_at)})"
        axes.plot(*zip(*ends_at, strict=True), marker, color=_RED, markersize=4, label=label)
    if ends_by_reason:
        figure.legend(loc="outside upper right", ncols=4, fontsize=7)
    axes.set_yticks(range(len(pads)), [_pad_label(pad, data) for pad in pads])
    axes.set(xlabel="time [s]", xlim=(_begin_s(data), data.end_s), ylim=(len(pads) - 0.5, -0.5))
    axes.tick_params(axis="y", length=0)
    if bars is not None:
        figure.colorbar(bars, ax=axes, label="force [N]", pad=0.01, aspect=30)
    return figure


def _begin_s(data: PlotData) -> float:
    times = [
        contact.times_s[0]
        for pad in data.touched_pads
        for contact in data.contacts[pad].values()
        if contact.times_s
    ]
    return min([*times, *(t_s for t_s, *_ in data.service[:1])], default=0.0)


def _draw_forces(data: PlotData) -> Figure:
    """Draw the force of the contacts on each touched pad, with two standard deviations."""
    pads = data.touched_pads
    columns = 1 if len(pads) < 4 else 2
    rows = -(-len(pads) // columns)
    figure, grid = _figure(rows, columns, 0.7 + 1.25 * rows, sharex=True)
    for axes, pad in zip(grid, pads, strict=False):
        for contact in data.contacts[pad].values():
            t_s, force, std = (
                np.array(column) for column in (contact.times_s, contact.force_n, contact.force_std_n)
            )
            axes.fill_between(t_s, force - 2 * std, force + 2 * std, color=_BLUE, alpha=0.25, linewidth=0)
            axes.plot(t_s, force, color=_BLUE, linewidth=0.8)
            bound = np.where(contact.is_lower_bound, force, np.nan)
            axes.plot(t_s, bound, color=_RED, linewidth=1.6)
            axes.axhline(contact.begin_threshold_n, color=_LINE_COLOR, linewidth=0.5, linestyle=(0, (4, 4)))
        axes.set_title(_pad_label(pad, data), loc="left", fontsize=8)
        axes.set(ylim=(0, None), xlim=(_begin_s(data), data.end_s))
        axes.set_ylabel("force [N]")
    for axes in grid[len(pads) :]:
        axes.set_visible(False)
    for axes in grid[max(0, len(pads) - columns) : len(pads)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("time [s]")
    figure.legend(handles=_force_legend(), loc="outside upper right", ncols=4, fontsize=7)
    return figure


def _force_legend() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Line2D([], [], color=_BLUE, linewidth=0.8, label="force"),
        Patch(color=_BLUE, alpha=0.25, linewidth=0, label="$\\pm$ 2 standard deviations"),
        Line2D([], [], color=_RED, linewidth=1.6, label="lower bound (saturated)"),
        Line2D([], [], color=_LINE_COLOR, linewidth=0.5, linestyle=(0, (4, 4)), label="begin threshold"),
    ]


def _draw_pads(data: PlotData) -> Figure:
    """Draw each touched pad unrolled, with the paths of its contacts coloured by force.

    The colours are of the root of the force, so that light contacts differ beside firm ones.
    """
    from matplotlib.colors import PowerNorm
    from matplotlib.lines import Line2D
    from matplotlib.patches import Polygon

    pads = data.touched_pads
    columns = min(len(pads), 4)
    rows = -(-len(pads) // columns)
    figure, grid = _figure(rows, columns, 0.5 + _WIDTH_IN / max(columns, 2) * rows)
    scale = PowerNorm(0.5, 0, _max_force_n(data))
    dots = None
    for axes, pad in zip(grid, pads, strict=False):
        edge = data.pads[pad]
        if edge is not None:
            axes.add_patch(Polygon(edge, fill=False, edgecolor=_LINE_COLOR, linewidth=0.8))
            low, high = edge.min(axis=0), edge.max(axis=0)
            margin = 0.04 * (high - low)
            (left, bottom), (right, top) = low - margin, high + margin
            axes.set(xlim=(left, right), ylim=(bottom, top))
        for contact in data.contacts[pad].values():
            x, y = np.array(contact.pad_mm).T
            if edge is not None:  # from y0 to the centre line
                upper = edge[: len(edge) // 2]
                y = y - np.interp(x, *upper.T)
            axes.plot(x, y, color=_GRID_COLOR, linewidth=0.6, zorder=1)
            dots = axes.scatter(
                x,
                y,
                c=contact.force_n,
                cmap=_COLOR_MAP,
                norm=scale,
                s=4,
                linewidths=0,
                zorder=2,
                rasterized=True,
            )
            axes.plot(x[:1], y[:1], "o", color=_LINE_COLOR, markersize=3.5, markerfacecolor="white", zorder=3)
        axes.set_aspect("equal")
        axes.set_title(_pad_label(pad, data), loc="left", fontsize=8)
        axes.set_xlabel("from x0 [mm]")
        axes.set_ylabel("from the centre line [mm]" if edge is not None else "from y0 [mm]")
    for axes in grid[len(pads) :]:
        axes.set_visible(False)
    if dots is not None:
        figure.colorbar(dots, ax=grid, label="force [N]", pad=0.01, aspect=30)
    begin = Line2D(
        [], [], marker="o", color=_LINE_COLOR, markersize=3.5, markerfacecolor="white", linestyle="none"
    )
    figure.legend([begin], ["contact begin"], loc="outside upper right", fontsize=7)
    return figure


def _draw_health(data: PlotData) -> Figure:
    """Draw the state of every pad over time; below it the daemon's tick rate, overruns and congestion."""
    from matplotlib.patches import Patch

    pads = list(data.pads)
    height = 0.18 * len(pads)
    figure, (strip, rate) = _figure(
        2, 1, height + 1.9, sharex=True, gridspec_kw={"height_ratios": (max(height, 0.4), 0.9)}
    )
    seen: dict[str, str] = {}
    for row, pad in enumerate(pads):
        for state, spans in spans_of_states(data.health.get(pad, []), data.end_s).items():
            color = seen[state] = _COLOR_OF_STATE.get(state, _LINE_COLOR)
            strip.broken_barh(spans, (row - 0.4, 0.8), facecolors=color, linewidth=0)
    for row, pad in enumerate(pads):
        spans = [(c.times_s[0], c.times_s[-1] - c.times_s[0]) for c in data.contacts.get(pad, {}).values()]
        if spans:
            seen["touched"] = _COLOR_OF_STATE["touched"]
            strip.broken_barh(spans, (row - 0.4, 0.8), facecolors=seen["touched"], linewidth=0)
    strip.set_yticks(range(len(pads)), [_pad_label(pad, data) for pad in pads])
    strip.set(ylim=(len(pads) - 0.5, -0.5), xlim=(_begin_s(data), max(data.end_s, 1e-3)))
    strip.tick_params(axis="both", length=0)
    handles = [Patch(color=color, label=state) for state, color in seen.items()]
    figure.legend(handles=handles, loc="outside upper right", ncols=max(1, len(handles)), fontsize=7)
    if data.service:
        t_s, ticks_hz, overruns, episodes = np.array(data.service).T
        rate.plot(t_s, ticks_hz, color=_BLUE, linewidth=0.9)
        _mark_increments(rate, t_s, overruns, ticks_hz, "overrun")
        _mark_increments(rate, t_s, episodes, ticks_hz, "congestion episode")
    fastest = max((hz for _, hz, *_ in data.service), default=1.0)
    rate.set(xlabel="time [s]", ylabel="ticks / s", ylim=(0, 1.15 * max(fastest, 1.0)))
    return figure


def spans_of_states(states: list[tuple[float, str]], end_s: float) -> dict[str, list[tuple[float, float]]]:
    """Return begin and length [s] of the spans in which a pad had each state; messages repeat states."""
    spans: dict[str, list[tuple[float, float]]] = {}
    runs = [next(run) for _, run in groupby(states, key=lambda entry: entry[1])]
    for (from_s, state), (to_s, _) in pairwise([*runs, (end_s, "")]):
        spans.setdefault(state, []).append((from_s, to_s - from_s))
    return spans


def _mark_increments(
    axes: Axes, t_s: NDArray[Any], totals: NDArray[Any], at: NDArray[Any], what: str
) -> None:
    """Mark the times at which a counter increased, with the sum in the legend."""
    grown = np.diff(totals, prepend=totals[:1]) > 0
    total = int(totals[-1] - totals[0])
    if total > 0:
        marker, color = ("v", _RED) if what == "overrun" else ("s", _LINE_COLOR)
        label = f"{total} {what}{'s' if total > 1 else ''}"
        axes.plot(t_s[grown], at[grown], marker, color=color, markersize=4, linestyle="none", label=label)
        axes.legend(loc="lower right", fontsize=7)
