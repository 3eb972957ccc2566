"""What is kept from tick to tick: put into another pipeline, nothing shows that it was moved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch import wire
from handtouch.canbus.bus.slab import Slab
from handtouch.daemon import state
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
    st.tuples(st.just("want"), st.booleans(), st.booleans(), st.integers(1, 3)),
    st.tuples(st.just("forget"), st.integers(0, 1)),
    st.tuples(
        st.just("solve"),
    ),
)


def _do(hand: Any, action: tuple[Any, ...]) -> None:
    tick = hand.pipeline.tick
    if action[0] == "sample":
        _, pads, x, y, current_a, delay_ns = action
        hand.step({pad: hand.counts(pad, x, y, current_a) for pad in sorted(pads)}, delay_ns)
    elif action[0] == "node":
        hand.step({}, node_state=int(action[1]))
    elif action[0] == "want":
        _, located, weighed, every = action
        tick.want(np.array([located, True]), np.array([weighed, True]), np.zeros(2), np.array([every, 1]))
    elif action[0] == "forget":
        tick.forget(np.array([action[1]]))
    else:
        tick.solve_all()


def _told(hand: Any) -> list[list[bytes]]:
    """Contacts and frames, without those about the state itself."""
    kept = [m for m in hand.taken.messages if isinstance(m, wire.Contact | wire.HandFrame)]
    return [wire.encode(message) for message in kept]


@given(st.lists(_ACTIONS, max_size=25), st.lists(_ACTIONS, min_size=1, max_size=25))
@settings(max_examples=40, deadline=None)
def test_a_restored_pipeline_goes_on_as_the_one_that_was_saved(
    make_hand: Callable[..., Any], before: list[Any], after: list[Any]
) -> None:
    first, second = make_hand(), make_hand()
    for action in before:
        _do(first, action)
    state.restore(second.pipeline, state.unpack(state.pack(state.save(first.pipeline))))
    second.pipeline.slab = _copy_of(first.pipeline.slab)  # what came from the bus is no state of the pipeline
    second.t_ns = first.t_ns
    first.taken.messages.clear()
    for hand in (first, second):
        for action in after:
            _do(hand, action)
    assert _told(second) == _told(first)
    assert state.save(second.pipeline) == state.save(first.pipeline)


def _copy_of(slab: Slab) -> Slab:
    made = Slab(slab.size)
    made._bytes[:] = slab._bytes
    made.t_ns[:], made.fresh[:], made.fresh_count = slab.t_ns, slab.fresh, slab.fresh_count
    made.repeats[:] = slab.repeats
    return made


def test_an_attribute_of_a_kind_that_cannot_be_kept_is_named(make_hand: Callable[..., Any]) -> None:
    hand = make_hand()
    hand.pipeline.tick.contacts.surprise = object()
    with pytest.raises(TypeError, match=r"tick\.contacts\.surprise"):
        state.save(hand.pipeline)


def test_every_array_and_number_of_the_tick_is_kept(make_hand: Callable[..., Any]) -> None:
    saved = state.save(make_hand().pipeline)
    for path in ("tick.contacts._against", "tick.follower._maps", "tick._behind", "tick._read", "ticks",
                 "messages._seq", "cycle.t_ns", "model.gains", "tick.columns.sample_ns"):  # fmt: skip
        assert path in saved


def test_arrays_keep_their_identity_so_that_views_of_them_go_on(make_hand: Callable[..., Any]) -> None:
    first, second = make_hand(), make_hand()
    first.stroke(30)
    columns = second.pipeline.tick.columns
    values = columns.values
    state.restore(second.pipeline, state.save(first.pipeline))
    assert second.pipeline.tick.columns.values is values
    assert np.shares_memory(columns.position_m, values)
    np.testing.assert_array_equal(columns.position_m, first.pipeline.tick.columns.position_m)


def test_the_state_of_another_build_is_refused_by_what_differs(make_hand: Callable[..., Any]) -> None:
    hand = make_hand()
    saved = state.save(hand.pipeline)
    del saved["tick.counts"]
    with pytest.raises(ValueError, match=r"another build.*tick\.counts"):
        state.restore(hand.pipeline, saved)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x93", b"\x01", b"\x81\x01"])
def test_bytes_that_are_no_state_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="state can't be read"):
        state.unpack(data)
