"""The compiled solver of a pad model: position, force and covariance of contacts, in one call a tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.core.pad_tables import SEARCH_POINTS, stack_table, view_bytes, view_floats
from handtouch.core.stages.force import PadLaw
from handtouch.core.stages.locate import Fit, PadTable
from handtouch.core.stages.place import PadSurface, Placement
from handtouch.core.stages.solve import VALUE_COUNT, VALUE_SLICES, ContactSolver

FloatArray = NDArray[np.float64]


def make_solver(
    tables: list[PadTable],
    laws: list[PadLaw],
    surfaces: list[PadSurface],
    electrodes: int,
    currents: FloatArray,
    weight: FloatArray,
    gain_covariance: FloatArray,
    gain_uncertain: NDArray[np.bool_],
    offset_std_a: FloatArray,
    force_requested: NDArray[np.bool_],
    values: FloatArray,
) -> ContactSolver:
    """Return a solver on these arrays, which it reads and writes in place.

    currents, weight: (pads, n). gain_covariance: (pads, n, n). gain_uncertain, offset_std_a,
    force_requested: (pads,). values: (pads, VALUE_COUNT).
    """
    fit = Fit(*(_work(electrodes) for _ in range(5)), _work(3 * (electrodes + 1)), _work(SEARCH_POINTS**2))
    return ContactSolver(
        tables, laws, surfaces, stack_table(), fit, Placement(_work(15)), electrodes, _work(4 * electrodes),
        *map(view_floats, (currents, weight, gain_covariance)), view_bytes(gain_uncertain),
        view_floats(offset_std_a), view_bytes(force_requested), view_floats(values),
    )  # fmt: skip


def _work(size: int) -> memoryview[float]:
    return view_floats(np.zeros(size))


__all__ = ["VALUE_COUNT", "VALUE_SLICES", "ContactSolver", "make_solver"]
