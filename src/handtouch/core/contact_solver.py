"""The stages on the arrays of a pad model: position, force and covariance of contacts, in one call a tick.

Public names: `make_solver`, `ContactSolver`, `VALUE_COUNT`, `VALUE_SLICES`,
`MAX_SQUARED_MISFIT`, `PART_COUNT`, `PART_SLICES`, `PARTS_COUNT`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.core.memory import RowArray, view_memory, view_rows
from handtouch.core.pad_model import PadModel
from handtouch.core.pad_tables import MAX_SQUARED_MISFIT
from handtouch.core.stages.solve import (
    MISFIT_COUNT,
    MISFIT_ROW,
    MOUNT_ROW,
    PART_COUNT,
    PART_ROW,
    PART_SLICES,
    PARTS_COUNT,
    VALUE_COUNT,
    VALUE_ROW,
    VALUE_SLICES,
    ContactSolver,
)
from handtouch.core.stages.tolerances import PartKnowledge
from handtouch.core.stages.two_sheets import TwoSheets

_MODEL_ARRAYS = (
    "weight",
    "peak_currents_a",
    "mounts",
    "crowding",
    "ampere_per_count",
)
"""Arrays that solver and model have by the same name"""
_ROWS = {"values": VALUE_ROW, "parts": PART_ROW, "mounts": MOUNT_ROW, "misfits": MISFIT_ROW}
"""Those of named numbers"""


def make_solver(
    model: PadModel,
    currents: FloatArray,
    offset_std_a: FloatArray,
    force_requested: NDArray[np.bool_],
    values: FloatArray,
    parts: FloatArray | None = None,
    measured: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    both: TwoSheets | None = None,
) -> ContactSolver:
    """Return a solver of contacts that reads and writes these arrays in place.

    currents: (pads, channels) [A]. offset_std_a: (pads,) of the sum of the currents, from the baseline.
    force_requested: (pads,). values: (pads, VALUE_COUNT), laid out as VALUE_SLICES; NaN for new contacts.
    parts: (pads, PARTS_COUNT), twice PART_SLICES. measured: by name, as far as known, `saturated` (pads,
    channels), lower bounds of currents; `noise_squared` (pads, channels), variances of the channels as
    measured [counts^2]; `misfits` (pads, 3), see `ContactSolver`. both: pads with two sheets.
    """
    limits, moments = model.pair_settings()
    arrays: dict[str, NDArray[Any]] = {
        "currents": currents,
        "offset_std_a": offset_std_a,
        "force_requested": force_requested,
        "values": values,
        "parts": np.full((model.size, PARTS_COUNT), np.nan) if parts is None else parts,
        "pair_limits": limits,
        "moment_stds": moments,
        "saturated": np.zeros(currents.shape, dtype=np.bool_),
        "noise_squared": np.zeros(currents.shape),
        "misfits": np.zeros((model.size, MISFIT_COUNT)),
    }
    arrays |= {name: getattr(model, name) for name in _MODEL_ARRAYS} | dict(measured)
    return ContactSolver(
        models=model.stage_tables(),
        pad_tolerances=model.stage_tolerances(),
        laws=model.stage_laws(),
        surfaces=model.surfaces,
        known=PartKnowledge(
            axes=model.part_axes,
            ends=model.part_axis_ends,
            offsets=model.part_offsets,
            touch_errors=model.touch_errors,
            gain_covariance=model.gain_covariance,
        ),
        arrays={name: _view(name, array) for name, array in arrays.items()},
        both=both,
    )


def _view(name: str, array: NDArray[Any]) -> memoryview[Any] | RowArray:
    row = _ROWS.get(name)
    return view_memory(array) if row is None else view_rows(array, row)


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
