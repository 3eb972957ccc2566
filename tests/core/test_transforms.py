"""Contacts in palm and base: joints at the sample's time, covariance, stale joint states."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch.config import load, shipped
from handtouch.core.columns import PadColumns, TickResult
from handtouch.core.stages.frames import ContactTransforms
from handtouch.core.stages.kinematics import LinkPose, LinkPoses
from handtouch.core.stages.rows import PART_COUNT
from handtouch.core.state import TickState
from handtouch.hand.joints import JointSnapshot, JointStateBuffer
from handtouch.hand.robot_models import RobotModels
from handtouch.wire import FrameStatus

MS = 1_000_000
NONE = np.zeros(0, dtype=np.intp)
DEPLOYMENT = load(shipped.path("utah_mit.toml"))
EXACT_HAND = DEPLOYMENT.hands[0].model_copy(
    update={"mount_std_mm": 0.0, "mount_std_deg": 0.0, "joint_std_deg": 0.0}
)
ROBOTS = RobotModels(DEPLOYMENT.model_copy(update={"hands": (EXACT_HAND,)}))
PADS = [pad.link for pad in DEPLOYMENT.hands[0].pads]
NAMES = ROBOTS.joint_names[0]
TIP, MIDDLE, PROXIMAL = (PADS.index(f"index_{phalanx}") for phalanx in ("distal", "middle", "proximal"))
HEEL = PADS.index("palm_heel")


class ReadTransforms(ContactTransforms):
    """Transforms whose state is read by the names of the fields of contact messages."""

    def __init__(self, pads: int, robots: RobotModels) -> None:
        self.state = TickState.empty(pads)
        super().__init__(["right"] * pads, robots, self.state)

    def contact_fields(self, pad: int) -> dict[str, Any]:
        state, fields = self.state, dict[str, Any]()
        if not (state.palm_requested[pad] or state.base_requested[pad]):
            return fields
        age_s = float(state.palm_values[pad, 30])
        fields["group"], fields["joints_age_s"] = int(self.group[pad]), None if np.isnan(age_s) else age_s
        for frame, status, at in (("palm", state.palm_status, 0), ("base", state.base_status, 15)):
            fields[f"{frame}_status"] = FrameStatus(int(status[pad])).text
            if status[pad] == FrameStatus.VALID:
                values = state.palm_values[pad, at : at + 15].tolist()
                fields[f"{frame}_position_m"], fields[f"{frame}_normal"] = values[:3], values[3:6]
                fields[f"{frame}_covariance_m2"] = values[6:]
                first = 3 * (frame == "base")
                fields[f"{frame}_force_vector_n"] = state.frame_force_vector[pad, first : first + 3].tolist()
        return fields


class TouchedHand:
    """The shipped hand with contacts on some pads, at 100 ms."""

    def __init__(
        self, *pads: int, joints: JointStateBuffer | None = None, robots: RobotModels = ROBOTS
    ) -> None:
        n = len(PADS)
        self.transforms = ReadTransforms(n, robots)
        self.columns = PadColumns.of_state(self.transforms.state)
        rng = np.random.default_rng(1)
        for pad in pads:
            self.transforms.state.contact_id[pad] = pad + 1
            self.columns.position_m[pad] = rng.normal(size=3) * 0.01
            normal = rng.normal(size=3)
            self.columns.normal[pad] = normal / np.linalg.norm(normal)
            self.transforms.state.force_vector[pad, :3] = rng.normal(size=3)
            root = rng.normal(size=(3, 2)) * 1e-4
            self.columns.covariance_m2[pad] = root @ root.T
        self.columns.sample_ns[:] = 100 * MS
        self.pads = np.array(pads, dtype=np.intp)
        if joints is not None:
            self.transforms.joints_at = lambda _, t_ns: joints.interpolate(t_ns)
        everything = np.ones(n, dtype=np.bool_)
        self.transforms.set_requested(everything, everything)

    def step(self) -> ReadTransforms:
        self.transforms.transform_updated(TickResult(100 * MS, self.pads, NONE, NONE, NONE))
        return self.transforms


def joint_states(
    t_ms: float, value: float | NDArray[np.float64] = 0.3, std: float | None = None
) -> JointStateBuffer:
    states = JointStateBuffer(NAMES)
    deviations = None if std is None else np.full(len(NAMES), std)
    states.add_state(round(t_ms * MS), NAMES, np.zeros(len(NAMES)) + value, None, deviations)
    return states


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_position_normal_and_covariance_are_transformed_by_the_pose_of_the_link(seed: int) -> None:
    position = np.random.default_rng(seed).uniform(-0.5, 1.5, len(NAMES))
    touched = TouchedHand(TIP, HEEL, joints=joint_states(100, position))
    frames, columns = touched.step(), touched.columns
    poses = LinkPoses(ROBOTS.kinematics[0])
    poses.set_joint_positions(position)
    for pad in (TIP, HEEL):
        contact = frames.contact_fields(pad)
        for name, pose in (("palm", poses.pose_in_palm(pad)), ("base", poses.pose_in_base(pad))):
            assert contact[f"{name}_status"] == "valid"
            expected = pose.rotation @ columns.position_m[pad] + pose.translation_m
            np.testing.assert_allclose(contact[f"{name}_position_m"], expected, atol=1e-12)
            np.testing.assert_allclose(
                contact[f"{name}_normal"], pose.rotation @ columns.normal[pad], atol=1e-12
            )
            turned = pose.rotation @ touched.transforms.state.force_vector[pad, :3]
            np.testing.assert_allclose(contact[f"{name}_force_vector_n"], turned, atol=1e-12)
            covariance = np.reshape(contact[f"{name}_covariance_m2"], (3, 3))
            rotated = pose.rotation @ columns.covariance_m2[pad] @ pose.rotation.T
            np.testing.assert_allclose(covariance, rotated, atol=1e-18)
            spread = np.linalg.eigvalsh(covariance)
            np.testing.assert_allclose(spread, np.linalg.eigvalsh(columns.covariance_m2[pad]), atol=1e-16)


def test_joints_are_interpolated_to_the_time_of_the_sample() -> None:
    states = joint_states(95, 0.2)
    states.add_state(105 * MS, NAMES, np.full(len(NAMES), 0.4))
    between, exact = (
        TouchedHand(TIP, joints=states).step(),
        TouchedHand(TIP, joints=joint_states(100, 0.3)).step(),
    )
    np.testing.assert_allclose(
        between.contact_fields(TIP)["palm_position_m"],
        exact.contact_fields(TIP)["palm_position_m"],
        atol=1e-12,
    )
    assert between.contact_fields(TIP)["joints_age_s"] == pytest.approx(0.005)


def test_uncertainty_of_joints_adds_their_sampled_covariance() -> None:
    std = 0.01
    position = np.full(len(NAMES), 0.5)
    exact, uncertain = (TouchedHand(TIP, joints=joint_states(100, position, s)).step() for s in (None, std))
    added = np.reshape(uncertain.contact_fields(TIP)["palm_covariance_m2"], (3, 3)) - np.reshape(
        exact.contact_fields(TIP)["palm_covariance_m2"], (3, 3)
    )
    rng = np.random.default_rng(2)
    touched = TouchedHand(TIP)

    def joints_at(_: str, t_ns: int) -> JointSnapshot:
        about = position + std * rng.normal(size=len(NAMES))
        return JointSnapshot(t_ns, about, np.zeros(len(NAMES)), np.zeros(len(NAMES)))

    touched.transforms.joints_at = joints_at
    positions = [touched.step().contact_fields(TIP)["palm_position_m"] for _ in range(2000)]
    np.testing.assert_allclose(added, np.cov(np.array(positions).T), atol=0.1 * added.max())


def stating(**tolerances: float) -> RobotModels:
    """Return the shipped hand with tolerances in its file."""
    hand = EXACT_HAND.model_copy(update=tolerances)
    return RobotModels(DEPLOYMENT.model_copy(update={"hands": (hand,)}))


def test_mount_tolerances_add_the_covariance_of_displaced_pads() -> None:
    position_mm, angle_deg = 0.2, 2.0
    position = np.full(len(NAMES), 0.5)
    stated, unstated = (
        TouchedHand(TIP, joints=joint_states(100, position), robots=robots)
        for robots in (stating(mount_std_mm=position_mm, mount_std_deg=angle_deg), ROBOTS)
    )
    on_link = np.array([0.0, 0.01, 0.01])  # 1 cm or so from the middle of the pad
    middle_m = np.array(DEPLOYMENT.hands[0].pads[TIP].mount.position_mm) * 1e-3
    for touched in (stated, unstated):
        touched.columns.position_m[TIP] = middle_m + on_link
        touched.step()
    poses = LinkPoses(ROBOTS.kinematics[0])
    poses.set_joint_positions(position)
    rng = np.random.default_rng(4)
    moved = 1e-3 * position_mm * rng.normal(size=(20_000, 3))
    moved += np.cross(np.radians(angle_deg) * rng.normal(size=(20_000, 3)), on_link)
    for frame, pose in (("palm", poses.pose_in_palm(TIP)), ("base", poses.pose_in_base(TIP))):
        wide, narrow = (
            np.reshape(touched.transforms.contact_fields(TIP)[f"{frame}_covariance_m2"], (3, 3))
            for touched in (stated, unstated)
        )
        drawn = np.cov(moved @ pose.rotation.T, rowvar=False)
        np.testing.assert_allclose(wide - narrow, drawn, atol=0.03 * drawn.max())


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_covariance_sums_those_of_contact_mount_and_joints(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mount_mm, mount_deg, joint_deg = rng.uniform(0, 1, 3)
    robots = stating(mount_std_mm=mount_mm, mount_std_deg=mount_deg, joint_std_deg=joint_deg)
    position = rng.uniform(-0.5, 1.5, len(NAMES))
    touched = TouchedHand(TIP, HEEL, joints=joint_states(100, position), robots=robots)
    frames, poses = touched.step(), LinkPoses(ROBOTS.kinematics[0])
    for pad, frame in itertools.product((TIP, HEEL), ("palm", "base")):
        at = touched.columns.position_m[pad]

        def pose(joints: NDArray[np.float64], pad: int = pad, frame: str = frame) -> LinkPose:
            poses.set_joint_positions(joints)
            return poses.pose_in_palm(pad) if frame == "palm" else poses.pose_in_base(pad)

        def placed(joints: NDArray[np.float64], at: NDArray[np.float64] = at) -> NDArray[np.float64]:
            return np.asarray(pose(joints).rotation @ at + pose(joints).translation_m)

        arm = at - np.array(DEPLOYMENT.hands[0].pads[pad].mount.position_mm) * 1e-3
        turning = np.radians(mount_deg) ** 2 * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        on_link = touched.columns.covariance_m2[pad] + (1e-3 * mount_mm) ** 2 * np.eye(3) + turning
        slopes = [(placed(position + d) - placed(position - d)) / 2e-5 for d in 1e-5 * np.eye(len(NAMES))]
        of_joints = np.radians(joint_deg) ** 2 * np.transpose(slopes) @ slopes
        rotation = pose(position).rotation
        found = np.reshape(frames.contact_fields(pad)[f"{frame}_covariance_m2"], (3, 3))
        np.testing.assert_allclose(found, rotation @ on_link @ rotation.T + of_joints, rtol=1e-6, atol=1e-13)


def test_the_configured_joint_std_applies_to_joint_states_without_one() -> None:
    std = 0.01
    robots = stating(joint_std_deg=np.degrees(std), joint_std_mm=1e3)  # none of them slides
    by_file = TouchedHand(TIP, HEEL, joints=joint_states(100), robots=robots).step()
    by_states = TouchedHand(TIP, HEEL, joints=joint_states(100, std=std)).step()
    smaller = TouchedHand(TIP, HEEL, joints=joint_states(100, std=std / 2), robots=robots).step()
    for pad in (TIP, HEEL):
        assert by_file.contact_fields(pad) == by_states.contact_fields(pad)
    trace = [sum(of.contact_fields(TIP)["palm_covariance_m2"][::4]) for of in (by_states, smaller)]
    assert trace[1] < 0.5 * trace[0]


@pytest.mark.parametrize("stated", [None, 0.01])
def test_backlash_is_part_of_all_joints_errors(stated: float | None) -> None:
    own, play = 0.01, 0.05
    robots = stating(joint_std_deg=np.degrees(own), joint_backlash_deg=np.degrees(play))
    found = TouchedHand(TIP, HEEL, joints=joint_states(100, std=stated), robots=robots).step()
    whole = TouchedHand(TIP, HEEL, joints=joint_states(100, std=np.hypot(own, play / np.sqrt(12)))).step()
    for pad in (TIP, HEEL):
        for frame in ("palm", "base"):
            name = f"{frame}_covariance_m2"
            assert found.contact_fields(pad)[name] == pytest.approx(whole.contact_fields(pad)[name])


def test_stale_joints_give_a_status_and_their_age_and_fixed_links_stay_valid() -> None:
    frames = TouchedHand(TIP, HEEL, joints=joint_states(100 - 150)).step()
    tip, heel = frames.contact_fields(TIP), frames.contact_fields(HEEL)
    assert tip["palm_status"] == tip["base_status"] == "stale"
    assert "palm_position_m" not in tip
    assert tip["joints_age_s"] == pytest.approx(0.15)
    assert heel["palm_status"] == heel["base_status"] == "valid"
    assert heel["joints_age_s"] == 0.0


def test_unknown_joints_and_unknown_positions_are_invalid() -> None:
    frames = TouchedHand(TIP, HEEL).step()
    assert frames.contact_fields(TIP)["palm_status"] == "invalid"
    assert frames.contact_fields(TIP)["joints_age_s"] is None
    assert frames.contact_fields(HEEL)["palm_status"] == "valid"
    touched = TouchedHand(TIP, joints=joint_states(100))
    touched.columns.position_m[TIP] = np.nan
    assert touched.step().contact_fields(TIP)["palm_status"] == "invalid"


def test_the_variance_from_joints_is_available_separately() -> None:
    exact = TouchedHand(TIP, joints=joint_states(100, 0.2)).step()
    uncertain = TouchedHand(TIP, joints=joint_states(100, 0.2, std=2e-3)).step()
    (_, _, _, none), (placed, _, _, some) = (frames.in_palm(np.array([TIP])) for frames in (exact, uncertain))
    more = np.trace((placed - exact.in_palm(np.array([TIP]))[0])[0, 6:].reshape(3, 3)) / 3
    assert none[0] == 0.0
    assert some[0] == pytest.approx(more, rel=1e-6)
    assert 1e-5 < some[0] ** 0.5 < 1e-3


def test_a_hand_without_urdf_has_positions_on_links_only() -> None:
    hand = DEPLOYMENT.hands[0].model_copy(update={"urdf": None})
    without_urdf = RobotModels(DEPLOYMENT.model_copy(update={"hands": (hand,)}))
    touched = TouchedHand(TIP, joints=joint_states(100), robots=without_urdf)
    fields = touched.step().contact_fields(TIP)
    assert (fields["palm_status"], fields["base_status"]) == ("invalid", "invalid")
    assert fields["group"] == TIP + 1


def test_only_requested_outputs_are_computed() -> None:
    touched = TouchedHand(TIP, HEEL, joints=joint_states(100))
    queried: list[str] = []

    def joints_at(hand: str, _: int) -> None:
        queried.append(hand)

    touched.transforms.joints_at = joints_at
    no_pad = np.zeros(len(PADS), dtype=np.bool_)
    touched.transforms.set_requested(no_pad, no_pad)
    frames = touched.step()
    assert not queried
    assert frames.contact_fields(TIP) == {}
    assert frames.hand_columns(slice(0, len(PADS))) == {}
    only = no_pad.copy()
    only[TIP] = True
    touched.transforms.set_requested(only, no_pad)
    frames = touched.step()
    assert queried == ["right"]
    assert frames.contact_fields(HEEL) == {}
    assert frames.contact_fields(TIP)["base_status"] == "not_computed"


def test_hand_columns_equal_the_contacts_and_discard_ended_ones() -> None:
    touched = TouchedHand(TIP, HEEL, joints=joint_states(100))
    frames = touched.step()
    rows = slice(0, len(PADS))
    columns = frames.hand_columns(rows)
    positions = np.frombuffer(columns["palm_position_m"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(positions[TIP], frames.contact_fields(TIP)["palm_position_m"], atol=1e-7)
    state = np.frombuffer(columns["palm_status"], "<u1")
    assert (np.flatnonzero(state) == sorted([TIP, HEEL])).all()
    assert np.isnan(np.delete(positions, [TIP, HEEL], axis=0)).all()
    frames.discard(np.array([TIP]))
    assert not np.frombuffer(frames.hand_columns(rows)["palm_status"], "<u1")[TIP]


def test_an_object_across_two_phalanges_is_one_group_with_stale_joints_too() -> None:
    states = joint_states(100, 0.0)
    touched = TouchedHand(MIDDLE, PROXIMAL, HEEL, joints=states)
    touched.columns.position_m[MIDDLE] = 0.008, 0.0, 0.01  # just beyond the joint, and just before it
    touched.columns.position_m[PROXIMAL] = 0.042, 0.0, 0.011
    touched.columns.normal[:] = 0.0, 0.0, 1.0
    frames = touched.step()
    group = frames.contact_fields(MIDDLE)["group"]
    assert group == frames.contact_fields(PROXIMAL)["group"] == min(MIDDLE, PROXIMAL) + 1
    assert frames.contact_fields(HEEL)["group"] == HEEL + 1
    touched.columns.sample_ns[:] = 900 * MS
    frames = touched.step()
    assert frames.contact_fields(MIDDLE)["palm_status"] == "stale"
    assert frames.contact_fields(MIDDLE)["group"] == frames.contact_fields(PROXIMAL)["group"] == group


def test_used_joints_are_recorded_and_replayed() -> None:
    touched = TouchedHand(TIP, HEEL, joints=joint_states(100, 0.3))
    touched.columns.sample_ns[HEEL] = 90 * MS
    frames = touched.step()
    assert [(hand, t_ns) for hand, t_ns, *_ in frames.used_joints] == [
        ("right", 90 * MS),
        ("right", 100 * MS),
    ]
    replayed = TouchedHand(TIP, HEEL)
    replayed.columns.sample_ns[HEEL] = 90 * MS
    replayed.transforms.replay_joints(frames.recorded_joints())
    assert replayed.step().contact_fields(TIP) == frames.contact_fields(TIP)
    assert replayed.transforms.recorded_joints() == frames.recorded_joints()


def test_two_contacts_on_a_pad_are_transformed_as_its_contact_is() -> None:
    """With the joints' and the mounts' uncertainty; absent again with the contact's next sample."""
    robots = RobotModels(DEPLOYMENT)
    touched = TouchedHand(TIP, HEEL, joints=joint_states(100, 0.4, 0.01), robots=robots)
    state, columns = touched.transforms.state, touched.columns
    contacts = [
        np.concatenate([columns.position_m[pad], columns.normal[pad], columns.covariance_m2[pad].ravel()])
        for pad in (TIP, HEEL)
    ]
    parts = state.parts.reshape(len(PADS), 2, PART_COUNT)
    parts[TIP, :, :15] = contacts[::-1]
    frames = touched.step()
    moved = state.part_frames.reshape(len(PADS), 2, 2, 15)
    own = frames.contact_fields(TIP)
    for number, name in enumerate(("palm", "base")):
        expected = [
            value for key in ("position_m", "normal", "covariance_m2") for value in own[f"{name}_{key}"]
        ]
        np.testing.assert_allclose(moved[TIP, 1, number], expected, rtol=1e-12)
        columns.position_m[TIP], columns.normal[TIP] = contacts[1][:3], contacts[1][3:6]
        columns.covariance_m2[TIP] = contacts[1][6:].reshape(3, 3)
    assert np.isnan(moved[HEEL]).all()
    kept = moved[TIP, 0].copy()
    parts[TIP] = np.nan
    own = touched.step().contact_fields(TIP)  # the other one of the two is now the pad's contact
    np.testing.assert_allclose(kept[0, :3], own["palm_position_m"], rtol=1e-12)
    np.testing.assert_allclose(kept[1, 6:], own["base_covariance_m2"], rtol=1e-9, atol=1e-18)
    assert np.isnan(moved[TIP]).all()
