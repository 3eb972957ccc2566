"""Recording of calibration readings as JSON lines: a header with the pad, then one line for each reading.

Public names: `RecordingHeader`, `ReadingRecorder`, `read_recording`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Self

from handtouch.procedures.calibrate.readings import Weight, WeightReading

_FORMAT = "handtouch-calibration-session"
_OPTIONAL = (
    "reported_force_n",
    "second_current_a",
    "second_std_a",
    "unloaded_s",
    "loaded_s",
    "measured_s",
)  # null where unknown


@dataclass(frozen=True)
class RecordingHeader:
    """Pad and node of a recording; default_calibration_id: of the deployment file's own calibration. zero:
    mean counts and their variances (4,) of the tare, empty without one."""

    pad: str
    default_calibration_id: str
    serial: int | None
    radius_std: float
    zero: Sequence[Sequence[float]] = ()


class ReadingRecorder:
    """Writes readings to a file, each at once; use it in a `with` block. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def write_header(self, header: RecordingHeader) -> None:
        """Write the header; before the first reading, and again if it changes."""
        self._write_line({"format": _FORMAT, "v": 1, **asdict(header)})

    def write_reading(self, reading: WeightReading) -> None:
        """Write a reading."""
        record = asdict(reading)
        del record["response"]  # follows from the times and the deployment file
        for name in _OPTIONAL:
            if math.isnan(record[name]):
                record[name] = None
        self._write_line(record)

    def _write_line(self, record: dict[str, Any]) -> None:
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()

    def __enter__(self) -> Self:
        self._file = self._path.open("w", encoding="utf-8")
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_recording(path: Path) -> tuple[RecordingHeader, list[WeightReading]]:
    """Return header and readings of a file. Raises ValueError naming the wrong line, OSError."""
    header: RecordingHeader | None = None
    readings = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            record = json.loads(line)
            if record.get("format") == _FORMAT:
                header = RecordingHeader(
                    **{field.name: record[field.name] for field in fields(RecordingHeader)}
                )
            else:
                readings.append(_parse_reading(record))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: line {number} is no line of a recording: {error!r:.80}") from error
    if header is None:
        raise ValueError(f'{path}: no recording: no line has the format "{_FORMAT}"')
    return header, readings


def _parse_reading(record: dict[str, Any]) -> WeightReading:
    weight = Weight(**record.pop("weight"))
    x, y = (float(value) for value in record.pop("position_m"))
    optional: dict[str, Any] = {
        name: math.nan if (value := record.pop(name, None)) is None else float(value) for name in _OPTIONAL
    }
    made = WeightReading(
        weight=weight,
        position_m=(x, y),
        **optional,
        **record,
    )
    numbers = (weight.force_n, weight.radius_m, made.current_a, made.current_std_a, x, y)
    if not all(isinstance(value, float | int) and math.isfinite(value) for value in numbers):
        raise ValueError("a number is missing")
    if min(weight.force_n, weight.radius_m) <= 0 or made.current_std_a < 0:
        raise ValueError("a number is negative")
    return made
