"""MuJoCo model of a deployment's hand and an object: bodies of the URDF, with pads at their true mounting.

Public names: `MujocoScene`, `MujocoPad`; `hand_spec`, `Motor`, `add_motors`, `set_solver_options`,
`quaternion`, of which other scenes are made. MuJoCo reads the URDF itself; each pad's surface is a geom of
the same shape, a skin on the link's body. Parts of the hand don't collide with each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.hand.pads import rotation_from_rpy
from handtouch.simulate.grasp.grasp_objects import GraspObject
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.worlds import DrawnWorld

TIME_STEP_S = 1e-3
_SKIN_THICKNESS_M = 1.5e-3  # URDF bodies are shrunk by this, so that objects touch the pads
_PLATE_HALF_THICKNESS_M = 2e-3
_CIRCLE_VERTICES = 96  # vertices of a frustum's circles
HAND_COLLISION_BIT, OBJECT_COLLISION_BIT = 1, 2
_CONTACT_TIME_CONSTANT_S = 5e-3  # soft contact, as of a skin
_GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class Motor:
    """Position-controlled motor of a joint, and the joint that it drives."""

    stiffness_nm: float
    damping_nm_s: float
    max_torque_nm: float
    armature_kg_m2: float
    joint_damping_nm_s: float


_MOTOR = Motor(
    stiffness_nm=1.5, damping_nm_s=0.03, max_torque_nm=np.inf, armature_kg_m2=1e-4, joint_damping_nm_s=0.005
)
"""Of a grasp; the object states the torque"""


@dataclass(frozen=True)
class MujocoPad:
    """Pad of the model."""

    link: str
    body_id: int
    rotation: FloatArray
    """(3, 3), true orientation of the pad's frame in its link's frame."""
    translation_m: FloatArray
    shape: SimulatedSurface


class MujocoScene:
    """MuJoCo model and data of a scene, at its start.

    `joints` and `pads` are in the order of URDF and deployment. Raises ValueError for an unfit hand.
    """

    def __init__(self, hand: config.HandTable, world: DrawnWorld, grasp_object: GraspObject) -> None:
        import mujoco

        self.grasp_object = grasp_object
        spec, self.joints = hand_spec(hand, world, grasp_object.friction)
        if not any(name.endswith(f"_{end}") for name in self.joints for end in grasp_object.closed_deg):
            ends = ", ".join(f"_{end}" for end in grasp_object.closed_deg)
            has = ", ".join(self.joints)
            raise ValueError(f'hand "{hand.name}" can\'t grasp: no joint ends in {ends}; its joints: {has}')
        mounts = {pad.link: world.mount(hand.name, pad) for pad in hand.pads}
        shapes = {pad.link: world.surface(hand.name, pad) for pad in hand.pads}
        add_motors(mujoco, spec, self.joints, replace(_MOTOR, max_torque_nm=grasp_object.max_torque_nm))
        set_solver_options(mujoco, spec)
        hand_only = spec.compile()
        data = mujoco.MjData(hand_only)
        mujoco.mj_forward(hand_only, data)
        palm = hand_only.body(hand.palm_link or hand_only.body(1).name).id
        palm_rotation, palm_m = data.xmat[palm].reshape(3, 3), data.xpos[palm]
        spec.option.gravity = palm_rotation @ [0.0, 0.0, -_GRAVITY_M_S2]  # the palm faces up
        _add_object(mujoco, spec, grasp_object, palm_rotation, palm_m)
        self.model: Any = spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.palm_body = palm
        self.object_body: int = self.model.body("object").id
        self.pads = tuple(
            MujocoPad(
                pad.link,
                self.model.body(pad.mount.link or pad.link).id,
                *mounts[pad.link],
                shapes[pad.link],
            )
            for pad in hand.pads
        )
        self.joint_qpos = np.array([self.model.joint(name).qposadr[0] for name in self.joints])
        self.pad_row_by_geom = {
            self.model.geom(f"pad {pad.link}").id: row for row, pad in enumerate(hand.pads)
        }
        """Row of the pad by MuJoCo's geom id."""
        self.palm_rotation, self.palm_m = palm_rotation.copy(), palm_m.copy()

    def to_palm(self, points_m: FloatArray) -> FloatArray:
        """Transform points (n, 3) from the world's frame to that of the palm, which is fixed."""
        return np.asarray((points_m - self.palm_m) @ self.palm_rotation)


def hand_spec(hand: config.HandTable, world: DrawnWorld, friction: float) -> tuple[Any, tuple[str, ...]]:
    """Return an MjSpec of a hand with its pads, which touch only objects, and the names of its joints.

    Raises ValueError for a hand without URDF.
    """
    import mujoco

    if not hand.urdf:
        raise ValueError(f'hand "{hand.name}" has no URDF, which a grasp needs: set urdf in [[hand]]')
    spec: Any = mujoco.MjSpec.from_file(str(Path(hand.urdf)))
    spec.compiler.fusestatic = False
    for geom in spec.geoms:
        _shrink_geom(mujoco, geom)
    for pad in hand.pads:
        body = spec.body(pad.mount.link or pad.link)
        _add_pad(mujoco, spec, body, pad, world.surface(hand.name, pad), *world.mount(hand.name, pad))
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = HAND_COLLISION_BIT, OBJECT_COLLISION_BIT
        geom.friction[0], geom.condim, geom.solref = friction, 4, [_CONTACT_TIME_CONSTANT_S, 1.0]
    return spec, tuple(joint.name for joint in spec.joints)


def _shrink_geom(mujoco: Any, geom: Any) -> None:
    if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
        geom.size = np.asarray(geom.size) - _SKIN_THICKNESS_M
    else:
        geom.size[0] -= _SKIN_THICKNESS_M


def _add_pad(
    mujoco: Any,
    spec: Any,
    body: Any,
    pad: config.Pad,
    shape: SimulatedSurface,
    rotation: FloatArray,
    translation: FloatArray,
) -> None:
    geom = body.add_geom(name=f"pad {pad.link}", density=0.0)
    if make := _GEOMS.get(pad.surface.kind):
        depth_m, turn = make(mujoco, geom, shape)
    else:
        depth_m, turn = 0.0, np.eye(3)
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, geom.name
        spec.add_mesh(name=geom.name, uservert=np.ravel(shape.hull_points()))
    geom.pos = translation - depth_m * rotation[:, 2]
    geom.quat = quaternion(mujoco, rotation @ turn)


def _box(mujoco: Any, geom: Any, shape: SimulatedSurface) -> tuple[float, FloatArray]:
    geom.type = mujoco.mjtGeom.mjGEOM_BOX
    geom.size = [shape.length_m / 2, shape.arc / 2, _PLATE_HALF_THICKNESS_M]
    return _PLATE_HALF_THICKNESS_M, np.eye(3)


def _cylinder(mujoco: Any, geom: Any, shape: SimulatedSurface) -> tuple[float, FloatArray]:
    geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
    geom.size = [shape.start_radius_m, shape.length_m / 2, 0.0]
    return shape.start_radius_m, rotation_from_rpy([0.0, np.pi / 2, 0.0])


def _sphere(mujoco: Any, geom: Any, shape: SimulatedSurface) -> tuple[float, FloatArray]:
    geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
    geom.size = [shape.start_radius_m, 0.0, 0.0]
    return shape.start_radius_m, np.eye(3)


_GEOMS = {"plane": _box, "cylinder": _cylinder, "sphere": _sphere}
"""Functions for kinds of surface under which MuJoCo has a geom; any other is a mesh.

They set type and size, and return the depth [m] of the geom's centre below that of the pad, and the geom's
orientation (3, 3) in the pad's frame.
"""


def _add_object(
    mujoco: Any, spec: Any, grasped: GraspObject, palm_rotation: FloatArray, palm_m: FloatArray
) -> None:
    """Add the object, free to move, and a holder that can hold it."""
    pose = {
        "pos": palm_m + palm_rotation @ grasped.position_m,
        "quat": quaternion(mujoco, palm_rotation @ rotation_from_rpy(np.radians(grasped.rpy_deg))),
    }
    body = spec.worldbody.add_body(name="object", **pose)
    body.add_freejoint()
    geom = _add_object_geom(body, grasped, "object")
    geom.mass = grasped.mass_kg
    if grasped.kind == "bolt":
        radius, half_m, head_radius, half_head_m = grasped.size_m
        geom.type, geom.mass = mujoco.mjtGeom.mjGEOM_CYLINDER, grasped.mass_kg / 2
        geom.size[:2], geom.pos = (radius, half_m), [0.0, 0.0, half_head_m]
        head = _add_object_geom(body, grasped, "head")
        head.type, head.mass = mujoco.mjtGeom.mjGEOM_CYLINDER, grasped.mass_kg / 2
        head.size[:2], head.pos = (head_radius, half_head_m), [0.0, 0.0, -half_m]
    elif grasped.kind == "frustum":
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, "object"
        around = 2 * np.pi * np.arange(_CIRCLE_VERTICES) / _CIRCLE_VERTICES
        low, high, half_m = grasped.size_m
        rings = [
            (r * np.cos(a), r * np.sin(a), z) for r, z in ((low, -half_m), (high, half_m)) for a in around
        ]
        spec.add_mesh(name="object", uservert=np.ravel(rings))
    else:
        geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{grasped.kind.upper()}")
        geom.size[: len(grasped.size_m)] = grasped.size_m
    spec.worldbody.add_body(name="holder", mocap=True, **pose)
    held = spec.add_equality(
        name="held",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="holder",
        name2="object",
    )
    held.data[:11] = [0.0] * 10 + [1.0]  # centres coincide; the last is the weight of the rotation


def _add_object_geom(body: Any, grasped: GraspObject, name: str) -> Any:
    geom = body.add_geom(name=name)
    geom.contype, geom.conaffinity, geom.friction[0] = (
        OBJECT_COLLISION_BIT,
        HAND_COLLISION_BIT,
        grasped.friction,
    )
    geom.condim = 4
    return geom


def add_motors(mujoco: Any, spec: Any, joints: Sequence[str], motor: Motor) -> None:
    """Add a position-controlled motor with limited torque to every joint."""
    for name in joints:
        joint = spec.joint(name)
        joint.armature, joint.damping[0] = motor.armature_kg_m2, motor.joint_damping_nm_s
        made = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        made.gaintype, made.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        made.gainprm[0] = motor.stiffness_nm
        made.biasprm[1], made.biasprm[2] = -motor.stiffness_nm, -motor.damping_nm_s
        made.forcelimited, made.forcerange = True, [-motor.max_torque_nm, motor.max_torque_nm]


def set_solver_options(mujoco: Any, spec: Any) -> None:
    """Set time step and solver as hands that touch need them."""
    spec.option.timestep = TIME_STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10


def quaternion(mujoco: Any, rotation: FloatArray) -> FloatArray:
    """Return the quaternion (4,) of a rotation (3, 3), in MuJoCo's order."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return quat
