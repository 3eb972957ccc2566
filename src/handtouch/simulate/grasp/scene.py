"""A deployment's hand and a thing as a MuJoCo model: bodies from the URDF, pads as they really sit on them.

Public name: `Scene`. MuJoCo reads the URDF itself; what it has for each pad's surface is a sphere, cylinder,
cone or plate of that very form, a skin on the link's body. Parts of the hand don't touch one another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.hand.pads import rotation_of
from handtouch.simulate.grasp.things import Thing
from handtouch.simulate.shape import Shape, shape_of
from handtouch.simulate.world import World

FloatArray = NDArray[np.float64]
STEP_S = 1e-3
_UNDER_SKIN_M = 1.5e-3  # bodies are so much thinner than the URDF has them, so that things meet the pads
_PLATE_M = 2e-3  # half the thickness of a flat pad
_CORNERS = 96  # of a cone's circles
_HAND, _THING = 1, 2  # bits of who may touch whom
_STIFFNESS_NM, _DAMPING_NM_S = 1.5, 0.03
_SKIN_S = 5e-3  # time in which a contact settles: soft, as a skin is
_GRAVITY = 9.81


@dataclass(frozen=True)
class Pad:
    """A pad in the model."""

    link: str
    body: int
    rotation: FloatArray
    """(3, 3), of the pad's frame in its link's, as it really is"""
    translation_m: FloatArray
    shape: Shape


class Scene:
    """The model and what is where in it; `data` is at the start.

    `joints` and `pads` in the order of URDF and deployment. Raises ValueError for a hand that can't grasp.
    """

    def __init__(self, hand: config.Hand, world: World, thing: Thing) -> None:
        import mujoco

        if not hand.urdf:
            raise ValueError(f'hand "{hand.name}" has no URDF, and a grasp needs one: [[hand]] urdf')
        self.thing = thing
        spec: Any = mujoco.MjSpec.from_file(str(Path(hand.urdf)))
        spec.compiler.fusestatic = False
        self.joints = tuple(joint.name for joint in spec.joints)
        if not any(name.endswith(f"_{end}") for name in self.joints for end in thing.closed_deg):
            ends = ", ".join(f"_{end}" for end in thing.closed_deg)
            has = ", ".join(self.joints)
            raise ValueError(f'hand "{hand.name}" can\'t grasp: joints to close end in {ends}; it has {has}')
        for geom in spec.geoms:
            _thin(mujoco, geom)
        mounts = {pad.link: world.mount(hand.name, pad) for pad in hand.pads}
        for pad in hand.pads:
            _add_pad(mujoco, spec, spec.body(pad.mount.link or pad.link), pad, *mounts[pad.link])
        for geom in spec.geoms:
            geom.contype, geom.conaffinity, geom.friction[0] = _HAND, _THING, thing.friction
        _drive(mujoco, spec, self.joints, thing)
        _set(mujoco, spec)
        alone = spec.compile()
        data = mujoco.MjData(alone)
        mujoco.mj_forward(alone, data)
        palm = alone.body(hand.palm_link or alone.body(1).name).id
        palm_rotation, palm_m = data.xmat[palm].reshape(3, 3), data.xpos[palm]
        spec.option.gravity = palm_rotation @ [0.0, 0.0, -_GRAVITY]  # the palm faces up
        _add_thing(mujoco, spec, thing, palm_rotation, palm_m)
        self.model: Any = spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.palm = palm
        self.body: int = self.model.body("thing").id
        self.pads = tuple(
            Pad(
                pad.link,
                self.model.body(pad.mount.link or pad.link).id,
                *mounts[pad.link],
                shape_of(pad.surface),
            )
            for pad in hand.pads
        )
        self.q = np.array([self.model.joint(name).qposadr[0] for name in self.joints])
        self.geoms = {self.model.geom(f"pad {pad.link}").id: row for row, pad in enumerate(hand.pads)}
        """number of a geom -> row of the pad that it is"""
        self.palm_rotation, self.palm_m = palm_rotation.copy(), palm_m.copy()

    def into_palm(self, points_m: FloatArray) -> FloatArray:
        """Points (n, 3) of the world in the frame of the palm, which stands still."""
        return np.asarray((points_m - self.palm_m) @ self.palm_rotation)


def _thin(mujoco: Any, geom: Any) -> None:
    if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
        geom.size = np.asarray(geom.size) - _UNDER_SKIN_M
    else:
        geom.size[0] -= _UNDER_SKIN_M


def _add_pad(
    mujoco: Any, spec: Any, body: Any, pad: config.Pad, rotation: FloatArray, translation: FloatArray
) -> None:
    geom = body.add_geom(name=f"pad {pad.link}", density=0.0)
    shape, radius_m = shape_of(pad.surface), 0.0
    turn = rotation
    if isinstance(pad.surface, config.Plane):
        geom.type, radius_m = mujoco.mjtGeom.mjGEOM_BOX, _PLATE_M
        geom.size = [shape.length_m / 2, shape.arc / 2, _PLATE_M]
    elif isinstance(pad.surface, config.Cylinder):
        geom.type, radius_m = mujoco.mjtGeom.mjGEOM_CYLINDER, shape.start_radius_m
        geom.size = [radius_m, shape.length_m / 2, 0.0]
        turn = rotation @ rotation_of([0.0, np.pi / 2, 0.0])
    elif isinstance(pad.surface, config.Sphere):
        geom.type, radius_m = mujoco.mjtGeom.mjGEOM_SPHERE, shape.start_radius_m
        geom.size = [radius_m, 0.0, 0.0]
    else:
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        around = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
        rings = [shape.point(s, phi) for s in (0.0, shape.length_m) for phi in around]
        spec.add_mesh(name=f"pad {pad.link}", uservert=np.ravel(rings))
        geom.meshname = f"pad {pad.link}"
    geom.pos = translation - radius_m * rotation[:, 2]
    geom.quat = _quat(mujoco, turn)


def _add_thing(mujoco: Any, spec: Any, thing: Thing, palm_rotation: FloatArray, palm_m: FloatArray) -> None:
    """The thing, free to move, and somebody's hand that can hold it."""
    pose = {
        "pos": palm_m + palm_rotation @ thing.place_m,
        "quat": _quat(mujoco, palm_rotation @ rotation_of(np.radians(thing.rpy_deg))),
    }
    body = spec.worldbody.add_body(name="thing", **pose)
    body.add_freejoint()
    geom = body.add_geom(name="thing", mass=thing.mass_kg)
    geom.contype, geom.conaffinity, geom.friction[0] = _THING, _HAND, thing.friction
    geom.condim = 4
    if thing.kind == "frustum":
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, "thing"
        around = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
        low, high, half_m = thing.size_m
        rings = [
            (r * np.cos(a), r * np.sin(a), z) for r, z in ((low, -half_m), (high, half_m)) for a in around
        ]
        spec.add_mesh(name="thing", uservert=np.ravel(rings))
    else:
        geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{thing.kind.upper()}")
        geom.size[: len(thing.size_m)] = thing.size_m
    spec.worldbody.add_body(name="holder", mocap=True, **pose)
    held = spec.add_equality(
        name="held",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="holder",
        name2="thing",
    )
    held.data[:11] = [0.0] * 10 + [1.0]  # the middles together; the last is how much turning counts


def _drive(mujoco: Any, spec: Any, joints: Sequence[str], thing: Thing) -> None:
    """A motor with a position controller for every joint; its torque is what limits a grip."""
    for name in joints:
        joint = spec.joint(name)
        joint.armature, joint.damping[0] = 1e-4, 0.005
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = _STIFFNESS_NM
        motor.biasprm[1], motor.biasprm[2] = -_STIFFNESS_NM, -_DAMPING_NM_S
        motor.forcelimited, motor.forcerange = True, [-thing.torque_nm, thing.torque_nm]


def _set(mujoco: Any, spec: Any) -> None:
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    for geom in spec.geoms:
        geom.condim = 4
        geom.solref = [_SKIN_S, 1.0]


def _quat(mujoco: Any, rotation: FloatArray) -> FloatArray:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return quat
