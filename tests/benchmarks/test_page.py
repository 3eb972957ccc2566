"""Pages of benchmarks: families of seeds, and the stamp of what was measured."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import page

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


def test_the_index_has_a_row_for_every_page_and_none_else() -> None:
    folder = ROOT / "docs" / "benchmarks"
    rows = re.findall(r"^\| (\[.*\.md\)) \|", (folder / "README.md").read_text(), re.MULTILINE)
    linked = [name for row in rows for name in re.findall(r"\((\w+\.md)\)", row)]
    assert sorted(linked) == sorted(path.name for path in folder.glob("*.md") if path.name != "README.md")


def test_every_benchmark_writes_the_page_of_its_name() -> None:
    for path in (ROOT / "docs" / "benchmarks").glob("*.md"):
        for kind, name, *_ in page.STAMP.findall(path.read_text()):
            assert path.stem in (name, f"{kind}_{name}")


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A benchmark that measures one module, in a tree of its own."""
    monkeypatch.setattr(page, "ROOT", tmp_path)
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "src" / "handtouch").mkdir(parents=True)
    (tmp_path / "src" / "handtouch" / "measured.py").write_text('"""Text."""\nSIZE = 3\n')
    (tmp_path / "src" / "handtouch" / "other.py").write_text("SIZE = 3\n")
    made = tmp_path / "benchmarks" / "bench_it.py"
    made.write_text("from handtouch.measured import SIZE\n")
    yield made
    page.forget_files()


def stamped(program: Path) -> str:
    return (
        f"# It\n\nMade by `make bench ONLY=it` at commit `1234567`,\nsource `{page.source_digest(program)}`."
    )


def rewrite(path: Path, text: str) -> None:
    path.write_text(text)
    page.forget_files()


def test_a_page_is_outdated_when_code_changes_that_its_program_imports(program: Path) -> None:
    text, measured = stamped(program), program.parents[1] / "src" / "handtouch" / "measured.py"
    assert page.outdated(text) == ""
    rewrite(measured, '"""Text."""\nSIZE = 4\n')
    assert "changed since commit 1234567" in page.outdated(text)


def test_comments_docstrings_and_other_modules_outdate_no_page(program: Path) -> None:
    text, folder = stamped(program), program.parents[1] / "src" / "handtouch"
    rewrite(folder / "measured.py", '"""Another text."""\n\nSIZE = (3)  # as before\n')
    rewrite(folder / "other.py", "SIZE = 5\n")
    assert page.outdated(text) == ""


def test_a_page_without_a_stamp_or_a_program_is_outdated(program: Path) -> None:
    text = stamped(program)
    assert "doesn't state a commit" in page.outdated("# It\n\nMade by `make bench ONLY=it`; x86_64.")
    program.unlink()
    assert "was removed" in page.outdated(text)


def test_a_run_time_is_kept_in_the_readmes_table(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# Measurements\n\nText.\n")
    entry = {"minutes": 2.0, "cpu_minutes": 3.5, "load": 0.4, "commit": "1234567"}
    page.keep_run_time(tmp_path, "bench_it", entry)
    page.keep_run_time(tmp_path, "bench_other", {**entry, "minutes": 40.0})
    page.keep_run_time(tmp_path, "bench_it", {**entry, "minutes": 5.0})
    text = (tmp_path / "README.md").read_text()
    assert text.startswith("# Measurements\n\nText.\n")
    assert text.count("bench_it") == text.count(page.RUN_TIMES_HEAD) == 1
    assert "| bench_it | 5.0 | 3.5 | 0.4 | 1234567 |" in text
    assert "45 minutes" in " ".join(text.split())


@pytest.mark.parametrize(("ending", "is_kept"), [("", True), ("raise ValueError", False)])
def test_a_program_keeps_its_run_time_unless_it_fails(tmp_path: Path, ending: str, is_kept: bool) -> None:
    program = tmp_path / "bench_it.py"
    program.write_text(
        f"import sys\nfrom pathlib import Path\nsys.path.insert(0, {str(ROOT)!r})\n"
        "from benchmarks import page\n"
        f"page.OUT = Path({str(tmp_path)!r})\npage.output_folder(False)\n{ending}\n"
    )
    subprocess.run([sys.executable, program], check=False, capture_output=True)
    assert (tmp_path / page.RUN_TIMES).exists() is is_kept
