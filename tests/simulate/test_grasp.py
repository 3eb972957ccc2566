"""Grasps in MuJoCo: forces are those that MuJoCo applies, contacts lie on the held object."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks import grasp_run
from benchmarks.event_score import (
    EventScore,
    compare_contacts,
    ideal_contact_spans,
    merge_spans,
    touch_spans,
)
from handtouch import config
from handtouch.cli import main
from handtouch.config import shipped
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.pads import mount_transform
from handtouch.hand.robot_models import RobotModels
from handtouch.simulate import grasp as grasping
from handtouch.simulate.contact_patch import ContactPatch
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.grasp_stimulus import EncoderErrors, GraspStimulus, pad_forces
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S, MujocoPad, MujocoScene
from handtouch.simulate.grasp.patches import ContactPatches, clip_to_pad, contact_patches
from handtouch.simulate.grasp.simulation import GraspRecord, hand_contacts, simulate_grasp
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, ElectronicsSpread, Fixed, World
from tests.simulate.surfaces import SURFACE_TABLES

FloatArray = NDArray[np.float64]

HAND = config.load(shipped.path("utah_mit.toml"))
PADS = HAND.hands[0].pads
SHORT_S = 2.2  # closed, released, squeezing
HELD_S = 1.7  # by the hand alone


@pytest.fixture(scope="module")
def ball() -> GraspRecord:
    """Record of a grasped ball."""
    return simulate_grasp(HAND.hands[0], "ball", 1, duration_s=SHORT_S)


@pytest.fixture(scope="module")
def pressed(ball: GraspRecord) -> ContactPatches:
    return contact_patches(ball)


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(PADS), st.floats(0, 1), st.floats(0, 1), st.floats(-2e-3, 2e-3))
def test_point_above_a_surface_projects_to_its_foot(
    pad: config.Pad, x: float, y: float, height_m: float
) -> None:
    shape = simulated_surface(pad.surface)
    at = x * shape.length_m, y * shape.arc
    normal = shape.normal(*at)
    found = shape.project((shape.point(*at) + height_m * normal)[None])
    np.testing.assert_allclose(found.fraction[0], (x, y), atol=1e-12)
    np.testing.assert_allclose(found.height_m[0], height_m, atol=1e-12)
    np.testing.assert_allclose(found.normal[0], normal, atol=1e-12)


def test_contact_forces_of_a_link_sum_to_mujocos_net_force() -> None:
    mujoco = pytest.importorskip("mujoco")
    compared = []

    def watch(scene: MujocoScene, step: int) -> None:
        if step < 1400 or step % 50:
            return
        mujoco.mj_rnePostConstraint(scene.model, scene.data)
        for body in {body for body, *_ in hand_contacts(scene)}:
            ours = sum(force for of, _, _, force, _ in hand_contacts(scene) if of == body)
            compared.append((ours, scene.data.cfrc_ext[body, 3:].copy()))

    simulate_grasp(HAND.hands[0], "box", 2, duration_s=1.8, watch=watch)
    assert len(compared) > 20
    ours, theirs = np.array(compared).transpose(1, 0, 2)
    assert np.linalg.norm(theirs, axis=1).max() > 2.0
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_forces_on_the_hand_balance_gravity_of_the_ball(ball: GraspRecord) -> None:
    free = np.flatnonzero(~ball.held_externally)[:-1]
    on_hand = np.stack([np.bincount(ball.step_index, f, len(ball.times_s)) for f in ball.force_n.T], axis=1)
    moved = ball.grasped_object.mass_kg * np.diff(ball.object_velocity_m_s, axis=0)[free] / TIME_STEP_S
    weight = np.array([0.0, 0.0, -9.81 * ball.grasped_object.mass_kg])
    np.testing.assert_allclose(-on_hand[free] + weight, moved, atol=1e-6)


def test_pads_sense_the_normal_component_of_the_force(ball: GraspRecord, pressed: ContactPatches) -> None:
    step = round(HELD_S / TIME_STEP_S)
    seen = 0
    for row, (pad, of) in enumerate(zip(ball.pads, PADS, strict=True)):
        mine = (ball.step_index == step) & (ball.pad_row == row)
        if not mine.any():
            continue
        x, y = pressed.force_centre[step, row]
        normal = pad.rotation @ pad.shape.normal(x * pad.shape.length_m, y * pad.shape.arc)
        in_palm = ball.link_rotation[step, row] @ normal
        assert pressed.total_n[step, row] == pytest.approx(-ball.force_n[mine].sum(0) @ in_palm, rel=1e-6)
        assert of.link == pad.link
        seen += 1
    assert seen >= 4


def test_patches_preserve_force_and_centre() -> None:
    grasp = simulate_grasp(HAND.hands[0], "pen", 1, duration_s=1.8)
    made = contact_patches(grasp)
    assert (made.force_n > 0).sum(2).max() == 2  # along a line, whose ends are far apart
    on = made.total_n > 0
    np.testing.assert_allclose(made.force_n.sum(2), made.total_n, atol=1e-12)
    centre = (made.force_n[..., None] * made.position).sum(2)[on] / made.total_n[on][:, None]
    np.testing.assert_allclose(centre, made.force_centre[on], atol=1e-12)
    alone = on & ((made.force_n > 0).sum(2) == 1)
    np.testing.assert_allclose(
        made.effective_radius_m[alone], made.radius_m.max(2, where=made.force_n > 0, initial=0)[alone]
    )
    assert made.points_off_pad > 0
    assert 0 < made.force_fraction_off_pad < 1


def test_link_poses_equal_those_of_mujoco(ball: GraspRecord) -> None:
    kinematics = RobotModels(HAND).kinematics[0]
    poses = LinkPoses(kinematics)
    order = [ball.joints.index(name) for name in kinematics.joints]
    for step in (500, 1200, 2000):
        poses.set_joint_positions(ball.joint_rad[step, order])
        for row in range(len(PADS)):
            pose = poses.pose_in_palm(row)
            np.testing.assert_allclose(pose.rotation, ball.link_rotation[step, row], atol=1e-9)
            np.testing.assert_allclose(pose.translation_m, ball.link_m[step, row], atol=1e-9)


def test_grasp_is_reproducible_by_seed(ball: GraspRecord) -> None:
    again, other = (simulate_grasp(HAND.hands[0], "ball", seed, duration_s=0.05) for seed in (1, 2))
    n = len(again.times_s)
    assert np.array_equal(again.joint_rad, ball.joint_rad[:n])
    assert np.array_equal(again.object_m, ball.object_m[:n])
    assert not np.array_equal(again.object_m, other.object_m)
    assert other.grasped_object.size_m != ball.grasped_object.size_m


def test_reported_contacts_on_a_ball_lie_within_their_covariance(ball: GraspRecord) -> None:
    served = grasp_run.served(HAND, "ball", 1, WORLDS["ideal"].draw(1), done=ball)
    strong = served.true_n > 0.3
    still = strong & (served.moving_rad_s < 0.2)  # the state of a moving joint is a little old
    assert still.sum() > 500
    middle = ball.object_m[served.step]
    outward = served.palm_m - middle
    from_middle = np.linalg.norm(outward, axis=1)
    overlap = np.zeros(served.patches.total_n.shape)  # a pad's surface is that of the undeformed skin
    overlap[ball.step_index[ball.pad_row >= 0], ball.pad_row[ball.pad_row >= 0]] = ball.penetration_m[
        ball.pad_row >= 0
    ]
    off_ball = from_middle - (ball.grasped_object.size_m[0] - overlap[served.step, served.pad])
    radial = outward / from_middle[:, None]
    std = np.sqrt(np.einsum("ki,kij,kj->k", radial, served.covariance_m2, radial))
    assert np.quantile(np.abs(off_ball[still]) - 3 * std[still], 0.95) < 5e-6
    error = served.palm_m - served.true_m
    values, axes = np.linalg.eigh(served.covariance_m2)
    along = np.einsum("kji,kj->ki", axes, error)[:, 1:]
    squared = (along**2 / values[:, 1:]).sum(1)[still]
    assert np.median(squared) < 3.0  # 1.39 for two dimensions of noise
    assert np.median(np.linalg.norm(error, axis=1)) < 22e-6
    np.testing.assert_allclose(sum(served.error_m.values()), error, atol=1e-12)
    events = grasp_run.at_best(served, HAND.touch)
    assert events.touches >= 5
    assert events.missed == events.false_positives == 0
    assert events.f1(0.011) > 0.9


def test_error_components_are_attributed_to_their_causes() -> None:
    world = WORLDS["default"].only("mounts").draw(1)
    served = grasp_run.served(HAND, "ball", 1, world, duration_s=1.9)
    length = {part: np.linalg.norm(error, axis=1) for part, error in served.error_m.items()}
    for row in np.unique(served.pad):
        mine = served.pad == row
        true, nominal = served.grasp.pads[row], mount_transform(PADS[row])
        off_m = np.linalg.norm(true.translation_m - nominal[1])
        assert np.median(length["mount"][mine]) == pytest.approx(off_m, abs=0.5e-3)  # besides its rotation
    still, moving = served.moving_rad_s < 0.2, served.moving_rad_s > 1.0
    assert np.mean(length["time"][moving]) > 5 * np.mean(length["time"][still])
    palm = [row for row, pad in enumerate(PADS) if pad.link.startswith("palm")]
    assert np.all(length["kinematics"][np.isin(served.pad, palm)] < 1e-12)
    assert np.median(length["kinematics"][~np.isin(served.pad, palm)]) > 50e-6


def test_grasp_stimulus_contacts_agree_with_samples(ball: GraspRecord, pressed: ContactPatches) -> None:
    encoders = EncoderErrors.of_world(WORLDS["default"].draw(1), ball)
    timeline = GraspStimulus.from_grasp(ball, pressed, encoders, repeat=True)
    virtual = VirtualHand(
        HAND, timeline, World("silent", electronics=ElectronicsSpread(noise_ratio=Fixed(0.0))).draw(1)
    )
    counts = np.stack([virtual.counts(row, [0.1, HELD_S]) for row in range(len(PADS))], axis=1)
    touched = (counts[1] > 20).any(axis=1)
    assert np.array_equal(touched, pressed.total_n[round(HELD_S / TIME_STEP_S)] > 0)
    assert np.array_equal(virtual.sample(HELD_S), counts[1])
    assert np.array_equal(virtual.sample(HELD_S + timeline.duration_s), counts[1])
    truth = {record.link: record for record in virtual.truth(HELD_S)}
    assert sum(record.force_n for record in truth.values()) == pytest.approx(
        pressed.total_n[round(HELD_S / TIME_STEP_S)].sum()
    )
    encoder_error = timeline.reported_rad - ball.joint_rad
    assert 0.05 < np.degrees(np.abs(encoder_error[-200:].mean(0))).mean() < 0.5


def test_touches_begin_and_end_at_their_thresholds() -> None:
    force = np.array([0, 0.05, 0.1, 0.04, 0.1, 0.01, 0.1, 0.0, 0.0, 0.0, 0.2, 0.2])
    assert touch_spans(force, 1.0, 0.06, 0.03, 0.0) == [(2.0, 5.0), (6.0, 7.0), (10.0, 12.0)]
    assert touch_spans(force, 1.0, 0.06, 0.03, 2.0) == [(2.0, 7.0), (10.0, 12.0)]


def test_ideal_contacts_need_consecutive_samples() -> None:
    force = np.array([0, 0.1, 0, 0.1, 0.1, 0.04, 0, 0.1, 0, 0, 0.1, 0.1])
    assert ideal_contact_spans(force, 1.0, 0.06, 0.03, 2) == [(3.0, 9.0), (10.0, 12.0)]
    assert ideal_contact_spans(force, 1.0, 0.06, 0.03, 1)[:2] == [(1.0, 2.0), (3.0, 6.0)]
    assert merge_spans(ideal_contact_spans(force, 1.0, 0.06, 0.03, 1), 1.5) == [(1.0, 8.0), (10.0, 12.0)]


@settings(deadline=None, max_examples=60)
@given(st.floats(0, 1), st.floats(0, 1), st.floats(0.5e-3, 5e-3))
def test_disc_is_clipped_at_the_edge_of_the_pad(x: float, y: float, radius: float) -> None:
    pad = grasp_pad()
    sides = np.array([pad.shape.length_m, pad.shape.arc])
    *_, place, force, found = clip_to_pad(
        pad, np.array([0]), np.array([[x, y]]), np.ones(1), np.array([radius])
    )
    points = np.random.default_rng(1).uniform(-1, 1, (20_000, 2))
    points = np.array([x, y]) + points[(points**2).sum(1) < 1] * radius / sides
    on = points[((points > 0) & (points < 1)).all(1)]
    assert force[0] == 1
    if min(x, 1 - x) * sides[0] > radius or min(y, 1 - y) * sides[1] > radius:  # not cut by a corner
        np.testing.assert_allclose(place[0] * sides, on.mean(0) * sides, atol=0.03 * radius)
        np.testing.assert_allclose(found[0], max(radius * np.sqrt(len(on) / len(points)), 0.5e-3), rtol=0.03)
    assert ((place >= 0) & (place <= 1)).all()


def grasp_pad() -> MujocoPad:
    """Return a flat pad of a scene."""
    (pad,) = [pad for pad in PADS if pad.link == "palm_heel"]
    return MujocoPad(pad.link, 1, *mount_transform(pad), simulated_surface(pad.surface))


def test_event_score_counts_late_missed_and_false_contacts() -> None:
    events = EventScore()
    true = [(1.0, 2.0), (3.0, 4.0), (5.0, 5.01), (6.0, 7.0)]
    compare_contacts(events, true, true, [(1.01, 2.005), (3.1, 4.0), (8.0, 8.1)])
    assert (events.touches, events.short_touches, events.missed, events.late, events.false_positives) == (
        3,
        1,
        1,
        1,
        1,
    )
    assert events.begin_delays_s == pytest.approx([0.01, 0.1])
    assert events.end_delays_s == pytest.approx([0.005, 0.0], abs=1e-9)
    assert events.f1(0.02) == pytest.approx(2 * 1 / (2 * 1 + 2 + 2))
    assert events.f1(0.2) == pytest.approx(2 * 2 / (2 * 2 + 1 + 1))


def test_impossible_grasp_is_reported_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    world = WORLDS["ideal"].draw(1)
    with pytest.raises(ValueError, match="known: ball, box, pen, cup"):
        grasping.grasp_stimulus(HAND, "bottle", world)
    bare = HAND.model_copy(update={"hands": (HAND.hands[0].model_copy(update={"urdf": None}),)})
    with pytest.raises(ValueError, match="has no URDF"):
        grasping.grasp_stimulus(bare, "ball", world)
    monkeypatch.setattr(grasping, "available", lambda: False)
    with pytest.raises(ValueError, match=r"pip install '.*\[mujoco\]'"):
        grasping.grasp_stimulus(HAND, "ball", world)


def test_unknown_object_gives_exit_status_2(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["demo", "--grasp", "bottle"]) == 2
    bus = ["--bus", "can0=virtual:grasp"]
    assert main(["simulate", str(shipped.path("utah_mit.toml")), *bus, "--grasp", "bottle"]) == 2
    assert capsys.readouterr().err.count("--grasp bottle: unknown object") == 2


@pytest.mark.parametrize("kind", ["prism", "revolution"])
def test_pads_of_every_surface_fit_into_a_scene(kind: str) -> None:
    hand = HAND.hands[0]
    pads = (hand.pads[0].model_copy(update={"surface": SURFACE_TABLES[kind]}), *hand.pads[1:])
    scene = MujocoScene(
        hand.model_copy(update={"pads": pads}), WORLDS["ideal"].draw(1), GRASP_OBJECTS["ball"]
    )
    geom = scene.model.geom(f"pad {pads[0].link}")
    assert scene.pad_row_by_geom[geom.id] == 0
    assert scene.pads[0].shape == simulated_surface(SURFACE_TABLES[kind])


def test_tangential_forces_of_a_grasp_lie_in_the_friction_cone(
    ball: GraspRecord, pressed: ContactPatches
) -> None:
    stimulus = GraspStimulus.from_grasp(ball, pressed)
    times_s = np.asarray(np.arange(len(pressed.total_n)) * TIME_STEP_S, np.float64)
    pulled = 0.0
    for row, pad in enumerate(ball.pads):
        forces = pad_forces(ball, row)
        found = stimulus.pad_stimulus(pad.link, lambda _: ContactPatch(1e-3)).tangential_n(times_s)
        np.testing.assert_array_equal(found, forces.tangential_n)
        size = np.hypot(*found)
        assert (size <= ball.grasped_object.friction * forces.normal_n + 1e-6).all()
        pulled = max(pulled, float(size.max()))
    assert pulled > 0.3  # the hand holds the ball's weight
