"""The hand frame encoder and the wire codec encode the same frame, for any content."""

from __future__ import annotations

from dataclasses import MISSING, fields

import msgpack
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from handtouch import wire
from handtouch.core.tick_messages import HandFrameEncoder

LINKS = ("palm", "thumb_distal", "index_distal")
COLUMNS = wire.COLUMNS[wire.HandFrame]
OPTIONAL = ("group", "palm_status", "palm_position_m", "base_covariance_m2", "joints_age_s")
ALWAYS = [
    field.name for field in fields(wire.HandFrame) if field.name in COLUMNS and field.default is MISSING
]
counts = st.integers(0, 2**40)


def column(name: str, seed: int) -> bytes:
    return np.random.default_rng(seed).bytes(len(LINKS) * COLUMNS[name].row_bytes)


@given(
    st.lists(
        st.tuples(counts, st.integers(0, 2**62), counts, st.booleans(), st.sets(st.sampled_from(OPTIONAL))),
        min_size=1,
        max_size=4,
    ),
    st.integers(0, 2**32),
)
def test_encoded_frames_equal_those_of_the_codec(
    frames: list[tuple[int, int, int, bool, set[str]]], seed: int
) -> None:
    sources = {
        name: np.frombuffer(bytearray(column(name, seed)), COLUMNS[name].dtype).reshape(len(LINKS), -1)
        for name in ALWAYS
    }
    encoder = HandFrameEncoder(7, "right", LINKS, sources)
    for step, (seq, t_ns, tick, retained, given_names) in enumerate(frames):
        for name, source in sources.items():
            source[:] = np.frombuffer(column(name, seed + step), source.dtype).reshape(source.shape)
        optional = {name: column(name, seed + step) for name in OPTIONAL if name in given_names}
        packed = encoder.encode(seq, t_ns, tick, retained, optional)
        frame = wire.HandFrame(
            wire.SCHEMA_VERSION, 7, seq, t_ns, tick, "right", LINKS,
            **{name: source.tobytes() for name, source in sources.items()}, **optional, retained=retained,
        )  # fmt: skip
        assert wire.decode(wire.encode(packed)) == frame
        sent = msgpack.unpackb(wire.encode(frame)[1])
        assert list(msgpack.unpackb(packed.payload).items()) == list(sent.items())
