"""Values in the wrong unit: metres in keys of millimetres, radians in keys of degrees.

Public names: `unit_problems`, `pad_unit_problems`. Refused are only values that no hand has: lengths below
what can be built or measured, and angles that are a multiple of 45 degrees to a thousandth when read as
radians.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

from handtouch.config.problems import Problem
from handtouch.config.tables import Deployment, Pad

_MIN_SIZE_MM = 0.5
"""least size of a sensing surface"""
_MIN_OFFSET_MM = 0.05
"""least offset of a mount: a quarter of the error of printed parts, so that nobody states a smaller one"""
_MIN_GAP_MM = 0.02  # narrower gaps can't be cut
_MIN_RADIUS_MM = 0.05  # smaller contacts than any fingertip makes
_MIN_STD_MM = 0.001  # a micrometre is better than parts are known
_MIN_GROUP_MM = 1.0  # pads are farther apart
_MAX_ANGLE_ERROR_RAD = 1e-3
_MM_PER_M = 1e3


def unit_problems(deployment: Deployment) -> Iterator[Problem]:
    """Yield keys whose value is in metres or radians, outside of pads."""
    for name, sheet in deployment.sheets.items():
        at = f"[sheet.{name}]: "
        yield from _check_length(f"{at}contact_radius_mm", sheet.contact_radius_mm, _MIN_RADIUS_MM)
        for key in ("contact_radius_std_mm", "gap_std_mm", "size_std_mm"):
            yield from _check_length(f"{at}{key}", getattr(sheet, key), _MIN_STD_MM)
    for number, hand in enumerate(deployment.hands, 1):
        at = f'[[hand]] {number} "{hand.name}": '
        yield from _check_length(f"{at}mount_std_mm", hand.mount_std_mm, _MIN_STD_MM)
        yield from _check_length(f"{at}grouping_distance_mm", hand.grouping_distance_mm, _MIN_GROUP_MM)


def pad_unit_problems(location: str, pad: Pad) -> Iterator[Problem]:
    """Yield keys of a pad whose value is in metres or radians; `location` precedes their names."""
    surface = pad.surface.model_dump(exclude={"kind", "resistivity_ratio"})
    lengths = {key: value for key, value in surface.items() if key.endswith("_mm")}
    together = {key for key in lengths if isinstance(lengths[key], tuple) or "_radius_" in key}
    for key, value in lengths.items():
        # single radii of a profile or a cone may be small
        greatest = (
            max((_greatest(lengths[other]) for other in together), default=0.0) if key in together else 0.0
        )
        if greatest < _MIN_SIZE_MM:
            yield from _check_length(f"{location}surface.{key}", value, _MIN_SIZE_MM)
    yield from _check_length(f"{location}gap_mm", pad.gap_mm, _MIN_GAP_MM)
    yield from _check_length(f"{location}mount.position_mm", pad.mount.position_mm, _MIN_OFFSET_MM)
    yield from _check_angle(f"{location}mount.rpy_deg", pad.mount.rpy_deg)
    for key, value in surface.items():
        if key.endswith("_deg"):
            yield from _check_angle(f"{location}surface.{key}", value)


def _check_length(location: str, value: float | tuple[float, ...], least_mm: float) -> Iterator[Problem]:
    if 0 < _greatest(value) < least_mm:
        yield Problem(
            location,
            f" = {json.dumps(value)}",
            f"less than {least_mm:g} mm; lengths are in millimetres: write "
            f"{_converted(value, lambda metres: _MM_PER_M * metres)} if it is in metres",
        )


def _check_angle(location: str, value: float | tuple[float, ...]) -> Iterator[Problem]:
    if any(map(_is_round_in_radians, value if isinstance(value, tuple) else (value,))):
        yield Problem(
            location,
            f" = {json.dumps(value)}",
            f"a multiple of 45 degrees if it is in radians; angles are in degrees: write "
            f"{_converted(value, math.degrees)}",
        )


def _is_round_in_radians(value: float) -> bool:
    eighths = round(abs(value) / (math.pi / 4))
    return 1 <= eighths <= 8 and abs(abs(value) - eighths * math.pi / 4) < _MAX_ANGLE_ERROR_RAD


def _greatest(value: Any) -> float:
    return max(map(abs, value), default=0.0) if isinstance(value, tuple) else abs(value)


def _converted(value: float | tuple[float, ...], convert: Any) -> str:
    values = value if isinstance(value, tuple) else (value,)
    texts = [
        f"{round(convert(one), 1):g}" if convert is math.degrees else f"{convert(one):.6g}" for one in values
    ]
    return f"[{', '.join(texts)}]" if isinstance(value, tuple) else texts[0]
