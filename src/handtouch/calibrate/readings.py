"""What a session of known weights consists of: the weights, what was read of each, the circuit around them.

Public names: `Weight`, `parse_weights`, `order`, `Reading`, `Circuit`, `circuit_at`, `GRAM_FORCE_N`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from handtouch import config
from handtouch.field import ElectrodeNetwork, Surface
from handtouch.hand import network_of, surface_of

GRAM_FORCE_N = 9.80665e-3
"""Weight of a gram [N] at standard gravity."""

_MIDDLE = 0.3  # of a side from the middle: farther out the sheet's resistance changes quickly
_RAIL = 0.98  # of a channel's range


@dataclass(frozen=True)
class Weight:
    """A known load: newton, the radius of what it stands on [m], and its name, as "50 gf"."""

    force_n: float
    radius_m: float
    name: str


def parse_weights(text: str, unit: str, radius_mm: float) -> list[Weight]:
    """Weights of "20,50,100@4": numbers in `unit` (gf or n); @ and millimetres where the radius differs.

    Raises ValueError for what is no such list.
    """
    weights = []
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        number, at, radius = part.partition("@")
        try:
            value, mm = float(number), float(radius) if at else radius_mm
        except ValueError:
            value = mm = math.nan
        if not (0 < value < math.inf and 0 < mm < math.inf):
            raise ValueError(
                f"{part!r}: a weight is a number above 0, such as 50, or 50@4 where it stands on 4 mm radius"
            )
        name = f"{value:g} {'N' if unit == 'n' else 'gf'}" + (f" on {mm:g} mm" if at else "")
        weights.append(Weight(value * (1.0 if unit == "n" else GRAM_FORCE_N), mm * 1e-3, name))
    if not weights:
        raise ValueError("no weight is given; an example: 20,50,100,200,500")
    return weights


def order(weights: Sequence[Weight], repeats: int) -> list[Weight]:
    """All weights, up and down by turns: what fades meanwhile doesn't look like a law."""
    rising = sorted(weights, key=lambda weight: (weight.radius_m, weight.force_n))
    return [weight for turn in range(repeats) for weight in (rising if turn % 2 == 0 else rising[::-1])]


@dataclass(frozen=True)
class Reading:
    """One weight, once: the mean total current [A] after it settled, and how sure that mean is.

    place_m: arc lengths on the pad from the electrodes x0 and y0. told_n: force that the daemon told then,
    NaN where it told none.
    """

    weight: Weight
    current_a: float
    current_std_a: float
    samples: int
    place_m: tuple[float, float]
    told_n: float = math.nan


@dataclass(frozen=True)
class Circuit:
    """Around one contact: potential [V], spreading radius [m] and its std as ln, resistors' part [ohm]."""

    drive_v: float
    spreading_m: float
    spreading_std: float
    series_ohm: float


class Place:
    """The circuit at places of one pad, as the deployment file has it."""

    def __init__(self, deployment: config.Deployment, pad: config.Pad) -> None:
        self.pad = pad
        self.node, self.sheet = deployment.nodes[pad.node], deployment.sheets[pad.sheet]
        self._surface: Surface = surface_of(pad)
        self._network: ElectrodeNetwork = network_of(pad, self.sheet)

    def circuit(self, place_m: tuple[float, float], std_m: float = 0.0) -> Circuit:
        """At arc lengths (x, y) from x0 and y0; std_m: how sure that place is."""
        x, y, scale = self._at(place_m)
        radius, series = self._network.spreading_radius(x, y) * scale, self._network.series_resistance(x, y)
        near = [self._at((place_m[0] + dx, place_m[1] + dy)) for dx, dy in ((std_m, 0.0), (0.0, std_m))]
        moved = [float(np.log(self._network.spreading_radius(u, v) * s / radius)) for u, v, s in near]
        return Circuit(self.node.drive_v, float(radius), math.hypot(*moved), float(series))

    def complaint(self, place_m: tuple[float, float], current_a: float) -> str:
        """Why a reading there can't be used; empty if it can."""
        x, y, _ = self._at(place_m)
        aside = max(abs(x / self._surface.a - 0.5), abs(y / self._surface.b - 0.5))
        if not aside < _MIDDLE:
            return "it stands far from the middle of the pad"
        shares = self._network.fractions(x, y)
        if float(np.max(shares)) * current_a > _RAIL * self.node.full_scale_ma * 1e-3:
            return "a channel is at the end of its range: leave this weight out, or lower drive_v"
        return ""

    def _at(self, place_m: tuple[float, float]) -> tuple[float, float, float]:
        """The rectangle's (x, y), and metres on the surface per unit of it."""
        x, y = self._surface.to_rectangle(*place_m)
        return float(x), float(y), float(self._surface.scale(x, y))
