"""No frame makes a node raise, and it serves the next valid request."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

IDENTIFIERS = [0x000, 0x080, 0x081, 0x181, 0x281, 0x601, 0x601, 0x601, 0x602, 0x701, 0x7E4, 0x7E5, 0x7FF]
OBJECTS = [b"\x17\x10\0", b"\x01\x18\x01", b"\x01\x18\x02", b"\x01\x1a\0", b"\x00\x21\0", b"\x08\x10\0"]

requests = st.builds(
    lambda command, place, value: bytes([command]) + place + value,
    st.integers(0, 255),
    st.one_of(st.sampled_from(OBJECTS), st.binary(min_size=3, max_size=3)),
    st.binary(min_size=4, max_size=4),
)
frames = st.tuples(
    st.one_of(st.sampled_from(IDENTIFIERS), st.integers(0, 0x7FF)),
    st.one_of(requests, st.binary(max_size=8)),
    st.booleans(),
)


@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(sent=st.lists(frames, max_size=40))
def test_no_frame_raises_in_a_node(
    make_bench: Any, caplog: pytest.LogCaptureFixture, sent: list[tuple[int, bytes, bool]]
) -> None:
    bench = make_bench()
    bench.running(1)
    bench.bus.add_unconfigured(serial=5).plug()
    caplog.clear()
    for identifier, data, remote in sent:
        bench.send(identifier, data, remote=remote)
        bench.run(1)
    assert not [record for record in caplog.records if record.exc_info]
    bench.nmt(128, 1)
    bench.take()
    bench.request(1, b"\x80\0\0\0\0\0\0\0")
    assert bench.read(1, 0x1018, 2) == 0x401
