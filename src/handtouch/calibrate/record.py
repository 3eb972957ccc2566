"""A session on file, as JSON lines: a head that says of which pad, then a line a reading, each as it comes.

Public names: `Head`, `Recorder`, `read`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Self

from handtouch.calibrate.readings import Reading, Weight

_FORMAT = "handtouch-calibration-session"


@dataclass(frozen=True)
class Head:
    """Which pad and unit; nominal: name of the deployment file's own calibration of it. zero: mean counts
    and their variances (4,) of the zero that was taken, nothing if none was."""

    pad: str
    nominal: str
    serial: int | None
    radius_std: float
    zero: Sequence[Sequence[float]] = ()


class Recorder:
    """Appends readings to a file, each written when it comes. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")

    def head(self, head: Head) -> None:
        """Say of which pad; before the first reading, and again when more is known."""
        self._write({"format": _FORMAT, "v": 1, **asdict(head)})

    def reading(self, reading: Reading) -> None:
        """Add one."""
        record = asdict(reading)
        record["told_n"] = None if math.isnan(reading.told_n) else reading.told_n
        self._write(record)

    def _write(self, record: dict[str, Any]) -> None:
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read(path: Path) -> tuple[Head, list[Reading]]:
    """A session from its file. Raises ValueError naming the line that can't be used, OSError."""
    head: Head | None = None
    readings = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            record = json.loads(line)
            if record.get("format") == _FORMAT:
                head = Head(**{field.name: record[field.name] for field in fields(Head)})
            else:
                readings.append(_reading(record))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: line {number} is no line of a session: {error!r:.80}") from error
    if head is None:
        raise ValueError(f'{path}: no session: nothing in it says "{_FORMAT}"')
    return head, readings


def _reading(record: dict[str, Any]) -> Reading:
    weight = Weight(**record.pop("weight"))
    x, y = (float(value) for value in record.pop("place_m"))
    told = record.pop("told_n")
    made = Reading(weight=weight, place_m=(x, y), told_n=math.nan if told is None else float(told), **record)
    numbers = (weight.force_n, weight.radius_m, made.current_a, made.current_std_a, x, y)
    if not all(isinstance(value, float | int) and math.isfinite(value) for value in numbers):
        raise ValueError("a number is missing")
    if min(weight.force_n, weight.radius_m) <= 0 or made.current_std_a < 0:
        raise ValueError("a number is negative")
    return made
