"""`handtouch check` tells what a deployment amounts to, and doubts what is allowed but unwise."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from handtouch import check, config, shipped

HAND = shipped.path("utah_mit.toml")
TEXT = HAND.read_text()


def doubts(*changes: tuple[str, str]) -> list[str]:
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return list(check.warnings(config.parse(text)))


def test_the_shipped_hand_is_beyond_doubt(capsys: pytest.CaptureFixture[str]) -> None:
    assert check.run(HAND, json=False, schema=False) == 0
    said = capsys.readouterr().out
    assert "15 pads, load 43%" in said
    assert "no warnings" in said


def test_json_says_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert check.run(HAND, json=True, schema=False) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is True
    assert report["buses"][0]["load"] == pytest.approx(0.43, abs=0.01)
    assert [pad["link"] for pad in report["hands"][0]["pads"]][:2] == ["thumb_proximal", "thumb_middle"]


def test_a_mistake_has_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(TEXT.replace("drive_v", "drive"))
    assert check.run(path, json=False, schema=False) == 2
    assert capsys.readouterr().err.startswith(f"{path}: [node.four_channel]: drive = 5.0: unknown key")
    assert check.run(path, json=True, schema=False) == 2
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is False
    assert report["problems"][0]["value"] == "5.0"


def test_an_object_that_cannot_be_has_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(TEXT.replace("drive_v = 5.0", 'drive_v = 5.0\nexcitation = "0x2100:0"'))
    assert check.run(path, json=False, schema=False) == 2
    assert capsys.readouterr().err.startswith(
        f'{path}: [node.four_channel]: excitation: "0x2100:0": its type'
    )


def test_a_full_scale_that_no_channel_reaches_is_doubtful() -> None:
    (doubt,) = doubts(("drive_v = 5.0", "drive_v = 5.0\nfull_scale_counts = 40000"))
    assert "full_scale_counts = 40000: its channels count to 32767 at most" in doubt


def test_a_doubt_has_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(TEXT.replace("serial = 1001\n", ""))
    assert check.run(path, json=False, schema=False) == 1
    assert "warning: right: no serial for thumb_proximal:" in capsys.readouterr().out


def test_the_schema_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert check.run(None, json=False, schema=True) == 0
    assert json.loads(capsys.readouterr().out) == config.json_schema()


def test_neither_file_nor_schema_is_wrong_usage() -> None:
    assert check.run(None, json=False, schema=False) == 2


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([("sync_period_ms = 5.0", "sync_period_ms = 2.8")], "load 75%: above 70%"),
        ([("sync_period_ms = 5.0", "sync_period_ms = 1.0")], "the bus can't carry this"),
        ([("bitrate_bit_s = 1_000_000", "bitrate_bit_s = 500_000")], "the last come a period late"),
        ([("heartbeat_timeout_ms = 350", "heartbeat_timeout_ms = 150")], "one late heartbeat of 100 ms"),
        ([("length_mm = 42.0", "length_mm = 120.0")], "3.8 times longer along x than along y"),
        ([("contact_radius_mm = 2.5", "contact_radius_mm = 8")], "a contact covers the pad of 16.6 mm"),
        ([("off_n = 0.03", "off_n = 0.0005")], "below what noise alone can read"),
        ([('sheet = "firm"', 'sheet = "soft"')], "[sheet.firm]: no pad uses it"),
        (
            [("[node.f", '[[bus]]\nname = "b"\ninterface = "virtual"\nchannel = "b"\n[node.f')],
            '[[bus]] "b": no pad is on it',
        ),
    ],
)
def test_what_is_unwise_is_doubted(changes: list[tuple[str, str]], expected: str) -> None:
    assert [doubt for doubt in doubts(*changes) if expected in doubt]
