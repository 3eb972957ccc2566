"""Pages of notebooks: cells as Markdown, code executed in one namespace without Jupyter, figures as PNG.

Public names: `render_notebook`, `execute_notebook`. Needs matplotlib.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt


class ExecutedCell(NamedTuple):
    """A cell with what it printed, and its open figures as PNG; both empty for text."""

    is_code: bool
    source: str
    printed: str
    figures: tuple[bytes, ...]


def render_notebook(notebook: Path, folder: Path, execute: bool = True) -> str:
    """Return a notebook as a section of a page in Markdown, executed or as it stands.

    Figures go to `folder` beside the page, created if missing. Raises what a cell raises.
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = []
    for number, cell in enumerate(execute_notebook(notebook) if execute else _cells(notebook)):
        text = re.sub(r"^#", "##", cell.source, flags=re.MULTILINE)  # headings one level down
        parts.append(f"```python\n{cell.source}\n```" if cell.is_code else text)
        if cell.printed:
            parts.append(f"```text\n{cell.printed.rstrip()}\n```")
        for index, picture in enumerate(cell.figures):
            name = f"{notebook.stem}_{number}_{index}.png"
            (folder / name).write_bytes(picture)
            parts.append(f"![Drawn by the code above]({folder.name}/{name})")
    return "\n\n".join(parts) + "\n"


def execute_notebook(notebook: Path) -> Iterator[ExecutedCell]:
    """Yield the cells of a notebook, executed in order in one namespace. Raises what a cell raises."""
    names: dict[str, Any] = {"__name__": "__main__"}
    with matplotlib.rc_context({"figure.facecolor": "white"}):
        for cell in _cells(notebook):
            if not cell.is_code:
                yield cell
                continue
            printed = io.StringIO()
            try:
                with redirect_stdout(printed):
                    exec(compile(cell.source, str(notebook), "exec"), names)
                figures = tuple(_png(plt.figure(number)) for number in plt.get_fignums())
            finally:
                plt.close("all")
            yield cell._replace(printed=printed.getvalue(), figures=figures)


def _cells(notebook: Path) -> Iterator[ExecutedCell]:
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        yield ExecutedCell(cell["cell_type"] == "code", "".join(cell["source"]), "", ())


def _png(figure: Any) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    return picture.getvalue()
