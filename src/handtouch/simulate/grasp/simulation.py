"""Simulate a grasp in MuJoCo and record it at 1 kHz.

Public names: `simulate_grasp` -> `GraspRecord`. A holder presents the object, the hand closes, the holder
releases the object, the hand squeezes twice, the holder pulls the object out of the hand, so that it slips,
and the hand opens. The same seed gives the same grasp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray, IntArray
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS, GraspObject
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S, MujocoPad, MujocoScene
from handtouch.simulate.smoothstep import smoothstep_array
from handtouch.simulate.worlds import WORLDS, DrawnWorld

_CLOSE_START_S, _CLOSE_END_S, _RELEASE_S = 0.3, 1.4, 1.6
_SQUEEZE_STARTS_S, _SQUEEZE_DURATION_S, _SQUEEZE_TORQUE_RATIO = (2.0, 2.9), 0.7, 2.0
_PULL_START_S, _PULL_SPEED_M_S, _OPEN_START_S, DURATION_S = 3.9, 0.06, 5.9, 6.8
_MAX_PULL_M = 0.11


@dataclass(frozen=True, eq=False)
class GraspRecord:
    """Record of a grasp: n steps at 1 kHz, m joints, p pads, k contact points of all steps together."""

    grasped_object: GraspObject
    hand: str
    pads: tuple[MujocoPad, ...]
    joints: tuple[str, ...]
    times_s: FloatArray
    """(n,)."""
    joint_rad: FloatArray
    """(n, m), joint positions."""
    link_rotation: FloatArray
    """(n, p, 3, 3), orientation of the pads' links in the palm's frame."""
    link_m: FloatArray
    """(n, p, 3), their origins in the palm's frame."""
    object_m: FloatArray
    """(n, 3), centre of the object in the palm's frame."""
    object_rotation: FloatArray
    """(n, 3, 3), its orientation in the palm's frame."""
    object_velocity_m_s: FloatArray
    """(n, 3), its velocity in the palm's frame."""
    object_angular_velocity_rad_s: FloatArray
    """(n, 3), its angular velocity in the palm's frame."""
    held_externally: NDArray[np.bool_]
    """(n,), true while the holder holds the object."""
    step_index: IntArray
    """(k,), step of each contact point."""
    pad_row: IntArray
    """(k,), row of its pad; -1: on another part of the hand."""
    point_m: FloatArray
    """(k, 3), position in the palm's frame."""
    force_n: FloatArray
    """(k, 3), force on the hand in the palm's frame."""
    penetration_m: FloatArray
    """(k,), penetration depth of the two bodies."""


def simulate_grasp(
    hand: config.HandTable,
    name: str | GraspObject,
    seed: int = 1,
    world: DrawnWorld | None = None,
    *,
    duration_s: float = DURATION_S,
    watch: Callable[[MujocoScene, int], None] = lambda *_: None,
) -> GraspRecord:
    """Grasp an object, by its name if it is one of `GRASP_OBJECTS`; `world` defines the pads' true mounting.

    `watch` is called after every step, with its number. Raises KeyError for an unknown object, ValueError for
    a hand without URDF, ImportError without MuJoCo.
    """
    grasped = GRASP_OBJECTS[name] if isinstance(name, str) else name
    scene = MujocoScene(hand, world or WORLDS["ideal"].draw(seed), grasped.randomised(seed))
    controller = _GraspController(scene, seed)
    recorder = _GraspRecorder(scene, round(duration_s / TIME_STEP_S))
    for number in range(recorder.step_count):
        controller.set_controls(number * TIME_STEP_S)
        recorder.record_step(number, controller.is_holding)
        watch(scene, number)
    return recorder.build_record(hand.name)


class _GraspController:
    """Commands of the motors and the holder over time."""

    def __init__(self, scene: MujocoScene, seed: int) -> None:
        rng = np.random.default_rng((seed, 77))
        self._scene, self.is_holding = scene, True
        closed = [_by_suffix(name, scene.grasp_object.closed_deg) for name in scene.joints]
        self._closed_rad = np.radians(closed)
        digits = {name: name.split("_")[0] for name in scene.joints}
        delays_s = {digit: rng.uniform(0.0, 0.15) for digit in dict.fromkeys(digits.values())}
        self._close_starts_s = np.array([_CLOSE_START_S + delays_s[digits[name]] for name in scene.joints])
        self._start_rad = scene.data.qpos[scene.joint_qpos].copy()
        self._pull_direction = scene.palm_rotation @ np.array(scene.grasp_object.pull_direction)
        self._pull_origin_m: FloatArray | None = None

    def set_controls(self, t_s: float) -> None:
        """Set motors and holder for the step that begins at `t_s`."""
        model, data = self._scene.model, self._scene.data
        closed = smoothstep_array((t_s - self._close_starts_s) / (_CLOSE_END_S - _CLOSE_START_S)) * (
            1 - smoothstep_array((t_s - _OPEN_START_S) / 0.5)
        )
        data.ctrl[:] = self._start_rad + closed * (self._closed_rad - self._start_rad)
        squeeze = sum(
            np.sin(np.pi * np.clip((t_s - s) / _SQUEEZE_DURATION_S, 0, 1)) ** 2 for s in _SQUEEZE_STARTS_S
        )
        torque = self._scene.grasp_object.max_torque_nm * (1 + (_SQUEEZE_TORQUE_RATIO - 1) * squeeze)
        model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1] = -torque, torque
        self.is_holding = t_s < _RELEASE_S or t_s >= _PULL_START_S
        data.eq_active[0] = self.is_holding
        if t_s >= _PULL_START_S:
            if self._pull_origin_m is None:  # the holder grasps the object where it is
                self._pull_origin_m = data.xpos[self._scene.object_body].copy()
                data.mocap_quat[0] = data.xquat[self._scene.object_body]
            pulled_m = min(_PULL_SPEED_M_S * (t_s - _PULL_START_S), _MAX_PULL_M)
            data.mocap_pos[0] = self._pull_origin_m + pulled_m * self._pull_direction


class _GraspRecorder:
    """Steps the scene and records it."""

    def __init__(self, scene: MujocoScene, n: int) -> None:
        import mujoco

        self._mujoco, self._scene, self.step_count = mujoco, scene, n
        p = len(scene.pads)
        self._bodies = np.array([pad.body_id for pad in scene.pads])
        self._joint_rad = np.empty((n, len(scene.joint_qpos)))
        self._object_rotation = np.empty((n, 3, 3))
        self._rotation, self._link_m = np.empty((n, p, 3, 3)), np.empty((n, p, 3))
        self._object_m, self._object_velocity_m_s, self._object_angular_velocity_rad_s = (
            np.empty((n, 3)) for _ in range(3)
        )
        self._held_externally = np.zeros(n, np.bool_)
        self._rows: list[tuple[int, int]] = []
        self._points: list[tuple[FloatArray, FloatArray]] = []
        self._penetrations_m: list[float] = []
        self._dof = scene.model.body(scene.object_body).dofadr[0]

    def record_step(self, number: int, held: bool) -> None:
        scene, data = self._scene, self._scene.data
        self._joint_rad[number], self._held_externally[number] = data.qpos[scene.joint_qpos], held
        self._object_velocity_m_s[number] = data.qvel[self._dof : self._dof + 3]
        orientation = data.xmat[scene.object_body].reshape(
            3, 3
        )  # MuJoCo's angular velocity is in the body's frame
        self._object_angular_velocity_rad_s[number] = orientation @ data.qvel[self._dof + 3 : self._dof + 6]
        self._mujoco.mj_step(scene.model, data)
        # poses and contacts in `data` are now those of the begin of the step, as the recorded qpos
        self._rotation[number] = data.xmat[self._bodies].reshape(-1, 3, 3)
        self._link_m[number], self._object_m[number] = data.xpos[self._bodies], data.xpos[scene.object_body]
        self._object_rotation[number] = data.xmat[scene.object_body].reshape(3, 3)
        for _, row, point_m, force_n, penetration_m in hand_contacts(scene):
            self._rows.append((number, row))
            self._points.append((point_m, force_n))
            self._penetrations_m.append(penetration_m)

    def build_record(self, hand: str) -> GraspRecord:
        """Return the record, in the palm's frame."""
        scene, rotation = self._scene, self._scene.palm_rotation
        step, pad = np.array(self._rows, np.intp).reshape(-1, 2).T
        points = np.array(self._points).reshape(-1, 2, 3)
        return GraspRecord(
            grasped_object=scene.grasp_object,
            hand=hand,
            pads=scene.pads,
            joints=scene.joints,
            times_s=np.arange(self.step_count) * np.float64(TIME_STEP_S),
            joint_rad=self._joint_rad,
            link_rotation=np.asarray(rotation.T @ self._rotation, np.float64),
            link_m=scene.to_palm(self._link_m),
            object_m=scene.to_palm(self._object_m),
            object_rotation=np.asarray(rotation.T @ self._object_rotation, np.float64),
            object_velocity_m_s=self._object_velocity_m_s @ rotation,
            object_angular_velocity_rad_s=self._object_angular_velocity_rad_s @ rotation,
            held_externally=self._held_externally,
            step_index=step,
            pad_row=pad,
            point_m=scene.to_palm(points[:, 0]),
            force_n=points[:, 1] @ rotation,
            penetration_m=np.array(self._penetrations_m),
        )


def hand_contacts(scene: MujocoScene) -> list[tuple[int, int, FloatArray, FloatArray, float]]:
    """Return the contact points of hand and object after a step.

    Each is body id, row of the pad or -1, position and force on the hand, both (3,) in the world's frame, and
    penetration depth [m].
    """
    import mujoco

    model, data = scene.model, scene.data
    found, force = [], np.zeros(6)
    for number in range(data.ncon):
        contact = data.contact[number]
        if contact.efc_address < 0:
            continue
        mujoco.mj_contactForce(model, data, number, force)
        one, other = contact.geom.tolist()
        on_other = force[:3] @ contact.frame.reshape(3, 3)  # rows: the normal, from one to other, ...
        geom, on_hand = (other, on_other) if model.geom_bodyid[one] == scene.object_body else (one, -on_other)
        row = scene.pad_row_by_geom.get(geom, -1)
        found.append((int(model.geom_bodyid[geom]), row, contact.pos.copy(), on_hand, -float(contact.dist)))
    return found


def _by_suffix(name: str, angles: Mapping[str, float]) -> float:
    return next((angle for suffix, angle in angles.items() if name.endswith(f"_{suffix}")), 0.0)
