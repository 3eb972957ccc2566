"""Percept `object`: pose of a known object in each hand, from all its contacts and its untouched pads.

Twenty times a second the touched points and the surfaces of the pads go to a `PoseSampler`. A contact that
sticks carries the object with its link: that motion is applied to samples and earlier points. A point is
remembered while the object is, less certain with every motion since.

Public name: `ObjectEstimator`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch import wire
from handtouch.config.objects import ObjectTable
from handtouch.percept.object_pose import (
    MAX_CONTACT_COST,
    MAX_OUTLIERS,
    PoseEvidence,
    PoseHypothesis,
    PoseSampler,
)
from handtouch.percept.object_shapes import KnownShape, build_shape
from handtouch.percept.samples import (
    ContactBuffer,
    ContactSamples,
    HandSnapshot,
    PerceptEstimate,
    PerceptEstimator,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

# Constants without an origin beside them were chosen on grasps of the tuning family;
# docs/benchmarks/object.md measures what they yield on others.
_SKIN_STD_M, _NORMAL_STD_RAD = 0.8e-3, 0.15  # of a touched point, on top of its covariance
_CLEAR_STD_M, _TOUCHED_STD_M = 1.0e-3, 1.2e-3  # penetration of the model by a pad's surface
_MIN_POINT_DISTANCE_M, _MIN_NORMAL_CHANGE = 3e-3, 0.15  # from one remembered point of a pad to its next
_MAX_POINTS = 30
_MAX_POINT_STD_M = 4e-3
"""A remembered point less certain than this is dropped."""
_MEMORY_NS = 5_000_000_000  # without touch, before another object is assumed
_MAX_SAMPLE_AGE_NS = 100_000_000
_STICKING_STD_M, _STICKING_SHARE = 0.05e-3, 0.15  # of a sticking contact's displacement: fixed, and its share
_SLIDING_STD_M = 5e-3
_REST_STD_M, _REST_STD_RAD = 3e-3, 0.1  # of the object's motion in one period, where no contact shows it
MIN_WEIGHT = 0.7
MAX_POSITION_STD_M, MAX_ROTATION_STD_RAD = 8e-3, math.radians(20)
"""A pose is `estimated` within these; the greatest standard deviation of any direction counts."""
_MIN_EFFECTIVE_SAMPLES = 5.0
_MIN_PADS_OF_SPHERE, _MIN_PADS = 1, 3
"""A pad gives three equations; two leave none over that would show a wrong pose of six unknowns."""
_log = logging.getLogger("handtouch.percept")


@dataclass
class _Point:
    """A touched point of the object, in the palm."""

    pad: int
    contact_id: int
    point_m: FloatArray
    normal: FloatArray
    variance_m2: float  # along the normal
    moved_m2: float = 0.0  # variance of the object's motion since
    turned_rad2: float = 0.0


class _TrackedObject:
    """The object in one hand: its samples, and the points that were touched."""

    def __init__(self, text: str, hand: int) -> None:
        self.text, self.hand = text, hand
        self.name, self.problem = "", ""
        self.shape: KnownShape | None = None
        self.sampler: PoseSampler | None = None
        self.points: list[_Point] = []
        self.last_touch_ns = 0
        self._before: HandSnapshot | None = None
        if text:
            self._set_object(text)

    def _set_object(self, text: str) -> None:
        self.name, _, table = text.partition("=")
        try:
            self.shape = build_shape(ObjectTable.model_validate_json(table))
        except (OSError, ValueError) as error:
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
        self._before = now
        if not len(touched):
            return self._undetermined(now, "nothing touches the object")
        self.last_touch_ns = now.t_ns
        self._remember(buffer, touched)
        evidence = self._evidence(now, touched, free_m)
        self.sampler.update(evidence)
        if self._is_another_place(evidence, touched):
            self.points = [point for point in self.points if not _is_earlier(point, touched)]
            self.sampler.forget()
            evidence = self._evidence(now, touched, free_m)
            self.sampler.update(evidence)
        return self._estimate(now, len(touched), len(evidence.free_m))

    # Details ----------------------------------------------------------------------------------------------

    def _follow_motion(self, now: HandSnapshot) -> None:
        """Move samples and points with the contacts that stick, since the last snapshot."""
        before, points = self._before, self.points
        if before is None or not points or self.sampler is None:
            return
        held = [p for p in points if now.contact_id[p.pad - now.first] == p.contact_id != 0]
        centre = np.mean([p.point_m for p in (held or points)], axis=0)
        # where one contact slides, others that seem to stick may slide unnoticed: the object is rigid
        sliding = max((float(now.slip_probability[p.pad - now.first]) for p in held), default=0.0)
        information = np.diag([_REST_STD_M**-2] * 3 + [_REST_STD_RAD**-2] * 3)
        slope = np.zeros(6)
        for point in held:
            row = point.pad - now.first
            turn = now.rotation[row] @ before.rotation[row].T
            shift = turn @ (point.point_m - before.origin_m[row]) + now.origin_m[row] - point.point_m
            if not np.isfinite(shift).all():
                continue
            std_m = _STICKING_STD_M + _STICKING_SHARE * np.linalg.norm(shift) + sliding * _SLIDING_STD_M
            jacobian = np.hstack([np.eye(3), -_cross_matrix(point.point_m - centre)])
            information += jacobian.T @ jacobian / std_m**2
            slope += jacobian.T @ shift / std_m**2
        covariance = np.linalg.inv(information)
        twist = covariance @ slope
        rotation = Rotation.from_rotvec(twist[3:]).as_matrix()
        translation = centre + twist[:3] - rotation @ centre
        self.sampler.move(rotation, translation)
        # at rest nothing is added; where a contact slides, the object may have moved by as much as is allowed
        moving = np.linalg.norm(twist[:3]) / _REST_STD_M + np.linalg.norm(twist[3:]) / _REST_STD_RAD
        share = min(max(float(moving), sliding), 1.0)
        for point in points:
            point.point_m = rotation @ point.point_m + translation
            point.normal = rotation @ point.normal
            lever = np.hstack([np.eye(3), -_cross_matrix(point.point_m - centre)])
            point.moved_m2 += share * float(point.normal @ lever @ covariance @ lever.T @ point.normal)
            point.turned_rad2 += share * float(np.trace(covariance[3:, 3:])) / 3
        self.points = [p for p in points if p.moved_m2 < _MAX_POINT_STD_M**2]

    def _remember(self, buffer: ContactBuffer, touched: IntArray) -> None:
        """Replace the last point of each touched pad, or add one where the contact is elsewhere."""
        position = buffer.latest_field(touched, "palm_position_m")
        normal = buffer.latest_field(touched, "palm_normal")
        covariance = buffer.latest_field(touched, "palm_covariance_m2")
        for k, pad in enumerate(touched.tolist()):
            variance = float(normal[k] @ covariance[k] @ normal[k])
            new = _Point(pad, int(buffer.contact_id[pad]), position[k], normal[k], variance)
            last = next((p for p in reversed(self.points) if p.pad == pad), None)
            if last is not None and _is_same_place(last, new):
                self.points.remove(last)
            elif last is not None:
                last.contact_id = 0  # the contact is elsewhere by now
            self.points.append(new)
        del self.points[:-_MAX_POINTS]

    def _evidence(self, now: HandSnapshot, touched: IntArray, free_m: FloatArray) -> PoseEvidence:
        points = self.points
        known = np.isfinite(now.origin_m).all(axis=1)
        is_touched = np.isin(np.arange(len(now.origin_m)) + now.first, touched)
        rows = np.flatnonzero(known & (now.clear | is_touched))
        placed = free_m[rows] @ now.rotation[rows].transpose(0, 2, 1) + now.origin_m[rows][:, None]
        moved = np.array([p.variance_m2 + p.moved_m2 for p in points])
        turned = np.array([p.turned_rad2 for p in points])
        return PoseEvidence(
            np.array([p.point_m for p in points]),
            np.array([p.normal for p in points]),
            np.sqrt(moved + _SKIN_STD_M**2),
            np.sqrt(turned + _NORMAL_STD_RAD**2),
            placed,
            np.where(is_touched[rows], _TOUCHED_STD_M, _CLEAR_STD_M),
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
        if pads < (_MIN_PADS_OF_SPHERE if self.shape.free_axes == 3 else _MIN_PADS):
            return "undetermined", f"touched by {pads} of the {_MIN_PADS} pads that it needs"
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
    """Estimates the pose of the known object in each hand; free_m: (n, f, 3), points over the surface of
    every pad, in its link's frame."""

    kind = "object"

    def __init__(self, free_m: FloatArray) -> None:
        super().__init__(len(free_m))
        self._free_m = free_m
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
            tracked = self._objects[snapshot.hand] = _TrackedObject(snapshot.known_object, snapshot.hand)
        return [tracked.update(buffer, snapshot, self._free_m[rows])]


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


def _cross_matrix(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _greatest_stds(
    hypothesis: PoseHypothesis, shape: KnownShape, pose: wire.ObjectPose
) -> tuple[float, float]:
    """Return the greatest standard deviations of position and rotation over directions, free ones aside."""
    position = np.array(pose["palm_covariance"]).reshape(6, 6)[:3, :3]
    rotation = hypothesis.covariance[3:, 3:]
    if shape.free_axes == 3:
        rotation = np.zeros((3, 3))
    elif shape.free_axes == 1:
        axis = Rotation.from_quat(hypothesis.quaternion).apply([0.0, 0.0, 1.0])
        across = np.eye(3) - np.outer(axis, axis)
        rotation = across @ rotation @ across
    return tuple(math.sqrt(max(float(np.linalg.eigvalsh(part)[-1]), 0.0)) for part in (position, rotation))  # type: ignore[return-value]


def _object_pose(hypothesis: PoseHypothesis, shape: KnownShape, now: HandSnapshot) -> wire.ObjectPose:
    """Return a hypothesis as published: of the object's stated frame, in palm and base."""
    rotation = Rotation.from_quat(hypothesis.quaternion)
    way = rotation.apply(shape.frame_m)
    lever = np.eye(6)
    lever[:3, 3:] = -_cross_matrix(way)
    position, covariance = hypothesis.position_m + way, lever @ hypothesis.covariance @ lever.T
    pose = wire.ObjectPose(
        weight=hypothesis.weight,
        palm_position_m=position.tolist(),
        palm_quaternion=rotation.as_quat().tolist(),
        palm_covariance=covariance.ravel().tolist(),
    )
    if np.isfinite(now.base_rotation).all():
        turn = np.kron(np.eye(2), now.base_rotation)
        pose["base_position_m"] = (now.base_rotation @ position + now.base_m).tolist()
        pose["base_quaternion"] = (Rotation.from_matrix(now.base_rotation) * rotation).as_quat().tolist()
        pose["base_covariance"] = (turn @ covariance @ turn.T).ravel().tolist()
    return pose
