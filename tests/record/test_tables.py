"""Export of recordings as tables and figures: complete rows, units in every column name."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch.cli import main
from handtouch.record import plot
from handtouch.record.export import Row, component_names, find_columns, flatten_payload, pad_state_name
from handtouch.record.recording import Recording

pyarrow = pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def tables(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tables")
    for kind in ("csv", "parquet"):
        assert main(["export", str(recorded), "-o", str(folder), "--format", kind]) == 0
    return folder


def test_export_lists_its_tables_as_json(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(recorded), "--output", str(tmp_path), "--json"]) == 0
    tables = json.loads(capsys.readouterr().out)["tables"]
    assert {Path(table["file"]).name: table["rows"] for table in tables}["contacts.csv"] > 100


def test_columns_are_those_with_a_value_in_some_row() -> None:
    rows: list[tuple[str, Row]] = [
        ("contacts", {"link": "tip", "force_n": None, "empty": "", "never": None}),
        ("contacts", {"link": "tip", "force_n": 1.0, "diagnoses": "gum"}),
        ("health", {"link": "tip"}),
    ]
    assert find_columns(iter(rows)) == {"contacts": ["link", "force_n", "diagnoses"], "health": ["link"]}


def test_diagnoses_and_states_of_a_later_version_are_exported() -> None:
    assert flatten_payload({"diagnoses": ("gum", "dead_electrode")}) == {"diagnoses": "gum; dead_electrode"}
    assert pad_state_name(1) == "touched"
    assert pad_state_name(200) == "200"


def _rows(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_contact_message_is_a_row_with_its_values(recorded: Path, tables: Path) -> None:
    contacts = [e for e in Recording(recorded).read("contact") if not e.payload["retained"]]
    rows = _rows(tables, "contacts")
    assert len(rows) == len(contacts) > 100
    for row, (_, t_ns, payload) in zip(rows, contacts, strict=True):
        assert int(row["time_ns"]) == t_ns
        assert row["link"] == payload["link"]
        assert float(row["force_n"]) == payload["force_n"]
        position = [float(row[f"position_{axis}_m"]) for axis in "xyz"]
        assert position == payload["position_m"]


def test_two_contacts_of_a_pad_have_columns_that_are_empty_for_one() -> None:
    part = {"position_m": [1.0, 2.0, 3.0], "covariance_m2": list(range(9)), "force_n": 0.5}
    row = flatten_payload({"link": "tip", "parts": [part, part | {"palm_position_m": [4.0, 5.0, 6.0]}]})
    assert [row[f"part_2_position_{axis}_m"] for axis in "xyz"] == [1.0, 2.0, 3.0]
    assert (row["part_1_force_n"], row["part_1_force_std_n"]) == (0.5, None)
    assert row["part_1_covariance_yz_m2"] == 5
    assert (row["part_1_palm_position_x_m"], row["part_2_palm_position_x_m"]) == (None, 4.0)
    single = flatten_payload({"link": "tip", "parts": ()})
    assert list(single) == list(row)
    assert single["part_1_position_x_m"] is None


def test_every_tick_has_a_row_of_counts_for_every_pad(recorded: Path, tables: Path) -> None:
    ticks = sum(not entry.payload["stopped"] for entry in Recording(recorded).read("tick"))
    rows = _rows(tables, "raw")
    assert len(rows) == 2 * ticks
    assert {row["link"] for row in rows} == {"plane", "round"}
    assert any(int(row["xa_counts"]) > 100 for row in rows)
    assert {row["node_state"] for row in rows} == {"clear", "lost"}


def test_hand_frames_are_rows_with_empty_cells_for_unknown_values(tables: Path) -> None:
    rows = _rows(tables, "hand")
    untouched = [row for row in rows if row["state"] == "clear"]
    touched = [row for row in rows if row["state"] == "touched"]
    assert untouched[0]["force_n"] == ""
    assert float(touched[-1]["position_z_m"]) == pytest.approx(0.0, abs=0.02)


def test_lists_of_health_are_one_cell(tables: Path) -> None:
    rows = _rows(tables, "health")
    assert [row["state"] for row in rows] == ["clear", "lost"]
    assert rows[0]["emergencies"] == "0x3100 mains voltage; 0x4200 device temperature"


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
def test_component_names_of_a_vector_end_with_its_unit(name: str, length: int, parts: list[str]) -> None:
    assert component_names(name, length) == parts


def test_a_missing_recording_is_wrong_usage_and_an_empty_one_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(tmp_path / "absent.mcap"), "-o", str(tmp_path)]) == 2
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    assert main(["export", str(empty), "-o", str(tmp_path / "made")]) == 1
    err = capsys.readouterr().err
    assert "absent.mcap" in err
    assert "holds no message" in err


@pytest.fixture(scope="module")
def plots(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("plots")
    assert main(["plot", str(recorded), "-o", str(folder)]) == 0
    return folder


def test_figures_are_written_as_pdf_and_png(plots: Path) -> None:
    for name in ("timeline", "forces", "pads", "health"):
        assert (plots / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert (plots / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_plot_data_are_the_recorded_messages(recorded: Path) -> None:
    data = plot.read_plot_data(Recording(recorded))
    ids = {(e.topic, e.payload["id"]) for e in Recording(recorded).read("contact")}
    assert sum(map(len, data.contacts.values())) == len(ids)
    edge = data.pads["h/plane"]
    assert edge is not None
    assert np.ptp(edge, axis=0) == pytest.approx((30.0, 24.0))
    reasons = [c.end_reason for contacts in data.contacts.values() for c in contacts.values()]
    assert {"released", "lost", "stopped"} >= set(reasons) >= {"released", "stopped"}
    part = plot.read_plot_data(Recording(recorded), from_s=0.5, to_s=1.0)
    times = [
        t for contacts in part.contacts.values() for contact in contacts.values() for t in contact.times_s
    ]
    assert 0.5 <= min(times) <= max(times) <= 1.0


def test_the_states_of_a_pad_are_as_many_spans_as_changes_however_many_messages() -> None:
    messages = [(0.01 * k, "stale" if k // 100 % 2 else "clear") for k in range(1000)]
    spans = plot.spans_of_states(messages, 12.0)
    assert {state: len(found) for state, found in spans.items()} == {"clear": 5, "stale": 5}
    assert sum(length_s for found in spans.values() for _, length_s in found) == pytest.approx(12.0)
    assert spans["stale"][0] == pytest.approx((1.0, 1.0))
    assert plot.spans_of_states([], 1.0) == {}


def test_a_plot_without_data_is_status_1(
    tmp_path: Path, recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plot", str(recorded), "-o", str(tmp_path), "--from", "1e6"]) == 1
    assert "holds no message of a daemon in that time" in capsys.readouterr().err


def test_the_summary_counts_the_messages(recorded: Path) -> None:
    recording = Recording(recorded)
    entries: list[Any] = list(recording)
    # the configuration stands once more before a later state, for readers that begin there
    configs = [entry.payload for entry in entries if entry.topic == "config"]
    repeats = sum(payload in configs[:number] for number, payload in enumerate(configs))
    assert int(recording.summary["messages"]) == len(entries) - repeats
    assert json.loads(recording.summary["lost"]) == {}
