"""The live page in a terminal of any size: who is touched where, how hard, how sure; how the nodes fare."""

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
from handtouch.view.lines import DOUBTED, finding_text, location_std_m, strength_text

_EVENTS = 6
_FRAME_ROWS, _FRAME_COLUMNS = 2, 4
_FULL_BAR_N = 5.0
_BAR = 8
_STYLE_OF_STATE = {
    "clear": "green",
    "touched": "bold cyan",
    "stale": "yellow",
    "lost": "bold red",
    "faulted": "bold red",
    "starting": "dim",
    "off": "dim",
}
_NO_NEWS = ("clear", "touched", "off")
_Key = tuple[str, str]


class _Column(NamedTuple):
    """A column, which is left out when the page is narrower than `from_width`."""

    title: str
    width: int
    from_width: int
    cell: Callable[[wire.Health, wire.Contact | None], Text]
    justify: str = "left"


@dataclass
class HandView:
    """A page of the messages given to `update`, for rich to draw; `alive`: was the daemon heard lately."""

    title: str = "handtouch"
    alive: bool = True
    _health: dict[_Key, wire.Health] = field(default_factory=dict)
    _contacts: dict[_Key, wire.Contact] = field(default_factory=dict)
    _service: wire.Service | None = None
    _events: deque[Text] = field(default_factory=lambda: deque(maxlen=_EVENTS))

    def update(self, message: wire.Message) -> None:
        """Take in a message of any topic."""
        if isinstance(message, wire.Contact):
            self._take_contact(message)
        elif isinstance(message, wire.Health):
            before = self._health.get((message.hand, message.link))
            self._health[message.hand, message.link] = message
            if before and (_pad_state(before), before.node) != (_pad_state(message), message.node):
                text = f"{self._name(message)}: pad {_pad_state(message)}, node {message.node}"
                why = f": {message.reason}" if message.reason else ""
                self._note(message.t_ns, text + why, _pad_state(message))
            self._note_findings(before, message)
        elif isinstance(message, wire.Service):
            self._service = message

    def __rich_console__(self, _: Console, options: ConsoleOptions) -> RenderResult:
        """The page, as much of it as there is room for."""
        rows = (options.height or options.size.height) - _FRAME_ROWS
        width = options.max_width - _FRAME_COLUMNS
        header = self._header()
        header.truncate(width, overflow="ellipsis")
        events = list(self._events)[-max(0, min(_EVENTS, rows - len(self._health) - 3)) :]
        if rows < len(self._health) + 3:
            events = []
        for event in events:
            event.truncate(width, overflow="ellipsis")
        room = rows - 2 - len(events)
        yield Panel(Group(header, self._table(width, room), *events), title=self.title, border_style="dim")

    def _take_contact(self, contact: wire.Contact) -> None:
        key = (contact.hand, contact.link)
        if contact.event == "end":
            self._contacts.pop(key, None)
            peak = "" if contact.peak_force_n is None else f", peak {contact.peak_force_n:.2f} N"
            text = f"#{contact.id} {contact.reason} after {contact.duration_s:.2f} s{peak}"
            self._note(
                contact.t_ns,
                f"{self._name(contact)}: {text}",
                "touched" if contact.reason == "released" else "lost",
            )
            return
        self._contacts[key] = contact
        if contact.event == "begin":
            self._note(contact.t_ns, f"{self._name(contact)}: #{contact.id} begins", "touched")

    def _note_findings(self, before: wire.Health | None, health: wire.Health) -> None:
        known = {finding.get("kind") for finding in before.findings} if before else set()
        for finding in health.findings:
            if finding.get("kind") not in known:
                self._note(health.t_ns, f"{self._name(health)}: {finding_text(finding)}", "stale")
        if before and before.trust in DOUBTED and health.trust not in DOUBTED:
            self._note(health.t_ns, f"{self._name(health)}: {health.trust} again", "clear")

    def _note(self, t_ns: int, text: str, state: str) -> None:
        self._events.append(
            Text.assemble((f"{t_ns * 1e-9:12.3f}  ", "dim"), (text, _STYLE_OF_STATE.get(state, "")))
        )

    def _name(self, pad: wire.Health | wire.Contact) -> str:
        """The link, with its hand where there are several."""
        return pad.link if len({hand for hand, _ in self._health}) < 2 else f"{pad.hand}/{pad.link}"

    def _header(self) -> Text:
        if not self.alive:
            return Text("the daemon is silent: is handtouch run up?", style="bold red")
        service = self._service
        if service is None:
            return Text("waiting for the daemon ...", style="dim")
        up = sum(health.node == "operational" for health in self._health.values())
        load = ", ".join(
            f"{name} {100 * bus.get('load', 0.0):.0f} %" for name, bus in sorted(service.buses.items())
        )
        tick_us = service.tick_us.get("p50")
        return Text.assemble(
            (f"{up}/{len(self._health)} nodes operational", "green" if up == len(self._health) else "yellow"),
            f"   touched {len(self._contacts)}",
            f"   {service.rate_hz:.0f} ticks/s",
            f"   bus load {load}",
            f"   dropped {sum(service.drops.values())}",
            f"   tick {tick_us:.0f} us" if tick_us is not None else "",
        )

    def _table(self, width: int, room: int) -> Table:
        names = {key: self._name(health) for key, health in self._health.items()}
        shown = list(self._health)
        if len(shown) > room:  # then those that there is something to say of come first
            news = [k for k in shown if k in self._contacts or self._health[k].state not in _NO_NEWS]
            shown = (news + [key for key in shown if key not in news])[: max(0, room - 1)]
        table = Table(expand=True, box=None, pad_edge=False, header_style="dim")
        longest = max(map(len, names.values()), default=4)
        table.add_column("link", no_wrap=True, min_width=min(longest, max(8, width // 3)))
        columns = [column for column in _COLUMNS if width >= column.from_width + longest]
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


def _pad_state(health: wire.Health) -> str:
    """State of a pad apart from being touched, which contacts tell."""
    return "clear" if health.state == "touched" else health.state


def _pad(health: wire.Health, contact: wire.Contact | None) -> Text:
    state = "touched" if contact else _pad_state(health)
    doubted = health.trust in DOUBTED and state in _NO_NEWS
    return Text(state, style="yellow" if doubted else _STYLE_OF_STATE.get(state, ""))


def _node(health: wire.Health, _: wire.Contact | None) -> Text:
    return Text(health.node, style="green" if health.node == "operational" else "yellow")


def _rate(health: wire.Health, _: wire.Contact | None) -> Text:
    return Text(f"{health.rate_hz:.0f}")


def _bar(_: wire.Health, contact: wire.Contact | None) -> Text:
    if contact is None:
        return Text("")
    filled = 0 if contact.force_n is None else round(_BAR * min(1.0, contact.force_n / _FULL_BAR_N))
    return Text("█" * filled + "·" * (_BAR - filled), style="cyan")


def _strength(_: wire.Health, contact: wire.Contact | None) -> Text:
    return Text(strength_text(contact) if contact else "")


def _place(_: wire.Health, contact: wire.Contact | None) -> Text:
    if contact is None:
        return Text("")
    if contact.position_m is None:
        return Text("invalid")
    return Text(" ".join(f"{1e3 * value:7.2f}" for value in contact.position_m))


def _doubt(_: wire.Health, contact: wire.Contact | None) -> Text:
    known = contact is not None and contact.position_m is not None
    return Text(f"{1e3 * location_std_m(contact):.3f}" if known and contact else "")


def _duration(_: wire.Health, contact: wire.Contact | None) -> Text:
    return Text(f"{contact.duration_s:.2f} s" if contact else "")


_COLUMNS = (
    _Column("pad", 8, 10, _pad),
    _Column("node", 11, 84, _node),
    _Column("Hz", 4, 96, _rate, "right"),
    _Column("force", _BAR, 92, _bar),
    _Column("how hard", 17, 30, _strength),
    _Column("where on the link, mm", 23, 56, _place, "right"),
    _Column("+-", 5, 64, _doubt, "right"),
    _Column("for", 7, 72, _duration, "right"),
)
"""Widths add up with one blank between columns; a column needs what those that matter more than it take."""
