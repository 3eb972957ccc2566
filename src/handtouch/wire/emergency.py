"""An EMCY message of a node as the topic `health` publishes it.

Public name: `Emergency`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True, slots=True)
class Emergency:
    """An error that a node has reported by EMCY."""

    code: int
    """error code"""
    register: int
    """error register (0x1001) in the message"""
    manufacturer: str
    """the five manufacturer-specific bytes, ten hexadecimal digits"""
    text: str
    """code and register as text"""
    arrival_ns: int
    """reception of the first message, on the clock of `t_ns`"""
    cleared_ns: int | None = None
    """when the node cleared it, on the clock of `t_ns`; nil while it lasts"""
    count: int = 1
    """messages received in succession"""

    def to_map(self) -> dict[str, Any]:
        """Return the map in `emergencies` of a health message."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
