"""Contact detection: debounce, hysteresis, unique ids; timing of ticks."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handtouch.core.contacts import ContactChanges, ContactDetector
from handtouch.core.cycle import Cycle

BEGIN, END = 2.0, 1.0


def _contacts(pads: int = 1, begin: int = 2, end: int = 3) -> ContactDetector:
    return ContactDetector(np.full(pads, BEGIN), np.full(pads, END), np.full(pads, begin), np.full(pads, end))


def _step(
    contacts: ContactDetector, level: float, t_ns: int = 0, sampled: bool = True, trusted: bool = True
) -> ContactChanges:
    one = np.ones(1, dtype=np.bool_)
    return contacts.detect_contacts(np.array([level]), one & sampled, one & trusted, np.array([t_ns]))


def test_a_contact_begins_after_the_debounce_with_the_time_of_its_first_sample() -> None:
    contacts = _contacts(begin=3)
    began = [len(_step(contacts, 3.0, t).began) for t in (10, 20, 30, 40)]
    assert began == [0, 0, 1, 0]
    assert contacts.begin_ns[0] == 10


def test_a_single_outlier_neither_begins_nor_ends_a_contact() -> None:
    contacts = _contacts(begin=2, end=2)
    levels = [3.0, 0.0, 3.0, 3.0, 0.0, 3.0, 0.0]
    changes = [_step(contacts, level) for level in levels]
    assert [len(c.began) for c in changes] == [0, 0, 0, 1, 0, 0, 0]
    assert not any(len(c.ended) for c in changes)


def test_between_the_thresholds_nothing_changes() -> None:
    contacts = _contacts(begin=1, end=1)
    assert not len(_step(contacts, 1.5).began)
    assert len(_step(contacts, 3.0).began)
    assert not len(_step(contacts, 1.5).ended)
    assert len(_step(contacts, 0.5).ended)


def test_a_pad_without_a_sample_keeps_its_state() -> None:
    contacts = _contacts(begin=2)
    _step(contacts, 3.0)
    assert not len(_step(contacts, 3.0, sampled=False).began)
    assert len(_step(contacts, 3.0).began)


def test_a_contact_on_an_untrusted_pad_ends_at_once_and_needs_a_new_debounce() -> None:
    contacts = _contacts(begin=2)
    _step(contacts, 3.0)
    _step(contacts, 3.0)
    assert len(_step(contacts, 3.0, sampled=False, trusted=False).ended)
    assert not len(_step(contacts, 3.0).began)
    assert len(_step(contacts, 3.0).began)


@given(st.lists(st.tuples(st.floats(0, 3), st.booleans(), st.booleans()), max_size=60))
def test_begins_and_ends_alternate_and_no_id_is_used_twice(steps: list[tuple[float, bool, bool]]) -> None:
    contacts = _contacts(begin=2, end=2)
    events: list[tuple[str, int]] = []
    for t_ns, (level, sampled, trusted) in enumerate(steps):
        changes = _step(contacts, level, t_ns, sampled, trusted)
        if len(changes.began):
            events.append(("begin", int(contacts.id[0])))
        if len(changes.ended):
            events.append(("end", int(contacts.id[0])))
            contacts.clear_ended(changes.ended)
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
