"""Rate-independent hysteresis: the Prandtl-Ishlinskii operator, a sum of plays, with its exact inverse.

Public name: `PrandtlIshlinskii`.

The plays are one-sided: each trails the load by up to its width while loading and never leads it, so a
released sheet reads nothing, and reads more while unloading than while loading. Shifted by half a width they
are the usual symmetric plays, and the usual inverse (Krejci and Kuhnen) holds: again a sum of plays.
Wiping-out and congruency, which define a Preisach operator, hold for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from handtouch.arrays import FloatArray


@dataclass(frozen=True)
class PrandtlIshlinskii:
    """reading = base * load + sum_j weights_j play_j, play = max(load - widths_n_j, min(load, play)).

    widths_n: rising [N]. Raises ValueError for widths that don't rise from above 0, or where the reading
    would not rise with the load (base, or base and the first weights summed, not positive).
    """

    base: float
    widths_n: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.weights) != len(self.widths_n):
            raise ValueError(f"{len(self.weights)} weights for {len(self.widths_n)} widths")
        widths = (0.0, *self.widths_n)
        if not all(low < high < np.inf for low, high in zip(widths, self.widths_n, strict=False)):
            raise ValueError(f"widths_n must be positive, finite and rise, got {self.widths_n}")
        slopes = np.cumsum((self.base, *self.weights))
        if not ((slopes > 0) & np.isfinite(slopes)).all():
            raise ValueError(f"the reading must rise with the load; slopes are {slopes.tolist()}")

    @classmethod
    def from_width(cls, width: float, full_n: float, plays: int = 6) -> PrandtlIshlinskii:
        """Build equal plays with unit gain at `full_n` and a loop 0 - `full_n` - 0 of `width` half-way (as a
        fraction of full_n, below 0.4)."""
        share = np.arange(1, plays + 1) / (plays + 1)
        weight = width / float(np.minimum(share, 1 - share).sum())
        base = 1 - weight * plays / 2
        return cls(base, tuple((full_n * share).tolist()), (weight,) * plays)

    @cached_property
    def inverse(self) -> PrandtlIshlinskii:
        """The inverse operator, for any history."""
        widths, weights = np.array(self.widths_n), np.array(self.weights)
        slopes = np.cumsum((self.base, *self.weights))
        turned = self.base * widths + np.tril(widths[:, None] - widths) @ weights
        return PrandtlIshlinskii(
            float(1 / slopes[0]), tuple(turned.tolist()), tuple(np.diff(1 / slopes).tolist())
        )

    def initial_state(self, pads: int) -> FloatArray:
        """Return the state (plays, pads) of sheets that were never pressed [N]."""
        return np.zeros((len(self.widths_n), pads))

    def apply_to(self, state: FloatArray, load_n: FloatArray) -> FloatArray:
        """Return the reading (n,) under load (n,) >= 0; update `state` in place. Rate-independent."""
        widths, weights = self._columns
        np.minimum(state, load_n, out=state)
        np.maximum(state, load_n - widths, out=state)
        return np.asarray(self.base * load_n + weights @ state)

    @cached_property
    def _columns(self) -> tuple[FloatArray, FloatArray]:
        return np.array(self.widths_n)[:, None], np.array(self.weights)
