"""Shear pads of a deployment, as the stage takes them.

Public names: `ShearParameters`, `shear_parameters`, `changed_shear_pads`. Derivation: docs/shear.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.roles import SHEAR, channel_numbers
from handtouch.core.memory import RowArray
from handtouch.core.stages.shear import SHEAR_ROW
from handtouch.field.shear import BarPattern, DiscPattern, ShearPattern, edge_excess, gap_loss
from handtouch.hand import mount_transform


class ShearParameters(NamedTuple):
    """Arguments of a `ShearTable`."""

    pad: int
    column: int
    unknowns: int
    points: FloatArray
    row: RowArray

    def equals(self, other: ShearParameters) -> bool:
        """Return True if all parameters are the same."""
        return self[:3] == other[:3] and all(map(np.array_equal, self[3:], other[3:]))


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
        "log_gain": [math.log(node.channel_scale[number]) for number in channel_numbers(pad, SHEAR)],
        "lean_per_m": (pattern.centroids_m / film.gyration_m2).ravel(),
        "alpha": film.alpha,
        "along": rotation[:, 0],
        **_geometry(pattern),
    }
    parameters = np.zeros(1, SHEAR_ROW).view(np.recarray)
    for name, value in values.items():
        parameters[name] = value
    return ShearParameters(row, column, len(pattern.components), _points(pattern), parameters)


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
