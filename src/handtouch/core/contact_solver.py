"""The stages on the arrays of a pad model: position, force and covariance of contacts, in one call a tick.

Public names: `make_solver`, `ContactSolver`, `VALUE_COUNT`, `VALUE_SLICES`,
`MAX_SQUARED_MISFIT`, `PART_COUNT`, `PART_SLICES`, `PARTS_COUNT`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.core.memory import view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.pad_tables import MAX_SQUARED_MISFIT, SEARCH_POINTS
from handtouch.core.stages.force import stack_table
from handtouch.core.stages.locate import Fit
from handtouch.core.stages.pairs import PairFit, grid_points, work_size
from handtouch.core.stages.solve import (
    MISFIT_COUNT,
    PART_COUNT,
    PART_SLICES,
    PARTS_COUNT,
    VALUE_COUNT,
    VALUE_SLICES,
    ContactSolver,
)
from handtouch.core.stages.tables import PadSurface, Placement
from handtouch.core.stages.tolerances import PartKnowledge

FloatArray = NDArray[np.float64]


def make_solver(
    model: PadModel,
    currents: FloatArray,
    offset_std_a: FloatArray,
    force_requested: NDArray[np.bool_],
    values: FloatArray,
    parts: FloatArray | None = None,
    saturated: NDArray[np.bool_] | None = None,
    noise_squared: FloatArray | None = None,
    misfits: FloatArray | None = None,
) -> ContactSolver:
    """Return a solver of contacts that reads and writes these arrays in place.

    currents: (pads, channels) [A]. offset_std_a: (pads,) of the sum of the currents, from the baseline.
    force_requested: (pads,). values: (pads, VALUE_COUNT), laid out as VALUE_SLICES; NaN for new contacts.
    parts: (pads, PARTS_COUNT), twice PART_SLICES. saturated: (pads, channels), lower bounds of currents.
    noise_squared: (pads, channels), variances of the channels as measured [counts^2]. misfits: (pads, 3), see
    `ContactSolver`.
    """
    n, points = currents.shape[1], grid_points(SEARCH_POINTS)
    limits, moments = model.pair_settings()
    if parts is None:
        parts = np.full((model.size, PARTS_COUNT), np.nan)
    if noise_squared is None:
        noise_squared = np.zeros(currents.shape)
    if misfits is None:
        misfits = np.zeros((model.size, MISFIT_COUNT))
    if saturated is None:
        saturated = np.zeros(currents.shape, dtype=np.bool_)
    return ContactSolver(
        model.stage_tables(),
        model.stage_tolerances(),
        model.stage_laws(),
        [PadSurface(surface) for surface in model.surface_tables],
        stack_table(),
        Fit(n, int(model.state_counts.max())),
        Placement(),
        n,
        _work(3 * n),
        view_memory(currents),
        view_memory(model.weight),
        PartKnowledge(model.part_axes, model.part_axis_ends, model.part_offsets, model.touch_errors),
        view_memory(model.gain_covariance),
        view_memory(offset_std_a),
        view_memory(force_requested),
        view_memory(values),
        PairFit(n, points, _work(work_size(n, points))),
        *(view_memory(limits), view_memory(moments), view_memory(parts)),
        *(view_memory(saturated), view_memory(model.peak_currents_a), view_memory(model.mounts)),
        *(view_memory(model.crowding), view_memory(model.ampere_per_count), view_memory(noise_squared)),
        view_memory(misfits),
    )


def _work(size: int) -> memoryview[float]:
    return view_memory(np.zeros(size))


__all__ = [
    "MAX_SQUARED_MISFIT",
    "PARTS_COUNT",
    "PART_COUNT",
    "PART_SLICES",
    "VALUE_COUNT",
    "VALUE_SLICES",
    "ContactSolver",
    "make_solver",
]
