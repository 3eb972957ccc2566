"""State between two ticks: a pipeline restored from it continues bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch import wire
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.events import BaselineEvent
from handtouch.core.scene import RequestedOutputs
from handtouch.core.slab import Slab
from handtouch.core.state import StateLayoutError, TickState
from handtouch.wire import PERCEPT_KINDS, PadState

_ACTIONS = st.one_of(
    st.tuples(
        st.just("sample"),
        st.sets(st.integers(0, 1)),
        st.floats(0.1, 0.9),
        st.floats(0.1, 0.9),
        st.sampled_from([0.0, 5e-5, 1e-3, 4e-3, 9e-3]),
        st.integers(0, 6_000_000),
    ),
    st.tuples(st.just("node"), st.sampled_from([PadState.LOST, PadState.FAULTED, PadState.OFF])),
    st.tuples(st.just("request"), st.booleans(), st.booleans(), st.integers(1, 3), st.booleans()),
    st.tuples(st.just("calibrate"), st.integers(0, 1), st.integers(0, 3)),
    st.tuples(st.just("tare"), st.integers(0, 1), st.integers(0, 3)),
    st.tuples(st.just("solve")),
)


def _do(hand: Any, action: tuple[Any, ...]) -> None:
    if action[0] == "sample":
        _, pads, x, y, current_a, delay_ns = action
        hand.step({pad: hand.counts(pad, x, y, current_a) for pad in sorted(pads)}, delay_ns)
    elif action[0] == "node":
        hand.step({}, node_state=int(action[1]))
    elif action[0] == "request":
        _, position, force, every, motion = action
        no_pads = np.zeros(2, dtype=np.bool_)
        requested = np.array([position, True]), np.array([force, True]), np.array([every, 1])
        percepts = np.zeros((len(PERCEPT_KINDS), 2), dtype=np.bool_)
        percepts[PERCEPT_KINDS.index("motion")] = motion, True
        hand.pipeline.apply_demand(RequestedOutputs(*requested, no_pads, no_pads, percepts), every)
    elif action[0] == "calibrate":
        gains = (1.0 + 0.01 * action[2], 1.0, 1.0, 1.0)
        hand.pipeline.set_calibration(action[1], ActiveCalibration(f"c{action[2]}", gains))
    elif action[0] == "tare":
        hand.pipeline.add_event(BaselineEvent(action[1], (float(action[2]),) * 4, (1.0,) * 4))
    else:
        hand.pipeline.solved_messages(hand.t_ns)


def _published(hand: Any) -> list[list[bytes]]:
    """Return contacts and hand frames, without messages for recorders."""
    kept = [m for m in hand.sink.messages if isinstance(m, wire.Contact | wire.HandFrame)]
    return [wire.encode(message) for message in kept]


@given(st.lists(_ACTIONS, max_size=25), st.lists(_ACTIONS, min_size=1, max_size=25))
@settings(max_examples=40, deadline=None)
def test_a_restored_pipeline_continues_as_the_saved_one(
    make_hand: Callable[..., Any], before: list[Any], after: list[Any]
) -> None:
    first, second = make_hand(), make_hand()
    for action in before:
        _do(first, action)
    first.step({})  # events added before belong to a tick
    saved, calibrations = first.pipeline.save_state(), first.pipeline.calibrations
    second.pipeline.load_state(saved, first.pipeline.state.layout(), calibrations)
    second.pipeline.slab = _copy_of(first.pipeline.slab)  # samples are inputs, not state
    second.t_ns = first.t_ns
    first.sink.messages.clear()
    for hand in (first, second):
        for action in after:
            _do(hand, action)
    assert _published(second) == _published(first)
    assert second.pipeline.save_state() == first.pipeline.save_state()


def _copy_of(slab: Slab) -> Slab:
    made = Slab(slab.size)
    made._bytes[:] = slab._bytes
    made.arrival_ns[:], made.fresh[:], made.fresh_count = slab.arrival_ns, slab.fresh, slab.fresh_count
    made.repeat_counts[:] = slab.repeat_counts
    return made


def test_every_declared_array_is_part_of_the_saved_block(make_hand: Callable[..., Any]) -> None:
    held = make_hand().pipeline.state
    values = [getattr(held, declared.name) for declared in fields(TickState)]
    arrays = [value for value in values if isinstance(value, np.ndarray) and value is not held.block]
    assert sum(array.nbytes for array in arrays) <= len(held.block) < sum(a.nbytes + 64 for a in arrays)
    assert all(np.shares_memory(array, held.block) for array in arrays if array.size)


def test_loaded_arrays_keep_their_identity_and_views(make_hand: Callable[..., Any]) -> None:
    first, second = make_hand(), make_hand()
    first.stroke(30)
    columns = second.pipeline.tick.columns
    second.pipeline.load_state(first.pipeline.save_state(), first.pipeline.state.layout())
    assert np.shares_memory(columns.position_m, second.pipeline.state.block)
    np.testing.assert_array_equal(columns.position_m, first.pipeline.tick.columns.position_m)


def test_a_snapshot_of_everything_leaves_the_state_as_it_was(make_hand: Callable[..., Any]) -> None:
    hand = make_hand()
    no_pads = np.zeros(2, dtype=np.bool_)
    every = np.ones(2, dtype=np.int64)
    hand.pipeline.apply_demand(RequestedOutputs(no_pads, no_pads, every, no_pads, no_pads))
    hand.stroke(15)
    before = hand.pipeline.save_state()
    messages = hand.pipeline.solved_messages(hand.t_ns)
    contact = wire.decode(wire.encode(messages["contact/h/plane"]))
    assert isinstance(contact, wire.Contact)
    assert contact.position_m is not None
    assert hand.pipeline.save_state() == before


def test_a_state_of_another_layout_is_rejected_changing_nothing(make_hand: Callable[..., Any]) -> None:
    pipeline = make_hand().pipeline
    before = pipeline.save_state()
    other = b"\1" * len(before)
    for layout, data in (("0-abc", other), ("", other), (pipeline.state.layout(), other[:-64])):
        with pytest.raises(StateLayoutError, match=r"layout|bytes"):
            pipeline.load_state(data, layout)
    assert pipeline.save_state() == before
