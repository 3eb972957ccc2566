"""Hidden quantities of shear pads: their distributions, and those of one pad.

Public names: `ShearSpread`, `HiddenShear`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from handtouch.arrays import FloatArray
from handtouch.config.shear import Discs, Shear
from handtouch.simulate.worlds.distributions import Distribution, Fixed

_ZERO, _ONE = Fixed(0.0), Fixed(1.0)


@dataclass(frozen=True)
class ShearSpread:
    """Parts of each shear pad. Ratios and offsets are to configured values."""

    stiffness_ratio: Distribution = _ONE
    """Tangential stiffness of the layer, both axes."""
    axis_ratio: Distribution = _ONE
    """Tangential stiffness of each axis by itself."""
    plate_offset_mm: Distribution = _ZERO
    """Each component of the upper pattern's displacement at rest."""
    plate_turn_deg: Distribution = _ZERO
    """Its rotation at rest."""
    edge_offset_mm: Distribution = _ZERO
    """Each electrode's edge: the electrode is larger by it."""
    film_ratio: Distribution = _ONE
    """Thickness of the film."""
    film_ohm_ratio: Distribution = _ONE
    """Resistivity of the film."""
    contact_share: Distribution = _ZERO
    """Contact resistance between film and one pattern over the film's resistance."""
    alpha_offset: Distribution = _ZERO
    """Exponent of the film's law."""
    hysteresis: Distribution = _ZERO
    """Share of a force that each of the layer's plays holds back: the half-width of its loop over its
    greatest force, for loads along one line."""
    creep: Distribution = _ZERO
    """Displacement that creep adds to a lasting force, relative."""
    stiffening: Distribution = _ZERO
    """Relative growth of the stiffness at a shear of 0.1."""

    def describe(self, shear: Shear) -> Shear:
        """Return a table as its builder writes it: with the tolerances of his parts."""
        pattern = shear.pattern
        overlap_mm = pattern.radius_mm if isinstance(pattern, Discs) else pattern.overlap_mm
        edges = self.edge_offset_mm.std / math.sqrt(2) / overlap_mm
        common = (self.stiffness_ratio.std, self.creep.mean, self.stiffening.mean, self.hysteresis.mean)
        return shear.model_copy(
            update={
                "stiffness_std": math.hypot(*common),
                "axis_std": math.hypot(self.axis_ratio.std, edges),
                "hysteresis": self.hysteresis.mean,
            }
        )


@dataclass(frozen=True)
class HiddenShear:
    """True properties of one shear pad, named as in `ShearSpread`."""

    stiffness_ratio: float
    axis_ratio: tuple[float, float]
    plate_offset_mm: tuple[float, float]
    plate_turn_deg: float
    edge_offset_mm: tuple[float, float, float, float]
    film_ratio: float
    film_ohm_ratio: float
    contact_share: float
    alpha_offset: float
    hysteresis: float
    creep: float
    stiffening: float

    @classmethod
    def draw(
        cls, spread: ShearSpread, numbers: Callable[[Distribution, int, str], FloatArray]
    ) -> HiddenShear:
        """Draw the properties of a pad; `numbers` returns so many draws of a distribution, by its name."""
        many = {"axis_ratio": 2, "plate_offset_mm": 2, "edge_offset_mm": 4}
        drawn: dict[str, Any] = {}
        for name in cls.__dataclass_fields__:
            values = numbers(getattr(spread, name), many.get(name, 1), name).tolist()
            drawn[name] = tuple(values) if name in many else values[0]
        return cls(**drawn)
