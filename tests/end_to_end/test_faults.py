"""A fault of each kind is reported with its cause, affects no other pad, and ends when it is removed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
KINDS = 52


@pytest.mark.timeout(300)
def test_campaign_of_one_fault_of_each_kind_leaves_nothing_behind(tmp_path: Path) -> None:
    """With the limits of a busy machine; the figures are in docs/benchmarks/stress_faults.md."""
    options = ["--faults", str(KINDS), "--rate", "3", "--period-ms", "20", "--patience", "5"]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.stress_faults", *options, "--keep", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    results = json.loads((tmp_path / "faults.json").read_text())
    # those that fell into a pause of the machine are void
    assert len(results["kinds"]) == results["faults"] > KINDS / 2
    assert all(row["reported"] in (None, row["number"]) for row in results["kinds"])
    assert results["samples_sent"] > 5000
    assert results["samples_lost"] == len(results["exceptions"]) == results["exit_status"] == 0


def test_two_nodes_with_one_id_are_logged_as_errors(rig: Any) -> None:
    """All 15 ids are used twice; the limit of repeated messages lets the decisive line of each pad pass.

    Until their heartbeats have shown it, two nodes that answer one request are an SDO fault.
    """
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    rig.processes["first"] = rig.processes.pop("simulate")
    rig.simulate()

    def named() -> set[str]:
        errors = [line for line in rig.printed("run").splitlines() if line.startswith("ERROR")]
        duplicate = [line for line in errors if "duplicate node id" in line]
        return {name for line in duplicate for name in re.findall(r"\((\w+/\w+)\)", line)}

    rig.wait("all named in the log", lambda _: len(named()) == 15)
