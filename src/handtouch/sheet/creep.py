"""Creep: a reading that lags behind a growing load and follows a release immediately.

Public names: `Creep`, `CreepStep`.

The response to a step of load is load * (instant + sum_i weight_i (1 - exp(-t / time_i))): a chain of
Kelvin-Voigt elements. The load on each element never exceeds the present load, so a release is abrupt. A
power law is a sum of such elements with logarithmically spaced times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray


@dataclass(frozen=True)
class Creep:
    """Response to a unit step of load: instant + sum_i weights_i (1 - exp(-t / times_s_i)).

    times_s: rising. The final reading is `total` times the load. Raises ValueError for times that don't rise
    from above 0, negative weights, or an instant share that isn't positive.
    """

    instant: float
    weights: tuple[float, ...]
    times_s: tuple[float, ...]

    def __post_init__(self) -> None:
        if not 0 < self.instant < np.inf:
            raise ValueError(f"instant must be positive and finite, got {self.instant}")
        if len(self.weights) != len(self.times_s):
            raise ValueError(f"{len(self.weights)} weights for {len(self.times_s)} times")
        if not all(0 <= weight < np.inf for weight in self.weights):
            raise ValueError(f"weights must be at least 0 and finite, got {self.weights}")
        if not all(
            low < high < np.inf for low, high in zip((0.0, *self.times_s), self.times_s, strict=False)
        ):
            raise ValueError(f"times_s must be positive, finite and rise, got {self.times_s}")

    @classmethod
    def first_order(cls, instant: float, time_s: float) -> Creep:
        """Build one element; the final reading is the load."""
        return cls(instant, (1 - instant,), (time_s,))

    @property
    def total(self) -> float:
        """Final reading over load."""
        return self.instant + sum(self.weights)

    def response(self, t_s: npt.ArrayLike) -> FloatArray:
        """Return the reading (...) at times (...) after a unit step of load."""
        t = np.asarray(t_s, np.float64)[..., None]
        grown = -np.expm1(-t / np.array(self.times_s)) @ np.array(self.weights)
        return np.asarray(self.instant + grown)

    def initial_state(self, pads: int) -> FloatArray:
        """Return the state (1 + modes, pads) of sheets without load: the load, then each element's [N]."""
        return np.zeros((1 + len(self.times_s), pads))

    def discretise(self, dt_s: float) -> CreepStep:
        """Precompute one step of `dt_s`."""
        return CreepStep(self, dt_s)


class CreepStep:
    """Creep over one interval; n steps of dt under a constant load equal one of n dt.

    `transition` (modes, 1 + modes): elements after it from load and elements, unless they exceed the load.
    `inverse_lines` (1 + modes, 1 + modes): the greatest of them is the load, from reading and elements.
    """

    def __init__(self, creep: Creep, dt_s: float) -> None:
        decay = np.exp(-dt_s / np.array(creep.times_s))
        modes, weights = len(decay), np.array(creep.weights)
        self._reading = np.append(creep.instant, weights)
        # An element moves to decay * state + (1 - decay) * load, or to the load where that is less.
        self.transition = np.column_stack([-np.expm1(-dt_s / np.array(creep.times_s)), np.diag(decay)])
        # Elements keep their order, the fastest nearest to the load. If the first k exceed the load they
        # follow it immediately, and reading = slope_k load + sum over the others of weight decay state: one
        # straight line for each k. The reading is the least of them, so the load is the largest solution.
        others = np.triu(np.ones((modes + 1, modes))) * (weights * decay)
        slope = creep.total - others.sum(1)
        self.inverse_lines = np.column_stack([np.ones(modes + 1), -others]) / slope[:, None]

    def forward(self, state: FloatArray, load_n: FloatArray) -> FloatArray:
        """Return the reading (n,) at the end of an interval under load (n,) >= 0; update `state` in place."""
        state[0] = load_n
        np.minimum(self.transition @ state, state[0], out=state[1:])
        return np.asarray(self._reading @ state)

    def inverse(self, state: FloatArray, reading_n: FloatArray) -> FloatArray:
        """Return the load (n,) of a reading; exact. Update `state` in place."""
        state[0] = reading_n
        load = np.maximum.reduce(self.inverse_lines @ state, out=state[0])
        np.minimum(self.transition @ state, load, out=state[1:])
        return np.array(load)
