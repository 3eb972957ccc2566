"""Words between daemon and slow half survive the way, and whatever else comes is told from them."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.supervise.link import (
    Alive,
    Calibrate,
    Finding,
    Judged,
    Start,
    Word,
    WordError,
    read_block,
    read_word,
    write_word,
)

from .conftest import Bench

FINDING = Finding(
    kind="stuck contact", cause="gum", evidence="40 s", remedy="wipe", since_ns=5, pad_m=(0.01, 0.02)
)
WORDS: list[Word] = [
    Alive(t_ns=7, word="2 trusted"),
    Calibrate(pad=1, serial=9, name="9-3", gains=(1, 1, 1, 1.1), covariance=(0.0,) * 16, back_n=0.4),
    Judged(pad=0, serial=None, trust="person", calibrating="no number", findings=(FINDING,)),
]


@pytest.mark.parametrize("word", WORDS, ids=lambda word: word.kind)
def test_a_word_survives_the_way(word: Word) -> None:
    assert read_word(write_word(word)) == word


@given(st.binary(max_size=200))
def test_bytes_that_are_no_word_are_told(data: bytes) -> None:
    with pytest.raises(WordError):
        read_word(data)


@given(
    st.sampled_from(WORDS),
    st.sampled_from(["kind", "pad", "serial", "gains", "covariance", "trust", "findings", "t_ns", "extra"]),
    st.none()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.lists(st.floats(), max_size=5)
    | st.text(),
)
def test_a_word_with_any_other_value_is_a_word_or_told(word: Word, key: str, value: Any) -> None:
    record = msgpack.unpackb(write_word(word))
    record[key] = value
    try:
        made = read_word(msgpack.packb(record))
    except WordError:
        return
    assert getattr(made, key) is not None or value is None
    for gain in getattr(made, "gains", ()):
        assert 0.1 <= gain <= 10


def test_a_deployment_and_a_block_survive_the_way(bench: Bench) -> None:
    again = Start.load(bench.start.dump())
    assert again.deployment == bench.deployment
    assert again.nominal == bench.start.nominal
    assert (again.ampere_per_count == bench.start.ampere_per_count).all()
    counts = np.arange(60.0).reshape(5, 3, 4)
    contact = np.arange(15, dtype=np.uint32).reshape(5, 3)
    block = read_block(bench.block(counts, contact, 100), 3)
    assert (block.counts == counts).all()
    assert (block.contact == contact).all()
    assert np.isnan(block.back_n).all()
