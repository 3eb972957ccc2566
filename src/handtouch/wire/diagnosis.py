"""The diagnosis of a pad as the topic `health` publishes it.

Public name: `Diagnosis`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from handtouch.wire.faults import FaultKind


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One fault of a pad that lasts: kind, cause, evidence, remedy.

    since_ns: begin, by the host's monotonic clock. confidence: probability of this kind, against another or
    none. pad_m: arc lengths from electrodes x0 and y0; size_m: diameter. position_valid, force_valid: whether
    the pad's contacts can be relied on meanwhile.
    """

    kind: FaultKind
    cause: str
    evidence: str
    remedy: str
    since_ns: int
    confidence: float = 1.0
    pad_m: tuple[float, float] | None = None
    size_m: float | None = None
    position_valid: bool = True
    force_valid: bool = True

    def to_map(self) -> dict[str, Any]:
        """Return the map in `diagnoses` of a health message."""
        return {field.name: getattr(self, field.name) for field in fields(self)} | {"kind": self.kind.value}
