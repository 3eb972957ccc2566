"""Programs in benchmarks/ start, print their help, and run; their figures aren't checked here."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAMS = sorted(
    path for kind in ("bench", "soak", "stress") for path in (ROOT / "benchmarks").glob(f"{kind}_*.py")
)
CHEAP = ("bench_shape",)
"""Programs whose quick pass takes two seconds; the others are too long for a test."""


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_every_program_explains_itself_and_has_a_quick_pass(
    program: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [str(program), "--help"])
    monkeypatch.setattr(os, "environ", os.environ.copy())
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(program), run_name="__main__")
    assert ended.value.code == 0
    assert "--quick" in capsys.readouterr().out


@pytest.mark.parametrize("name", CHEAP)
def test_a_quick_pass_prints_a_stamped_page_and_keeps_none(name: str) -> None:
    pages = ROOT / "docs" / "benchmarks"
    before = {path: path.stat().st_mtime_ns for path in pages.iterdir()}
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", "--quick"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "|---|" in done.stdout
    assert {path: path.stat().st_mtime_ns for path in pages.iterdir()} == before
