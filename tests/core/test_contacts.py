"""Contact detection: debounce, hysteresis, unique ids; timing of ticks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.config import Touch
from handtouch.core.memory import rows_by_name
from handtouch.core.slab import Cycle, Slab
from handtouch.core.stages.detect import ContactChanges, ContactDetector, DetectionSettings
from handtouch.core.stages.rows import TOUCH_ROW
from handtouch.core.state import TickState

BEGIN, END = 20.0, 10.0


class Detector:
    """Contacts of one pad with a baseline of 0 and 1 A per count; debounces of so many cycles' samples."""

    def __init__(self, begin: int = 2, end: int = 3, *, period_ns: int = 10, delay_ns: int = 0) -> None:
        one, self.state, self._slab = np.ones(1), TickState.empty(1), Slab(1)
        self.state.max_sample_period_ns[:] = period_ns
        self._cycle, self._up, self._period_ns = Cycle(period_ns, 0.6), np.zeros(1, np.uint8), period_ns
        touch = Touch(begin_ms=1e-5 * (begin - 1), end_ms=1e-5 * (end - 1), max_gap_periods=10)
        settings = DetectionSettings(
            *(np.ones((1, 4)), one, one, BEGIN * one, END * one, rows_by_name(TOUCH_ROW, [touch])),
            np.array([delay_ns]),
        )
        self.contacts = ContactDetector(settings, np.zeros((1, 4)), self.state)

    def step(self, level: float, sampled: bool = True, trusted: bool = True) -> ContactChanges:
        """Run a cycle; a pad that isn't trusted is at the end of its range."""
        self._cycle.begin_cycle(self._cycle.sync_ns + self._period_ns)
        self._slab.begin_cycle(self._cycle.sync_ns)
        counts = np.array([level, 0, 0, 0] if trusted else [32767] * 4, dtype="<i2")
        if sampled or not trusted:
            self._slab.write_pdo(0, counts.tobytes(), self._cycle.sync_ns + 1)
        self._slab.unpack_counts()
        return self.contacts.detect_contacts(self._slab, self._up, self._cycle)


def test_a_contact_begins_after_the_debounce_with_the_time_of_its_first_sample() -> None:
    detector = Detector(begin=3)
    began = [len(detector.step(30).began) for _ in range(4)]
    assert began == [0, 0, 1, 0]
    assert detector.state.begin_ns[0] == 10


def test_a_sample_of_a_node_that_samples_by_itself_is_dated_by_its_delay_before_its_sync() -> None:
    detector = Detector(begin=3, delay_ns=4)
    began = [len(detector.step(30).began) for _ in range(4)]
    assert began == [0, 0, 1, 0]
    assert detector.state.begin_ns[0] == 10 - 4


@pytest.mark.parametrize(("period_ns", "samples"), [(1, 11), (2, 6), (9, 2), (11, 2), (40, 2)])
def test_the_debounce_is_a_time_whatever_the_rate_and_at_least_two_samples(
    period_ns: int, samples: int
) -> None:
    detector = Detector(begin=2, end=2, period_ns=period_ns)
    began = [len(detector.step(30).began) for _ in range(samples)]
    assert began == [0] * (samples - 1) + [1]
    ended = [len(detector.step(0).ended) for _ in range(samples)]
    assert ended == [0] * (samples - 1) + [1]


def test_a_single_outlier_neither_begins_nor_ends_a_contact() -> None:
    detector = Detector(begin=2, end=2)
    levels = [30, 0, 30, 30, 0, 30, 0]
    changes = [detector.step(level) for level in levels]
    assert [len(c.began) for c in changes] == [0, 0, 0, 1, 0, 0, 0]
    assert not any(len(c.ended) for c in changes)


def test_between_the_thresholds_nothing_changes() -> None:
    detector = Detector(begin=1, end=1)
    assert not len(detector.step(15).began)
    assert len(detector.step(30).began)
    assert not len(detector.step(15).ended)
    assert len(detector.step(5).ended)


def test_a_pad_without_a_sample_keeps_its_state() -> None:
    detector = Detector(begin=2)
    detector.step(30)
    assert not len(detector.step(30, sampled=False).began)
    assert len(detector.step(30).began)


def test_a_contact_on_an_untrusted_pad_ends_at_once_and_needs_a_new_debounce() -> None:
    detector = Detector(begin=2)
    detector.step(30)
    detector.step(30)
    assert len(detector.step(30, trusted=False).ended)
    assert not len(detector.step(30).began)
    assert len(detector.step(30).began)


@given(st.lists(st.tuples(st.integers(0, 30), st.booleans(), st.booleans()), max_size=60))
def test_begins_and_ends_alternate_and_no_id_is_used_twice(steps: list[tuple[int, bool, bool]]) -> None:
    detector = Detector(begin=2, end=2)
    events: list[tuple[str, int]] = []
    for level, sampled, trusted in steps:
        changes = detector.step(level, sampled, trusted)
        if len(changes.began):
            events.append(("begin", int(detector.state.contact_id[0])))
        if len(changes.ended):
            events.append(("end", int(detector.state.contact_id[0])))
            detector.state.contact_id[changes.ended] = 0
    assert [event for event, _ in events] == ["begin", "end"] * (len(events) // 2) + ["begin"] * (
        len(events) % 2
    )
    begun = [number for event, number in events if event == "begin"]
    assert len(set(begun)) == len(begun)
    assert [number for event, number in events if event == "end"] == begun[: len(events) // 2]


def test_a_cycle_ticks_once_when_complete_or_after_its_window() -> None:
    cycle = Cycle(period_ns=1000, window=0.6)
    assert not cycle.is_tick_due(0, complete=True)
    cycle.begin_cycle(5000)
    assert not cycle.is_tick_due(5599, complete=False)
    assert cycle.is_tick_due(5600, complete=False)
    assert cycle.is_tick_due(5001, complete=True)
    cycle.ticked = True
    assert not cycle.is_tick_due(5600, complete=True)
    assert cycle.sync_overdue_ns == 6500
