"""The pages about nodes agree with the code: wiring diagram, kinds of failures."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from handtouch.node.adc_fault import AdcFaultKind, emergency_of
from handtouch.node.settings import load

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/node.md").read_text()


def test_the_diagram_is_current() -> None:
    drawn = subprocess.run(
        [sys.executable, str(ROOT / "docs/wiring.py")], capture_output=True, text=True, check=True
    ).stdout
    assert (ROOT / "docs/wiring.svg").read_text() == drawn, "run `make wiring`"


def test_the_diagram_has_the_channels_gain_and_line_of_the_shipped_node() -> None:
    drawing = ET.parse(ROOT / "docs/wiring.svg")
    texts = [element.text for element in drawing.iter() if element.tag.endswith("text")]
    pad = load(ROOT / "config/touch_node.toml").settings.pads[0]
    assert set(pad.channels) <= set(texts)
    assert pad.gain_ohm is not None
    assert any(str(text).startswith(f"{-pad.gain_ohm:g} Ω") for text in texts)
    assert pad.excitation is not None
    assert f"GPIO {pad.excitation.line}" in texts


def test_the_how_to_s_values_of_a_board_make_a_node(tmp_path: Path) -> None:
    """Its full scale is within what the sketch can print, in the unit that it states."""
    page = (ROOT / "docs/howto.md").read_text()
    steps = page[page.index("With an Arduino UNO") : page.index("## ... equip an Allegro hand")]
    text = (ROOT / "config/board_node.toml").read_text().rpartition("[[pad]]")[0]
    keys = re.findall(r"`(\w+ = [^`]+)`", steps[: steps.index("\n2. ")])
    assert len(keys) == 5
    for key in keys:
        name = key.split(" = ")[0]
        if name == "limits":
            text = text.replace("[source.board]", f"[source.board]\n{key}")
        else:
            text, changed = re.subn(rf"^{name} = .*", key, text, count=1, flags=re.MULTILINE)
            assert changed == 1, name
    (tmp_path / "node.toml").write_text(text)
    node = load(tmp_path / "node.toml").settings
    (pad,) = node.pads
    reference_mv, steps_of_adc, readings, shunt_ohm = 1100, 1024, 16, 220
    assert f"/ {steps_of_adc} / {readings} / {shunt_ohm} ohm" in steps
    assert pad.ma_per_unit == pytest.approx(reference_mv / steps_of_adc / readings / shunt_ohm, rel=1e-3)
    assert node.sources["board"].limits == (0, readings * (steps_of_adc - 1))
    assert f"full_scale_ma = {pad.full_scale_ma}" in steps[steps.index("\n3. ") :]
    assert f"series_ohm = {[shunt_ohm] * 4}" in steps


def test_the_page_has_every_kind_of_failure_with_its_emcy_message() -> None:
    rows = re.findall(r"^\| (\d+) ([a-z ]+) \| (0x\w+) \| (0x\w+) \|", PAGE, re.MULTILINE)
    assert [(int(kind), text, int(code, 16), int(bits, 16)) for kind, text, code, bits in rows] == [
        (kind.value, kind.text, *emergency_of(kind)) for kind in AdcFaultKind
    ]
