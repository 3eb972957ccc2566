"""Questions about the pose of a known object: the touch whose outcome differs most between its hypotheses.

A candidate is a straight motion of a fingertip towards the object, from outside of it under every hypothesis;
the outcome is the distance until it touches, which each hypothesis predicts from the object's shape.

Public name: `object_questions`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from handtouch.arrays import FloatArray, IntArray
from handtouch.percept.action_request import CandidateAction, Question
from handtouch.percept.object_pose import PoseHypothesis, Poses, cross
from handtouch.percept.object_shapes import KnownShape

_MAX_HYPOTHESES, _ASKED_ABOUT = 4, 2  # predicting an outcome, and whose surfaces are candidates
_PLACES, _MAX_ACTIONS = 48, 4
_START_M, _REACH_M, _CLEARANCE_M = 20e-3, 40e-3, 5e-3
"""Distance of a motion's start from the surface, its length, and the start's distance from any hypothesis."""
_STEPS = 24
_HIT_M = 0.5e-3
_NOISE_M, _MISSED_STD_M = 1.0e-3, 2.0e-3
_GRAZED_STD_M = 10e-3
"""Standard deviation of the outcome where the motion passes the surface closer than its own is uncertain."""
_MIN_COSINE = 0.3
_COST_PER_M = 20.0  # of moving a pad to the start, beside 1 for the touch


def object_questions(
    hand: int,
    name: str,
    shape: KnownShape,
    hypotheses: Sequence[PoseHypothesis],
    pads: IntArray,
    surface_m: FloatArray,
) -> list[Question]:
    """Return questions about poses, each with touches by the one untouched pad that is nearest to them.

    `pads` (p,): untouched pads; `surface_m` (p, f, 3): points of their surfaces in the palm. The hypotheses
    are named `pose 1`, `pose 2` and so on, in the order of `poses` in the percept.
    """
    hypotheses = hypotheses[:_MAX_HYPOTHESES]
    if len(hypotheses) < 2 or not len(pads):
        return []
    poses = Poses.of(hypotheses)
    feet, normals = shape.surface_points(np.random.default_rng(0), _PLACES)
    turns = poses.matrices[:_ASKED_ABOUT].transpose(0, 2, 1)
    start = feet @ turns + poses.position_m[:_ASKED_ABOUT, None] + _START_M * (normals @ turns)
    start, direction = start.reshape(-1, 3), -(normals @ turns).reshape(-1, 3)
    free = (shape.distance(poses.in_object(start)) > _CLEARANCE_M).all(axis=0)
    start, direction = start[free], direction[free]
    mean, std = _predicted(shape, poses, hypotheses, start, direction)
    weight = np.array([h.weight for h in hypotheses])
    weight /= weight.sum()
    apart = np.square(mean[:, None] - mean) / (np.square(std)[:, None] + np.square(std))
    gain = np.einsum("i,j,ijn->n", weight, weight, 1 - np.exp(-0.5 * apart))
    way = np.linalg.norm(surface_m[:, :, None] - start, axis=3).min(axis=1)  # (p, n)
    cost = 1 + _COST_PER_M * way.min(axis=0)
    names = [f"pose {number}" for number in range(1, len(hypotheses) + 1)]
    actions: dict[int, list[CandidateAction]] = defaultdict(list)
    for row in np.argsort(-gain / cost)[:_MAX_ACTIONS].tolist():
        outcomes = {label: (float(mean[k, row]), float(std[k, row])) for k, label in enumerate(names)}
        actions[int(pads[way[:, row].argmin()])].append(
            CandidateAction(
                "touch",
                {
                    "object": name,
                    "palm_start_m": start[row].tolist(),
                    "palm_direction": direction[row].tolist(),
                    "distance_m": _REACH_M,
                },
                outcomes,
                float(cost[row]),
                f"distance until the touch in m, {_REACH_M:g} for none",
            )
        )
    probabilities = dict(zip(names, weight.tolist(), strict=True))
    return [Question("object_pose", hand, pad, 0, probabilities, found) for pad, found in actions.items()]


def _predicted(
    shape: KnownShape,
    poses: Poses,
    hypotheses: Sequence[PoseHypothesis],
    start: FloatArray,
    direction: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation (k, n) of the distance [m] until each motion touches, by sphere
    tracing."""
    turned = direction @ poses.matrices
    begin = poses.in_object(start)
    way, nearest = np.zeros(begin.shape[:2]), np.full(begin.shape[:2], np.inf)
    for _ in range(_STEPS):
        distance = shape.distance(begin + way[..., None] * turned)
        nearest = np.minimum(nearest, distance)
        way = np.minimum(way + np.maximum(distance, 0.0), _REACH_M)
    at = begin + way[..., None] * turned
    distance, normal = shape.distance_and_normal(at)
    jacobian = np.concatenate(
        [part @ poses.matrices.transpose(0, 2, 1) for part in (normal, cross(at, normal))], axis=2
    )
    covariance = np.array([h.covariance for h in hypotheses])
    surface_std = np.sqrt(np.einsum("kni,kij,knj->kn", jacobian, covariance, jacobian))
    steep = np.maximum(np.abs(np.einsum("kni,kni->kn", normal, turned)), _MIN_COSINE)
    hits = distance < _HIT_M
    missed = np.where(nearest < 2 * surface_std, _GRAZED_STD_M, _MISSED_STD_M)
    return np.where(hits, way, _REACH_M), np.where(hits, np.hypot(surface_std / steep, _NOISE_M), missed)
