"""A bolt on a table, a plate with a hole, and a hand of a deployment on an arm, in MuJoCo.

The arm holds the hand's root link at a commanded pose; every joint of the hand has a position-controlled
motor. The world's frame has z up, and the table at z = 0. The bolt's frame has its origin in the middle of
its length, with z from the head to the tip. The hole's axis is horizontal, along y.

Public names: `BoltScene`, `Bolt`, `BOLTS`, `BoltStart`, `HOLE_M`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.simulate.grasp.mujoco_scene import (
    HAND_COLLISION_BIT,
    OBJECT_COLLISION_BIT,
    Motor,
    add_motors,
    hand_spec,
    quaternion,
    set_solver_options,
)
from handtouch.simulate.worlds import DrawnWorld

HOLE_M = np.array([0.0, 0.25, 0.14])
"""Centre of the hole on the near face of the plate."""
_PLATE_M, _PLATE_RADIUS_M, _WEDGES = 8e-3, 0.03, 24
_CORNERS = 48  # of the chamfer's circles
_DENSITY_KG_M3 = 7850.0
_TABLE_FRICTION, _HAND_FRICTION, _PLATE_FRICTION = 0.6, 0.9, 0.2
_STIFF = (2e-3, 1.0)  # time constant [s] and damping ratio of metal on metal
_STIFF_IMPEDANCE = (0.98, 0.999, 1e-4, 0.5, 2.0)
_ARM = (4e-3, 1.0)
_MOTOR = Motor(
    stiffness_nm=3.0, damping_nm_s=0.06, max_torque_nm=0.6, armature_kg_m2=2e-4, joint_damping_nm_s=0.01
)
_AREA_M = 0.02
"""The bolt's middle lies within this distance of the origin, along x and y."""


@dataclass(frozen=True)
class Bolt:
    """Hexagon head bolt with a chamfered tip, by default M10 x 40."""

    diameter_m: float = 10e-3
    length_m: float = 40e-3
    """of the shank"""
    head_flats_m: float = 16e-3
    head_m: float = 6.4e-3
    chamfer_m: float = 1e-3

    @property
    def total_m(self) -> float:
        """Length of shank and head."""
        return self.length_m + self.head_m


BOLTS = {
    "M8x40": Bolt(8e-3, 40e-3, 13e-3, 5.3e-3),
    "M10x40": Bolt(),
    "M12x50": Bolt(12e-3, 50e-3, 18e-3, 7.5e-3),
}
"""Sizes with the heads of ISO 4017"""


@dataclass(frozen=True)
class BoltStart:
    """Where the bolt lies on the table, and which way round."""

    x_m: float
    y_m: float
    yaw_rad: float
    """Direction from head to tip; about z, from x."""

    @classmethod
    def drawn(cls, seed: int) -> BoltStart:
        """Draw a place within 40 x 40 mm, with any yaw."""
        rng = np.random.default_rng((seed, 47))
        x, y = rng.uniform(-_AREA_M, _AREA_M, 2)
        return cls(float(x), float(y), float(rng.uniform(-np.pi, np.pi)))


class BoltScene:
    """MuJoCo model and data; `world` defines the pads' true mounting.

    `joints` are the hand's, in the order of the URDF. Set `arm` (position, rotation of the root link) and
    `target_rad`, then call `step`.
    """

    def __init__(
        self,
        hand: config.HandTable,
        world: DrawnWorld,
        start: BoltStart,
        clearance_m: float = 1e-3,
        bolt: Bolt | None = None,
    ) -> None:
        self.bolt, self.clearance_m = bolt or Bolt(), clearance_m
        spec, self.joints = hand_spec(hand, world, _HAND_FRICTION)
        root = spec.worldbody.first_body()
        root.add_freejoint().name = "flange"
        for body in spec.bodies[1:]:
            body.gravcomp = 1.0
        add_motors(mujoco, spec, self.joints, _MOTOR)
        _add_arm(spec, root.name)
        _add_table(spec)
        _add_plate(spec, self.bolt.diameter_m / 2 + clearance_m / 2)
        _add_bolt(spec, self.bolt)
        set_solver_options(mujoco, spec)
        spec.option.noslip_iterations = 3
        self.model: Any = spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        self._bolt = self.model.body("bolt").id
        self._on_bolt = self.model.geom_bodyid == self._bolt
        self._qpos = np.array([self.model.joint(name).qposadr[0] for name in self.joints])
        self.restart(start)

    def restart(self, start: BoltStart) -> None:
        """Put everything back, and the bolt onto the table; place the arm then."""
        mujoco.mj_resetData(self.model, self.data)
        self.arm = np.array([0.0, 0.0, 0.5]), np.eye(3)
        self.target_rad = np.zeros(len(self.joints))
        lying_m = np.array([start.x_m, start.y_m, self.bolt.head_flats_m / 2 + 1e-3])
        self.place_bolt(lying_m, np.array([np.cos(start.yaw_rad), np.sin(start.yaw_rad), 0.0]))

    def place_arm(self, position_m: FloatArray, rotation: FloatArray, joint_rad: FloatArray) -> None:
        """Put arm and joints somewhere at once, at the start."""
        self.arm, self.target_rad = (position_m, rotation), joint_rad.copy()
        self.data.joint("flange").qpos[:] = *position_m, *quaternion(mujoco, rotation)
        self.data.qpos[self._qpos] = joint_rad
        self._command()
        mujoco.mj_forward(self.model, self.data)

    def place_bolt(self, position_m: FloatArray, direction: FloatArray) -> None:
        """Put the bolt's middle somewhere at once, its tip in a horizontal direction."""
        down = np.array([0.0, 0.0, -1.0])
        rotation = np.column_stack([down, np.cross(direction, down), direction])
        self.data.joint("bolt").qpos[:] = *position_m, *quaternion(mujoco, rotation)
        mujoco.mj_forward(self.model, self.data)

    def step(self, count: int = 1) -> None:
        """Advance by milliseconds, under the present commands."""
        self._command()
        mujoco.mj_step(self.model, self.data, count)

    @property
    def joint_rad(self) -> FloatArray:
        """True joint positions (m,)."""
        return np.asarray(self.data.qpos[self._qpos].copy())

    @property
    def bolt_pose(self) -> tuple[FloatArray, FloatArray]:
        """True position (3,) and rotation (3, 3) of the bolt."""
        return self.data.xpos[self._bolt].copy(), self.data.xmat[self._bolt].reshape(3, 3).copy()

    @property
    def inserted_m(self) -> float:
        """How far the bolt's tip is in the hole; 0 or less if it isn't."""
        position, rotation = self.bolt_pose
        tip = position + self.bolt.total_m / 2 * rotation[:, 2]
        aside = np.hypot(*(tip - HOLE_M)[[0, 2]])
        return float(tip[1] - HOLE_M[1]) if aside < self.bolt.diameter_m / 2 else 0.0

    @property
    def hand_touches(self) -> bool:
        """True if the hand touches the bolt."""
        geom = self.data.contact.geom
        others = self.model.geom_contype[geom][self._on_bolt[geom][:, ::-1]]
        return bool((others == HAND_COLLISION_BIT).any())

    @property
    def deepest_m(self) -> float:
        """Greatest penetration of bolt and plate or table at present."""
        contact = self.data.contact
        hard = (self.model.geom_contype[contact.geom] != HAND_COLLISION_BIT).all(axis=1)
        return float(-contact.dist[hard].min(initial=0.0))

    def _command(self) -> None:
        position_m, rotation = self.arm
        self.data.mocap_pos[0], self.data.mocap_quat[0] = position_m, quaternion(mujoco, rotation)
        self.data.ctrl[:] = self.target_rad


def _add_arm(spec: Any, root: str) -> None:
    spec.worldbody.add_body(name="arm", mocap=True)
    held = spec.add_equality(
        name="flange",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="arm",
        name2=root,
        solref=_ARM,
    )
    held.data[:11] = [0.0] * 6 + [1.0] + [0.0] * 3 + [1.0]


def _add_table(spec: Any) -> None:
    table = spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.15, 0.02])
    table.pos = [0.0, 0.0, -0.02]
    _make_hard(table, _TABLE_FRICTION)
    table.contype = HAND_COLLISION_BIT | OBJECT_COLLISION_BIT
    table.conaffinity = HAND_COLLISION_BIT | OBJECT_COLLISION_BIT


def _add_plate(spec: Any, hole_radius_m: float) -> None:
    """Add a round plate with a hole of so many sides, each a convex wedge."""
    plate = spec.worldbody.add_body(name="plate", pos=HOLE_M)
    inner, outer = (r / np.cos(np.pi / _WEDGES) for r in (hole_radius_m, _PLATE_RADIUS_M))
    for number in range(_WEDGES):
        angles = 2 * np.pi * (number + np.array([0.0, 1.0])) / _WEDGES
        points = [
            (r * np.cos(a), y, r * np.sin(a)) for y in (0.0, _PLATE_M) for r in (inner, outer) for a in angles
        ]
        name = f"wedge {number}"
        spec.add_mesh(name=name, uservert=np.ravel(points))
        wedge = plate.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
        _make_hard(wedge, _PLATE_FRICTION)
        wedge.contype = wedge.conaffinity = HAND_COLLISION_BIT | OBJECT_COLLISION_BIT


def _add_bolt(spec: Any, bolt: Bolt) -> None:
    body = spec.worldbody.add_body(name="bolt")
    body.add_freejoint().name = "bolt"
    radius, half = bolt.diameter_m / 2, bolt.total_m / 2
    cylinder_m = bolt.length_m - bolt.chamfer_m
    shank = body.add_geom(name="shank", type=mujoco.mjtGeom.mjGEOM_CYLINDER)
    shank.size[:2], shank.pos = (radius, cylinder_m / 2), [0.0, 0.0, bolt.head_m - half + cylinder_m / 2]
    around = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
    rings = ((radius, half - bolt.chamfer_m), (radius - bolt.chamfer_m, half))
    _add_hull(spec, body, "chamfer", [(r * np.cos(a), r * np.sin(a), z) for r, z in rings for a in around])
    corner = bolt.head_flats_m / np.sqrt(3)
    sides = np.pi / 3 * np.arange(6) + np.pi / 6
    ends = (-half, bolt.head_m - half)
    _add_hull(spec, body, "head", [(corner * np.cos(a), corner * np.sin(a), z) for z in ends for a in sides])
    for name in ("shank", "chamfer", "head"):
        geom = spec.geom(name)
        _make_hard(geom, 0.0)
        geom.density = _DENSITY_KG_M3
        geom.contype = geom.conaffinity = OBJECT_COLLISION_BIT
        geom.condim = 4


def _add_hull(spec: Any, body: Any, name: str, points: list[tuple[float, ...]]) -> None:
    spec.add_mesh(name=name, uservert=np.ravel(points))
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def _make_hard(geom: Any, friction: float) -> None:
    """Make a geom hard, with a coefficient of friction: the greater of two bodies' holds."""
    geom.solref, geom.solimp, geom.friction[0] = _STIFF, _STIFF_IMPEDANCE, friction
    geom.condim = 4
