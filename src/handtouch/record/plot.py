"""`handtouch plot`: what a recording holds, drawn for a paper: vectors as PDF, and the same as PNG.

Public names: `draw`, `run`. Seconds are from the first message of the recording.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment
from handtouch.hand import surface_of
from handtouch.record.read import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INK, _PALE = "#222222", "#d9d9d9"
_BLUE, _RED = "#0072b2", "#d55e00"
_STATES = {
    "clear": "#e3efe3",
    "stale": "#f0e442",
    "lost": "#d55e00",
    "faulted": "#cc79a7",
    "starting": "#bbbbbb",
    "off": "#eeeeee",
}
_COLORS = "viridis"
_DPI = 200
_WIDTH_IN = 7.2
_STYLE = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _INK,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,
    "legend.frameon": False,
}


@dataclass
class Touch:
    """One contact: columns of its samples, and how it ended."""

    t_s: list[float] = field(default_factory=list)
    pad_mm: list[tuple[float, float]] = field(default_factory=list)
    force_n: list[float] = field(default_factory=list)
    std_n: list[float] = field(default_factory=list)
    saturated: list[bool] = field(default_factory=list)
    reason: str = ""
    on_n: float = 0.0

    def add(self, t_s: float, contact: Mapping[str, Any]) -> None:
        """Take in a payload of `contact`."""
        self.on_n, self.reason = contact["on_n"], contact["reason"]
        if contact["event"] == "end" and self.t_s:
            self._add(t_s, self.pad_mm[-1], self.force_n[-1], self.std_n[-1], self.saturated[-1])
            return
        unknown = float("nan")
        x, y = contact["pad_m"] or (unknown, unknown)
        force_n = unknown if contact["force_n"] is None else contact["force_n"]
        saturated = contact["strength"] == "saturated"
        self._add(t_s, (x * 1e3, y * 1e3), force_n, contact["force_std_n"] or 0.0, saturated)

    def _add(
        self, t_s: float, pad_mm: tuple[float, float], force_n: float, std_n: float, at_end: bool
    ) -> None:
        self.t_s.append(t_s)
        self.pad_mm.append(pad_mm)
        self.force_n.append(force_n)
        self.std_n.append(std_n)
        self.saturated.append(at_end)


@dataclass
class Story:
    """What is drawn of a recording; pads by "hand/link"."""

    pads: dict[str, tuple[float, float]] = field(default_factory=dict)
    """length and width [mm], of the deployment's pads in its order"""
    touches: dict[str, dict[tuple[int, int], Touch]] = field(default_factory=lambda: defaultdict(dict))
    health: dict[str, list[tuple[float, str]]] = field(default_factory=lambda: defaultdict(list))
    service: list[tuple[float, float, int, int]] = field(default_factory=list)
    """seconds, ticks per second, overruns and drops so far"""
    end_s: float = 0.0

    @property
    def touched(self) -> list[str]:
        """Pads that were touched."""
        return [pad for pad in self.pads if self.touches.get(pad)]


def read(recording: Recording, from_s: float = 0.0, to_s: float | None = None) -> Story:
    """What there is to draw between two times. Raises ValueError where there is nothing."""
    story = Story()
    first_ns: int | None = None
    for topic, t_ns, payload in recording.read("config", "contact", "health", "service"):
        first_ns = t_ns if first_ns is None else first_ns
        t_s = (t_ns - first_ns) * 1e-9
        prefix, _, pad = topic.partition("/")
        if prefix == "config":
            story.pads |= _pads(Deployment.model_validate_json(payload["deployment"]))
        if not from_s <= t_s <= (float("inf") if to_s is None else to_s):
            continue
        story.end_s = max(story.end_s, t_s)
        if prefix == "contact" and not payload["repeat"]:
            key = payload["run"], payload["id"]
            story.touches[pad].setdefault(key, Touch()).add(t_s, payload)
        elif prefix == "health":
            state = payload["state"].replace("touched", "clear")  # once a second says nothing of touches
            story.health[pad].append((t_s, state))
        elif prefix == "service":
            drops = sum(payload["drops"].values())
            story.service.append((t_s, payload["rate_hz"], payload["overruns"], drops))
    for pad in [*story.touches, *story.health]:
        story.pads.setdefault(pad, (float("nan"), float("nan")))
    if not story.service and not story.touches:
        raise ValueError(f"{recording.path}: holds no message of a daemon in that time")
    return story


def draw(story: Story, folder: Path) -> list[Path]:
    """Draw all figures into a folder; the files."""
    import matplotlib

    folder.mkdir(parents=True, exist_ok=True)
    made: list[Path] = []
    figures: dict[str, Callable[[Story], Figure]] = {"timeline": _timeline, "health": _health}
    if story.touched:
        figures |= {"forces": _forces, "pads": _maps}
    with matplotlib.rc_context(_STYLE):
        for name, make in figures.items():
            figure = make(story)
            for suffix in ("pdf", "png"):
                made.append(folder / f"{name}.{suffix}")
                figure.savefig(made[-1], dpi=_DPI)
    return made


def run(path: Path, folder: Path, from_s: float = 0.0, to_s: float | None = None) -> int:
    """`handtouch plot`; exit status 0, 1 (it can't be read, or holds nothing), 2 (matplotlib is missing)."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        print(f"{error}; pip install 'handtouch[figures]'", file=sys.stderr)
        return 2
    try:
        recording = Recording(path)
        story = read(recording, from_s, to_s)
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    try:
        made = draw(story, folder)
    except OSError as error:
        print(error, file=sys.stderr)
        return 1
    for file in made:
        print(file)
    if recording.cut:
        print(f"{path}: {recording.cut}; all before it is drawn", file=sys.stderr)
    return 0


def _pads(deployment: Deployment) -> dict[str, tuple[float, float]]:
    made = {}
    for hand in deployment.hands:
        for pad in hand.pads:
            length_m, width_m = surface_of(pad).extent_m
            made[f"{hand.name}/{pad.link}"] = length_m * 1e3, width_m * 1e3
    return made


def _figure(rows: int, columns: int, height_in: float, **shared: Any) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, **shared)
    return figure, list(grid.ravel())


def _name(pad: str, story: Story) -> str:
    """Without the hand where there is only one."""
    hands = {name.split("/")[0] for name in story.pads}
    return pad if len(hands) > 1 else pad.split("/")[1]


def _strongest(story: Story) -> float:
    forces = [f for pad in story.touched for touch in story.touches[pad].values() for f in touch.force_n]
    known = [force for force in forces if np.isfinite(force)]
    return max(known, default=1.0)


def _timeline(story: Story) -> Figure:
    """Contacts as bars, a row for each pad, in the colour of their force."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize

    pads = list(story.pads)
    figure, (axes,) = _figure(1, 1, 0.8 + 0.2 * len(pads))
    scale = Normalize(0, _strongest(story))
    bars = None
    for row, pad in enumerate(pads):
        axes.axhline(row, color=_PALE, linewidth=0.5, zorder=0)
        for touch in story.touches.get(pad, {}).values():
            t_s = np.array(touch.t_s)
            force = np.array(touch.force_n)
            ends = np.stack([t_s[:-1], t_s[1:]], axis=1)
            lines = np.stack([ends, np.full_like(ends, row)], axis=2)
            bars = LineCollection(list(lines), cmap=_COLORS, norm=scale, linewidth=5, capstyle="butt")
            bars.set_array(force[:-1])
            bars.set_rasterized(True)
            axes.add_collection(bars)
            if touch.reason not in ("", "released"):
                axes.plot(t_s[-1], row, "x", color=_RED, markersize=5)
                axes.annotate(touch.reason, (t_s[-1], row), (4, 2), textcoords="offset points", color=_RED)
    axes.set_yticks(range(len(pads)), [_name(pad, story) for pad in pads])
    axes.set(xlabel="time [s]", xlim=(_begin(story), story.end_s), ylim=(len(pads) - 0.5, -0.5))
    axes.tick_params(axis="y", length=0)
    if bars is not None:
        figure.colorbar(bars, ax=axes, label="force [N]", pad=0.01, aspect=30)
    return figure


def _begin(story: Story) -> float:
    times = [touch.t_s[0] for pad in story.touched for touch in story.touches[pad].values() if touch.t_s]
    return min([*times, *(t_s for t_s, *_ in story.service[:1])], default=0.0)


def _forces(story: Story) -> Figure:
    """Force of the contacts on each touched pad, with two standard deviations."""
    pads = story.touched
    columns = 1 if len(pads) < 4 else 2
    rows = -(-len(pads) // columns)
    figure, grid = _figure(rows, columns, 0.7 + 1.25 * rows, sharex=True)
    for axes, pad in zip(grid, pads, strict=False):
        for touch in story.touches[pad].values():
            t_s, force, std = (np.array(column) for column in (touch.t_s, touch.force_n, touch.std_n))
            axes.fill_between(t_s, force - 2 * std, force + 2 * std, color=_BLUE, alpha=0.25, linewidth=0)
            axes.plot(t_s, force, color=_BLUE, linewidth=0.8)
            bound = np.where(touch.saturated, force, np.nan)
            axes.plot(t_s, bound, color=_RED, linewidth=1.6)
            axes.axhline(touch.on_n, color=_INK, linewidth=0.5, linestyle=(0, (4, 4)))
        axes.set_title(_name(pad, story), loc="left", fontsize=8)
        axes.set(ylim=(0, None), xlim=(_begin(story), story.end_s))
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
        Line2D([], [], color=_RED, linewidth=1.6, label="saturated: at least"),
        Line2D([], [], color=_INK, linewidth=0.5, linestyle=(0, (4, 4)), label="contacts begin"),
    ]


def _maps(story: Story) -> Figure:
    """Each touched pad unrolled, with the trails of its contacts in the colour of their force."""
    from matplotlib.colors import Normalize
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    pads = story.touched
    columns = min(len(pads), 4)
    rows = -(-len(pads) // columns)
    figure, grid = _figure(rows, columns, 0.5 + _WIDTH_IN / max(columns, 2) * rows)
    scale = Normalize(0, _strongest(story))
    dots = None
    for axes, pad in zip(grid, pads, strict=False):
        length, width = story.pads[pad]
        if np.isfinite(length):
            axes.add_patch(Rectangle((0, 0), length, width, fill=False, edgecolor=_INK, linewidth=0.8))
            axes.set(xlim=(-0.04 * length, 1.04 * length), ylim=(-0.04 * width, 1.04 * width))
        for touch in story.touches[pad].values():
            x, y = np.array(touch.pad_mm).T
            axes.plot(x, y, color=_PALE, linewidth=0.6, zorder=1)
            dots = axes.scatter(
                x, y, c=touch.force_n, cmap=_COLORS, norm=scale, s=4, linewidths=0, zorder=2, rasterized=True
            )
            axes.plot(x[:1], y[:1], "o", color=_INK, markersize=3.5, markerfacecolor="white", zorder=3)
        axes.set_aspect("equal")
        axes.set_title(_name(pad, story), loc="left", fontsize=8)
        axes.set_xlabel("from x0 [mm]")
        axes.set_ylabel("from y0 [mm]")
    for axes in grid[len(pads) :]:
        axes.set_visible(False)
    if dots is not None:
        figure.colorbar(dots, ax=grid, label="force [N]", pad=0.01, aspect=30)
    begin = Line2D([], [], marker="o", color=_INK, markersize=3.5, markerfacecolor="white", linestyle="none")
    figure.legend([begin], ["a contact begins"], loc="outside upper right", fontsize=7)
    return figure


def _health(story: Story) -> Figure:
    """State of every pad in time, and below it the daemon's tick rate, overruns and drops."""
    from matplotlib.patches import Patch

    pads = list(story.pads)
    height = 0.18 * len(pads)
    figure, (strip, rate) = _figure(
        2, 1, height + 1.9, sharex=True, gridspec_kw={"height_ratios": (max(height, 0.4), 0.9)}
    )
    seen: dict[str, str] = {}
    for row, pad in enumerate(pads):
        told = story.health.get(pad, [])
        if not told:
            continue
        for (from_s, state), (to_s, _) in zip(told, [*told[1:], (story.end_s, "")], strict=True):
            color = seen[state] = _STATES.get(state, _INK)
            strip.broken_barh([(from_s, to_s - from_s)], (row - 0.4, 0.8), facecolors=color, linewidth=0)
    strip.set_yticks(range(len(pads)), [_name(pad, story) for pad in pads])
    strip.set(ylim=(len(pads) - 0.5, -0.5), xlim=(_begin(story), max(story.end_s, 1e-3)))
    strip.tick_params(axis="both", length=0)
    handles = [Patch(color=color, label=state) for state, color in seen.items()]
    figure.legend(handles=handles, loc="outside upper right", ncols=max(1, len(handles)), fontsize=7)
    if story.service:
        t_s, ticks_hz, overruns, drops = np.array(story.service).T
        rate.plot(t_s, ticks_hz, color=_BLUE, linewidth=0.9)
        _mark(rate, t_s, overruns, ticks_hz, "overrun")
        _mark(rate, t_s, drops, ticks_hz, "dropped message")
    fastest = max((hz for _, hz, *_ in story.service), default=1.0)
    rate.set(xlabel="time [s]", ylabel="ticks / s", ylim=(0, 1.15 * max(fastest, 1.0)))
    return figure


def _mark(axes: Axes, t_s: NDArray[Any], totals: NDArray[Any], at: NDArray[Any], what: str) -> None:
    """A mark where a counter has grown, and the sum in the legend."""
    grown = np.diff(totals, prepend=totals[:1]) > 0
    total = int(totals[-1] - totals[0])
    if total > 0:
        marker, color = ("v", _RED) if what == "overrun" else ("s", _INK)
        label = f"{total} {what}{'s' if total > 1 else ''}"
        axes.plot(t_s[grown], at[grown], marker, color=color, markersize=4, linestyle="none", label=label)
        axes.legend(loc="lower right", fontsize=7)
