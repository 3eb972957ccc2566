"""The robots of a deployment: what its hands' URDFs say, checked against the pads that are mounted on them.

Public names: `Robots`, `check`, `served`, `doubts`.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.config import ConfigError, Deployment, Hand, Problem
from handtouch.hand import kinematics, urdf
from handtouch.hand.body import distance_m, find_mesh
from handtouch.hand.kinematics import Kinematics
from handtouch.hand.pads import Mounts, mount_of
from handtouch.hand.urdf import Description, UrdfError

FloatArray = NDArray[np.float64]
_DEEPEST_M, _FARTHEST_M = 0.003, 0.010
"""How far below its link's body, and how far off it, the middle of a pad may be."""
_OUTWARD_M = 0.003
_OF_URDF = (
    *("palm_link", "base_link", "joint_names", "joint_prefix"),
    *("mount_std_mm", "mount_std_deg", "joint_std_deg", "joint_std_mm"),
)
INSTALL = "pip install 'handtouch[urdf]'"


class Robots:
    """Kinematics of the hands that have a URDF; those without are left out.

    `hands` their names; `kinematics` of each; `rows` (of each) numbers of its pads among those of the
    deployment, in the order of the kinematics' links; `joint_names` (of each) what joint states call the
    kinematics' joints; `stale_s`, `group_m` and `gravity` (3,), unit, in the base, of each; `mounts` of each,
    how sure it is where its pads sit, None where that isn't stated; `joint_std` (m,) of each, for joints that
    tell no deviation of their own [rad, m where they slide]. Raises UrdfError, KeyError or OSError for what
    `check` would have told.
    """

    def __init__(self, deployment: Deployment) -> None:
        self.hands: list[str] = []
        self.kinematics: list[Kinematics] = []
        self.rows: list[NDArray[np.intp]] = []
        self.joint_names: list[tuple[str, ...]] = []
        self.stale_s: list[float] = []
        self.group_m: list[float] = []
        self.mounts: list[Mounts | None] = []
        self.joint_std: list[FloatArray] = []
        self.gravity: list[NDArray[np.float64]] = []
        first = 0
        for hand in deployment.hands:
            if hand.urdf and kinematics.available():
                robot = urdf.read(Path(hand.urdf))
                links = [pad.mount.link or pad.link for pad in hand.pads]
                made = Kinematics(robot, links, hand.palm_link or robot.root, hand.base_link or robot.root)
                self.hands.append(hand.name)
                self.kinematics.append(made)
                self.rows.append(np.arange(first, first + len(hand.pads)))
                self.joint_names.append(tuple(_told_name(hand, joint) for joint in made.joints))
                self.stale_s.append(hand.joints_stale_ms * 1e-3)
                self.group_m.append(hand.group_mm * 1e-3)
                self.mounts.append(Mounts(hand) if hand.mount_std_mm or hand.mount_std_deg else None)
                slides = np.array([robot.joints[name].kind == "prismatic" for name in made.joints], np.bool_)
                std = np.where(slides, hand.joint_std_mm * 1e-3, np.radians(hand.joint_std_deg))
                self.joint_std.append(std)
                self.gravity.append(np.array(hand.gravity) / np.linalg.norm(hand.gravity))
            first += len(hand.pads)


def _told_name(hand: Hand, joint: str) -> str:
    return hand.joint_names.get(joint, hand.joint_prefix + joint)


def check(deployment: Deployment, file: str) -> Deployment:
    """The deployment, if its hands fit their URDFs. Raises ConfigError naming every mistake."""
    problems = [*_unserved(deployment)]
    for number, hand in enumerate(deployment.hands, 1):
        problems += _problems(number, hand)
    if problems:
        raise ConfigError(file, tuple(problems))
    return deployment


def served(deployment: Deployment, file: str) -> tuple[Deployment, tuple[Problem, ...]]:
    """The deployment to serve, and what is wrong with its URDFs: a hand that doesn't fit its own is served on
    its links alone. Raises ConfigError where palm or base is asked for and no hand could ever have it."""
    if unserved := tuple(_unserved(deployment)):
        raise ConfigError(file, unserved)
    hands, problems = [], []
    for number, hand in enumerate(deployment.hands, 1):
        found = list(_problems(number, hand))
        problems += found
        hands.append(hand.model_copy(update={"urdf": None}) if found else hand)
    return deployment.model_copy(update={"hands": tuple(hands)}), tuple(problems)


def _unserved(deployment: Deployment) -> Iterator[Problem]:
    """Frames that the file's scene asks for and nobody could tell."""
    asked = sorted({"palm", "base"} & set(deployment.scene.outputs))
    if asked and not any(hand.urdf for hand in deployment.hands):
        yield Problem("[scene]: outputs", _is(asked), "needs a hand with a URDF: [[hand]] urdf")
    elif asked and not kinematics.available():
        yield Problem("[scene]: outputs", _is(asked), f"needs a package that isn't here: {INSTALL}")


def doubts(deployment: Deployment) -> Iterator[str]:
    """What couldn't be checked, and why. The deployment has passed `check`."""
    for hand in deployment.hands:
        if not hand.urdf:
            continue
        if not kinematics.available():
            yield f"{hand.name}: urdf: contacts are not told in palm and base frame: {INSTALL}"
        robot = urdf.read(Path(hand.urdf))
        for pad in hand.pads:
            meshes = [s.file for s in robot.bodies[pad.mount.link or pad.link] if s.kind == "mesh"]
            lost = [mesh for mesh in meshes if find_mesh(mesh, robot.path.parent) is None]
            if lost or (meshes and not kinematics.available()):
                why = f"there is no file {lost[0]}" if lost else f"meshes are read with {INSTALL}"
                yield f"{hand.name}/{pad.link}: its place on the body is not checked: {why}"


def _problems(number: int, hand: Hand) -> Iterator[Problem]:
    place = f'[[hand]] {number} "{hand.name}": '
    if not any(hand.gravity):
        yield Problem(f"{place}gravity", _is(hand.gravity), "must point somewhere, e.g. [0.0, 0.0, -1.0]")
    if not hand.urdf:
        for key in _OF_URDF:
            if value := getattr(hand, key):
                yield Problem(
                    f"{place}{key}", _is(value), "is of no use without a URDF, and urdf is left out"
                )
        return
    try:
        robot = urdf.read(Path(hand.urdf))
    except UrdfError as error:
        yield Problem(f"{place}urdf", _is(hand.urdf), str(error))
        return
    for key in ("palm_link", "base_link"):
        if (value := getattr(hand, key)) and value not in robot.bodies:
            yield Problem(f"{place}{key}", _is(value), _no_such("link", value, list(robot.bodies)))
    for joint in hand.joint_names:
        if joint not in robot.joints:
            yield Problem(f"{place}joint_names", _is(joint), _no_such("joint", joint, list(robot.joints)))
    for count, pad in enumerate(hand.pads, 1):
        at = f'[[hand.pad]] {count} "{hand.name}/{pad.link}": '
        key, link = ("mount.link", pad.mount.link) if pad.mount.link else ("link", pad.link)
        if link not in robot.bodies:
            remedy = _no_such("link", link, list(robot.bodies))
            yield Problem(f"{at}{key}", _is(link), f"{remedy}; mount.link names the one that carries the pad")
        else:
            yield from _mount_problems(at, pad, link, robot)


def _mount_problems(at: str, pad: config.Pad, link: str, robot: Description) -> Iterator[Problem]:
    rotation, middle = mount_of(pad)
    outward = middle + _OUTWARD_M * rotation[:, 2]
    here, above = distance_m(robot.bodies[link], np.stack([middle, outward]), robot.path.parent).tolist()
    if here == np.inf:
        return  # nothing is known of the body
    body = f'the body of link "{link}"'
    if here < -_DEEPEST_M:
        yield Problem(
            f"{at}mount.position_mm",
            _is(pad.mount.position_mm),
            f"the middle of the pad is {-here * 1e3:.1f} mm inside {body}; move it out to the surface",
        )
    elif here > _FARTHEST_M:
        yield Problem(
            f"{at}mount.position_mm",
            _is(pad.mount.position_mm),
            f"the middle of the pad is {here * 1e3:.1f} mm off {body}; is it on another link, or in metres?",
        )
    elif above <= here:
        yield Problem(
            f"{at}mount.rpy_deg",
            _is(pad.mount.rpy_deg),
            f"the pad faces into {body}; its z axis points outward",
        )


def _no_such(what: str, name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    meant = f'did you mean "{near[0]}"? ' if near else ""
    return f"the URDF has no such {what}; {meant}it has {', '.join(known)}"


def _is(value: object) -> str:
    return f" = {json.dumps(value, ensure_ascii=False)}"
