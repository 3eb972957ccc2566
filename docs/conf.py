"""Sphinx configuration: `make docs` builds the site in docs/_build."""

from __future__ import annotations

import itertools
import json
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.errors import ExtensionError

from handtouch import __version__

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))
from key_figures import draw_all
from notebook_page import render_notebook

from benchmarks.stale import outdated, unmarked

EXAMPLES = Path(__file__).parents[1] / "examples"
MAX_NUMBER_CHARACTERS = 24
"""of a cell such as "93.8 (92.8-94.8)" or "12 of 300, 4 %"."""

project = "handtouch"
author = "the handtouch authors"
copyright = author  # the name that Sphinx reads
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
add_module_names = False

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = "handtouch"
html_theme_options = {"source_edit_link": "", "sidebar_hide_name": False}


def as_text(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:  # noqa: ARG001
    """Docstrings are plain text but for `names`; indented blocks are code, and hanging lines make lists."""
    made: list[str] = []
    for blank, grouped in itertools.groupby(lines, key=lambda line: not line.strip()):
        group = list(grouped)
        if not blank and all(line.startswith("    ") for line in group):
            made += ["", ".. code-block:: python", "", *group, ""]
            continue
        block = [re.sub(r"([|*\\]|_\b)", r"\\\1", line) for line in group]
        hanging = not blank and any(line.startswith(" ") for line in block)
        if hanging and made and made[-1].strip():
            made.append("")
        made += [_in_list(line) for line in block] if hanging else block
    lines[:] = made


def _in_list(line: str) -> str:
    return f"  {line.strip()}" if line.startswith(" ") else f"* {line}"


def mark_outdated(app: Any, page: str, source: list[str]) -> None:
    """Add a note below the title of a page of measurements that is older than the code it measures."""
    results = Path(app.srcdir) / f"{page}.json"
    if page.startswith("benchmarks/") and results.exists():
        parts = outdated(json.loads(results.read_text()))
        title, rest = source[0].split("\n", 1)
        if parts:
            commits = ", ".join(sorted({f"`{commit}`" for commit in parts.values()}))
            note = f"The code that it measures has changed since commit {commits}."
            source[0] = f"{title}\n\n:::{{note}}\n{note}\n:::\n{rest}"


def check_quotes(app: Any) -> None:
    """Fail for a front page that quotes outdated results without their commit."""
    for path in (Path(app.srcdir).parent / "README.md", Path(app.srcdir) / "key_figures.md"):
        if missing := unmarked(path.read_text()):
            raise ExtensionError(f"{path.name} quotes outdated results without their commit: {missing}")


def insert_notebooks(app: Any, page: str, source: list[str]) -> None:  # noqa: ARG001
    """Replace each `<!-- notebook: NAME -->` by the notebook, executed unless that follows the name."""

    def insert(mark: re.Match[str]) -> str:
        figures = Path(app.srcdir) / "_figures"
        return render_notebook(EXAMPLES / f"{mark[1]}.ipynb", figures, execute=mark[2] is None)

    source[0] = re.sub(r"<!-- notebook: (\w+)(, not executed)? -->", insert, source[0])


def mark_numbers(app: Any, doctree: nodes.document) -> None:  # noqa: ARG001
    """Give short cells that begin with a number the class `number`, which keeps them on one line."""
    for cell in doctree.findall(nodes.entry):
        text = cell.astext().strip()
        if len(text) <= MAX_NUMBER_CHARACTERS and re.match(r"[<>~+\-\u2212]?\s?\d", text):
            cell["classes"].append("number")


def setup(app: Any) -> None:
    """Sphinx calls it."""
    app.connect("builder-inited", lambda app: draw_all(Path(app.srcdir) / "_figures"))
    app.connect("builder-inited", check_quotes)
    app.connect("source-read", mark_outdated)
    app.connect("source-read", insert_notebooks)
    app.connect("doctree-read", mark_numbers)
    app.connect("autodoc-process-docstring", as_text)
