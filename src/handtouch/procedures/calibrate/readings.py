"""Known weights, readings of them, and the circuit around each contact.

Public names: `Weight`, `parse_weights`, `measurement_order`, `WeightReading`, `ContactCircuit`,
`circuit_at`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from handtouch import config
from handtouch.field import Surface
from handtouch.field.network import ElectrodeNetwork
from handtouch.hand import pad_network, pad_surface
from handtouch.host.units import GRAM_FORCE_N

_MAX_CENTRE_OFFSET_FRACTION = 0.3
"""Distance from the middle over a side: farther out, the sheet's resistance changes quickly."""
_MAX_RANGE_FRACTION = 0.98  # fraction of a channel's range


@dataclass(frozen=True)
class Weight:
    """Known load: force [N], radius of its foot [m], and name, as "50 gf"."""

    force_n: float
    radius_m: float
    name: str


def parse_weights(text: str, unit: str, radius_mm: float) -> list[Weight]:
    """Parse weights such as "20,50,100@4": numbers in `unit` (gf or n), @ and millimetres of another radius.

    Raises ValueError for other text.
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
                f"{part!r}: a weight is a number above 0, such as 50, or 50@4 on a foot of 4 mm radius"
            )
        name = f"{value:g} {'N' if unit == 'n' else 'gf'}" + (f" on {mm:g} mm" if at else "")
        weights.append(Weight(value * (1.0 if unit == "n" else GRAM_FORCE_N), mm * 1e-3, name))
    if not weights:
        raise ValueError("no weight is given; an example: 20,50,100,200,500")
    return weights


def measurement_order(weights: Sequence[Weight], repeats: int) -> list[Weight]:
    """Return all weights, up and down alternately, so that drift isn't taken for a law."""
    rising = sorted(weights, key=lambda weight: (weight.radius_m, weight.force_n))
    return [weight for turn in range(repeats) for weight in (rising if turn % 2 == 0 else rising[::-1])]


@dataclass(frozen=True)
class WeightReading:
    """Reading of one weight: mean total current [A] once settled, and standard deviation of the mean.

    position_m: arc lengths on the pad from electrodes x0 and y0. reported_force_n: force that the daemon
    published, NaN without one.
    """

    weight: Weight
    current_a: float
    current_std_a: float
    samples: int
    position_m: tuple[float, float]
    reported_force_n: float = math.nan


@dataclass(frozen=True)
class ContactCircuit:
    """Circuit of one contact: potential [V], spreading radius [m], std of its ln, resistors' part [ohm]."""

    drive_v: float
    spreading_m: float
    spreading_log_std: float
    series_ohm: float


class PadCircuitModel:
    """Circuit at positions of one pad, by the deployment file."""

    def __init__(self, deployment: config.Deployment, pad: config.Pad) -> None:
        self.pad = pad
        self.node, self.sheet = deployment.nodes[pad.node], deployment.sheets[pad.sheet]
        self._surface: Surface = pad_surface(pad)
        self._network: ElectrodeNetwork = pad_network(pad, self.sheet)

    def circuit_at(self, position_m: tuple[float, float], std_m: float = 0.0) -> ContactCircuit:
        """Return the circuit at arc lengths (x, y) from x0 and y0; std_m: standard deviation of the
        position."""
        x, y, scale = self._to_rectangle(position_m)
        radius, series = self._network.spreading_radius(x, y) * scale, self._network.series_resistance(x, y)
        shifted = [
            self._to_rectangle((position_m[0] + dx, position_m[1] + dy))
            for dx, dy in ((std_m, 0.0), (0.0, std_m))
        ]
        moved = [float(np.log(self._network.spreading_radius(u, v) * s / radius)) for u, v, s in shifted]
        return ContactCircuit(self.node.drive_v, float(radius), math.hypot(*moved), float(series))

    def rejection_reason(self, position_m: tuple[float, float], current_a: float) -> str:
        """Return why a reading there can't be used; empty if it can."""
        x, y, _ = self._to_rectangle(position_m)
        aside = max(abs(x / self._surface.a - 0.5), abs(y / self._surface.b - 0.5))
        if not aside < _MAX_CENTRE_OFFSET_FRACTION:
            return "the weight is far from the middle of the pad"
        shares = self._network.fractions(x, y)
        if float(np.max(shares)) * current_a > _MAX_RANGE_FRACTION * self.node.full_scale_ma * 1e-3:
            return "a channel is at the end of its range: leave this weight out, or lower drive_v"
        return ""

    def _to_rectangle(self, position_m: tuple[float, float]) -> tuple[float, float, float]:
        """Return the rectangle's (x, y), and metres on the surface per unit of the rectangle."""
        x, y = self._surface.to_rectangle(*position_m)
        return float(x), float(y), float(self._surface.scale(x, y))
