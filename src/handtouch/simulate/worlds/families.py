"""Families of worlds: seeds on which estimators may be tuned, and others on which they are reported.

Public name: `Family`. A seed belongs to one family, and with it the kinds of sheets it can draw.
"""

from __future__ import annotations

from enum import Enum


class Family(Enum):
    """Half of the seeds; the value is its range."""

    TUNING = range(1_000_000)
    """Seeds for estimators' thresholds, priors and tests."""
    REPORTING = range(1_000_000, 2_000_000)
    """Seeds of published figures; nothing may be chosen by its result on them."""

    @property
    def seeds(self) -> range:
        """All seeds of the family."""
        return self.value

    def seed(self, number: int) -> int:
        """Return the seed of the family with a number from 0; raises ValueError out of range."""
        if not 0 <= number < len(self.seeds):
            raise ValueError(f"number = {number}: must lie between 0 and {len(self.seeds) - 1}")
        return self.seeds[number]

    @classmethod
    def of_seed(cls, seed: int) -> Family:
        """Return the family of a seed; raises ValueError for a seed of none."""
        for family in cls:
            if seed in family.seeds:
                return family
        raise ValueError(f"seed = {seed}: must lie between 0 and {cls.REPORTING.seeds[-1]}")
