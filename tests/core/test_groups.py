"""Contacts that one object may bridge form a group with a lasting id."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch.core.memory import view_rows
from handtouch.core.stages.groups import ContactGroups
from handtouch.core.stages.rows import CONTACT_FRAMES
from handtouch.core.state import TickState

UP = np.array([0.0, 0.0, 1.0])


class Contacts:
    """Contacts on n pads, all of which are requested in the palm; groups are joined up to 20 mm."""

    def __init__(self, n: int = 4, hand: tuple[int, ...] | None = None) -> None:
        self.state = TickState.empty(n)
        self.state.palm_requested[:] = True
        palm: Any = view_rows(self.state.palm_values, CONTACT_FRAMES)["palm"]
        self.groups = ContactGroups(np.full(n, 0.02), np.array(hand or [0] * n), self.state, palm)


def step(
    made: Contacts, ids: list[int], x_m: list[float], normals: list[NDArray[np.float64]] | None = None
) -> list[int]:
    made.state.contact_id[:] = ids
    made.state.palm_values[:, :3] = np.stack([[x, 0.0, 0.0] for x in x_m])
    made.state.palm_values[:, 3:6] = np.stack(normals or [UP] * len(ids))
    made.groups.update_groups()
    return list(map(int, made.state.group_id))


def test_near_contacts_form_a_group() -> None:
    assert step(Contacts(), [5, 7, 0, 9], [0.0, 0.015, np.nan, 0.1]) == [5, 5, 0, 9]


def test_chain_of_contacts_is_one_group() -> None:
    assert step(Contacts(), [5, 7, 8, 9], [0.0, 0.015, 0.03, 0.045]) == [5] * 4


def test_facing_pads_are_separate_groups() -> None:
    assert step(Contacts(2), [5, 7], [0.0, 0.005], [UP, -UP]) == [5, 7]


def test_groups_do_not_span_hands() -> None:
    assert step(Contacts(2, (0, 1)), [5, 7], [0.0, 0.0]) == [5, 7]


def test_group_keeps_its_id_when_the_contact_that_gave_it_ends() -> None:
    made = Contacts(3)
    assert step(made, [5, 7, 8], [0.0, 0.015, 0.03]) == [5, 5, 5]
    assert step(made, [0, 7, 8], [np.nan, 0.015, 0.03]) == [0, 5, 5]
    assert step(made, [9, 7, 8], [0.1, 0.015, 0.03]) == [9, 5, 5]


def test_split_groups_have_two_ids_and_joined_ones_one() -> None:
    made = Contacts(2)
    assert step(made, [5, 7], [0.0, 0.015]) == [5, 5]
    assert step(made, [5, 7], [0.0, 0.024]) == [5, 5]  # joined until a quarter farther
    assert step(made, [5, 7], [0.0, 0.03]) == [5, 7]
    assert step(made, [5, 7], [0.0, 0.024]) == [5, 7]
    assert step(made, [5, 7], [0.0, 0.01]) == [5, 5]


def test_end_of_a_connecting_contact_splits_the_group() -> None:
    made = Contacts(3)
    assert step(made, [5, 6, 7], [0.0, 0.018, 0.036]) == [5, 5, 5]
    assert step(made, [5, 0, 7], [0.0, np.nan, 0.036]) == [5, 0, 7]


def test_unknown_positions_leave_groups_unchanged() -> None:
    made = Contacts(2)
    step(made, [5, 7], [0.0, 0.015])
    assert step(made, [5, 7], [np.nan, np.nan]) == [5, 5]


@given(st.lists(st.lists(st.tuples(st.booleans(), st.floats(0, 0.1)), min_size=5, max_size=5), max_size=8))
def test_separate_groups_never_share_an_id(story: list[list[tuple[bool, float]]]) -> None:
    made, ids, following = Contacts(5), [0] * 5, 1
    for moment in story:
        for pad, (touching, _) in enumerate(moment):
            if touching and not ids[pad]:
                ids[pad], following = following, following + 1
            elif not touching:
                ids[pad] = 0
        x = [at if number else np.nan for number, (_, at) in zip(ids, moment, strict=True)]
        named = step(made, ids, x)
        order = sorted((at, name) for at, name, number in zip(x, named, ids, strict=True) if number)
        assert all(name for _, name in order)
        assert not any(named[pad] for pad in range(5) if not ids[pad])
        for (left, one), (right, two) in itertools.pairwise(order):
            assert one == two or right - left > 0.02
            assert one != two or right - left <= 0.025 + 1e-12
