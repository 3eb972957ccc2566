"""The diagnosis of a pad as the topic `health` publishes it.

Public name: `Diagnosis`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from handtouch.wire.faults import FaultKind


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One fault of a pad that lasts: kind, cause, evidence, remedy."""

    kind: FaultKind
    """identifier"""
    cause: str
    """cause as text"""
    evidence: str
    """evidence as text"""
    remedy: str
    """remedy as text"""
    since_ns: int
    """begin, on the clock of `t_ns`"""
    confidence: float = 1.0
    """probability of this kind, against another or none"""
    pad_m: tuple[float, float] | None = None
    """its arc lengths on the pad, from the electrodes x0 and y0"""
    size_m: float | None = None
    """its diameter"""
    position_valid: bool = True
    """the pad's contact positions can be relied on meanwhile"""
    force_valid: bool = True
    """the pad's forces can be relied on meanwhile"""

    def to_map(self) -> dict[str, Any]:
        """Return the map in `diagnoses` of a health message."""
        return {field.name: getattr(self, field.name) for field in fields(self)} | {"kind": self.kind.value}
