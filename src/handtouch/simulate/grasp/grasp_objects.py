"""Objects to grasp, a ball, a box, a pen and a cup, with their presentation and the direction of pulling.

Public names: `GraspObject`, `GRASP_OBJECTS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from handtouch.arrays import FloatArray

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class GraspObject:
    """A rigid body in the frame of the palm."""

    name: str
    kind: str
    """sphere (radius), box (half sides), cylinder (radius, half length), frustum (2 radii, half length),
    bolt (radius and half length of the shank, of the head), centre at half its length, head at -z."""
    size_m: tuple[float, ...]
    mass_kg: float
    position_m: Vector
    """Position of its centre where it is presented to the hand."""
    rpy_deg: Vector
    pull_direction: Vector
    """Unit vector along which it is pulled out of the hand."""
    closed_deg: Mapping[str, float]
    """Closing angles of joints, by the suffix of their names; the object stops them earlier."""
    max_torque_nm: float = 0.05
    """Maximum torque of each joint."""
    friction: float = 0.8

    @property
    def curvature(self) -> float:
        """Mean curvature [1/m] of its side; 0 if flat."""
        if self.kind == "box":
            return 0.0
        if self.kind == "sphere":
            return 1 / self.size_m[0]
        radii = self.size_m[:2] if self.kind == "frustum" else self.size_m[:1]
        return 0.5 / float(np.mean(radii))

    def randomised(self, seed: int) -> GraspObject:
        """Return a random variation in size, mass, pose, torque and friction."""
        rng = np.random.default_rng((seed, sum(map(ord, self.name))))
        scale = float(np.exp(0.03 * rng.normal()))
        offset_m, rotation_deg = 2e-3 * rng.normal(size=3), 4.0 * rng.normal(size=3)
        return replace(
            self,
            size_m=tuple(scale * size for size in self.size_m),
            mass_kg=self.mass_kg * float(np.exp(0.1 * rng.normal())),
            position_m=_vector(np.array(self.position_m) + np.append(offset_m[:2], abs(offset_m[2]))),
            rpy_deg=_vector(np.array(self.rpy_deg) + rotation_deg),
            max_torque_nm=self.max_torque_nm * float(np.exp(0.15 * rng.normal())),
            friction=float(rng.uniform(0.6, 1.0)),
        )


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


_FIST_DEG = {"mcp": 85.0, "pip": 80.0, "dip": 50.0, "cmc": 60.0, "ip": 45.0}
_HOOK_DEG = {"mcp": 91.0, "pip": 97.0, "dip": 80.0}  # the thumb would push it away
GRASP_OBJECTS: Mapping[str, GraspObject] = MappingProxyType(
    {
        it.name: it
        for it in (
            GraspObject(
                "ball", "sphere", (0.030,), 0.08, (0.066, 0.0, 0.046), (0, 0, 0), (0, 0.94, 0.34), _FIST_DEG
            ),
            GraspObject(
                "box",
                "box",
                (0.020, 0.050, 0.015),
                0.12,
                (0.076, 0.0, 0.031),
                (0, 0, 0),
                (0, 1, 0),
                _FIST_DEG,
            ),
            GraspObject(
                "pen", "cylinder", (0.006, 0.075), 0.02, (0.073, 0.0, 0.022), (90, 0, 0), (0, 1, 0), _HOOK_DEG
            ),
            GraspObject(
                name="cup",
                kind="frustum",
                size_m=(0.026, 0.032, 0.05),
                mass_kg=0.10,
                position_m=(0.066, 0.0, 0.048),
                rpy_deg=(90, 0, 0),
                pull_direction=(0, 1, 0),
                closed_deg=_FIST_DEG,
                max_torque_nm=0.06,
            ),
        )
    }
)
"""By name."""
