"""Contacts in palm and base: by the joints at the sample, with their covariance, and never on old joints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch import shipped
from handtouch.config import load
from handtouch.daemon.frames import Frames
from handtouch.daemon.tick import Columns, Ticked
from handtouch.hand.joints import Joints, JointStates
from handtouch.hand.robot import Robots

MS = 1_000_000
NONE = np.zeros(0, dtype=np.intp)
DEPLOYMENT = load(shipped.path("utah_mit.toml"))
ROBOTS = Robots(DEPLOYMENT)
PADS = [pad.link for pad in DEPLOYMENT.hands[0].pads]
NAMES = ROBOTS.joint_names[0]
TIP, MIDDLE, PROXIMAL = (PADS.index(f"index_{phalanx}") for phalanx in ("distal", "middle", "proximal"))
HEEL = PADS.index("palm_heel")


class Touched:
    """The shipped hand with contacts on some pads, at 100 ms."""

    def __init__(self, *pads: int, joints: JointStates | None = None, robots: Robots = ROBOTS) -> None:
        n = len(PADS)
        self.columns, self.ids = Columns.of(n), np.zeros(n, dtype=np.uint32)
        rng = np.random.default_rng(1)
        for pad in pads:
            self.ids[pad] = pad + 1
            self.columns.position_m[pad] = rng.normal(size=3) * 0.01
            normal = rng.normal(size=3)
            self.columns.normal[pad] = normal / np.linalg.norm(normal)
            root = rng.normal(size=(3, 2)) * 1e-4
            self.columns.covariance_m2[pad] = root @ root.T
        self.columns.sample_ns[:] = 100 * MS
        self.pads = np.array(pads, dtype=np.intp)
        self.frames = Frames(["right"] * n, robots)
        if joints is not None:
            self.frames.joints_at = lambda _, t_ns: joints.at(t_ns)
        everything = np.ones(n, dtype=np.bool_)
        self.frames.want(everything, everything)

    def step(self) -> Frames:
        self.frames.step(Ticked(100 * MS, self.pads, NONE, NONE), self.columns, self.ids)
        return self.frames


def told(t_ms: float, value: float | NDArray[np.float64] = 0.3, std: float | None = None) -> JointStates:
    states = JointStates(NAMES)
    deviations = None if std is None else np.full(len(NAMES), std)
    states.take(round(t_ms * MS), NAMES, np.zeros(len(NAMES)) + value, None, deviations)
    return states


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_place_normal_and_covariance_are_carried_by_the_pose_of_the_link(seed: int) -> None:
    position = np.random.default_rng(seed).uniform(-0.5, 1.5, len(NAMES))
    touched = Touched(TIP, HEEL, joints=told(100, position))
    frames, columns = touched.step(), touched.columns
    kinematics = ROBOTS.kinematics[0]
    kinematics.move(position)
    for pad in (TIP, HEEL):
        contact = frames.tell(pad)
        for name, pose in (("palm", kinematics.in_palm(pad)), ("base", kinematics.in_base(pad))):
            assert contact[name] == "valid"
            expected = pose.rotation @ columns.position_m[pad] + pose.translation_m
            np.testing.assert_allclose(contact[f"{name}_position_m"], expected, atol=1e-12)
            np.testing.assert_allclose(
                contact[f"{name}_normal"], pose.rotation @ columns.normal[pad], atol=1e-12
            )
            covariance = np.reshape(contact[f"{name}_covariance_m2"], (3, 3))
            turned = pose.rotation @ columns.covariance_m2[pad] @ pose.rotation.T
            np.testing.assert_allclose(covariance, turned, atol=1e-18)
            spread = np.linalg.eigvalsh(covariance)
            np.testing.assert_allclose(spread, np.linalg.eigvalsh(columns.covariance_m2[pad]), atol=1e-16)


def test_joints_are_those_at_the_time_of_the_sample() -> None:
    states = told(95, 0.2)
    states.take(105 * MS, NAMES, np.full(len(NAMES), 0.4))
    between, exact = Touched(TIP, joints=states).step(), Touched(TIP, joints=told(100, 0.3)).step()
    np.testing.assert_allclose(
        between.tell(TIP)["palm_position_m"], exact.tell(TIP)["palm_position_m"], atol=1e-12
    )
    assert between.tell(TIP)["joints_age_s"] == pytest.approx(0.005)


def test_uncertain_joints_widen_the_covariance_as_samples_of_them_do() -> None:
    std = 0.01
    position = np.full(len(NAMES), 0.5)
    sure, unsure = (Touched(TIP, joints=told(100, position, s)).step() for s in (None, std))
    added = np.reshape(unsure.tell(TIP)["palm_covariance_m2"], (3, 3)) - np.reshape(
        sure.tell(TIP)["palm_covariance_m2"], (3, 3)
    )
    rng = np.random.default_rng(2)
    touched = Touched(TIP)

    def joints_at(_: str, t_ns: int) -> Joints:
        about = position + std * rng.normal(size=len(NAMES))
        return Joints(t_ns, about, np.zeros(len(NAMES)), np.zeros(len(NAMES)))

    touched.frames.joints_at = joints_at
    places = [touched.step().tell(TIP)["palm_position_m"] for _ in range(2000)]
    np.testing.assert_allclose(added, np.cov(np.array(places).T), atol=0.1 * added.max())


def stating(**tolerances: float) -> Robots:
    """The shipped hand, whose file tells these tolerances."""
    hand = DEPLOYMENT.hands[0].model_copy(update=tolerances)
    return Robots(DEPLOYMENT.model_copy(update={"hands": (hand,)}))


def test_stated_tolerances_of_mounts_widen_covariances_as_pads_that_sit_a_little_off_do() -> None:
    place_mm, turn_deg = 0.2, 2.0
    position = np.full(len(NAMES), 0.5)
    stated, unstated = (
        Touched(TIP, joints=told(100, position), robots=robots)
        for robots in (stating(mount_std_mm=place_mm, mount_std_deg=turn_deg), ROBOTS)
    )
    on_link = np.array([0.0, 0.01, 0.01])  # 1 cm or so from the middle of the pad
    middle_m = np.array(DEPLOYMENT.hands[0].pads[TIP].mount.position_mm) * 1e-3
    for touched in (stated, unstated):
        touched.columns.position_m[TIP] = middle_m + on_link
        touched.step()
    kinematics = ROBOTS.kinematics[0]
    kinematics.move(position)
    rng = np.random.default_rng(4)
    moved = 1e-3 * place_mm * rng.normal(size=(20_000, 3))
    moved += np.cross(np.radians(turn_deg) * rng.normal(size=(20_000, 3)), on_link)
    for frame, pose in (("palm", kinematics.in_palm(TIP)), ("base", kinematics.in_base(TIP))):
        wide, narrow = (
            np.reshape(touched.frames.tell(TIP)[f"{frame}_covariance_m2"], (3, 3))
            for touched in (stated, unstated)
        )
        drawn = np.cov(moved @ pose.rotation.T, rowvar=False)
        np.testing.assert_allclose(wide - narrow, drawn, atol=0.03 * drawn.max())


def test_the_stated_error_of_joints_counts_where_joint_states_tell_none() -> None:
    std = 0.01
    robots = stating(joint_std_deg=np.degrees(std), joint_std_mm=1e3)  # none of them slides
    by_file = Touched(TIP, HEEL, joints=told(100), robots=robots).step()
    by_states = Touched(TIP, HEEL, joints=told(100, std=std)).step()
    surer = Touched(TIP, HEEL, joints=told(100, std=std / 2), robots=robots).step()
    for pad in (TIP, HEEL):
        assert by_file.tell(pad) == by_states.tell(pad)
    trace = [sum(of.tell(TIP)["palm_covariance_m2"][::4]) for of in (by_states, surer)]
    assert trace[1] < 0.5 * trace[0]


def test_old_joints_give_no_place_but_their_age_and_what_no_joint_moves_stays_valid() -> None:
    frames = Touched(TIP, HEEL, joints=told(100 - 150)).step()
    tip, heel = frames.tell(TIP), frames.tell(HEEL)
    assert tip["palm"] == tip["base"] == "stale"
    assert "palm_position_m" not in tip
    assert tip["joints_age_s"] == pytest.approx(0.15)
    assert heel["palm"] == heel["base"] == "valid"
    assert heel["joints_age_s"] == 0.0


def test_joints_that_nobody_told_and_places_that_are_not_known_are_invalid() -> None:
    frames = Touched(TIP, HEEL).step()
    assert frames.tell(TIP)["palm"] == "invalid"
    assert frames.tell(TIP)["joints_age_s"] is None
    assert frames.tell(HEEL)["palm"] == "valid"
    touched = Touched(TIP, joints=told(100))
    touched.columns.position_m[TIP] = np.nan
    assert touched.step().tell(TIP)["palm"] == "invalid"


def test_what_joints_put_into_a_place_is_told_apart_from_the_rest_of_its_covariance() -> None:
    sure = Touched(TIP, joints=told(100, 0.2)).step()
    shaky = Touched(TIP, joints=told(100, 0.2, std=2e-3)).step()
    (_, _, _, none), (placed, _, _, some) = (frames.in_palm(np.array([TIP])) for frames in (sure, shaky))
    more = np.trace((placed - sure.in_palm(np.array([TIP]))[0])[0, 6:].reshape(3, 3)) / 3
    assert none[0] == 0.0
    assert some[0] == pytest.approx(more, rel=1e-6)
    assert 1e-5 < some[0] ** 0.5 < 1e-3


def test_poses_by_commands_are_those_of_joint_states_that_are_alike() -> None:
    touched = Touched(TIP, HEEL, joints=told(100, 0.2))
    frames, rows = touched.step(), np.array([TIP, HEEL])
    placed, rotation, *_ = frames.in_palm(rows)
    poses = frames.told_poses(rows, 100 * MS, lambda _, t_ns: told(100, 0.2).at(t_ns))
    np.testing.assert_allclose(poses[:, :, :3], rotation, atol=1e-12)
    carried = (poses[:, :, :3] @ touched.columns.position_m[rows][:, :, None])[:, :, 0] + poses[:, :, 3]
    np.testing.assert_allclose(carried, placed[:, :3], atol=1e-12)
    nobody = frames.told_poses(rows, 100 * MS, lambda _, t_ns: JointStates(NAMES).at(t_ns))
    assert np.isnan(nobody[0]).all()  # a finger's needs joints, the palm's heel none
    assert np.isfinite(nobody[1]).all()


def test_a_hand_whose_description_is_no_use_has_no_place_but_its_links() -> None:
    hand = DEPLOYMENT.hands[0].model_copy(update={"urdf": None})
    nobody = Robots(DEPLOYMENT.model_copy(update={"hands": (hand,)}))
    touched = Touched(TIP, joints=told(100), robots=nobody)
    told_of = touched.step().tell(TIP)
    assert (told_of["palm"], told_of["base"]) == ("invalid", "invalid")
    assert told_of["group"] == TIP + 1


def test_nothing_is_computed_that_no_scene_asks_for() -> None:
    touched = Touched(TIP, HEEL, joints=told(100))
    asked: list[str] = []

    def joints_at(hand: str, _: int) -> None:
        asked.append(hand)

    touched.frames.joints_at = joints_at
    nobody = np.zeros(len(PADS), dtype=np.bool_)
    touched.frames.want(nobody, nobody)
    frames = touched.step()
    assert not asked
    assert frames.tell(TIP) == {}
    assert frames.columns(slice(0, len(PADS))) == {}
    only = nobody.copy()
    only[TIP] = True
    touched.frames.want(only, nobody)
    frames = touched.step()
    assert asked == ["right"]
    assert frames.tell(HEEL) == {}
    assert frames.tell(TIP)["base"] == "skipped"


def test_the_columns_of_a_hand_say_what_the_contacts_say_and_forget_what_ended() -> None:
    touched = Touched(TIP, HEEL, joints=told(100))
    frames = touched.step()
    rows = slice(0, len(PADS))
    columns = frames.columns(rows)
    places = np.frombuffer(columns["palm_position_m"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(places[TIP], frames.tell(TIP)["palm_position_m"], atol=1e-7)
    state = np.frombuffer(columns["palm"], "<u1")
    assert (np.flatnonzero(state) == sorted([TIP, HEEL])).all()
    assert np.isnan(np.delete(places, [TIP, HEEL], axis=0)).all()
    frames.forget(np.array([TIP]))
    assert not np.frombuffer(frames.columns(rows)["palm"], "<u1")[TIP]


def test_an_object_across_two_phalanges_is_one_group_also_while_joints_are_old() -> None:
    states = told(100, 0.0)
    touched = Touched(MIDDLE, PROXIMAL, HEEL, joints=states)
    touched.columns.position_m[MIDDLE] = 0.008, 0.0, 0.01  # just beyond the joint, and just before it
    touched.columns.position_m[PROXIMAL] = 0.042, 0.0, 0.011
    touched.columns.normal[:] = 0.0, 0.0, 1.0
    frames = touched.step()
    group = frames.tell(MIDDLE)["group"]
    assert group == frames.tell(PROXIMAL)["group"] == min(MIDDLE, PROXIMAL) + 1
    assert frames.tell(HEEL)["group"] == HEEL + 1
    touched.columns.sample_ns[:] = 900 * MS
    frames = touched.step()
    assert frames.tell(MIDDLE)["palm"] == "stale"
    assert frames.tell(MIDDLE)["group"] == frames.tell(PROXIMAL)["group"] == group


def test_what_a_step_used_is_kept_for_recorders() -> None:
    touched = Touched(TIP, HEEL, joints=told(100, 0.3))
    touched.columns.sample_ns[HEEL] = 90 * MS
    frames = touched.step()
    assert [(hand, t_ns) for hand, t_ns, *_ in frames.used] == [("right", 90 * MS), ("right", 100 * MS)]
    again = Touched(TIP, HEEL)
    again.columns.sample_ns[HEEL] = 90 * MS
    again.frames.recall(frames.journal())
    assert again.step().tell(TIP) == frames.tell(TIP)
    assert again.frames.journal() == frames.journal()
