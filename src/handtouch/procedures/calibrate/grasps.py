"""Forces of a hand's contacts in static grasps, by the torques of its joints or the weight of what it holds.

Public names: `StaticGrasp`, `read_grasps`, `contact_forces`, `grasp_readings`.

In a grasp at rest the contacts' forces balance the torques of the joints (arXiv 2605.28812): the motors of
joint j apply minus the sum of J_ij . f_i, where J_ij is the velocity of contact i by joint j, and f_i the
force on its link. The sum of all f_i is the weight of a held object. A force is normal, inward, by a size
that nothing is assumed of, and tangential within what friction allows. All equations are linear: the forces
are estimated by generalised least squares, with their covariance.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from handtouch.arrays import FloatArray
from handtouch.config.base import NonNegative, Positive, Table, Vector3
from handtouch.hand.urdf import MOVABLE_JOINT_TYPES, RobotDescription
from handtouch.host.units import GRAVITY_M_S2
from handtouch.procedures.calibrate.readings import Weight, WeightReading

_FRICTION_STD = 0.5
"""Standard deviation of each tangential force over the normal one: friction coefficients of 0.3 to 1."""
_MIN_SCALE_N, _MAX_FORCE_N = 0.1, 1e3
_MAX_FORCE_STD = 0.15
"""Of a force that the law is fitted to: larger errors of forces would flatten it."""
_RESTED_S = 3600.0
"""Time before the first grasp in which its pads are taken to have been unloaded."""
_MEAN_NOISE = 1e-3
"""Standard deviation of a contact's total current, beside the sheet's scatter."""


class GraspContact(Table):
    """A contact of a grasp, by the keys of `contact` messages; others are ignored. force_n: as published."""

    model_config = ConfigDict(extra="ignore")
    link: str
    position_m: Vector3
    normal: Vector3
    pad_m: tuple[float, float]
    total_current_a: Positive
    force_n: float | None = None


class StaticGrasp(Table):
    """A line of a file of grasps: a hand at rest.

    joints: positions [rad or m]; torque_nm: of its motors, less what gravity and friction of the hand need,
    with the standard deviation of each, torque_std_nm. held_kg: mass of an object that only these contacts
    hold, with held_std_kg; gravity: direction in the frame of the URDF's root. began_s, t_s, ended_s: times
    of one clock at which its contacts began, were read, and ended.
    """

    joints: dict[str, float]
    contacts: Annotated[tuple[GraspContact, ...], Field(min_length=1)]
    torque_nm: dict[str, float] = Field(default_factory=dict)
    torque_std_nm: Positive = 0.01
    held_kg: NonNegative | None = None
    held_std_kg: Positive = 1e-3
    gravity: Vector3 = (0.0, 0.0, -1.0)
    began_s: float = math.nan
    t_s: float = math.nan
    ended_s: float = math.nan


def read_grasps(path: Path) -> list[StaticGrasp]:
    """Return the grasps of a file of JSON lines. Raises ValueError naming the wrong line, OSError."""
    grasps = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            grasps.append(StaticGrasp.model_validate_json(line))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            key = ".".join(map(str, problem["loc"]))
            raise ValueError(f"{path}: line {number}: {key}: {problem['msg']}") from error
    return grasps


def contact_forces(robot: RobotDescription, grasp: StaticGrasp) -> tuple[FloatArray, FloatArray]:
    """Return the normal forces (k,) [N] of a grasp's contacts and their covariance (k, k).

    Raises ValueError for a link, or a joint above one, that is unknown.
    """
    scale = [max(contact.force_n or 0.0, _MIN_SCALE_N) for contact in grasp.contacts]
    count = 3 * len(scale)
    axes, by_joint = np.zeros((3, count)), defaultdict[str, FloatArray](lambda: np.zeros(count))
    for k, contact in enumerate(grasp.contacts):
        own = slice(3 * k, 3 * k + 3)
        axes[:, own], columns = _linearise(robot, contact, grasp.joints)
        for name, column in columns:
            by_joint[name][own] -= column @ axes[:, own]
    rows = [by_joint[name] / grasp.torque_std_nm for name in grasp.torque_nm]
    values = [torque / grasp.torque_std_nm for torque in grasp.torque_nm.values()]
    if grasp.held_kg is not None:
        std_n = GRAVITY_M_S2 * grasp.held_std_kg
        down = np.array(grasp.gravity) / np.linalg.norm(grasp.gravity)
        rows += list(axes / std_n)
        values += (GRAVITY_M_S2 * grasp.held_kg / std_n * down).tolist()
    stds = np.array([(_MAX_FORCE_N, _FRICTION_STD * own, _FRICTION_STD * own) for own in scale]).ravel()
    equations = np.array(rows).reshape(-1, count)
    covariance = np.linalg.inv(equations.T @ equations + np.diag(stds**-2.0))
    forces = covariance @ equations.T @ np.array(values)
    return np.asarray(forces[::3]), np.asarray(covariance[::3, ::3])


def grasp_readings(
    robot: RobotDescription, grasps: Sequence[StaticGrasp], link: str, radius_m: float
) -> list[WeightReading]:
    """Return the readings of a link's pad whose forces the grasps determine well enough to fit a law."""
    readings, ended_s = [], -math.inf
    for grasp in grasps:
        forces, covariance = contact_forces(robot, grasp)
        own = [k for k, contact in enumerate(grasp.contacts) if contact.link == link]
        for k in own if len(own) == 1 else ():
            force_n, std_n = float(forces[k]), math.sqrt(covariance[k, k])
            if std_n > _MAX_FORCE_STD * force_n:
                continue
            contact = grasp.contacts[k]
            current_a, reported_n = contact.total_current_a, contact.force_n
            readings.append(
                WeightReading(
                    Weight(force_n, radius_m, f"{force_n:.3g} N", std_n),
                    current_a,
                    _MEAN_NOISE * current_a,
                    1,
                    contact.pad_m,
                    math.nan if reported_n is None else reported_n,
                    unloaded_s=max(ended_s, grasp.began_s - _RESTED_S),
                    loaded_s=grasp.began_s,
                    measured_s=grasp.t_s,
                )
            )
        if own:
            ended_s = grasp.ended_s
    return readings


def _linearise(
    robot: RobotDescription, contact: GraspContact, joints: Mapping[str, float]
) -> tuple[FloatArray, list[tuple[str, FloatArray]]]:
    """Return the directions (3, 3) of a contact's force, inward normal first, as columns, and its velocities
    (3,) by the joints that move it; in the frame of the root."""
    if contact.link not in robot.bodies:
        raise ValueError(f'contact on link "{contact.link}", which the URDF lacks')
    rotation, origin = np.eye(3), np.zeros(3)
    moved: list[tuple[str, FloatArray, FloatArray | None]] = []
    for joint in robot.joint_chain(contact.link):
        turn, shift = joint.pose(joints)
        axis, origin, rotation = (
            rotation @ joint.rotation @ joint.axis,
            origin + rotation @ shift,
            rotation @ turn,
        )
        if joint.kind not in MOVABLE_JOINT_TYPES:
            continue
        name, factor, _ = joint.mimic or (joint.name, 1.0, 0.0)
        if name not in joints:
            raise ValueError(f'joints: lacks "{name}", which moves link "{contact.link}"')
        moved.append((name, factor * axis, None if joint.kind == "prismatic" else origin))
    point = origin + rotation @ contact.position_m
    columns = [
        (name, axis if at is None else np.asarray(np.cross(axis, point - at))) for name, axis, at in moved
    ]
    inward = -rotation @ contact.normal
    inward /= np.linalg.norm(inward)
    across = np.cross(inward, np.eye(3)[np.abs(inward).argmin()])
    across /= np.linalg.norm(across)
    return np.stack([inward, across, np.cross(inward, across)], axis=1), columns
