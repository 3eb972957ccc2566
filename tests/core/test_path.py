"""The documented path of a sample is the one that it takes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from handtouch.core.compiled import DISABLE_VARIABLE

ROOT = Path(__file__).parents[2]


def test_a_tick_passes_the_documented_modules() -> None:
    text = (ROOT / "docs/architecture.md").read_text()
    (block,) = re.findall(r"test_path.py.*?```text\n(.*?)```", text, re.DOTALL)
    variables = {**os.environ, DISABLE_VARIABLE: "1", "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"}
    command = [sys.executable, str(Path(__file__).with_name("trace_tick.py"))]
    traced = subprocess.run(command, env=variables, capture_output=True, text=True, check=True, timeout=300)
    assert sorted(block.split()) == traced.stdout.split()
