"""Interface of the hand during commissioning, and the outcome of each pad.

Public names: `SampleSource`, `PadResult`, `PadOutcome`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from handtouch import config
from handtouch.canbus.nodes.spec import NodeStatus
from handtouch.procedures.commission.sample_source import HandSample


class SampleSource(Protocol):
    """Nodes and their samples, as `CanSampleSource` provides them."""

    @property
    def nodes(self) -> list[NodeStatus]:
        """Status of each slot's node."""

    def samples(self) -> Iterator[HandSample]:
        """Yield samples without end."""


class PadResult(Enum):
    """Result of a pad."""

    AS_CONFIGURED = "as configured"
    CHANGED = "changed"
    AMBIGUOUS = "ambiguous"
    NO_ANSWER = "no answer"
    SKIPPED = "skipped"
    DONE_BEFORE = "done before"
    NOT_DONE = "not done"


@dataclass
class PadOutcome:
    """Outcome of a pad with its problems; `slot` and `electrodes` where known."""

    hand: str
    pad: config.Pad
    result: PadResult = PadResult.NOT_DONE
    slot: int | None = None
    electrodes: tuple[str, ...] | None = None
    problems: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Name of the pad, "hand/link"."""
        return f"{self.hand}/{self.pad.link}"

    @property
    def ok(self) -> bool:
        """The wiring is known and there is no problem."""
        return (
            self.result in (PadResult.AS_CONFIGURED, PadResult.CHANGED, PadResult.DONE_BEFORE)
            and not self.problems
        )
