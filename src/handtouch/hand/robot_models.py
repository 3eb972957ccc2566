"""Kinematics and URDF checks of the hands of a deployment.

Public names: `RobotModels`, `JointErrors`, `check_urdfs`, `drop_invalid_urdfs`, `unchecked_items`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config import (
    ConfigError,
    Deployment,
    HandTable,
    Problem,
)
from handtouch.config.problems import suggest_name
from handtouch.hand import urdf
from handtouch.hand.body_distance import (
    can_read_meshes,
    find_mesh,
    signed_distance_m,
    unreadable_mesh,
)
from handtouch.hand.joints import FollowerJoint
from handtouch.hand.kinematics import HandKinematics
from handtouch.hand.pads import MountUncertainty, mount_transform
from handtouch.hand.urdf import RobotDescription, UrdfError
from handtouch.host.installation import extra_command

_MAX_PAD_DEPTH_M, _MAX_PAD_HEIGHT_M = 0.003, 0.010
"""Distance of a pad's centre below its link's body, and above it, beyond which its mount is rejected."""
_OUTWARD_TEST_STEP_M = 0.003
_KEYS_REQUIRING_URDF = (
    "palm_link",
    "base_link",
    "joint_names",
    "joint_prefix",
    "mount_std_mm",
    "mount_std_deg",
    "joint_std_deg",
    "joint_std_mm",
    "joint_backlash_deg",
    "joint_backlash_mm",
)
_GRADIENT_STEP_M = 1e-5
_MAX_SURFACE_STEPS = 50
_MIN_SLOPE = 0.1
"""A distance has slope 1, but where two places are equally near"""
_MAX_PARALLEL = 0.9


class JointErrors(NamedTuple):
    """Standard deviations (m,) of a hand's joints [rad, m if prismatic]."""

    unstated: FloatArray
    """of those whose states carry none"""
    backlash: FloatArray
    """of the play, which no encoder sees: a part of all"""

    def of(self, stated: FloatArray) -> FloatArray:
        """Return the whole deviations (m,) for those that joint states carry, 0 or NaN where they don't."""
        return np.hypot(np.where(stated > 0, stated, self.unstated), self.backlash)


class RobotModels:
    """Kinematics of the hands that have a URDF; all attributes are lists over these hands.

    `hands`: names; `kinematics`; `pad_rows`: numbers of its pads among those of the deployment, in the order
    of the kinematics' links; `pad_centres_m`: (n, 3) in their links; `joint_names`: names of the kinematics'
    joints in joint states; `followers`: by their names in joint states; `joints_stale_s`, `group_distance_m`;
    `gravity`: unit vector (3,) in the base frame; `magnetic_pads`: (n,); `mounts`: uncertainty of its
    mounts; `joint_errors`. Raises UrdfError, KeyError or OSError for errors that `check_urdfs` reports.
    """

    def __init__(self, deployment: Deployment) -> None:
        self.hands: list[str] = []
        self.kinematics: list[HandKinematics] = []
        self.pad_rows: list[NDArray[np.intp]] = []
        self.pad_centres_m: list[FloatArray] = []
        self.joint_names: list[tuple[str, ...]] = []
        self.followers: list[dict[str, FollowerJoint]] = []
        self.joints_stale_s: list[float] = []
        self.group_distance_m: list[float] = []
        self.mounts: list[MountUncertainty] = []
        self.joint_errors: list[JointErrors] = []
        self.gravity: list[NDArray[np.float64]] = []
        self.magnetic_pads: list[NDArray[np.bool_]] = []
        first = 0
        for hand in deployment.hands:
            if hand.urdf:
                robot = urdf.read_urdf(Path(hand.urdf))
                links = [pad.mount.link or pad.link for pad in hand.pads]
                made = HandKinematics(robot, links, hand.palm_link or robot.root, _base(robot, hand))
                self.hands.append(hand.name)
                self.kinematics.append(made)
                self.pad_rows.append(np.arange(first, first + len(hand.pads)))
                self.pad_centres_m.append(np.array([mount_transform(pad)[1] for pad in hand.pads]))
                self.joint_names.append(tuple(_message_joint_name(hand, joint) for joint in made.joints))
                self.followers.append(
                    {
                        _message_joint_name(hand, name): joint._replace(
                            leader=_message_joint_name(hand, joint.leader)
                        )
                        for name, joint in made.followers.items()
                    }
                )
                self.joints_stale_s.append(hand.joint_state_timeout_ms * 1e-3)
                self.group_distance_m.append(hand.grouping_distance_mm * 1e-3)
                self.mounts.append(MountUncertainty(hand))
                slides = np.array([robot.joints[name].kind == "prismatic" for name in made.joints], np.bool_)
                std = np.where(slides, hand.joint_std_mm * 1e-3, np.radians(hand.joint_std_deg))
                play = np.where(slides, hand.joint_backlash_mm * 1e-3, np.radians(hand.joint_backlash_deg))
                self.joint_errors.append(JointErrors(std, play / np.sqrt(12)))
                self.gravity.append(np.array(hand.gravity) / np.linalg.norm(hand.gravity))
                self.magnetic_pads.append(np.array([pad.is_magnetic for pad in hand.pads]))
            first += len(hand.pads)


def _base(robot: RobotDescription, hand: HandTable) -> str:
    return hand.base_link or robot.default_base(hand.palm_link or robot.root)


def _message_joint_name(hand: HandTable, joint: str) -> str:
    return hand.joint_names.get(joint, hand.joint_prefix + joint)


def check_urdfs(deployment: Deployment, file: str) -> Deployment:
    """Return the deployment if its hands fit their URDFs. Raises ConfigError naming every error."""
    problems = [*_unavailable_frames(deployment)]
    for number, hand in enumerate(deployment.hands, 1):
        found = list(_hand_problems(number, hand))
        problems += found or _hand_mount_problems(hand)
    if problems:
        raise ConfigError(file, tuple(problems))
    return deployment


def drop_invalid_urdfs(deployment: Deployment, file: str) -> tuple[Deployment, tuple[Problem, ...]]:
    """Return the deployment without URDFs that don't fit their hands, and the errors found.

    Such a hand is served in link frames only. A doubtful mount is among the errors, but its hand keeps its
    URDF. Raises ConfigError if palm or base output is requested and no
    hand can ever provide it.
    """
    if unserved := tuple(_unavailable_frames(deployment)):
        raise ConfigError(file, unserved)
    hands: list[HandTable] = []
    problems: list[Problem] = []
    for number, hand in enumerate(deployment.hands, 1):
        found = list(_hand_problems(number, hand))
        problems += found or _hand_mount_problems(hand)
        hands.append(hand.model_copy(update={"urdf": None}) if found else hand)
    return deployment.model_copy(update={"hands": tuple(hands)}), tuple(problems)


def _unavailable_frames(deployment: Deployment) -> Iterator[Problem]:
    """Yield frames that the file's scene requests and no hand can provide."""
    requested = sorted({"palm", "base"} & set(deployment.scene.outputs))
    if requested and not any(hand.urdf for hand in deployment.hands):
        yield Problem("[scene]: outputs", _value_text(requested), "needs a hand with a URDF: [[hand]] urdf")


def unchecked_items(deployment: Deployment) -> Iterator[str]:
    """Yield what couldn't be checked, and why; for a deployment that has passed `check_urdfs`."""
    for hand in deployment.hands:
        if not hand.urdf:
            continue
        robot = urdf.read_urdf(Path(hand.urdf))
        for warning in robot.warnings:
            yield f"{hand.name}: {hand.urdf}: {warning}"
        for pad in hand.pads:
            link = pad.mount.link or pad.link
            if why := _why_unchecked(robot, (*robot.bodies[link], *robot.visible.get(link, ()))):
                yield f"{hand.name}/{pad.link}: position on the link's body not checked: {why}"


def _place_of_mesh(file: str, folder: Path) -> str:
    """Return where a mesh is searched."""
    if file.startswith("package://"):
        package = file.removeprefix("package://").partition("/")[0]
        return (
            f"put the folder {package} of its ROS package into {folder.resolve()} or a folder above it, "
            "or its folder into ROS_PACKAGE_PATH"
        )
    return f"paths are relative to the URDF's folder, {folder.resolve()}"


def _why_unchecked(robot: RobotDescription, shapes: Sequence[urdf.BodyShape]) -> str:
    """Return why some mesh of a body isn't known; empty if all are."""
    meshes = [shape for shape in shapes if shape.kind == "mesh"]
    if meshes and not can_read_meshes():
        return f"meshes are read with {extra_command('urdf')}"
    for mesh in meshes:
        path = find_mesh(mesh.file, robot.path.parent)
        why = (
            f"file {mesh.file} not found; {_place_of_mesh(mesh.file, robot.path.parent)}"
            if path is None
            else unreadable_mesh(path, mesh.size_m)
        )
        if why:
            return why
    return ""


def _hand_problems(number: int, hand: HandTable) -> Iterator[Problem]:
    location = f'[[hand]] {number} "{hand.name}": '
    if not any(hand.gravity):
        yield Problem(
            f"{location}gravity", _value_text(hand.gravity), "must not be zero, e.g. [0.0, 0.0, -1.0]"
        )
    if not hand.urdf:
        for key in _KEYS_REQUIRING_URDF:
            if key in hand.model_fields_set and (value := getattr(hand, key)):
                yield Problem(f"{location}{key}", _value_text(value), "needs a URDF, and urdf is missing")
        return
    try:
        robot = urdf.read_urdf(Path(hand.urdf))
    except UrdfError as error:
        yield Problem(f"{location}urdf", _value_text(hand.urdf), str(error))
        return
    for key in ("palm_link", "base_link"):
        if (value := getattr(hand, key)) and value not in robot.bodies:
            yield Problem(f"{location}{key}", _value_text(value), _no_such("link", value, list(robot.bodies)))
    for joint in hand.joint_names:
        if joint not in robot.joints:
            yield Problem(
                f"{location}joint_names", _value_text(joint), _no_such("joint", joint, list(robot.joints))
            )
    for count, pad in enumerate(hand.pads, 1):
        at = f'[[hand.pad]] {count} "{hand.name}/{pad.link}": '
        key, link = ("mount.link", pad.mount.link) if pad.mount.link else ("link", pad.link)
        if link not in robot.bodies:
            remedy = _no_such("link", link, list(robot.bodies))
            yield Problem(
                f"{at}{key}", _value_text(link), f"{remedy}; set mount.link to the link that carries the pad"
            )
            return
    links = [pad.mount.link or pad.link for pad in hand.pads]
    try:
        HandKinematics(robot, links, hand.palm_link or robot.root, _base(robot, hand))
    except UrdfError as error:
        yield Problem(f"{location}urdf", _value_text(hand.urdf), str(error))
    except KeyError:
        return  # palm or base, reported above


def _hand_mount_problems(hand: HandTable) -> Iterator[Problem]:
    """Yield doubtful mounts of a hand that has no other problem."""
    if not hand.urdf:
        return
    robot = urdf.read_urdf(Path(hand.urdf))
    for count, pad in enumerate(hand.pads, 1):
        at, link = f'[[hand.pad]] {count} "{hand.name}/{pad.link}": ', pad.mount.link or pad.link
        bodies = [robot.bodies[link], *([robot.visible[link]] if link in robot.visible else [])]
        found = [list(_mount_problems(at, pad, link, body, robot.path.parent)) for body in bodies]
        if all(found):  # a pad lies on the visible surface, or on the collision body
            yield from found[-1]


def _mount_problems(
    at: str, pad: config.Pad, link: str, shapes: Sequence[urdf.BodyShape], folder: Path
) -> Iterator[Problem]:
    rotation, middle = mount_transform(pad)
    outward = middle + _OUTWARD_TEST_STEP_M * rotation[:, 2]
    height, outward_height = signed_distance_m(shapes, np.stack([middle, outward]), folder).tolist()
    if height == np.inf:
        return  # the URDF has no body for this link
    body = f'the body of link "{link}"'
    if height < -_MAX_PAD_DEPTH_M:
        key, problem = "position_mm", f"the pad's centre is {-height * 1e3:.1f} mm inside {body}"
        remedy = "move it to the surface"
    elif height > _MAX_PAD_HEIGHT_M:
        key, problem = "position_mm", f"the pad's centre is {height * 1e3:.1f} mm from {body}"
        remedy = "is it on another link, or in metres?"
    elif outward_height <= height:
        key, problem, remedy = "rpy_deg", f"the pad faces into {body}", "its z axis points outward"
    else:
        return
    if pad.surface.build().frame[1].any():  # drawn in a frame of its own, for which the mount is stated
        yield Problem(f"{at}mount.{key}", _value_text(getattr(pad.mount, key)), f"{problem}; {remedy}")
        return
    nearest = _nearest_mount(rotation, middle, shapes, folder)
    if pad.mount.model_fields_set & {"position_mm", "rpy_deg"}:
        given = _value_text(getattr(pad.mount, key))
        yield Problem(f"{at}mount.{key}", given, f"{problem}; {remedy}{nearest}")
    else:
        yield Problem(
            f"{at}mount",
            "",
            f"isn't given, so the pad lies at the origin of its link, where {problem}; "
            f"state position_mm of its centre and rpy_deg, z outward{nearest}",
        )


def _nearest_mount(
    rotation: FloatArray, middle_m: FloatArray, shapes: Sequence[urdf.BodyShape], folder: Path
) -> str:
    """Return the mount at the nearest place on the body, as a hint; empty if none is found.

    Its z axis is the body's outward normal there, its x axis as near as possible to the given one.
    """
    point = np.array(middle_m, np.float64)
    for _ in range(_MAX_SURFACE_STEPS):
        steps = _GRADIENT_STEP_M * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        distance_m = signed_distance_m(shapes, point + steps, folder)
        gradient = (distance_m[1:4] - distance_m[4:]) / (2 * _GRADIENT_STEP_M)
        if not (slope := float(np.linalg.norm(gradient))) > _MIN_SLOPE:
            return ""  # on an edge inside the body
        if abs(distance_m[0]) < _GRADIENT_STEP_M:
            break
        point -= distance_m[0] * gradient / slope**2
    else:
        return ""
    z = gradient / slope
    x = next(axis for axis in rotation.T if abs(axis @ z) < _MAX_PARALLEL)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    rpy = np.arctan2(y[2], z[2]), -np.arcsin(np.clip(x[2], -1, 1)), np.arctan2(x[1], x[0])
    position_mm = ((1e3 * point).round(1) + 0.0).tolist()
    rpy_deg = (np.rad2deg(rpy).round() + 0.0).tolist()  # + 0.0: without a sign of zero
    return f"; the nearest place is position_mm = {position_mm}, rpy_deg = {rpy_deg}"


def _no_such(what: str, name: str, known: Sequence[str]) -> str:
    return f"the URDF has no such {what}; {suggest_name(name, known)}known: {', '.join(known)}"


def _value_text(value: object) -> str:
    return f" = {json.dumps(value, ensure_ascii=False)}"
