"""Messages of percepts state what is experimental."""

from __future__ import annotations

import pytest

from handtouch import wire
from handtouch.percept.messages import make_percept_message, pack_message, unpack_output
from handtouch.percept.samples import PerceptEstimate


@pytest.mark.parametrize("kind", wire.PERCEPT_KINDS)
def test_estimates_of_unproven_kinds_are_labelled_experimental_on_the_wire(kind: str) -> None:
    estimate = PerceptEstimate(kind, 0, 0, 1, 10, "estimated", "", {}, {}, {}, "")
    sent = make_percept_message(estimate, "right", "index_distal")
    received = unpack_output(pack_message(sent))
    assert isinstance(received, wire.Percept)
    assert received.experimental == (kind in ("shape", "object", "stiffness"))
