"""A pad that comes back while it is held: nothing says `clear` before the contact begins."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch import wire
from handtouch.config import parse
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.table_cache import build_pad_model
from handtouch.wire import PadState
from tests.record.conftest import DEPLOYMENT, PERIOD_NS, SESSION, CollectingSink, Hand

REST = b"\0" * 8
SLOW_TO_BEGIN = DEPLOYMENT.replace("begin_ms = 5.0", "begin_ms = 15.0")


def make_hand() -> Hand:
    sink = CollectingSink()
    model = build_pad_model(parse(SLOW_TO_BEGIN))
    return Hand(parse(DEPLOYMENT), Pipeline(model, PERIOD_NS, 0.6, sink, SESSION), sink)


def states(hand: Hand) -> list[int]:
    """Return the states of the first pad in the frames since the last call."""
    frames = [message for message in hand.sink.messages if isinstance(message, wire.HandFrame)]
    hand.sink.messages.clear()
    return [int(np.frombuffer(frame.state, np.uint8)[0]) for frame in frames]


@pytest.mark.parametrize("away", [PadState.LOST, PadState.STARTING, PadState.FAULTED, PadState.OFF])
def test_a_pad_that_returns_held_is_starting_until_it_is_touched(away: PadState) -> None:
    hand = make_hand()
    for _ in range(300):
        hand.step({0: REST, 1: REST})
    hand.step({}, node_state=away)
    states(hand)
    held = hand.counts(0, 0.5, 0.4, 2e-3)
    for _ in range(5):
        hand.step({0: held, 1: REST})
    assert states(hand) == [PadState.STARTING] * 3 + [PadState.TOUCHED] * 2


def test_a_pad_that_returns_untouched_is_clear_at_once() -> None:
    hand = make_hand()
    for _ in range(300):
        hand.step({0: REST, 1: REST})
    hand.step({}, node_state=PadState.LOST)
    states(hand)
    hand.step({0: REST, 1: REST})
    assert states(hand) == [PadState.CLEAR]


def test_a_pad_whose_samples_return_is_starting_until_it_is_touched() -> None:
    hand = make_hand()
    for _ in range(300):
        hand.step({0: REST, 1: REST})
    for _ in range(6):
        hand.step({1: REST})
    assert states(hand)[-1] == PadState.STALE
    held = hand.counts(0, 0.5, 0.4, 2e-3)
    for _ in range(5):
        hand.step({0: held, 1: REST})
    assert states(hand) == [PadState.STARTING] * 3 + [PadState.TOUCHED] * 2
    hand.step({0: REST, 1: REST})
    assert PadState.STARTING not in states(hand)


def test_a_touch_of_a_sampled_pad_is_clear_until_it_begins() -> None:
    hand = make_hand()
    for _ in range(300):
        hand.step({0: REST, 1: REST})
    states(hand)
    held = hand.counts(0, 0.5, 0.4, 2e-3)
    for _ in range(5):
        hand.step({0: held, 1: REST})
    assert states(hand) == [PadState.CLEAR] * 3 + [PadState.TOUCHED] * 2
