"""Pages of benchmarks: families of seeds, rendering, and figures that are older than the code."""

from __future__ import annotations

import ast
import json
import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks import page, stale

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "benchmarks").glob("*.py"))
TRAINERS = [path for path in FILES if path.stem.startswith("train_")]
"""They fit what is shipped, and publish no figures."""


@pytest.mark.parametrize("path", sorted({*FILES} - {*TRAINERS}), ids=lambda path: path.stem)
def test_benchmarks_draw_worlds_of_the_reporting_family_only(path: Path) -> None:
    text = path.read_text()
    assert "TUNING" not in text
    _check_drawn_worlds(text, "REPORTING")


@pytest.mark.parametrize("path", TRAINERS, ids=lambda path: path.stem)
def test_trainers_draw_worlds_of_the_tuning_family_only(path: Path) -> None:
    text = path.read_text()
    assert "REPORTING" not in text
    _check_drawn_worlds(text, "TUNING")


def _check_drawn_worlds(text: str, family: str) -> None:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "draw":
            is_world = len(node.args) == 1  # a fault takes a generator and more
            argument = ast.unparse(node.args[0])
            assert not is_world or re.match(rf"Family\.{family}\.seed\(", argument), ast.unparse(node)


def results(source: str, commit: str = "1234567", **run: Any) -> dict[str, Any]:
    return {
        "program": "bench_it",
        "parts": {
            "": {"settings": {}, "tables": {}, "commit": commit, "source": source, "machine": "x", **run}
        },
    }


def test_every_page_of_the_repository_is_what_its_results_render(tmp_path: Path) -> None:
    for path in page.OUT.glob("*"):
        (tmp_path / path.name).write_text(path.read_text())
    page.render_all(tmp_path)
    for path in page.OUT.glob("*"):
        assert (tmp_path / path.name).read_text() == path.read_text(), path
    assert {path.stem for path in page.OUT.glob("*.md")} - {"README"} == {
        page.page_name(json.loads(path.read_text())["program"])
        for path in page.OUT.glob("*.json")
        if path.name != page.RUN_TIMES
    }


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A benchmark that measures one module, in a tree of its own."""
    for module in (page, stale):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(stale, "RESULTS", tmp_path)
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "src" / "handtouch").mkdir(parents=True)
    (tmp_path / "src" / "handtouch" / "measured.py").write_text('"""Text."""\nSIZE = 3\n')
    (tmp_path / "src" / "handtouch" / "other.py").write_text("SIZE = 3\n")
    made = tmp_path / "benchmarks" / "bench_it.py"
    made.write_text('"""Cost of it: by size.\n\nHow.\n"""\n\nfrom handtouch.measured import SIZE\n')
    yield made
    stale.forget_files()


def rewrite(path: Path, text: str) -> None:
    path.write_text(text)
    stale.forget_files()


def test_results_are_outdated_when_code_changes_that_their_program_imports(program: Path) -> None:
    kept, measured = results(stale.source_digest(program)), program.parents[1] / "src/handtouch/measured.py"
    assert stale.outdated(kept) == {}
    rewrite(measured, '"""Text."""\nSIZE = 4\n')
    assert stale.outdated(kept) == {"": "1234567"}


def test_comments_docstrings_and_other_modules_outdate_no_results(program: Path) -> None:
    kept, folder = results(stale.source_digest(program)), program.parents[1] / "src" / "handtouch"
    rewrite(folder / "measured.py", '"""Another text."""\n\nSIZE = (3)  # as before\n')
    rewrite(folder / "other.py", "SIZE = 5\n")
    assert stale.outdated(kept) == {}


def test_results_of_a_removed_program_are_outdated(program: Path) -> None:
    kept = results(stale.source_digest(program))
    program.unlink()
    assert stale.outdated(kept) == {"": "1234567"}


def test_a_page_must_name_the_commit_of_outdated_results_that_it_links_to(program: Path) -> None:
    link, kept = "It takes [3 us](benchmarks/it.md)", program.parents[1] / "it.json"
    kept.write_text(json.dumps(results(stale.source_digest(program))))
    assert stale.unmarked(link) == []
    kept.write_text(json.dumps(results("another")))
    assert stale.unmarked(link) == ["it (commit 1234567)"]
    assert stale.unmarked(f"{link} at commit `1234567`.") == []


def test_a_page_says_what_the_results_and_the_program_say(program: Path) -> None:
    rows = [{"size": 3, "share": {"count": 1, "total": 2}, "met": False, "ms": [0.12345, None]}]
    text = page.render_page(results("s", tables={"Sizes": rows}, settings={"runs": 3}))
    assert text.startswith("# Cost of it\n\nBy size.\n\nHow.\n")
    assert "at commit `1234567` on x. Settings: runs 3." in text
    assert "| 3 | 50.0 (1.3-98.7) | NO | 0.123 / - |" in text
    assert program.exists()


def test_kept_json_reads_back_as_it_was() -> None:
    kept = results("s", tables={"a": [{"b": 1.5, "c": None}, {"b": "x"}], "d": []})
    assert json.loads(page.as_text(kept)) == kept


def test_a_limit_that_a_value_does_not_meet_is_said_so_and_nan_meets_none() -> None:
    assert page.Limit("delay", 2.0, 3.0, "ms").row()["met"]
    assert not page.Limit("delay", 4.0, 3.0, "ms").row()["met"]
    assert not page.Limit("rate", 2.0, 3.0, at_least=True).is_met
    assert not page.Limit("delay", math.nan, 3.0).is_met


def test_a_run_time_is_kept_in_the_readmes_table(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# Measurements\n\nText.\n")
    entry = {"minutes": 2.0, "cpu_minutes": 3.5, "load": 0.4, "commit": "1234567"}
    page.keep_run_time(tmp_path, "bench_it", entry)
    page.keep_run_time(tmp_path, "bench_other", {**entry, "minutes": 40.0})
    page.keep_run_time(tmp_path, "bench_it", {**entry, "minutes": 5.0})
    text = (tmp_path / "README.md").read_text()
    assert text.startswith("# Measurements\n\nText.\n")
    assert text.count("bench_it") == text.count("## Run times") == 1
    assert "| bench_it | 5 | 3.5 | 0.4 | 1234567 |" in text
    assert "45 minutes" in " ".join(text.split())


@pytest.mark.parametrize(("ending", "is_kept"), [("", True), ("raise ValueError", False)])
def test_a_program_keeps_its_run_time_unless_it_fails(tmp_path: Path, ending: str, is_kept: bool) -> None:
    (tmp_path / "README.md").write_text("# Measurements\n")
    program = ROOT / "benchmarks" / "bench_tick.py"
    script = (
        "import runpy, sys\nfrom pathlib import Path\nfrom benchmarks import page\n"
        f"page.OUT = Path({str(tmp_path)!r})\npage.program_path = lambda: Path({str(program)!r})\n"
        f"report = page.Report(False)\nreport.table('T', [{{'a': 1.0}}])\nreport.keep()\n{ending}\n"
    )
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=False, capture_output=True)
    assert (tmp_path / page.RUN_TIMES).exists() is is_kept
    assert "| 1 |" in (tmp_path / "tick.md").read_text()
