"""Live table in a terminal of any size: contacts with position, force and uncertainty; state of the nodes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from handtouch import wire
from handtouch.view.message_lines import (
    UNCALIBRATED_STATES,
    force_text,
    health_news,
    is_same_reason,
    names_text,
    position_std_m,
    tick_rate_text,
)

_MAX_EVENTS = 100
_TITLE_ROWS = 1
_FRAME_ROWS, _FRAME_COLUMNS = 2, 4
_GAP = "   "
_FULL_BAR_N = 5.0
_BAR_CHARACTERS = 8
_STYLE_OF_STATE = {
    "clear": "green",
    "touched": "bold cyan",
    "stale": "yellow",
    "unreliable": "yellow",
    "lost": "bold red",
    "faulted": "bold red",
    "starting": "dim",
    "off": "dim",
}
_OK_STATES = ("clear", "touched", "off")
_PadKey = tuple[str, str]
_ONE_EVENT_S = 0.1
"""Longest time between pads that change together: a tick at 10 Hz, the slowest that a hand is read at"""


@dataclass
class _Event:
    """What happened to pads, in one line for those that it happened to together."""

    t_ns: int
    names: list[str]
    text: str
    style: str

    def lines(self, console: Console, width: int) -> list[Text]:
        """Return the text, wrapped at a width."""
        head = f"{self.t_ns * 1e-9:12.3f}  "
        text = Text(f"{names_text(self.names)}: {self.text}", self.style)
        first, *others = text.wrap(console, max(1, width - len(head)))
        return [
            Text.assemble((head, "dim"), first),
            *(Text.assemble(" " * len(head), line) for line in others),
        ]


class _TerminalColumn(NamedTuple):
    """A column; left out when the page is narrower than `min_page_width`."""

    title: str
    width: int
    min_page_width: int
    cell: Callable[[wire.Health, wire.Contact | None], Text]
    justify: str = "left"


@dataclass
class HandView:
    """A rich renderable of the messages given to `update`; `problem`: why no daemon is connected."""

    title: str = "handtouch"
    problem: str = ""
    _health: dict[_PadKey, wire.Health] = field(default_factory=dict)
    _contacts: dict[_PadKey, wire.Contact] = field(default_factory=dict)
    _service: wire.Service | None = None
    _events: deque[_Event] = field(default_factory=lambda: deque(maxlen=_MAX_EVENTS))

    def update(self, message: wire.Message) -> None:
        """Process a message of any topic."""
        if isinstance(message, wire.Contact):
            self._update_contact(message)
        elif isinstance(message, wire.Health):
            before = self._health.get((message.hand, message.link))
            self._health[message.hand, message.link] = message
            if before and (_untouched_state(before), before.node_state) != (
                _untouched_state(message),
                message.node_state,
            ):
                text = f"pad {_untouched_state(message)}, node {message.node_state}"
                why = f": {message.reason}" if message.reason else ""
                self._add_event(message, text + why, _untouched_state(message), together=True)
            for text, status in health_news(before, message):
                self._add_event(message, text, status)
        elif isinstance(message, wire.Service):
            self._service = message

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the page: as many pads and of the newest events as the console has room for."""
        rows = (options.height or options.size.height) - _FRAME_ROWS
        width = options.max_width - _FRAME_COLUMNS
        header = self._header(width).wrap(console, width)
        rows -= len(header) + _TITLE_ROWS
        events = self._event_lines(console, width, max(0, rows - len(self._health)))
        table = self._table(width, rows - len(events))
        yield Panel(Group(*header, table, *events), title=self.title, border_style="dim")

    def _update_contact(self, contact: wire.Contact) -> None:
        key = (contact.hand, contact.link)
        if contact.event == "end":
            self._contacts.pop(key, None)
            peak = "" if contact.peak_force_n is None else f", peak {contact.peak_force_n:.2f} N"
            self._add_event(
                contact,
                f"#{contact.id} {contact.end_reason} after {contact.duration_s:.2f} s{peak}",
                "touched" if contact.end_reason == "released" else "lost",
            )
            return
        self._contacts[key] = contact
        if contact.event == "begin":
            self._add_event(contact, f"#{contact.id} begins", "touched")

    def _add_event(
        self, pad: wire.Health | wire.Contact, text: str, state: str, *, together: bool = False
    ) -> None:
        """Add an event; `together`: to the last one, if that is the same of other pads."""
        name, last = self._name(pad), self._events[-1] if self._events else None
        if (
            together
            and last is not None
            and name not in last.names
            and abs(pad.t_ns - last.t_ns) <= 1e9 * _ONE_EVENT_S
            and is_same_reason(text, last.text)
        ):
            last.names.append(name)
        else:
            self._events.append(_Event(pad.t_ns, [name], text, _STYLE_OF_STATE.get(state, "")))

    def _event_lines(self, console: Console, width: int, rows: int) -> list[Text]:
        """Return the lines of the newest events that fit; the newest one is cut where it doesn't."""
        lines: list[Text] = []
        for event in reversed(self._events):
            more = event.lines(console, width)
            if lines and len(lines) + len(more) > rows:
                break
            lines = more + lines
        return lines[:rows]

    def _name(self, pad: wire.Health | wire.Contact) -> str:
        """Return the link, with its hand if there are several."""
        return pad.link if len({hand for hand, _ in self._health}) < 2 else f"{pad.hand}/{pad.link}"

    def _header(self, width: int) -> Text:
        """Return the state of the daemon, as much of it as fits; the most important comes first."""
        if self.problem:
            return Text(self.problem, style="bold red")
        service = self._service
        if service is None:
            return Text("waiting for the daemon ...", style="dim")
        up = sum(health.node_state == "operational" for health in self._health.values())
        load = ", ".join(
            f"{name} {100 * bus.get('load', 0.0):.0f} %" for name, bus in sorted(service.buses.items())
        )
        rate = tick_rate_text(
            rate_hz=service.rate_hz,
            period_s=service.period_s,
            overruns=service.overruns,
            uptime_s=service.uptime_s,
        )
        tick_us = service.tick_us.get("p50")
        episodes = sum(service.congestion_episodes.values())
        parts = [
            Text(
                f"{up}/{len(self._health)} nodes operational",
                "green" if up == len(self._health) else "yellow",
            ),
            Text(f"touched {len(self._contacts)}"),
            Text(f"{rate} ticks/s", "yellow" if "of" in rate else ""),
            Text(f"congestion episodes {episodes}" if episodes else ""),
            Text(f"bus load {load}" if load else ""),
            Text(f"tick {tick_us:.0f} us" if tick_us is not None else ""),
        ]
        line, *others = filter(None, parts)
        for part in others:
            if line.cell_len + len(_GAP) + part.cell_len <= width:
                line = Text.assemble(line, _GAP, part)
        return line

    def _table(self, width: int, free_rows: int) -> Table:
        names = {key: self._name(health) for key, health in self._health.items()}
        hands = self._service.hands if self._service else {}
        order = {(hand, link): row for hand, links in hands.items() for row, link in enumerate(links)}
        shown = sorted(self._health, key=lambda key: (key[0], order.get(key, len(order))))
        if len(shown) > free_rows:  # pads with a contact or a fault first
            first = [k for k in shown if k in self._contacts or self._health[k].state not in _OK_STATES]
            shown = (first + [key for key in shown if key not in first])[: max(0, free_rows - 1)]
        table = Table(expand=True, box=None, pad_edge=False, header_style="dim")
        longest = max(map(len, names.values()), default=4)
        table.add_column("link", no_wrap=True, min_width=min(longest, max(8, width // 3)))
        columns = [column for column in _COLUMNS if width >= column.min_page_width + longest]
        for column in columns:
            table.add_column(
                column.title,
                no_wrap=True,
                width=column.width,
                justify="right" if column.justify == "right" else "left",
            )
        for key in shown:
            health, contact = self._health[key], self._contacts.get(key)
            table.add_row(Text(names[key]), *(column.cell(health, contact) for column in columns))
        if len(shown) < len(self._health):
            table.add_row(Text(f"and {len(self._health) - len(shown)} more", style="dim"))
        return table


def _untouched_state(health: wire.Health) -> str:
    """Return the state of a pad; contacts are shown by their own messages."""
    return "clear" if health.state == "touched" else health.state


def _state_cell(health: wire.Health, contact: wire.Contact | None) -> Text:
    state = "touched" if contact else _untouched_state(health)
    uncalibrated = health.calibration_state in UNCALIBRATED_STATES and state in _OK_STATES
    return Text(state, style="yellow" if uncalibrated else _STYLE_OF_STATE.get(state, ""))


def _node_cell(health: wire.Health, _: wire.Contact | None) -> Text:
    return Text(health.node_state, style="green" if health.node_state == "operational" else "yellow")


def _rate_cell(health: wire.Health, _: wire.Contact | None) -> Text:
    return Text(f"{health.rate_hz:.0f}")


def _force_bar_cell(_: wire.Health, contact: wire.Contact | None) -> Text:
    if contact is None:
        return Text("")
    filled = (
        0 if contact.force_n is None else round(_BAR_CHARACTERS * min(1.0, contact.force_n / _FULL_BAR_N))
    )
    return Text("█" * filled + "·" * (_BAR_CHARACTERS - filled), style="cyan")


def _force_cell(_: wire.Health, contact: wire.Contact | None) -> Text:
    return Text(force_text(contact) if contact else "")


def _position_cell(_: wire.Health, contact: wire.Contact | None) -> Text:
    if contact is None:
        return Text("")
    if contact.position_m is None:
        return Text(contact.position_status)
    return Text(" ".join(f"{1e3 * value:7.2f}" for value in contact.position_m))


def _std_cell(_: wire.Health, contact: wire.Contact | None) -> Text:
    known = contact is not None and contact.position_m is not None
    return Text(f"{1e3 * position_std_m(contact):.3f}" if known and contact else "")


def _duration_cell(_: wire.Health, contact: wire.Contact | None) -> Text:
    return Text(f"{contact.duration_s:.2f} s" if contact else "")


_COLUMNS = (
    _TerminalColumn("pad", 8, 10, _state_cell),
    _TerminalColumn("node", 11, 84, _node_cell),
    _TerminalColumn("Hz", 4, 96, _rate_cell, "right"),
    _TerminalColumn("force", _BAR_CHARACTERS, 92, _force_bar_cell),
    _TerminalColumn("force +- std", 17, 30, _force_cell),
    _TerminalColumn("position on link, mm", 23, 56, _position_cell, "right"),
    _TerminalColumn("+-", 5, 64, _std_cell, "right"),
    _TerminalColumn("for", 7, 72, _duration_cell, "right"),
)
"""Widths add up with one blank between columns; a column is shown if all more important ones fit too."""
