"""Deployment files are accepted whole, or rejected with every error: location, value and remedy."""

from __future__ import annotations

import contextlib
import ipaddress
import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson, simpson
from scipy.interpolate import CubicSpline

from handtouch import config
from handtouch.config import ConfigError, shipped
from handtouch.field.embedded_file import read_embedded

CONFIG = Path(__file__).parents[2] / "config"
SMALL = """
[[bus]]
name = "can0"
interface = "socketcan"
channel = "can0"

[node.four]
drive_v = 5.0
full_scale_ma = 10.0
noise_counts = 1.0

[sheet.firm]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20_000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5

[touch]
begin_threshold_n = 0.06
end_threshold_n = 0.03

[[hand]]
name = "right"

[[hand.pad]]
link = "thumb"
bus = "can0"
node_id = 5
node = "four"
sheet = "firm"
surface = { kind = "cylinder", radius_mm = 12.0, length_mm = 30.0, arc_deg = 150.0 }
gap_mm = 0.8
mount = { position_mm = [1.0, 2.0, 3.0] }

[[hand.pad]]
link = "index"
bus = "can0"
node_id = 6
node = "four"
sheet = "firm"
surface = { kind = "cone", near_radius_mm = 12.0, far_radius_mm = 10.0, slant_mm = 25.0, arc_deg = 120.0 }
gap_mm = 0.8
"""
THUMB = 'hand.toml: [[hand.pad]] 1 "right/thumb": '
INDEX = 'hand.toml: [[hand.pad]] 2 "right/index": '


def config_error(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        config.parse(text, "hand.toml")
    return str(caught.value)


DEPLOYMENTS = [path for path in sorted(CONFIG.glob("*.toml")) if "\n[[hand]]\n" in path.read_text()]


@pytest.mark.parametrize("path", DEPLOYMENTS, ids=lambda path: path.name)
def test_shipped_deployments_are_valid(path: Path) -> None:
    deployment = config.load(path)
    pads = {
        "two_finger": 2,
        "electrodes": 2,
        "switched": 2,
        "outlined": 3,
        "shear": 2,
        "two_sheets": 2,
        "l_palm": 1,
        "fingertip": 1,
        "taxels": 2,
        "two_layers": 2,
    }.get(path.stem, 15)
    assert [len(hand.pads) for hand in deployment.hands] == [pads]


def test_a_deployment_holds_the_files_of_its_surfaces(tmp_path: Path) -> None:
    for name in ("fingertip.toml", "fingertip.stl"):
        (tmp_path / name).write_bytes(shipped.path(name).read_bytes())
    deployment = config.load(tmp_path / "fingertip.toml")
    (tmp_path / "fingertip.stl").unlink()
    config.surfaces._build.cache_clear()
    sent = config.Deployment.model_validate_json(deployment.model_dump_json(by_alias=True))
    assert sent == deployment
    assert sent.pads[0].pad.surface.build().extent_m[0] == pytest.approx(0.0244, abs=1e-4)
    with pytest.raises(ConfigError, match=r"surface.file = .*: No such file"):
        config.load(tmp_path / "fingertip.toml")


def test_shipped_pads_have_moderate_aspect_ratios() -> None:
    for pad in config.load(shipped.path("utah_mit.toml")).hands[0].pads:
        a, b = pad.surface.rectangle_mm
        assert max(a / b, b / a) < 1.8, pad.link


def test_shipped_schema_is_current() -> None:
    kept = json.loads((CONFIG / "handtouch.schema.json").read_text())
    assert kept == config.json_schema(), "run `make tables`"


# --- every mistake is named: file, section, key, value, and what would be right

ERRORS = {
    "unknown key": (
        ("drive_v = 5.0", "drive_v = 5.0\ncolour = 3"),
        "hand.toml: [node.four]: colour = 3: unknown key; known here: eds, vendor_id",
    ),
    "misspelt key": (
        ("full_scale_ma = 10.0", "ful_scale_ma = 10.0"),
        'hand.toml: [node.four]: ful_scale_ma = 10.0: unknown key; did you mean "full_scale_ma"?',
    ),
    "missing unit": (
        ("drive_v = 5.0", "drive = 5.0"),
        'hand.toml: [node.four]: drive = 5.0: unknown key; did you mean "drive_v"? Keys carry their unit',
    ),
    "missing unit in a surface": (
        ("radius_mm = 12.0,", "radius = 12.0,"),
        THUMB + 'surface.radius = 12.0: unknown key; did you mean "radius_mm"? Keys carry their unit',
    ),
    "key with a different unit": (
        ("gap_mm = 0.8\nmount", "gap_cm = 0.08\nmount"),
        THUMB + 'gap_cm = 0.08: unknown key; did you mean "gap_mm"? Keys carry their unit',
    ),
    "two pads with one serial number": (
        (
            "gap_mm = 0.8\nmount",
            'serial = 7\ngap_mm = 0.8\n[[hand.pad]]\nserial = 7\nlink = "ring"\nbus = "can0"\n'
            'node_id = 9\nnode = "four"\nsheet = "firm"\ngap_mm = 0.8\n'
            'surface = { kind = "plane", length_mm = 30.0, width_mm = 20.0 }\nmount',
        ),
        '2 "right/ring": serial = 7: is already that of "right/thumb"; serial numbers must be unique',
    ),
    "missing key": (("gap_mm = 0.8\nmount", "mount"), THUMB + "gap_mm: is missing (gap_mm: bare length"),
    "unknown table": (("[touch]", "[tuch]"), "hand.toml: [tuch]: unknown table; did you mean [touch]?"),
    "one table for many": (("[[bus]]", "[bus]"), "hand.toml: [bus]: must be a list of tables: write [[bus]]"),
    "out of range": (
        ("node_id = 5", "node_id = 200"),
        THUMB + "node_id = 200: must be less than or equal to 127 (node_id: CANopen node id, 1 to 127)",
    ),
    "not positive": (
        ("drive_v = 5.0", "drive_v = -5.0"),
        "hand.toml: [node.four]: drive_v = -5.0: must be greater than 0",
    ),
    "not finite": (("drive_v = 5.0", "drive_v = nan"), "[node.four]: drive_v = NaN: must be a finite number"),
    "number as text": (
        ("drive_v = 5.0", 'drive_v = "5 V"'),
        '[node.four]: drive_v = "5 V": must be a number',
    ),
    "list too short": (
        ("[1.0, 2.0, 3.0]", "[1.0, 2.0]"),
        THUMB + "mount.position_mm[2]: is missing (position_mm: origin of the pad frame",
    ),
    "no list": (
        ("gap_mm = 0.8\nmount", "gap_mm = 0.8\nseries_ohm = 336\nmount"),
        THUMB + "series_ohm = 336: must be a list",
    ),
    "bad name": (
        ('name = "right"', 'name = "my hand"'),
        'hand.toml: [[hand]] 1 "my hand": name = "my hand": must start with a letter and hold only letters',
    ),
    "wrong shape": (
        ('kind = "cylinder"', 'kind = "tube"'),
        THUMB + 'surface.kind = "tube": must be "cone", "cylinder", "mesh", "outline",',
    ),
    "wrong option": (
        ('channel = "can0"', 'channel = "can0"\noptions = { fd = [1] }'),
        'hand.toml: [[bus]] 1 "can0": options.fd = [1]: must be a string or a number',
    ),
    "two pads on one node id": (
        ("node_id = 6", "node_id = 5"),
        INDEX + 'node_id = 5: is already the node id of "right/thumb" on bus "can0"; node ids must be',
    ),
    "two pads on one link": (
        ('link = "index"', 'link = "thumb"'),
        'hand.toml: [[hand.pad]] 2: link = "thumb": is used twice; names must differ',
    ),
    "pad wider than its cone": (
        ("arc_deg = 120.0", "arc_deg = 400.0"),
        INDEX + "surface.arc_deg = 400.0: must be less than or equal to 360 (arc_deg: around the axis",
    ),
    "impossible cone": (
        ("slant_mm = 25.0", "slant_mm = 1.5"),
        INDEX + "surface.slant_mm = 1.5: is too short for a cone; must be at least the difference of the "
        "two radii, 2",
    ),
    "gaps that leave no electrode": (
        ("gap_mm = 0.8\nmount", "gap_mm = 15.0\nmount"),
        THUMB + "gap_mm = 15.0: leaves no electrode on a side of 30 mm; must be below 15",
    ),
    "gap offsets that leave no electrode": (
        ("gap_mm = 0.8\nmount", "gap_mm = 0.8\ngap_offsets_mm = [[0, 0], [0, 0], [20, 20], [0, 0]]\nmount"),
        THUMB + "gap_offsets_mm = [[0.0, 0.0], [0.0, 0.0], [20.0, 20.0], [0.0, 0.0]]: with gap_mm leaves no "
        "electrode y0 on a side of 30 mm",
    ),
    "gaps longer than a cone is wide at its end": (
        ("far_radius_mm = 10.0, slant_mm = 25.0", "far_radius_mm = 0.5, slant_mm = 25.0"),
        INDEX + "gap_mm = 0.8: leaves no electrode on a side of 1.047 mm; must be below 0.5236",
    ),
    "resistors without gaps": (
        ("gap_mm = 0.8\nmount", "gap_mm = 0\nseries_ohm = [336, 0, 0, 0]\nmount"),
        THUMB + "gap_mm = 0.0: touching electrodes share their currents, so series_ohm needs a gap",
    ),
    "bus that is not there": (
        ('bus = "can0"', 'bus = "can1"'),
        THUMB + 'bus = "can1": no [[bus]] of that name; did you mean "can0"? known: can0',
    ),
    "sheet that is not there": (
        ('sheet = "firm"', 'sheet = "frim"'),
        THUMB + 'sheet = "frim": no [sheet.NAME] of that name; did you mean "firm"? known: firm',
    ),
    "unknown interface": (
        ('interface = "socketcan"', 'interface = "socketcann"'),
        'hand.toml: [[bus]] 1 "can0": interface = "socketcann": did you mean "socketcan"? '
        "python-can knows canalystii",
    ),
    "no multicast address": (
        ('interface = "socketcan"', 'interface = "udp_multicast"'),
        '[[bus]] 1 "can0": channel = "can0": must be a multicast address such as 239.74.163.2',
    ),
    "two names for one wire": (
        ("[node.four]", '[[bus]]\nname = "b"\ninterface = "socketcan"\nchannel = "can0"\n[node.four]'),
        '[[bus]] 2 "b": channel = "can0": is also the channel of bus "can0"; list each channel once',
    ),
    "two buses on one UDP port, in two groups": (
        (
            'interface = "socketcan"\nchannel = "can0"',
            'interface = "udp_multicast"\nchannel = "239.74.163.2"\n[[bus]]\nname = "b"\n'
            'interface = "udp_multicast"\nchannel = "239.74.163.3"\noptions.port = 43113',
        ),
        '[[bus]] 2 "b": options.port = 43113: bus "can0" has UDP port 43113 too, and multicast groups '
        "don't separate buses; give each its own port, e.g. options = { port = 43114 }",
    ),
    "no UDP port": (
        (
            'interface = "socketcan"\nchannel = "can0"',
            'interface = "udp_multicast"\nchannel = "239.74.163.2"\noptions.port = 99999',
        ),
        '[[bus]] 1 "can0": options.port = 99999: must be a UDP port, 1 to 65535',
    ),
    "hasty time-out": (
        ("noise_counts = 1.0", "noise_counts = 1.0\nheartbeat_timeout_ms = 90"),
        "[node.four]: heartbeat_timeout_ms = 90: must be longer than heartbeat_ms = 100",
    ),
    "EDS that is not there": (
        ("noise_counts = 1.0", 'noise_counts = 1.0\neds = "my.eds"'),
        '[node.four]: eds = "my.eds": no such file',
    ),
    "samples for a time": (
        ("end_threshold_n = 0.03", "end_threshold_n = 0.03\nbegin_samples = 3"),
        "hand.toml: [touch]: begin_samples = 3: is begin_ms now: write begin_ms = 10 (begin_ms: a contact",
    ),
    "samples of a pad for a time, at another rate": (
        ("gap_mm = 0.8\nmount", "gap_mm = 0.8\ntouch = { end_samples = 2 }\nmount"),
        THUMB + "touch.end_samples = 2: is end_ms now: write end_ms = 5 (end_ms: a contact",
    ),
    "thresholds the wrong way round": (
        ("end_threshold_n = 0.03", "end_threshold_n = 0.07"),
        "hand.toml: [touch]: end_threshold_n = 0.07: must be below begin_threshold_n = 0.06",
    ),
    "thresholds of a pad the wrong way round": (
        (
            "gap_mm = 0.8\nmount",
            "gap_mm = 0.8\ntouch = { begin_threshold_n = 0.1, end_threshold_n = 0.2 }\nmount",
        ),
        THUMB + "touch.end_threshold_n = 0.2: must be below begin_threshold_n = 0.1",
    ),
    "endpoint open to the world": (
        ("[[bus]]", '[daemon]\nlive = "tcp://0.0.0.0:5580"\n[[bus]]'),
        '[daemon]: live = "tcp://0.0.0.0:5580": is reachable from other machines, which requires',
    ),
    "endpoint open to the world, and how to open it": (
        ("[[bus]]", '[daemon]\nlive = "tcp://*:5580"\n[[bus]]'),
        'create them beside this file with `handtouch keys make FOLDER` and set keys = "FOLDER" in [daemon]',
    ),
    "keys that are not there": (
        ("[[bus]]", '[daemon]\nkeys = "absent"\n[[bus]]'),
        '[daemon]: keys = "absent": no such folder; create it with `handtouch keys make absent`',
    ),
    "keys that are nowhere": (
        ("[[bus]]", '[daemon]\nkeys = ""\nlive = "tcp://*:5580"\n[[bus]]'),
        '[daemon]: keys = ""',
    ),
    "endpoint used twice": (
        ("[[bus]]", '[daemon]\nlive = "tcp://127.0.0.1:5582"\n[[bus]]'),
        '[daemon]: complete = "tcp://127.0.0.1:5582": is also the endpoint of live',
    ),
    "no endpoint": (
        ("[[bus]]", '[daemon]\nlive = "5580"\n[[bus]]'),
        '[daemon]: live = "5580": must be a ZeroMQ endpoint such as tcp://127.0.0.1:5580',
    ),
    "endpoint without a port": (
        ("[[bus]]", '[daemon]\nlive = "tcp://127.0.0.1"\n[[bus]]'),
        '[daemon]: live = "tcp://127.0.0.1": needs a port: tcp://127.0.0.1:5580, or :*',
    ),
    "endpoint on a port that can't be": (
        ("[[bus]]", '[daemon]\nlive = "tcp://127.0.0.1:99999"\n[[bus]]'),
        '[daemon]: live = "tcp://127.0.0.1:99999": must end in a port, 1 to 65535, or *',
    ),
    "metrics for other machines": (
        ("[[bus]]", '[daemon]\nmetrics = "0.0.0.0:9580"\n[[bus]]'),
        '[daemon]: metrics = "0.0.0.0:9580": is reachable from other machines, and CURVE keys',
    ),
    "metrics without a port": (
        ("[[bus]]", '[daemon]\nmetrics = "127.0.0.1"\n[[bus]]'),
        '[daemon]: metrics = "127.0.0.1": must be HOST:PORT such as 127.0.0.1:9580',
    ),
    "endpoint of a host that looks like loopback": (
        ("[[bus]]", '[daemon]\nlive = "tcp://127.evil.example:5580"\n[[bus]]'),
        '[daemon]: live = "tcp://127.evil.example:5580": is reachable from other machines, which requires',
    ),
    "one endpoint by two names": (
        ("[[bus]]", '[daemon]\nlive = "tcp://localhost:5582"\n[[bus]]'),
        '[daemon]: complete = "tcp://127.0.0.1:5582": is also the endpoint of live',
    ),
    "surface in metres": (
        ("radius_mm = 12.0, length_mm = 30.0", "radius_mm = 0.012, length_mm = 30.0"),
        THUMB + "surface.radius_mm = 0.012: less than 0.5 mm; lengths are in millimetres: write 12 if",
    ),
    "gap in metres": (("gap_mm = 0.8", "gap_mm = 0.0008"), THUMB + "gap_mm = 0.0008: less than 0.02 mm"),
    "mount in metres": (
        ("[1.0, 2.0, 3.0]", "[0.015, 0.0, -0.0115]"),
        THUMB + "mount.position_mm = [0.015, 0.0, -0.0115]: less than 0.05 mm; lengths are in millimetres: "
        "write [15, 0, -11.5] if it is in metres",
    ),
    "mount in radians": (
        ("[1.0, 2.0, 3.0]", "[1.0, 2.0, 3.0], rpy_deg = [0.0, -1.5708, 3.1416]"),
        THUMB + "mount.rpy_deg = [0.0, -1.5708, 3.1416]: a multiple of 45 degrees if it is in radians; "
        "angles are in degrees: write [0, -90, 180]",
    ),
    "arc in radians": (
        ("arc_deg = 150.0", "arc_deg = 2.3562"),
        THUMB
        + "surface.arc_deg = 2.3562: a multiple of 45 degrees if it is in radians; angles are in degrees"
        ": write 135",
    ),
    "contact radius in metres": (
        ("contact_radius_mm = 2.5", "contact_radius_mm = 0.0025"),
        "[sheet.firm]: contact_radius_mm = 0.0025: less than 0.05 mm; lengths are in "
        "millimetres: write 2.5 if",
    ),
    "key twice": (
        ("node_id = 5\n", "node_id = 5\nserial = 7\nnode_id = 6\n"),
        'hand.toml: line 31 `node_id = 6`: the key "node_id" is given twice in [[hand.pad]], '
        "first on line 29 "
        "`node_id = 5`; delete one of them",
    ),
    "list twice": (
        ("gap_mm = 0.8\n", "gap_mm = 0.8\nseries_ohm = [1.0,\n1.0, 1.0, 1.0]\nseries_ohm = [\n]\n"),
        'the key "series_ohm" is given twice in [[hand.pad]], first on line 34',
    ),
    "key twice in an inline table": (
        ("radius_mm = 12.0", "radius_mm = 12.0, radius_mm = 13.0"),
        '`surface = { kind = "cylinder", radius_mm = 12.0, radius_m...`: the key "radius_mm" '
        "is given twice in {",
    ),
    "table twice": (
        ("[[hand]]", "[touch]\nbegin_ms = 9.0\n[[hand]]"),
        "hand.toml: line 23 [touch]: this table is given twice, first on line 19; keep one",
    ),
    "byte order mark": (("\n[[bus]]", "\ufeff\n[[bus]]"), "line 1: its first character is a byte order mark"),
    "no TOML": (("[touch]", "[touch"), "hand.toml: TOML, line 19, column 7 `[touch`: Expected ']'"),
}


SHEAR_ERRORS = {
    "no such shear pad": (
        ('shear = "bars"', 'shear = "bar"'),
        'shear = "bar": no [shear.NAME] of that name; did you mean "bars"? known: bars, discs',
    ),
    "too few channels": (
        (', "0x6401:8"', ""),
        'node = "eight_channel": has 7 channels, the pad 4 electrodes and its shear pad 4; list as many',
    ),
    "folded pad": (
        (
            'kind = "plane", length_mm = 16.0, width_mm = 16.0',
            'kind = "prism", length_mm = 16.0, section_aside_mm = [-8, 0, 8], section_up_mm = [0, 2, 0]',
        ),
        'shear = "bars": lies beneath a smooth pad whose surface.kind is plane, cylinder, cone, sphere or '
        'revolution, not "prism"',
    ),
    "electrode twice": (
        ('shear = "bars"', 'shear = "bars"\nshear_electrodes = ["x0", "xa", "y0", "y0"]'),
        'shear_electrodes = ["x0", "xa", "y0", "y0"]: must name each of x0, xa, y0, yb once',
    ),
    "pattern without y": (
        ('kind = "crossed_bars"', 'kind = "bars"'),
        '[shear.bars]: pattern.kind = "bars": senses the component x only, which is no force vector; use',
    ),
    "unknown pattern": (
        ('kind = "crossed_bars"', 'kind = "stripes"'),
        'pattern.kind = "stripes": must be "bars", "crossed_bars", "pinwheel" or "discs"',
    ),
    "misspelt key of a pattern": (
        ("radius_mm = 2.0, gap_mm", "radius = 2.0, gap_mm"),
        '[shear.discs.pattern]: radius = 2.0: unknown key; did you mean "radius_mm"? Keys carry their unit',
    ),
    "impossible pattern": (
        ("radius_mm = 2.0, gap_mm = 0.4", "radius_mm = 2.0, gap_mm = 2.4"),
        "[shear.discs]: pattern: gap_m 0.0024 must be less than radius_m 0.002",
    ),
}


@pytest.mark.parametrize(("change", "expected"), SHEAR_ERRORS.values(), ids=SHEAR_ERRORS.keys())
def test_errors_of_shear_pads_name_location_value_and_remedy(change: tuple[str, str], expected: str) -> None:
    text = (CONFIG / "shear.toml").read_text()
    assert change[0] in text
    assert expected in config_error(text.replace(*change, 1))


SECOND_SHEET_ERRORS = {
    "no such sheet": (('second_sheet = "even"', 'second_sheet = "evn"'), 'did you mean "even"?'),
    "equal alphas": (("alpha = 1.0", "alpha = 1.4"), "they must differ by 0.2 or more"),
    "no channel for it": (
        (', "0x6401:5"', ""),
        'node = "five_channel": has 4 channels, the pad 4 electrodes and its second sheet 1; list as many',
    ),
    "measured film": (
        ('second_sheet = "even"', 'second_sheet = "even"\nresistance_map = "film.npz"'),
        "isn't supported together with resistance_map",
    ),
}


@pytest.mark.parametrize(("change", "expected"), SECOND_SHEET_ERRORS.values(), ids=SECOND_SHEET_ERRORS.keys())
def test_errors_of_second_sheets_name_value_and_remedy(change: tuple[str, str], expected: str) -> None:
    text = (CONFIG / "two_sheets.toml").read_text()
    assert change[0] in text
    assert expected in config_error(text.replace(*change))


OBJECT_ERRORS = {
    'object = "bolts"': '1 "right": object = "bolts": there is no [object.bolts]; did you mean "bolt"?',
    "head_diameter_mm = 10.0": "[object.bolt]: shape.head_diameter_mm = 10: must be more than diameter_mm",
    "length_mm = -4.0": "[object.bolt.shape]: length_mm = -4.0: must be",
    'kind = "cone"': "[object.bolt]: shape",
}


@pytest.mark.parametrize(("change", "expected"), OBJECT_ERRORS.items(), ids=OBJECT_ERRORS.keys())
def test_errors_of_objects_name_location_value_and_remedy(change: str, expected: str) -> None:
    shape = (
        'kind = "bolt", diameter_mm = 10.0, length_mm = 40.0, head_diameter_mm = 17.0, head_length_mm = 6.4'
    )
    key = change.partition(" =")[0]
    if key in shape:
        words = [change if word.startswith(f"{key} ") else word for word in shape.split(", ")]
        shape = ", ".join(words)
    text = SMALL.replace("[[hand]]", f"[object.bolt]\nshape = {{ {shape} }}\n\n[[hand]]", 1)
    text = text.replace('name = "right"', f'name = "right"\n{change if key == "object" else ""}', 1)
    assert expected in config_error(text)


def test_the_mesh_of_an_object_is_read_beside_the_deployment_and_travels_with_it(tmp_path: Path) -> None:
    mesh = '[object.mug]\nshape = { kind = "mesh", file = "mug.stl" }\n\n[[hand]]'
    (tmp_path / "hand.toml").write_text(SMALL.replace("[[hand]]", mesh, 1))
    stl = b"vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    for content, error in ((None, "No such file"), (b"solid mug", "no STL file")):
        if content is not None:
            (tmp_path / "mug.stl").write_bytes(content)
        with pytest.raises(ConfigError, match=rf"\[object.mug\]: shape.file.*{error}"):
            config.load(tmp_path / "hand.toml")
    (tmp_path / "mug.stl").write_bytes(stl)
    text = config.load(tmp_path / "hand.toml").model_dump_json(by_alias=True)
    (tmp_path / "mug.stl").unlink()
    shape = config.Deployment.model_validate_json(text).objects["mug"].shape
    assert shape.kind == "mesh"
    assert read_embedded(shape.file) == stl


@pytest.mark.parametrize(("change", "expected"), ERRORS.values(), ids=ERRORS.keys())
def test_config_error_names_location_value_and_remedy(change: tuple[str, str], expected: str) -> None:
    assert SMALL.count(change[0]) >= 1
    error = config_error(SMALL.replace(*change, 1))
    assert expected in error
    assert len(error.splitlines()) == 1, "one error, one line"


@pytest.mark.parametrize(
    "endpoint",
    ["tcp://127.0.0.1:*", "tcp://127.8.9.1:1", "tcp://localhost:65535", "ipc:///x"],
)
def test_local_endpoints_are_accepted(endpoint: str) -> None:
    text = SMALL.replace("[[bus]]", f'[daemon]\nlive = "{endpoint}"\n[[bus]]', 1)
    assert config.parse(text).daemon.live == endpoint


@pytest.mark.parametrize("host", ["0.0.0.0", "*", "192.168.1.20", "eth0", "127.0.0.1"])
def test_endpoints_for_other_machines_are_accepted_with_keys(tmp_path: Path, host: str) -> None:
    (tmp_path / "keys").mkdir()
    table = f'[daemon]\nkeys = "keys"\nlive = "tcp://{host}:7001"\n[[bus]]'
    daemon = config.parse(SMALL.replace("[[bus]]", table, 1), folder=tmp_path).daemon
    assert daemon.live == f"tcp://{host}:7001"
    assert daemon.keys == str(tmp_path / "keys")


def test_endpoint_on_all_interfaces_conflicts_with_its_port_on_any(tmp_path: Path) -> None:
    (tmp_path / "keys").mkdir()
    table = '[daemon]\nkeys = "keys"\nlive = "tcp://*:5582"\n[[bus]]'
    with pytest.raises(ConfigError, match="is also the endpoint of live"):
        config.parse(SMALL.replace("[[bus]]", table, 1), folder=tmp_path)


@given(st.from_regex(r"tcp://[\[\]0-9a-z.:*]{0,20}", fullmatch=True))
def test_endpoints_for_other_machines_are_rejected_without_keys(endpoint: str) -> None:
    with contextlib.suppress(ConfigError):
        host, _, port = (
            config.parse(SMALL.replace("[[bus]]", f'[daemon]\nlive = "{endpoint}"\n[[bus]]', 1))
            .daemon.live[6:]
            .rpartition(":")
        )
        assert port == "*" or 0 < int(port) < 65536
        assert host == "localhost" or ipaddress.IPv4Address(host).is_loopback


def test_empty_file_lists_missing_tables() -> None:
    assert config_error("").splitlines() == [
        f"hand.toml: {key}: is missing; it is a table of its own, under a line {header}"
        for key, header in (
            ("bus", "[[bus]]"),
            ("node", "[node.NAME]"),
            ("sheet", "[sheet.NAME]"),
            ("hand", "[[hand]]"),
        )
    ]


def test_hand_without_pads_names_the_missing_table() -> None:
    error = config_error(SMALL[: SMALL.index("[[hand.pad]]")])
    assert '[[hand]] 1 "right": pad: is missing; it is a table of its own, under a line [[hand.pad]]' in error


def test_all_errors_are_reported_at_once() -> None:
    error = config_error(SMALL.replace("drive_v = 5.0", "drive_v = 0").replace("node_id = 5", "node_id = 0"))
    assert len(error.splitlines()) == 2


def test_node_ids_may_repeat_on_another_bus() -> None:
    second = '[[bus]]\nname = "can1"\ninterface = "socketcan"\nchannel = "can1"\n[node.four]'
    text = SMALL.replace("[node.four]", second).replace(
        'link = "index"\nbus = "can0"\nnode_id = 6', 'link = "index"\nbus = "can1"\nnode_id = 5'
    )
    assert [pad.bus for pad in config.parse(text).hands[0].pads] == ["can0", "can1"]


def test_missing_file_raises_config_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"missing\.toml: the file: No such file"):
        config.load(tmp_path / "missing.toml")


def test_binary_file_raises_config_error(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not UTF-8 text"):
        config.load(tmp_path / "a.toml")


def test_text_in_another_encoding_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(("# für die Hand" + SMALL).encode("latin-1"))
    with pytest.raises(
        ConfigError, match=r"line 1 `# für die Hand`: byte 0xFC isn't UTF-8; it is 'ü' in Latin-1"
    ):
        config.load(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_bytes(SMALL.encode("utf-16"))
    with pytest.raises(ConfigError, match="is UTF-16; save it as UTF-8"):
        config.load(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_bytes(SMALL.encode("utf-8-sig"))
    with pytest.raises(ConfigError, match="without BOM"):
        config.load(tmp_path / "a.toml")


@pytest.mark.parametrize(
    "rpy_deg", [[0.0, 12.5, 0.0], [0.0, 2.29, 0.0], [180.0, -90.0, 0.0], [0.0, 1.5, 3.0]]
)
def test_small_and_large_angles_in_degrees_are_accepted(rpy_deg: list[float]) -> None:
    config.parse(SMALL.replace("[1.0, 2.0, 3.0]", f"[0.0, 0.0, 0.0], rpy_deg = {rpy_deg}"))


def test_eds_path_is_relative_to_the_deployment(tmp_path: Path) -> None:
    (tmp_path / "my.eds").touch()
    (tmp_path / "a.toml").write_text(
        SMALL.replace("noise_counts = 1.0", 'noise_counts = 1.0\neds = "my.eds"')
    )
    assert config.load(tmp_path / "a.toml").nodes["four"].eds == str(tmp_path / "my.eds")


@pytest.mark.parametrize(
    "surface",
    [
        {"kind": "plane", "length_mm": 30.0, "width_mm": 20.0},
        {"kind": "cylinder", "radius_mm": 11.0, "length_mm": 30.0, "arc_deg": 150.0},
        {"kind": "cone", "near_radius_mm": 12.0, "far_radius_mm": 7.0, "slant_mm": 25.0, "arc_deg": 150.0},
        {"kind": "cone", "near_radius_mm": 7.0, "far_radius_mm": 12.0, "slant_mm": 25.0, "arc_deg": 150.0},
        {"kind": "cone", "near_radius_mm": 7.0, "far_radius_mm": 7.0, "slant_mm": 25.0, "arc_deg": 150.0},
        {"kind": "sphere", "radius_mm": 10.0, "from_deg": -30.0, "to_deg": 55.0, "arc_deg": 140.0},
        {
            "kind": "prism",
            "length_mm": 40.0,
            "section_aside_mm": [0.0, 6.0, 18.0, 24.0],
            "section_up_mm": [0.0, 5.0, 5.0, 0.0],
        },
        {
            "kind": "revolution",
            "profile_axial_mm": [0.0, 10.0, 20.0, 30.0],
            "profile_radius_mm": [12.0, 11.0, 11.0, 8.0],
            "arc_deg": 150.0,
        },
        {"kind": "plane", "length_mm": 30.0, "width_mm": 20.0, "resistivity_ratio": 1.44},
    ],
    ids=lambda surface: surface["kind"],
)
def test_every_surface_can_be_named_in_a_deployment(surface: dict[str, Any]) -> None:
    raw = tomllib.loads(SMALL)
    raw["hand"][0]["pad"][0]["surface"] = surface
    pad = config.parse(toml(raw)).hands[0].pads[0]
    assert pad.surface.kind == surface["kind"]
    assert pad.surface.rectangle_mm == pytest.approx(_rectangle_mm(surface), rel=1e-9)


def _rectangle_mm(surface: dict[str, Any]) -> tuple[float, float]:
    """Sides of the conformal rectangle by closed forms, or by quadrature along the profile."""
    kind = surface["kind"]
    if kind == "plane":
        return surface["length_mm"] * math.sqrt(surface.get("resistivity_ratio", 1.0)), surface["width_mm"]
    if kind == "prism":
        aside, up = surface["section_aside_mm"], surface["section_up_mm"]
        return surface["length_mm"], float(np.hypot(np.diff(aside), np.diff(up)).sum())
    arc = math.radians(surface["arc_deg"])
    if kind == "cylinder":
        return surface["length_mm"], surface["radius_mm"] * arc
    if kind == "cone":
        near, far, slant = surface["near_radius_mm"], surface["far_radius_mm"], surface["slant_mm"]
        middle = (near + far) / 2
        per_radius = math.log(far / near) / (far - near) if far != near else 1 / near
        return slant * middle * per_radius, middle * arc
    if kind == "sphere":
        start, end = math.radians(surface["from_deg"]), math.radians(surface["to_deg"])
        middle = surface["radius_mm"] * math.cos((start + end) / 2)
        return middle * (math.asinh(math.tan(end)) - math.asinh(math.tan(start))), middle * arc
    points = np.stack([surface["profile_axial_mm"], surface["profile_radius_mm"]], axis=1)
    chords = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    spline = CubicSpline(chords, points)
    t = np.linspace(0.0, chords[-1], 200_001)
    speed = np.hypot(*spline(t, 1).T)
    length = cumulative_simpson(speed, x=t, initial=0.0)
    middle = float(spline(np.interp(length[-1] / 2, length, t))[1])
    return middle * float(simpson(speed / spline(t)[:, 1], x=t)), middle * arc


def test_an_output_that_is_no_longer_estimated_is_refused_with_the_remedy() -> None:
    raw = tomllib.loads(SMALL) | {"scene": {"outputs": ["position", "texture", "shape"]}}
    with pytest.raises(ConfigError) as refused:
        config.parse(toml(raw))
    (problem,) = refused.value.problems
    assert (problem.location, problem.value) == ("[scene]: outputs[1]", ' = "texture"')
    assert problem.remedy.startswith("is no longer estimated; delete it from the list")


@pytest.mark.parametrize(
    ("surface", "key", "remedy"),
    [
        (
            {
                "kind": "prism",
                "length_mm": 40.0,
                "section_aside_mm": [0.0, 6.0, 18.0],
                "section_up_mm": [0.0, 5.0],
            },
            "section_up_mm",
            "must have as many finite points as section_aside_mm, 3",
        ),
        (
            {
                "kind": "revolution",
                "profile_axial_mm": [0.0, 1.0, 20.0, 21.0],
                "profile_radius_mm": [30.0, 0.1, 0.1, 30.0],
                "arc_deg": 150.0,
            },
            "profile_radius_mm",
            "the smooth curve through the points crosses the axis",
        ),
        ({"kind": "plane", "length_mm": 30.0, "width_mm": 0.0}, "width_mm", "must be greater than 0"),
        (
            {"kind": "plane", "length_mm": 30.0, "width_mm": 9.0, "resistivity_ratio": -1.0},
            "resistivity_ratio",
            "must be greater than 0",
        ),
    ],
)
def test_an_impossible_surface_is_refused_by_key_and_remedy(
    surface: dict[str, Any], key: str, remedy: str
) -> None:
    raw = tomllib.loads(SMALL)
    raw["hand"][0]["pad"][0]["surface"] = surface
    with pytest.raises(ConfigError) as refused:
        config.parse(toml(raw))
    (problem,) = refused.value.problems
    assert problem.location.endswith(f"surface.{key}")
    assert problem.remedy.startswith(remedy)


# --- another wire for a bus


@pytest.mark.parametrize(
    ("text", "interface", "channel", "options"),
    [
        ("can0=socketcan:vcan0", "socketcan", "vcan0", {}),
        ("can0=virtual:demo-1", "virtual", "demo-1", {}),
        ("can0=vector:1", "vector", 1, {}),
        ("can0=udp_multicast:239.74.163.2:43113", "udp_multicast", "239.74.163.2", {"port": 43113}),
        ("can0=udp_multicast:239.74.163.2,port=43113", "udp_multicast", "239.74.163.2", {"port": 43113}),
        ("can0=slcan:/dev/tty@9,sleep=0.5,on=true", "slcan", "/dev/tty@9", {"sleep": 0.5, "on": True}),
        ("can0=socketcand:can0,host=a b", "socketcand", "can0", {"host": "a b"}),
    ],
)
def test_with_bus_replaces_interface_and_options(
    text: str, interface: str, channel: str | int, options: dict[str, Any]
) -> None:
    before = config.parse(
        SMALL.replace('channel = "can0"', 'channel = "can0"\nbitrate_bit_s = 500000\noptions = { fd = true }')
    )
    after = config.with_bus(before, text)
    bus = after.buses[0]
    assert (bus.name, bus.interface, bus.channel, bus.options) == ("can0", interface, channel, options)
    assert bus.bitrate_bit_s == 500_000
    assert after.hands == before.hands


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("can0", "must be NAME=INTERFACE:CHANNEL"),
        ("can0=socketcan", "must be NAME=INTERFACE:CHANNEL"),
        ("can0=socketcan:can0,fd", "must be NAME=INTERFACE:CHANNEL"),
        ("can7=socketcan:can0", "NAME = can7: the deployment has no bus of that name; known: can0"),
        ("can0=socketcann:can0", 'interface = "socketcann": did you mean "socketcan"? python-can knows'),
        ("can0=udp_multicast:10.0.0.1", 'channel = "10.0.0.1": must be a multicast address'),
    ],
)
def test_with_bus_error_names_option_and_remedy(text: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config.with_bus(config.parse(SMALL), text)
    assert str(caught.value).startswith(f"--bus {text}: ")
    assert expected in str(caught.value)


def test_two_multicast_buses_need_different_ports() -> None:
    second = '[[bus]]\nname = "can1"\ninterface = "socketcan"\nchannel = "can1"\n[node.four]'
    one = config.with_bus(config.parse(SMALL.replace("[node.four]", second)), "can0=udp_multicast:239.0.0.1")
    assert config.with_bus(one, "can1=udp_multicast:239.0.0.1:43114").buses[1].options == {"port": 43114}
    with pytest.raises(ConfigError, match=r"can0.* has UDP port 43113 too, .*give each its own port"):
        config.with_bus(one, "can1=udp_multicast:239.0.0.2")


# --- properties

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_\-]{0,8}", fullmatch=True)
lengths = st.floats(1.0, 100.0)
arcs = st.floats(10.0, 360.0)
whole_degrees = st.integers(-180, 180).map(float)  # no multiple of 45 degrees in radians, which is refused
any_text = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
any_value = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats()
    | any_text
    | st.sampled_from(["plane", "cone", "can0", "tcp://127.0.0.1:*", 0, 1.0, -1]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(any_text, inner, max_size=3),
    max_leaves=4,
)


@st.composite
def surfaces(draw: st.DrawFn) -> dict[str, Any]:
    kind = draw(st.sampled_from(["plane", "cylinder", "cone", "sphere"]))
    if kind == "plane":
        return {"kind": kind, "length_mm": draw(lengths), "width_mm": draw(lengths)}
    arc = {"kind": kind, "arc_deg": draw(arcs)}
    if kind == "cylinder":
        return arc | {"radius_mm": draw(lengths), "length_mm": draw(lengths)}
    if kind == "cone":
        near, far = draw(lengths), draw(lengths)
        return arc | {
            "near_radius_mm": near, "far_radius_mm": far, "slant_mm": abs(far - near) + draw(lengths)
        }  # fmt: skip
    start = draw(st.floats(-65.0, 60.0))  # nearer to a pole the gaps may leave no electrode
    return arc | {"radius_mm": draw(lengths), "from_deg": start, "to_deg": draw(st.floats(start + 5, 65.0))}


@st.composite
def deployments(draw: st.DrawFn) -> dict[str, Any]:
    """Deployments that are right, as the tables of a file."""
    raw = tomllib.loads(SMALL)
    ids = draw(st.lists(st.integers(1, 127), min_size=1, max_size=4, unique=True))
    links = draw(st.lists(names, min_size=len(ids), max_size=len(ids), unique=True))
    raw["hand"][0]["name"] = draw(names)
    raw["hand"][0]["pad"] = [
        {
            "link": link,
            "bus": "can0",
            "node_id": node_id,
            "node": "four",
            "sheet": "firm",
            "surface": draw(surfaces()),
            "gap_mm": draw(st.floats(0.02, 0.03)),
            "series_ohm": draw(st.lists(st.floats(0.0, 1e4), min_size=4, max_size=4)),
            "mount": {"rpy_deg": draw(st.lists(whole_degrees, min_size=3, max_size=3))},
        }
        for link, node_id in zip(links, ids, strict=True)
    ]
    raw["bus"][0]["options"] = draw(
        st.dictionaries(names, st.integers() | st.booleans() | any_text, max_size=2)
    )
    raw["daemon"] = {"sync_period_ms": draw(st.floats(0.5, 1000.0))}
    return raw


def toml(value: Any) -> str:
    """The tables of a file as TOML text."""
    return "".join(f"{quoted(key)} = {inline(item)}\n" for key, item in value.items())


def inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{quoted(key)} = {inline(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(inline, value)) + "]"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return json.dumps(value)


def quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of nested tables and lists."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, item in pairs for place in [(value, key), *places(item)]]


@given(deployments())
def test_valid_deployment_survives_a_round_trip(raw: dict[str, Any]) -> None:
    deployment = config.parse(toml(raw))
    kept = deployment.model_dump(by_alias=True, exclude_none=True)
    assert config.parse(toml(kept)) == deployment


@given(deployments(), st.data())
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_corrupted_deployment_raises_only_config_error(raw: dict[str, Any], data: st.DataObject) -> None:
    for _ in range(data.draw(st.integers(1, 2))):
        container, key = data.draw(st.sampled_from(places(raw)))
        if data.draw(st.booleans()):
            container[key] = data.draw(any_value)
        else:
            container.pop(key)
    problems: tuple[config.Problem, ...] = ()
    try:
        config.parse(toml(raw), "hand.toml")
    except ConfigError as error:
        problems = error.problems
    assert all(problem.location and problem.remedy for problem in problems)


@given(deployments(), any_text, any_value, st.data())
def test_unknown_keys_are_always_named(
    raw: dict[str, Any], key: str, value: Any, data: st.DataObject
) -> None:
    free = (raw["bus"][0]["options"], raw["node"], raw["sheet"])  # tables whose keys the user chooses
    tables = [raw] + [
        container[name]
        for container, name in places(raw)
        if isinstance(container[name], dict) and not any(container[name] is table for table in free)
    ]
    table = data.draw(st.sampled_from(tables))
    known = {"eds", "vendor_id", "product_code", "serial", "touch", "rpy_deg", "position_mm", "reference_kpa"}
    known |= set(config.Daemon.model_fields) | set(config.Bus.model_fields) | set(config.Node.model_fields)
    known |= set(config.Touch.model_fields) | set(table)
    if key in known:
        return
    table[key] = value
    assert key in config_error(toml(raw))


@given(any_text)
def test_malformed_bus_text_raises_only_config_error(text: str) -> None:
    deployment = config.parse(SMALL)
    for wire in (text, f"can0={text}", f"can0=socketcan:{text}", f"can0=udp_multicast:239.0.0.1,{text}"):
        with contextlib.suppress(ConfigError):
            assert config.with_bus(deployment, wire).hands == deployment.hands
