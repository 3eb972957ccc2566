"""Running all benchmarks: what may run side by side, what becomes of failures, run times kept together."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from benchmarks import page
from benchmarks.run_programs import SIDE_BY_SIDE, Runner, main

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", SIDE_BY_SIDE)
def test_what_runs_side_by_side_measures_no_wall_time(name: str) -> None:
    waiting, seen = [ROOT / "benchmarks" / f"bench_{name}.py"], set()
    while waiting:
        path = waiting.pop()
        seen.add(path)
        text = path.read_text()
        assert not re.search(r"perf_counter|time\.monotonic|time\.time\b", text), path
        modules = set(re.findall(r"^from benchmarks\.(\w+)", text, re.MULTILINE)) - {"page"}
        own = {ROOT / "benchmarks" / f"{module}.py" for module in modules}
        waiting += [each for each in own - seen if each.exists()]


def test_a_failed_program_is_named_with_its_last_lines_and_stops_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, good = tmp_path / "bench_bad.py", tmp_path / "bench_good.py"
    bad.write_text("print('first')\nraise SystemExit('no such pad')\n")
    good.write_text("import sys\nprint('measured', *sys.argv[1:])\n")
    runner = Runner(tmp_path / "out", ["--quick"])
    runner.run([bad, good], 1)
    printed = capsys.readouterr().out
    assert runner.failed == [bad]
    assert re.search(r"bench_bad: FAILED after .*, exit code 1\n    first\n    no such pad", printed)
    assert "bench_good: done in" in printed
    assert (tmp_path / "out" / "bench_good.txt").read_text() == "measured --quick\n"


def test_an_unknown_program_is_refused_with_the_names_of_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "worms"]) == 2
    printed = capsys.readouterr().err
    assert "bench_worms.py" in printed
    assert "worlds" in printed


def test_one_named_program_writes_to_the_terminal_and_its_exit_code_is_returned() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.run_programs", "bench", "worlds", "--no-such-option"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "unrecognized arguments: --no-such-option" in done.stderr


def test_programs_that_end_together_all_keep_their_run_time(tmp_path: Path) -> None:
    entry = {"minutes": 1.0, "cpu_minutes": 2.0, "load": 0.5, "commit": "1234567"}
    (tmp_path / "README.md").write_text("# Measurements\n")
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda i: page.keep_run_time(tmp_path, f"bench_{i}", entry), range(24)))
    assert len(json.loads((tmp_path / page.RUN_TIMES).read_text())) == 24
    assert (tmp_path / "README.md").read_text().count("| bench_") == 24
