"""Pose of a known object from touched points and from surfaces that nothing touches, as weighted hypotheses.

Population Monte Carlo: starts from earlier samples and from random alignments of the object with a contact
are refined by Gauss-Newton steps. Samples are drawn from the normal distributions about the refined poses,
and weighted by their likelihood over that density. So modes, their weights and flat directions follow from
one set of samples; nothing is multiplied over time.

Where few samples carry the weight, it is raised to a power below 1 until `_MIN_EFFECTIVE` equal samples are
left (annealed importance sampling, R. Neal 2001): the spread is then between that of the proposals and the
posterior's, so that it isn't too small.

A perturbation of a pose is (translation, rotation) (6,), in the frame of the evidence, about the object's
centre. Public names: `PoseEvidence`, `Poses`, `PoseHypothesis`,
`PoseSampler`, `MAX_CONTACT_COST`, `MAX_OUTLIERS`, `FREE_ROTATION_RAD2`; `cross`, `multiply`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from handtouch.arrays import FloatArray, IntArray
from handtouch.hand.rotations import rotation_matrices
from handtouch.percept.object_shapes import KnownShape

FREE_ROTATION_RAD2 = math.pi**2 / 3
"""Variance of an angle of which nothing is known."""
_OFFSET_M = 3e-3
"""Contacts are compared this far outside the object, where the gradient at an edge is any normal that a body
touching the edge may have."""
MAX_CONTACT_COST, _MAX_PAD_COST = 9.0, 9.0
"""Cost, in -ln of the likelihood, beyond which a contact or an untouched pad counts as an outlier."""
_KERNEL_M, _KERNEL_RAD = 20e-3, 0.6
"""Standard deviations of a proposal along directions that the evidence leaves open, at most."""
_GROWTH = 3.0
"""Covariance of a proposal over that of its hypothesis' earlier samples, at most."""
_MIN_EFFECTIVE = 24.0
"""Equal samples that the tempered weights are worth, at least."""
_EDGE_STD_M, _EDGE_STD_RAD = 1.2e-3, 0.5
"""Standard deviations of place and normal where a pad's edge touches, beside those of its face."""
_STEP_M = 2e-4
_SHIFTS = _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3)])
_MAX_STEP_M, _MAX_STEP_RAD = 10e-3, 0.5
_FIRST_STARTS, _FIRST_ITERATIONS = 48, 5
_KEPT_STARTS, _TURNED_STARTS, _NEW_STARTS, _ITERATIONS = 8, 2, 8, 2
_SAMPLES = 128
MAX_OUTLIERS = 0.5
"""Share of outliers beyond which a pose explains nothing."""
_FIRST_ALIGNMENTS, _ALIGNMENTS = 256, 64
_ALIGNMENT_TEMPERATURE = 4.0
_FEET_PAIRS, _PAIRS = 2048, 4
_PAIR_M, _PAIR_COSINE = 4e-3, 0.2  # by which pairs of contacts and of feet may differ
_SAME_SIDE, _LITTLE_SIDE = -0.8, 1e-3
_WIDER = 1.2  # proposals over their normal approximation, so that tails are covered
_MERGED_DISTANCE2 = 12.0
"""Squared Mahalanobis distance of proposals up to which they are one hypothesis."""
_PINNED = 1e8  # information about a rotation that changes nothing
_MAX_LOG_GAP = 15.0
_MIN_WEIGHT = 0.02
_MIN_SHARE = 1e-3
_LIKELY, _CLOSE = 0.1, 3.0  # weight of a hypothesis, and distance of a pad in standard deviations
_BISECTIONS = 12
_OPPOSITE = 1e-6  # sine of the angle between axes that count as opposite
_MIN_SCATTER = 10


class PoseEvidence(NamedTuple):
    """Touched points (c,) and points of untouched pads (p, f), in one frame."""

    point_m: FloatArray
    """(c, 3)"""
    normal: FloatArray
    """(c, 3), unit vectors from the pad into the object"""
    spread_m: FloatArray
    """(c, 3, 3), L of the point's covariance L L^T: where on the pad it is"""
    point_std_m: FloatArray
    """(c,), of its distance from the surface, on top"""
    normal_std_rad: FloatArray
    """(c,)"""
    edge_share: FloatArray
    """(c,), prior probability that the pad's edge touches, with any normal"""
    free_m: FloatArray
    """(p, f, 3), points of the surfaces of pads, which the object doesn't penetrate"""
    free_std_m: FloatArray
    """(p,), how far it may nevertheless"""


@dataclass(frozen=True)
class Poses:
    """k poses of an object's centre."""

    position_m: FloatArray
    """(k, 3)"""
    quaternion: FloatArray
    """(k, 4): x, y, z, w"""

    @classmethod
    def of(cls, hypotheses: Sequence[PoseHypothesis]) -> Poses:
        """Return the poses of hypotheses."""
        return cls(
            np.array([one.position_m for one in hypotheses]), np.array([one.quaternion for one in hypotheses])
        )

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

    @cached_property
    def matrices(self) -> FloatArray:
        """(k, 3, 3)"""
        return rotation_matrices(self.quaternion)

    def in_object(self, points: FloatArray) -> FloatArray:
        """Return points (n, 3) in the frame of the object at each pose (k, n, 3)."""
        return np.asarray((points - self.position_m[:, None]) @ self.matrices)


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """One possible pose of the object's centre."""

    weight: float
    position_m: FloatArray
    quaternion: FloatArray
    covariance: FloatArray
    """(6, 6) of a perturbation; `FREE_ROTATION_RAD2` about axes on which nothing depends"""

    def moved(self, rotation: FloatArray, translation_m: FloatArray) -> PoseHypothesis:
        """Return it after a rigid motion of everything, by a matrix (3, 3) and a vector (3,)."""
        turn, both = Rotation.from_matrix(rotation).as_quat(), np.kron(np.eye(2), rotation)
        return PoseHypothesis(
            self.weight,
            rotation @ self.position_m + translation_m,
            multiply(turn, self.quaternion),
            both @ self.covariance @ both.T,
        )


class _Proposals(NamedTuple):
    poses: Poses
    covariance: FloatArray  # (k, 6, 6)
    log_likelihood: FloatArray  # (k,)


class PoseSampler:
    """Samples of an object's pose; `update` replaces them by those that new evidence allows.

    `poses` and `weights` (s,) are the samples, `effective_samples` how many equal ones the weights are worth
    before they are tempered.
    """

    def __init__(self, shape: KnownShape, seed: int = 0) -> None:
        self.shape = shape
        self._rng = np.random.default_rng(seed)
        self._feet, self._normals = shape.surface_points(self._rng)
        first, second = self._rng.integers(len(self._feet), size=(2, _FEET_PAIRS))
        self._pairs = _pair_features(
            self._feet[first], self._feet[second], self._normals[first], self._normals[second]
        )
        self.poses = Poses(np.zeros((0, 3)), np.zeros((0, 4)))
        self.weights = self._hypothesis_weight = np.zeros(0)
        self._hypothesis = np.zeros(0, np.intp)  # of each sample, -1 for none
        self.hypotheses: list[PoseHypothesis] = []
        self.effective_samples = 0.0
        self.outliers = 0.0
        """share of the touched points that contradict the likeliest sample"""

    def forget(self) -> None:
        """Discard the samples."""
        self.poses, self.weights = self.poses.take(np.zeros(0, np.intp)), np.zeros(0)
        self.hypotheses, self.effective_samples, self.outliers = [], 0.0, 0.0

    def move(self, rotation: FloatArray, translation_m: FloatArray) -> None:
        """Move samples and hypotheses with the object."""
        self.poses = self.poses.moved(rotation, translation_m)
        self.hypotheses = [h.moved(rotation, translation_m) for h in self.hypotheses]

    def update(self, evidence: PoseEvidence) -> None:
        """Draw new samples, given at least one contact."""
        evidence = self._near(evidence)
        proposals = self._refine(*self._start_poses(evidence), evidence)
        poses, component_density = self._draw(proposals)
        log_weights = self._log_weights(poses, component_density.max_plus_sum, evidence)
        weights, self.effective_samples = _tempered(log_weights)
        self.poses, self.weights = poses, weights
        best = self.poses.take(np.array([int(log_weights.argmax())]))
        self.outliers = float(np.mean(self._contact_costs(best, evidence) > MAX_CONTACT_COST))
        self.hypotheses = self._merge(proposals, component_density.responsible)

    def contact_costs(self, hypothesis: PoseHypothesis, evidence: PoseEvidence) -> FloatArray:
        """Return the cost (c,) of each contact at a hypothesis, in -ln of the likelihood."""
        return np.asarray(self._contact_costs(Poses.of([hypothesis]), evidence)[0])

    def fit(self, evidence: PoseEvidence) -> FloatArray:
        """Return how evidence lies at the likely hypotheses, in standard deviations: residuals of contacts,
        then distances of pads that are close."""
        likely = [h for h in self.hypotheses if h.weight > _LIKELY]
        poses = Poses.of(likely)
        residual = self._contact_residuals(poses, evidence, np.zeros((1, 3)))[0]
        way = poses.in_object(evidence.free_m.reshape(-1, 3))
        distance = self.shape.distance(way).reshape(len(likely), *evidence.free_m.shape[:2])
        near = np.minimum(distance / evidence.free_std_m[:, None], _CLOSE)
        return np.concatenate([residual.ravel(), near.ravel()])

    # Details ----------------------------------------------------------------------------------------------

    def _log_weights(self, poses: Poses, log_density: FloatArray, evidence: PoseEvidence) -> FloatArray:
        """Return ln of likelihood over density (s,); pads are compared only where contacts leave a chance."""
        found = -_capped(self._contact_costs(poses, evidence), MAX_CONTACT_COST).sum(axis=1) - log_density
        if not len(evidence.free_m):
            return np.asarray(found)
        compared, least = np.zeros(len(found), np.bool_), found.max() - _MAX_LOG_GAP
        while len(rows := np.flatnonzero(~compared & (found > least))):
            depth = self._pad_depths(poses.take(rows), evidence)[0]
            found[rows] -= _capped(0.5 * depth**2, _MAX_PAD_COST).sum(axis=1)
            compared[rows] = True
            least = found[compared].max() - _MAX_LOG_GAP
        return np.asarray(found)

    @property
    def _is_lost(self) -> bool:
        """There are no samples that fit."""
        return not len(self.weights) or self.outliers > MAX_OUTLIERS

    def _start_poses(self, evidence: PoseEvidence) -> tuple[Poses, FloatArray]:
        """Return poses to refine: some of the samples, also turned about, and alignments with a contact; and
        the information (k, 6, 6) of earlier samples about the first, from which proposals are narrower."""
        if self._is_lost:
            return self._alignments(evidence, _FIRST_STARTS), np.zeros((_FIRST_STARTS, 6, 6))
        # by the square root of a hypothesis' weight, so that unlikely ones aren't lost by chance
        shares = self.weights / np.sqrt(self._hypothesis_weight)
        rows = self._choose(shares / shares.sum(), _KEPT_STARTS)
        kept = self.poses.take(rows)
        turned = kept.take(self._rng.permutation(_KEPT_STARTS)[:_TURNED_STARTS])
        half_turns = np.eye(4)[self._rng.integers(3, size=_TURNED_STARTS)]
        turned = replace(turned, quaternion=multiply(turned.quaternion, half_turns))
        found = (kept, turned, self._alignments(evidence, _NEW_STARTS))
        information = np.zeros((_KEPT_STARTS + _TURNED_STARTS + _NEW_STARTS, 6, 6))
        for row, number in enumerate(self._hypothesis[rows].tolist()):
            if number >= 0:
                information[row] = np.linalg.inv(_GROWTH * self.hypotheses[number].covariance)
        return _joined(*found), information

    def _choose(self, shares: FloatArray, count: int) -> IntArray:
        """Return rows in proportion to shares, by systematic sampling."""
        steps = (np.arange(count) + self._rng.random()) / count
        return np.minimum(np.searchsorted(np.cumsum(shares), steps), len(shares) - 1)

    def _alignments(self, evidence: PoseEvidence, count: int) -> Poses:
        """Return poses that fit best of many with one or two contacts on the surface."""
        n = _FIRST_ALIGNMENTS if self._is_lost else _ALIGNMENTS
        pairs = n // 2 if len(evidence.point_m) > 1 else 0
        poses = _joined(self._pair_alignments(evidence, pairs), self._contact_alignments(evidence, n - pairs))
        fit = -_capped(self._contact_costs(poses, evidence), MAX_CONTACT_COST).sum(axis=1)
        chosen = np.argsort(fit / _ALIGNMENT_TEMPERATURE + self._rng.gumbel(size=n))[-count:]
        return poses.take(chosen)

    def _contact_alignments(self, evidence: PoseEvidence, n: int) -> Poses:
        rng = self._rng
        contact, foot = rng.integers(len(evidence.point_m), size=n), rng.integers(len(self._feet), size=n)
        turn = _turns_between(self._normals[foot], -evidence.normal[contact])
        roll = _quaternions(rng.uniform(-np.pi, np.pi, (n, 1)) * evidence.normal[contact])
        return self._placed(multiply(roll, turn), self._feet[foot], evidence.point_m[contact])

    def _pair_alignments(self, evidence: PoseEvidence, n: int) -> Poses:
        """Return poses with pairs of contacts on pairs of feet that lie and face alike (B. Drost et al.,
        Model globally, match locally, CVPR 2010)."""
        rng, c = self._rng, len(evidence.point_m)
        first = rng.integers(c, size=_PAIRS if n else 0)
        second = (first + rng.integers(1, max(c, 2), size=len(first))) % c
        pairs = _pair_features(
            evidence.point_m[first],
            evidence.point_m[second],
            -evidence.normal[first],
            -evidence.normal[second],
        )
        of_contact, of_feet = np.zeros(0, np.intp), np.zeros(0, np.intp)
        for row, features in enumerate(pairs.features):
            unlike = np.square(self._pairs.features - features).sum(axis=1)
            likely = np.argpartition(0.5 * unlike - rng.gumbel(size=len(unlike)), n // _PAIRS)[: n // _PAIRS]
            of_contact = np.append(of_contact, np.full(len(likely), row))
            of_feet = np.append(of_feet, likely)
        turn = _turns_between(self._pairs.way[of_feet], pairs.way[of_contact])
        side = _rotated(turn, self._pairs.side[of_feet])
        way, wanted = pairs.way[of_contact], pairs.side[of_contact]
        sine = np.einsum("ni,ni->n", way, cross(side, wanted))
        roll = np.arctan2(sine, np.einsum("ni,ni->n", side, wanted))
        rotation = multiply(_quaternions(roll[:, None] * way), turn)
        return self._placed(rotation, self._pairs.middle_m[of_feet], pairs.middle_m[of_contact])

    def _placed(self, rotation: FloatArray, foot_m: FloatArray, at_m: FloatArray) -> Poses:
        """Return poses with points of the object (n, 3) at others."""
        return Poses(at_m - _rotated(rotation, foot_m), rotation)

    def _refine(self, poses: Poses, earlier: FloatArray, evidence: PoseEvidence) -> _Proposals:
        for _ in range(_FIRST_ITERATIONS if self._is_lost else _ITERATIONS):
            _, slope, information = self._normal_equations(poses, evidence)
            change: FloatArray = np.asarray(-np.linalg.solve(information, slope[..., None])[..., 0])
            poses = poses.perturbed(_limited(change))
        log_likelihood, _, information = self._normal_equations(poses, evidence)
        information += earlier
        covariance: FloatArray = np.asarray(np.linalg.inv(information))
        score = log_likelihood - 0.5 * np.linalg.slogdet(information)[1]
        kept = score > score.max() - _MAX_LOG_GAP
        return _Proposals(poses.take(kept), covariance[kept], log_likelihood[kept])

    def _normal_equations(
        self, poses: Poses, evidence: PoseEvidence
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return ln of the likelihood (k,), but for a constant; the gradient (k, 6) of the cost and its
        information (k, 6, 6), with that of the kernel.

        Derivatives are by a perturbation (t, w) in the object's frame: a point q there moves by -t - w x q,
        and a contact's normal m by -w x m.
        """
        k, c = len(poses.position_m), len(evidence.point_m)
        residual, std_m, compared = self._contact_residuals(poses, evidence, _SHIFTS)
        rows = np.empty((k, c, 4, 3))  # by a point's place: of the distance, and of the normal's components
        rows[:, :, 0] = compared.normals[0] / std_m[..., None]
        bend = (compared.normals[1:] - compared.normals[0]) / _STEP_M  # (3, k, c, 3)
        rows[:, :, 1:] = bend.transpose(1, 2, 3, 0) / evidence.normal_std_rad[:, None, None]
        jacobian = np.empty((k, c, 4, 6))
        jacobian[..., :3] = -rows
        jacobian[..., 3:] = cross(rows, compared.way[:, :, None])
        m = compared.contact_normal / evidence.normal_std_rad[:, None]
        jacobian[..., 1:, 3:] += cross(np.eye(3), m[:, :, None])
        cost, share = self._costs(residual, std_m, evidence)
        weight = share / (1 + np.maximum(cost, 0.0) / MAX_CONTACT_COST)[..., None]
        flat = jacobian.reshape(k, -1, 6)
        weighted = (jacobian * weight[..., None]).reshape(k, -1, 6).transpose(0, 2, 1)
        slope, information = (weighted @ residual.reshape(k, -1, 1))[..., 0], weighted @ flat
        total = _capped(cost, MAX_CONTACT_COST).sum(axis=1)
        total += self._add_pads(poses, evidence, slope, information)
        information[:, range(6), range(6)] += np.repeat([_KERNEL_M**-2, _KERNEL_RAD**-2], 3)
        free = {0: [], 1: [5], 3: [3, 4, 5]}[self.shape.free_axes]
        information[:, free, free] += _PINNED
        turn = np.zeros((k, 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = poses.matrices
        return -total, (turn @ slope[..., None])[..., 0], turn @ information @ turn.transpose(0, 2, 1)

    def _add_pads(
        self, poses: Poses, evidence: PoseEvidence, slope: FloatArray, information: FloatArray
    ) -> FloatArray:
        """Add what the pads contribute, in the object's frame; return their cost (k,)."""
        if not len(evidence.free_m):
            return np.zeros(len(slope))
        depth, deepest = self._pad_depths(poses, evidence)
        pose, pad = np.nonzero(depth < 0)
        way = deepest[pose, pad]
        normal = self.shape.distance_and_normal(way)[1] / evidence.free_std_m[pad, None]
        jacobian = np.concatenate([-normal, cross(normal, way)], axis=1)
        inside = depth[pose, pad]
        weighted = jacobian / (1 + 0.5 * inside**2 / _MAX_PAD_COST)[:, None]
        np.add.at(slope, pose, weighted * inside[:, None])
        np.add.at(information, pose, weighted[:, :, None] * jacobian[:, None])
        return np.asarray(_capped(0.5 * depth**2, _MAX_PAD_COST).sum(axis=1))

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
        weights = np.bincount(of_sample, self.weights)
        found: list[PoseHypothesis] = []
        self._hypothesis = np.full(len(of_sample), -1)
        for number in np.argsort(-weights)[: np.count_nonzero(weights >= _MIN_WEIGHT)].tolist():
            rows = np.flatnonzero(of_sample == number)
            best = rows[self.weights[rows].argmax()]
            self._hypothesis[rows] = len(found)
            found.append(
                self._summarise(rows, float(weights[number]), proposals.covariance[responsible[best]])
            )
        return found

    def _summarise(self, rows: IntArray, weight: float, kernel: FloatArray) -> PoseHypothesis:
        """Return mean and covariance of some samples; few effective ones are widened by the proposal's."""
        share = self.weights[rows] / weight
        best = self.poses.take(rows[[share.argmax()]])
        apart = self._differences(self.poses.take(rows), best)[:, 0]
        mean = share @ apart
        scatter = apart - mean
        effective = 1 / np.square(share).sum()
        covariance = (share[:, None] * scatter).T @ scatter + kernel / max(effective / _MIN_SCATTER, 1.0) ** 2
        covariance *= 1 + 1 / effective  # the mean's own error
        pose = best.perturbed(mean[None])
        covariance[3:, 3:] += FREE_ROTATION_RAD2 * self._free_projector(pose)[0]
        return PoseHypothesis(weight, pose.position_m[0], pose.quaternion[0], covariance)

    def _contact_residuals(
        self, poses: Poses, evidence: PoseEvidence, shifts: FloatArray
    ) -> tuple[FloatArray, FloatArray, _Compared]:
        """Return residuals (k, c, 4) of distance and normal, in standard deviations, and that of the distance
        (k, c) [m]. shifts: (n, 3), by which the points are shifted in the object's frame; the first is 0.

        The point lies somewhere on the pad: the less the object's surface there is parallel to the pad, the
        less certain is its distance.
        """
        way = poses.in_object(evidence.point_m - _OFFSET_M * evidence.normal)
        to_contact = np.asarray(evidence.normal @ poses.matrices)
        distances, normals = self.shape.distance_and_normal(way + shifts[:, None, None])
        along = np.einsum("kci,cij->kcj", normals[0] @ poses.matrices.transpose(0, 2, 1), evidence.spread_m)
        std_m = np.sqrt(np.einsum("kcj,kcj->kc", along, along) + evidence.point_std_m**2)
        found = np.empty((*std_m.shape, 4))
        found[..., 0] = (distances[0] - _OFFSET_M) / std_m
        found[..., 1:] = (normals[0] + to_contact) / evidence.normal_std_rad[:, None]
        return found, std_m, _Compared(way, to_contact, normals)

    def _costs(
        self, residual: FloatArray, std_m: FloatArray, evidence: PoseEvidence
    ) -> tuple[FloatArray, FloatArray]:
        """Return -ln of the likelihood (k, c) over its greatest value at a parallel surface, and the weights
        of squared residuals (k, c, 4) in it.

        It is a mixture of a face's touch and of an edge's, whose normal and place are less certain.
        """
        parallel = np.einsum("ci,cij->cj", evidence.normal, evidence.spread_m)
        least_m = np.sqrt(np.einsum("cj,cj->c", parallel, parallel) + evidence.point_std_m**2)
        narrower_m = std_m**2 / (std_m**2 + _EDGE_STD_M**2)
        narrower_rad = evidence.normal_std_rad**2 / (evidence.normal_std_rad**2 + _EDGE_STD_RAD**2)
        of_distance, of_normal = residual[..., 0] ** 2, np.square(residual[..., 1:]).sum(axis=2)
        scale = np.log(std_m / least_m)
        face = -0.5 * (of_distance + of_normal) - scale + np.log(1 - evidence.edge_share)
        edge = -0.5 * (of_distance * narrower_m + of_normal * narrower_rad) - scale
        edge += 0.5 * np.log(narrower_m) + np.log(narrower_rad) + np.log(evidence.edge_share)
        both = np.logaddexp(face, edge)
        is_face = np.exp(face - both)
        share = np.empty(residual.shape)
        share[..., 0] = is_face + (1 - is_face) * narrower_m
        share[..., 1:] = (is_face + (1 - is_face) * narrower_rad)[..., None]
        return -both, share

    def _contact_costs(self, poses: Poses, evidence: PoseEvidence) -> FloatArray:
        residual, std_m, _ = self._contact_residuals(poses, evidence, np.zeros((1, 3)))
        return self._costs(residual, std_m, evidence)[0]

    def _pad_depths(self, poses: Poses, evidence: PoseEvidence) -> tuple[FloatArray, FloatArray]:
        """Return the deepest distance (k, p) of each pad, in standard deviations, 0 outside the object, and
        the deepest points (k, p, 3) in the object's frame."""
        middle = evidence.free_m.mean(axis=1)
        reach = np.linalg.norm(evidence.free_m - middle[:, None], axis=2).max(axis=1)
        deepest = poses.in_object(middle)
        distance = self.shape.distance(deepest)
        pose, pad = np.nonzero(distance < reach)  # no point of another pad is inside the object
        way = (evidence.free_m[pad] - poses.position_m[pose, None]) @ poses.matrices[pose]
        of_points = self.shape.distance(way)
        at = of_points.argmin(axis=1)
        depth, row = np.zeros(distance.shape), np.arange(len(at))
        depth[pose, pad] = np.minimum(of_points[row, at] / evidence.free_std_m[pad], 0.0)
        deepest[pose, pad] = way[row, at]
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
        axis = flipped[..., None] * cross(of_others[None], axes[:, None])
        sine = np.linalg.norm(axis, axis=2)
        angle = np.arctan2(sine, flipped * cosine)
        opposite = (sine < _OPPOSITE) & (angle > 1.0)  # turned by pi about any axis across
        if opposite.any():
            across = np.linalg.svd(of_others[:, None])[2][:, 1]
            axis[opposite] = np.broadcast_to(across, axis.shape)[opposite]
            sine[opposite] = 1.0
        return np.asarray(axis * (angle / np.maximum(sine, 1e-12))[..., None])

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


class _Pairs(NamedTuple):
    """n pairs of points with normals."""

    features: FloatArray  # (n, 4): distance, cosines of its direction with both normals, and of these
    way: FloatArray  # (n, 3), direction from the first to the second
    side: FloatArray  # (n, 3), perpendicular to it, as the normals lie
    middle_m: FloatArray  # (n, 3)


def _pair_features(
    first_m: FloatArray, second_m: FloatArray, first_normal: FloatArray, second_normal: FloatArray
) -> _Pairs:
    """Return pairs of points (n, 3) with outward normals; features in units of their tolerances."""
    way = second_m - first_m
    length = np.linalg.norm(way, axis=1)
    way = way / np.maximum(length, 1e-9)[:, None]
    one, other = (np.einsum("ni,ni->n", way, normal) for normal in (first_normal, second_normal))
    alike = np.einsum("ni,ni->n", first_normal, second_normal)
    features = np.stack([length / _PAIR_M, one / _PAIR_COSINE, other / _PAIR_COSINE, alike / _PAIR_COSINE], 1)
    across = [v - np.einsum("ni,ni->n", way, v)[:, None] * way for v in (first_normal, second_normal)]
    # nearly opposite normals add up to nothing
    side = np.where((alike < _SAME_SIDE)[:, None], across[0], across[0] + across[1])
    beside = cross(way, np.eye(3)[np.abs(way).argmin(axis=1)])
    side = side + _LITTLE_SIDE * beside
    return _Pairs(features, way, side, (first_m + second_m) / 2)


class _Compared(NamedTuple):
    way: FloatArray  # (k, c, 3), points in the object's frame
    contact_normal: FloatArray  # (k, c, 3), of the contacts, alike
    normals: FloatArray  # (n, k, c, 3), of the object at the points after each shift


class _Density(NamedTuple):
    max_plus_sum: FloatArray  # (s,), ln of the proposals' density at each sample
    responsible: IntArray  # (s,), the proposal with the largest part of it


def _capped(cost: FloatArray, limit: float) -> FloatArray:
    """Return -ln of exp(-cost) with a floor of exp(-limit)."""
    return np.asarray(-np.logaddexp(-cost, -limit))


def _tempered(log_weights: FloatArray) -> tuple[FloatArray, float]:
    """Return normalised weights (s,) raised to the greatest power up to 1 with which they are worth
    `_MIN_EFFECTIVE` equal ones, and how many they are worth without."""
    effective, low, high = _effective(log_weights), 0.0, 1.0
    power = 1.0
    if effective < _MIN_EFFECTIVE:
        for _ in range(_BISECTIONS):
            power = (low + high) / 2
            low, high = (power, high) if _effective(power * log_weights) > _MIN_EFFECTIVE else (low, power)
        power = low
    weights = np.exp(power * (log_weights - log_weights.max()))
    return np.asarray(weights / weights.sum()), effective


def _effective(log_weights: FloatArray) -> float:
    weights = np.exp(log_weights - log_weights.max())
    return float(weights.sum() ** 2 / (weights @ weights))


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return np.cross of arrays (..., 3), in half its time."""
    (ax, ay, az), (bx, by, bz) = (tuple(v[..., i] for i in range(3)) for v in (a, b))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _joined(*parts: Poses) -> Poses:
    return Poses(
        np.concatenate([poses.position_m for poses in parts]),
        np.concatenate([poses.quaternion for poses in parts]),
    )


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


def _rotated(quaternion: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return vectors (n, 3) turned by quaternions (n, 4)."""
    return np.asarray((rotation_matrices(quaternion) @ vectors[:, :, None])[:, :, 0])


def _quaternions(turns: FloatArray) -> FloatArray:
    """Return the quaternions (k, 4) of rotation vectors (k, 3)."""
    angle = np.sqrt(np.einsum("ki,ki->k", turns, turns))[:, None]
    return np.concatenate([0.5 * np.sinc(angle / (2 * np.pi)) * turns, np.cos(angle / 2)], axis=1)
