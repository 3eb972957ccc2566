"""Tables of what tolerances of parts change in the fractions of a pad, built once for each distinct pad.

Public names: `ToleranceTable`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.core.pad_tables import ForwardTable, hermite_table, inside, view_floats
from handtouch.core.stages.tolerances import PadTolerances
from handtouch.field.network import ElectrodeNetwork
from handtouch.hand import electrode_network, pad_surface

FloatArray = NDArray[np.float64]
_CELLS_PER_CELL = 3  # of the forward model: a table has 0.5 MB
_GAP_STEP_M, _LOG_ASPECT_STEP = 1e-6, 1e-5
_M_PER_MM = 1e-3


@dataclass(frozen=True)
class ToleranceTable:
    """Derivatives of a pad's four fractions by the gap at each end of its electrodes, by the ratio of its
    sides, and by its resistors.

    nodes: (cells + 1, cells + 1, 4, 12), see `PadTolerances`; its nodes are some of the forward model's.
    end_vectors: (8, 4) [1/m], two ends of each electrode. series_vectors: (4, 4). size_m: length, and width
    in the middle.
    """

    nodes: FloatArray
    end_vectors: FloatArray
    series_vectors: FloatArray
    size_m: tuple[float, float]

    @classmethod
    def from_pad(cls, pad: config.Pad, sheet: config.Sheet, forward: ForwardTable) -> ToleranceTable:
        """Tabulate differences between networks of slightly longer gaps and sides and the forward model's."""
        surface, network = pad_surface(pad), electrode_network(pad, sheet)
        s, t = (inside(at[::_CELLS_PER_CELL, 0]) / at[-1, 0] for at in (forward.nodes_x, forward.nodes_y))
        at = np.meshgrid(s, t)
        nominal = np.moveaxis(forward.nodes[::_CELLS_PER_CELL, ::_CELLS_PER_CELL, 0, :4], -1, 0)

        def slope(changed: ElectrodeNetwork, step: float) -> FloatArray:
            """Return derivatives of the fractions (4, y, x)."""
            return np.asarray((changed.fractions(at[0] * changed.a, at[1] * changed.b) - nominal) / step)

        fields, vectors = [], []
        for end in np.eye(8).reshape(8, 4, 2):
            by_gap = slope(electrode_network(pad, sheet, _GAP_STEP_M * end), _GAP_STEP_M)  # of rank 1
            left, singular, right = np.linalg.svd(by_gap.reshape(4, -1), full_matrices=False)
            vectors.append(left[:, 0] * singular[0])
            fields.append(right[0].reshape(by_gap.shape[1:]))
        by_aspect = slope(electrode_network(pad, sheet, 0.0, _LOG_ASPECT_STEP), _LOG_ASPECT_STEP)
        return cls(
            hermite_table(np.stack([*fields, *by_aspect], axis=-1)),
            np.array(vectors),
            network.series_sensitivity.T.copy(),
            (surface.extent_m[0], float(surface.b * surface.scale(surface.a / 2, surface.b / 2))),
        )

    def pad_tolerances(self, pad: config.Pad, node: config.Node, sheet: config.Sheet) -> PadTolerances:
        """Return the tolerances that a deployment states, as the stages take them; gains aside."""
        size_x, size_y = (sheet.size_std_mm * _M_PER_MM / side for side in self.size_m)
        aspect_std = math.sqrt(size_x**2 + size_y**2 + (sheet.anisotropy_std / 2) ** 2)
        ends = sheet.gap_std_mm * _M_PER_MM * self.end_vectors
        has_series = any(pad.series_ohm)
        return PadTolerances(
            view_floats(self.nodes),
            len(self.nodes) - 1,
            1 / _CELLS_PER_CELL,
            view_floats(np.ascontiguousarray(ends)),
            aspect_std,
            view_floats(self.series_vectors),
            node.series_std,
            sheet.ohm_per_square_std,
            has_series,
            self.size_m[0] / 2,
            size_x,
            size_y,
            not (ends.any() or aspect_std or has_series),
        )
