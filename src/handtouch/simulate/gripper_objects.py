"""Compliant objects for the simulated gripper, integrated in steps of time.

Public names: `SoftBlock`, `CurvedEdge`, `FingertipPositions`, `FingertipContact`, `GRIPPER_OBJECTS`.
Metres, newton, seconds, in the base's frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from handtouch.arrays import FloatArray

_SEARCH_POINTS = 40  # points of the curve on either side of the last contact


class FingertipPositions(NamedTuple):
    """Positions of the fingertips."""

    x_m: float
    z_m: float
    thumb_y_m: float
    """Position of the thumb's plate, which faces +y."""
    index_y_m: float
    """Position of the foremost point of the index finger's round tip, which faces -y."""
    index_radius_m: float


class FingertipContact(NamedTuple):
    """Contact of the object with a fingertip."""

    finger: str
    offset: tuple[float, float]
    """Along x and z: from the centre of the thumb's plate [m]; on the index tip the sines of the angles."""
    force_n: float


@dataclass
class _ViscoelasticSpring:
    """Standard linear solid: under constant indentation d the force relaxes from (k0 + k1) d to k0 d."""

    equilibrium_stiffness_n_m: float
    relaxing_stiffness_n_m: float
    relax_s: float
    _crept_m: float = 0.0

    @property
    def instantaneous_stiffness_n_m(self) -> float:
        """Stiffness against a fast indentation."""
        return self.equilibrium_stiffness_n_m + self.relaxing_stiffness_n_m

    @property
    def relaxed_force_n(self) -> float:
        """Force lost by creep."""
        return self.relaxing_stiffness_n_m * self._crept_m

    def force_n(self, depth: float) -> float:
        """Return the force at an indentation depth; 0 without contact."""
        return max(self.instantaneous_stiffness_n_m * depth - self.relaxed_force_n, 0.0) if depth > 0 else 0.0

    def advance(self, dt_s: float, depth: float) -> None:
        """Creep towards the indentation depth."""
        self._crept_m += (max(depth, 0.0) - self._crept_m) * (1 - math.exp(-dt_s / self.relax_s))


@dataclass
class SoftBlock:
    """Soft block between the fingers, with a small bead under the thumb, on a stand compliant along y.

    Friction, mu times both forces, resists a pull; the excess moves the block at a proportional speed,
    without inertia. The block is lost when the bead has left the thumb's plate.
    """

    width_m: float = 0.04
    equilibrium_stiffness_n_m: float = 1500.0
    relaxing_stiffness_n_m: float = 500.0
    relax_s: float = 1.0
    stand_stiffness_n_m: float = 2000.0
    friction: float = 0.5
    drag_n_s_m: float = 20.0
    plate_m: float = 0.012
    """Largest distance of the bead from the centre of the plate."""
    _springs: tuple[_ViscoelasticSpring, _ViscoelasticSpring] = field(init=False)
    _slipped_m: float = field(default=0.0, init=False)
    _pull_n: float = field(default=0.0, init=False)
    _forces_n: tuple[float, float] = field(default=(0.0, 0.0), init=False)
    _depths_m: tuple[float, float] = field(default=(0.0, 0.0), init=False)

    def __post_init__(self) -> None:
        if min(self.relax_s, self.drag_n_s_m, self.equilibrium_stiffness_n_m) <= 0:
            raise ValueError("relax_s, drag_n_s_m and equilibrium_stiffness_n_m of a block must be above 0")
        self._springs = (self._new_spring(), self._new_spring())

    def advance(self, dt_s: float, tips: FingertipPositions) -> list[FingertipContact]:
        """Balance the forces of both fingers and the stand, then creep and slip."""
        bead = self._slipped_m - tips.x_m
        if abs(bead) > self.plate_m:
            self._forces_n = self._depths_m = (0.0, 0.0)
            return []
        thumb, index = self._springs
        undeflected = self.width_m / 2 + tips.thumb_y_m, self.width_m / 2 - tips.index_y_m
        y = self._equilibrium_y_m(*undeflected)
        self._depths_m = undeflected[0] - y, undeflected[1] + y
        self._forces_n = thumb.force_n(self._depths_m[0]), index.force_n(self._depths_m[1])
        thumb.advance(dt_s, self._depths_m[0])
        index.advance(dt_s, self._depths_m[1])
        excess_n = abs(self._pull_n) - self.friction * sum(self._forces_n)
        if excess_n > 0:
            self._slipped_m += math.copysign(excess_n / self.drag_n_s_m * dt_s, self._pull_n)
        offsets = (bead, 0.0), (0.0, 0.0)
        return [
            FingertipContact(finger, offset, force_n)
            for finger, offset, force_n in zip(("thumb", "index"), offsets, self._forces_n, strict=True)
            if force_n > 0
        ]

    def set_pull(self, force_n: float) -> None:
        """Set the external force along +x."""
        self._pull_n = force_n

    def truth(self) -> dict[str, float]:
        """Return forces, indentation depths and the slipped distance."""
        return {
            "thumb_force_n": self._forces_n[0],
            "index_force_n": self._forces_n[1],
            "thumb_depth_m": max(self._depths_m[0], 0.0),
            "index_depth_m": max(self._depths_m[1], 0.0),
            "slipped_m": self._slipped_m,
            "pull_n": self._pull_n,
        }

    def _new_spring(self) -> _ViscoelasticSpring:
        return _ViscoelasticSpring(self.equilibrium_stiffness_n_m, self.relaxing_stiffness_n_m, self.relax_s)

    def _equilibrium_y_m(self, thumb_depth: float, index_depth: float) -> float:
        """Return y of the block at balanced forces; the depths are those at y = 0."""
        thumb, index = self._springs
        forces_n = (
            thumb.instantaneous_stiffness_n_m * thumb_depth - thumb.relaxed_force_n,
            index.instantaneous_stiffness_n_m * index_depth - index.relaxed_force_n,
        )
        for touching in ((True, True), (True, False), (False, True)):
            net_n = touching[0] * forces_n[0] - touching[1] * forces_n[1]
            y = net_n / (sum(touching) * thumb.instantaneous_stiffness_n_m + self.stand_stiffness_n_m)
            if (thumb.force_n(thumb_depth - y) > 0, index.force_n(index_depth + y) > 0) == touching:
                return y
        return 0.0


@dataclass
class CurvedEdge:
    """Curved rim of a plate, in a plane y = const, under the round tip of the index finger."""

    y_m: float = 0.02
    amplitude_m: float = 0.008
    wavelength_m: float = 0.06
    begin_z_m: float = 0.002
    stiffness_n_m: float = 1500.0
    _curve: FloatArray = field(init=False, repr=False)
    _nearest_index: int = field(default=0, init=False)
    _offset_m: float = field(default=0.0, init=False)
    _along_m: float = field(default=0.0, init=False)
    _force_n: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        if self.wavelength_m <= 0:
            raise ValueError("wavelength_m of an edge must be above 0")
        x = np.linspace(-0.02, 0.12, 2801)
        z = self.begin_z_m + self.amplitude_m / 2 * (1 - np.cos(2 * math.pi * x / self.wavelength_m))
        self._curve = np.stack([x, z], axis=1)

    def advance(self, dt_s: float, tips: FingertipPositions) -> list[FingertipContact]:  # noqa: ARG002
        """Compute the contact, which is where the edge is nearest to the tip's centre."""
        x, z = self._nearest_point(tips.x_m, tips.z_m)
        away_x, away_z, radius = x - tips.x_m, z - tips.z_m, tips.index_radius_m
        gap = tips.index_y_m + radius - self.y_m
        distance = math.hypot(away_x, away_z, gap)
        self._offset_m, self._along_m = math.hypot(away_x, away_z), x
        self._force_n = self.stiffness_n_m * max(radius - distance, 0.0) if gap > 0 else 0.0
        if self._force_n == 0:
            return []
        return [FingertipContact("index", (away_x / distance, away_z / distance), self._force_n)]

    def set_pull(self, force_n: float) -> None:
        """Ignore the force: the plate is fixed."""

    def truth(self) -> dict[str, float]:
        """Return the force, the edge's distance from the centre of the tip, and its position along x."""
        return {"index_force_n": self._force_n, "offset_m": self._offset_m, "along_m": self._along_m}

    def _nearest_point(self, x: float, z: float) -> tuple[float, float]:
        low = max(self._nearest_index - _SEARCH_POINTS, 0)  # near the last contact
        index = low + self._closest_index(x, z, slice(low, self._nearest_index + _SEARCH_POINTS))
        if not low < index < self._nearest_index + _SEARCH_POINTS - 1:
            index = self._closest_index(x, z, slice(None))
        self._nearest_index = index = min(max(index, 1), len(self._curve) - 2)
        begin, end = self._curve[index - 1], self._curve[index + 1]  # chord about the nearest point
        chord = end - begin
        fraction = min(max(float((np.array((x, z)) - begin) @ chord / (chord @ chord)), 0.0), 1.0)
        nearest = begin + fraction * chord
        return float(nearest[0]), float(nearest[1])

    def _closest_index(self, x: float, z: float, part: slice) -> int:
        offset = self._curve[part] - (x, z)
        return int(np.argmin(np.einsum("ij,ij->i", offset, offset)))


GRIPPER_OBJECTS: dict[str, type[SoftBlock] | type[CurvedEdge]] = {"block": SoftBlock, "edge": CurvedEdge}
"""By their names in requests."""
