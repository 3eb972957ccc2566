"""The percept pipeline: bounded load, requested pads only, and questions about contacts that may slip."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.percept.action_request import CandidateAction, Question
from handtouch.percept.estimator import PerceptEstimator
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate
from handtouch.wire import PERCEPT_KINDS


class Slow(PerceptEstimator):
    """A part whose fits are always due."""

    # ruff: noqa: ARG002

    kind = "shape"

    def __init__(self) -> None:
        super().__init__(2)
        self.fitted: list[int] = []
        self.stepped = 0

    def process_samples(self, stream: ContactBuffer, sample: ContactSamples) -> list[PerceptEstimate]:
        self.stepped += 1
        assert self.requested[sample.pads].all()
        return []

    def next_pad_to_fit(self, stream: ContactBuffer, t_ns: int) -> int | None:
        return 1

    def fit_contact(self, stream: ContactBuffer, pad: int, t_ns: int) -> list[PerceptEstimate]:
        self.fitted.append(t_ns)
        return []

    def open_questions(self, t_ns: int) -> list[Question]:
        action = CandidateAction("squeeze", {"force_ratio": 2.0}, {"flat": (0.0, 1.0), "round": (9.0, 1.0)})
        return [Question("area", 0, 1, 2, {"flat": 0.5, "round": 0.5}, [action])]


@pytest.mark.parametrize("period_ns", [1_000_000, 5_000_000])
def test_fits_run_one_at_a_time_and_at_most_a_hundred_per_second(period_ns: int) -> None:
    stream, first, second = ContactBuffer(2), Slow(), Slow()
    perceiver = PerceptPipeline(stream, [first, second])
    requested = np.ones((len(PERCEPT_KINDS), 2), dtype=np.bool_)
    perceiver.set_requested(requested, np.ones(2, dtype=np.bool_))
    for k in range(1, 1 + 10**9 // period_ns):
        sample = ContactSamples(np.array([1]), np.array([k * period_ns]), np.array([2], np.uint32))
        perceiver.process_tick(sample, np.zeros(0, np.intp), k * period_ns)
    together = sorted(first.fitted + second.fitted)
    assert 90 <= len(together) <= 100
    assert len(set(together)) == len(together)
    assert abs(len(first.fitted) - len(second.fitted)) <= 1


def test_estimator_processes_only_its_requested_pads() -> None:
    slow = Slow()
    perceiver = PerceptPipeline(ContactBuffer(2), [slow])
    requested = np.zeros((len(PERCEPT_KINDS), 2), dtype=np.bool_)
    requested[PERCEPT_KINDS.index("shape"), 1] = True
    perceiver.set_requested(requested, np.zeros(2, dtype=np.bool_))
    both = ContactSamples(np.array([0, 1]), np.array([1, 1]), np.array([1, 2], np.uint32))
    _, asks = perceiver.process_tick(both, np.zeros(0, np.intp), 1)
    only = ContactSamples(np.array([0]), np.array([2]), np.array([1], np.uint32))
    perceiver.process_tick(only, np.zeros(0, np.intp), 2)
    assert slow.stepped == 1
    assert asks == []  # action requests aren't requested
    perceiver.set_requested(requested, np.ones(2, dtype=np.bool_))
    assert [ask.action.kind for ask in perceiver.process_tick(both, np.zeros(0, np.intp), 10**9)[1]] == [
        "squeeze"
    ]


@pytest.mark.parametrize(("log_odds", "asks"), [(-0.5, ["hold"]), (-5.0, []), (np.inf, [])])
def test_contact_that_may_slip_poses_a_hold_question(log_odds: float, asks: list[str]) -> None:
    """Not one that sticks, nor one that is known to slip."""
    pipeline, one = PerceptPipeline(ContactBuffer(1), []), np.ones(1, dtype=np.bool_)
    requested = np.zeros((len(PERCEPT_KINDS), 1), dtype=np.bool_)
    requested[PERCEPT_KINDS.index("motion")] = True
    pipeline.set_requested(requested, one)
    sample = ContactSamples(np.array([0]), np.array([10**9]), np.array([1], np.uint32))
    sample["slip_log_odds"] = np.array([log_odds])
    sample["tremor_std_m"], sample["slip_velocity_m_per_s"] = np.full((1, 2), 2e-5), np.full((1, 2), 1e-3)
    _, requests = pipeline.process_tick(sample, np.zeros(0, np.intp), 10**9)
    assert [request.action.kind for request in requests] == asks
