"""Tables of commands, and the console that they are printed to.

Public names: `make_table`, `print_table`, `output_console`, `table_lines`.
"""

from __future__ import annotations

import sys
from collections.abc import Collection
from io import StringIO
from typing import Any, TextIO

from rich.cells import cell_len
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

_PIPE_COLUMNS = 200
"""Width without a terminal: one line per row, for grep."""
_UNWRAPPED_COLUMNS = 10_000
_MIN_WRAPPED_COLUMNS = 24
"""Narrowest column of long texts: three words a line; with less room, a row becomes a paragraph"""


def make_table(*columns: str, right: Collection[str] = (), wrapped: Collection[str] = ()) -> Table:
    """Return an empty table without a frame; `right`: columns of numbers, `wrapped`: long texts."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in columns:
        table.add_column(
            column, justify="right" if column in right else "left", no_wrap=column not in wrapped
        )
    return table


def print_table(console: Console, table: Table) -> None:
    """Print a table; where its columns don't fit, a paragraph for each row, which names what it lists."""
    widths = [
        _MIN_WRAPPED_COLUMNS if not column.no_wrap else max(map(_width, (column.header, *column.cells)))
        for column in table.columns
    ]
    if sum(widths) + len(widths) - 1 <= console.width:
        console.print(table)
        return
    first, *others = table.columns
    rows = zip(first.cells, *(column.cells for column in others), strict=True)
    for name, *cells in rows:
        pairs = [
            Text.assemble((f"{column.header} " if column.header else "", "dim"), _as_text(cell))
            for column, cell in zip(others, cells, strict=True)
            if _as_text(cell)
        ]
        console.print(_as_text(name))
        console.print(Padding(Text(", ").join(pairs), (0, 0, 0, 2)))


def _as_text(cell: Any) -> Text:
    return cell if isinstance(cell, Text) else Text(str(cell))


def _width(cell: Any) -> int:
    return max((cell_len(line) for line in _as_text(cell).plain.splitlines()), default=0)


def output_console(file: TextIO | None = None, *, terminal: bool | None = None) -> Console:
    """Return a console for text without markup, on standard output by default.

    `terminal`: style the text, and wrap it at the terminal's width; default: if standard output is one.
    """
    terminal = sys.stdout.isatty() if terminal is None else terminal
    width = None if terminal else _PIPE_COLUMNS
    return Console(
        file=file, width=width, force_terminal=terminal, markup=False, highlight=False, emoji=False
    )


def table_lines(table: Table) -> list[str]:
    """Return the header of a table and a line for each row, unstyled and never wrapped."""
    file = StringIO()
    Console(file=file, width=_UNWRAPPED_COLUMNS, markup=False, highlight=False, emoji=False).print(table)
    return [line.rstrip() for line in file.getvalue().splitlines()]
