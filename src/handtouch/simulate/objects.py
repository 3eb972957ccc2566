"""What a simulated gripper touches: soft things that push back. No clock: they are stepped.

Public names: `Block`, `Edge`, `Thing`, `Tips`, `Spot`, `OBJECTS`. Metres, newton, seconds; axes of the base.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_NEAR = 40  # points of a curve


class Tips(NamedTuple):
    """Where the fingertips are."""

    x: float
    z: float
    thumb_y: float
    """of its plate, which faces +y"""
    index_y: float
    """of the foremost point of its round tip, which faces -y"""
    index_radius: float


class Spot(NamedTuple):
    """A contact with a fingertip."""

    finger: str
    aside: tuple[float, float]
    """along x and z: from the middle of the thumb's plate [m]; on the index tip the sines of the angles"""
    force_n: float


class Thing(Protocol):
    """An object that is touched."""

    def step(self, dt_s: float, tips: Tips) -> list[Spot]:
        """Let time pass with the fingertips there; the contacts after it."""

    def pull(self, force_n: float) -> None:
        """Pull at it along +x from now on."""

    def truth(self) -> dict[str, float]:
        """What really happened to it, by name with its unit."""


@dataclass
class _Spring:
    """A standard linear solid: pressed and held, its force falls from (k0 + k1) d to k0 d."""

    lasting_n_m: float
    relaxing_n_m: float
    relax_s: float
    _crept: float = 0.0

    @property
    def stiff(self) -> float:
        """At once [N/m]."""
        return self.lasting_n_m + self.relaxing_n_m

    @property
    def relaxed_n(self) -> float:
        """What creep has taken off the force."""
        return self.relaxing_n_m * self._crept

    def force_n(self, depth: float) -> float:
        """At a depth; 0 beside it."""
        return max(self.stiff * depth - self.relaxed_n, 0.0) if depth > 0 else 0.0

    def step(self, dt_s: float, depth: float) -> None:
        """Creep towards the depth."""
        self._crept += (max(depth, 0.0) - self._crept) * (1 - math.exp(-dt_s / self.relax_s))


@dataclass
class Block:
    """A soft block between the fingers, with a small bead for the thumb, on a stand that yields along y.

    Friction holds it against a pull, mu times both forces; what is above that moves it, at a speed in
    proportion (a greasy block without inertia). When the bead has left the plate, it is gone.
    """

    width_m: float = 0.04
    lasting_n_m: float = 1500.0
    relaxing_n_m: float = 500.0
    relax_s: float = 1.0
    stand_n_m: float = 2000.0
    friction: float = 0.5
    drag_n_s_m: float = 20.0
    plate_m: float = 0.012
    """how far the bead may go from the middle of the plate"""
    _sides: tuple[_Spring, _Spring] = field(init=False)
    _slipped: float = field(default=0.0, init=False)
    _pull_n: float = field(default=0.0, init=False)
    _forces: tuple[float, float] = field(default=(0.0, 0.0), init=False)
    _depths: tuple[float, float] = field(default=(0.0, 0.0), init=False)

    def __post_init__(self) -> None:
        if min(self.relax_s, self.drag_n_s_m, self.lasting_n_m) <= 0:
            raise ValueError("relax_s, drag_n_s_m and lasting_n_m of a block must be above 0")
        self._sides = (self._side(), self._side())

    def step(self, dt_s: float, tips: Tips) -> list[Spot]:
        """Equal and opposite: the stand takes what one finger presses more than the other."""
        bead = self._slipped - tips.x
        if abs(bead) > self.plate_m:
            self._forces = self._depths = (0.0, 0.0)
            return []
        thumb, index = self._sides
        over = self.width_m / 2 + tips.thumb_y, self.width_m / 2 - tips.index_y
        y = self._moved_aside(*over)
        self._depths = over[0] - y, over[1] + y
        self._forces = thumb.force_n(self._depths[0]), index.force_n(self._depths[1])
        thumb.step(dt_s, self._depths[0])
        index.step(dt_s, self._depths[1])
        spare = abs(self._pull_n) - self.friction * sum(self._forces)
        if spare > 0:
            self._slipped += math.copysign(spare / self.drag_n_s_m * dt_s, self._pull_n)
        places = (bead, 0.0), (0.0, 0.0)
        return [
            Spot(*spot) for spot in zip(("thumb", "index"), places, self._forces, strict=True) if spot[2] > 0
        ]

    def pull(self, force_n: float) -> None:
        """Pull at it along +x."""
        self._pull_n = force_n

    def truth(self) -> dict[str, float]:
        """Forces, how deep the fingers are in it, how far it was pulled out."""
        return {
            "thumb_force_n": self._forces[0],
            "index_force_n": self._forces[1],
            "thumb_depth_m": max(self._depths[0], 0.0),
            "index_depth_m": max(self._depths[1], 0.0),
            "slipped_m": self._slipped,
            "pull_n": self._pull_n,
        }

    def _side(self) -> _Spring:
        return _Spring(self.lasting_n_m, self.relaxing_n_m, self.relax_s)

    def _moved_aside(self, thumb_over: float, index_over: float) -> float:
        """y of the block where the forces balance; over: how far each finger would be in it at y = 0."""
        thumb, index = self._sides
        pushes = thumb.stiff * thumb_over - thumb.relaxed_n, index.stiff * index_over - index.relaxed_n
        for touching in ((True, True), (True, False), (False, True)):
            push = touching[0] * pushes[0] - touching[1] * pushes[1]
            y = push / (sum(touching) * thumb.stiff + self.stand_n_m)
            if (thumb.force_n(thumb_over - y) > 0, index.force_n(index_over + y) > 0) == touching:
                return y
        return 0.0


@dataclass
class Edge:
    """The winding rim of a plate, in a plane y = const, which the round index tip presses upon."""

    y_m: float = 0.02
    amplitude_m: float = 0.008
    wave_m: float = 0.06
    begin_z_m: float = 0.002
    stiffness_n_m: float = 1500.0
    _curve: FloatArray = field(init=False, repr=False)
    _at: int = field(default=0, init=False)
    _aside: float = field(default=0.0, init=False)
    _along: float = field(default=0.0, init=False)
    _force: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        if self.wave_m <= 0:
            raise ValueError("wave_m of an edge must be above 0")
        x = np.linspace(-0.02, 0.12, 2801)
        z = self.begin_z_m + self.amplitude_m / 2 * (1 - np.cos(2 * math.pi * x / self.wave_m))
        self._curve = np.stack([x, z], axis=1)

    def step(self, dt_s: float, tips: Tips) -> list[Spot]:  # noqa: ARG002
        """A round tip touches an edge where the edge is nearest to its centre."""
        x, z = self._nearest(tips.x, tips.z)
        away_x, away_z, radius = x - tips.x, z - tips.z, tips.index_radius
        gap = tips.index_y + radius - self.y_m
        distance = math.hypot(away_x, away_z, gap)
        self._aside, self._along = math.hypot(away_x, away_z), x
        self._force = self.stiffness_n_m * max(radius - distance, 0.0) if gap > 0 else 0.0
        if self._force == 0:
            return []
        return [Spot("index", (away_x / distance, away_z / distance), self._force)]

    def pull(self, force_n: float) -> None:
        """It is screwed down."""

    def truth(self) -> dict[str, float]:
        """Force, how far the edge is from the middle of the tip, and where along x."""
        return {"index_force_n": self._force, "aside_m": self._aside, "along_m": self._along}

    def _nearest(self, x: float, z: float) -> tuple[float, float]:
        low = max(self._at - _NEAR, 0)  # it hasn't gone far since the last time
        at = low + self._closest(x, z, slice(low, self._at + _NEAR))
        if not low < at < self._at + _NEAR - 1:
            at = self._closest(x, z, slice(None))
        self._at = at = min(max(at, 1), len(self._curve) - 2)
        begin, end = self._curve[at - 1], self._curve[at + 1]  # the chord about the nearest point
        leg = end - begin
        part = min(max(float((np.array((x, z)) - begin) @ leg / (leg @ leg)), 0.0), 1.0)
        found = begin + part * leg
        return float(found[0]), float(found[1])

    def _closest(self, x: float, z: float, part: slice) -> int:
        away = self._curve[part] - (x, z)
        return int(np.argmin(np.einsum("ij,ij->i", away, away)))


OBJECTS: dict[str, type[Block] | type[Edge]] = {"block": Block, "edge": Edge}
"""By the name that a request has."""
