"""What shape is it: from where a hand touches in the palm's frame, and from what a pad's currents leave over.

Points are gathered as contacts come and move; the classes are fitted to them a little at a time. The object
is taken to rest in the palm's frame as long as anything touches it.

Public names: `Shape`, `point_or_more`, `pair_distance`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handtouch.field.bank import LocatorBank
from handtouch.percept.ask import Action, Question
from handtouch.percept.classify import Verdict, classifying
from handtouch.percept.primitives import CLASSES, SIZES, Prior
from handtouch.percept.stream import IntArray, Percept, Sample, Stream, Turns

FloatArray = NDArray[np.float64]

PairDistance = Callable[[int, float, float], tuple[float, float]]
SPOTS = ("point", "along x", "along y")
"""What one pad's residual tells apart: no more than how far it is longer one way than the other."""

_MOST = 100  # contacts kept of a hand
_MOVED_M, _TURNED = 2e-3, 0.1  # from one that is kept to the next; radians
_SETTLED = 8  # samples of a new contact before it counts
_FORGET_NS = 5_000_000_000  # untouched for so long: the next touch is another object's
_TURNS_M_PER_S, _TURNS_M = 1.5e-3, 3e-3  # what was touched has moved since, by so much a second, and at most
_STEPS = 2  # of a fit at a time
_SPOT_NS = 500_000_000
_SPOT_SAMPLES = 64
_LONG = 0.05  # residuals of contacts that aren't points (1 sigma, prior)
_TOLERANCE = 3e-3  # residual of a point on a pad whose parts are a little off
_SLIDE_M = 5e-3
_COST = 2.0  # sliding disturbs a grasp more than squeezing


def point_or_more(residual: FloatArray, residual_std: FloatArray) -> dict[str, float]:
    """Probabilities of SPOTS from residuals (k,) of one contact and their deviations.

    The residual is what x0 and xa take beyond a point's share: above 0 along x. An elongated contact and two
    points can't be told apart: it is one number.
    """
    mean = float(np.mean(residual))
    own = float(np.mean(np.square(residual_std))) / len(residual) + _TOLERANCE**2
    wide = own + _LONG**2
    point = math.exp(-0.5 * mean * mean / own) / math.sqrt(own)
    more = math.exp(-0.5 * mean * mean / wide) / math.sqrt(wide)
    z = mean / math.sqrt(own) * math.sqrt(_LONG**2 / wide)
    along_x = 0.5 * math.erfc(-z / math.sqrt(2))
    found = np.array([point, more * along_x, more * (1 - along_x)])
    found /= found.sum()
    return dict(zip(SPOTS, found.tolist(), strict=True))


def pair_distance(
    bank: LocatorBank, pad: int, x: float, y: float, residual: float, residual_std: float
) -> tuple[float, float]:
    """How far apart two equal points about (x, y) on a pad would be that leave this residual; its deviation.

    In the unit of the pad's rectangle; along x where the residual is above 0, else along y. The least size
    that explains it. The deviation is infinite where the residual isn't told from 0.
    """
    at, side = np.array([x, y]), bank.sides[pad]
    axis = 0 if residual >= 0 else 1
    half = 0.05 * float(min(side.min(), 2 * at[axis], 2 * (side - at)[axis]))
    xs, ys = at[:, None] + half * np.eye(2)[axis][:, None] * [-1.0, 1.0]
    pair = bank.fractions(np.full(2, pad), xs, ys).mean(axis=1, keepdims=True)
    found = bank.estimate(np.array([pad]), pair, 1e-6, start=at[:, None])
    point = bank.fractions(np.array([pad]), found.x, found.y)
    known = abs(float((pair - point)[:2].sum()))  # goes as the square of the distance
    distance = 2 * half * math.sqrt(abs(residual) / max(known, 1e-12))
    sure = abs(residual) > 2 * residual_std
    return distance, distance / 2 * residual_std / abs(residual) if sure else math.inf


@dataclass
class _Object:
    """What a hand has touched lately."""

    points: list[FloatArray] = field(default_factory=list)
    normals: list[FloatArray] = field(default_factory=list)
    covariances: list[FloatArray] = field(default_factory=list)
    links: list[int] = field(default_factory=list)
    times_ns: list[int] = field(default_factory=list)
    seen_ns: int = 0
    news: bool = False
    at_work: Generator[None, None, Verdict] | None = None
    verdict: Verdict | None = None

    def add(self, pad: int, t_ns: int, point: FloatArray, normal: FloatArray, covariance: FloatArray) -> None:
        self.points = [*self.points[1 - _MOST :], point.copy()]
        self.normals = [*self.normals[1 - _MOST :], normal.copy()]
        self.covariances = [*self.covariances[1 - _MOST :], covariance.copy()]
        self.links = [*self.links[1 - _MOST :], pad]
        self.times_ns = [*self.times_ns[1 - _MOST :], t_ns]
        self.news = True


class Shape:
    """Shape of what each hand holds, and of the spot on each pad, as a part of perception."""

    kind = "shape"

    def __init__(self, pads: int, prior: Prior | None = None, pair_m: PairDistance | None = None) -> None:
        """pair_m: of a pad, a residual and its deviation: how far apart two points would be, as
        `pair_distance`, in metres; left out, no size is told of a spot."""
        self.wanted = np.zeros(pads, dtype=np.bool_)
        self.prior = Prior() if prior is None else prior
        self._pair_m = pair_m
        self._objects: dict[int, _Object] = {}
        self._kept_m, self._kept_normal = np.full((pads, 3), np.inf), np.zeros((pads, 3))
        self._kept_of = np.zeros(pads, dtype=np.uint32)
        self._spots = Turns(pads, _SPOT_NS)

    def step(self, stream: Stream, sample: Sample, began: IntArray) -> Sequence[Percept]:  # noqa: ARG002
        """Keep what is a new place."""
        place, normal, pads = sample["palm_position_m"], sample["palm_normal"], sample.pads
        moved = ((place - self._kept_m[pads]) ** 2).sum(axis=1) > _MOVED_M**2
        moved |= ((normal - self._kept_normal[pads]) ** 2).sum(axis=1) > _TURNED**2
        fresh = self._kept_of[pads] != sample.contact
        keep = (moved | fresh) & (stream.count[pads] >= _SETTLED) & np.isfinite(place).all(axis=1)
        for row in np.flatnonzero(keep).tolist():
            pad, t_ns = int(pads[row]), int(sample.t_ns[row])
            touched = self._objects.setdefault(int(stream.hand_of[pad]), _Object())
            if t_ns - touched.seen_ns > _FORGET_NS and touched.points:
                touched = self._objects[int(stream.hand_of[pad])] = _Object()
            touched.add(pad, t_ns, place[row], normal[row], sample["palm_covariance_m2"][row])
            self._kept_m[pad], self._kept_normal[pad] = place[row], normal[row]
            self._kept_of[pad] = sample.contact[row]
        for hand in set(stream.hand_of[pads].tolist()) & self._objects.keys():
            self._objects[hand].seen_ns = int(sample.t_ns.max())
        return ()

    def due(self, stream: Stream, t_ns: int) -> int | None:
        """A pad of a hand whose fit is under way or has news, else one whose spot wasn't told lately."""
        for hand, touched in self._objects.items():
            mine = self.wanted & (stream.hand_of == hand)
            if (touched.news or touched.at_work is not None) and mine.any():
                return int(np.argmax(mine))
        return self._spots.due(self.wanted & (stream.count >= _SETTLED), t_ns)

    def fit(self, stream: Stream, pad: int, t_ns: int) -> Sequence[Percept]:
        """A few steps for the hand of a pad, and the pad's own spot."""
        hand = int(stream.hand_of[pad])
        found: list[Percept] = []
        this = (np.arange(stream.size) == pad) & (stream.count >= _SETTLED)
        if self._spots.due(this, t_ns) is not None:
            self._spots.took(pad, t_ns)
            found += self._spot(stream, pad, t_ns)
        touched = self._objects.get(hand)
        if touched is None or not (touched.news or touched.at_work is not None):
            return found
        if touched.at_work is None:
            touched.news = False
            touched.at_work = self._classifying(touched)
        try:
            for _ in range(_STEPS):
                next(touched.at_work)
        except StopIteration as done:
            touched.at_work, touched.verdict = None, done.value
            found.append(_told(done.value, hand, t_ns, len(set(touched.links))))
        return found

    def end(self, stream: Stream, pads: IntArray, t_ns: int) -> Sequence[Percept]:  # noqa: ARG002
        """Nothing: what was touched stays known for a while."""
        return ()

    def questions(self, t_ns: int) -> Sequence[Question]:
        """Which of the shapes that are still possible is it?"""
        found = []
        for hand, touched in self._objects.items():
            verdict = touched.verdict
            here = touched.links[-1] if touched.links else -1
            if verdict is None or verdict.state != "unestimated" or t_ns - touched.seen_ns > _FORGET_NS:
                continue
            if verdict.fits and self.wanted[here]:
                found.append(question(verdict, hand, here, int(self._kept_of[here]), self.prior))
        return found

    def _classifying(self, touched: _Object) -> Generator[None, None, Verdict]:
        """Older touches count less: things turn in the hand."""
        age_s = 1e-9 * (touched.times_ns[-1] - np.array(touched.times_ns))
        moved_m = np.minimum(_TURNS_M_PER_S * age_s, _TURNS_M)
        covariances = np.array(touched.covariances) + (moved_m**2)[:, None, None] * np.eye(3)
        rows = np.array(touched.points), np.array(touched.normals), covariances
        moved = touched.verdict is not None and touched.verdict.moves  # then it has, for good
        return (yield from classifying(*rows, self.prior, moved=moved))

    def _spot(self, stream: Stream, pad: int, t_ns: int) -> Sequence[Percept]:
        window = stream.window(pad, _SPOT_SAMPLES)
        residual, std = window["residual"], window["residual_std"]
        known = np.isfinite(residual) & np.isfinite(std)
        hand, contact = int(stream.hand_of[pad]), int(stream.contact[pad])
        if not known.any():
            reason = "no residual: the place isn't known"
            return [Percept(self.kind, hand, pad, contact, t_ns, "unestimated", reason=reason)]
        chances = point_or_more(residual[known], std[known])
        label = max(chances, key=chances.__getitem__)
        sure = chances[label] >= self.prior.sure
        count = int(known.sum())
        values: dict[str, float] = {
            "residual": float(residual[known].mean()),
            "residual_std": math.hypot(float(std[known].mean()) / math.sqrt(count), _TOLERANCE),
        }
        if sure and label != "point" and self._pair_m is not None:
            distance_m, std_m = self._pair_m(pad, *values.values())
            if math.isfinite(distance_m + std_m):
                values |= {"pair_distance_m": distance_m, "pair_distance_m_std": std_m}
        reason = "" if sure else "press for longer, or harder: the residual is within its noise"
        state = "estimated" if sure else "unestimated"
        evidence = {"samples": count}
        return [
            Percept(
                self.kind, hand, pad, contact, t_ns, state, label * sure, chances, values, evidence, reason
            )
        ]


def question(verdict: Verdict, hand: int, pad: int, contact: int, prior: Prior) -> Question:
    """What would tell shapes apart: how far the normal turns when a pad slides on, and which way.

    Along the row of touches or across it: a cylinder curves one way only, an edge has no across.
    """
    noise = prior.normal_std_rad * math.sqrt(2)
    radius = {name: max(verdict.fits[name].radius_m, 1e-3) for name in CLASSES if SIZES[name]}
    curves = {
        "slide around": {"cylinder": 1.0, "sphere": 1.0, "edge": 0.0, "flat": 0.0},
        "slide along": {"cylinder": 0.0, "sphere": 1.0, "edge": 0.0, "flat": 0.0},
    }
    actions = []
    for way, bends in curves.items():
        outcomes = {}
        for name in CLASSES:
            turn = bends[name] * _SLIDE_M / radius.get(name, math.inf)
            own = math.hypot(noise, turn * prior.radius_log_std / 2)
            outcomes[name] = turn, (own if name != "edge" else math.hypot(noise, 0.5))
        direction = "across the axis" if way == "slide around" else "along the axis"
        amount: dict[str, float | str] = {"distance_m": _SLIDE_M, "direction": direction}
        actions.append(Action("slide", amount, outcomes, _COST, "turn of the normal in rad"))
    return Question("which shape", hand, pad, contact, verdict.probabilities, actions)


def _told(verdict: Verdict, hand: int, t_ns: int, pads: int) -> Percept:
    values: dict[str, float | str | Sequence[float] | None] = {}
    found = verdict.fits.get(verdict.label)
    if found is not None:
        values = {
            "point_m": found.point.tolist(),
            "covariance": found.covariance.ravel().tolist(),
            "covariance_of": " ".join(found.names),
            "object": "moves" if verdict.moves else "rests",
        }
        if verdict.label != "sphere":
            values["direction"] = found.direction.tolist()
        if SIZES[verdict.label]:
            values |= {"radius_m": found.radius_m, "radius_m_std": found.radius_std_m}
    return Percept(
        "shape",
        hand,
        -1,
        0,
        t_ns,
        verdict.state,
        verdict.label,
        verdict.probabilities,
        values,
        {"contacts": verdict.contacts, "pads": pads},
        verdict.reason,
    )
