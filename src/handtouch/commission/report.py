"""The end of commissioning: a table of the pads, and what changed in the file."""

from __future__ import annotations

import difflib

import numpy as np

from .outcome import Outcome
from .session import Session

_TITLES = ("pad", "node", "serial", "electrodes", "noise", "result")


def table(session: Session) -> str:
    """A line a pad, with what is wrong below it; noise in counts, measured (configured)."""
    outcomes = [session.outcomes[row] for row in session.chosen]
    rows = [_cells(session, row, session.outcomes[row]) for row in session.chosen]
    widths = [max(len(cells[i]) for cells in (_TITLES, *rows)) for i in range(len(_TITLES))]
    lines = [_line(_TITLES, widths)]
    for outcome, cells in zip(outcomes, rows, strict=True):
        lines.append(_line(cells, widths))
        lines += [f"    {problem}" for problem in outcome.problems]
    well = sum(outcome.well for outcome in outcomes)
    lines.append(f"{well} of {len(rows)} pads are well.")
    return "\n".join(lines) + "\n"


def difference(before: str, after: str, name: str) -> str:
    """The lines that changed, table by table, as a diff shows them; empty when nothing changed.

    Tables are compared one by one: a diff of the whole would show swapped nodes as pads that moved.
    """
    shown, line = [], 1
    for old, new in zip(_tables(before), _tables(after), strict=True):
        if old != new:
            link = next((text.partition("=")[2].strip() for text in old if text.startswith("link")), "")
            shown.append(f"@@ line {line} @@ {old[0].strip()} {link}".rstrip())
            body = list(difflib.unified_diff(old, new, n=1, lineterm=""))[2:]
            shown += [text for text in body if not text.startswith("@@")]
        line += len(old)
    return "\n".join([f"--- {name}", f"+++ {name}, as found", *shown]) + "\n" if shown else ""


def _tables(text: str) -> list[list[str]]:
    """Lines of the text, a new list at every table header."""
    tables: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.startswith("["):
            tables.append([])
        tables[-1].append(line)
    return tables


def _cells(session: Session, row: int, outcome: Outcome) -> tuple[str, ...]:
    node, rest = session.node_of(row), session.rest_of(row)
    known = outcome.slot is not None
    configured = session.noise_counts(row)
    noise = "-"
    if rest is not None and rest.samples:
        noise = f"{float(np.max(rest.std)):.1f} ({configured:g})"
    return (
        outcome.name,
        f"{node.bus} 0x{node.node_id:02X}" if known else "-",
        str(node.serial) if known and node.serial else "-",
        " ".join(outcome.electrodes) if outcome.electrodes else "-",
        noise,
        outcome.result.value,
    )


def _line(cells: tuple[str, ...], widths: list[int]) -> str:
    return "  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()
