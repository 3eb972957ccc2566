"""Kinematics agree with products of transforms, for the shipped hand and a third-party one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch.config import shipped
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand import urdf
from handtouch.hand.kinematics import HandKinematics

FloatArray = NDArray[np.float64]
WITH_MIMIC = """
<robot name="r">
  <link name="base"/><link name="palm"/><link name="turn"/><link name="slide"/><link name="follow"/>
  <joint name="wrist" type="revolute"><parent link="base"/><child link="palm"/>
    <origin xyz="0.1 0 0" rpy="0.1 0.2 0.3"/>
    <axis xyz="0 1 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="turn" type="continuous"><parent link="palm"/><child link="turn"/>
    <origin xyz="0 0.1 0" rpy="0.5 0 0"/>
    <axis xyz="0 0 1"/></joint>
  <joint name="slide" type="prismatic"><parent link="turn"/><child link="slide"/><origin xyz="0 0.1 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="follow" type="revolute"><parent link="slide"/><child link="follow"/><origin xyz="0 0 0.1"/>
    <axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>
    <mimic joint="turn" multiplier="-0.5" offset="0.2"/>
  </joint>
</robot>
"""


def pose(robot: urdf.RobotDescription, link: str, position: dict[str, float]) -> FloatArray:
    """Homogeneous transform (4, 4) from a link to the root."""
    found = np.eye(4)
    for joint in robot.joint_chain(link):
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = joint.rotation, joint.translation_m
        move = np.eye(4)
        name, factor, offset = joint.mimic or (joint.name, 1.0, 0.0)
        by = factor * position.get(name, 0.0) + offset
        if joint.kind == "prismatic":
            move[:3, 3] = by * joint.axis
        elif joint.kind != "fixed":
            move[:3, :3] = Rotation.from_rotvec(by * joint.axis).as_matrix()
        found = found @ step @ move
    return found


@pytest.fixture(scope="module", params=["shipped", "allegro", "mimic"])
def hand(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, allegro: Path
) -> tuple[urdf.RobotDescription, HandKinematics]:
    path = {"shipped": shipped.path("utah_mit.urdf"), "allegro": allegro}.get(request.param)
    if path is None:
        path = tmp_path_factory.mktemp("urdf") / "mimic.urdf"
        path.write_text(WITH_MIMIC)
    robot = urdf.read_urdf(path)
    palm = {"shipped": "palm", "allegro": "palm_link", "mimic": "palm"}[request.param]
    return robot, HandKinematics(robot, list(robot.bodies), palm, robot.root)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_poses_equal_products_of_joint_transforms(
    hand: tuple[urdf.RobotDescription, HandKinematics], seed: int
) -> None:
    robot, kinematics = hand
    poses = LinkPoses(kinematics)
    position = np.random.default_rng(seed).uniform(-1.5, 1.5, len(kinematics.joints))
    poses.set_joint_positions(position)
    by_name = dict(zip(kinematics.joints, position.tolist(), strict=True))
    palm = pose(robot, "palm" if "palm" in robot.bodies else "palm_link", by_name)
    for number, link in enumerate(robot.bodies):
        in_base = pose(robot, link, by_name)
        for expected, found in (
            (in_base, poses.pose_in_base(number)),
            (np.linalg.solve(palm, in_base), poses.pose_in_palm(number)),
        ):
            np.testing.assert_allclose(found.rotation, expected[:3, :3], atol=1e-12)
            np.testing.assert_allclose(found.translation_m, expected[:3, 3], atol=1e-12)


@st.composite
def trees(draw: st.DrawFn) -> tuple[str, list[str]]:
    """URDF of a random tree of all kinds of joints, some mimicking others, and its links but the root."""
    number = st.floats(-2.0, 2.0).map(lambda value: round(value, 6))
    lines, count = ['<link name="l0"/>'], draw(st.integers(1, 8))
    movable: list[str] = []
    for k in range(1, count + 1):
        kinds = ["revolute", "continuous", "prismatic", "fixed"]
        kind = draw(st.sampled_from(kinds[:3] if k == 1 else kinds))  # Pinocchio needs one that moves
        xyz, rpy = (" ".join(str(draw(number)) for _ in range(3)) for _ in range(2))
        axis = draw(st.sampled_from(["1 0 0", "0 -1 0", "0 0 1", "1 -2 3", "0.3 0.4 0"]))
        parts = f'<parent link="l{draw(st.integers(0, k - 1))}"/><child link="l{k}"/>'
        parts += f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        if kind in ("revolute", "prismatic"):
            parts += '<limit lower="-9" upper="9" effort="1" velocity="1"/>'
        if kind != "fixed" and movable and draw(st.booleans()):
            mimicked, factor, offset = draw(st.sampled_from(movable)), draw(number), draw(number)
            parts += f'<mimic joint="{mimicked}" multiplier="{factor}" offset="{offset}"/>'
        elif kind != "fixed":
            movable.append(f"j{k}")
        lines += [f'<link name="l{k}"/>', f'<joint name="j{k}" type="{kind}">{parts}</joint>']
    return f'<robot name="r">{"".join(lines)}</robot>', [f"l{k}" for k in range(count + 1)]


@settings(max_examples=40, deadline=None)
@given(tree=trees(), seed=st.integers(0, 2**32 - 1))
def test_poses_and_covariances_equal_those_of_pinocchio(tree: tuple[str, list[str]], seed: int) -> None:
    pinocchio = pytest.importorskip("pinocchio")
    text, links = tree
    robot, rng = urdf.parse_urdf(text), np.random.default_rng(seed)
    palm = str(rng.choice(links))
    kinematics = HandKinematics(robot, links, palm, "l0")
    poses, position = LinkPoses(kinematics), rng.uniform(-3, 3, len(kinematics.joints))
    poses.set_joint_positions(position)
    given = dict(zip(kinematics.joints, position.tolist(), strict=True))
    model = pinocchio.buildModelFromXML(text)
    q, by_joint = pinocchio.neutral(model), np.zeros((model.nv, len(given)))
    for number in range(1, model.njoints):
        joint, name = model.joints[number], model.names[number]
        mover, factor, offset = robot.joints[name].mimic or (name, 1.0, 0.0)
        value = factor * given.get(mover, 0.0) + offset
        turned = [math.cos(value), math.sin(value)]
        q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else turned
        if mover in given:
            by_joint[joint.idx_v, kinematics.joints.index(mover)] = factor
    data = model.createData()
    pinocchio.computeJointJacobians(model, data, q)
    pinocchio.updateFramePlacements(model, data)
    frame = {link: model.getFrameId(link, pinocchio.FrameType.BODY) for link in links}
    twist = {
        link: pinocchio.getFrameJacobian(model, data, at, pinocchio.WORLD).reshape(6, model.nv)
        for link, at in frame.items()
    }
    point, std = rng.normal(size=3), rng.uniform(0, 1, len(given))
    for number, link in enumerate(links):
        for other, in_base in ((palm, False), ("l0", True)):
            expected = data.oMf[frame[other]].actInv(data.oMf[frame[link]])
            found = poses.pose_in_base(number) if in_base else poses.pose_in_palm(number)
            np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-12)
            np.testing.assert_allclose(found.translation_m, expected.translation, atol=1e-12)
            linear, angular = np.split(twist[link] - twist[other], 2)
            moved = linear + np.cross(angular.T, data.oMf[frame[link]].act(point)).T
            slope = data.oMf[frame[other]].rotation.T @ moved @ by_joint * std
            covariance = poses.joint_covariance_m2(number, point, std, in_base)
            np.testing.assert_allclose(covariance, slope @ slope.T, rtol=1e-12, atol=1e-10)


def test_covariances_of_single_joints_are_squares_of_finite_differences(
    hand: tuple[urdf.RobotDescription, HandKinematics],
) -> None:
    _, kinematics = hand
    poses, m, link = LinkPoses(kinematics), len(kinematics.joints), len(kinematics.palm_joint_mask) - 1
    position, point = np.random.default_rng(3).uniform(-1, 1, m), np.array([0.01, -0.02, 0.03])

    def at(joints: FloatArray, in_base: bool) -> FloatArray:
        poses.set_joint_positions(joints)
        found = poses.pose_in_base(link) if in_base else poses.pose_in_palm(link)
        return np.asarray(found.rotation @ point + found.translation_m)

    for in_base in (False, True):
        needed = (kinematics.base_joint_mask if in_base else kinematics.palm_joint_mask)[link]
        for joint, step in enumerate(1e-6 * np.eye(m)):
            slope = (at(position + step, in_base) - at(position - step, in_base)) / 2e-6
            poses.set_joint_positions(position)
            covariance = poses.joint_covariance_m2(link, point, np.eye(m)[joint], in_base)
            np.testing.assert_allclose(covariance, np.outer(slope, slope), atol=1e-8)
            assert needed[joint] == (covariance.trace() > 1e-12)


def test_shipped_hand_has_sixteen_joints_and_closes_over_its_palm() -> None:
    robot = urdf.read_urdf(shipped.path("utah_mit.urdf"))
    tips = ["thumb_distal", "index_distal", "middle_distal", "ring_distal"]
    kinematics = HandKinematics(robot, [*tips, "palm_heel"], "palm", "base")
    assert len(kinematics.joints) == 16
    assert kinematics.palm_joint_mask.sum(axis=1).tolist() == [4, 4, 4, 4, 0]
    poses = LinkPoses(kinematics)
    closed = np.array([0.0 if name.endswith("abduction") else 0.9 for name in kinematics.joints])
    for number, tip in enumerate(tips):
        poses.set_joint_positions(np.zeros(16))
        open_hand = poses.pose_in_palm(number).translation_m.copy()
        poses.set_joint_positions(closed)
        found = poses.pose_in_palm(number).translation_m
        assert found[2] > 0.02, tip  # out of the palm
        assert abs(found[0]) < abs(open_hand[0]) + 0.01
    poses.set_joint_positions(closed)
    thumb, index = poses.pose_in_palm(0).translation_m, poses.pose_in_palm(1).translation_m
    assert math.dist(thumb, index) < 0.1


def test_mimicking_joints_follow_and_need_no_state(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(WITH_MIMIC)
    kinematics = HandKinematics(urdf.read_urdf(path), ["follow"], "palm", "base")
    assert kinematics.joints == ("wrist", "turn", "slide")
    assert kinematics.continuous.tolist() == [False, True, False]
    assert kinematics.palm_joint_mask.tolist() == [[False, True, True]]
