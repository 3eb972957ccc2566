"""JSON on standard output: one value per command, or one per line for streams.

Public names: `print_json`, `print_json_line`, `to_json`.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any


def print_json(value: Any) -> None:
    """Print the result of a command as one indented JSON value, see `to_json`."""
    print(to_json(value, indent=2))


def print_json_line(value: Any) -> None:
    """Print one value of a stream as a line of JSON, see `to_json`."""
    print(to_json(value), flush=True)


def to_json(value: Any, indent: int | None = None) -> str:
    """Format a value as strict JSON.

    Dataclasses become objects, paths strings, arrays lists, bytes hexadecimal strings; numbers that JSON
    can't express (NaN, infinity) become null.
    """
    return json.dumps(_plain(value), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if hasattr(value, "tolist"):  # arrays and scalars of numpy, which isn't imported here
        return _plain(value.tolist())
    return value
