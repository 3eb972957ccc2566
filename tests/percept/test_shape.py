"""Shapes by their evidence: the right class, sizes with valid deviations, undetermined otherwise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.bench_shape import touched
from handtouch.field import Rectangle
from handtouch.percept.action_request import expected_information_bits
from handtouch.percept.classify import ShapeClassification, classify_shape
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.primitives import SHAPE_CLASSES, SIZE_PARAMETERS
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate
from handtouch.percept.shape import ShapeEstimator, pair_distance, spot_probabilities
from handtouch.wire import PERCEPT_KINDS

FloatArray = NDArray[np.float64]
Touches = tuple[FloatArray, FloatArray, FloatArray]


def touches(kind: str, n: int, seed: int, radius: float = 0.02, patch: float = 1.2) -> Touches:
    """Places, normals of the pads and covariances of n touches of an object that lies anyhow."""
    chance = np.random.default_rng(seed)
    along, angle = chance.uniform(-0.03, 0.03, (n, 2)), chance.uniform(-patch, patch, n)
    if kind == "flat":
        outward, points = np.tile([0, 0, 1.0], (n, 1)), np.c_[along, np.zeros(n)]
    elif kind == "sphere":
        z, turn = chance.uniform(math.cos(patch), 1, n), chance.uniform(0, 2 * np.pi, n)
        outward = np.c_[np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
        points = radius * outward
    else:
        angle = angle if kind == "cylinder" else angle * 0.7 / patch
        outward = np.c_[np.zeros(n), np.sin(angle), np.cos(angle)]
        points = (radius if kind == "cylinder" else 0.0) * outward
        points[:, 0] = along[:, 0]
    across = np.eye(3) - outward[:, :, None] * outward[:, None]
    points = points + 0.5e-3 * np.einsum("nij,nj->ni", across, chance.normal(size=(n, 3)))
    points += 0.3e-3 * chance.normal(size=(n, 1)) * outward
    normal = outward + 0.07 * chance.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn, _ = np.linalg.qr(chance.normal(size=(3, 3)))
    away = 0.05 * chance.normal(size=3)
    return points @ turn.T + away, -normal @ turn.T, 0.5e-3**2 * turn @ across @ turn.T


@pytest.mark.parametrize("kind", SHAPE_CLASSES)
def test_twenty_touches_give_class_and_size(kind: str) -> None:
    for seed in range(8):
        found = classify_shape(*touches(kind, 20, seed))
        assert found.label == kind
        if SIZE_PARAMETERS[kind]:
            fit = found.fits[kind]
            assert abs(fit.radius_m - 0.02) < 4 * fit.radius_std_m < 0.008


@pytest.mark.parametrize("kind", SHAPE_CLASSES)
def test_few_touches_are_undetermined(kind: str) -> None:
    for n in (1, 2):
        found = classify_shape(*touches(kind, n, 3))
        assert (found.state, found.label, found.contacts) == ("undetermined", "", n)
    wrong = [classify_shape(*touches(kind, 3, seed)).label not in ("", kind) for seed in range(20)]
    assert np.mean(wrong) <= 0.25


def test_touches_in_a_row_on_a_plane_are_not_an_edge() -> None:
    points, normals, covariances = touches("flat", 30, 5)
    row = points[0] + np.linspace(0, 0.03, 30)[:, None] * np.cross(normals[0], [0.3, 0.5, 0.8])
    even = np.tile(normals[0], (30, 1)) + 0.02 * np.random.default_rng(1).normal(size=(30, 3))
    found = classify_shape(row, even, covariances)
    assert found.probabilities["edge"] < 1e-3
    assert found.label == "flat"


def test_shape_outside_the_classes_is_invalid() -> None:
    chance = np.random.default_rng(4)
    normals = chance.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = classify_shape(0.03 * chance.normal(size=(20, 3)), normals, np.tile(1e-7 * np.eye(3), (20, 1, 1)))
    assert (found.state, found.label) == ("invalid", "")


@pytest.mark.parametrize("kind", ["cylinder", "sphere"])
def test_object_seen_to_move_keeps_its_class_and_is_marked_as_moving(kind: str) -> None:
    for seed in range(4):
        points, normals, covariances = touches(kind, 20, seed)
        rests = classify_shape(points, normals, covariances, moves=True)
        points = points + np.random.default_rng(seed).normal(0.0, 2e-3, (20, 3))
        moved = classify_shape(points, normals, covariances, moves=True)
        assert (rests.state, rests.label, rests.object_moves) == ("estimated", kind, False)
        assert (moved.state, moved.label, moved.object_moves) == ("estimated", kind, True)
        assert classify_shape(points, normals, covariances).state == "invalid"
        fits = rests.fits[kind], moved.fits[kind]
        assert abs(fits[1].radius_m - 0.02) < 3 * fits[1].radius_std_m
        assert fits[1].radius_std_m > fits[0].radius_std_m


def test_few_misfitting_touches_are_not_explained_by_motion() -> None:
    points, normals, covariances = touches("sphere", 5, 1)
    points = points + np.random.default_rng(2).normal(0.0, 4e-3, (5, 3))
    found = classify_shape(points, normals, covariances, moves=True)
    assert (found.state, found.object_moves) == ("invalid", False)


@pytest.mark.parametrize("each", [2, 12])
def test_radii_have_valid_deviations_where_a_pads_touches_share_its_errors(each: int) -> None:
    inside = []
    for seed in range(20):
        kind, radius = ("sphere", "cylinder")[seed % 2], 0.008 + 0.0015 * seed
        of, pads = touched(kind, each, np.random.default_rng(seed), radius)
        found = classify_shape(*of, pads=pads)
        assert found.label == kind
        inside.append(abs(found.fits[kind].radius_m - radius) < 1.96 * found.fits[kind].radius_std_m)
    assert np.mean(inside) >= 0.85  # of 0.95 in 20: 1 in 400 is lower


@pytest.mark.parametrize(("kind", "labelled"), [("box", 0), ("ellipsoid", 1)])
def test_what_the_classes_lack_has_no_label(kind: str, labelled: int) -> None:
    labels = []
    for seed in range(10):
        of, pads = touched(kind, 2, np.random.default_rng(seed), 0.02)
        labels.append(classify_shape(*of, pads=pads).label)
    assert np.count_nonzero(labels) <= labelled


def test_pose_of_the_object_makes_no_difference() -> None:
    points, normals, covariances = touches("cylinder", 12, 6)
    turn, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))
    plain = classify_shape(points, normals, covariances)
    moved = classify_shape(points @ turn.T + 0.2, normals @ turn.T, turn @ covariances @ turn.T)
    assert moved.fits["cylinder"].radius_m == pytest.approx(plain.fits["cylinder"].radius_m, rel=1e-3)
    assert moved.probabilities == pytest.approx(plain.probabilities, abs=0.02)
    axis = turn @ plain.fits["cylinder"].direction
    assert abs(axis @ moved.fits["cylinder"].direction) == pytest.approx(1, abs=1e-3)


def test_uncertain_touch_is_down_weighted() -> None:
    points, normals, covariances = touches("sphere", 20, 2)
    points[0] += 0.01
    loose = covariances.copy()
    loose[0] = 0.02**2 * np.eye(3)
    off = abs(classify_shape(points, normals, loose).fits["sphere"].radius_m - 0.02)
    assert off < 0.5 * abs(classify_shape(points, normals, covariances).fits["sphere"].radius_m - 0.02)


def test_invalid_contacts_are_rejected() -> None:
    points, normals, covariances = touches("flat", 4, 1)
    with pytest.raises(ValueError, match="must be"):
        classify_shape(points, normals[:3], covariances)
    with pytest.raises(ValueError, match="finite"):
        classify_shape(points * np.nan, normals, covariances)


def explored(
    kind: str, n: int, seed: int, radius: float = 0.02, drift_m: float = 0.0
) -> tuple[list[PerceptEstimate], ShapeEstimator, ShapeClassification]:
    """The part on a stream: one pad touches n places, 60 samples each."""
    stream, part = ContactBuffer(1), ShapeEstimator(1)
    perceiver = PerceptPipeline(stream, [part])
    perceiver.set_requested(np.ones((len(PERCEPT_KINDS), 1), np.bool_), np.ones(1, np.bool_))
    points, normals, covariances = touches(kind, n, seed, radius)
    points = points + drift_m * np.arange(n)[:, None] * [0.6, 0.0, 0.8]
    percepts: list[PerceptEstimate] = []
    t_ns = 0
    for contact in range(n):
        for _ in range(60):
            t_ns += 10_000_000
            sample = ContactSamples(
                np.zeros(1, np.intp), np.array([t_ns]), np.array([contact + 1], np.uint32)
            )
            sample["palm_position_m"], sample["palm_normal"] = points[contact], normals[contact]
            sample["palm_covariance_m2"] = covariances[contact]
            sample["residual"], sample["residual_std"] = np.zeros(1), np.full(1, 0.01)
            percepts += perceiver.process_tick(sample, np.zeros(0, np.intp), t_ns)[0]
    return [p for p in percepts if p.pad < 0], part, classify_shape(points, normals, covariances)


def test_estimator_collects_touches_and_agrees_with_the_fit() -> None:
    percepts, _, expected = explored("sphere", 12, 3)
    assert percepts[0].state == "undetermined"
    assert (percepts[-1].state, percepts[-1].label) == ("estimated", "sphere")
    assert percepts[-1].evidence == {"contacts": 12, "pads": 1}
    assert percepts[-1].values["radius_m"] == pytest.approx(expected.fits["sphere"].radius_m, rel=0.1)
    assert percepts[-1].probabilities["sphere"] == pytest.approx(expected.probabilities["sphere"], abs=0.05)


def test_drifting_object_keeps_its_shape() -> None:
    for seed in range(3):
        percepts, _, at_once = explored("sphere", 14, seed, drift_m=0.9e-3)
        assert at_once.state == "invalid"
        assert (percepts[-1].state, percepts[-1].label, percepts[-1].values["object_moves"]) == (
            "estimated",
            "sphere",
            False,
        )


def test_flat_or_large_cylinder_poses_a_slide_question() -> None:
    percepts, part, _ = explored("flat", 2, 1)
    assert percepts[-1].state == "undetermined"
    (question,) = part.open_questions(10**9)
    assert question.hypotheses == percepts[-1].probabilities
    assert {action.kind for action in question.actions} == {"slide"}
    bits = max(expected_information_bits(question, action) for action in question.actions)
    assert 0.0 < bits <= 2.0
    assert all(action.parameters["distance_m"] == 5e-3 for action in question.actions)


@pytest.mark.parametrize(("residual", "label"), [(0.0, "point"), (0.1, "along x"), (-0.1, "along y")])
def test_residual_distinguishes_points_from_elongated_contacts(residual: float, label: str) -> None:
    noise = np.random.default_rng(1).normal(size=64)
    chances = spot_probabilities(residual + 0.01 * noise, np.full(64, 0.01))
    assert chances[label] > 0.9
    weak = spot_probabilities(0.02 + 0.05 * noise[:1], np.full(1, 0.05))
    assert max(weak.values()) < 0.9


@pytest.mark.parametrize("along_y", [False, True])
def test_distance_of_two_points_follows_from_the_residual(along_y: bool) -> None:
    pad = Rectangle(1.0, 1.0)
    half = np.array([0.0, 0.05] if along_y else [0.05, 0.0])
    shares = (pad.fractions(np.array(0.5 + s * half[0]), np.array(0.5 + s * half[1])) / 2 for s in (-1, 1))
    pair = np.sum(list(shares), axis=0)
    residual = float(pair[0] + pair[1] - 0.5)  # in the middle a point gives a half
    distance, std = pair_distance(pad, 0.5, 0.5, residual, abs(residual) / 10)
    assert distance == pytest.approx(0.1, rel=0.02)
    assert std == pytest.approx(distance / 20)
    assert math.isinf(pair_distance(pad, 0.5, 0.5, residual, abs(residual))[1])
