"""Wording: words that the field doesn't use stay out of what users and developers read."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WORDS = (
    "told", "tells?", "in vain", "anew", "nobody", "somebody", "whoever", "wanted", "judged", "felt",
    "slow half", "fast half", "keeps? house", "another unit", "in force", "let in", "how hard",
    "what really happened", "doubtful", "unestimated", "trembl\\w*",
)  # fmt: skip
"""Write reports, publishes, false positives, again, no client, requested, assessed, detected, supervisor
process, per-tick compensation, replaced node, active, authorised, force, ground truth, unreliable, tremor."""
_PATTERN = re.compile(rf"(?<![A-Za-z])(?:{'|'.join(WORDS)})(?![A-Za-z])", re.IGNORECASE)
_RIDDLE = re.compile(r"(?:What|Whether|Who|Whose|Where|Which|Of)\b")
TEXTS = sorted(
    path
    for pattern in ("src/**/*.py", "src/**/*.js", "src/**/*.html", "docs/**/*.md", "README.md")
    for path in ROOT.glob(pattern)
    if "_build" not in path.parts
)


def _found(text: str) -> list[str]:
    text = re.sub(r"(\.|def )tell\(", "", text)  # of file objects
    apart = re.sub(r"(?<=[A-Za-z0-9])_|_(?=[A-Za-z])", " ", text)  # words in identifiers count, too
    return [
        f"line {number}: {match[0]}"
        for number, line in enumerate(apart.splitlines(), 1)
        for match in _PATTERN.finditer(line)
    ]


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_words_of_a_private_vocabulary_stay_out_of_source_and_docs(path: Path) -> None:
    assert not _found(path.read_text())


def test_names_of_tests_use_the_same_vocabulary() -> None:
    wrong = {
        f"{path.relative_to(ROOT)}: {node.name}"
        for path in ROOT.glob("tests/**/test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and _found(node.name)
    }
    assert not wrong


def test_a_docstring_begins_with_what_a_thing_is_or_returns() -> None:
    """Not with a clause such as "What ..." or "Whether ..."."""
    wrong = [
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}: {text.splitlines()[0]}"
        for path in sorted(ROOT.glob("src/**/*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module)
        if (text := ast.get_docstring(node)) and _RIDDLE.match(text)
    ]
    assert not wrong


def test_every_term_of_the_glossary_is_defined_once() -> None:
    terms = [
        term.strip()
        for row in re.findall(
            r"^\| ([^|]+) \| [^|]+ \|$", (ROOT / "docs/glossary.md").read_text(), re.MULTILINE
        )
        for term in row.split(",")
        if row.strip() not in ("term", "---")
    ]
    assert len(terms) > 40
    assert len(terms) == len(set(terms))
