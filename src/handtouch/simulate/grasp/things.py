"""What the hand can grasp: a ball, a box, a pen, a cup; where it is held out, how it is pulled off.

Public names: `Thing`, `THINGS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Thing:
    """A rigid body in the frame of the palm."""

    name: str
    kind: str
    """sphere (radius), box (half sides), cylinder (radius, half length), frustum (both radii, half length)"""
    size_m: tuple[float, ...]
    mass_kg: float
    place_m: Vector
    """of its middle, where it is held out"""
    rpy_deg: Vector
    pull: Vector
    """direction in which it is pulled off; unit"""
    closed_deg: Mapping[str, float]
    """how far joints close, by the end of their names; what stops them is the thing"""
    torque_nm: float = 0.05
    """of each joint at most, while it holds"""
    friction: float = 0.8

    @property
    def curvature(self) -> float:
        """Mean curvature [1/m] of its side; 0 where it is flat."""
        if self.kind == "box":
            return 0.0
        if self.kind == "sphere":
            return 1 / self.size_m[0]
        radii = self.size_m[:1] if self.kind == "cylinder" else self.size_m[:2]
        return 0.5 / float(np.mean(radii))

    def drawn(self, seed: int) -> Thing:
        """Another of its kind: a little larger or smaller, elsewhere, turned, smoother or rougher."""
        rng = np.random.default_rng((seed, sum(map(ord, self.name))))
        scale = float(np.exp(0.03 * rng.normal()))
        off_m, turned_deg = 2e-3 * rng.normal(size=3), 4.0 * rng.normal(size=3)
        return replace(
            self,
            size_m=tuple(scale * size for size in self.size_m),
            mass_kg=self.mass_kg * float(np.exp(0.1 * rng.normal())),
            place_m=_vector(np.array(self.place_m) + np.append(off_m[:2], abs(off_m[2]))),
            rpy_deg=_vector(np.array(self.rpy_deg) + turned_deg),
            torque_nm=self.torque_nm * float(np.exp(0.15 * rng.normal())),
            friction=float(rng.uniform(0.6, 1.0)),
        )


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


_FIST = {"mcp": 85.0, "pip": 80.0, "dip": 50.0, "cmc": 60.0, "ip": 45.0}
_HOOK = {"mcp": 91.0, "pip": 97.0, "dip": 80.0}  # the thumb would push it away
THINGS: Mapping[str, Thing] = MappingProxyType(
    {
        thing.name: thing
        for thing in (
            Thing("ball", "sphere", (0.030,), 0.08, (0.066, 0.0, 0.046), (0, 0, 0), (0, 0.94, 0.34), _FIST),
            Thing(
                "box", "box", (0.020, 0.050, 0.015), 0.12, (0.076, 0.0, 0.031), (0, 0, 0), (0, 1, 0), _FIST
            ),
            Thing("pen", "cylinder", (0.006, 0.075), 0.02, (0.073, 0.0, 0.022), (90, 0, 0), (0, 1, 0), _HOOK),
            Thing(
                "cup",
                "frustum",
                (0.026, 0.032, 0.05),
                0.10,
                (0.066, 0.0, 0.048),
                (90, 0, 0),
                (0, 1, 0),
                _FIST,
                0.06,
            ),
        )
    }
)
"""By name."""
