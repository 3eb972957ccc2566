"""Action requests about a known object: the touch that tells its hypotheses apart, on the wire."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch import wire
from handtouch.config import ObjectTable, load, shipped
from handtouch.percept.action_request import expected_information_bits
from handtouch.percept.object_pose import FREE_ROTATION_RAD2, PoseHypothesis
from handtouch.percept.object_questions import object_questions
from handtouch.percept.object_shapes import build_shape
from handtouch.percept.worker import PerceptWorker
from handtouch.view.message_lines import message_line
from handtouch.wire import PERCEPT_KINDS

FloatArray = NDArray[np.float64]
BOLT = ObjectTable.model_validate(
    {
        "shape": {
            "kind": "bolt",
            "diameter_mm": 16.0,
            "length_mm": 80.0,
            "head_diameter_mm": 26.0,
            "head_length_mm": 12.0,
        }
    }
)
SHAPE = build_shape(BOLT)
IRRELEVANT = (
    *("xy", "pad_m", "pad_noise_m2", "position_m", "normal", "covariance_m2", "force_n", "force_std_n"),
    *("total_current_a", "residual", "residual_std", "slip_velocity_m_per_s", "tremor_std_m"),
)
"""Columns that the pose of an object doesn't depend on"""
ALONG_Z = [0.0, 0.0, 0.0, 1.0]
FLIPPED = [1.0, 0.0, 0.0, 0.0]


def hypothesis(weight: float, quaternion: list[float], std_m: float = 1e-3) -> PoseHypothesis:
    covariance = np.diag([std_m**2] * 3 + [0.03**2] * 2 + [FREE_ROTATION_RAD2])
    return PoseHypothesis(weight, np.zeros(3), np.array(quaternion), covariance)


def questions(*hypotheses: PoseHypothesis) -> list[float]:
    """Return the expected information [bits] of every touch of two pads beside the bolt."""
    surfaces = np.array([[[0.05, 0.0, 0.04]], [[0.05, 0.0, -0.04]]])
    found = object_questions(0, "bolt", SHAPE, hypotheses, np.array([3, 4]), surfaces)
    return [expected_information_bits(question, action) for question in found for action in question.actions]


def test_a_touch_of_an_end_tells_which_is_the_head() -> None:
    two = hypothesis(0.5, ALONG_Z), hypothesis(0.5, FLIPPED)
    surfaces = np.array([[[0.05, 0.0, 0.04]], [[0.05, 0.0, -0.04]]])
    found = object_questions(0, "bolt", SHAPE, two, np.array([3, 4]), surfaces)
    assert max(questions(*two)) > 0.6
    for question in found:
        assert question.hypotheses == pytest.approx({"pose 1": 0.5, "pose 2": 0.5})
        for action in question.actions:
            start, way = (np.array(action.parameters[k]) for k in ("palm_start_m", "palm_direction"))
            for name, turn in (("pose 1", ALONG_Z), ("pose 2", FLIPPED)):
                mean, std = action.predicted_outcomes[name]
                reached = Rotation.from_quat(turn).inv().apply(start + mean * way)
                missed = mean == action.parameters["distance_m"]
                assert missed or abs(SHAPE.distance(reached)) < 1e-3
                assert std >= 1e-3


def test_no_touch_is_requested_where_one_pose_is_left_or_none_can_be_told_apart() -> None:
    assert questions(hypothesis(1.0, ALONG_Z)) == []
    assert max(questions(hypothesis(0.5, ALONG_Z), hypothesis(0.5, ALONG_Z)), default=0.0) < 1e-6


def test_a_vague_pose_promises_less_information() -> None:
    sharp = max(questions(hypothesis(0.5, ALONG_Z), hypothesis(0.5, FLIPPED)))
    vague = max(questions(hypothesis(0.5, ALONG_Z, 20e-3), hypothesis(0.5, FLIPPED, 20e-3)))
    assert vague < sharp


def shank_input(t_ns: int, pads: int, points: FloatArray, normals: FloatArray) -> wire.PerceptInput:
    """Return the daemon's message about touches on the bolt's shank by the first pads."""
    k = len(points)
    columns = wire.COLUMNS[wire.PerceptInput]
    ids = np.where(np.arange(pads) < k, 1, 0).astype("<u4")
    values = {name: np.zeros((k, columns[name].elements)).tobytes() for name in IRRELEVANT}
    requested = 1 << PERCEPT_KINDS.index("object") | 1 << len(PERCEPT_KINDS)
    apart = np.arange(pads)[:, None] * [0.0, 0.05, 0.0] + [0.15, 0.0, 0.0]
    poses = np.concatenate([np.tile(np.eye(3).ravel(), (pads, 1)), apart], axis=1)
    return wire.PerceptInput(
        v=wire.SCHEMA_VERSION,
        session=0,
        seq=1,
        t_ns=t_ns,
        hand="right",
        contact_id=ids.tobytes(),
        requested=np.full(pads, requested, "<u1").tobytes(),
        row=np.arange(k, dtype="<u4").tobytes(),
        sample_ns=np.full(k, t_ns, "<i8").tobytes(),
        slip_log_odds=np.full(k, np.nan).tobytes(),
        retained=False,
        **values,
        palm_position_m=points.tobytes(),
        palm_normal=normals.tobytes(),
        palm_covariance_m2=np.tile(1e-7 * np.eye(3).ravel(), (k, 1)).tobytes(),
        clear=(ids == 0).astype("<u1").tobytes(),
        link_poses=poses.tobytes(),
        base_pose=np.concatenate([np.eye(3).ravel(), np.zeros(3)]).tobytes(),
        known_object=f"bolt={BOLT.model_dump_json()}",
    )


def test_the_touch_that_tells_the_head_is_requested_on_the_wire() -> None:
    """From the stream of the daemon to what a client decodes."""
    deployment = load(shipped.path("utah_mit.toml"))
    worker = PerceptWorker(deployment)
    angle, height = np.array([0.0, 2.1, 4.2, 1.0, 3.1]), np.array([-12e-3, 12e-3, 0.0, -6e-3, 6e-3])
    outward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = 8e-3 * outward + np.outer(height, [0, 0, 1])
    received: list[wire.Percept] = []
    for step in range(1, 13):
        message = shank_input(step * 50_000_000, len(deployment.pads), points, -outward)
        received += [wire.decode(wire.encode(percept)) for percept in worker.process_input(message)]  # type: ignore[misc]
    pose = [percept for percept in received if percept.kind == "object"][-1]
    request = next(percept for percept in received if percept.kind == "action_request")
    assert pose.state == "undetermined"
    assert request.question == "object_pose"
    assert request.label == "touch"
    assert request.link in {pad.link for _, pad in deployment.pads}
    assert request.values["expected_information_bits"] > 0.2
    assert set(request.probabilities) >= {"pose 1", "pose 2"}
    assert len(request.values["palm_start_m"]) == len(request.values["palm_direction"]) == 3
    assert "touch" in message_line(request)
