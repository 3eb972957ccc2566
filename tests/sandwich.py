"""Total currents of two sheets under one contact, by the contact law of each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.field import ContactLaw


class Sandwich(NamedTuple):
    """Two sheets, each with its layer's resistance at 1e5 Pa, its exponent and its film."""

    contact_ohm_m2: tuple[float, float]
    alpha: tuple[float, float]
    ohm_per_square: tuple[float, float]

    def currents(
        self, force_n: ArrayLike, radius_m: ArrayLike, drive_v: float, spreading_m: float
    ) -> NDArray[np.float64]:
        """Return the total currents (2, ...) [A] of contacts of this force and radius (...)."""
        sheets = zip(*self, strict=True)
        return np.stack(
            [
                ContactLaw(layer, alpha, radius_m).current(force_n, drive_v, ohm, spreading_m)
                for layer, alpha, ohm in sheets
            ]
        )

    def is_unique(self, currents_a: NDArray[np.float64], drive_v: float, spreading_m: float) -> bool:
        """Return True if only one radius of 0.2 mm to half the spreading radius explains both currents."""
        radius_m = np.geomspace(2e-4, spreading_m / 2, 400)
        forces = []
        for current, layer, alpha, ohm in zip(currents_a, *self, strict=True):
            force_n = ContactLaw(layer, alpha, radius_m).force(current, drive_v, ohm, spreading_m).force_n
            most = ContactLaw(layer, alpha, radius_m).current(1e9, drive_v, ohm, spreading_m)
            forces.append(np.where(current < 0.98 * most, force_n, np.inf))
        known = np.isfinite(forces).all(axis=0)
        first, second = np.array(forces)[:, known]
        return int(np.count_nonzero(np.diff(np.sign(first - second)))) == 1
