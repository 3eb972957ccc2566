"""Samples of any layout come out as they went in, and never as a mixture of two SYNCs."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.canbus.bus.slab import PDO_BYTES, PDOS, STANDARD, Field, Layout, Slab, limits

TWO: Layout = (
    Field(0, 0, 32, True),
    Field(0, 32, 32, True),
    Field(1, 0, 32, True),
    Field(1, 32, 32, True),
)


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    """Four fields of 8 to 32 bits at any bit of one to four PDOs, none over another."""
    used = draw(st.integers(1, PDOS))
    pdos = [*range(used), *(draw(st.integers(0, used - 1)) for _ in range(PDOS - used))]
    widths = [draw(st.integers(8, 32)) for _ in range(4)]
    fields, ends = [], dict.fromkeys(range(PDOS), 0)
    for number, (pdo, bits) in enumerate(zip(pdos, widths, strict=True)):
        later = [w for p, w in zip(pdos[number + 1 :], widths[number + 1 :], strict=True) if p == pdo]
        room = 8 * PDO_BYTES - ends[pdo] - sum(later) - bits
        if room < 0:  # narrower, so that all have room
            bits, room = 8, 8 * PDO_BYTES - ends[pdo] - sum(later) - 8
        bit = ends[pdo] + draw(st.integers(0, max(room, 0)))
        ends[pdo] = bit + bits
        fields.append(Field(pdo, bit, bits, draw(st.booleans())))
    first, second, third, fourth = draw(st.permutations(fields))
    return first, second, third, fourth


def frames(layout: Layout, counts: list[int], noise: random.Random) -> dict[int, bytes]:
    """PDOs that carry these counts, among other bits that mean nothing."""
    words = {field.pdo: noise.getrandbits(64) for field in layout}
    for field, count in zip(layout, counts, strict=True):
        mask = (1 << field.bits) - 1
        words[field.pdo] = words[field.pdo] & ~(mask << field.bit) | (count & mask) << field.bit
    return {pdo: word.to_bytes(PDO_BYTES, "little") for pdo, word in words.items()}


def fits(layout: Layout) -> bool:
    return all(field.bit >= 0 and field.bit + field.bits <= 64 for field in layout)


@given(st.data(), layouts().filter(fits), layouts().filter(fits), st.randoms(use_true_random=False))
def test_counts_of_any_layout_come_out_as_they_went_in(
    data: st.DataObject, one: Layout, other: Layout, noise: random.Random
) -> None:
    slab = Slab(3)
    slab.arrange(0, one)
    slab.arrange(2, other)
    for slot, layout in ((0, one), (2, other), (1, STANDARD)):
        counts = [data.draw(st.integers(*field.limits)) for field in layout]
        parts = list(frames(layout, counts, noise).items())
        noise.shuffle(parts)
        for pdo, frame in parts:
            assert slab.t_ns[slot] == 0
            slab.write(slot, frame, 7, pdo)
        assert slab.read()[slot].tolist() == counts
        assert slab.t_ns[slot] == 7
    assert slab.fresh.tolist() == [1, 1, 1]


@given(
    st.lists(
        st.tuples(*[st.sampled_from(["ok", "ok", "ok", "lost", "twice", "late"])] * 3),
        min_size=2,
        max_size=20,
    ),
    st.randoms(use_true_random=False),
)
def test_parts_of_two_syncs_are_never_mixed(fates: list[tuple[str, ...]], order: random.Random) -> None:
    """Lost, twice or late by a period, in any order; only not late after two SYNCs in a row."""
    layout: Layout = (
        Field(0, 0, 16, True),
        Field(1, 8, 24, False),
        Field(2, 0, 32, True),
        Field(2, 32, 8, False),
    )
    slab = Slab(1)
    slab.arrange(0, layout)
    late: list[tuple[int, bytes]] = []
    counted: list[int] = []
    t_ns, whole_before = 0, False
    for sync, drawn in enumerate(fates, 1):
        fate = [("ok" if late and f == "late" else f) for f in drawn]
        t_ns += 10
        slab.begin_cycle(t_ns)
        parts = list(frames(layout, [sync] * 4, order).items())
        own = [p for p in parts for _ in range({"ok": 1, "twice": 2}.get(fate[p[0]], 0))]
        came = own + late
        late = [p for p in parts if fate[p[0]] == "late"]
        order.shuffle(came)
        for number, (pdo, frame) in enumerate(came):
            before = slab.repeats[0] + slab.fresh[0]
            slab.write(0, frame, t_ns + 1 + number % 8, pdo)
            if slab.repeats[0] + slab.fresh[0] != before:
                (counts,) = slab.read().tolist()
                assert counts == [sync] * 4
                counted.append(sync)
        whole = {pdo for pdo, _ in own} == {0, 1, 2}
        if whole and whole_before:
            assert counted[-1] == sync
        whole_before = whole and len(came) == len(own)


def test_part_that_is_missing_at_the_next_sync_costs_two_samples_and_no_more() -> None:
    slab = Slab(1)
    slab.arrange(0, TWO)
    fresh = []
    for sync, parts in enumerate([(0, 1), (0, 1), (0,), (0, 1), (1, 0), (0, 1)]):
        slab.begin_cycle(10 * sync + 10)
        for pdo in parts:
            slab.write(0, bytes([sync]) * 8, 10 * sync + 11, pdo)
        fresh.append(int(slab.fresh[0]))
    assert fresh == [0, 1, 0, 0, 1, 1]  # the first: what was before it isn't known


def test_parts_that_overtake_the_news_of_their_sync_belong_to_it() -> None:
    slab = Slab(1)
    slab.arrange(0, TWO)
    slab.write(0, bytes(8), 1, 0)
    slab.write(0, bytes(8), 1, 1)
    slab.write(0, bytes(8), 12, 1)
    slab.begin_cycle(10)
    assert slab.fresh[0] == 0
    slab.write(0, bytes(8), 13, 0)
    assert (slab.fresh[0], slab.t_ns[0]) == (1, 13)


def test_another_layout_forgets_what_was_there() -> None:
    slab = Slab(1)
    slab.write(0, b"\x01" * 8, 1)
    slab.arrange(0, TWO)
    assert slab.read().tolist() == [[0, 0, 0, 0]]
    slab.write(0, b"\x01" * 8, 2, 0)
    slab.arrange(0, TWO)
    slab.write(0, b"\x01" * 8, 3, 1)
    assert slab.t_ns[0] == 1  # its other half is gone


@pytest.mark.parametrize("bits", [8, 16, 24, 32])
@pytest.mark.parametrize("signed", [True, False])
def test_railed_is_either_end_of_a_signed_channel_and_the_top_of_an_unsigned_one(
    bits: int, signed: bool
) -> None:
    x0, xa, y0, yb = (Field(n // 2, 32 * (n % 2), bits, signed) for n in range(4))
    slab = Slab(2)
    slab.arrange(1, (x0, xa, y0, yb))
    low, high = limits(bits, signed)
    rows = {low: signed, low + 1: signed, low + 2: False, 5: False, high - 1: False, high: True}
    for count, railed in rows.items():
        for pdo, frame in frames((x0, xa, y0, yb), [count] * 4, random.Random(1)).items():
            slab.write(1, frame, 1, pdo)
        found = slab.railed(slab.read())
        assert found.tolist() == [[False] * 4, [railed] * 4], count


def test_read_costs_no_new_array() -> None:
    slab = Slab(2)
    assert slab.read() is slab.read()
    assert slab.read().dtype == np.int64
