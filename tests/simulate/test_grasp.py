"""A grasp in MuJoCo: its forces are those that MuJoCo applies, its contacts lie on what is held."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch import config, demo, shipped
from handtouch.hand.pads import mount_of
from handtouch.hand.robot import Robots
from handtouch.simulate import grasp as grasping
from handtouch.simulate.grasp.episode import Grasp, contacts, grasp
from handtouch.simulate.grasp.events import Events, compare, joined, sampled, touches
from handtouch.simulate.grasp.patches import Patches, _cut, patches
from handtouch.simulate.grasp.scene import STEP_S, Pad, Scene
from handtouch.simulate.grasp.shapes import foot
from handtouch.simulate.grasp.timeline import Encoders, Timeline
from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.run import run as simulate
from handtouch.simulate.shape import shape_of
from handtouch.simulate.world import World

FloatArray = NDArray[np.float64]
HAND = config.load(shipped.path("utah_mit.toml"))
PADS = HAND.hands[0].pads
SHORT_S = 2.2  # closed, let go, squeezing
HELD_S = 1.7  # by the hand alone


@pytest.fixture(scope="module")
def ball() -> Grasp:
    """A ball that is gripped."""
    return grasp(HAND.hands[0], "ball", 1, duration_s=SHORT_S)


@pytest.fixture(scope="module")
def pressed(ball: Grasp) -> Patches:
    return patches(ball)


@pytest.fixture(scope="module")
def run() -> Iterator[Any]:
    """The benchmark's way of serving a grasp."""
    path = Path(__file__).parents[2] / "benchmarks" / "grasp_run.py"
    spec = importlib.util.spec_from_file_location("grasp_run", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["grasp_run"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["grasp_run"]


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(PADS), st.floats(0, 1), st.floats(0, 1), st.floats(-2e-3, 2e-3))
def test_the_foot_of_a_point_above_a_surface_is_where_it_stands(
    pad: config.Pad, x: float, y: float, height_m: float
) -> None:
    shape = shape_of(pad.surface)
    at = x * shape.length_m, y * shape.arc
    normal = shape.normal(*at)
    found = foot(shape, (shape.point(*at) + height_m * normal)[None])
    np.testing.assert_allclose(found.fraction[0], (x, y), atol=1e-12)
    np.testing.assert_allclose(found.height_m[0], height_m, atol=1e-12)
    np.testing.assert_allclose(found.normal[0], normal, atol=1e-12)


def test_contacts_of_a_link_add_up_to_mujocos_net_contact_force_on_it() -> None:
    mujoco = pytest.importorskip("mujoco")
    compared = []

    def watch(scene: Scene, step: int) -> None:
        if step < 1400 or step % 50:
            return
        mujoco.mj_rnePostConstraint(scene.model, scene.data)
        for body in {body for body, *_ in contacts(scene)}:
            ours = sum(force for of, _, _, force, _ in contacts(scene) if of == body)
            compared.append((ours, scene.data.cfrc_ext[body, 3:].copy()))

    grasp(HAND.hands[0], "box", 2, duration_s=1.8, watch=watch)
    assert len(compared) > 20
    ours, theirs = np.array(compared).transpose(1, 0, 2)
    assert np.linalg.norm(theirs, axis=1).max() > 2.0
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_forces_on_the_hand_are_what_holds_the_ball_against_gravity(ball: Grasp) -> None:
    free = np.flatnonzero(~ball.held)[:-1]
    on_hand = np.stack([np.bincount(ball.step, f, len(ball.times_s)) for f in ball.force_n.T], axis=1)
    moved = ball.thing.mass_kg * np.diff(ball.thing_m_s, axis=0)[free] / STEP_S
    weight = np.array([0.0, 0.0, -9.81 * ball.thing.mass_kg])
    np.testing.assert_allclose(-on_hand[free] + weight, moved, atol=1e-6)


def test_what_pads_sense_is_the_part_of_the_force_along_their_normals(ball: Grasp, pressed: Patches) -> None:
    step = round(HELD_S / STEP_S)
    seen = 0
    for row, (pad, of) in enumerate(zip(ball.pads, PADS, strict=True)):
        mine = (ball.step == step) & (ball.pad == row)
        if not mine.any():
            continue
        x, y = pressed.centre[step, row]
        normal = pad.rotation @ pad.shape.normal(x * pad.shape.length_m, y * pad.shape.arc)
        in_palm = ball.link_rotation[step, row] @ normal
        assert pressed.total_n[step, row] == pytest.approx(-ball.force_n[mine].sum(0) @ in_palm, rel=1e-6)
        assert of.link == pad.link
        seen += 1
    assert seen >= 4


def test_patches_keep_force_and_centre_of_what_they_are_made_of() -> None:
    went = grasp(HAND.hands[0], "pen", 1, duration_s=1.8)
    made = patches(went)
    assert (made.force_n > 0).sum(2).max() == 2  # along a line, whose ends are far apart
    on = made.total_n > 0
    np.testing.assert_allclose(made.force_n.sum(2), made.total_n, atol=1e-12)
    centre = (made.force_n[..., None] * made.place).sum(2)[on] / made.total_n[on][:, None]
    np.testing.assert_allclose(centre, made.centre[on], atol=1e-12)
    alone = on & ((made.force_n > 0).sum(2) == 1)
    np.testing.assert_allclose(
        made.spread_m[alone], made.radius_m.max(2, where=made.force_n > 0, initial=0)[alone]
    )
    assert made.beside > 0
    assert 0 < made.beside_share < 1


def test_links_are_where_pinocchio_and_mujoco_both_say(ball: Grasp) -> None:
    kinematics = Robots(HAND).kinematics[0]
    order = [ball.joints.index(name) for name in kinematics.joints]
    for step in (500, 1200, 2000):
        kinematics.move(ball.position_rad[step, order])
        for row in range(len(PADS)):
            pose = kinematics.in_palm(row)
            np.testing.assert_allclose(pose.rotation, ball.link_rotation[step, row], atol=1e-9)
            np.testing.assert_allclose(pose.translation_m, ball.link_m[step, row], atol=1e-9)


def test_the_same_seed_gives_the_same_grasp_and_another_another(ball: Grasp) -> None:
    again, other = (grasp(HAND.hands[0], "ball", seed, duration_s=0.05) for seed in (1, 2))
    n = len(again.times_s)
    assert np.array_equal(again.position_rad, ball.position_rad[:n])
    assert np.array_equal(again.thing_m, ball.thing_m[:n])
    assert not np.array_equal(again.thing_m, other.thing_m)
    assert other.thing.size_m != ball.thing.size_m


def test_a_served_ball_is_touched_where_it_is_within_the_told_covariance(run: Any, ball: Grasp) -> None:
    served = run.served(HAND, "ball", 1, run.Setting.ideal(1), done=ball)
    strong = served.true_n > 0.3
    still = strong & (served.moving_rad_s < 0.2)  # a joint that moves is known as it was a little ago
    assert still.sum() > 500
    middle = ball.thing_m[served.step]
    outward = served.palm_m - middle
    from_middle = np.linalg.norm(outward, axis=1)
    overlap = np.zeros(served.patches.total_n.shape)  # a pad's surface is that of the skin before it gave way
    overlap[ball.step[ball.pad >= 0], ball.pad[ball.pad >= 0]] = ball.overlap_m[ball.pad >= 0]
    off_ball = from_middle - (ball.thing.size_m[0] - overlap[served.step, served.pad])
    radial = outward / from_middle[:, None]
    std = np.sqrt(np.einsum("ki,kij,kj->k", radial, served.covariance_m2, radial))
    assert np.quantile(np.abs(off_ball[still]) - 3 * std[still], 0.95) < 5e-6
    error = served.palm_m - served.true_m
    values, axes = np.linalg.eigh(served.covariance_m2)
    along = np.einsum("kji,kj->ki", axes, error)[:, 1:]
    squared = (along**2 / values[:, 1:]).sum(1)[still]
    assert np.median(squared) < 3.0  # 1.39 for two dimensions of noise
    assert np.median(np.linalg.norm(error, axis=1)) < 20e-6
    np.testing.assert_allclose(sum(served.error_m.values()), error, atol=1e-12)
    events = run.at_best(served, HAND.touch)
    assert events.touches >= 5
    assert events.missed == events.invented == 0
    assert events.f1(0.011) > 0.9


def test_causes_of_an_error_show_where_they_are(run: Any) -> None:
    world = replace(World.ideal_parts(1), mount_mm=0.2, mount_deg=0.5)
    usual = run.Setting(world, run.Setting.usual(1).encoders)
    served = run.served(HAND, "ball", 1, usual, duration_s=1.9)
    length = {part: np.linalg.norm(error, axis=1) for part, error in served.error_m.items()}
    for row in np.unique(served.pad):
        mine = served.pad == row
        true, nominal = served.grasp.pads[row], mount_of(PADS[row])
        off_m = np.linalg.norm(true.translation_m - nominal[1])
        assert np.median(length["mount"][mine]) == pytest.approx(off_m, abs=0.5e-3)  # and it is turned
    still, moving = served.moving_rad_s < 0.2, served.moving_rad_s > 1.0
    assert np.mean(length["time"][moving]) > 5 * np.mean(length["time"][still])
    palm = [row for row, pad in enumerate(PADS) if pad.link.startswith("palm")]
    assert np.all(length["kinematics"][np.isin(served.pad, palm)] < 1e-12)
    assert np.median(length["kinematics"][~np.isin(served.pad, palm)]) > 50e-6


def test_a_timeline_presses_what_it_says_and_samples_are_its_counts(ball: Grasp, pressed: Patches) -> None:
    timeline = Timeline.play(ball, pressed, Encoders(1, 0.2, 0.05, 0.003), repeat=True)
    virtual = VirtualHand(HAND, timeline, replace(World.ideal_parts(1), noise_counts=0.0))
    counts = np.stack([virtual.counts(row, [0.1, HELD_S]) for row in range(len(PADS))], axis=1)
    touched = (counts[1] > 20).any(axis=1)
    assert np.array_equal(touched, pressed.total_n[round(HELD_S / STEP_S)] > 0)
    assert np.array_equal(virtual.sample(HELD_S), counts[1])
    assert np.array_equal(virtual.sample(HELD_S + timeline.duration_s), counts[1])
    truth = {record.link: record for record in virtual.truth(HELD_S)}
    assert sum(record.force_n for record in truth.values()) == pytest.approx(
        pressed.total_n[round(HELD_S / STEP_S)].sum()
    )
    told = timeline.told_rad - ball.position_rad
    assert 0.05 < np.degrees(np.abs(told[-200:].mean(0))).mean() < 0.5


def test_touches_begin_above_one_force_and_end_below_another() -> None:
    force = np.array([0, 0.05, 0.1, 0.04, 0.1, 0.01, 0.1, 0.0, 0.0, 0.0, 0.2, 0.2])
    assert touches(force, 1.0, 0.06, 0.03, 0.0) == [(2.0, 5.0), (6.0, 7.0), (10.0, 12.0)]
    assert touches(force, 1.0, 0.06, 0.03, 2.0) == [(2.0, 7.0), (10.0, 12.0)]


def test_what_a_pad_could_tell_at_best_takes_samples_in_a_row() -> None:
    force = np.array([0, 0.1, 0, 0.1, 0.1, 0.04, 0, 0.1, 0, 0, 0.1, 0.1])
    assert sampled(force, 1.0, 0.06, 0.03, 2) == [(3.0, 9.0), (10.0, 12.0)]
    assert sampled(force, 1.0, 0.06, 0.03, 1)[:2] == [(1.0, 2.0), (3.0, 6.0)]
    assert joined(sampled(force, 1.0, 0.06, 0.03, 1), 1.5) == [(1.0, 8.0), (10.0, 12.0)]


@settings(deadline=None, max_examples=60)
@given(st.floats(0, 1), st.floats(0, 1), st.floats(0.5e-3, 5e-3))
def test_at_an_edge_a_disc_is_the_part_of_it_that_lies_on_the_pad(x: float, y: float, radius: float) -> None:
    pad = grasp_pad()
    sides = np.array([pad.shape.length_m, pad.shape.arc])
    *_, place, force, found = _cut(pad, np.array([0]), np.array([[x, y]]), np.ones(1), np.array([radius]))
    points = np.random.default_rng(1).uniform(-1, 1, (20_000, 2))
    points = np.array([x, y]) + points[(points**2).sum(1) < 1] * radius / sides
    on = points[((points > 0) & (points < 1)).all(1)]
    assert force[0] == 1
    if min(x, 1 - x) * sides[0] > radius or min(y, 1 - y) * sides[1] > radius:  # not cut by a corner
        np.testing.assert_allclose(place[0] * sides, on.mean(0) * sides, atol=0.03 * radius)
        np.testing.assert_allclose(found[0], max(radius * np.sqrt(len(on) / len(points)), 0.5e-3), rtol=0.03)
    assert ((place >= 0) & (place <= 1)).all()


def grasp_pad() -> Pad:
    """A flat pad, as it is in a scene."""
    (pad,) = [pad for pad in PADS if pad.link == "palm_heel"]
    return Pad(pad.link, 1, *mount_of(pad), shape_of(pad.surface))


def test_events_are_late_missed_or_invented_by_what_really_touched() -> None:
    events = Events()
    true = [(1.0, 2.0), (3.0, 4.0), (5.0, 5.01), (6.0, 7.0)]
    compare(events, true, true, [(1.01, 2.005), (3.1, 4.0), (8.0, 8.1)])
    assert (events.touches, events.short, events.missed, events.late, events.invented) == (3, 1, 1, 1, 1)
    assert events.begin_s == pytest.approx([0.01, 0.1])
    assert events.end_s == pytest.approx([0.005, 0.0], abs=1e-9)
    assert events.f1(0.02) == pytest.approx(2 * 1 / (2 * 1 + 2 + 2))
    assert events.f1(0.2) == pytest.approx(2 * 2 / (2 * 2 + 1 + 1))


def test_what_cannot_be_grasped_is_told_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World.ideal_parts(1)
    with pytest.raises(ValueError, match="there are ball, box, pen, cup"):
        grasping.played(HAND, "bottle", world)
    bare = HAND.model_copy(update={"hands": (HAND.hands[0].model_copy(update={"urdf": None}),)})
    with pytest.raises(ValueError, match="has no URDF"):
        grasping.played(bare, "ball", world)
    monkeypatch.setattr(grasping, "available", lambda: False)
    with pytest.raises(ValueError, match=r"pip install 'handtouch\[mujoco\]'"):
        grasping.played(HAND, "ball", world)


def test_a_thing_that_is_not_there_ends_commands_with_status_2(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert demo.run(grasp="bottle") == 2
    assert simulate(shipped.path("utah_mit.toml"), buses=("can0=virtual:grasp",), grasp="bottle") == 2
    assert capsys.readouterr().err.count("--grasp bottle: there is no such thing") == 2
