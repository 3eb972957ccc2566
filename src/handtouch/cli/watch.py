"""`handtouch watch`: show messages as a live table in a terminal, as plain or JSON lines elsewhere."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence

from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_endpoint, add_number
from handtouch.client import UnknownNameError, connect
from handtouch.view.displays import Display, LineDisplay, LiveDisplay, show_messages


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `watch`."""
    parser.set_defaults(command=run)
    parser.add_argument(
        "patterns",
        metavar="PATTERN",
        nargs="*",
        help='topics such as "contact/*/thumb_*", "hand/*", "service" (default: contacts and health)',
    )
    add_endpoint(parser, "live")
    style = parser.add_mutually_exclusive_group()
    style.add_argument(
        "--plain", dest="style", action="store_const", const="plain", help="print lines, also on a terminal"
    )
    style.add_argument(
        "--json", dest="style", action="store_const", const="json", help="print JSON, a line per message"
    )
    parser.add_argument("--wide", action="store_true", help="don't shorten lines to the terminal's width")
    add_number(parser, "--seconds", "S", "duration (default: until Ctrl-C)", default=0.0)
    parser.set_defaults(style="auto")


def run(
    patterns: Sequence[str],
    *,
    endpoint: str,
    key: str | None,
    style: str = "auto",
    wide: bool = False,
    seconds: float = 0,
) -> int:
    """Show messages until Ctrl-C, or for `seconds`; `style`: auto, plain or json.

    Default patterns: contacts and health, as a live table on a terminal. Exit status 0, 1 if no message was
    received in that time or the daemon rejects this client, 2 for wrong usage.
    """
    live = style == "auto" and sys.stdout.isatty() and not patterns
    default = ("contact/*/*", "health/*/*", "service") if live else ("contact/*/*", "health/*/*")
    end_s = time.monotonic() + seconds if seconds else float("inf")
    with failing(2, ValueError):
        messages = connect(*(patterns or default), endpoint=endpoint, key=key)
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() and not wide else None
    display: Display = (
        LiveDisplay(f"handtouch at {endpoint}") if live else LineDisplay(style == "json", columns)
    )
    try:
        with failing(1, PermissionError, UnknownNameError), messages, display:
            show_messages(messages, display, lambda: time.monotonic() > end_s)
            has_received = messages.has_received
    except KeyboardInterrupt:  # the usual end
        return 0
    if not has_received:
        raise CommandError(messages.connection.reason_of_silence, 1)
    return 0
