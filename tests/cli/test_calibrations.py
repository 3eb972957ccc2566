"""`handtouch calibrations`: output, rollback, export, and refused imports."""

from __future__ import annotations

import json
import re
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from handtouch.calibration.calibration import (
    Calibration,
    Gains,
    Offsets,
    Provenance,
    StoredSheetState,
    matrix,
)
from handtouch.calibration.store import Store
from handtouch.cli import main

CONFIG = "nominal-0123456789ab"
NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)


def gains(first: float) -> Calibration:
    covariance = matrix(1e-6 * np.eye(4))
    return Calibration(
        Gains((first, 1.0, 1.0, 1.0), covariance),
        Offsets((1.0, 2.0, 3.0, 4.0), (0.1, 0.1, 0.1, 0.1)),
        sheet=StoredSheetState("creep", 1, b"\x00\xff"),
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "store.db"
    with Store(path) as store:
        for serial, link, first in (
            (1001, "thumb_distal", 1.01),
            (1001, "thumb_distal", 1.02),
            (7, "palm", 1),
        ):
            origin = Provenance("gains from contacts", 400, 1.02, "right", link, "robot1", "handtouch 0.1.0")
            store.write(serial, CONFIG, gains(first), origin, NOW)
    return path


def run(path: Path, *arguments: str) -> int:
    return main(["calibrations", *arguments, "--store", str(path)])


def test_list_shows_every_sensor_and_its_newest_version(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(path, "list") == 0
    output = capsys.readouterr().out
    assert "2 sensors" in output
    assert "right/thumb_distal" in output
    assert "gains+offsets+sheet: gains from contacts, 400 contacts" in output
    assert run(path, "list", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert [(u["newest"]["serial"], u["versions"]) for u in record["sensors"]] == [(7, 1), (1001, 2)]
    assert record["damaged"] == []


@pytest.mark.parametrize("sensor", ["1001", "0x3E9", "thumb_distal", "right/thumb_distal"])
def test_sensor_is_selected_by_serial_number_or_link(
    path: Path, capsys: pytest.CaptureFixture[str], sensor: str
) -> None:
    assert run(path, "show", sensor) == 0
    output = capsys.readouterr().out
    assert "serial 1001, version 2, under the tables nominal-0123456789ab" in output
    assert "1.02  1  1  1" in output
    assert run(path, "show", sensor, "--version", "1", "--json") == 0
    assert json.loads(capsys.readouterr().out)["calibration"]["gains"]["factors"][0] == 1.01


def test_unknown_sensor_is_refused_with_a_list_of_known_ones(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(path, "show", "pinky") == 2
    assert "1001 (right/thumb_distal)" in capsys.readouterr().err
    assert run(path, "show", "12") == 2
    assert run(path, "show", "1001", "--version", "9") == 2
    assert "there are: 1, 2" in capsys.readouterr().err


def test_diff_shows_changes_and_sets_the_exit_status(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(path, "diff", "1001") == 1
    output = capsys.readouterr().out
    assert "  - 1.01  1  1  1\n  + 1.02  1  1  1" in output
    assert "offsets" not in output.split("gains.factors")[1]
    assert run(path, "diff", "1001", "--from", "2") == 0
    assert run(path, "diff", "7") == 0


def test_rollback_copies_an_old_version_to_the_newest(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(path, "rollback", "thumb_distal", "1") == 0
    assert "version 3 is a copy of version 1" in capsys.readouterr().out
    with Store(path) as store:
        newest = store.newest(1001)
        assert newest is not None
        assert newest.calibration == gains(1.01)
        assert newest.provenance.note == "rolled back to version 1"
        assert len(store.versions(1001)) == 3
    assert run(path, "rollback", "thumb_distal", "9") == 2


def test_export_and_import_round_trip_exactly(path: Path, tmp_path: Path) -> None:
    assert run(path, "export", "--history", "--out", str(tmp_path / "all.json")) == 0
    assert run(tmp_path / "other.db", "import", str(tmp_path / "all.json")) == 0
    with Store(path) as one, Store(tmp_path / "other.db") as other:
        for serial in (7, 1001):
            before, after = one.versions(serial), other.versions(serial)
            assert [v.calibration for v in before] == [v.calibration for v in after]
            assert all(v.provenance.note == "imported from all.json" for v in after)


def test_calibration_of_another_sensor_needs_an_option_and_stays_marked(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "one.json")
    assert run(path, "export", "1001", "--out", out) == 0
    assert run(path, "import", out, "--serial", "8") == 2
    assert "made for serial 1001, not for 8" in capsys.readouterr().err
    with Store(path) as store:
        assert store.newest(8) is None
    assert run(path, "import", out, "--serial", "8", "--other-sensor") == 0
    capsys.readouterr()
    assert run(path, "list") == 0
    assert "FROM ANOTHER SENSOR" in capsys.readouterr().out
    assert run(path, "export", "8", "--out", out) == 0  # with the mark
    assert run(path, "import", out) == 2
    assert "made for serial 1001" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "line 1"),
        ("[]", '"format" is not'),
        ('{"format": "handtouch-calibrations", "v": 2, "versions": []}', "format version 2"),
        ('{"format": "handtouch-calibrations", "v": 1}', "versions"),
        ('{"format": "handtouch-calibrations", "v": 1, "versions": [{"serial": 5}]}', "config"),
    ],
)
def test_invalid_export_is_refused_by_name(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    (tmp_path / "bad.json").write_text(text)
    assert run(path, "import", str(tmp_path / "bad.json")) == 2
    error = capsys.readouterr().err
    assert "bad.json" in error
    assert message in error


def test_listing_without_a_store_creates_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "none.db", "list") == 2
    assert "no calibration store here yet" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_damaged_store_is_reported_now_and_later(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path.write_bytes(path.read_bytes()[:5000])
    assert run(path, "list") == 2
    assert "damaged" in capsys.readouterr().err
    Store(path).close()
    assert run(path, "list") == 1
    assert f"{path}.damaged-" in capsys.readouterr().err


@pytest.mark.parametrize("width", [80, 120])
def test_a_list_of_sensors_fits_the_terminal(
    path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    assert run(path, "list") == 0
    whole = capsys.readouterr().out.split()
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert run(path, "list") == 0
    shown = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(map(len, shown.splitlines()[1:])) <= width
    assert sorted(shown.split()) == sorted(whole)


def test_store_of_a_deployment_is_used(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = (Path(__file__).parents[2] / "config" / "utah_mit.toml").read_text()
    deployment = path.with_name("hand.toml")
    deployment.write_text(shipped.replace("[daemon]", '[daemon]\nstore = "store.db"', 1))
    assert main(["calibrations", "list", "--config", str(deployment)]) == 0
    assert str(path) in capsys.readouterr().out
