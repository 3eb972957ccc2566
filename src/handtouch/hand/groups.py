"""Which contacts of a hand one object may bridge: those that lie close together and don't face each other.

Public names: `Groups`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_APART = 1.25
"""Of the distance that joins two contacts: what parts them, so that groups don't flicker."""
_FACING = -0.5
"""Cosine of the angle between outward normals, 120 degrees: beyond it two pads grip something."""


class Groups:
    """Groups of the contacts on n pads; `within_m` (n,) apart joins two of one `hand` (n,), by number.

    `id` (n,) uint32: of a group, the contact id of one that is or was in it; of a contact by itself, its own;
    0 without contact. A group keeps its id as long as anything of it is left; where it falls apart, the part
    with the contact that gave the id keeps it, else the one with the oldest contact.
    """

    def __init__(self, within_m: FloatArray, hand: NDArray[np.intp]) -> None:
        n = len(hand)
        self.id = np.zeros(n, dtype=np.uint32)
        self._within2, self._hand = within_m**2, hand
        self._joined = np.zeros((n, n), dtype=np.bool_)
        self._contact = np.zeros(n, dtype=np.uint32)

    def step(self, contact: NDArray[np.uint32], position_m: FloatArray, normal: FloatArray) -> None:
        """Contact ids (n,), 0 for none; places and normals (n, 3) in the hand's frame, NaN if not known.

        Two contacts of which one isn't known stay joined, or apart, as they were.
        """
        new = np.flatnonzero(contact != self._contact)
        if len(new):
            self._joined[new] = self._joined[:, new] = False
            self.id[new] = contact[new]
            self._contact[new] = contact[new]
        here = np.flatnonzero(contact)
        if len(here) > 1:
            self._join(here, position_m[here], normal[here], changed=len(new) > 0)

    def _join(
        self, here: NDArray[np.intp], position_m: FloatArray, normal: FloatArray, changed: bool
    ) -> None:
        before = self._joined.take(here, axis=0).take(here, axis=1)
        apart = position_m[:, None] - position_m
        distance2 = np.einsum("ijk,ijk->ij", apart, apart)
        limit2 = self._within2.take(here) * np.where(before, _APART**2, 1.0)
        near = (distance2 <= limit2) & (normal @ normal.T >= _FACING)
        hand = self._hand.take(here)
        near &= hand[:, None] == hand
        joined = np.where(np.isnan(distance2), before, near)
        joined.flat[:: len(here) + 1] = False
        if changed or np.count_nonzero(joined != before):
            self._joined[np.ix_(here, here)] = joined
            self._name(here, joined)

    def _name(self, here: NDArray[np.intp], joined: NDArray[np.bool_]) -> None:
        ids, contacts = self.id[here], self._contact[here]
        parts = _parts(joined)
        taken: set[int] = set()
        # a part that has the contact which gave a group its name is first to choose, then the oldest
        for part in sorted(parts, key=lambda p: (not (ids[p] == contacts[p]).any(), contacts[p].min())):
            free = [name for name in ids[part].tolist() if name not in taken]
            name = min(free or contacts[part].tolist())
            taken.add(name)
            self.id[here[part]] = name


def _parts(joined: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Numbers of the nodes of each connected part of a graph (k, k)."""
    reach = joined | np.eye(len(joined), dtype=np.bool_)
    for _ in range(len(joined).bit_length()):
        reach = reach @ reach
    firsts = np.unique(reach.argmax(axis=1))
    return [np.flatnonzero(reach[first]) for first in firsts]
