"""Slip and motion of every contact: sticking, incipient slip, sliding, rolling, lift-off.

At every tick `SlipTest` judges whether the centroid has begun to run, and a Kalman filter follows its
velocity on the pad. When it runs, joint states tell sliding from rolling: the surfaces' relative velocity is
that of the link's material less that of the object, which is a rigid body held by the hand's other contacts
that stick, or stands still in the palm's frame where there are none. Without joint states a running centroid
is taken for sliding, with the share of them that rolls by experience left open.

Public names: `Motion`, `CLASSES`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.ask import Action, Question
from handtouch.percept.relative import Materials, Relative, relative_to_object
from handtouch.percept.slip import SlipTest
from handtouch.percept.stream import IntArray, Percept, Sample, Stream

FloatArray = NDArray[np.float64]

CLASSES = ("sticking", "incipient", "sliding", "rolling", "lift-off")
FALSE_ALARM_S = 600.0
"""Least mean time between two false alarms of one contact, under the model of a grip."""
_HAZARD_HZ = 0.05  # slips of a contact per second, before anything is known
_UNLOADING = 5.0  # times that, while its force falls as fast as it ever does
_ROLLS = 0.2  # share of running centroids that roll, where joints don't tell
_OPEN_S = 0.05  # in which evidence of a slip that goes on no longer falls by a factor e
_DOUBT = math.log(0.25)  # ln of the odds of a slip from which on it is worth asking
_HOLD_S = 0.5
_FIRM = 10.0  # times the current at which a contact begins
_FEW = 4  # samples of a contact that nothing can be said of
_LEAST_M2 = 1e-14
_TELL_NS = 50_000_000
_PLACE, _SPREAD = 0, 4  # rows of the velocity filter
_ACCELERATION = 0.01  # of the centroid, root of its spectral density [m/s^1.5]
_LEAVES_S = 0.04  # a force that is gone in this time at the rate at which it falls is about to leave
_RATE_S = 0.02  # over which the rate of a force is smoothed
_HOLDS = -3.0  # ln of the odds of a slip up to which a contact is taken to hold the object
_RUNS_S = 0.06  # a centroid that stands for so long has come to rest
_REST_SPEED = 0.5e-3


class Motion:
    """The part `motion`: a percept of every contact 20 times a second, and at once when its class changes."""

    kind = "motion"

    def __init__(self, stream: Stream, period_ns: int, false_alarm_s: float = FALSE_ALARM_S) -> None:
        n = stream.size
        self.wanted = np.zeros(n, dtype=np.bool_)
        self.test = SlipTest(n, period_ns * 1e-9, false_alarm_s)
        self.running = np.zeros(n, dtype=np.bool_)
        """centroids (n,) that run"""
        self.alarms = 0
        self._last_ns = np.zeros(n, dtype=np.int64)
        self._told_ns = np.zeros(n, dtype=np.int64)
        self._label = np.zeros(n, dtype=np.intp)
        self._looks = np.zeros(n, dtype=np.intp)  # the class at a first look, without joints
        self._follows = np.zeros((5, n, 2))  # place, velocity; variance, covariance, variance
        self._force = np.zeros(n)  # smoothed
        self._rate = np.zeros(n)
        self._rate_std = np.zeros(n)
        self._began_at = np.zeros((n, 2))  # where it began to run
        self._quiet_s = np.zeros(n)
        self._slips = np.zeros(n, dtype=np.int64)  # of the contact so far
        self._scale_a, self._peak_a = np.zeros((2, n))
        self._in_doubt = np.zeros(n, dtype=np.bool_)
        self._odds = np.full(n, -np.inf)
        self._contact = np.zeros((n, 2), dtype=np.int64)  # hand and id

    def step(self, stream: Stream, sample: Sample, began: IntArray) -> Sequence[Percept]:
        """Judge every contact with a new sample."""
        place, force = sample["pad_m"], sample["force_n"]
        variance = np.diagonal(sample["pad_noise_m2"], axis1=1, axis2=2)
        if not (variance > _LEAST_M2).all():  # too light to tell
            whole = np.trace(sample["covariance_m2"], axis1=1, axis2=2)[:, None] / 2
            variance = np.where(variance > _LEAST_M2, variance, np.maximum(whole, _LEAST_M2))
        force = np.where(np.isfinite(force), force, self._force[sample.pads])
        new = np.isin(sample.pads, began) if len(began) else np.zeros(len(sample.pads), dtype=np.bool_)
        press = self._press(sample.pads, sample["current_a"], new)
        usable = np.isfinite(place.sum(axis=1) + variance.sum(axis=1) + press)
        if len(began):
            self._begin(sample.pads[new], place[new], variance[new], force[new], sample.t_ns[new])
            self.test.begin(sample.pads[new], place[new], variance[new], press[new])
        dt_s = np.asarray((sample.t_ns - self._last_ns[sample.pads]) * 1e-9, dtype=np.float64)
        go = usable & ~new & (dt_s > 0)
        if np.count_nonzero(go):
            pads = sample.pads[go]
            self._last_ns[pads] = sample.t_ns[go]
            self._follow(pads, dt_s[go], place[go], variance[go], force[go])
            alarm = self.test.step(pads, dt_s[go], place[go], variance[go], press[go])
            self._start(pads[alarm & ~self.running[pads]], stream)
            self._settle(pads, dt_s[go], place[go], variance[go], press[go])
        self._weigh(sample.pads, dt_s)
        looks = self._look(sample.pads)
        rows = self._to_tell(sample, looks)
        if not len(rows):
            return ()
        known = Materials.of(stream, int(sample.t_ns.max()), self.test.period_s)
        return [
            self._tell(stream, int(sample.pads[k]), int(sample.t_ns[k]), int(looks[k]), known)
            for k in rows.tolist()
        ]

    def _to_tell(self, sample: Sample, looks: IntArray) -> IntArray:
        """Rows whose class is news, and of those that were told a while ago a few: all at once take long."""
        news = looks != self._looks[sample.pads]
        waits = sample.t_ns - self._told_ns[sample.pads]
        due = np.flatnonzero((waits >= _TELL_NS) & ~news)
        few = math.ceil(1.25 * len(sample.pads) * self.test.period_s * 1e9 / _TELL_NS)
        if len(due) > few:
            due = due[np.argsort(-waits[due], kind="stable")[:few]]
        return np.concatenate([news.nonzero()[0], due])

    def due(self, stream: Stream, t_ns: int) -> int | None:  # noqa: ARG002
        """Nothing here takes long."""
        return None

    def fit(self, stream: Stream, pad: int, t_ns: int) -> Sequence[Percept]:  # noqa: ARG002
        """Nothing here takes long."""
        return ()

    def questions(self, t_ns: int) -> Sequence[Question]:  # noqa: ARG002
        """Does it begin to slide? Holding still shows it: a ramp goes on, tremor comes back."""
        return [self._asked(pad) for pad in np.flatnonzero(self._in_doubt).tolist()]

    def end(self, stream: Stream, pads: IntArray, t_ns: int) -> Sequence[Percept]:
        """A contact that ended has lifted off."""
        told = []
        for pad in pads.tolist():
            probabilities = {name: float(name == "lift-off") for name in CLASSES}
            told.append(self._percept(stream, pad, t_ns, probabilities, at_once=True))
            self.running[pad] = self._in_doubt[pad] = False
        return told

    def velocity(self, pads: IntArray) -> tuple[FloatArray, FloatArray]:
        """Velocities (k, 2) on the pads and their standard deviations [m/s]."""
        return self._follows[1, pads], np.sqrt(self._follows[_SPREAD, pads])

    # Details ----------------------------------------------------------------------------------------------

    def _press(self, pads: IntArray, current_a: FloatArray, new: NDArray[np.bool_]) -> FloatArray:
        """Currents (k,) over that of a firm contact on each pad: the greatest ever, or as it begins."""
        self._scale_a[pads[new]] = np.fmax(self._peak_a[pads[new]], _FIRM * current_a[new])
        self._peak_a[pads] = np.fmax(self._peak_a[pads], current_a)
        return np.asarray(current_a / np.maximum(self._scale_a[pads], 1e-12))

    def _begin(
        self,
        pads: IntArray,
        place: FloatArray,
        variance: FloatArray,
        force: FloatArray,
        t_ns: NDArray[np.int64],
    ) -> None:
        if not len(pads):
            return
        self._follows[:, pads] = 0.0
        self._follows[_PLACE, pads], self._follows[2, pads], self._follows[_SPREAD, pads] = (
            place,
            variance,
            1e-4,
        )
        self._force[pads], self._rate[pads], self._rate_std[pads] = force, 0.0, np.abs(force)
        self._last_ns[pads] = t_ns
        self._told_ns[pads] = 0
        self._label[pads] = self._looks[pads] = -1
        self.running[pads] = self._in_doubt[pads] = False
        self._slips[pads] = 0
        self._odds[pads] = -np.inf

    def _follow(
        self, pads: IntArray, dt_s: FloatArray, place: FloatArray, variance: FloatArray, force: FloatArray
    ) -> None:
        """A place that runs at a velocity which wanders; and the rate of the force."""
        dt = dt_s[:, None]
        density = _ACCELERATION**2 * dt
        at, velocity, pp, pv, vv = self._follows[:, pads]
        pp += dt * (2 * pv + dt * (vv + density / 3))
        pv += dt * (vv + density / 2)
        vv += density
        at += dt * velocity
        total, off = pp + variance, place - at
        of_place, of_velocity = pp / total, pv / total
        at += of_place * off
        velocity += of_velocity * off
        vv -= of_velocity * pv
        pv -= of_place * pv
        pp -= of_place * pp
        self._follows[:, pads] = at, velocity, pp, pv, vv
        part = 1 - np.exp(-dt_s / _RATE_S)
        rate = (force - self._force[pads]) / (dt_s + _RATE_S * (1 - part))
        self._force[pads] += part * (force - self._force[pads])
        self._rate[pads] += part * (rate - self._rate[pads])
        slow = np.minimum(dt_s / 1.0, 1.0)
        self._rate_std[pads] = np.sqrt(
            (1 - slow) * self._rate_std[pads] ** 2 + slow * self._rate[pads] ** 2 + 1e-12
        )

    def _start(self, pads: IntArray, stream: Stream) -> None:
        """Centroids begin to run."""
        for pad in pads.tolist():
            self.alarms += 1
            self._slips[pad] += 1
            window = stream.window(pad)
            at = int(np.searchsorted(window.t_s, -self.test.onset_s[pad]))
            self._began_at[pad] = window["pad_m"][min(at, len(window) - 1)]
            self.running[pad] = True
            self.test.runs(np.array([pad]))
            self._quiet_s[pad] = 0.0

    def _settle(
        self, pads: IntArray, dt_s: FloatArray, place: FloatArray, variance: FloatArray, press: FloatArray
    ) -> None:
        """What has run and stands has come to rest: the test begins anew there."""
        if not np.count_nonzero(self.running[pads]):
            return
        velocity, std = self.velocity(pads)
        speed = np.hypot(*velocity.T)
        quiet = speed < np.maximum(2 * np.hypot(*std.T), _REST_SPEED)
        self._quiet_s[pads] = np.where(quiet, self._quiet_s[pads] + dt_s, 0.0)
        rests = self.running[pads] & (self._quiet_s[pads] > _RUNS_S)
        if np.count_nonzero(rests):
            self.running[pads[rests]] = False
            self._odds[pads[rests]] = -np.inf
            self.test.begin(pads[rests], place[rests], variance[rests], press[rests], keep=True)

    def _look(self, pads: IntArray) -> NDArray[np.intp]:
        """The most probable class (k,) at a first look: without joints, and quick."""
        odds, runs = self._odds[pads], self.running[pads]
        self._in_doubt[pads] = (odds > _DOUBT) & ~runs
        looks = np.where(runs, 2, np.where(odds > 0, 1, 0))
        return np.where(self._ahead(pads) < 0, 4, looks)

    def _tell(self, stream: Stream, pad: int, t_ns: int, looks: int, known: Materials) -> Percept:
        """What is to be told of a contact now."""
        slips, leaves = self._slip_probability(pad), self._leave_probability(pad)
        self._contact[pad] = stream.hand_of[pad], stream.contact[pad]
        doubtful = self.running | (self._odds > _HOLDS)
        relative = relative_to_object(known, pad, stream.hand_of, doubtful)
        probabilities = self._probabilities(pad, slips, leaves, relative)
        best = max(range(len(CLASSES)), key=lambda k: probabilities[CLASSES[k]])
        news = best != self._label[pad]
        self._label[pad], self._looks[pad], self._told_ns[pad] = best, looks, t_ns
        return self._percept(stream, pad, t_ns, probabilities, at_once=bool(news), relative=relative)

    def _asked(self, pad: int) -> Question:
        slips = self._slip_probability(pad)
        tremor = float(np.hypot(*self.test.tremor_m(np.array([pad]))[0]))
        ramp = _HOLD_S * float(np.hypot(*self.test.speed[pad]))
        hold = Action(
            "hold",
            {"duration_s": _HOLD_S},
            {"sticks": (0.0, tremor), "slides": (ramp, math.hypot(tremor, ramp / 2))},
            outcome="metres that the centroid moves on",
        )
        hand, contact = self._contact[pad].tolist()
        return Question("sliding", hand, pad, contact, {"sticks": 1 - slips, "slides": slips}, [hold])

    def _weigh(self, pads: IntArray, dt_s: FloatArray) -> None:
        """ln of the odds of having begun to run: R, by how often contacts slip at such forces. What a moment
        ago looked like a slip is still open, or a contact near the threshold would chatter."""
        falls = np.maximum(-self._rate[pads], 0.0) / np.maximum(3 * self._rate_std[pads], 1e-9)
        hazard = _HAZARD_HZ * (1 + (_UNLOADING - 1) * np.minimum(falls, 1.0)) * self.test.period_s
        odds = self.test.log_odds[pads] + np.log(hazard)
        self._odds[pads] = np.fmax(odds, self._odds[pads] - dt_s / _OPEN_S)

    def _slip_probability(self, pad: int) -> float:
        if self.running[pad]:
            return 1.0
        odds = float(self._odds[pad])
        return 1 / (1 + math.exp(min(max(-odds, -50.0), 50.0)))

    def _ahead(self, pads: IntArray) -> FloatArray:
        """Forces (k,) in a moment, at the rate at which they change; smoothing lags behind."""
        return np.asarray(self._force[pads] + (_LEAVES_S + _RATE_S) * self._rate[pads])

    def _leave_probability(self, pad: int) -> float:
        """Of the force being gone by then."""
        ahead = float(self._ahead(np.array([pad]))[0])
        std = max(_LEAVES_S * 0.3 * abs(self._rate[pad]), 0.03 * self._force[pad], 1e-3)
        return 0.5 * math.erfc(ahead / (std * math.sqrt(2)))

    def _probabilities(
        self, pad: int, slips: float, leaves: float, relative: Relative | None
    ) -> dict[str, float]:
        stays = 1 - leaves
        slides = (1 - _ROLLS) if relative is None else relative.slides
        runs = stays * slips if self.running[pad] else 0.0
        still = stays * (1 - slips)
        creeps = stays * slips - runs
        if relative is not None and not self.running[pad]:  # what slides may stand still on the pad
            runs += still * relative.surely
            still *= 1 - relative.surely
            slides = 1.0 if relative.surely > slides else slides
        found = (still, creeps, runs * slides, runs * (1 - slides), leaves)
        return dict(zip(CLASSES, map(float, found), strict=True))

    def _percept(
        self,
        stream: Stream,
        pad: int,
        t_ns: int,
        probabilities: dict[str, float],
        at_once: bool,
        relative: Relative | None = None,
    ) -> Percept:
        (velocity,), (std,) = self.velocity(np.array([pad]))
        count = int(stream.count[pad])
        times = stream.window(pad).t_ns
        label = max(probabilities, key=lambda name: probabilities[name])
        few = count < _FEW and label == "sticking"
        values: dict[str, float | str | Sequence[float] | None] = {
            "velocity_m_per_s": velocity.tolist(),
            "velocity_m_per_s_std": std.tolist(),
            "force_rate_n_per_s": float(self._rate[pad]),
            "tremor_m": self.test.tremor_m(np.array([pad]))[0].tolist(),
        }
        if self.running[pad]:
            way = self._follows[_PLACE, pad] - self._began_at[pad]
            values["slipped_m"] = float(np.hypot(*way))
        if relative is not None:
            values |= relative.values()
        odds = float(self.test.log_odds[pad])
        return Percept(
            self.kind,
            int(stream.hand_of[pad]),
            pad,
            int(stream.contact[pad]),
            t_ns,
            "unestimated" if few else "estimated",
            label,
            probabilities,
            values,
            {
                "samples": count,
                "span_s": float(times[-1] - times[0]) * 1e-9 if count else 0.0,
                "log_odds": odds if math.isfinite(odds) else 0.0,
                "slips": int(self._slips[pad]),
            },
            f"it has just begun: {_FEW} samples are the least to tell" if few else "",
            at_once,
        )
