"""The demo: one command, no hardware, and a summary of how near it came to the truth."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path


def test_the_demo_finds_touches_within_the_noise_bound_and_ends_by_itself() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "handtouch", "demo", "--seconds", "9"],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"begin +right/index_distal", done.stdout)
    total = done.stdout.splitlines()[-1].split()
    assert total[0] == "all"
    assert int(total[1]) > 20
    ratio, invented = float(total[4]), int(total[-1])
    assert ratio < 2.5  # a few weak samples carry it in so short a time; the whole session stays below 1.5
    assert invented == 0


STUCK = """

[[fault]]
kind = "stuck_channel"
link = "ring_distal"
from_s = 0.5
electrode = "xa"

[[touch]]
link = "index_distal"
from_s = 0.1
duration_s = 10.0
path = [[0.2, 0.3], [0.8, 0.5]]
force_n = [0.8]
"""


def test_a_scenario_with_a_fault_has_it_told_in_words_and_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "stuck.toml").write_text(STUCK)
    home = {**os.environ, "HOME": str(tmp_path), "XDG_STATE_HOME": str(tmp_path / "state")}
    command = ["--seconds", "150", "--scenario", str(tmp_path / "stuck.toml")]
    rest = _interrupted_at(r"right/ring_distal.*channel xa", *command, env=home)
    assert re.search(r"^found right/ring_distal: channel xa", rest, re.MULTILINE)
    assert not (tmp_path / "state").exists()


def test_ctrl_c_ends_the_demo_with_its_summary() -> None:
    assert "touches missed invented" in _interrupted_at(" begin ")


def _interrupted_at(said: str, *options: str, env: dict[str, str] | None = None) -> str:
    """What a demo with these options says after a Ctrl-C, which it gets once a line matches `said`."""
    command = [sys.executable, "-m", "handtouch", "demo", "--plain", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as demo:
        assert demo.stdout is not None
        try:
            assert any(re.search(said, line) for line in demo.stdout)
            demo.send_signal(signal.SIGINT)
            rest = demo.stdout.read()
            assert demo.wait(30) == 0
        finally:
            demo.kill()
    return rest


def test_two_demos_run_side_by_side() -> None:
    command = [sys.executable, "-m", "handtouch", "demo", "--plain", "--seconds", "2"]
    demos = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(2)]
    end_s = time.monotonic() + 100
    assert [demo.wait(end_s - time.monotonic()) for demo in demos] == [0, 0]
