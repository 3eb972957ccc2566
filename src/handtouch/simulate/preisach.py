"""Rate-independent hysteresis of a simulated sheet: the Preisach operator, by its Everett function.

Public names: `Loops` of the kinds `HomogeneousLoops` and `PlayLoops`, which
`handtouch.simulate.stages.histories` computes.

The Everett function E(a, b) is the decrease of the reading when the load turns round at a and falls to b. It
determines the operator: the reading is the sum of E over the load's turning points that a later, larger swing
hasn't wiped out (Mayergoyz, Mathematical Models of Hysteresis, 1991). A virgin sheet reads E(load, 0).
"""

from __future__ import annotations

from dataclasses import dataclass


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


@dataclass(frozen=True)
class PlayLoops:
    """Loops of the same shape at every load: equal plays up to `full_n`, as in Prandtl and Ishlinskii.

    A swing 0 - full_n - 0 reads up to `full_n`, with a loop of `width` half-way, as a fraction of full_n.
    E(a, b) is `linear` (a - b), and `weight` times what a - b exceeds each of the `thresholds_n` by.
    """

    width: float
    full_n: float
    plays: int = 6

    @property
    def linear(self) -> float:
        """Part of a swing that is read at once."""
        return 1 - self.weight * self.plays / 2

    @property
    def weight(self) -> float:
        """Weight of each play."""
        return self.width / sum(min(share, 1 - share) for share in self._shares)

    @property
    def thresholds_n(self) -> list[float]:
        """Swings beyond which the plays move."""
        return [share * self.full_n for share in self._shares]

    @property
    def _shares(self) -> list[float]:
        return [(k + 1) / (self.plays + 1) for k in range(self.plays)]


Loops = HomogeneousLoops | PlayLoops
