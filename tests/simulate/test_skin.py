"""Weight of the skin on simulated sheets: its law, the motion of links, and the same counts in every way."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from handtouch import config
from handtouch.config import ConfigError, shipped
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand import urdf
from handtouch.hand.robot_models import RobotModels
from handtouch.simulate.base_motion import BaseTurn, base_rotation, gravity_in_base
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.skin import LinkMotion
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS

G_M_S2, KG_PER_M2 = 9.80665, 7.0
IDEAL = WORLDS["ideal"].draw(3)
SHIPPED = config.load(shipped.path("utah_mit.toml"))


def scenario(link: str, **tables: Any) -> Scenario:
    """Return a scenario with a skin, in which nothing touches for long."""
    touch = {"link": link, "from_s": 1e4, "duration_s": 1.0, "path": [(0.5, 0.5)], "force_n": [1.0]}
    return Scenario.model_validate({"touch": [touch], "skin": {"g_per_cm2": KG_PER_M2 / 10}, **tables})


def with_gravity(deployment: config.Deployment, direction: Any) -> config.Deployment:
    hand = deployment.hands[0].model_copy(update={"gravity": tuple(map(float, direction))})
    return deployment.model_copy(update={"hands": (hand,)})


def skin_currents(deployment: config.Deployment, row: int, direction: Any) -> Any:
    """Return the currents of the skin on a pad, of a hand that rests in some direction of gravity."""
    turned = with_gravity(deployment, direction)
    hand = VirtualHand(turned, scenario(turned.pads[row][1].link), IDEAL)
    return hand.virtual_pads[row].load_currents(np.array([0.5]))[0]


def test_a_flat_skin_presses_by_its_weight_through_the_contact_law(deployment: config.Deployment) -> None:
    pad, node = deployment.pads[0][1], deployment.nodes["n"]
    sheet = deployment.sheets[pad.sheet]
    pressure_pa = KG_PER_M2 * G_M_S2
    resistivity = 1e-6 * sheet.contact_ohm_mm2 * (1e3 * sheet.reference_kpa / pressure_pa) ** sheet.alpha
    expected = node.drive_v * (40e-3 * 25e-3) / resistivity
    down = skin_currents(deployment, 0, (0, 0, -1))
    assert down.sum() == pytest.approx(expected, rel=1e-3)
    assert down[0] == pytest.approx(down[1], rel=1e-2)
    assert down[2] == pytest.approx(down[3], rel=1e-2)
    aslant = skin_currents(deployment, 0, (0, math.sin(0.7), -math.cos(0.7)))
    assert aslant.sum() / down.sum() == pytest.approx(math.cos(0.7) ** sheet.alpha, rel=1e-6)
    assert not skin_currents(deployment, 0, (0, 0, 1)).any()
    assert not skin_currents(deployment, 0, (1, 0, 0)).any()


@pytest.mark.parametrize("row", [1, 2, 3])
def test_on_a_curved_pad_only_what_lies_above_presses(deployment: config.Deployment, row: int) -> None:
    rng = np.random.default_rng(row)
    upright = [skin_currents(deployment, row, way).sum() for way in rng.normal(size=(40, 3))]
    assert min(upright) >= 0
    assert max(upright) > 20 * (min(upright) + 1e-12)


def test_gravity_on_a_link_is_that_of_the_daemon_s_kinematics() -> None:
    robots = RobotModels(SHIPPED)
    poses, names = LinkPoses(robots.kinematics[0]), robots.joint_names[0]
    position = np.random.default_rng(1).uniform(-0.5, 1.5, len(names))
    robot = urdf.read_urdf(shipped.path("utah_mit.urdf"))

    class Still:
        def positions_at(self, t_s: float) -> dict[str, float]:  # noqa: ARG002
            return dict(zip(names, position.tolist(), strict=True))

    poses.set_joint_positions(position)
    down = np.array([0.3, -0.2, -0.9])
    turns = (BaseTurn(duration_s=4.0, axis=(1.0, 2.0, 0.0), rev_s=0.3),)
    in_base = gravity_in_base(turns, tuple(down.tolist()), 9.0)
    assert in_base is not None
    rotations = [poses.pose_in_base(link).rotation for link in range(len(SHIPPED.pads))]
    expected = np.array(in_base) @ np.array(rotations).reshape(-1, 3, 3)
    for row, (_, pad) in enumerate(SHIPPED.pads):
        motion = LinkMotion(robot.joint_chain(pad.link), robot.joint_chain("base"), Still(), turns, down)
        felt = motion.felt_m_s2(np.array([9.0]), np.zeros(3))[0]
        np.testing.assert_allclose(felt, G_M_S2 * expected[row] / np.linalg.norm(down), atol=1e-6)


def test_a_turning_link_feels_gravity_and_the_centrifugal_acceleration() -> None:
    turns = (BaseTurn(duration_s=60.0, axis=(0.0, 0.0, 2.0), rev_s=1.0),)
    motion = LinkMotion((), (), None, turns, np.array([0.0, 0.0, -1.0]))
    felt = motion.felt_m_s2(np.linspace(5, 6, 50), np.array([0.1, 0.0, 0.02]))
    omega = 2 * math.pi
    np.testing.assert_allclose(felt[:, 0], omega**2 * 0.1, rtol=2e-3)
    np.testing.assert_allclose(felt[:, 1], 0.0, atol=1e-2)
    np.testing.assert_allclose(felt[:, 2], -G_M_S2, rtol=1e-9)


def test_a_turn_begins_and_ends_smoothly_and_stays_where_it_ended() -> None:
    turn = BaseTurn(from_s=1.0, duration_s=2.0, axis=(0.0, 0.0, 1.0), rev_s=0.5, ramp_s=0.4)
    rotation = base_rotation((turn,), np.array([0.5, 1.0, 2.0, 3.0, 9.0]))
    angle = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    turned = math.pi * (2.0 - 0.4) - 2 * math.pi
    np.testing.assert_allclose(angle, [0.0, 0.0, 0.8 * math.pi, turned, turned], atol=1e-12)
    fine = base_rotation((turn,), np.arange(0.5, 3.5, 1e-3))
    speed = np.diff(np.unwrap(np.arctan2(fine[:, 1, 0], fine[:, 0, 0]))) / 1e-3
    assert np.abs(np.diff(speed)).max() < 1.01 * math.pi / 0.4 * 1e-3
    assert speed.max() == pytest.approx(math.pi, rel=1e-6)


def test_the_live_samples_of_a_turning_hand_are_those_of_its_pads(deployment: config.Deployment) -> None:
    tables: Any = {"turn": [{"duration_s": 30.0, "axis": [1.0, 0.2, 0.0], "rev_s": 1.0}]}
    hand = VirtualHand(deployment, scenario("flat", **tables), WORLDS["default"].draw(5))
    times = np.arange(0.0, 2.5, 0.11)
    live = np.stack([hand.sample(t) for t in times.tolist()], axis=1)
    for row in range(4):
        np.testing.assert_array_equal(live[row], hand.counts(row, times))


def test_a_scenario_without_skin_has_no_weight_and_a_wrong_one_is_named(
    deployment: config.Deployment,
) -> None:
    light = scenario("flat").model_copy(update={"skin": None})
    assert not VirtualHand(deployment, light, IDEAL).virtual_pads[0].load_currents(np.array([1.0])).any()
    text = '[[touch]]\nlink = "a"\nfrom_s = 0.0\nduration_s = 1.0\npath = [[0.5, 0.5]]\nforce_n = [1.0]\n'
    with pytest.raises(ConfigError, match="g_per_cm2"):
        Scenario.parse(text + "[skin]\ng_per_cm2 = -1.0\n")
    with pytest.raises(ConfigError, match="axis"):
        Scenario.parse(text + "[[turn]]\nduration_s = 1.0\naxis = [0.0, 0.0, 0.0]\nrev_s = 1.0\n")
