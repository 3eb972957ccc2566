"""State between two ticks: a pipeline restored from it continues bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch import wire
from handtouch.core import state
from handtouch.core.slab import Slab
from handtouch.wire import PadState

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
    st.tuples(st.just("discard"), st.integers(0, 1)),
    st.tuples(st.just("solve")),
)


def _do(hand: Any, action: tuple[Any, ...]) -> None:
    tick = hand.pipeline.tick
    if action[0] == "sample":
        _, pads, x, y, current_a, delay_ns = action
        hand.step({pad: hand.counts(pad, x, y, current_a) for pad in sorted(pads)}, delay_ns)
    elif action[0] == "node":
        hand.step({}, node_state=int(action[1]))
    elif action[0] == "request":
        _, position, force, every, motion = action
        requested = np.array([position, True]), np.array([force, True])
        tick.set_requested(*requested, np.array([every, 1]))
        tick.slip.set_requested(np.array([motion, True]))
    elif action[0] == "discard":
        tick.discard_solutions(np.array([action[1]]))
    else:
        tick.solve_all()


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
    first.pipeline.tick.slip.set_requested(np.ones(2, dtype=np.bool_))
    for action in before:
        _do(first, action)
    state.restore(second.pipeline, state.unpack(state.pack(state.save(first.pipeline))))
    second.pipeline.slab = _copy_of(first.pipeline.slab)  # samples are inputs, not state
    second.t_ns = first.t_ns
    first.sink.messages.clear()
    for hand in (first, second):
        for action in after:
            _do(hand, action)
    assert _published(second) == _published(first)
    assert state.save(second.pipeline) == state.save(first.pipeline)


def _copy_of(slab: Slab) -> Slab:
    made = Slab(slab.size)
    made._bytes[:] = slab._bytes
    made.arrival_ns[:], made.fresh[:], made.fresh_count = slab.arrival_ns, slab.fresh, slab.fresh_count
    made.repeat_counts[:] = slab.repeat_counts
    return made


def test_an_attribute_of_unknown_type_is_named(make_hand: Callable[..., Any]) -> None:
    hand = make_hand()
    hand.pipeline.tick.contacts.surprise = object()
    with pytest.raises(TypeError, match=r"tick\.contacts\.surprise"):
        state.save(hand.pipeline)


def test_every_array_and_number_of_the_tick_is_saved(make_hand: Callable[..., Any]) -> None:
    saved = state.save(make_hand().pipeline)
    for path in ("tick.contacts._contradicting_samples", "tick.columns.values",
                 "tick.baseline.offset", "ticks", "messages._seq",
                 "cycle.sync_ns", "model.gains", "tick.columns.sample_ns"):  # fmt: skip
        assert path in saved


def test_restored_arrays_keep_their_identity_and_views(make_hand: Callable[..., Any]) -> None:
    first, second = make_hand(), make_hand()
    first.stroke(30)
    columns = second.pipeline.tick.columns
    values = columns.values
    state.restore(second.pipeline, state.save(first.pipeline))
    assert second.pipeline.tick.columns.values is values
    assert np.shares_memory(columns.position_m, values)
    np.testing.assert_array_equal(columns.position_m, first.pipeline.tick.columns.position_m)


def test_the_state_of_another_build_is_rejected_naming_the_difference(make_hand: Callable[..., Any]) -> None:
    hand = make_hand()
    saved = state.save(hand.pipeline)
    del saved["tick.counts"]
    with pytest.raises(ValueError, match=r"another build.*tick\.counts"):
        state.restore(hand.pipeline, saved)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x93", b"\x01", b"\x81\x01"])
def test_malformed_bytes_of_a_state_are_rejected(data: bytes) -> None:
    with pytest.raises(ValueError, match="malformed state"):
        state.unpack(data)
