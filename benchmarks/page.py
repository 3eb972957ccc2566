"""Options and pages of benchmarks, the stamp of what they measured, and their run times.

Public names: `options`, `output_folder`, `table`, `made_by`, `progress`; `outdated` for readers of a page;
`keep_run_time` and `measured_commit` for who runs several programs.

A program that ends without an error notes how long it took in docs/benchmarks/run_times.json, and in the
table at the end of docs/benchmarks/README.md.
"""

from __future__ import annotations

import argparse
import ast
import atexit
import fcntl
import hashlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "benchmarks"
LAZY = ROOT / "src" / "handtouch" / "__init__.py"
"""Names in it are imported on use: it depends on all, and nothing that imports a package depends on it."""
STAMP = re.compile(
    r"Made\s+by\s+`make\s+(bench|soak|stress)\s+ONLY=(\w+)`\s+at\s+commit\s+`([^`]+)`,\s+source\s+`(\w+)`"
)
"""Kind and name of the program, commit and source digest, as `made_by` writes them."""
RUN_TIMES = "run_times.json"
RUN_TIMES_HEAD = "## Run times\n"
"""Of the last section of docs/benchmarks/README.md, which the programs write."""
_BEGAN_S = time.monotonic()


def options(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the option that every benchmark has."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a little of everything; keeps no page")
    return parser


def output_folder(quick: bool) -> Path:
    """Return docs/benchmarks or, for a quick pass, a folder that is deleted when the process ends."""
    if not quick:
        OUT.mkdir(parents=True, exist_ok=True)
        atexit.register(_note_run_time, OUT, _program().stem, os.getpid())
        return OUT
    scratch = tempfile.TemporaryDirectory(prefix="handtouch-bench-")
    atexit.register(scratch.cleanup)
    return Path(scratch.name)


def table(title: str, note: str, rows: list[dict[str, Any]]) -> list[str]:
    """Lines of a section with a table of rows by their keys; printed as well."""
    heads = list(rows[0])
    lines = [f"## {title}", "", note, "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        cells = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values())
        lines.append("| " + " | ".join(cells) + " |")
    print("\n".join(lines), end="\n\n", flush=True)
    return [*lines, ""]


def progress(done: object) -> None:
    """Print a line about what is done, with the time since the program began."""
    print(f"[{time.monotonic() - _BEGAN_S:6.0f} s] {done}", file=sys.stderr, flush=True)


def keep_run_time(folder: Path, name: str, entry: dict[str, Any]) -> None:
    """Write how long a program took into the folder's run_times.json and the README's table of all."""
    path, readme = folder / RUN_TIMES, folder / "README.md"
    lock = os.open(folder, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)  # programs may end at the same time
    try:
        _write_run_time(path, readme, name, entry)
    finally:
        os.close(lock)


def _write_run_time(path: Path, readme: Path, name: str, entry: dict[str, Any]) -> None:
    known = json.loads(path.read_text()) if path.exists() else {}
    known[name] = entry
    path.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
    lines = ["| program | minutes | CPU minutes | load average | commit |", "| --- | --- | --- | --- | --- |"]
    for program, row in sorted(known.items()):
        numbers = " | ".join(f"{row[key]:.1f}" for key in ("minutes", "cpu_minutes", "load"))
        lines.append(f"| {program} | {numbers} | {row['commit']} |")
    all_bench = [row["minutes"] for program, row in known.items() if program.startswith("bench_")]
    note = (
        "Of the last full run of each program: wall time, processor time of all its processes, and the load "
        f"average when it ended. The benchmarks listed here take {sum(all_bench):.0f} minutes in sum; "
        "`make bench` runs those that time nothing side by side."
    )
    before = readme.read_text().partition(RUN_TIMES_HEAD)[0].rstrip() if readme.exists() else ""
    readme.write_text("\n".join([f"{before}\n\n{RUN_TIMES_HEAD}", *textwrap.wrap(note, 110), "", *lines, ""]))


def _note_run_time(folder: Path, name: str, process: int) -> None:
    """At exit of the program's own process: keep the run time unless it ends by an error."""
    if os.getpid() != process or hasattr(sys, "last_value"):
        return
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    entry = {
        "minutes": (time.monotonic() - _BEGAN_S) / 60,
        "cpu_minutes": sum(usage.ru_utime + usage.ru_stime for usage in used) / 60,
        "load": os.getloadavg()[0],
        "commit": measured_commit(),
    }
    keep_run_time(folder, name, entry)


def made_by() -> str:
    """Return the stamp of the running program: its name, commit and source digest."""
    program = _program()
    kind, _, name = program.stem.partition("_")
    commit, source = measured_commit(), source_digest(program)
    return f"Made by `make {kind} ONLY={name}` at commit `{commit}`, source `{source}`"


def outdated(text: str) -> str:
    """Return why a page is older than the code that it measures; empty if it isn't."""
    stamps = STAMP.findall(text)
    if not stamps:
        return "The page doesn't state a commit; the code that it measures has changed since."
    for kind, name, commit, source in stamps:
        program = ROOT / "benchmarks" / f"{kind}_{name}.py"
        if not program.exists():
            return f"The program that made the page at commit {commit} was removed."
        if source_digest(program) != source:
            return f"The code that the page measures has changed since commit {commit}."
    return ""


def forget_files() -> None:
    """Read all files again from now on."""
    for cached in (_tree, _imported, _code_digest):
        cached.cache_clear()


def source_digest(program: Path) -> str:
    """Return a digest of the code that a program imports at any depth, from src and benchmarks, and its own.

    Comments, docstrings and layout don't count, nor does this module, which measures nothing.
    """
    digest, waiting, seen = hashlib.sha256(), [program], {program}
    while waiting:
        for path in _imported(waiting.pop()):
            if path not in seen:
                seen.add(path)
                waiting.append(path)
    for path in sorted(seen - {Path(__file__)}):
        digest.update(f"{path.relative_to(ROOT)} {_code_digest(path)}\n".encode())
    return digest.hexdigest()[:12]


def _program() -> Path:
    return Path(str(sys.modules["__main__"].__file__)).resolve()


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
