"""Build facts: code, libraries and processor, which decide on the last bit of a result.

Public name: `build_info`.
"""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import __version__

_NUMERIC_PACKAGES = ("calibration", "config", "core", "field", "hand", "sheet", "wire")


@cache
def build_info() -> dict[str, Any]:
    """Return version, source hash, libraries and processor; results are equal bit for bit if these are."""
    code = hashlib.sha256()
    root = Path(__file__).parents[1]
    for package in _NUMERIC_PACKAGES:
        for file in sorted((root / package).rglob("*.py")):
            code.update(file.read_bytes())
    return {
        "handtouch": __version__,
        "source": code.hexdigest()[:16],
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "scipy")},
        "processor": _processor_name(),
        "features": _cpu_features(),
    }


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith(("model name", "CPU part"))]
    return names[0] if names else platform.machine()


def _cpu_features() -> list[str]:
    """Return the instruction sets that numpy detected, which select its loops and its linear algebra's."""
    detected: dict[str, NDArray[Any] | bool] = np._core._multiarray_umath.__cpu_features__  # type: ignore[attr-defined]
    return sorted(name for name, present in detected.items() if present)
