"""`handtouch check` summarises a deployment, and warns of valid but questionable values."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from handtouch import config
from handtouch.cli import main
from handtouch.config import shipped
from handtouch.procedures.check import find_warnings

HAND = shipped.path("utah_mit.toml")
TEXT = HAND.read_text()


def warnings_of(*changes: tuple[str, str]) -> list[str]:
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return list(find_warnings(config.parse(text)))


def test_shipped_hand_has_no_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(HAND)]) == 0
    output = capsys.readouterr().out
    assert "15 pads, load 43%" in output
    assert "no warnings" in output


@pytest.mark.parametrize(
    ("old", "new", "warning"),
    [
        ("full_scale_ma = 10.0", "full_scale_ma = 0.01", "exceeds the full scale"),
        ("full_scale_ma = 10.0", "full_scale_ma = 10000.0", "fewer than 50 counts"),
        ("drive_v = 5.0", "drive_v = 5000.0", "exceeds the full scale"),
        ("drive_v = 5.0", "drive_v = 0.005", "fewer than 50 counts"),
        ("ohm_per_square = 2400.0", "ohm_per_square = 2.4", "check the unit"),
        (
            "begin_threshold_n = 0.06",
            "begin_threshold_n = 6.0",
            "forces are in newtons, and 1 gram-force is 0.0098 N",
        ),
        ("max_force_n = 20.0", "max_force_n = 0.02", "begin_threshold_n = 0.06: above max_force_n"),
    ],
)
def test_values_in_another_unit_are_one_warning_for_all_pads(old: str, new: str, warning: str) -> None:
    found = [text for text in warnings_of((old, new)) if warning in text]
    assert len(found) in (1, 2)  # one for each sheet
    assert sum(text.split(": ")[0].count("right/") for text in found) == 15


def test_json_has_the_same_content(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(HAND), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is True
    assert report["buses"][0]["load"] == pytest.approx(0.43, abs=0.01)
    assert [pad["link"] for pad in report["hands"][0]["pads"]][:2] == ["thumb_proximal", "thumb_middle"]


def test_sizes_are_those_as_built(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    surface = 'surface = { kind = "plane", length_mm = 48.0, width_mm = 16.0, resistivity_ratio = 1.5 }'
    text = TEXT.replace('surface = { kind = "plane", length_mm = 36.0, width_mm = 56.0 }', surface)
    assert text != TEXT
    path.write_text(text)
    main(["check", str(path)])
    assert " 48.0 x  16.0 mm" in capsys.readouterr().out


def test_invalid_file_exits_with_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(TEXT.replace("drive_v", "drive"))
    assert main(["check", str(path)]) == 2
    assert capsys.readouterr().err.startswith(f"{path}: [node.four_channel]: drive = 5.0: unknown key")
    assert main(["check", str(path), "--json"]) == 2
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is False
    assert report["problems"][0]["value"] == "5.0"


def test_invalid_object_exits_with_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(TEXT.replace("drive_v = 5.0", 'drive_v = 5.0\nexcitation_object = "0x2100:0"'))
    assert main(["check", str(path)]) == 2
    assert capsys.readouterr().err.startswith(
        f'{path}: [node.four_channel]: excitation_object: "0x2100:0": its type'
    )


def test_unreachable_full_scale_is_a_warning() -> None:
    (warning,) = warnings_of(("drive_v = 5.0", "drive_v = 5.0\nfull_scale_counts = 40000"))
    assert "full_scale_counts = 40000: its channels reach at most 32767" in warning


@pytest.mark.parametrize(("allowed", "then"), [("true", "has them mapped over SDO"), ("false", "is faulted")])
def test_an_eds_that_maps_other_objects_is_a_warning_with_what_it_maps(allowed: str, then: str) -> None:
    eds = f'eds = "{shipped.path("handtouch-node.eds")}"\nallow_pdo_remapping = {allowed}\n'
    other = 'channels = ["0x1018:1", "0x1018:2", "0x1018:3", "0x1018:4"]\n'
    channels = "drive_v = 5.0"
    assert not warnings_of((channels, eds + channels))
    (warning,) = [text for text in warnings_of((channels, eds + other + channels)) if "TPDO" in text]
    assert "no TPDO carries 0x1018:01 (unsigned 32 bit)" in warning
    assert "TPDO2 has 0x6401:01 (16 bit)" in warning
    assert then in warning


def test_warnings_exit_with_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(TEXT.replace("serial = 1001\n", ""))
    assert main(["check", str(path)]) == 1
    assert "warning: right: no serial for thumb_proximal:" in capsys.readouterr().out


def test_schema_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--schema"]) == 0
    assert json.loads(capsys.readouterr().out) == config.json_schema()


def test_missing_arguments_are_wrong_usage() -> None:
    assert main(["check"]) == 2


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([("sync_period_ms = 5.0", "sync_period_ms = 2.8")], "load 75%: above 70%"),
        ([("sync_period_ms = 5.0", "sync_period_ms = 1.0")], "exceeds the bus"),
        (
            [("bitrate_bit_s = 1_000_000", "bitrate_bit_s = 500_000")],
            "last ones are used one period late",
        ),
        (
            [("heartbeat_timeout_ms = 350", "heartbeat_timeout_ms = 150")],
            "two heartbeat periods of 100 ms",
        ),
        ([("length_mm = 42.0", "length_mm = 120.0")], "3.8 times longer along x than along y"),
        ([("contact_radius_mm = 2.5", "contact_radius_mm = 8")], "large for a pad of 16.6 mm"),
        (
            [("end_threshold_n = 0.03", "end_threshold_n = 0.0005")],
            "the force that noise alone can read",
        ),
        ([('sheet = "firm"', 'sheet = "soft"')], "[sheet.firm]: no pad uses it"),
        (
            [("[node.f", '[[bus]]\nname = "b"\ninterface = "virtual"\nchannel = "b"\n[node.f')],
            '[[bus]] "b": no pad is on it',
        ),
    ],
)
def test_questionable_values_are_warnings(changes: list[tuple[str, str]], expected: str) -> None:
    assert [warning for warning in warnings_of(*changes) if expected in warning]
