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
    DISCONNECTED_TEXT,
    UNCALIBRATED_STATES,
    force_text,
    health_news,
    position_std_m,
)

_MAX_EVENTS = 100
_HEADER_ROWS = 2
"""State of the daemon, and the titles of the columns"""
_FRAME_ROWS, _FRAME_COLUMNS = 2, 4
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


class _TerminalColumn(NamedTuple):
    """A column; left out when the page is narrower than `min_page_width`."""

    title: str
    width: int
    min_page_width: int
    cell: Callable[[wire.Health, wire.Contact | None], Text]
    justify: str = "left"


@dataclass
class HandView:
    """A rich renderable of the messages given to `update`; `alive`: the daemon is connected."""

    title: str = "handtouch"
    alive: bool = True
    _health: dict[_PadKey, wire.Health] = field(default_factory=dict)
    _contacts: dict[_PadKey, wire.Contact] = field(default_factory=dict)
    _service: wire.Service | None = None
    _events: deque[Text] = field(default_factory=lambda: deque(maxlen=_MAX_EVENTS))

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
                text = f"{self._name(message)}: pad {_untouched_state(message)}, node {message.node_state}"
                why = f": {message.reason}" if message.reason else ""
                self._add_event(message.t_ns, text + why, _untouched_state(message))
            for text, status in health_news(before, message):
                self._add_event(message.t_ns, f"{self._name(message)}: {text}", status)
        elif isinstance(message, wire.Service):
            self._service = message

    def __rich_console__(self, _: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the page, cut to the size of the console."""
        rows = (options.height or options.size.height) - _FRAME_ROWS
        width = options.max_width - _FRAME_COLUMNS
        header = self._header()
        header.truncate(width, overflow="ellipsis")
        event_rows = max(0, rows - _HEADER_ROWS - len(self._health))
        events = list(self._events)[-event_rows:] if event_rows else []
        for event in events:
            event.truncate(width, overflow="ellipsis")
        free_rows = rows - _HEADER_ROWS - len(events)
        yield Panel(
            Group(header, self._table(width, free_rows), *events), title=self.title, border_style="dim"
        )

    def _update_contact(self, contact: wire.Contact) -> None:
        key = (contact.hand, contact.link)
        if contact.event == "end":
            self._contacts.pop(key, None)
            peak = "" if contact.peak_force_n is None else f", peak {contact.peak_force_n:.2f} N"
            text = f"#{contact.id} {contact.end_reason} after {contact.duration_s:.2f} s{peak}"
            self._add_event(
                contact.t_ns,
                f"{self._name(contact)}: {text}",
                "touched" if contact.end_reason == "released" else "lost",
            )
            return
        self._contacts[key] = contact
        if contact.event == "begin":
            self._add_event(contact.t_ns, f"{self._name(contact)}: #{contact.id} begins", "touched")

    def _add_event(self, t_ns: int, text: str, state: str) -> None:
        self._events.append(
            Text.assemble((f"{t_ns * 1e-9:12.3f}  ", "dim"), (text, _STYLE_OF_STATE.get(state, "")))
        )

    def _name(self, pad: wire.Health | wire.Contact) -> str:
        """Return the link, with its hand if there are several."""
        return pad.link if len({hand for hand, _ in self._health}) < 2 else f"{pad.hand}/{pad.link}"

    def _header(self) -> Text:
        if not self.alive:
            return Text(DISCONNECTED_TEXT, style="bold red")
        service = self._service
        if service is None:
            return Text("waiting for the daemon ...", style="dim")
        up = sum(health.node_state == "operational" for health in self._health.values())
        load = ", ".join(
            f"{name} {100 * bus.get('load', 0.0):.0f} %" for name, bus in sorted(service.buses.items())
        )
        tick_us = service.tick_us.get("p50")
        return Text.assemble(
            (f"{up}/{len(self._health)} nodes operational", "green" if up == len(self._health) else "yellow"),
            f"   touched {len(self._contacts)}",
            f"   {service.rate_hz:.0f} ticks/s",
            f"   bus load {load}",
            f"   congestion episodes {sum(service.congestion_episodes.values())}",
            f"   tick {tick_us:.0f} us" if tick_us is not None else "",
        )

    def _table(self, width: int, free_rows: int) -> Table:
        names = {key: self._name(health) for key, health in self._health.items()}
        shown = list(self._health)
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
