"""Percept `shape`: of an object, from contact points in the palm frame; of a contact, from its residual.

Points are collected as contacts begin and move; the classes are fitted to them a few steps at a time. The
object is assumed at rest in the palm frame while anything touches it.

Public names: `ShapeEstimator`, `spot_probabilities`, `pair_distance`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.field import estimate
from handtouch.field.model import ForwardModel
from handtouch.percept.action_request import CandidateAction, Question
from handtouch.percept.classify import ShapeClassification, classify_touches
from handtouch.percept.estimator import FitSchedule, PerceptEstimator
from handtouch.percept.primitives import SHAPE_CLASSES, SIZE_PARAMETERS, ShapePrior, Touches
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate

PairDistanceFunction = Callable[[int, float, float], tuple[float, float]]
# Constants without an origin beside them were chosen; docs/benchmarks/percept_grasp.md measures what they
# yield.
SPOT_CLASSES = ("point", "along x", "along y")
"""Classes that one pad's residual distinguishes: only whether the contact is longer along x or along y."""

_MAX_POINTS = 100  # kept of a hand
_MIN_POINT_DISTANCE_M, _MIN_NORMAL_CHANGE = 2e-3, 0.1  # from one stored point to the next; radians
_MIN_SAMPLES = 8  # samples of a new contact before its points are stored
_FORGET_TIME_NS = 5_000_000_000  # without touch, before the next object is assumed
_OBJECT_DRIFT_M_PER_S, _MAX_OBJECT_DRIFT_M = (
    1.5e-3,
    3e-3,
)  # assumed motion of the object since a touch: rate and bound
_MOVED_SIGMA = 3.0  # advance of a contact along its normal that shows an object that moves
_STEPS_PER_FIT = 2
_SPOT_PERIOD_NS = 500_000_000
_SPOT_SAMPLES = 64
_ELONGATED_RESIDUAL_STD = 0.05  # prior of contacts that aren't points
_POINT_RESIDUAL_STD = 3e-3  # error of a point on a pad within its tolerances
_REQUESTED_SLIDE_M = 5e-3
_SLIDE_COST = 2.0  # sliding disturbs a grasp more than squeezing does


def spot_probabilities(residual: FloatArray, residual_std: FloatArray) -> dict[str, float]:
    """Return probabilities of SPOT_CLASSES from residuals (k,) of one contact and their deviations.

    The residual is the excess of x0 and xa over a point's share: positive along x. An elongated contact and
    two points are indistinguishable: it is one number.
    """
    mean = float(np.mean(residual))
    own = float(np.mean(np.square(residual_std))) / len(residual) + _POINT_RESIDUAL_STD**2
    wide = own + _ELONGATED_RESIDUAL_STD**2
    point = math.exp(-0.5 * mean * mean / own) / math.sqrt(own)
    more = math.exp(-0.5 * mean * mean / wide) / math.sqrt(wide)
    z = mean / math.sqrt(own) * math.sqrt(_ELONGATED_RESIDUAL_STD**2 / wide)
    along_x = 0.5 * math.erfc(-z / math.sqrt(2))
    found = np.array([point, more * along_x, more * (1 - along_x)])
    found /= found.sum()
    return dict(zip(SPOT_CLASSES, found.tolist(), strict=True))


def pair_distance(
    network: ForwardModel, x: float, y: float, residual: float, residual_std: float
) -> tuple[float, float]:
    """Return the distance of two equal points about (x, y) on a pad that leave this residual, and its
    deviation.

    In the unit of the pad's rectangle; along x if the residual is positive, else along y. This is the
    smallest extent that explains the residual. The deviation is infinite where the residual doesn't differ
    significantly from 0.
    """
    at, side = np.array([x, y]), np.array([network.a, network.b])
    axis = 0 if residual >= 0 else 1
    half = 0.05 * float(min(side.min(), 2 * at[axis], 2 * (side - at)[axis]))
    xs, ys = at[:, None] + half * np.eye(2)[axis][:, None] * [-1.0, 1.0]
    pair = network.fractions(xs, ys).mean(axis=1)
    found = estimate(network, pair, 1e-6, at)
    point = network.fractions(found.x, found.y)
    known = abs(float((pair - point)[:2].sum()))  # grows as the square of the distance
    distance = 2 * half * math.sqrt(abs(residual) / max(known, 1e-12))
    determined = abs(residual) > 2 * residual_std
    return distance, distance / 2 * residual_std / abs(residual) if determined else math.inf


class _TouchedPoint(NamedTuple):
    """Point of an object, touched by a pad at `sample_ns`, with normal and covariance."""

    pad: int
    sample_ns: int
    point: FloatArray
    normal: FloatArray
    covariance: FloatArray


@dataclass
class _TouchedObject:
    """Points that a hand touched recently."""

    points: deque[_TouchedPoint] = field(default_factory=lambda: deque(maxlen=_MAX_POINTS))
    last_touch_ns: int = 0
    has_new_points: bool = False
    moved: bool = False
    running_fit: Generator[None, None, ShapeClassification] | None = None
    classification: ShapeClassification | None = None

    @property
    def needs_fit(self) -> bool:
        return self.has_new_points or self.running_fit is not None


class ShapeEstimator(PerceptEstimator):
    """Estimates the shape of the object in each hand, and of the contact spot on each pad."""

    kind = "shape"

    def __init__(
        self, pads: int, prior: ShapePrior | None = None, pair_m: PairDistanceFunction | None = None
    ) -> None:
        """pair_m: function of pad, residual and its deviation that returns the distance of two points as
        `pair_distance`, in metres; default: no extent of a spot is reported.
        """
        super().__init__(pads)
        self.prior = ShapePrior() if prior is None else prior
        self._pair_m = pair_m
        self._objects: dict[int, _TouchedObject] = {}
        self._last_point_m, self._last_normal = np.full((pads, 3), np.inf), np.zeros((pads, 3))
        self._last_contact_id = np.zeros(pads, dtype=np.uint32)
        self._path_m, self._advance_m = np.zeros(pads), np.zeros(pads)
        self._spot_schedule = FitSchedule(pads, _SPOT_PERIOD_NS)

    def process_samples(self, buffer: ContactBuffer, sample: ContactSamples) -> Sequence[PerceptEstimate]:
        """Store contact points that are new."""
        position, normal, pads = sample["palm_position_m"], sample["palm_normal"], sample.pads
        moved = ((position - self._last_point_m[pads]) ** 2).sum(axis=1) > _MIN_POINT_DISTANCE_M**2
        moved |= ((normal - self._last_normal[pads]) ** 2).sum(axis=1) > _MIN_NORMAL_CHANGE**2
        fresh = self._last_contact_id[pads] != sample.contact_id
        keep = (
            (moved | fresh) & (buffer.sample_count[pads] >= _MIN_SAMPLES) & np.isfinite(position).all(axis=1)
        )
        for row in np.flatnonzero(keep).tolist():
            pad, now_ns = int(pads[row]), int(sample.sample_ns[row])
            touched = self._objects.setdefault(int(buffer.hand_index[pad]), _TouchedObject())
            if now_ns - touched.last_touch_ns > _FORGET_TIME_NS and touched.points:
                touched = self._objects[int(buffer.hand_index[pad])] = _TouchedObject()
            touched.moved |= self._object_moved(pad, position[row], normal[row], bool(fresh[row]))
            rows = position[row], normal[row], sample["palm_covariance_m2"][row]
            touched.points.append(_TouchedPoint(pad, now_ns, *(values.copy() for values in rows)))
            touched.has_new_points = True
            self._last_point_m[pad], self._last_normal[pad] = position[row], normal[row]
            self._last_contact_id[pad] = sample.contact_id[row]
        for hand in set(buffer.hand_index[pads].tolist()) & self._objects.keys():
            self._objects[hand].last_touch_ns = int(sample.sample_ns.max())
        return ()

    def next_pad_to_fit(self, buffer: ContactBuffer, now_ns: int) -> int | None:
        """Return a pad of a hand with new points or an unfinished fit, else one whose spot is due."""
        for hand, touched in self._objects.items():
            mine = self.requested & (buffer.hand_index == hand)
            if touched.needs_fit and mine.any():
                return int(np.argmax(mine))
        return self._spot_schedule.next_pad(self.requested & (buffer.sample_count >= _MIN_SAMPLES), now_ns)

    def fit_contact(self, buffer: ContactBuffer, pad: int, now_ns: int) -> Sequence[PerceptEstimate]:
        """Run a few steps of the fit of the pad's hand, and classify the pad's own spot."""
        hand = int(buffer.hand_index[pad])
        found: list[PerceptEstimate] = []
        this = (np.arange(buffer.size) == pad) & (buffer.sample_count >= _MIN_SAMPLES)
        if self._spot_schedule.next_pad(this, now_ns) is not None:
            self._spot_schedule.mark_fitted(pad, now_ns)
            found += self._classify_spot(buffer, pad, now_ns)
        touched = self._objects.get(hand)
        if touched is None or not touched.needs_fit:
            return found
        if touched.running_fit is None:
            touched.has_new_points = False
            touched.running_fit = self._classify_object(touched)
        try:
            for _ in range(_STEPS_PER_FIT):
                next(touched.running_fit)
        except StopIteration as done:
            touched.running_fit, touched.classification = None, done.value
            found.append(
                _shape_percept(done.value, hand, now_ns, len({point.pad for point in touched.points}))
            )
        return found

    def open_questions(self, now_ns: int) -> Sequence[Question]:
        """Return a question for each object whose class is undetermined."""
        found = []
        for hand, touched in self._objects.items():
            result = touched.classification
            here = touched.points[-1].pad if touched.points else -1
            if (
                result is None
                or result.state != "undetermined"
                or now_ns - touched.last_touch_ns > _FORGET_TIME_NS
            ):
                continue
            if result.fits and self.requested[here]:
                found.append(shape_question(result, hand, here, int(self._last_contact_id[here]), self.prior))
        return found

    def _object_moved(self, pad: int, position_m: FloatArray, normal: FloatArray, fresh: bool) -> bool:
        """Return True if a contact that goes on has moved along its normal: the object gives way.

        A contact that slides or rolls on an object at rest moves at right angles to its normal, whatever the
        shape; what it advances is by its way and the errors of normals, and by the skin.
        """
        if fresh:
            self._path_m[pad] = self._advance_m[pad] = 0.0
            return False
        step = position_m - self._last_point_m[pad]
        self._path_m[pad] += math.sqrt(float(step @ step))
        self._advance_m[pad] += float(step @ (normal + self._last_normal[pad])) / 2
        std_m = math.hypot(
            math.sqrt(2) * self.prior.surface_std_m, self.prior.normal_std_rad * float(self._path_m[pad])
        )
        return abs(float(self._advance_m[pad])) > _MOVED_SIGMA * std_m

    def _classify_object(self, touched: _TouchedObject) -> Generator[None, None, ShapeClassification]:
        """Classify stepwise; the place of older points is less certain, because objects turn in the hand."""
        pads, times_ns, points, normals, covariances = map(np.array, zip(*touched.points, strict=True))
        age_s = 1e-9 * (times_ns[-1] - times_ns)
        moved_m = np.minimum(_OBJECT_DRIFT_M_PER_S * age_s, _MAX_OBJECT_DRIFT_M)
        touches = Touches(points, normals, covariances, pads, moved_m**2)
        return (yield from classify_touches(touches, self.prior, moves=touched.moved))

    def _classify_spot(self, buffer: ContactBuffer, pad: int, now_ns: int) -> Sequence[PerceptEstimate]:
        residual, std = (buffer.window(pad, name, _SPOT_SAMPLES) for name in ("residual", "residual_std"))
        known = np.isfinite(residual) & np.isfinite(std)
        hand, contact = int(buffer.hand_index[pad]), int(buffer.contact_id[pad])
        if not known.any():
            reason = "no residual: the position isn't known"
            return [PerceptEstimate(self.kind, hand, pad, contact, now_ns, "undetermined", reason=reason)]
        probabilities = spot_probabilities(residual[known], std[known])
        label = max(probabilities, key=probabilities.__getitem__)
        determined = probabilities[label] >= self.prior.min_probability
        count = int(known.sum())
        values: dict[str, float] = {
            "residual": float(residual[known].mean()),
            "residual_std": math.hypot(float(std[known].mean()) / math.sqrt(count), _POINT_RESIDUAL_STD),
        }
        if determined and label != "point" and self._pair_m is not None:
            distance_m, std_m = self._pair_m(pad, *values.values())
            if math.isfinite(distance_m + std_m):
                values |= {"pair_distance_m": distance_m, "pair_distance_m_std": std_m}
        reason = "" if determined else "the residual is within its noise: press for longer or harder"
        state = "estimated" if determined else "undetermined"
        evidence = {"samples": count}
        return [
            PerceptEstimate(
                kind=self.kind,
                hand=hand,
                pad=pad,
                contact=contact,
                estimate_ns=now_ns,
                state=state,
                label=label * determined,
                probabilities=probabilities,
                values=values,
                evidence=evidence,
                reason=reason,
            )
        ]


def shape_question(
    result: ShapeClassification, hand: int, pad: int, contact: int, prior: ShapePrior
) -> Question:
    """Return the question of the shape class; the outcome is how far the normal turns during a slide.

    Slides along the row of touches or across it: a cylinder curves one way only, an edge has no surface
    across it.
    """
    noise = prior.normal_std_rad * math.sqrt(2)
    radius = {name: max(result.fits[name].radius_m, 1e-3) for name in SHAPE_CLASSES if SIZE_PARAMETERS[name]}
    curves = {
        "slide around": {"cylinder": 1.0, "sphere": 1.0, "edge": 0.0, "flat": 0.0},
        "slide along": {"cylinder": 0.0, "sphere": 1.0, "edge": 0.0, "flat": 0.0},
    }
    actions = []
    for way, bends in curves.items():
        outcomes = {}
        for name in SHAPE_CLASSES:
            turn = bends[name] * _REQUESTED_SLIDE_M / radius.get(name, math.inf)
            own = math.hypot(noise, turn * prior.radius_log_std / 2)
            outcomes[name] = turn, (own if name != "edge" else math.hypot(noise, 0.5))
        direction = "across the axis" if way == "slide around" else "along the axis"
        amount: dict[str, float | str] = {"distance_m": _REQUESTED_SLIDE_M, "direction": direction}
        actions.append(CandidateAction("slide", amount, outcomes, _SLIDE_COST, "turn of the normal in rad"))
    return Question("shape_class", hand, pad, contact, result.probabilities, actions)


def _shape_percept(result: ShapeClassification, hand: int, now_ns: int, pads: int) -> PerceptEstimate:
    values: dict[str, float | str | Sequence[float] | None] = {}
    found = result.fits.get(result.label)
    if found is not None:
        values = {
            "point_m": found.point.tolist(),
            "covariance": found.covariance.ravel().tolist(),
            "covariance_parameters": " ".join(found.parameter_names),
            "object_moves": result.object_moves,
        }
        if result.label != "sphere":
            values["direction"] = found.direction.tolist()
        if SIZE_PARAMETERS[result.label]:
            values |= {"radius_m": found.radius_m, "radius_m_std": found.radius_std_m}
    return PerceptEstimate(
        kind="shape",
        hand=hand,
        pad=-1,
        contact=0,
        estimate_ns=now_ns,
        state=result.state,
        label=result.label,
        probabilities=result.probabilities,
        values=values,
        evidence={"contacts": result.contacts, "pads": pads},
        reason=result.reason,
    )
