"""Errors in the file of a node name file, key, value and remedy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from handtouch.config.problems import ConfigError
from handtouch.node.settings import json_schema, load

CONFIG = Path(__file__).parents[2] / "config"


@pytest.mark.parametrize(
    ("adc", "pad", "message"),
    [
        ("mode = 'buffer'", "", "[adc.main]: mode = \"buffer\": must be 'one-shot' or 'buffered'"),
        ("buffer_scans = 64", "", '[adc.main]: buffer_scans: is used only with mode = "buffered"; delete it'),
        (
            "mode = 'buffered'\nrate_hz = 8000",
            "",
            "[adc.main]: buffer_scans = 256: holds less than 0.1 s at that rate_hz; give at least 800",
        ),
        ("rate = 3.0", "", '[adc.main]: rate = 3.0: unknown key; did you mean "rate_hz"?'),
        ("", "full_scale_ma = -1.0", '[[pad]] 1 "tip": full_scale_ma = -1.0: must be greater than 0'),
        ("", "excitation = { chip = '/dev/gpiochip0' }", "give either chip and line, or file"),
        ("", "trim = 'missing.toml'", "missing.toml: the file: No such file or directory; give the path"),
        (
            "",
            "[[pad]]\nname = 'tip'\nadc = 'other'\ngain_ohm = 0.5\n"
            "channels = ['voltage0', 'voltage1', 'voltage2', 'voltage4']",
            '[[pad]] 2 "tip": adc = other: there is no [adc.other]; known: main',
        ),
        (
            "",
            "[[pad]]\nname = 'second'\nadc = 'main'\ngain_ohm = 0.5\n"
            "channels = ['voltage3', 'voltage4', 'voltage5', 'voltage6']",
            '[[pad]] 2 "second": channels = voltage3: another pad has this channel',
        ),
        (
            "",
            "[[pad]]\nname = 'second'\nadc = 'main'\ngain_ohm = 0\nnode_id = 5\n"
            "channels = ['voltage4', 'voltage5', 'voltage6', 'voltage7']",
            "gain_ohm must not be 0",
        ),
        (
            "",
            "[[pad]]\nname = 'second'\nadc = 'main'\ngain_ohm = 1.0\nnode_id = 5\n"
            "channels = ['voltage4', 'voltage5', 'voltage6', 'voltage7']",
            "[[pad]]: node_id = 5: is given 2 times; each pad needs its own",
        ),
    ],
)
def test_an_error_names_key_value_and_remedy(bench: Any, adc: str, pad: str, message: str) -> None:
    more = pad if pad.startswith("[[") else ""
    path = bench.write(adc, "" if more else pad, more)
    with pytest.raises(ConfigError) as raised:
        load(path)
    assert str(bench.folder) in str(raised.value)
    assert message in str(raised.value)


def test_trim_files_are_read_and_checked(bench: Any) -> None:
    trim = bench.folder / "tip.toml"
    trim.write_text("gain = [1.01, 0.99, 1.0, 1.0]\noffset_ma = [0.002, 0.0, 0.0, -0.001]\n")
    file = load(bench.write(pad="trim = 'tip.toml'"))
    assert file.trims[0].gain == (1.01, 0.99, 1.0, 1.0)
    trim.write_text("gain = [1.01, 0.99, 1.0]\n")
    with pytest.raises(ConfigError, match=r"tip\.toml: gain"):
        load(bench.folder / "node.toml")


def test_shipped_schema_and_example_are_current() -> None:
    kept = json.loads((CONFIG / "touch_node.schema.json").read_text())
    assert kept == json_schema(), "run `make tables`"
    assert [pad.node_id for pad in load(CONFIG / "touch_node.toml").settings.pads] == [1, 2]


def test_state_is_kept_in_the_folder_of_the_service(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load(bench.write()).state == bench.folder / "node.toml.state.json"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/handtouch/node")
    assert load(bench.write()).state == Path("/var/lib/handtouch/node/state.json")
