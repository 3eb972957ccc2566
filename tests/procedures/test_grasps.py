"""Forces in static grasps follow from joint torques or a held weight, and the contact law from them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import cli
from handtouch.calibration.store import Store
from handtouch.hand.urdf import parse_urdf
from handtouch.host.units import GRAVITY_M_S2
from handtouch.procedures.calibrate.grasps import StaticGrasp, contact_forces, read_grasps
from tests.procedures.test_calibrate import TEXT, TRUE, Table, weights

JOINT = """
<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{x} 0 0"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/>{mimic}</joint>
"""
URDF = "".join([
    '<robot name="r"><link name="base"/><link name="proximal"/><link name="plane"/><link name="other"/>',
    JOINT.format(name="near", parent="base", child="proximal", x=0, mimic=""),
    JOINT.format(name="far", parent="proximal", child="plane", x=0.04, mimic=""),
    JOINT.format(
        name="follower", parent="base", child="other", x=0, mimic='<mimic joint="near" multiplier="2"/>'
    ),
    "</robot>",
])  # fmt: skip
ROBOT = parse_urdf(URDF)


def contact(link: str = "plane", **values: Any) -> dict[str, Any]:
    made = {"position_m": [0.05, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "pad_m": [0.0, 0.0]}
    return {"link": link, "total_current_a": 1e-3, "unknown": 1, **made, **values}


def grasp(*contacts: dict[str, Any], **values: Any) -> StaticGrasp:
    joints = {"near": 0.0, "far": 0.0, "elsewhere": 1.0}
    return StaticGrasp.model_validate_json(json.dumps({"joints": joints, "contacts": contacts, **values}))


def test_a_force_follows_from_the_torques_of_its_joints_with_its_uncertainty() -> None:
    torques = {"near": -2.0 * 0.09, "far": -2.0 * 0.05}
    force, covariance = contact_forces(ROBOT, grasp(contact(), torque_nm=torques, torque_std_nm=0.005))
    assert force[0] == pytest.approx(2.0, rel=1e-3)
    assert math.sqrt(covariance[0, 0]) == pytest.approx(0.005 / math.hypot(0.09, 0.05), rel=0.01)
    # bent, the normal force has the same lever about the far joint; a mimicking joint adds its part
    bent = grasp(contact(), torque_nm={"far": -0.1}).model_copy(update={"joints": {"near": 0.0, "far": 0.6}})
    assert contact_forces(ROBOT, bent)[0][0] == pytest.approx(2.0, rel=1e-3)
    both = grasp(contact(), contact("other"), torque_nm={"near": -0.28, "far": -0.1}, torque_std_nm=1e-4)
    assert contact_forces(ROBOT, both)[0] == pytest.approx([2.0, 1.0], rel=0.02)


def test_a_held_weight_shows_the_force_that_carries_it_and_nothing_shows_no_force() -> None:
    held = grasp(contact(), held_kg=0.2)
    force, covariance = contact_forces(ROBOT, held)
    assert force[0] == pytest.approx(0.2 * GRAVITY_M_S2, rel=1e-3)
    assert math.sqrt(covariance[0, 0]) == pytest.approx(1e-3 * GRAVITY_M_S2, rel=0.01)
    assert contact_forces(ROBOT, grasp(contact()))[1][0, 0] > 1e5
    shared, covariance = contact_forces(ROBOT, grasp(contact(), contact("other"), held_kg=0.2))
    assert shared.sum() == pytest.approx(0.2 * GRAVITY_M_S2, rel=1e-3)
    assert covariance[0, 0] > 100


def test_wrong_lines_are_named(tmp_path: Path) -> None:
    file = tmp_path / "grasps.jsonl"
    file.write_text(json.dumps({"joints": {}, "contacts": [contact()]}) + '\n{"joints": {"near": "x"}}\n')
    with pytest.raises(ValueError, match=r"line 2: joints\.near"):
        read_grasps(file)
    with pytest.raises(ValueError, match='lacks "near"'):
        contact_forces(ROBOT, StaticGrasp.model_validate_json(file.read_text().splitlines()[0]))


def test_calibrate_fits_and_stores_the_law_of_grasps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Torques with errors of 1 mN m, levers of 5 cm: forces are off by 20 mN."""
    rng = np.random.default_rng(5)
    (tmp_path / "hand.urdf").write_text(URDF)
    (tmp_path / "hand.toml").write_text(TEXT.replace('name = "h"', 'name = "h"\nurdf = "hand.urdf"'))
    lines = []
    for reading in Table(weights()).readings():
        torque = -0.05 * reading.weight.force_n + 1e-3 * rng.normal()
        own = contact(pad_m=reading.position_m, total_current_a=reading.current_a)
        made = {"torque_nm": {"far": torque}, "torque_std_nm": 1e-3}
        lines.append(json.dumps({"joints": {"near": 0.0, "far": 0.0}, "contacts": [own], **made}))
    file = tmp_path / "grasps.jsonl"
    file.write_text("\n".join(lines))
    command = ["calibrate", "plane", "--config", str(tmp_path / "hand.toml"), "--grasps", str(file)]
    assert cli.main([*command, "--yes", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    low, high = answer["intervals_95"]["alpha"]
    assert low < TRUE["alpha"] < high
    with Store(tmp_path / "store.db") as store:
        version = store.newest(4711)
    assert version is not None
    assert version.calibration_id == answer["calibration_id"]
    assert version.calibration.law is not None
    (file.parent / "none.jsonl").write_text(json.dumps({"joints": {"near": 0, "far": 0}, "contacts": [own]}))
    assert cli.main([*command[:-1], str(tmp_path / "none.jsonl")]) == 1
    assert "none of 1 grasps" in capsys.readouterr().err
