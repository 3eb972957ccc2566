"""Percept `object`: laws of its shapes, of the sampled poses, and of the estimates over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch.config import ObjectTable
from handtouch.percept.estimator import HandSnapshot
from handtouch.percept.object_estimator import ObjectEstimator
from handtouch.percept.object_pose import FREE_ROTATION_RAD2, PoseEvidence, PoseHypothesis, PoseSampler
from handtouch.percept.object_shapes import KnownShape, build_shape
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate

FloatArray = NDArray[np.float64]
POINT_STD_M, NORMAL_STD_RAD = 4e-4, 0.1
CHI2_3_95, CHI2_6_95 = 7.81, 12.59
MAX_DISTANCES_OF_CONTACTS, MAX_DISTANCES_WITH_PADS = 4_000, 40_000
SHAPES: dict[str, dict[str, Any]] = {
    "sphere": {"diameter_mm": 50.0},
    "box": {"size_mm": (40.0, 100.0, 30.0)},
    "cylinder": {"diameter_mm": 30.0, "length_mm": 80.0},
    "bolt": {"diameter_mm": 16.0, "length_mm": 80.0, "head_diameter_mm": 26.0, "head_length_mm": 12.0},
}


def table(kind: str, **keys: Any) -> ObjectTable:
    return ObjectTable.model_validate({"shape": {"kind": kind, **(keys or SHAPES[kind])}})


def touches(
    rotation: Rotation,
    position: FloatArray,
    feet: tuple[FloatArray, FloatArray],
    seed: int,
) -> PoseEvidence:
    """Return touches at points of the surface with normals, with the errors that the evidence states."""
    rng = np.random.default_rng(seed)
    points = rotation.apply(feet[0]) + position + POINT_STD_M * rng.normal(size=feet[0].shape)
    normals = -rotation.apply(feet[1]) + NORMAL_STD_RAD * rng.normal(size=feet[0].shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    c = len(points)
    return PoseEvidence(
        points,
        normals,
        np.zeros((c, 3, 3)),
        np.full(c, POINT_STD_M),
        np.full(c, NORMAL_STD_RAD),
        np.full(c, 0.03),
        np.zeros((0, 1, 3)),
        np.zeros(0),
    )


def sampled(shape: KnownShape, evidence: PoseEvidence, seed: int = 0) -> PoseSampler:
    sampler = PoseSampler(shape, seed)
    for _ in range(5):
        sampler.update(evidence)
    return sampler


def mahalanobis2(hypothesis: PoseHypothesis, rotation: Rotation, position: FloatArray) -> float:
    """Return the squared distance of the truth, of position and of the direction of the z axis."""
    own = Rotation.from_quat(hypothesis.quaternion)
    axis, true_axis = own.apply([0.0, 0.0, 1.0]), rotation.apply([0.0, 0.0, 1.0])
    apart = np.append(position - hypothesis.position_m, np.cross(axis, true_axis))
    return float(apart @ np.linalg.solve(hypothesis.covariance, apart))


@pytest.mark.parametrize("kind", SHAPES)
def test_the_gradient_of_a_distance_is_its_derivative_and_leads_to_the_surface(kind: str) -> None:
    shape, step = build_shape(table(kind)), 1e-7
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (400, 3)) * shape.half_m
    distance, normal = shape.distance_and_normal(points)
    slopes = [
        (shape.distance(points + step * e) - shape.distance(points - step * e)) / (2 * step)
        for e in np.eye(3)
    ]
    smooth = np.quantile(np.abs(np.stack(slopes, axis=1) - normal).max(axis=1), 0.97)  # but at inner edges
    assert smooth < 1e-5
    outside = distance > 0
    feet = points[outside] - distance[outside, None] * normal[outside]
    np.testing.assert_allclose(shape.distance(feet), 0.0, atol=1e-12)


def test_the_head_of_a_bolt_is_at_its_negative_end() -> None:
    shape = build_shape(table("bolt"))
    along = np.array([[12e-3, 0.0, -40e-3], [12e-3, 0.0, 40e-3]])
    assert shape.distance(along).tolist() == pytest.approx([-1e-3, 4e-3])
    np.testing.assert_allclose(shape.half_m, [13e-3, 13e-3, 46e-3])


def write_box(file: Path, low: FloatArray, high: FloatArray) -> None:
    """Write the STL file of a box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(a, b, c) for q in quads for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    lines = ["solid box"]
    for triangle in triangles:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {' '.join(map(str, corners[k]))}" for k in triangle]
        lines += ["endloop", "endfacet"]
    file.write_text("\n".join([*lines, "endsolid box"]))


def test_a_mesh_has_the_distances_of_its_surface_and_the_frame_of_its_file(tmp_path: Path) -> None:
    low, high = np.array([10.0, -5.0, 0.0]), np.array([50.0, 95.0, 30.0])
    write_box(tmp_path / "box.stl", low, high)
    mesh, box = build_shape(table("mesh", file=str(tmp_path / "box.stl"))), build_shape(table("box"))
    points = np.random.default_rng(2).uniform(-1.3, 1.3, (500, 3)) * box.half_m
    expected, normal = box.distance_and_normal(points)
    distance, own_normal = mesh.distance_and_normal(points)
    cell_m = 100e-3 / 40
    assert np.abs(distance - expected).max() < 0.5 * cell_m
    smooth = (expected > 2 * cell_m) & (expected < 8 * cell_m)
    assert np.quantile(np.einsum("ni,ni->n", normal, own_normal)[smooth], 0.05) > 0.98
    np.testing.assert_allclose(mesh.frame_m, -1e-3 * (low + high) / 2)


def test_a_mesh_with_a_hole_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "open.stl"
    write_box(file, np.zeros(3), np.ones(3))
    text = file.read_text().split("facet normal 0 0 0")
    file.write_text("facet normal 0 0 0".join(text[:-1]))
    with pytest.raises(ValueError, match="closed"):
        build_shape(table("mesh", file=str(file)))


def test_the_truth_lies_in_the_covariance_as_often_as_it_says() -> None:
    """Ninety-five of a hundred in its own world; here of 48 poses of bolts and cylinders at eight touches."""
    rng, inside, errors = np.random.default_rng(5), [], []
    for trial in range(48):
        shape = build_shape(table("bolt" if trial % 2 else "cylinder"))
        rotation, position = Rotation.random(random_state=trial), rng.normal(scale=0.05, size=3)
        feet = shape.surface_points(np.random.default_rng(trial), 8)
        best = sampled(shape, touches(rotation, position, feet, trial)).hypotheses[0]
        if (
            trial % 2 == 0
            and Rotation.from_quat(best.quaternion).apply([0, 0, 1]) @ rotation.apply([0, 0, 1]) < 0
        ):
            rotation = rotation * Rotation.from_rotvec([np.pi, 0, 0])  # a cylinder has no head
        inside.append(mahalanobis2(best, rotation, position) < CHI2_6_95)
        errors.append(np.linalg.norm(best.position_m - position))
    assert np.mean(inside) >= 0.85  # three standard deviations of 48 draws below 0.95
    assert np.median(errors) < 1.5e-3


@pytest.mark.parametrize("kind", ["bolt", "box"])
def test_hypotheses_move_with_the_evidence(kind: str) -> None:
    shape = build_shape(table(kind))
    feet = shape.surface_points(np.random.default_rng(3), 7)
    still = touches(Rotation.identity(), np.zeros(3), feet, 3)
    turn, shift = Rotation.from_rotvec([0.4, -1.9, 0.8]), np.array([0.3, -0.1, 0.2])
    moved = still._replace(point_m=turn.apply(still.point_m) + shift, normal=turn.apply(still.normal))
    first, second = sampled(shape, still).hypotheses[0], sampled(shape, moved).hypotheses[0]
    apart = second.position_m - (turn.apply(first.position_m) + shift)
    std_m = np.sqrt(np.trace(first.covariance[:3, :3]))
    assert np.linalg.norm(apart) < std_m
    turned = np.kron(np.eye(2), turn.as_matrix())
    expected = np.diag(turned @ first.covariance @ turned.T)[:3]
    np.testing.assert_allclose(np.sqrt(np.diag(second.covariance)[:3]), np.sqrt(expected), rtol=0.5)


def test_the_rotation_of_a_sphere_is_undetermined_and_its_position_isnt() -> None:
    shape = build_shape(table("sphere"))
    feet = shape.surface_points(np.random.default_rng(4), 4)
    (found,) = sampled(shape, touches(Rotation.identity(), np.full(3, 0.1), feet, 4)).hypotheses
    np.testing.assert_allclose(np.diag(found.covariance)[3:], FREE_ROTATION_RAD2, rtol=0.01)
    assert np.linalg.norm(found.position_m - 0.1) < 3e-3


def shank_touches() -> tuple[KnownShape, PoseEvidence]:
    """Return touches around the shank of a bolt that lies along z: either end may be the head."""
    shape = build_shape(table("bolt"))
    angle, height = np.array([0.0, 2.1, 4.2, 1.0, 3.1]), np.array([-12e-3, 12e-3, 0.0, -6e-3, 6e-3])
    outward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    feet = 8e-3 * outward + np.outer(height, [0, 0, 1]) + [0, 0, 6e-3], outward
    return shape, touches(Rotation.identity(), np.zeros(3), feet, 6)


def towards_head(hypotheses: list[PoseHypothesis]) -> tuple[float, float]:
    """Return the weights of the free end at +z and at -z."""
    axes = [Rotation.from_quat(h.quaternion).apply([0, 0, 1])[2] for h in hypotheses]
    return tuple(
        sum(h.weight for h, z in zip(hypotheses, axes, strict=True) if sign * z > 0) for sign in (1, -1)
    )  # type: ignore[return-value]


def test_a_cylinder_touched_on_its_side_is_free_along_its_axis() -> None:
    shape, rotation = build_shape(table("cylinder")), Rotation.random(random_state=2)
    angles, along = np.arange(6) * np.pi / 3, np.array([-8.0, 0.0, 8.0, -8.0, 0.0, 8.0]) * 1e-3
    outward = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    feet = 15e-3 * outward + along[:, None] * [0.0, 0.0, 1.0]
    best = sampled(shape, touches(rotation, np.zeros(3), (feet, outward), 1)).hypotheses[0]
    own_axis = rotation.apply([0.0, 0.0, 1.0])
    variance = best.covariance[:3, :3]
    along_m2 = own_axis @ variance @ own_axis
    assert along_m2 > 8e-3**2
    assert np.trace(variance) - along_m2 < 2 * 1e-3**2
    assert abs(best.position_m @ own_axis) < 3 * np.sqrt(along_m2)


def test_which_end_is_the_head_stays_open_until_an_untouched_pad_excludes_one() -> None:
    shape, evidence = shank_touches()
    up, down = towards_head(sampled(shape, evidence).hypotheses)
    assert min(up, down) > 0.15
    ring = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    reach = np.linspace(19e-3, 100e-3, 60)
    free = np.array([[10.5e-3 * np.cos(a), 10.5e-3 * np.sin(a), z] for a in ring for z in reach])
    cleared = evidence._replace(free_m=free[None], free_std_m=np.full(1, 0.8e-3))
    up, down = towards_head(sampled(shape, cleared).hypotheses)
    assert up > 30 * down
    assert up > 0.5


# Over time --------------------------------------------------------------------------------------------------

PADS = 6
STEP_NS = 50_000_000


class Hand:
    """A hand whose links are the palm: pads touch an object where its surface is, and see it by snapshots."""

    def __init__(self, known: str) -> None:
        self.known, self.t_ns = known, 0
        self.buffer = ContactBuffer(PADS)
        self.estimator = ObjectEstimator(np.full((PADS, 1, 3), 10.0))
        self.estimator.requested[:] = True
        self.rotation, self.origin_m = np.tile(np.eye(3), (PADS, 1, 1)), np.zeros((PADS, 3))
        self.base_m = np.array([1.0, 0.0, 0.0])

    def step(
        self, points: FloatArray, normals: FloatArray, contact_id: int = 1, slips: float = 0.0
    ) -> PerceptEstimate:
        """Let the first pads touch at points with normals; return the estimate."""
        self.t_ns += STEP_NS
        k = len(points)
        ids = np.where(np.arange(PADS) < k, contact_id, 0).astype(np.uint32)
        self.buffer.end_contacts(np.flatnonzero((self.buffer.contact_id > 0) & (ids == 0)))
        if k:
            sample = ContactSamples(np.arange(k), np.full(k, self.t_ns), ids[:k])
            sample["palm_position_m"], sample["palm_normal"] = points, normals
            sample["palm_covariance_m2"] = np.tile(1e-7 * np.eye(3), (k, 1, 1))
            self.buffer.add_samples(sample)
        snapshot = HandSnapshot(
            *(0, 0, self.t_ns, ids, ids == 0, np.full(PADS, slips)),
            *(self.rotation.copy(), self.origin_m.copy(), np.eye(3), self.base_m.copy()),
            self.known,
        )
        (found,) = self.estimator.process_hand(self.buffer, snapshot)
        return found


def known(kind: str) -> str:
    return f"thing={table(kind).model_dump_json()}"


def feet_of(kind: str, seed: int, count: int = PADS) -> tuple[FloatArray, FloatArray]:
    points, normals = build_shape(table(kind)).surface_points(np.random.default_rng(seed), count)
    return points, -normals


def test_without_object_or_contact_the_pose_is_undetermined() -> None:
    points, normals = feet_of("sphere", 1)
    assert Hand("").step(points, normals).state == "undetermined"
    found = Hand(known("sphere")).step(np.zeros((0, 3)), np.zeros((0, 3)))
    assert (found.state, found.reason) == ("undetermined", "nothing touches the object")


def test_without_the_pose_of_a_link_the_reason_is_that_joint_states_are_missing() -> None:
    hand = Hand(known("sphere"))
    hand.origin_m[:] = np.nan
    found = hand.step(*feet_of("sphere", 1))
    assert (found.state, found.poses) == ("undetermined", ())
    assert "joint states" in found.reason


def test_a_mesh_that_is_missing_is_the_reason_of_an_undetermined_pose() -> None:
    found = Hand(f"thing={table('mesh', file='/nowhere.stl').model_dump_json()}").step(*feet_of("sphere", 1))
    assert found.state == "undetermined"
    assert "nowhere.stl" in found.reason


def test_poses_are_published_in_palm_and_base_with_the_weight_of_each() -> None:
    hand = Hand(known("sphere"))
    found = hand.step(*feet_of("sphere", 2, 4))
    assert (found.state, found.label) == ("estimated", "thing")
    pose = found.poses[0]
    np.testing.assert_allclose(pose["palm_position_m"], 0.0, atol=2e-3)
    np.testing.assert_allclose(
        np.array(pose["base_position_m"]) - pose["palm_position_m"], [1, 0, 0], atol=1e-12
    )
    assert sum(pose["weight"] for pose in found.poses) <= 1 + 1e-9


def test_a_contact_that_sticks_carries_the_object_with_its_link() -> None:
    points, normals = feet_of("sphere", 3, 4)
    hand = Hand(known("sphere"))
    hand.step(points, normals)
    for k in range(1, 11):
        shift = np.array([1e-3 * k, 0.0, 0.0])
        hand.origin_m[:4] = shift
        found = hand.step(points + shift, normals)
    assert found.evidence["points"] == 4  # the same places of the object, not new ones
    np.testing.assert_allclose(found.poses[0]["palm_position_m"], [10e-3, 0, 0], atol=2e-3)


def test_the_pose_recovers_after_a_drop_and_a_regrasp_elsewhere() -> None:
    points, normals = feet_of("box", 5)
    hand = Hand(known("box"))
    for _ in range(4):
        hand.step(points, normals)
    assert hand.step(points[:0], normals[:0]).state == "undetermined"
    turn, shift = Rotation.from_rotvec([0.0, 1.2, 0.9]), np.array([0.03, -0.05, 0.02])
    for _ in range(6):
        found = hand.step(turn.apply(points) + shift, turn.apply(normals), contact_id=2)
    assert found.state == "estimated", found.reason
    assert np.linalg.norm(np.array(found.poses[0]["palm_position_m"]) - shift) < 3e-3


def test_what_nothing_holds_stays_in_the_base_while_the_palm_moves() -> None:
    points, normals = feet_of("sphere", 9, 4)
    hand, way = Hand(known("sphere")), np.array([0.02, 0.0, -0.01])
    hand.step(points, normals)
    hand.step(points[:0], normals[:0])
    hand.base_m = hand.base_m + way
    hand.step(points[:0], normals[:0])
    found = hand.step(points[:1] - way, normals[:1], contact_id=2)
    assert found.evidence["points"] == 4  # three are remembered
    np.testing.assert_allclose(found.poses[0]["palm_position_m"], -way, atol=2e-3)


def test_errors_that_the_points_of_a_pad_share_dont_make_a_pose_sharper() -> None:
    """Three pads, each off by as much in all of its touches: the sphere is in the 95 % ellipsoid as often."""
    rng, inside = np.random.default_rng(12), []
    for trial in range(8):
        _, normals = feet_of("sphere", 20 + trial, 3)
        off = 0.5e-3 * rng.normal(size=(3, 1)) * normals - 0.4e-3 * normals  # and the skin gives way
        hand = Hand(known("sphere"))
        for _ in range(3):
            beside = normals + 0.2 * rng.normal(size=(3, 3))
            beside /= np.linalg.norm(beside, axis=1, keepdims=True)
            found = hand.step(25e-3 * -beside - off, beside)
        pose = found.poses[0]
        covariance = np.array(pose["palm_covariance"]).reshape(6, 6)[:3, :3]
        position = np.array(pose["palm_position_m"])
        inside.append(position @ np.linalg.solve(covariance, position) < CHI2_3_95)
    assert found.evidence["points"] > 4
    assert np.mean(inside) >= 0.75  # with 95 %, fewer of 8 have a probability of 0.6 %


class CountingShape(KnownShape):
    """A shape that counts the points whose distance was asked."""

    def __init__(self, shape: KnownShape) -> None:
        super().__init__(shape.half_m, shape.free_axes, shape.symmetries, shape.frame_m)
        self.shape, self.count = shape, 0

    def distance_and_normal(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        self.count += points.size // 3
        return self.shape.distance_and_normal(points)

    def counted(self) -> int:
        """Return the count since the last call."""
        count, self.count = self.count, 0
        return count


def test_an_update_costs_few_distances_and_known_evidence_almost_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shapes: list[CountingShape] = []

    def counting(stated: ObjectTable) -> KnownShape:
        shapes.append(CountingShape(build_shape(stated)))
        return shapes[-1]

    monkeypatch.setattr("handtouch.percept.object_estimator.build_shape", counting)
    hand = Hand(known("bolt"))
    points, normals = feet_of("bolt", 11)
    counts, poses = [], []
    for _ in range(12):
        found = hand.step(points, normals)
        counts.append(shapes[0].counted())
        poses.append(found.poses)
    assert max(counts[1:]) < MAX_DISTANCES_OF_CONTACTS
    assert min(counts) < 0.01 * MAX_DISTANCES_OF_CONTACTS
    assert poses[-1] == poses[-2]


def test_pads_near_the_object_cost_a_bounded_number_of_distances() -> None:
    shape = CountingShape(build_shape(table("bolt")))
    feet = shape.surface_points(np.random.default_rng(13), 6)
    evidence = touches(Rotation.identity(), np.zeros(3), feet, 13)
    x, y = (part.ravel() for part in np.meshgrid([-8e-3, -3e-3, 3e-3, 8e-3], [-8e-3, -3e-3, 3e-3, 8e-3]))
    pad = np.stack([x, y, 0 * x], axis=1)
    turns = np.arange(15.0)
    middle = np.stack([15e-3 * np.cos(turns), 15e-3 * np.sin(turns), 5e-3 * (turns - 7)], axis=1)
    free = middle[:, None] + pad
    evidence = evidence._replace(free_m=free, free_std_m=np.full(15, 1e-3))
    sampler = sampled(shape, evidence)
    shape.counted()
    sampler.update(evidence)
    assert shape.counted() < MAX_DISTANCES_WITH_PADS


def test_contacts_that_no_pose_explains_are_invalid() -> None:
    rng = np.random.default_rng(8)
    points = rng.normal(size=(PADS, 3))  # a metre apart
    found = Hand(known("bolt")).step(points, -points / np.linalg.norm(points, axis=1, keepdims=True))
    assert found.state != "estimated"
