"""What a program measured, kept as JSON, and the pages that are made from it.

Public names: `options`, `progress`; `Report`, which a program fills and keeps; `render_page`, `render_index`
and `render_all` for who makes pages without measuring: `python -m benchmarks.page`.

docs/benchmarks/NAME.json holds a run for each part of a program, with its commit, machine, tables and limits.
The page shows these and the program's docstring, nothing else: what is said of a result is computed from it.
"""

from __future__ import annotations

import argparse
import ast
import atexit
import fcntl
import json
import math
import os
import platform
import resource
import statistics
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "benchmarks"
RUN_TIMES = "run_times.json"
WIDTH = 110
Row = dict[str, Any]
Rows = list[Row]
_BEGAN_S = time.monotonic()
# programs that run themselves again, and those that run others by path, find the package
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])


def options(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the option that every benchmark has."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a little of everything; keeps no page")
    return parser


def progress(done: object) -> None:
    """Print a line about what is done, with the time since the program began."""
    print(f"[{time.monotonic() - _BEGAN_S:6.0f} s] {done}", file=sys.stderr, flush=True)


def machine() -> str:
    """Return what the figures of a run depend on, but for the code."""
    return f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"


def middle(
    rows: Sequence[Row], by: Sequence[str], sums: Sequence[str] = ("lost", "compared", "equal")
) -> Rows:
    """Return a row for each case, of columns `by`: medians over its turns, and sums of the named columns."""
    cases: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        cases.setdefault(tuple(row[key] for key in by), []).append(row)
    found = []
    for case, of_case in cases.items():
        keys = [key for key in of_case[-1] if key not in (*by, "turn")]
        values = {key: [row[key] for row in of_case if row.get(key) is not None] for key in keys}
        found.append(
            dict(zip(by, case, strict=True))
            | {
                key: sum(some) if key in sums else statistics.median(some) if some else None
                for key, some in values.items()
            }
        )
    return found


@dataclass(frozen=True)
class Limit:
    """A measured value beside what it may be; `at_least`: the limit is a lower one."""

    what: str
    measured: float
    limit: float
    unit: str = ""
    at_least: bool = False

    @property
    def is_met(self) -> bool:
        """NaN meets none."""
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    def row(self) -> Row:
        sign = "at least" if self.at_least else "at most"
        return {
            "limit": self.what,
            "measured": f"{_cell(self.measured)} {self.unit}".strip(),
            "allowed": f"{sign} {_cell(self.limit)} {self.unit}".strip(),
            "met": self.is_met,
        }


class Report:
    """Tables, limits and settings of one run of the running program.

    `part`: of a program that measures parts by separate runs; others' results stay in the file. `quick`:
    print only; a full run that ends without an error keeps its figures, its page and its run time.
    """

    def __init__(self, quick: bool, part: str = "", **settings: object) -> None:
        self.quick, self.part = quick, part
        self.run: dict[str, Any] = {"settings": dict(settings), "tables": {}}
        self.limits: list[Limit] = []

    def table(self, title: str, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add a table of rows by their keys, and print it."""
        self.run["tables"][title] = plain = _plain([dict(row) for row in rows])
        print("\n".join(_section(title, plain)), flush=True)

    def limit(
        self, what: str, measured: float, limit: float, unit: str = "", *, at_least: bool = False
    ) -> None:
        """Compare a measured value with its limit."""
        self.limits.append(Limit(what, float(measured), float(limit), unit, at_least))

    @property
    def is_met(self) -> bool:
        """Every limit is met."""
        return all(limit.is_met for limit in self.limits)

    def keep(self) -> bool:
        """Print the limits, write results and page unless the run is quick; return whether all are met."""
        if self.limits:
            self.table("Limits", [limit.row() for limit in self.limits])
        print(f"all limits met: {_cell(self.is_met)}; {machine()}, load {os.getloadavg()[0]:.1f}", flush=True)
        if self.quick:
            return self.is_met
        from benchmarks.stale import measured_commit, source_digest

        program = program_path()
        self.run["commit"], self.run["source"] = measured_commit(), source_digest(program)
        self.run["machine"] = f"{machine()}, load {os.getloadavg()[0]:.1f}"
        OUT.mkdir(parents=True, exist_ok=True)
        path = OUT / f"{program_name()}.json"
        with _locked(OUT):
            known = json.loads(path.read_text()) if path.exists() else {"parts": {}}
            known = {"program": program.stem, "parts": known["parts"] | {self.part: self.run}}
            path.write_text(as_text(known))
            path.with_suffix(".md").write_text(render_page(known))
        atexit.register(_note_run_time, OUT, program.stem, os.getpid())
        return self.is_met


def program_path() -> Path:
    """Return the file of the running program."""
    return Path(str(sys.modules["__main__"].__file__)).resolve()


def program_name() -> str:
    """Return the name of the running program's page: without `bench_` or `stress_`."""
    return page_name(program_path().stem)


def page_name(program: str) -> str:
    """Return the name of a program's page; `soak_rate` keeps its kind, `bench_tick` doesn't."""
    kind, _, name = program.partition("_")
    return name if kind == "bench" else program


def docstring(program: str) -> str:
    """Return the text of a program that its page shows."""
    path = ROOT / "benchmarks" / f"{program}.py"
    return ast.get_docstring(ast.parse(path.read_text())) or ""


def as_text(results: Mapping[str, Any]) -> str:
    """Return the JSON of a program's results, a line for each row of a table."""
    parts = []
    for part, run in results["parts"].items():
        tables = [
            f"  {json.dumps(title)}: [\n   " + ",\n   ".join(map(json.dumps, rows)) + "\n  ]"
            for title, rows in run["tables"].items()
        ]
        others = json.dumps({key: value for key, value in run.items() if key != "tables"})[:-1]
        parts.append(f' {json.dumps(part)}: {others}, "tables": {{\n' + ",\n".join(tables) + "\n }}")
    return f'{{"program": {json.dumps(results["program"])}, "parts": {{\n' + ",\n".join(parts) + "\n}}\n"


def render_page(results: Mapping[str, Any]) -> str:
    """Return the page of a program's results, as they are in its JSON file."""
    program = results["program"]
    kind, _, name = program.partition("_")
    first, _, rest = docstring(program).partition("\n")
    title, _, more = first.partition(":")
    text = f"{more.strip().capitalize() if more else ''}\n{rest}".strip()
    lines = [f"# {title.rstrip('.')}", "", *([text, ""] if text else [])]
    for part, run in results["parts"].items():
        if part:
            lines += [f"## {part[:1].upper()}{part[1:]}", ""]
        made = f"Measured by `make {kind} ONLY={name}` at commit `{run['commit']}` on {run['machine']}."
        stated = ", ".join(
            f"{key.replace('_', ' ')} {_cell(value)}" for key, value in run["settings"].items()
        )
        lines += [textwrap.fill(f"{made} {f'Settings: {stated}.' if stated else ''}".strip(), WIDTH), ""]
        for heading, rows in run["tables"].items():
            lines += _section(heading, rows, "###" if part else "##")
    return "\n".join(lines).rstrip() + "\n"


def render_index(folder: Path) -> str:
    """Return the list of all pages, and the table of run times."""
    text = (folder / "README.md").read_text().partition("## Pages\n")[0].rstrip()
    lines = [text, "", "## Pages", ""]
    for path in sorted(folder.glob("*.json")):
        if path.name != RUN_TIMES:
            first = docstring(json.loads(path.read_text())["program"]).partition("\n")[0]
            lines.append(f"* [{path.stem}]({path.stem}.md): {first}")
    times = folder / RUN_TIMES
    known: dict[str, Row] = json.loads(times.read_text()) if times.exists() else {}
    sum_min = sum(row["minutes"] for name, row in known.items() if name.startswith("bench_"))
    note = (
        "Of the last full run of each program: wall time, processor time of all its processes, and the load "
        f"average when it ended. The benchmarks take {sum_min:.0f} minutes in sum; `make bench` runs those "
        "that time nothing side by side."
    )
    rows = [
        {
            "program": name,
            **{key.replace("cpu_", "CPU "): row[key] for key in ("minutes", "cpu_minutes", "load")},
        }
        | {"commit": row["commit"]}
        for name, row in sorted(known.items())
    ]
    return (
        "\n".join([*lines, "", *_section("Run times", rows, note=textwrap.fill(note, WIDTH))]).rstrip() + "\n"
    )


def render_all(folder: Path = OUT) -> None:
    """Write every page and the index again from the results that are there."""
    for path in folder.glob("*.json"):
        if path.name != RUN_TIMES:
            path.with_suffix(".md").write_text(render_page(json.loads(path.read_text())))
    (folder / "README.md").write_text(render_index(folder))


def _section(title: str, rows: Rows, level: str = "##", note: str = "") -> list[str]:
    """Return the lines of a heading and a table; rows may lack keys."""
    heads = list(dict.fromkeys(key for row in rows for key in row))
    lines = [f"{level} {title}", "", *([note, ""] if note else [])]
    if not rows:
        return [*lines, "None.", ""]
    lines += ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(_cell(row.get(head, "")) for head in heads) + " |" for row in rows]
    return [*lines, ""]


def _cell(value: Any) -> str:
    """Return the text of a value as it is in JSON."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, Mapping):
        from benchmarks.scores import from_plain

        return str(from_plain(value))
    if isinstance(value, Sequence) and not isinstance(value, str):
        return " / ".join(map(_cell, value))
    return str(value)


def _plain(value: Any) -> Any:
    """Return a value as JSON has it; shares and rates keep their counts, NaN becomes None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if hasattr(value, "as_plain"):
        return value.as_plain()
    if hasattr(value, "tolist"):  # numpy's
        return _plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(entry) for entry in value]
    return (
        value
        if not isinstance(value, float) or math.isfinite(value)
        else None
        if value != value
        else str(value)
    )


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder: programs may end at the same time."""
    lock = os.open(folder, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        yield
    finally:
        os.close(lock)


def keep_run_time(folder: Path, name: str, entry: Row) -> None:
    """Write how long a program took into the folder's run_times.json and the index."""
    with _locked(folder):
        path = folder / RUN_TIMES
        known = json.loads(path.read_text()) if path.exists() else {}
        path.write_text(json.dumps(known | {name: entry}, indent=1, sort_keys=True) + "\n")
        (folder / "README.md").write_text(render_index(folder))


def _note_run_time(folder: Path, name: str, process: int) -> None:
    """At exit of the program's own process: keep the run time unless it ends by an error."""
    if os.getpid() != process or hasattr(sys, "last_value"):
        return
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    keep_run_time(folder, name, run_time(_BEGAN_S, sum(usage.ru_utime + usage.ru_stime for usage in used)))


def run_time(began_s: float, processor_s: float) -> Row:
    """Return the entry of a run that began at a time of the monotonic clock and ends now."""
    from benchmarks.stale import measured_commit

    return {
        "minutes": (time.monotonic() - began_s) / 60,
        "cpu_minutes": processor_s / 60,
        "load": os.getloadavg()[0],
        "commit": measured_commit(),
    }


if __name__ == "__main__":
    render_all()
