"""The live view in a terminal: who is touched where, how hard, how sure, and how the nodes fare."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from handtouch import wire
from handtouch.view.lines import location_std_m, strength_text

_EVENTS = 6
_FULL_BAR_N = 5.0
_BAR = 8
_STYLE_OF_STATE = {
    "clear": "green",
    "touched": "bold cyan",
    "stale": "yellow",
    "lost": "bold red",
    "faulted": "bold red",
    "starting": "dim",
}


@dataclass
class HandView:
    """What a terminal shows of the messages given to `update`; `render` draws it."""

    title: str = "handtouch"
    _health: dict[tuple[str, str], wire.Health] = field(default_factory=dict)
    _contacts: dict[tuple[str, str], wire.Contact] = field(default_factory=dict)
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
                text = f"{message.link}: pad {_pad_state(message)}, node {message.node}"
                why = f": {message.reason}" if message.reason else ""
                self._note(message.t_ns, text + why, _pad_state(message))
        elif isinstance(message, wire.Service):
            self._service = message

    def render(self, alive: bool = True) -> RenderableType:
        """The page; `alive` is whether the daemon was heard lately."""
        return Panel(
            Group(self._header(alive), self._table(), self._footer()), title=self.title, border_style="dim"
        )

    def _take_contact(self, contact: wire.Contact) -> None:
        key = (contact.hand, contact.link)
        if contact.event == "end":
            self._contacts.pop(key, None)
            peak = "" if contact.peak_force_n is None else f", peak {contact.peak_force_n:.2f} N"
            text = f"{contact.link}: #{contact.id} {contact.reason} after {contact.duration_s:.2f} s{peak}"
            self._note(contact.t_ns, text, "touched" if contact.reason == "released" else "lost")
            return
        self._contacts[key] = contact
        if contact.event == "begin":
            self._note(contact.t_ns, f"{contact.link}: #{contact.id} begins", "touched")

    def _note(self, t_ns: int, text: str, state: str) -> None:
        self._events.append(
            Text.assemble((f"{t_ns * 1e-9:12.3f}  ", "dim"), (text, _STYLE_OF_STATE.get(state, "")))
        )

    def _header(self, alive: bool) -> Text:
        if not alive:
            return Text("the daemon is silent: is handtouch run up?", style="bold red")
        service = self._service
        if service is None:
            return Text("waiting for the daemon ...", style="dim")
        up = sum(health.node == "operational" for health in self._health.values())
        tick_us = service.tick_us.get("p50")
        load = ", ".join(
            f"{name} {100 * bus.get('load', 0.0):.0f} %" for name, bus in sorted(service.buses.items())
        )
        return Text.assemble(
            (f"{up}/{len(self._health)} nodes operational", "green" if up == len(self._health) else "yellow"),
            f"   {service.rate_hz:.0f} ticks/s",
            f"   tick {tick_us:.0f} us" if tick_us is not None else "",
            f"   bus load {load}",
            f"   dropped {sum(service.drops.values())}",
            f"   touched {len(self._contacts)}",
        )

    def _table(self) -> Table:
        table = Table(expand=True, box=None, pad_edge=False, header_style="dim")
        table.add_column("link", no_wrap=True, ratio=3)
        table.add_column("pad", no_wrap=True, width=8)
        table.add_column("node", no_wrap=True, width=11)
        table.add_column("Hz", justify="right", no_wrap=True, width=4)
        table.add_column("force", no_wrap=True, width=_BAR)
        table.add_column("how hard", no_wrap=True, width=17)
        table.add_column("where on the link, mm", no_wrap=True, justify="right", width=23)
        table.add_column("+-", justify="right", no_wrap=True, width=5)
        table.add_column("for", justify="right", no_wrap=True, width=7)
        hands = {hand for hand, _ in self._health}
        for key, health in self._health.items():
            name = health.link if len(hands) == 1 else f"{health.hand}/{health.link}"
            table.add_row(Text(name), *self._row(health, self._contacts.get(key)))
        return table

    def _row(self, health: wire.Health, contact: wire.Contact | None) -> list[Text]:
        state = "touched" if contact else _pad_state(health)
        row = [
            Text(state, style=_STYLE_OF_STATE.get(state, "")),
            Text(health.node, style="green" if health.node == "operational" else "yellow"),
            Text(f"{health.rate_hz:.0f}"),
        ]
        if contact is None:
            return [*row, Text(""), Text(""), Text(""), Text(""), Text("")]
        where, sure = "invalid", ""
        if contact.position_m is not None:
            where = " ".join(f"{1e3 * value:7.2f}" for value in contact.position_m)
            sure = f"{1e3 * location_std_m(contact):.3f}"
        filled = 0 if contact.force_n is None else round(_BAR * min(1.0, contact.force_n / _FULL_BAR_N))
        return [
            *row,
            Text("█" * filled + "·" * (_BAR - filled), style="cyan"),
            Text(strength_text(contact)),
            Text(where),
            Text(sure),
            Text(f"{contact.duration_s:.2f} s"),
        ]

    def _footer(self) -> RenderableType:
        lines = [*self._events, *[Text("")] * (_EVENTS - len(self._events))]
        return Group(Text(""), *lines)


def _pad_state(health: wire.Health) -> str:
    """State of a pad apart from being touched, which contacts tell."""
    return "clear" if health.state == "touched" else health.state
