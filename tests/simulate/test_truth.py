"""Ground truth survives its file, and its times convert to the wall clock."""

from __future__ import annotations

import io
import time
from dataclasses import replace
from pathlib import Path

import pytest

from handtouch.simulate import truth as truth_file
from handtouch.simulate.truth import GroundTruth

RECORD = GroundTruth(
    10**9,
    "right",
    "tip",
    2,
    0.01,
    0.02,
    (0.1, -0.2, 0.3),
    (0.0, 0.6, 0.8),
    1.5,
    2e-3,
    (1e-3, 2e-3, 0.0, 1e-9),
    5e-6,
)


def write(path: Path, records: list[GroundTruth]) -> None:
    text = io.StringIO()
    truth_file.write_header(text, time.time_ns() - time.monotonic_ns())
    truth_file.write_records(text, records)
    path.write_text(text.getvalue())


def test_records_survive_a_round_trip(tmp_path: Path) -> None:
    records = [RECORD, replace(RECORD, t_ns=2 * 10**9, link="flat")]
    write(tmp_path / "t.jsonl", records)
    assert truth_file.read_records(tmp_path / "t.jsonl") == records


def test_times_convert_to_wall_clock(tmp_path: Path) -> None:
    write(tmp_path / "t.jsonl", [replace(RECORD, t_ns=time.monotonic_ns())])
    (found,) = truth_file.read_records(tmp_path / "t.jsonl", wall=True)
    assert abs(found.t_ns - time.time_ns()) < 5e9


def test_invalid_line_is_reported(tmp_path: Path) -> None:
    write(tmp_path / "t.jsonl", [RECORD])
    with (tmp_path / "t.jsonl").open("a") as file:
        file.write('{"t_ns": 3}\n')
    with pytest.raises(ValueError, match="line 3"):
        truth_file.read_records(tmp_path / "t.jsonl")
