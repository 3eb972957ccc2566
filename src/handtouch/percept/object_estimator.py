"""Percept `object`: pose of a known object in each hand, from all its contacts and its untouched pads.

Twenty times a second the touched points and the surfaces of the pads go to a `PoseSampler`, while they
change. A contact that sticks carries the object with its link: that motion is applied to samples and earlier
points. An object that nothing holds rests in the base. A point is remembered while the object is, less
certain with every motion since.

Public name: `ObjectEstimator`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from handtouch import wire
from handtouch.arrays import FloatArray, IntArray
from handtouch.config.objects import ObjectTable
from handtouch.hand.rotations import rotation_matrices
from handtouch.percept.action_request import Question
from handtouch.percept.estimator import HandSnapshot, PerceptEstimator
from handtouch.percept.object_pose import (
    MAX_CONTACT_COST,
    MAX_OUTLIERS,
    PoseEvidence,
    PoseHypothesis,
    PoseSampler,
    multiply,
)
from handtouch.percept.object_questions import object_questions
from handtouch.percept.object_shapes import KnownShape, build_shape
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate

# Constants without an origin beside them were chosen on grasps of the tuning family;
# docs/benchmarks/object.md measures what they yield on others.
_INDENTATION_M = 0.4e-3  # by which the skin gives where it is touched, in the mean
_COMMON_STD_M, _OWN_STD_M = 0.5e-3, 0.2e-3  # of a touched point, on top of its covariance
_COMMON_STD_RAD, _OWN_STD_RAD = 0.09, 0.05  # of its normal; the first is common to all points of a pad
_EDGE_M, _EDGE_SHARE, _FACE_SHARE = 3.5e-3, 0.3, 0.03
"""Distance from a pad's edge within which the edge may touch, and probabilities that it does"""
_CLEAR_STD_M, _TOUCHED_STD_M = 0.6e-3, 1.0e-3  # penetration of the model by a pad's surface
_MIN_POINT_DISTANCE_M, _MIN_NORMAL_CHANGE = 3e-3, 0.15  # from one remembered point of a pad to its next
_MAX_POINTS = 30
_MAX_POINT_STD_M = 4e-3
"""A remembered point less certain than this is dropped."""
_MEMORY_NS = 5_000_000_000  # without touch, before another object is assumed
_MAX_SAMPLE_AGE_NS = 100_000_000
_STICKING_STD_M, _STICKING_SHARE = 0.05e-3, 0.15  # of a sticking contact's displacement: fixed, and its share
_SLIDING_STD_M = 5e-3
_REST_STD_M, _REST_STD_RAD = 3e-3, 0.1  # of the object's motion in one period, where no contact shows it
_SAME_SHARE = 0.8
"""Part of its standard deviation by which evidence may differ from that used last, to count as the same"""
_SETTLING_UPDATES, _REFRESH_UPDATES = 3, 20
MIN_WEIGHT = 0.7
MAX_POSITION_STD_M, MAX_ROTATION_STD_RAD = 8e-3, math.radians(20)
"""A pose is `estimated` within these; the greatest standard deviation of any direction counts."""
_MIN_EFFECTIVE_SAMPLES = 12.0
_PADS_NEEDED = {0: 4, 1: 3, 3: 1}
"""By free axes. A pad gives three equations; two leave none over that would show a wrong pose of six
unknowns: with two, 3 of 7 poses of held-out grasps were covered. The faces of a box are square to each other,
so that the normals of three pads fit any of its faces alike: 1 of 3 poses was covered."""
_log = logging.getLogger("handtouch.percept")


@dataclass
class _Point:
    """A touched point of the object, in the palm."""

    pad: int
    contact_id: int
    point_m: FloatArray
    normal: FloatArray
    variance_m2: float  # along the normal
    edge_share: float  # probability that the pad's edge touches
    spread_m: FloatArray  # L of the covariance L L^T across the normal
    moved_m2: float = 0.0  # variance of the object's motion since
    turned_rad2: float = 0.0


class _TrackedObject:
    """The object in one hand: its samples, and the points that were touched."""

    def __init__(self, text: str, hand: int, extent_m: FloatArray) -> None:
        self.text, self.hand, self._extent_m = text, hand, extent_m
        self.name, self.problem = "", ""
        self.shape: KnownShape | None = None
        self.sampler: PoseSampler | None = None
        self.points: list[_Point] = []
        self.last_touch_ns = 0
        self._before: HandSnapshot | None = None
        self._rows: IntArray = np.zeros(0, np.intp)  # pads of the latest evidence
        self._evidence: PoseEvidence | None = None  # the latest
        self._used_fit: FloatArray | None = None  # of that used last, when it was
        self._used_places: tuple[int, ...] = ()
        self._asked_hypotheses: list[PoseHypothesis] = []
        self._questions: list[Question] = []
        self._repeats = 0  # snapshots with the same points
        if text:
            self._set_object(text)

    def _set_object(self, text: str) -> None:
        self.name, _, table = text.partition("=")
        try:
            self.shape = build_shape(ObjectTable.model_validate_json(table))
        except ValueError as error:
            self.problem = f"{self.name}: {error}"
            _log.warning("object %s", self.problem)
            return
        self.sampler = PoseSampler(self.shape)

    def update(self, buffer: ContactBuffer, now: HandSnapshot, free_m: FloatArray) -> PerceptEstimate:
        """Return the estimate at a snapshot; free_m: (p, f, 3), points of the hand's pads in their links."""
        if self.sampler is None or self.shape is None:
            return self._undetermined(now, self.problem or "no object is stated for this hand")
        if not np.isfinite(now.origin_m).any():
            return self._undetermined(
                now, "no link's pose is known; send joint states, to a hand with a URDF"
            )
        touched = _touched_pads(buffer, now)
        self._follow_motion(now)
        if now.t_ns - self.last_touch_ns > _MEMORY_NS:
            self.points.clear()
            self.sampler.forget()
            self._used_fit = None
        self._before = now
        if not len(touched):
            return self._undetermined(now, "nothing touches the object")
        self.last_touch_ns = now.t_ns
        self._remember(buffer, touched)
        evidence = self._evidence = self._gather(now, touched, free_m)
        if self._is_new(evidence):
            self._use(evidence)
            if self._is_another_place(evidence, touched):
                self.points = [point for point in self.points if not _is_earlier(point, touched)]
                self.sampler.forget()
                self._use(self._gather(now, touched, free_m))
        return self._estimate(now, len(touched), len(evidence.free_m))

    def questions(self, now_ns: int) -> list[Question]:
        """Return the touches of untouched pads that would tell the present hypotheses apart."""
        now, evidence = self._before, self._evidence
        if self.shape is None or self.sampler is None or now is None or evidence is None:
            return []
        if now_ns - self.last_touch_ns > _MAX_SAMPLE_AGE_NS or self.sampler.outliers > MAX_OUTLIERS:
            return []
        if self._asked_hypotheses is not self.sampler.hypotheses:
            untouched = now.contact_id[self._rows] == 0
            self._asked_hypotheses = self.sampler.hypotheses
            self._questions = object_questions(
                self.hand,
                self.name,
                self.shape,
                self.sampler.hypotheses,
                now.first + self._rows[untouched],
                evidence.free_m[untouched],
            )
        return self._questions

    # Details ----------------------------------------------------------------------------------------------

    def _use(self, evidence: PoseEvidence) -> None:
        assert self.sampler is not None
        self.sampler.update(evidence)
        self._used_places, self._used_fit = self._touched_places, None
        if self.sampler.hypotheses:
            self._used_fit = self.sampler.fit(evidence)

    @property
    def _touched_places(self) -> tuple[int, ...]:
        return tuple(point.pad for point in self.points)

    def _is_new(self, evidence: PoseEvidence) -> bool:
        """Return whether the evidence lies otherwise at the hypotheses than that used last did, by a part of
        its errors; new points are used some times in a row, and all now and then: the search goes on."""
        assert self.sampler is not None
        self._repeats = self._repeats + 1 if self._used_places == self._touched_places else 0
        if self._repeats < _SETTLING_UPDATES or self._repeats % _REFRESH_UPDATES == 0:
            return True
        if self._used_fit is None or self.sampler.effective_samples < _MIN_EFFECTIVE_SAMPLES:
            return True
        fit = self.sampler.fit(evidence)
        return len(fit) != len(self._used_fit) or bool(np.abs(fit - self._used_fit).max() > _SAME_SHARE)

    def _follow_motion(self, now: HandSnapshot) -> None:
        """Move samples and points with the contacts that stick, since the last snapshot."""
        before, points = self._before, self.points
        if before is None or not points:
            return
        held = [p for p in points if now.contact_id[p.pad - now.first] == p.contact_id != 0]
        if not held:
            self._stay_in_base(before, now)
            return
        centre = np.mean([p.point_m for p in held], axis=0)
        # where one contact slides, others that seem to stick may slide unnoticed: the object is rigid
        sliding = max(float(now.slip_probability[p.pad - now.first]) for p in held)
        rows = np.array([p.pad - now.first for p in held])
        at = np.array([p.point_m for p in held])
        turn = now.rotation[rows] @ before.rotation[rows].transpose(0, 2, 1)
        shift = (turn @ (at - before.origin_m[rows])[:, :, None])[:, :, 0] + now.origin_m[rows] - at
        known = np.isfinite(shift).all(axis=1)
        at, shift = at[known], shift[known]
        std_m = _STICKING_STD_M + _STICKING_SHARE * np.linalg.norm(shift, axis=1) + sliding * _SLIDING_STD_M
        lever = _levers(at - centre)
        weighted = lever.transpose(0, 2, 1) / (std_m**2)[:, None, None]
        information = np.diag([_REST_STD_M**-2] * 3 + [_REST_STD_RAD**-2] * 3) + (weighted @ lever).sum(
            axis=0
        )
        covariance = np.linalg.inv(information)
        twist = covariance @ (weighted @ shift[:, :, None]).sum(axis=0)[:, 0]
        rotation = Rotation.from_rotvec(twist[3:]).as_matrix()
        # at rest nothing is added; where a contact slides, the object may have moved by as much as is allowed
        moving = np.linalg.norm(twist[:3]) / _REST_STD_M + np.linalg.norm(twist[3:]) / _REST_STD_RAD
        share = min(max(float(moving), sliding), 1.0)
        along = np.array([p.normal for p in points])
        along = (along[:, None] @ _levers(np.array([p.point_m for p in points]) - centre))[:, 0]
        grown = share * np.einsum("ci,ij,cj->c", along, covariance, along)
        for point, variance in zip(points, grown.tolist(), strict=True):
            point.moved_m2 += variance
            point.turned_rad2 += share * float(np.trace(covariance[3:, 3:])) / 3
        self.points = [p for p in points if p.moved_m2 < _MAX_POINT_STD_M**2]
        self._move(rotation, centre + twist[:3] - rotation @ centre)

    def _stay_in_base(self, before: HandSnapshot, now: HandSnapshot) -> None:
        """Move everything in the palm as an object that stays where it is in the base."""
        rotation = now.base_rotation.T @ before.base_rotation
        translation = now.base_rotation.T @ (before.base_m - now.base_m)
        if np.isfinite(rotation).all() and np.isfinite(translation).all():
            self._move(rotation, translation)

    def _move(self, rotation: FloatArray, translation_m: FloatArray) -> None:
        assert self.sampler is not None
        self.sampler.move(rotation, translation_m)
        for point in self.points:
            point.point_m = rotation @ point.point_m + translation_m
            point.normal, point.spread_m = rotation @ point.normal, rotation @ point.spread_m

    def _remember(self, buffer: ContactBuffer, touched: IntArray) -> None:
        """Replace the last point of each touched pad, or add one where the contact is elsewhere."""
        position = buffer.latest_field(touched, "palm_position_m")
        normal = buffer.latest_field(touched, "palm_normal")
        covariance = buffer.latest_field(touched, "palm_covariance_m2")
        place = buffer.latest_field(touched, "pad_m")
        near_edge = np.minimum(place, self._extent_m[touched] - place).min(axis=1) < _EDGE_M
        for k, pad in enumerate(touched.tolist()):
            variance = float(normal[k] @ covariance[k] @ normal[k])
            point = position[k] - _INDENTATION_M * normal[k]
            spread = _spread_across(covariance[k], normal[k])
            share = _EDGE_SHARE if near_edge[k] else _FACE_SHARE
            new = _Point(pad, int(buffer.contact_id[pad]), point, normal[k], variance, share, spread)
            last = next((p for p in reversed(self.points) if p.pad == pad), None)
            if last is not None and _is_same_place(last, new):
                self.points.remove(last)
            elif last is not None:
                last.contact_id = 0  # the contact is elsewhere by now
            self.points.append(new)
        del self.points[:-_MAX_POINTS]

    def _gather(self, now: HandSnapshot, touched: IntArray, free_m: FloatArray) -> PoseEvidence:
        points = self.points
        known = np.isfinite(now.origin_m).all(axis=1)
        is_touched = np.isin(np.arange(len(now.origin_m)) + now.first, touched)
        rows = self._rows = np.flatnonzero(known & (now.clear | is_touched))
        placed = free_m[rows] @ now.rotation[rows].transpose(0, 2, 1) + now.origin_m[rows][:, None]
        point_std, normal_std = _conservative_stds(points)
        return PoseEvidence(
            point_m=np.array([p.point_m for p in points]),
            normal=np.array([p.normal for p in points]),
            spread_m=np.array([p.spread_m for p in points]),
            point_std_m=point_std,
            normal_std_rad=normal_std,
            edge_share=np.array([p.edge_share for p in points]),
            free_m=placed,
            free_std_m=np.where(is_touched[rows], _TOUCHED_STD_M, _CLEAR_STD_M),
        )

    def _is_another_place(self, evidence: PoseEvidence, touched: IntArray) -> bool:
        """Return whether the likeliest pose contradicts most earlier points, or most present ones: the object
        fell or was turned in between."""
        assert self.sampler is not None
        earlier = np.array([_is_earlier(point, touched) for point in self.points])
        if not earlier.any() or not self.sampler.hypotheses:
            return False
        outlies = self.sampler.contact_costs(self.sampler.hypotheses[0], evidence) > MAX_CONTACT_COST
        return bool(max(np.mean(outlies[earlier]), np.mean(outlies[~earlier])) > MAX_OUTLIERS)

    def _undetermined(self, now: HandSnapshot, reason: str) -> PerceptEstimate:
        return PerceptEstimate("object", self.hand, -1, 0, now.t_ns, "undetermined", reason=reason)

    def _estimate(self, now: HandSnapshot, contacts: int, pads: int) -> PerceptEstimate:
        assert self.sampler is not None
        assert self.shape is not None
        found = self.sampler.hypotheses
        evidence = {
            "contacts": contacts,
            "points": len(self.points),
            "pads": pads,
            "samples": round(self.sampler.effective_samples),
        }
        if not found:
            return self._undetermined(now, "no pose fits better than others")
        poses = tuple(_object_pose(hypothesis, self.shape, now) for hypothesis in found[: wire.MAX_POSES])
        position_std, rotation_std = _greatest_stds(found[0], self.shape, poses[0])
        values = {
            "position_std_m": position_std,
            "orientation_std_rad": rotation_std,
            "free_axes": self.shape.free_axes,
            "outliers": self.sampler.outliers,
        }
        state, reason = self._state(found, position_std, rotation_std)
        return PerceptEstimate(
            *("object", self.hand, -1, 0, now.t_ns, state, self.name),
            {self.name: found[0].weight},
            values,
            evidence,
            reason,
            poses,
        )

    def _state(
        self, found: Sequence[PoseHypothesis], position_std: float, rotation_std: float
    ) -> tuple[str, str]:
        assert self.sampler is not None
        if self.sampler.outliers > MAX_OUTLIERS:
            return "invalid", f"the contacts fit no pose of {self.name}"
        assert self.shape is not None
        pads = len({point.pad for point in self.points})  # points of one pad share its errors
        if pads < (needed := _PADS_NEEDED[self.shape.free_axes]):
            return "undetermined", f"touched by {pads} of the {needed} pads that it needs"
        if found[0].weight < MIN_WEIGHT:
            return "undetermined", f"{len(found)} hypotheses; the likeliest has {found[0].weight:.0%}"
        if self.sampler.effective_samples < _MIN_EFFECTIVE_SAMPLES:
            return "undetermined", "too few samples fit; hold the contacts"
        if position_std > MAX_POSITION_STD_M:
            return "undetermined", f"the position is known to {1e3 * position_std:.0f} mm; touch another side"
        if rotation_std > MAX_ROTATION_STD_RAD:
            return (
                "undetermined",
                f"the orientation is known to {math.degrees(rotation_std):.0f} deg; touch farther apart",
            )
        return "estimated", ""


class ObjectEstimator(PerceptEstimator):
    """Estimates the pose of the known object in each hand.

    free_m: (n, f, 3), points over the surface of every pad, in its link's frame; extent_m: (n, 2), lengths
    along its sides, by default without an end.
    """

    kind = "object"

    def __init__(self, free_m: FloatArray, extent_m: FloatArray | None = None) -> None:
        super().__init__(len(free_m))
        self._free_m = free_m
        self._extent_m = np.full((len(free_m), 2), np.inf) if extent_m is None else extent_m
        self._objects: dict[int, _TrackedObject] = {}

    def process_samples(self, buffer: ContactBuffer, sample: ContactSamples) -> Sequence[PerceptEstimate]:  # noqa: ARG002
        """Return nothing: poses are estimated by snapshots of the whole hand."""
        return ()

    def process_hand(self, buffer: ContactBuffer, snapshot: HandSnapshot) -> Sequence[PerceptEstimate]:
        """Return the pose of the object in a hand."""
        rows = slice(snapshot.first, snapshot.first + len(snapshot.clear))
        if not self.requested[rows].any():
            return ()
        tracked = self._objects.get(snapshot.hand)
        if tracked is None or tracked.text != snapshot.known_object:
            tracked = self._objects[snapshot.hand] = _TrackedObject(
                snapshot.known_object, snapshot.hand, self._extent_m
            )
        return [tracked.update(buffer, snapshot, self._free_m[rows])]

    def open_questions(self, now_ns: int) -> Sequence[Question]:
        """Return which touch would tell the hypotheses about each object apart."""
        return [question for tracked in self._objects.values() for question in tracked.questions(now_ns)]


def _conservative_stds(points: Sequence[_Point]) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations (c,) of distances [m] and normals [rad] that may be taken as independent.

    Points of a pad share the errors of its parts, mount and joints, and all earlier points those of the
    object's motion since. For a matrix C of correlations, diag(sum_j |C_ij|) - C is diagonally dominant, so
    positive semidefinite (Gershgorin): a variance times its row's sum never yields too small a covariance.
    """
    pad = np.array([point.pad for point in points])
    same = pad[:, None] == pad
    found = []
    for common, own, moved in (
        ([p.variance_m2 + _COMMON_STD_M**2 for p in points], _OWN_STD_M**2, [p.moved_m2 for p in points]),
        ([_COMMON_STD_RAD**2] * len(points), _OWN_STD_RAD**2, [p.turned_rad2 for p in points]),
    ):
        shared = same * np.sqrt(np.outer(common, common)) + np.sqrt(np.outer(moved, moved))
        variance = np.diagonal(shared) + own
        correlation = shared / np.sqrt(np.outer(variance, variance))
        np.fill_diagonal(correlation, 1.0)
        found.append(np.sqrt(variance * correlation.sum(axis=1)))
    return found[0], found[1]


def _spread_across(covariance_m2: FloatArray, normal: FloatArray) -> FloatArray:
    """Return L (3, 3) of the part L L^T of a covariance across a normal."""
    across = np.eye(3) - np.outer(normal, normal)
    value, vector = np.linalg.eigh(across @ covariance_m2 @ across)
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))


def _touched_pads(buffer: ContactBuffer, now: HandSnapshot) -> IntArray:
    """Return the pads whose contact has a recent position in the palm."""
    pads: IntArray = now.first + np.flatnonzero(now.contact_id)
    pads = pads[buffer.contact_id[pads] == now.contact_id[pads - now.first]]
    if not len(pads):
        return pads
    at = (buffer.sample_count[pads] - 1) % buffer.length
    recent = now.t_ns - buffer.sample_ns[pads, at] < _MAX_SAMPLE_AGE_NS
    known = np.isfinite(buffer.latest_field(pads, "palm_covariance_m2")).all(axis=(1, 2))
    return np.asarray(pads[recent & known & (buffer.sample_count[pads] > 0)])


def _is_earlier(point: _Point, touched: IntArray) -> bool:
    """Return whether a point isn't one of a present contact."""
    return point.contact_id == 0 or point.pad not in touched


def _is_same_place(last: _Point, new: _Point) -> bool:
    near = np.linalg.norm(new.point_m - last.point_m) < _MIN_POINT_DISTANCE_M
    return bool(near and np.linalg.norm(new.normal - last.normal) < _MIN_NORMAL_CHANGE)


def _levers(points: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, 6) of points by a perturbation about the origin."""
    found = np.zeros((len(points), 3, 6))
    found[:, :, :3] = np.eye(3)
    for row, column, axis, sign in ((0, 4, 2, 1), (0, 5, 1, -1), (1, 3, 2, -1), (1, 5, 0, 1)):
        found[:, row, column] = sign * points[:, axis]
    found[:, 2, 3], found[:, 2, 4] = points[:, 1], -points[:, 0]
    return found


def _greatest_stds(
    hypothesis: PoseHypothesis, shape: KnownShape, pose: wire.ObjectPose
) -> tuple[float, float]:
    """Return the greatest standard deviations of position and rotation over directions, free ones aside."""
    position = np.array(pose["palm_covariance"]).reshape(6, 6)[:3, :3]
    rotation = hypothesis.covariance[3:, 3:]
    if shape.free_axes == 3:
        rotation = np.zeros((3, 3))
    elif shape.free_axes == 1:
        axis = rotation_matrices(hypothesis.quaternion[None])[0, :, 2]
        across = np.eye(3) - np.outer(axis, axis)
        rotation = across @ rotation @ across
    return tuple(math.sqrt(max(float(np.linalg.eigvalsh(part)[-1]), 0.0)) for part in (position, rotation))  # type: ignore[return-value]


def _object_pose(hypothesis: PoseHypothesis, shape: KnownShape, now: HandSnapshot) -> wire.ObjectPose:
    """Return a hypothesis as published: of the object's stated frame, in palm and base."""
    way = rotation_matrices(hypothesis.quaternion[None])[0] @ shape.frame_m
    lever = np.eye(6)
    lever[:3] = _levers(way[None])[0]
    position, covariance = hypothesis.position_m + way, lever @ hypothesis.covariance @ lever.T
    pose = wire.ObjectPose(
        weight=hypothesis.weight,
        palm_position_m=position.tolist(),
        palm_quaternion=hypothesis.quaternion.tolist(),
        palm_covariance=covariance.ravel().tolist(),
    )
    if np.isfinite(now.base_rotation).all():
        turn = np.kron(np.eye(2), now.base_rotation)
        base = Rotation.from_matrix(now.base_rotation).as_quat()
        pose["base_position_m"] = (now.base_rotation @ position + now.base_m).tolist()
        pose["base_quaternion"] = multiply(base, hypothesis.quaternion).tolist()
        pose["base_covariance"] = (turn @ covariance @ turn.T).ravel().tolist()
    return pose
