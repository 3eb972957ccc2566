"""Rate-independent hysteresis of a simulated sheet: the Preisach operator, by its Everett function.

Public names: `Everett` and its kinds `PlayLoops` and `HomogeneousLoops`, `PreisachState`.

The Everett function E(a, b) is the decrease of the reading when the load turns round at a and falls to b. It
determines the operator: the reading is the sum of E over the load's turning points that a later, larger swing
hasn't wiped out (Mayergoyz, Mathematical Models of Hysteresis, 1991). A virgin sheet reads E(load, 0).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol


class Everett(Protocol):
    """Everett function of a Preisach operator."""

    def swing_n(self, high_n: float, low_n: float) -> float:
        """Return the change of the reading [N] between two turning points of the load, high >= low >= 0."""


@dataclass(frozen=True)
class HomogeneousLoops:
    """Loops in proportion to their load: E(a, b) = a (1 - b / a)^exponent.

    The first loading reads the load itself. Unloading from a reads a (1 - (1 - b / a)^exponent), a relative
    loop width of 1/2 - 2^-exponent half-way. The density of relays is (exponent - 1) exponent
    (1 - b / a)^(exponent - 2) b / a^2 over a > b, not a function of a - b alone: no sum of plays has it.
    Raises ValueError for an exponent below 1; 1 is no hysteresis.
    """

    exponent: float

    def __post_init__(self) -> None:
        if not self.exponent >= 1:
            raise ValueError(f"exponent must be at least 1, got {self.exponent}")

    def swing_n(self, high_n: float, low_n: float) -> float:
        """Return the change of the reading [N] between two turning points."""
        return float(high_n * (1 - low_n / high_n) ** self.exponent) if high_n > 0 else 0.0


@dataclass(frozen=True)
class PlayLoops:
    """Loops of the same shape at every load: equal plays up to `full_n`, as in Prandtl and Ishlinskii.

    A swing 0 - full_n - 0 reads up to `full_n`, with a loop of `width` half-way, as a fraction of full_n.
    """

    width: float
    full_n: float
    plays: int = 6

    def swing_n(self, high_n: float, low_n: float) -> float:
        """Return the change of the reading [N] between two turning points."""
        swing, weight, total = high_n - low_n, self._weight, 0.0
        for threshold in self._thresholds_n:
            if swing > threshold:
                total += swing - threshold
        return (1 - weight * self.plays / 2) * swing + weight * total

    @cached_property
    def _shares(self) -> list[float]:
        return [(k + 1) / (self.plays + 1) for k in range(self.plays)]

    @cached_property
    def _thresholds_n(self) -> list[float]:
        return [share * self.full_n for share in self._shares]

    @cached_property
    def _weight(self) -> float:
        return self.width / sum(min(share, 1 - share) for share in self._shares)


@dataclass
class PreisachState:
    """Turning points of the load that still count [N]: 0, maximum, minimum, ... and the present load."""

    turning_n: list[float] = field(default_factory=lambda: [0.0])

    def apply(self, loops: Everett, load_n: float) -> float:
        """Return the reading [N] under a load >= 0; update the state."""
        points = self.turning_n
        while len(points) > 1:
            before, last = points[-2:]
            is_continued = (last - before) * (load_n - last) >= 0
            is_wiped_out = (last - before) * (load_n - before) <= 0
            if not (is_continued or is_wiped_out):
                break
            points.pop()
        if load_n != points[-1]:
            points.append(load_n)
        return sum(
            loops.swing_n(b, a) if b > a else -loops.swing_n(a, b) for a, b in itertools.pairwise(points)
        )

    def copy(self) -> PreisachState:
        """Return an independent copy."""
        return PreisachState(list(self.turning_n))
