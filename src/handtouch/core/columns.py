"""Columns of the pads that a tick writes, and which rows of them one tick changed.

Public names: `PadColumns`, `TickResult`, `PUBLISHED`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray, IntArray
from handtouch.core.stages.rows import VALUE_SLICES
from handtouch.core.state import TickState
from handtouch.wire import COLUMNS, HandFrame

PUBLISHED = {
    name: at
    for name, at in VALUE_SLICES.items()
    if name in COLUMNS[HandFrame] and COLUMNS[HandFrame][name].codes is None
}
"""Values of a contact that are columns of hand frames"""


@dataclass(frozen=True)
class PadColumns:
    """State and contact values of n pads; a row keeps its last values until newer ones are computed."""

    state: NDArray[np.uint8]
    """PadState"""
    sample_ns: NDArray[np.int64]
    """SYNC of the newest sample, 0 before the first"""
    total_current_a: FloatArray
    """sum of the channels"""
    values: FloatArray
    """(n, VALUE_COUNT) contact values of each pad's last sample of a contact; most below are views of it"""
    xy: FloatArray
    """(n, 2) position on the pad's rectangle"""
    position_m: FloatArray
    """(n, 3) in the link frame; NaN without a valid position"""
    normal: FloatArray
    """(n, 3)"""
    pad_m: FloatArray
    """(n, 2) arc lengths from the electrodes x0 and y0"""
    pad_noise_m2: FloatArray
    """(n, 3) covariance of pad_m that is independent in each sample: uu, uv, vv"""
    residual: FloatArray
    residual_std: FloatArray
    """of a point contact, from channel noise"""
    squared_misfit: FloatArray
    """of a point contact, in variances of noise and tolerances; above MAX_SQUARED_MISFIT it is no point"""
    covariance_m2: FloatArray
    """(n, 3, 3) of position_m"""
    force_n: FloatArray
    """NaN without a valid force; a lower bound where `force_status` is LOWER_BOUND"""
    force_std_n: FloatArray
    """infinite for a lower bound"""
    uncompensated_force_n: FloatArray
    """force of the contact law, before the sheet behaviour is compensated"""
    published_values: NDArray[np.float32]
    """memory of the contact columns in `published`"""
    published: dict[str, NDArray[np.float32]]
    """columns of hand frames that are copied from here: contact columns (n, ...), NaN without contact, and
    total_current_a (n,)"""
    position_status: NDArray[np.uint8]
    """PositionStatus"""
    force_status: NDArray[np.uint8]
    """ForceStatus"""
    contact_radius_status: NDArray[np.uint8]
    """ContactRadiusStatus"""

    @classmethod
    def of_state(cls, state: TickState) -> PadColumns:
        """Return views of a state's arrays."""
        values = state.values
        views = {name: values[:, columns] for name, columns in VALUE_SLICES.items()}
        n = len(values)
        memory, published = _published_columns(n)
        return cls(
            state=state.pad_state,
            sample_ns=state.sample_ns,
            total_current_a=state.total_current_a,
            values=values,
            xy=views["xy"],
            position_m=views["position_m"],
            normal=views["normal"],
            pad_m=views["pad_m"],
            pad_noise_m2=views["pad_noise_m2"],
            residual=views["residual"][:, 0],
            residual_std=views["residual_std"][:, 0],
            squared_misfit=views["squared_misfit"][:, 0],
            covariance_m2=np.lib.stride_tricks.as_strided(
                views["covariance_m2"], (len(values), 3, 3), (values.strides[0], 24, 8)
            ),
            force_n=views["force_n"][:, 0],
            force_std_n=views["force_std_n"][:, 0],
            uncompensated_force_n=state.uncompensated_force_n,
            published_values=memory,
            published={**published, "total_current_a": np.zeros(n, np.float32)},
            position_status=np.zeros(len(values), dtype=np.uint8),
            force_status=np.zeros(len(values), dtype=np.uint8),
            contact_radius_status=np.zeros(len(values), dtype=np.uint8),
        )


_NO_PADS = np.zeros(0, dtype=np.intp)


class TickResult(NamedTuple):
    """Rows of the columns that one tick changed."""

    sync_ns: int
    began: IntArray
    updated: IntArray
    """contacts with a new sample that did not begin in this tick"""
    ended: IntArray
    silent: IntArray
    """contacts whose sample is missing; their values are those of the last one"""
    framed: IntArray = _NO_PADS
    """contacts with a new sample, updated in a hand frame only"""


def _published_columns(pads: int) -> tuple[NDArray[np.float32], dict[str, NDArray[np.float32]]]:
    """Return the memory of the published columns of n pads, and the columns in it, (n, ...)."""
    widths = {name: at.stop - at.start for name, at in PUBLISHED.items()}
    memory, first, columns = np.full(pads * sum(widths.values()), np.nan, np.float32), 0, {}
    for name, width in widths.items():
        columns[name] = memory[first : first + pads * width].reshape((pads, width)[:width])
        first += pads * width
    return memory, columns
