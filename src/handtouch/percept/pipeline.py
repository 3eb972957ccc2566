"""Pipeline of percept estimators: per-tick updates, one slow fit at a time, and action requests.

A new kind of percept is added in `PerceptPipeline.build`.

Public name: `PerceptPipeline`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray, IntArray
from handtouch.percept.action_request import ActionRequest, ActionSelector, CandidateAction, Question
from handtouch.percept.estimator import HandSnapshot, PerceptEstimator
from handtouch.percept.friction import FrictionEstimator
from handtouch.percept.object_estimator import ObjectEstimator
from handtouch.percept.relative_motion import slip_probability
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate
from handtouch.percept.shape import PairDistanceFunction, ShapeEstimator
from handtouch.percept.stiffness_estimator import ExpectedRadius, StiffnessEstimator
from handtouch.wire import PERCEPT_KINDS

_FIT_PERIOD_NS = 10_000_000
"""From one fit to the next, whatever the tick period: bounds the load to one fit in 10 ms."""


class PerceptPipeline:
    """Runs estimators over n pads; call `process_tick` after every tick.

    Each estimator runs only for the pads it is requested for.
    """

    def __init__(self, buffer: ContactBuffer, estimators: Sequence[PerceptEstimator]) -> None:
        self.buffer = buffer
        self.estimators = list(estimators)
        self.motion_pads = np.zeros(buffer.size, dtype=np.bool_)
        """pads (n,) whose motion is requested; the core detects it, here it only raises questions"""
        self.action_selector = ActionSelector()
        self.action_request_pads = np.zeros(buffer.size, dtype=np.bool_)
        """pads (n,) about which actions may be requested"""
        self._last_fit_ns = 0
        self._next_estimator = 0  # the first to offer a fit

    @classmethod
    def build(
        cls,
        buffer: ContactBuffer,
        pair_m: PairDistanceFunction | None = None,
        shear_pads: NDArray[np.bool_] | None = None,
        surface_m: FloatArray | None = None,
        extent_m: FloatArray | None = None,
        radii: Sequence[ExpectedRadius | None] | None = None,
    ) -> PerceptPipeline:
        """Return a pipeline of all estimators.

        pair_m: see `ShapeEstimator`; shear_pads: (n,), pads above shear pads, by default none; surface_m,
        extent_m: see `ObjectEstimator`, by default no untouched pad is evidence; radii: see
        `StiffnessEstimator`, by default all pads have one sheet.
        """
        above_shear = np.zeros(buffer.size, np.bool_) if shear_pads is None else shear_pads
        surface_m = np.zeros((buffer.size, 0, 3)) if surface_m is None else surface_m
        return cls(
            buffer,
            (
                ShapeEstimator(buffer.size, pair_m=pair_m),
                FrictionEstimator(above_shear),
                ObjectEstimator(surface_m, extent_m),
                StiffnessEstimator(radii or [None] * buffer.size),
            ),
        )

    def set_requested(self, requested: NDArray[np.bool_], action_request_pads: NDArray[np.bool_]) -> None:
        """Set the pads of each estimator (kinds, n), rows as PERCEPT_KINDS, and those of action requests
        (n,).
        """
        motion = requested[PERCEPT_KINDS.index("motion")]
        changed = motion != self.motion_pads
        self.motion_pads = motion.copy()
        for estimator in self.estimators:
            pads = requested[PERCEPT_KINDS.index(estimator.kind)]
            changed |= pads != estimator.requested
            estimator.requested = pads.copy()
        # for an estimator, every contact begins with its first sample
        self.buffer.end_contacts(np.flatnonzero(changed))
        self.action_request_pads = action_request_pads.copy()

    def process_tick(
        self, sample: ContactSamples, ended: IntArray, tick_ns: int, snapshot: HandSnapshot | None = None
    ) -> tuple[list[PerceptEstimate], list[ActionRequest]]:
        """Process the samples of a tick at `tick_ns`, and the pads (k,) whose contacts ended; also a snapshot
        of the hand, if the tick has one."""
        found: list[PerceptEstimate] = []
        if len(ended):
            ended = ended[self.buffer.contact_id[ended] > 0]
            for estimator in self.estimators:
                if len(rows := ended[estimator.requested[ended]]):
                    estimator.end_contacts(self.buffer, rows)
            self.buffer.end_contacts(ended)
        if len(sample.pads):
            self.buffer.add_samples(sample)
            for estimator in self.estimators:
                found += self._process_samples(estimator, sample)
        if snapshot is not None:
            for estimator in self.estimators:
                found += estimator.process_hand(self.buffer, snapshot)
        found += self._fit_next(tick_ns)
        return found, self._select_requests(tick_ns)

    def _process_samples(
        self, estimator: PerceptEstimator, sample: ContactSamples
    ) -> Sequence[PerceptEstimate]:
        rows = estimator.requested[sample.pads]
        count = np.count_nonzero(rows)
        if not count:
            return ()
        if count < len(rows):
            some = ContactSamples(sample.pads[rows], sample.sample_ns[rows], sample.contact_id[rows])
            some.values = sample.values[rows]
            sample = some
        return estimator.process_samples(self.buffer, sample)

    def _fit_next(self, tick_ns: int) -> Sequence[PerceptEstimate]:
        """Run at most one fit; estimators take turns."""
        if tick_ns - self._last_fit_ns < _FIT_PERIOD_NS:
            return ()
        for number in range(len(self.estimators)):
            estimator = self.estimators[(self._next_estimator + number) % len(self.estimators)]
            if (
                estimator.requested.any()
                and (pad := estimator.next_pad_to_fit(self.buffer, tick_ns)) is not None
            ):
                self._next_estimator += number + 1
                self._last_fit_ns = tick_ns
                return estimator.fit_contact(self.buffer, pad, tick_ns)
        return ()

    def _select_requests(self, tick_ns: int) -> list[ActionRequest]:
        if not self.action_request_pads.any() or not self.action_selector.is_due(tick_ns):
            return []
        questions = [
            question
            for estimator in self.estimators
            if estimator.requested.any()
            for question in estimator.open_questions(tick_ns)
        ] + slip_questions(self.buffer, self.motion_pads)
        questions = [question for question in questions if self._is_requested(question)]
        return self.action_selector.select_requests(questions, tick_ns)

    def _is_requested(self, question: Question) -> bool:
        pads = self.buffer.hand_index == question.hand if question.pad < 0 else question.pad
        return bool(np.any(self.action_request_pads[pads]))


_MIN_LOG_ODDS = math.log(0.25)  # ln of the odds of slip above which a question is posed
_HOLD_S = 0.5


def slip_questions(buffer: ContactBuffer, requested: NDArray[np.bool_]) -> list[Question]:
    """Return a question for each contact on the requested pads (n,) that may slip and isn't known to."""
    pads = np.flatnonzero(requested & (buffer.contact_id > 0))
    log_odds = buffer.latest_field(pads, "slip_log_odds")
    uncertain = (log_odds > _MIN_LOG_ODDS) & np.isfinite(log_odds)
    return [
        _slip_question(buffer, pad, slip_probability(odds))
        for pad, odds in zip(pads[uncertain].tolist(), log_odds[uncertain].tolist(), strict=True)
    ]


def _slip_question(buffer: ContactBuffer, pad: int, slips: float) -> Question:
    tremor_m, velocity = (
        buffer.latest_field(np.array([pad]), name)[0] for name in ("tremor_std_m", "slip_velocity_m_per_s")
    )
    tremor, ramp = float(np.hypot(*tremor_m)), _HOLD_S * float(np.hypot(*velocity))
    hold = CandidateAction(
        "hold",
        {"duration_s": _HOLD_S},
        {"sticks": (0.0, tremor), "slides": (ramp, math.hypot(tremor, ramp / 2))},
        outcome_name="further displacement of the centroid in m",
    )
    hand, contact = int(buffer.hand_index[pad]), int(buffer.contact_id[pad])
    return Question("slip", hand, pad, contact, {"sticks": 1 - slips, "slides": slips}, [hold])
