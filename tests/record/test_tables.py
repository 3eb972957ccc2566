"""A recording as tables and as figures: every row that there is, every name with its unit."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from handtouch.record import export, plot
from handtouch.record.read import Recording
from handtouch.record.tables import split

pyarrow = pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def tables(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tables")
    for kind in ("csv", "parquet"):
        assert export.run(recorded, folder, kind) == 0
    return folder


def _rows(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_contact_message_is_a_row_with_its_values(recorded: Path, tables: Path) -> None:
    contacts = [e for e in Recording(recorded).read("contact") if not e.payload["repeat"]]
    rows = _rows(tables, "contacts")
    assert len(rows) == len(contacts) > 100
    for row, (_, t_ns, payload) in zip(rows, contacts, strict=True):
        assert int(row["time_ns"]) == t_ns
        assert row["link"] == payload["link"]
        assert float(row["force_n"]) == payload["force_n"]
        place = [float(row[f"position_{axis}_m"]) for axis in "xyz"]
        assert place == payload["position_m"]


def test_every_tick_has_a_row_of_counts_for_every_pad(recorded: Path, tables: Path) -> None:
    ticks = sum(not entry.payload["stopped"] for entry in Recording(recorded).read("tick"))
    rows = _rows(tables, "raw")
    assert len(rows) == 2 * ticks
    assert {row["link"] for row in rows} == {"plane", "round"}
    assert any(int(row["xa_counts"]) > 100 for row in rows)
    assert {row["node_state"] for row in rows} == {"clear", "lost"}


def test_hand_frames_are_rows_of_what_is_known(tables: Path) -> None:
    rows = _rows(tables, "hand")
    untouched = [row for row in rows if row["state"] == "clear"]
    touched = [row for row in rows if row["state"] == "touched"]
    assert untouched[0]["force_n"] == ""
    assert float(touched[-1]["position_z_m"]) == pytest.approx(0.0, abs=0.02)


def test_health_tells_lists_in_one_cell(tables: Path) -> None:
    rows = _rows(tables, "health")
    assert [row["state"] for row in rows] == ["clear", "lost"]
    assert rows[0]["emergencies"] == "low supply; hot"


def test_parquet_holds_the_same_rows_with_types(tables: Path) -> None:
    from pyarrow import parquet

    for name in ("contacts", "raw", "hand", "health", "service"):
        table = parquet.read_table(tables / f"{name}.parquet")
        rows = _rows(tables, name)
        assert table.num_rows == len(rows)
        assert table.column_names == list(rows[0])
    kinds = {field.name: str(field.type) for field in parquet.read_schema(tables / "contacts.parquet")}
    assert (kinds["time_ns"], kinds["force_n"], kinds["link"]) == ("int64", "double", "string")
    forces = parquet.read_table(tables / "contacts.parquet")["force_n"].to_pylist()
    assert forces == [float(row["force_n"]) for row in _rows(tables, "contacts")]


@pytest.mark.parametrize(
    ("name", "length", "parts"),
    [
        ("position_m", 3, ["position_x_m", "position_y_m", "position_z_m"]),
        ("normal", 3, ["normal_x", "normal_y", "normal_z"]),
        ("pad_m", 2, ["pad_x_m", "pad_y_m"]),
        ("palm_normal", 3, ["palm_normal_x", "palm_normal_y", "palm_normal_z"]),
    ],
)
def test_parts_of_a_vector_keep_its_unit_at_the_end(name: str, length: int, parts: list[str]) -> None:
    assert split(name, length) == parts


def test_what_cannot_be_exported_is_told_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export.run(tmp_path / "absent.mcap", tmp_path, "csv") == 1
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    assert export.run(empty, tmp_path / "made", "csv") == 1
    told = capsys.readouterr().err
    assert "absent.mcap" in told
    assert "holds no message" in told


@pytest.fixture(scope="module")
def plots(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("plots")
    assert plot.run(recorded, folder) == 0
    return folder


def test_figures_are_drawn_as_vectors_and_as_pictures(plots: Path) -> None:
    for name in ("timeline", "forces", "pads", "health"):
        assert (plots / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert (plots / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_drawn_is_what_was_recorded(recorded: Path) -> None:
    story = plot.read(Recording(recorded))
    ids = {(e.topic, e.payload["id"]) for e in Recording(recorded).read("contact")}
    assert sum(map(len, story.touches.values())) == len(ids)
    assert story.pads["h/plane"] == pytest.approx((30.0, 24.0))
    reasons = [touch.reason for touches in story.touches.values() for touch in touches.values()]
    assert {"released", "lost", "stopped"} >= set(reasons) >= {"released", "stopped"}
    part = plot.read(Recording(recorded), from_s=0.5, to_s=1.0)
    times = [t for touches in part.touches.values() for touch in touches.values() for t in touch.t_s]
    assert 0.5 <= min(times) <= max(times) <= 1.0


def test_nothing_to_draw_is_told(tmp_path: Path, recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plot.run(recorded, tmp_path, from_s=1e6) == 1
    assert "holds no message of a daemon in that time" in capsys.readouterr().err


def test_the_summary_is_readable_without_any_of_this(recorded: Path) -> None:
    recording = Recording(recorded)
    entries: list[Any] = list(recording)
    assert int(recording.summary["messages"]) == len(entries)
    assert json.loads(recording.summary["lost"]) == {}
