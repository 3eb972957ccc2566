"""Lets a hand grasp a thing in MuJoCo, and keeps what happened, a record a millisecond.

Public names: `grasp` -> `Grasp`. The thing is held out, the hand closes on it, it is let go, the hand
squeezes twice, and then it is pulled off, slipping, and the hand opens. The same seed, the same grasp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.simulate.grasp.scene import STEP_S, Pad, Scene
from handtouch.simulate.grasp.things import THINGS, Thing
from handtouch.simulate.world import World

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_CLOSE_S, _GRIPPED_S, _RELEASE_S = 0.3, 1.4, 1.6
_SQUEEZES_S, _SQUEEZE_S, _SQUEEZE = (2.0, 2.9), 0.7, 2.0
_PULL_S, _PULL_M_S, _OPEN_S, DURATION_S = 3.9, 0.06, 5.9, 6.8
_PULLED_M = 0.11


@dataclass(frozen=True, eq=False)
class Grasp:
    """How a grasp went: n steps at 1 kHz, m joints, p pads, k contact points of all steps together."""

    thing: Thing
    hand: str
    pads: tuple[Pad, ...]
    joints: tuple[str, ...]
    times_s: FloatArray
    """(n,)"""
    position_rad: FloatArray
    """(n, m) of the joints"""
    link_rotation: FloatArray
    """(n, p, 3, 3) of the pads' links in the palm"""
    link_m: FloatArray
    """(n, p, 3)"""
    thing_m: FloatArray
    """(n, 3) its middle, in the palm"""
    thing_m_s: FloatArray
    """(n, 3) its velocity, in the palm"""
    thing_rad_s: FloatArray
    """(n, 3) how it turns, in the palm"""
    held: NDArray[np.bool_]
    """(n,) whether somebody besides the hand holds it"""
    step: IntArray
    """(k,) of a contact point"""
    pad: IntArray
    """(k,) row of its pad; -1: on another part of the hand"""
    body: IntArray
    """(k,) MuJoCo's number of the link"""
    point_m: FloatArray
    """(k, 3) in the palm"""
    force_n: FloatArray
    """(k, 3) on the hand, in the palm"""
    overlap_m: FloatArray
    """(k,) by which the two bodies give way"""


def grasp(
    hand: config.Hand,
    name: str,
    seed: int = 1,
    world: World | None = None,
    *,
    duration_s: float = DURATION_S,
    watch: Callable[[Scene, int], None] = lambda *_: None,
) -> Grasp:
    """Grasp a thing of `THINGS`; `world` says how pads really sit on their links.

    `watch` is called after every step, with its number. Raises KeyError for a thing that isn't there,
    ValueError for a hand without URDF, ImportError without MuJoCo.
    """
    scene = Scene(hand, world or World.ideal_parts(seed), THINGS[name].drawn(seed))
    script, kept = _Script(scene, seed), _Kept(scene, round(duration_s / STEP_S))
    for number in range(kept.n):
        script.step(number * STEP_S)
        kept.step(number, script.holds)
        watch(scene, number)
    return kept.grasp(hand.name)


class _Script:
    """What motors and helper do in the course of time."""

    def __init__(self, scene: Scene, seed: int) -> None:
        rng = np.random.default_rng((seed, 77))
        self._scene, self.holds = scene, True
        closed = [_by_end(name, scene.thing.closed_deg) for name in scene.joints]
        self._closed = np.radians(closed)
        digits = {name: name.split("_")[0] for name in scene.joints}
        late = {digit: rng.uniform(0.0, 0.15) for digit in dict.fromkeys(digits.values())}
        self._begin_s = np.array([_CLOSE_S + late[digits[name]] for name in scene.joints])
        self._start = scene.data.qpos[scene.q].copy()
        self._pull = scene.palm_rotation @ np.array(scene.thing.pull)
        self._from_m: FloatArray | None = None

    def step(self, t_s: float) -> None:
        """Set motors and helper for the step that begins at `t_s`."""
        model, data = self._scene.model, self._scene.data
        part = _gentle((t_s - self._begin_s) / (_GRIPPED_S - _CLOSE_S)) * (1 - _gentle((t_s - _OPEN_S) / 0.5))
        data.ctrl[:] = self._start + part * (self._closed - self._start)
        squeeze = sum(np.sin(np.pi * np.clip((t_s - s) / _SQUEEZE_S, 0, 1)) ** 2 for s in _SQUEEZES_S)
        torque = self._scene.thing.torque_nm * (1 + (_SQUEEZE - 1) * squeeze)
        model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1] = -torque, torque
        self.holds = t_s < _RELEASE_S or t_s >= _PULL_S
        data.eq_active[0] = self.holds
        if t_s >= _PULL_S:
            if self._from_m is None:  # taken hold of where it is
                self._from_m = data.xpos[self._scene.body].copy()
                data.mocap_quat[0] = data.xquat[self._scene.body]
            way = min(_PULL_M_S * (t_s - _PULL_S), _PULLED_M)
            data.mocap_pos[0] = self._from_m + way * self._pull


class _Kept:
    """Steps the scene and keeps what there is to keep."""

    def __init__(self, scene: Scene, n: int) -> None:
        import mujoco

        self._mujoco, self._scene, self.n = mujoco, scene, n
        p = len(scene.pads)
        self._bodies = np.array([pad.body for pad in scene.pads])
        self._q = np.empty((n, len(scene.q)))
        self._rotation, self._link = np.empty((n, p, 3, 3)), np.empty((n, p, 3))
        self._thing, self._speed, self._turn = (np.empty((n, 3)) for _ in range(3))
        self._held = np.zeros(n, np.bool_)
        self._rows: list[tuple[int, int, int]] = []
        self._points: list[tuple[FloatArray, FloatArray]] = []
        self._overlaps: list[float] = []
        self._dof = scene.model.body(scene.body).dofadr[0]

    def step(self, number: int, held: bool) -> None:
        scene, data = self._scene, self._scene.data
        self._q[number], self._held[number] = data.qpos[scene.q], held
        self._speed[number] = data.qvel[self._dof : self._dof + 3]
        turned = data.xmat[scene.body].reshape(3, 3)  # MuJoCo has how it turns in its own frame
        self._turn[number] = turned @ data.qvel[self._dof + 3 : self._dof + 6]
        self._mujoco.mj_step(scene.model, data)
        # poses and contacts in `data` are now those of the step's begin, which is what was kept of qpos
        self._rotation[number] = data.xmat[self._bodies].reshape(-1, 3, 3)
        self._link[number], self._thing[number] = data.xpos[self._bodies], data.xpos[scene.body]
        for body, row, point_m, force_n, overlap_m in contacts(scene):
            self._rows.append((number, row, body))
            self._points.append((point_m, force_n))
            self._overlaps.append(overlap_m)

    def grasp(self, hand: str) -> Grasp:
        """What was kept, in the frame of the palm."""
        scene, turn = self._scene, self._scene.palm_rotation
        step, pad, body = np.array(self._rows, np.intp).reshape(-1, 3).T
        points = np.array(self._points).reshape(-1, 2, 3)
        return Grasp(
            scene.thing,
            hand,
            scene.pads,
            scene.joints,
            np.arange(self.n) * np.float64(STEP_S),
            self._q,
            np.asarray(turn.T @ self._rotation, np.float64),
            scene.into_palm(self._link),
            scene.into_palm(self._thing),
            self._speed @ turn,
            self._turn @ turn,
            self._held,
            step,
            pad,
            body,
            scene.into_palm(points[:, 0]),
            points[:, 1] @ turn,
            np.array(self._overlaps),
        )


def contacts(scene: Scene) -> list[tuple[int, int, FloatArray, FloatArray, float]]:
    """Contact points of hand and thing after a step: body, row of the pad or -1, place and force on the hand,
    both (3,) in the world, and overlap [m]."""
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
        geom, on_hand = (other, on_other) if model.geom_bodyid[one] == scene.body else (one, -on_other)
        row = scene.geoms.get(geom, -1)
        found.append((int(model.geom_bodyid[geom]), row, contact.pos.copy(), on_hand, -float(contact.dist)))
    return found


def _by_end(name: str, of: Any) -> float:
    return float(next((value for end, value in of.items() if name.endswith(f"_{end}")), 0.0))


def _gentle(part: Any) -> Any:
    part = np.clip(part, 0.0, 1.0)
    return part * part * (3 - 2 * part)
