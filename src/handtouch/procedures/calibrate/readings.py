"""Known weights, readings of them, the circuit around each contact, and what the sheet's behaviour leaves.

Public names: `Weight`, `parse_weights`, `measurement_order`, `WeightReading`, `ContactCircuit`,
`PadCircuitModel`, `with_responses`. The core compensates creep, adaptation and hysteresis in every force, so
a law is fitted to the loads that it takes for uncompensated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from handtouch import config
from handtouch.config.roles import SECOND_SHEET, channel_numbers
from handtouch.core.pad_model import channel_ampere_per_count
from handtouch.core.sheet_force import sheet_behaviour_of
from handtouch.field import Surface
from handtouch.field.model import ChannelModel
from handtouch.hand import pad_channels, pad_surface
from handtouch.host.units import GRAM_FORCE_N
from handtouch.sheet import Fluctuation

_MAX_CENTRE_OFFSET_FRACTION = 0.3
"""Distance from the middle over a side: farther out, the sheet's resistance changes quickly."""
_MAX_RANGE_FRACTION = 0.98  # fraction of a channel's range


@dataclass(frozen=True)
class Weight:
    """Known load: force [N], radius of its foot [m], and name, as "50 gf"; std_n: of the force."""

    force_n: float
    radius_m: float
    name: str
    std_n: float = 0.0


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
    published, NaN without one. second_current_a, second_std_a: the same of the pad's second sheet, NaN
    without one. unloaded_s, loaded_s, measured_s: times of one clock at which the pad was unloaded before,
    at which the weight came, and of the mean's middle, NaN where unknown. response: reading over load by the
    sheet's behaviour.
    """

    weight: Weight
    current_a: float
    current_std_a: float
    samples: int
    position_m: tuple[float, float]
    reported_force_n: float = math.nan
    second_current_a: float = math.nan
    second_std_a: float = math.nan
    unloaded_s: float = math.nan
    loaded_s: float = math.nan
    measured_s: float = math.nan
    response: float = 1.0

    @property
    def apparent_n(self) -> float:
        """Return the force that the sheet's reading stands for: the core compensates it to the weight's."""
        return self.weight.force_n * self.response

    @property
    def of_second(self) -> WeightReading:
        """Return the reading of the second sheet as one of the first."""
        return replace(self, current_a=self.second_current_a, current_std_a=self.second_std_a)


@dataclass(frozen=True)
class ContactCircuit:
    """Circuit of one contact: potential [V], spreading radius [m], std of its ln, resistors' part [ohm]."""

    drive_v: float
    spreading_m: float
    spreading_log_std: float
    series_ohm: float


class PadCircuitModel:
    """Circuit at positions of one pad, by the deployment file.

    second_sheet: with the current per count of its channel, None without one.
    """

    def __init__(self, deployment: config.Deployment, pad: config.Pad) -> None:
        self.pad = pad
        self.node, self.sheet = deployment.nodes[pad.node], deployment.sheet_of(pad)
        self._surface: Surface = pad_surface(pad)
        self._network: ChannelModel = pad_channels(pad, self.sheet, self.node)
        self.second_sheet = deployment.sheets[pad.second_sheet] if pad.second_sheet else None
        self.second_ampere_per_count: float | None = None
        if self.second_sheet is not None:
            (number,) = channel_numbers(pad, SECOND_SHEET)
            self.second_ampere_per_count = channel_ampere_per_count(self.node, number)

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

    def rejection_reason(self, reading: WeightReading) -> str:
        """Return why a reading can't be used; empty if it can."""
        x, y, _ = self._to_rectangle(reading.position_m)
        aside = max(abs(x / self._surface.a - 0.5), abs(y / self._surface.b - 0.5))
        if not aside < _MAX_CENTRE_OFFSET_FRACTION:
            return "the weight is far from the middle of the pad"
        shares = self._network.fractions(x, y)
        greatest = max(float(np.max(shares)) * reading.current_a, reading.second_current_a)
        if greatest > _MAX_RANGE_FRACTION * self.node.full_scale_ma * 1e-3:
            return "a channel is at the end of its range: leave this weight out, or lower drive_v"
        return ""

    def _to_rectangle(self, position_m: tuple[float, float]) -> tuple[float, float, float]:
        """Return the rectangle's (x, y), and metres on the surface per unit of the rectangle."""
        x, y = self._surface.to_rectangle(*position_m)
        return float(x), float(y), float(self._surface.scale(x, y))


_MIN_RESPONSE = 0.1  # of a sheet that passed current, whatever its model


def with_responses(sheet: config.Sheet, readings: Sequence[WeightReading]) -> list[WeightReading]:
    """Return consecutive readings of a sheet with its responses by the behaviour that its table states.

    The sheet is fresh at first; each weight stays until the pad is unloaded before the next one. Without
    behaviour, or times, the readings are returned as they are.
    """
    known = all(math.isfinite(reading.unloaded_s) for reading in readings)
    if sheet.behaviour is None or not known:
        return list(readings)
    steady = replace(sheet_behaviour_of(sheet.behaviour).model, fluctuation=Fluctuation())
    state, made = steady.initial_state(1), list[WeightReading]()
    for reading in readings:
        if made:
            weight_n, measured_s = made[-1].weight.force_n, made[-1].measured_s
            steady.discretise(max(reading.unloaded_s - measured_s, 0.0)).forward(state, weight_n)
        steady.discretise(max(reading.loaded_s - reading.unloaded_s, 0.0)).forward(state, 0.0)
        step = steady.discretise(reading.measured_s - reading.loaded_s)
        (apparent_n,) = step.forward(state, reading.weight.force_n)
        made.append(replace(reading, response=max(apparent_n / reading.weight.force_n, _MIN_RESPONSE)))
    return made
