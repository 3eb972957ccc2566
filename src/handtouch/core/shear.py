"""Force vectors of contacts above shear pads: the compiled stage on the tables of a deployment.

Public names: `ShearForces`, `ShearParameters`, `shear_parameters`, `changed_shear_pads`. Derivation:
docs/shear.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.config.channels import shear_numbers
from handtouch.core.memory import view_memory
from handtouch.core.slab import Slab
from handtouch.core.stages.shear import SHEAR_NUMBERS, ShearStage, ShearTable
from handtouch.core.state import TickState
from handtouch.field.shear import BarPattern, DiscPattern, ShearPattern, edge_excess, gap_loss
from handtouch.hand import mount_transform

FloatArray = NDArray[np.float64]
_WORK = 55


class ShearParameters(NamedTuple):
    """Arguments of a `ShearTable`."""

    pad: int
    column: int
    unknowns: int
    points: FloatArray
    numbers: FloatArray

    def equals(self, other: ShearParameters) -> bool:
        """Return True if all parameters are the same."""
        points, numbers = (self.points, other.points), (self.numbers, other.numbers)
        return self[:3] == other[:3] and np.array_equal(*points) and np.array_equal(*numbers)

    def table(self) -> ShearTable:
        """Return the table for the stage."""
        numbers = view_memory(self.numbers)
        return ShearTable(self.pad, self.column, self.unknowns, view_memory(self.points), numbers)


class ShearForces:
    """Force vectors of n pads, in a tick's state: those of contacts above shear pads, 0 to n of them.

    position_status, force_status: (n,) of the contacts, read in place. mounts: (n, MOUNT_COUNT), as
    `PadModel.mounts`.
    """

    def __init__(
        self,
        pads: Sequence[ShearParameters],
        state: TickState,
        position_status: NDArray[np.uint8],
        force_status: NDArray[np.uint8],
        mounts: FloatArray,
    ) -> None:
        self._numbers = {shear.pad: number for number, shear in enumerate(pads)}
        self.any_configured = bool(pads)
        """there is a shear pad"""
        self._state = state
        self._stage = ShearStage(
            *([shear.table() for shear in pads], state.pads, state.memory),
            *(view_memory(position_status), view_memory(force_status)),
            *(view_memory(mounts), view_memory(np.zeros(_WORK))),
        )

    def has_shear(self, pad: int) -> bool:
        """Return True if there is a shear pad beneath a pad."""
        return pad in self._numbers

    def rest_known(self, pad: int) -> bool:
        """Return True if the rest position of the shear pad beneath a pad is known."""
        return bool(np.isfinite(self._state.shear_rest_m[pad]).all())

    def update_forces(self, slab: Slab) -> None:
        """Compute the force vectors of contacts, once position and force of a tick's contacts are known."""
        self._stage.update_forces(slab.memory)

    def set_rest(self, pad: int, counts: ArrayLike) -> None:
        """Set the rest position of the shear pad beneath a pad by its counts (4,) at rest: a tare."""
        self._stage.set_rest(self._numbers[pad], view_memory(np.array(counts, np.float64)))

    def forget_rest(self, pads: Sequence[int]) -> None:
        """Forget the rest positions of pads that were replaced; untouched samples give new ones."""
        for pad in pads:
            self._stage.forget_rest(pad)

    def discard(self, pads: NDArray[np.intp]) -> None:
        """Discard the force vectors of pads whose contact ended, or whose model changed."""
        held = self._state
        held.force_vector[pads], held.force_vector_status[pads] = np.nan, 0

    def hand_columns(self, rows: slice) -> dict[str, bytes]:
        """Return columns of a hand frame; empty for a hand without shear pads."""
        if not any(rows.start <= pad < rows.stop for pad in self._numbers):
            return {}
        held = self._state
        values = held.force_vector[rows].astype("<f4")
        columns = {
            "force_vector_status": held.force_vector_status[rows].tobytes(),
            "force_vector_n": values[:, :3].tobytes(),
            "force_vector_covariance_n2": values[:, 3:].tobytes(),
        }
        in_frames = held.frame_force_vector[rows].astype("<f4").reshape(-1, 2, 3)
        for number, (frame, requested) in enumerate(
            (("palm", held.palm_requested), ("base", held.base_requested))
        ):
            if np.count_nonzero(requested[rows]):
                columns[f"{frame}_force_vector_n"] = in_frames[:, number].tobytes()
        return columns


def shear_parameters(
    deployment: config.Deployment, channels: int, noise_counts: FloatArray
) -> list[ShearParameters]:
    """Return those of a deployment's shear pads; channels: column of their first channel in the slab.

    noise_counts: (n,) of the pads' channels.
    """
    return [
        _parameters(row, pad, deployment, channels, float(noise_counts[row]))
        for row, (_, pad) in enumerate(deployment.pads)
        if pad.shear
    ]


def changed_shear_pads(old: Sequence[ShearParameters], new: Sequence[ShearParameters]) -> list[int]:
    """Return the pads above shear pads that differ."""
    before = {shear.pad: shear for shear in old}
    return [shear.pad for shear in new if shear.pad not in before or not shear.equals(before[shear.pad])]


def _parameters(
    row: int, pad: config.Pad, deployment: config.Deployment, column: int, noise_counts: float
) -> ShearParameters:
    shear, node = deployment.shears[pad.shear or ""], deployment.nodes[pad.node]
    pattern, film, layer = shear.build_pattern(), shear.build_film(), shear.build_layer()
    surface = pad.surface.build()
    rotation, _ = mount_transform(pad)
    numbers = np.zeros(max(part.stop for part in SHEAR_NUMBERS.values()))
    values: dict[str, ArrayLike] = {
        "travel_m": pattern.travel_m,
        "noise_counts": noise_counts,
        "load_n": film.plate_m2 * film.reference_pa,
        "stiffness_n_per_m": layer.stiffness_n_per_m,
        "stiffness_std": layer.stiffness_std,
        "axis_std": layer.axis_std,
        "hysteresis": layer.hysteresis,
        "zero_std_n": layer.zero_std_n,
        "centre_m": np.array(surface.extent_m) / 2,
        "log_gain": [math.log(node.channel_scale[number]) for number in shear_numbers(pad)],
        "lean_per_m": (pattern.centroids_m / film.gyration_m2).ravel(),
        "alpha": film.alpha,
        "along": rotation[:, 0],
        **_geometry(pattern),
    }
    for name, value in values.items():
        numbers[SHEAR_NUMBERS[name]] = value
    return ShearParameters(row, column, len(pattern.components), _points(pattern), numbers)


def _geometry(pattern: ShearPattern) -> dict[str, ArrayLike]:
    """Return the numbers of a pattern's overlaps."""
    if isinstance(pattern, DiscPattern):
        excess, loss = edge_excess(pattern.film_m), gap_loss(pattern.gap_m, pattern.film_m)
        return {"film_m": pattern.film_m, "radius_m": pattern.radius_m + excess, "inset_m": loss / 2}
    assert isinstance(pattern, BarPattern)
    return {"film_m": pattern.film_m, "overlap_m": pattern.overlap_m, "lost_m": pattern.gap_gain_m}


def _points(pattern: ShearPattern) -> FloatArray:
    """Return the points (m, 6) of bars' edges; one of a channel suffices where a twist isn't estimated."""
    if not isinstance(pattern, BarPattern):
        return np.zeros((0, 6))
    rows = [
        [channel, weight, *edge]
        for channel, weights in enumerate(pattern.edge_weights)
        for edge, weight in zip(pattern.edges.tolist(), weights.tolist(), strict=True)
        if weight > 0
    ]
    points = np.array(rows)
    if "twist" in pattern.components:
        return points
    _, first = np.unique(points[:, 0], return_index=True)
    return np.asarray(points[first])
