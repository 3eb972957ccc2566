"""What commissioning has to do with: the hand, and what became of each pad.

Public names: `Hand`, `Result`, `Outcome`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from handtouch import config
from handtouch.canbus.nodes.spec import NodeStatus

from .bench import Sample
from .order import Near


class Hand(Protocol):
    """The nodes, as `Bench` has them."""

    @property
    def nodes(self) -> list[NodeStatus]:
        """Of each slot."""

    def samples(self) -> Iterator[Sample]:
        """Without end."""


class Result(Enum):
    """What became of a pad."""

    WELL = "as configured"
    CHANGED = "changed"
    UNCLEAR = "not clear"
    NO_ANSWER = "no answer"
    SKIPPED = "skipped"
    BEFORE = "done before"
    LEFT = "left"


@dataclass
class Outcome:
    """A pad: what was found, and what is wrong with it, in words. `slot` and `electrodes` where known."""

    hand: str
    pad: config.Pad
    result: Result = Result.LEFT
    slot: int | None = None
    electrodes: tuple[Near, Near, Near, Near] | None = None
    problems: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"{self.hand}/{self.pad.link}"

    @property
    def well(self) -> bool:
        return self.result in (Result.WELL, Result.CHANGED, Result.BEFORE) and not self.problems
