"""What really happened to a simulated hand, one record a contact and sample; kept as JSON lines.

Public names: `Truth`, `write`, `read`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TextIO

Vector = tuple[float, float, float]
_HEADER = "wall_minus_monotonic_ns"


@dataclass(frozen=True, slots=True)
class Truth:
    """One contact as it really was at one sample."""

    t_ns: int
    """Host's monotonic time of the SYNC that the sample belongs to."""
    hand: str
    link: str
    touch: int
    """Its number in the scenario, from 0."""
    u_m: float
    v_m: float
    """Arc lengths on the pad from electrodes x0 and y0."""
    position_m: Vector
    """In the frame of the link, as is `normal`."""
    normal: Vector
    force_n: float
    radius_m: float
    currents_a: tuple[float, float, float, float]
    """Into the channels x0, xa, y0, yb before gain, noise and rounding."""
    bound_m: float
    """Least rms location error that an unbiased estimate from this sample can have (Cramer-Rao)."""


def write_header(file: TextIO) -> None:
    """First line of a file: what turns its times into those of a log with wall-clock stamps."""
    file.write(json.dumps({_HEADER: time.time_ns() - time.monotonic_ns()}) + "\n")


def write(file: TextIO, records: Iterable[Truth]) -> None:
    """Append records, a line each."""
    for record in records:
        file.write(json.dumps(asdict(record)) + "\n")


def read(path: Path | str, *, wall: bool = False) -> list[Truth]:
    """Read a file back; with `wall`, its times as those of a log recorded with wall-clock stamps.

    Raises ValueError naming the line that isn't a record.
    """
    names = {field.name for field in fields(Truth)}
    records = []
    with open(path, encoding="utf-8") as file:
        offset_ns = json.loads(file.readline())[_HEADER] if wall else file.readline() and 0
        for number, line in enumerate(file, 2):
            found = json.loads(line)
            if found.keys() != names:
                raise ValueError(f"{path}: line {number} isn't a record of the truth")
            found["t_ns"] += offset_ns
            for name in ("position_m", "normal", "currents_a"):
                found[name] = tuple(found[name])
            records.append(Truth(**found))
    return records
