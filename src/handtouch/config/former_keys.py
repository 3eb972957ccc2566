"""Keys of earlier versions of the deployment file, and what replaces them.

Public names: `replacement`, `replace_former_keys`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

DEFAULT_PERIOD_MS = 5.0
_TIMES = {"begin_samples": "begin_ms", "end_samples": "end_ms"}  # of `[touch]` and a pad's `touch`


def replacement(key: str, value: object, tables: Mapping[str, Any]) -> tuple[str, float] | None:
    """Return key and value that mean the same as a key of an earlier version; None if it never was one.

    tables: of the whole file. n successive samples take n - 1 SYNC periods.
    """
    if key not in _TIMES or not isinstance(value, int) or value < 1:
        return None
    daemon = tables.get("daemon")
    period_ms = daemon.get("sync_period_ms") if isinstance(daemon, Mapping) else None
    usable = isinstance(period_ms, int | float)
    return _TIMES[key], (value - 1) * (period_ms if usable and period_ms is not None else DEFAULT_PERIOD_MS)


def replace_former_keys(tables: dict[str, Any]) -> None:
    """Replace the keys of earlier versions in a recorded deployment."""
    touches = [tables.get("touch"), *(pad.get("touch") for hand in tables["hand"] for pad in hand["pad"])]
    for touch in touches:
        for key in _TIMES if touch else ():
            if key in touch and (found := replacement(key, touch.pop(key), tables)):
                touch[found[0]] = found[1]
