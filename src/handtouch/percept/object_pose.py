"""Pose of a known object from touched points and from surfaces that nothing touches, as weighted hypotheses.

Population Monte Carlo: starts from earlier samples and from random alignments of the object with a contact
are refined by Gauss-Newton steps. Samples are drawn from the normal distributions about the refined poses,
and weighted by their likelihood over that density. So modes, their weights and flat directions follow from
one set of samples; nothing is multiplied over time.

A perturbation of a pose is (translation, rotation) (6,), in the frame of the evidence, about the object's
centre. Public names: `PoseEvidence`, `Poses`, `PoseHypothesis`,
`PoseSampler`, `MAX_CONTACT_COST`, `MAX_OUTLIERS`, `FREE_ROTATION_RAD2`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from handtouch.percept.object_shapes import KnownShape

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

FREE_ROTATION_RAD2 = math.pi**2 / 3
"""Variance of an angle of which nothing is known."""
_OFFSET_M = 3e-3
"""Contacts are compared this far outside the object, where the gradient at an edge is any normal that a body
touching the edge may have."""
MAX_CONTACT_COST, _MAX_PAD_COST = 9.0, 9.0
"""Cost, in -ln of the likelihood, beyond which a contact or an untouched pad counts as an outlier."""
_KERNEL_M, _KERNEL_RAD = 10e-3, 0.5
"""Standard deviations of a proposal along directions that the evidence leaves open, at most:
where few samples are worth anything, they are narrowed."""
_MIN_KERNEL, _NARROWER, _WIDER_AGAIN = 0.1, 0.6, 1.2
_FEW_SAMPLES, _MANY_SAMPLES = 20, 60
_STEP_M, _STEP_RAD = 2e-4, 5e-3
_MAX_STEP_M, _MAX_STEP_RAD = 10e-3, 0.5
_FIRST_STARTS, _FIRST_ITERATIONS = 48, 5
_KEPT_STARTS, _TURNED_STARTS, _NEW_STARTS, _ITERATIONS = 10, 3, 5, 2
_SAMPLES = 192
MAX_OUTLIERS = 0.5
"""Share of outliers beyond which a pose explains nothing."""
_ALIGNMENTS = 256
_ALIGNMENT_TEMPERATURE = 4.0
_WIDER = 1.2  # proposals over their normal approximation, so that tails are covered
_MERGED_DISTANCE2 = 12.0
"""Squared Mahalanobis distance of proposals up to which they are one hypothesis."""
_PINNED = 1e8  # information about a rotation that changes nothing
_MAX_LOG_GAP = 15.0
_MIN_WEIGHT = 0.02
_MIN_SHARE = 1e-3
_OPPOSITE = 1e-6  # sine of the angle between axes that count as opposite
_MIN_SCATTER = 10


class PoseEvidence(NamedTuple):
    """Touched points (c,) and points of untouched pads (p, f), in one frame."""

    point_m: FloatArray
    """(c, 3)"""
    normal: FloatArray
    """(c, 3), unit vectors from the pad into the object"""
    point_std_m: FloatArray
    """(c,), along the normal"""
    normal_std_rad: FloatArray
    """(c,)"""
    free_m: FloatArray
    """(p, f, 3), points of the surfaces of pads, which the object doesn't penetrate"""
    free_std_m: FloatArray
    """(p,), how far it may nevertheless"""


class Poses(NamedTuple):
    """k poses of an object's centre."""

    position_m: FloatArray
    """(k, 3)"""
    quaternion: FloatArray
    """(k, 4): x, y, z, w"""

    def take(self, rows: IntArray | NDArray[np.bool_]) -> Poses:
        """Return some of the poses."""
        return Poses(self.position_m[rows], self.quaternion[rows])

    def perturbed(self, changes: FloatArray) -> Poses:
        """Return the poses after changes (k, 6)."""
        return Poses(
            self.position_m + changes[:, :3], multiply(_quaternions(changes[:, 3:]), self.quaternion)
        )

    def moved(self, rotation: FloatArray, translation_m: FloatArray) -> Poses:
        """Return the poses after a rigid motion of everything, by a matrix (3, 3) and a vector (3,)."""
        turn = Rotation.from_matrix(rotation).as_quat()
        return Poses(self.position_m @ rotation.T + translation_m, multiply(turn, self.quaternion))

    @property
    def matrices(self) -> FloatArray:
        """(k, 3, 3)"""
        return _matrices(self.quaternion)


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """One possible pose of the object's centre."""

    weight: float
    position_m: FloatArray
    quaternion: FloatArray
    covariance: FloatArray
    """(6, 6) of a perturbation; `FREE_ROTATION_RAD2` about axes on which nothing depends"""


class _Proposals(NamedTuple):
    poses: Poses
    covariance: FloatArray  # (k, 6, 6)
    log_likelihood: FloatArray  # (k,)


class PoseSampler:
    """Samples of an object's pose; `update` replaces them by those that new evidence allows.

    `poses` and `weights` (s,) are the samples, `effective_samples` how many equal ones they are worth.
    """

    def __init__(self, shape: KnownShape, seed: int = 0) -> None:
        self.shape = shape
        self._rng = np.random.default_rng(seed)
        self._feet, self._normals = shape.surface_points(self._rng)
        self.poses = Poses(np.zeros((0, 3)), np.zeros((0, 4)))
        self.weights = self._hypothesis_weight = np.zeros(0)
        self.hypotheses: list[PoseHypothesis] = []
        self.effective_samples = 0.0
        self._kernel = 1.0
        self.outliers = 0.0
        """share of the touched points that contradict the likeliest sample"""

    def forget(self) -> None:
        """Discard the samples."""
        self.poses, self.weights = self.poses.take(np.zeros(0, np.intp)), np.zeros(0)
        self.hypotheses, self.effective_samples, self.outliers, self._kernel = [], 0.0, 0.0, 1.0

    def move(self, rotation: FloatArray, translation_m: FloatArray) -> None:
        """Move the samples with the object."""
        self.poses = self.poses.moved(rotation, translation_m)

    def update(self, evidence: PoseEvidence) -> None:
        """Draw new samples, given at least one contact."""
        evidence = self._near(evidence)
        proposals = self._refine(self._start_poses(evidence), evidence)
        poses, component_density = self._draw(proposals)
        log_weights = self.log_likelihood(poses, evidence) - component_density.max_plus_sum
        weights = np.exp(log_weights - log_weights.max())
        self.poses, self.weights = poses, weights / weights.sum()
        self.effective_samples = float(1 / np.square(self.weights).sum())
        if self.effective_samples < _FEW_SAMPLES:
            self._kernel = max(self._kernel * _NARROWER, _MIN_KERNEL)
        elif self.effective_samples > _MANY_SAMPLES:
            self._kernel = min(self._kernel * _WIDER_AGAIN, 1.0)
        best = self.poses.take(np.array([int(self.weights.argmax())]))
        self.outliers = float(np.mean(self._contact_costs(best, evidence) > MAX_CONTACT_COST))
        self.hypotheses = self._merge(proposals, component_density.responsible)

    def log_likelihood(self, poses: Poses, evidence: PoseEvidence) -> FloatArray:
        """Return ln of the likelihood (k,) of the evidence, but for a constant."""
        cost = _capped(self._contact_costs(poses, evidence), MAX_CONTACT_COST).sum(axis=1)
        if len(evidence.free_m):
            depth = self._pad_depths(poses, evidence)
            cost += _capped(0.5 * depth**2, _MAX_PAD_COST).sum(axis=1)
        return np.asarray(-cost)

    def contact_costs(self, hypothesis: PoseHypothesis, evidence: PoseEvidence) -> FloatArray:
        """Return the cost (c,) of each contact at a hypothesis, in -ln of the likelihood."""
        pose = Poses(hypothesis.position_m[None], hypothesis.quaternion[None])
        return np.asarray(self._contact_costs(pose, evidence)[0])

    # Details ----------------------------------------------------------------------------------------------

    @property
    def _kernel_information(self) -> FloatArray:
        return np.array([_KERNEL_M] * 3 + [_KERNEL_RAD] * 3) ** -2 / self._kernel**2

    @property
    def _is_lost(self) -> bool:
        """There are no samples that fit."""
        return not len(self.weights) or self.outliers > MAX_OUTLIERS

    def _start_poses(self, evidence: PoseEvidence) -> Poses:
        """Return poses to refine: some of the samples, also turned about, and alignments with a contact."""
        if self._is_lost:
            return self._alignments(evidence, _FIRST_STARTS)
        # by the square root of a hypothesis' weight, so that unlikely ones aren't lost by chance
        shares = self.weights / np.sqrt(self._hypothesis_weight)
        kept = self.poses.take(self._choose(shares / shares.sum(), _KEPT_STARTS))
        turned = kept.take(self._rng.permutation(_KEPT_STARTS)[:_TURNED_STARTS])
        half_turns = np.eye(4)[self._rng.integers(3, size=_TURNED_STARTS)]
        turned = turned._replace(quaternion=multiply(turned.quaternion, half_turns))
        new = self._alignments(evidence, _NEW_STARTS)
        return Poses(*(np.concatenate(parts) for parts in zip(kept, turned, new, strict=True)))

    def _choose(self, shares: FloatArray, count: int) -> IntArray:
        """Return rows in proportion to shares, by systematic sampling."""
        steps = (np.arange(count) + self._rng.random()) / count
        return np.minimum(np.searchsorted(np.cumsum(shares), steps), len(shares) - 1)

    def _alignments(self, evidence: PoseEvidence, count: int) -> Poses:
        rng, n = self._rng, _ALIGNMENTS
        contact, foot = rng.integers(len(evidence.point_m), size=n), rng.integers(len(self._feet), size=n)
        turn = _turns_between(self._normals[foot], -evidence.normal[contact])
        roll = _quaternions(rng.uniform(-np.pi, np.pi, (n, 1)) * evidence.normal[contact])
        rotation = multiply(roll, turn)
        way = np.einsum("nij,nj->ni", _matrices(rotation), self._feet[foot])
        poses = Poses(evidence.point_m[contact] - way, rotation)
        fit = -_capped(self._contact_costs(poses, evidence), MAX_CONTACT_COST).sum(axis=1)
        chosen = np.argsort(fit / _ALIGNMENT_TEMPERATURE + rng.gumbel(size=n))[-count:]
        return poses.take(chosen)

    def _refine(self, poses: Poses, evidence: PoseEvidence) -> _Proposals:
        information = np.zeros((len(poses.position_m), 6, 6))
        iterations = _FIRST_ITERATIONS if self._is_lost else _ITERATIONS
        for iteration in range(iterations + 1):
            slope, information = self._normal_equations(poses, evidence)
            if iteration < iterations:
                change: FloatArray = np.asarray(-np.linalg.solve(information, slope[..., None])[..., 0])
                poses = poses.perturbed(_limited(change))
        covariance: FloatArray = np.asarray(np.linalg.inv(information))
        found = _Proposals(poses, covariance, self.log_likelihood(poses, evidence))
        score = found.log_likelihood + 0.5 * np.linalg.slogdet(covariance)[1]
        kept = score > score.max() - _MAX_LOG_GAP
        return _Proposals(poses.take(kept), covariance[kept], found.log_likelihood[kept])

    def _normal_equations(self, poses: Poses, evidence: PoseEvidence) -> tuple[FloatArray, FloatArray]:
        """Return the gradient (k, 6) of the cost and its information (k, 6, 6), with that of the kernel."""
        k, c = len(poses.position_m), len(evidence.point_m)
        steps = np.diag([_STEP_M] * 3 + [_STEP_RAD] * 3)
        changed = np.concatenate([np.zeros((1, 6)), steps])
        repeated = Poses(*(np.repeat(part, 7, axis=0) for part in poses)).perturbed(np.tile(changed, (k, 1)))
        residual = self._contact_residuals(repeated, evidence).reshape(k, 7, c, 4)
        here = residual[:, 0]
        weight = 1 / (1 + 0.5 * np.square(here).sum(axis=2) / MAX_CONTACT_COST)
        jacobian = (residual[:, 1:] - residual[:, :1]) / np.diag(steps)[:, None, None]  # (k, 6, c, 4)
        weighted = (jacobian * weight[:, None, :, None]).reshape(k, 6, -1)
        slope = np.einsum("kin,kn->ki", weighted, here.reshape(k, -1))
        information = weighted @ jacobian.reshape(k, 6, -1).transpose(0, 2, 1)
        self._add_pads(poses, evidence, slope, information)
        information[:, range(6), range(6)] += self._kernel_information
        information[:, 3:, 3:] += _PINNED * self._free_projector(poses)
        return slope, information

    def _add_pads(
        self, poses: Poses, evidence: PoseEvidence, slope: FloatArray, information: FloatArray
    ) -> None:
        if not len(evidence.free_m):
            return
        depth, deepest = self._pad_depths_at(poses, evidence)
        rotations = poses.matrices
        way = deepest - poses.position_m[:, None]  # (k, p, 3)
        normal = self.shape.distance_and_normal(way @ rotations)[1] @ rotations.transpose(0, 2, 1)
        jacobian = -np.concatenate([normal, np.cross(way, normal)], axis=2) / evidence.free_std_m[:, None]
        weight = (depth < 0) / (1 + 0.5 * depth**2 / _MAX_PAD_COST)
        weighted = jacobian * weight[..., None]
        slope += np.einsum("kpi,kp->ki", weighted, depth)
        information += weighted.transpose(0, 2, 1) @ jacobian

    def _draw(self, proposals: _Proposals) -> tuple[Poses, _Density]:
        k = len(proposals.log_likelihood)
        score = proposals.log_likelihood + 0.5 * np.linalg.slogdet(proposals.covariance)[1]
        share = np.exp(score - score.max())
        share = 0.5 * share / share.sum() + 0.5 / k
        owner = self._choose(share, _SAMPLES)
        spread = _WIDER * np.linalg.cholesky(proposals.covariance)
        noise = self._rng.normal(size=(_SAMPLES, 6))
        poses = proposals.poses.take(owner).perturbed(np.einsum("sij,sj->si", spread[owner], noise))
        apart = self._differences(poses, proposals.poses)  # (s, k, 6)
        whitened = np.einsum("kij,skj->ski", np.linalg.inv(spread), apart)
        log_scale = np.log(np.diagonal(spread, axis1=1, axis2=2)).sum(axis=1)
        density = np.log(share) - log_scale - 0.5 * np.square(whitened).sum(axis=2)
        most = density.max(axis=1)
        total = most + np.log(np.exp(density - most[:, None]).sum(axis=1))
        return poses, _Density(total, density.argmax(axis=1))

    def _merge(self, proposals: _Proposals, responsible: IntArray) -> list[PoseHypothesis]:
        apart = self._differences(proposals.poses, proposals.poses)
        both = proposals.covariance[:, None] + proposals.covariance[None]
        near = np.einsum("ski,ski->sk", apart, np.linalg.solve(both, apart[..., None])[..., 0])
        _, cluster = connected_components(near < _MERGED_DISTANCE2, directed=False)
        of_sample = cluster[responsible]
        shares: FloatArray = np.asarray(np.bincount(of_sample, self.weights)[of_sample] + _MIN_SHARE)
        self._hypothesis_weight = shares
        found = []
        for number in np.unique(of_sample):
            rows = np.flatnonzero(of_sample == number)
            weight = float(self.weights[rows].sum())
            if weight >= _MIN_WEIGHT:
                best = rows[self.weights[rows].argmax()]
                found.append(self._summarise(rows, weight, proposals.covariance[responsible[best]]))
        return sorted(found, key=lambda hypothesis: -hypothesis.weight)

    def _summarise(self, rows: IntArray, weight: float, kernel: FloatArray) -> PoseHypothesis:
        """Return mean and covariance of some samples; few effective ones are widened by the proposal's."""
        share = self.weights[rows] / weight
        best = self.poses.take(rows[[share.argmax()]])
        apart = self._differences(self.poses.take(rows), best)[:, 0]
        mean = share @ apart
        scatter = apart - mean
        effective = 1 / np.square(share).sum()
        covariance = (share[:, None] * scatter).T @ scatter + kernel / max(effective / _MIN_SCATTER, 1.0)
        pose = best.perturbed(mean[None])
        covariance[3:, 3:] += FREE_ROTATION_RAD2 * self._free_projector(pose)[0]
        return PoseHypothesis(weight, pose.position_m[0], pose.quaternion[0], covariance)

    def _contact_residuals(self, poses: Poses, evidence: PoseEvidence) -> FloatArray:
        """Return residuals (k, c, 4) of distance and normal, in standard deviations."""
        rotations = poses.matrices
        outside = evidence.point_m - _OFFSET_M * evidence.normal
        local = (outside - poses.position_m[:, None]) @ rotations
        distance, normal = self.shape.distance_and_normal(local)
        found = np.empty((*distance.shape, 4))
        found[..., 0] = (distance - _OFFSET_M) / evidence.point_std_m
        found[..., 1:] = (normal @ rotations.transpose(0, 2, 1) + evidence.normal) / evidence.normal_std_rad[
            :, None
        ]
        return found

    def _contact_costs(self, poses: Poses, evidence: PoseEvidence) -> FloatArray:
        return np.asarray(0.5 * np.square(self._contact_residuals(poses, evidence)).sum(axis=2))

    def _pad_depths(self, poses: Poses, evidence: PoseEvidence) -> FloatArray:
        """Return the deepest distance (k, p) of each pad, in standard deviations, 0 outside the object."""
        return self._pad_depths_at(poses, evidence)[0]

    def _pad_depths_at(self, poses: Poses, evidence: PoseEvidence) -> tuple[FloatArray, FloatArray]:
        """Return depths as `_pad_depths`, and the deepest points (k, p, 3)."""
        middle = evidence.free_m.mean(axis=1)
        reach = np.linalg.norm(evidence.free_m - middle[:, None], axis=2).max(axis=1)
        rotations = poses.matrices
        distance = self.shape.distance((middle - poses.position_m[:, None]) @ rotations)
        pose, pad = np.nonzero(distance < reach)  # no point of another pad is inside the object
        way = evidence.free_m[pad] - poses.position_m[pose, None]
        of_points = self.shape.distance(way @ rotations[pose])
        at = of_points.argmin(axis=1)
        depth, deepest = np.zeros(distance.shape), np.broadcast_to(middle, (*distance.shape, 3)).copy()
        depth[pose, pad] = np.minimum(of_points[np.arange(len(at)), at] / evidence.free_std_m[pad], 0.0)
        deepest[pose, pad] = evidence.free_m[pad, at]
        return depth, deepest

    def _near(self, evidence: PoseEvidence) -> PoseEvidence:
        """Return the evidence without pads that the object can't reach from any contact."""
        if not len(evidence.free_m):
            return evidence
        way = evidence.free_m[:, :, None] - evidence.point_m
        near = np.linalg.norm(way, axis=3).min(axis=(1, 2)) < 2 * self.shape.radius_m
        return evidence._replace(free_m=evidence.free_m[near], free_std_m=evidence.free_std_m[near])

    def _free_projector(self, poses: Poses) -> FloatArray:
        """Return projectors (k, 3, 3) to the rotations that change nothing."""
        if self.shape.free_axes == 1:
            axis = poses.matrices[:, :, 2]
            return axis[:, :, None] * axis[:, None]
        return np.broadcast_to(np.eye(3) * (self.shape.free_axes == 3), (len(poses.position_m), 3, 3))

    def _differences(self, poses: Poses, others: Poses) -> FloatArray:
        """Return the smallest perturbations (s, k, 6) that carry others (k,) to poses (s,)."""
        found = np.zeros((len(poses.position_m), len(others.position_m), 6))
        found[..., :3] = poses.position_m[:, None] - others.position_m
        if self.shape.free_axes == 1:
            found[..., 3:] = self._axis_differences(poses, others)
        elif self.shape.free_axes == 0:
            found[..., 3:] = self._rotation_differences(poses, others)
        return found

    def _axis_differences(self, poses: Poses, others: Poses) -> FloatArray:
        axes, of_others = poses.matrices[:, :, 2], others.matrices[:, :, 2]
        cosine = axes @ of_others.T
        flipped = np.where((cosine < 0) & (len(self.shape.symmetries) > 1), -1.0, 1.0)
        cross = flipped[..., None] * np.cross(of_others[None], axes[:, None])
        sine = np.linalg.norm(cross, axis=2)
        angle = np.arctan2(sine, flipped * cosine)
        opposite = (sine < _OPPOSITE) & (angle > 1.0)  # turned by pi about any axis across
        across = np.linalg.svd(of_others[:, None])[2][:, 1]
        cross[opposite] = np.broadcast_to(across, cross.shape)[opposite]
        sine[opposite] = 1.0
        return np.asarray(cross * (angle / np.maximum(sine, 1e-12))[..., None])

    def _rotation_differences(self, poses: Poses, others: Poses) -> FloatArray:
        k, symmetries = len(others.quaternion), self.shape.symmetries
        same = multiply(others.quaternion[:, None], symmetries)  # (k, g, 4)
        cosine = (poses.quaternion @ same.reshape(-1, 4).T).reshape(-1, k, len(symmetries))
        nearest = np.abs(cosine).argmax(axis=2)
        back = same[np.arange(k), nearest] * [-1.0, -1.0, -1.0, 1.0]  # (s, k, 4)
        best = multiply(poses.quaternion[:, None], back)
        best *= np.where(best[..., 3:] < 0, -1.0, 1.0)
        sine = np.linalg.norm(best[..., :3], axis=2)
        angle = 2 * np.arctan2(sine, best[..., 3])
        return np.asarray(best[..., :3] * (angle / np.maximum(sine, 1e-12))[..., None])


class _Density(NamedTuple):
    max_plus_sum: FloatArray  # (s,), ln of the proposals' density at each sample
    responsible: IntArray  # (s,), the proposal with the largest part of it


def _capped(cost: FloatArray, limit: float) -> FloatArray:
    """Return -ln of exp(-cost) with a floor of exp(-limit)."""
    return np.asarray(-np.logaddexp(-cost, -limit))


def _limited(change: FloatArray) -> FloatArray:
    """Return changes (k, 6) shortened to the longest step."""
    shift = np.linalg.norm(change[:, :3], axis=1) / _MAX_STEP_M
    turn = np.linalg.norm(change[:, 3:], axis=1) / _MAX_STEP_RAD
    return np.asarray(change / np.maximum(np.maximum(shift, turn), 1.0)[:, None])


def _turns_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) that turn unit vectors (n, 3) into others."""
    found = np.concatenate([np.cross(start, end), 1 + np.einsum("ni,ni->n", start, end)[:, None]], axis=1)
    opposite = found[:, 3] < 1e-9
    beside = np.eye(3)[np.abs(start[opposite]).argmin(axis=1)]
    found[opposite, :3], found[opposite, 3] = np.cross(start[opposite], beside), 0.0
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


# Quaternions x, y, z, w; scipy's cost more than the rest where there are few


def multiply(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return products (..., 4) of quaternions: the turn `other`, then `one`."""
    a, b, c, d = (one[..., i] for i in range(4))
    x, y, z, w = (other[..., i] for i in range(4))
    product = (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )
    return np.stack(product, axis=-1)


def _quaternions(turns: FloatArray) -> FloatArray:
    """Return the quaternions (k, 4) of rotation vectors (k, 3)."""
    angle = np.sqrt(np.einsum("ki,ki->k", turns, turns))[:, None]
    return np.concatenate([0.5 * np.sinc(angle / (2 * np.pi)) * turns, np.cos(angle / 2)], axis=1)


def _matrices(quaternion: FloatArray) -> FloatArray:
    x, y, z, w = quaternion.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.ascontiguousarray(np.array(rows).transpose(2, 0, 1))
