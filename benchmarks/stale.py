"""Figures that are older than the code that they measure: `python -m benchmarks.stale [PAGE ...]`.

A program's results state a digest of the code it imports, at any depth, from src and benchmarks; comments,
docstrings and layout don't count. Without arguments every page of docs/benchmarks/ must be up to date. With
pages, such as README.md: of each page of results that one links to and that is older than the code, it must
name the commit. The exit code is 1 otherwise.

Public names: `outdated`, `unmarked`; `source_digest` and `measured_commit` for who keeps results.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "benchmarks"
LAZY = ROOT / "src" / "handtouch" / "__init__.py"
"""Names in it are imported on use: it depends on all, and nothing that imports a package depends on it."""
NOT_MEASURED = ("page.py", "stale.py")
"""Files of benchmarks/ that keep results and measure nothing."""


def outdated(results: Mapping[str, Any]) -> dict[str, str]:
    """Return the commits of runs that are older than the code by the names of their parts."""
    program = ROOT / "benchmarks" / f"{results['program']}.py"
    source = source_digest(program) if program.exists() else ""
    return {part: run["commit"] for part, run in results["parts"].items() if run["source"] != source}


def unmarked(text: str) -> list[str]:
    """Return the pages of results that a text links to though older than the code, and names no commit of."""
    missing = []
    for name in sorted(set(re.findall(r"benchmarks/(\w+)\.md", text))):
        path = RESULTS / f"{name}.json"
        commits = set(outdated(json.loads(path.read_text())).values()) if path.exists() else {"unknown"}
        missing += [f"{name} (commit {commit})" for commit in sorted(commits) if commit not in text]
    return missing


def forget_files() -> None:
    """Read all files again from now on."""
    for cached in (_tree, _imported, _code_digest):
        cached.cache_clear()


def source_digest(program: Path) -> str:
    """Return a digest of the code that a program imports at any depth, and its own."""
    digest, waiting, seen = hashlib.sha256(), [program], {program}
    while waiting:
        for path in _imported(waiting.pop()):
            if path not in seen and path.name not in NOT_MEASURED:
                seen.add(path)
                waiting.append(path)
    for path in sorted(seen):
        digest.update(f"{path.relative_to(ROOT)} {_code_digest(path)}\n".encode())
    return digest.hexdigest()[:12]


def measured_commit() -> str:
    """Return the checked-out commit, with a note if the code was changed since; `unknown` without git."""
    git = ("git", "-C", str(ROOT))
    try:
        commit = subprocess.run(
            [*git, "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=True
        ).stdout.strip()
        changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "src", "benchmarks"], check=False)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit + (" with changes" if changed.returncode else "")


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def _imported(path: Path) -> tuple[Path, ...]:
    """Return the files of this repository that a file imports."""
    found: list[Path] = []
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            found += [file for alias in node.names for file in _files(alias.name)]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found += _files(node.module)
            found += [file for alias in node.names for file in _files(f"{node.module}.{alias.name}")]
    return tuple(found)


def _files(module: str) -> Iterator[Path]:
    """Yield the file of a module, with those of its packages, from src or benchmarks."""
    parts = module.split(".")
    for folder in (ROOT / "src", *([ROOT] if parts[0] == "benchmarks" else [])):
        for depth in range(1, len(parts) + 1):
            base = folder.joinpath(*parts[:depth])
            for file in (base.with_suffix(".py"), base / "__init__.py"):
                if file.is_file() and file != LAZY:
                    yield file


@cache
def _code_digest(path: Path) -> str:
    return hashlib.sha256(repr(_code(_tree(path))).encode()).hexdigest()


def _code(node: object) -> object:
    """Return a syntax tree as nested tuples, without docstrings and empty fields, alike for all Pythons."""
    if isinstance(node, list):
        is_text = [isinstance(entry, ast.Expr) and isinstance(entry.value, ast.Constant) for entry in node]
        return tuple(_code(entry) for entry, text in zip(node, is_text, strict=True) if not text)
    if not isinstance(node, ast.AST):
        return node
    fields = ((name, value) for name, value in ast.iter_fields(node) if value is not None and value != [])
    return (type(node).__name__, *((name, _code(value)) for name, value in fields))


def main() -> int:
    """Check what the command line names; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="*", type=Path)
    problems = []
    for page in parser.parse_args().pages:
        problems += [f"{page} quotes {found} without its commit" for found in unmarked(page.read_text())]
    if len(sys.argv) == 1:
        for path in sorted(RESULTS.glob("*.json")):
            if path.name != "run_times.json":
                for part, commit in outdated(json.loads(path.read_text())).items():
                    problems.append(f"{path.stem} {part}".strip() + f": measured at commit {commit}")
    for problem in problems:
        print(f"older than the code: {problem}", file=sys.stderr)
    if problems:
        print("measure them again, or leave the figures out", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
