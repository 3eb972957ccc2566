"""What a simulated hand that moves reads without a touch: its skin's weight, the Earth's magnetic field.

Public names: `SkinLoad`, `FieldLoad`, `LinkMotion`, `link_motion`.

Skin and drive plate lie loosely on the sheet: each piece presses by its own weight, and by its inertia, along
the normal there, wherever that points down. What it presses through the layer is far less than the sheet
conducts, so that currents of pieces add, to those of contacts too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.hand import urdf
from handtouch.host.units import GRAVITY_M_S2
from handtouch.simulate.base_motion import BaseTurn, axis_rotations, base_rotation
from handtouch.simulate.pad_circuit import PadCircuit, layer_of
from handtouch.simulate.sheet_solver import SheetMapBank
from handtouch.simulate.stimulus import JointTrajectory, Stimulus

_STEP_S = 0.01  # of the accelerations: motions of a hand are slower
_NODES = 5  # along each side of a pad
_KEPT_CHUNKS, _CHUNK_STEPS = 600, 100


class SkinLoad:
    """Currents of the skin on one pad by time; None of `of_pad`, where a stimulus has no skin.

    `link_motion`: see `LinkMotion`. rotation, translation: of the pad's frame in its link's.
    """

    def __init__(
        self,
        kg_per_m2: float,
        circuit: PadCircuit,
        motion: LinkMotion,
        rotation: FloatArray,
        translation_m: FloatArray,
    ) -> None:
        self._motion, self._centre_m = motion, translation_m
        shape, layer = circuit.shape, layer_of(circuit.sheet)
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        x, y = (grid.ravel() for grid in np.meshgrid(0.5 + nodes / 2, 0.5 + nodes / 2))
        weight = np.outer(weights, weights).ravel() / 4
        metres = np.array([shape.metres_per_fraction(*at) for at in zip(x.tolist(), y.tolist(), strict=True)])
        normals = [
            shape.normal(s * shape.length_m, phi * shape.arc)
            for s, phi in zip(x.tolist(), y.tolist(), strict=True)
        ]
        self._inward = -np.array(normals) @ rotation.T * kg_per_m2
        """(nodes, 3): to the pressure [Pa] of a piece, by the acceleration in the link's frame"""
        shares = SheetMapBank([circuit.maps]).look_up(np.zeros(len(x), np.intp), x, y)[0][:-1]
        conductance = weight * np.linalg.det(metres) / layer.contact_ohm_m2
        self._reference_pa, self._alpha = float(layer.reference_pa), float(layer.alpha)
        self._currents = (circuit.healthy.share_to_channel @ shares * conductance).T * circuit.drive_v
        """(nodes, m) [A] at the reference pressure"""

    @classmethod
    def of_pad(
        cls,
        deployment: config.Deployment,
        hand: str,
        pad: config.Pad,
        circuit: PadCircuit,
        stimulus: Stimulus,
        mount: tuple[FloatArray, FloatArray],
    ) -> SkinLoad | None:
        """Return the load of a pad with its true circuit and mount; None without skin."""
        if stimulus.skin is None:
            return None
        (table,) = (one for one in deployment.hands if one.name == hand)
        motion = link_motion(table, pad, stimulus)
        return cls(10 * stimulus.skin.g_per_cm2, circuit, motion, *mount)

    def prepare(self, until_s: float) -> None:
        """Compute the motion up to a time in advance, as far as it is kept."""
        kept_s = _KEPT_CHUNKS * _CHUNK_STEPS * _STEP_S
        self._motion.felt_m_s2(np.arange(0.0, min(until_s, kept_s)), self._centre_m)

    def currents(self, scenario_s: FloatArray) -> FloatArray:
        """Return the currents (n, m) of the channels at times (n,) of the scenario [A], at nominal supply."""
        felt = self._motion.felt_m_s2(scenario_s, self._centre_m)
        pressure = np.maximum(felt @ self._inward.T, 0.0) / self._reference_pa
        return np.asarray(pressure**self._alpha @ self._currents)


class FieldLoad:
    """Signals of the Earth's field on a magnetic pad by time.

    axes: (n, 3) of the channels in the link's frame, as long as a field along them is read. field: its
    direction (3,) in the base's frame at the start, when the sensor is zeroed.
    """

    def __init__(self, axes: FloatArray, field: FloatArray, motion: LinkMotion) -> None:
        self._axes, self._field, self._motion = axes, field, motion
        self._zero = motion.in_link(np.zeros(1), field)

    def prepare(self, until_s: float) -> None:
        """Do nothing: it is quick."""

    def currents(self, scenario_s: FloatArray) -> FloatArray:
        """Return the signals (n, m) of the channels at times (n,) of the scenario."""
        return np.asarray((self._motion.in_link(scenario_s, self._field) - self._zero) @ self._axes.T)


class LinkMotion:
    """Motion of a link that carries a pad: joints as the scenario has them, and turns of the base.

    chain, base_chain: joints from the root of the tree to the link, and to the base.
    """

    def __init__(
        self,
        chain: Sequence[urdf.UrdfJoint],
        base_chain: Sequence[urdf.UrdfJoint],
        joints: JointTrajectory | None,
        turns: Sequence[BaseTurn],
        gravity: FloatArray,
    ) -> None:
        self._chain, self._base_chain, self._joints, self._turns = chain, base_chain, joints, turns
        self._gravity_m_s2 = GRAVITY_M_S2 * gravity / np.linalg.norm(gravity)
        self._steps = lru_cache(_KEPT_CHUNKS)(self._felt_in_chunk)

    def felt_m_s2(self, times_s: FloatArray, point_m: FloatArray) -> FloatArray:
        """Return gravity less acceleration (n, 3) [m/s^2] of a point of the link, in the link's frame."""
        if self._joints is None and not self._turns:
            return np.broadcast_to(self._steps(0, tuple(point_m.tolist()))[0], (len(times_s), 3))
        step = np.maximum(times_s, 0.0) / _STEP_S
        before = np.floor(step).astype(np.int64)
        felt = np.empty((len(times_s), 3))
        for number in np.unique(before // _CHUNK_STEPS).tolist():
            at = np.flatnonzero(before // _CHUNK_STEPS == number)
            steps = self._steps(number, tuple(point_m.tolist()))
            first, part = before[at] - number * _CHUNK_STEPS, (step[at] - before[at])[:, None]
            felt[at] = (1 - part) * steps[first] + part * steps[first + 1]
        return felt

    def in_link(self, times_s: FloatArray, direction: FloatArray) -> FloatArray:
        """Return a direction (3,) of the base's frame at the start in the link's frame (n, 3)."""
        rotation = self._poses(np.maximum(times_s, 0.0))[0]
        return np.asarray(direction @ rotation)

    def _felt_in_chunk(self, number: int, point_m: tuple[float, float, float]) -> FloatArray:
        """Return what is felt at the steps of a chunk, the first one of the next included."""
        steps = number * _CHUNK_STEPS + np.arange(-1, _CHUNK_STEPS + 2)
        times_s = np.asarray(_STEP_S * steps, np.float64)
        rotation, translation = self._poses(times_s)
        inertial = translation + rotation @ np.array(point_m)
        acceleration = (inertial[2:] - 2 * inertial[1:-1] + inertial[:-2]) / _STEP_S**2
        felt: FloatArray = np.einsum("nji,nj->ni", rotation[1:-1], self._gravity_m_s2 - acceleration)
        return felt

    def _poses(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return rotations (n, 3, 3) and translations (n, 3) of the link in the base's frame at the start."""
        names = {joint.mimic[0] if joint.mimic else joint.name for joint in (*self._chain, *self._base_chain)}
        positions = [
            {} if self._joints is None else self._joints.positions_at(max(t_s, 0.0))
            for t_s in times_s.tolist()
        ]
        by_joint = {name: np.array([at.get(name, 0.0) for at in positions]) for name in names}
        turned, moved = _chain_pose(self._chain, by_joint, len(times_s))
        base, origin = _chain_pose(self._base_chain, by_joint, len(times_s))
        to_start = base_rotation(self._turns, times_s) @ base.transpose(0, 2, 1)
        return to_start @ turned, (to_start @ (moved - origin)[:, :, None])[:, :, 0]


def link_motion(hand: config.HandTable, pad: config.Pad, stimulus: Stimulus) -> LinkMotion:
    """Return the motion of a pad's link; without a URDF it moves with the base."""
    gravity = np.array(hand.gravity)
    if not hand.urdf:
        return LinkMotion((), (), None, stimulus.turns, gravity)
    robot = _read_robot(Path(hand.urdf), Path(hand.urdf).stat().st_mtime_ns)
    base = hand.base_link or robot.default_base(hand.palm_link or robot.root)
    chains = robot.joint_chain(pad.mount.link or pad.link), robot.joint_chain(base)
    return LinkMotion(*chains, stimulus.joint_trajectory(robot), stimulus.turns, gravity)


@lru_cache(4)
def _read_robot(path: Path, changed_ns: int) -> urdf.RobotDescription:  # noqa: ARG001
    """Return a robot description, which all pads of a hand share."""
    return urdf.read_urdf(path)


def _chain_pose(
    chain: Sequence[urdf.UrdfJoint], positions: Mapping[str, FloatArray], count: int
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (n, 3, 3) and translations (n, 3) of the last link in the root's frame."""
    rotation, translation = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
    for joint in chain:
        translation = translation + rotation @ joint.translation_m
        rotation = rotation @ joint.rotation
        leader, factor, offset = joint.mimic or (joint.name, 1.0, 0.0)
        if joint.kind == "prismatic":
            slid = (offset + factor * positions[leader])[:, None] * joint.axis
            translation = translation + (rotation @ slid[:, :, None])[:, :, 0]
        elif joint.kind in urdf.MOVABLE_JOINT_TYPES:
            rotation = rotation @ axis_rotations(joint.axis, offset + factor * positions[leader])
    return rotation, translation
