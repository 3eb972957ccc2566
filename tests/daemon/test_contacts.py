"""Contacts have a life: debounce, hysteresis, stable ids."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handtouch.daemon.contacts import Changes, Contacts
from handtouch.daemon.cycle import Cycle

ON, OFF = 2.0, 1.0


def _contacts(pads: int = 1, begin: int = 2, end: int = 3) -> Contacts:
    return Contacts(np.full(pads, ON), np.full(pads, OFF), np.full(pads, begin), np.full(pads, end))


def _step(
    contacts: Contacts, level: float, t_ns: int = 0, sampled: bool = True, trusted: bool = True
) -> Changes:
    one = np.ones(1, dtype=np.bool_)
    return contacts.step(np.array([level]), one & sampled, one & trusted, np.array([t_ns]))


def test_a_contact_begins_after_the_debounce_and_is_dated_to_its_first_sample() -> None:
    contacts = _contacts(begin=3)
    began = [len(_step(contacts, 3.0, t).began) for t in (10, 20, 30, 40)]
    assert began == [0, 0, 1, 0]
    assert contacts.begin_ns[0] == 10


def test_a_single_sample_out_of_line_neither_begins_nor_ends_a_contact() -> None:
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


def test_a_pad_without_a_sample_is_left_as_it_is() -> None:
    contacts = _contacts(begin=2)
    _step(contacts, 3.0)
    assert not len(_step(contacts, 3.0, sampled=False).began)
    assert len(_step(contacts, 3.0).began)


def test_a_contact_on_a_pad_that_lost_trust_ends_at_once_and_needs_a_new_debounce() -> None:
    contacts = _contacts(begin=2)
    _step(contacts, 3.0)
    _step(contacts, 3.0)
    assert len(_step(contacts, 3.0, sampled=False, trusted=False).ended)
    assert not len(_step(contacts, 3.0).began)
    assert len(_step(contacts, 3.0).began)


@given(st.lists(st.tuples(st.floats(0, 3), st.booleans(), st.booleans()), max_size=60))
def test_begins_and_ends_alternate_and_no_id_is_used_twice(steps: list[tuple[float, bool, bool]]) -> None:
    contacts = _contacts(begin=2, end=2)
    life: list[tuple[str, int]] = []
    for t_ns, (level, sampled, trusted) in enumerate(steps):
        changes = _step(contacts, level, t_ns, sampled, trusted)
        if len(changes.began):
            life.append(("begin", int(contacts.id[0])))
        if len(changes.ended):
            life.append(("end", int(contacts.id[0])))
            contacts.forget(changes.ended)
    assert [event for event, _ in life] == ["begin", "end"] * (len(life) // 2) + ["begin"] * (len(life) % 2)
    begun = [number for event, number in life if event == "begin"]
    assert len(set(begun)) == len(begun)
    assert [number for event, number in life if event == "end"] == begun[: len(life) // 2]


def test_a_cycle_ticks_once_when_complete_or_when_its_window_has_passed() -> None:
    cycle = Cycle(period_ns=1000, window=0.6)
    assert not cycle.tick_due(0, complete=True)
    cycle.begin(5000)
    assert not cycle.tick_due(5599, complete=False)
    assert cycle.tick_due(5600, complete=False)
    assert cycle.tick_due(5001, complete=True)
    cycle.ticked = True
    assert not cycle.tick_due(5600, complete=True)
    assert cycle.overdue_ns == 6500
