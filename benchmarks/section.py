"""Sections of the pages that benchmarks write."""

from __future__ import annotations

from typing import Any


def table(title: str, note: str, rows: list[dict[str, Any]]) -> list[str]:
    """Lines of a section with a table of rows by their keys; printed as well."""
    heads = list(rows[0])
    lines = [f"## {title}", "", note, "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        cells = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values())
        lines.append("| " + " | ".join(cells) + " |")
    print("\n".join(lines), end="\n\n", flush=True)
    return [*lines, ""]
