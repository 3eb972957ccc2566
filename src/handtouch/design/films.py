"""Positions by two films with a pressed layer between, instead of by one sheet, over the same four wires.

Public names: `FILM_OHM`, `LEAD_STD_OHM`, `film_position_std`.
"""

from __future__ import annotations

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.config.responses import TwoLayersTable
from handtouch.design.pad_task import PadTask
from handtouch.design.response import ContactResponse
from handtouch.field.two_layers import TwoLayers

FILM_OHM = 400.0
"""Sheet resistance of each film: of the range that docs/responses.md advises"""
LEAD_STD_OHM: float = TwoLayersTable.model_fields["lead_std_ohm"].default
"""Error of each lead where it wasn't measured"""


def film_position_std(task: PadTask, lead_std_ohm: float = 0.0) -> FloatArray:
    """Return the root of the sum of both coordinates' variances [m] on the task's grid, (k,).

    Layer, law, node and gains are those of the pad. lead_std_ohm: error of each lead's resistance. Uneven
    films are no part of it, as uneven sheets aren't of the goals.
    """
    films = TwoLayers(task.surface, FILM_OHM, 1e-3 * task.sheet.contact_radius_mm, lead_std_ohm=lead_std_ohm)
    x, y = task.grid
    fractions, jacobian = films.fractions_with_jacobian(x, y)
    outer_m = films.spreading_radius(x, y) * task.surface.scale(x, y)
    total: FloatArray = task.law.current(
        task.force_n, task.node.drive_v, films.sheet_ohm_per_square, outer_m, films.series_resistance(x, y)
    )
    slopes = np.concatenate([jacobian / task.surface.scales(x, y), fractions[:, None]], axis=1)
    gains = task.tolerances.gain * fractions * np.eye(films.channels)[:, :, None]
    parts = np.concatenate([gains, films.variation_slopes(x, y)])
    covariance = np.einsum("pik,pjk->kij", parts, parts)
    covariance += np.eye(films.channels) * ((task.noise_a / total) ** 2)[:, None, None]
    no_bends = np.zeros((len(x), films.channels, 0))
    return ContactResponse(
        fractions=fractions.T,
        slopes=np.moveaxis(slopes, 2, 0),
        bends=no_bends,
        covariance=covariance,
        total_a=total,
    ).position_std
