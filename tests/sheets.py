"""Readings of a sheet over time, by its forward model; creep by a power law."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

from handtouch.sheet import Creep, SheetModel


def apparent_load(
    model: SheetModel, load_n: Callable[[float], float], seed: int = 1, step_s: float = 2e-3
) -> Callable[[float], float]:
    """Return the apparent load [N] of a sheet as a function of time [s], to be called with rising times."""
    state, step, count = model.initial_state(1, seed), model.discretise(step_s), 0

    def at(t_s: float) -> float:
        nonlocal count
        while count < int(t_s / step_s):
            count += 1
            step.forward(state, load_n(count * step_s))
        rest = model.discretise(max(t_s - count * step_s, 0.0))
        return float(rest.forward(state.copy(), load_n(t_s))[0])

    return at


def power_law(exponent: float, modes: int = 7) -> Creep:
    """Return elements with the response (t / 1 s)^exponent from 1 ms to 1 h, by least squares."""
    t, times = np.geomspace(1e-3, 3600, 262), np.geomspace(1e-3, 3600, modes)
    columns = np.column_stack([np.ones_like(t), -np.expm1(-t[:, None] / times)])
    weights, _ = nnls(columns / t[:, None] ** exponent, np.ones_like(t))
    return Creep(float(weights[0]), tuple(weights[1:].tolist()), tuple(times.tolist()))
