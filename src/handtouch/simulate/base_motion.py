"""What presses on the sheets of a simulated hand without a touch: its skin's weight, while its base turns.

Public names: `Skin` (`[skin]`) and `BaseTurn` (`[[turn]]`) of a scenario, `base_rotation`, `gravity_in_base`,
`base_pose`, `axis_rotations`. `simulate.skin` computes the currents.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation

from handtouch.arrays import FloatArray
from handtouch.config.base import Positive, Table, Vector3


class Skin(Table):
    """`[skin]`: skin and drive plate that lie on the sheets, and press on them by weight and acceleration."""

    g_per_cm2: Positive = Field(
        description="mass per area; 2.5 mm of silicone have 0.28, half a millimetre of copper has 0.45",
        examples=[0.7],
    )


class BaseTurn(Table):
    """`[[turn]]`: the hand's base turns at a constant speed, as on an arm; turns add up."""

    from_s: float = Field(0.0, ge=0, description="begin, in seconds since the start of the scenario")
    duration_s: Positive = Field(description="duration of the turn")
    axis: Vector3 = Field(description="axis through the origin of the base, in its frame at the start")
    rev_s: float = Field(description="revolutions per second, right-handed", examples=[1.0])
    ramp_s: Positive = Field(
        0.5, description="time in which the speed is reached, and lost at the end; at most half of the turn"
    )
    gravity_sent: bool = Field(
        True,
        description="joint states carry gravity in the base's frame, and its orientation",
    )

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, axis: Vector3) -> Vector3:
        if not any(axis):
            raise ValueError("must not be zero")
        return axis

    def rotation(self, times_s: FloatArray) -> FloatArray:
        """Return the rotation (n, 3, 3) at times (n,)."""
        ramp = min(self.ramp_s, self.duration_s / 2)
        passed = np.clip(times_s - self.from_s, 0.0, self.duration_s)
        left = self.duration_s - passed
        at_speed = np.maximum(passed - ramp / 2, np.square(np.minimum(passed, ramp)) / (2 * ramp))
        ending = self.duration_s - ramp - np.square(np.minimum(left, ramp)) / (2 * ramp)
        full = np.where(left < ramp, ending, at_speed)  # time at full speed that turns as far
        return axis_rotations(np.array(self.axis), 2 * math.pi * self.rev_s * full)


def base_rotation(turns: Sequence[BaseTurn], times_s: FloatArray) -> FloatArray:
    """Return the rotation (n, 3, 3) of the base from its frame to that at the start, later turns last."""
    rotation = np.broadcast_to(np.eye(3), (len(times_s), 3, 3))
    for turn in turns:
        rotation = turn.rotation(times_s) @ rotation
    return rotation


def gravity_in_base(
    turns: Sequence[BaseTurn], gravity: Sequence[float], t_s: float
) -> tuple[float, float, float] | None:
    """Return the direction of gravity in the base's frame at a time, `gravity` at the start; None if joint
    states don't carry it."""
    if not any(turn.gravity_sent for turn in turns):
        return None
    x, y, z = (base_rotation(turns, np.array([t_s]))[0].T @ gravity).tolist()
    return x, y, z


def base_pose(
    turns: Sequence[BaseTurn], gravity: Sequence[float], t_s: float
) -> dict[str, tuple[float, ...]]:
    """Return what joint states carry of the base's pose at a time: `gravity_in_base`, and the quaternion x,
    y, z, w of its frame in that at the start."""
    down = gravity_in_base(turns, gravity, t_s)
    if down is None:
        return {}
    quaternion = Rotation.from_matrix(base_rotation(turns, np.array([t_s]))[0]).as_quat()
    return {"gravity": down, "orientation": tuple(quaternion.tolist())}


def axis_rotations(axis: FloatArray, angles: FloatArray) -> FloatArray:
    """Return the rotations (n, 3, 3) about an axis (3,) of any length by angles (n,)."""
    x, y, z = (axis / np.linalg.norm(axis)).tolist()
    crossed = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, versine = np.sin(angles)[:, None, None], 1 - np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sine * crossed + versine * (crossed @ crossed))
