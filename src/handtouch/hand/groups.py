"""Groups of contacts that one object may bridge: close together, and not facing each other.

Public names: `ContactGroups`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_SPLIT_DISTANCE_RATIO = 1.25
"""Distance that splits two contacts over the distance that joins them: hysteresis against flicker."""
_MIN_NORMAL_COSINE = -0.5
"""Cosine of the angle between outward normals, 120 degrees: beyond it two pads grip an object."""


class ContactGroups:
    """Groups of the contacts on n pads; contacts of one `hand` (n,) within `within_m` (n,) are joined.

    `group_id` (n,) uint32: the contact id of one that is or was in the group; a single contact's own id; 0
    without contact. A group keeps its id as long as any of it remains; if it splits, the component with the
    contact that gave the id keeps it, else the one with the oldest contact.
    """

    def __init__(
        self,
        within_m: FloatArray,
        hand: NDArray[np.intp],
        group_id: NDArray[np.uint32] | None = None,
        contact_id: NDArray[np.uint32] | None = None,
        joined: NDArray[np.bool_] | None = None,
    ) -> None:
        """Use these arrays (n,), (n,), (n, n) of zeros for the state, if given."""
        n = len(hand)
        none: NDArray[np.uint32] = np.zeros(n, dtype=np.uint32)
        self.group_id: NDArray[np.uint32] = none if group_id is None else group_id
        self._contact_id = none.copy() if contact_id is None else contact_id
        self._joined = np.zeros((n, n), dtype=np.bool_) if joined is None else joined
        self._join_distance2, self._hand = within_m**2, hand

    def update_groups(self, contact: NDArray[np.uint32], position_m: FloatArray, normal: FloatArray) -> None:
        """Update the groups from contact ids (n,), 0 for none, and positions and normals (n, 3).

        In the hand's frame, NaN if unknown. Two contacts, one of which is unknown, stay joined or separate as
        before.
        """
        new = np.flatnonzero(contact != self._contact_id)
        if len(new):
            self._joined[new] = self._joined[:, new] = False
            self.group_id[new] = contact[new]
            self._contact_id[new] = contact[new]
        here = np.flatnonzero(contact)
        if len(here) > 1:
            self._update_joined(here, position_m[here], normal[here], changed=len(new) > 0)

    def _update_joined(
        self, here: NDArray[np.intp], position_m: FloatArray, normal: FloatArray, changed: bool
    ) -> None:
        before = self._joined.take(here, axis=0).take(here, axis=1)
        apart = position_m[:, None] - position_m
        distance2 = np.einsum("ijk,ijk->ij", apart, apart)
        limit2 = self._join_distance2.take(here) * np.where(before, _SPLIT_DISTANCE_RATIO**2, 1.0)
        near = (distance2 <= limit2) & (normal @ normal.T >= _MIN_NORMAL_COSINE)
        hand = self._hand.take(here)
        near &= hand[:, None] == hand
        joined = np.where(np.isnan(distance2), before, near)
        joined.flat[:: len(here) + 1] = False
        if changed or np.count_nonzero(joined != before):
            self._joined[np.ix_(here, here)] = joined
            self._assign_group_ids(here, joined)

    def _assign_group_ids(self, here: NDArray[np.intp], joined: NDArray[np.bool_]) -> None:
        ids, contacts = self.group_id[here], self._contact_id[here]
        components = _connected_components(joined)
        taken: set[int] = set()
        # the component with the contact that gave the id chooses first, then the oldest
        for component in sorted(
            components, key=lambda p: (not (ids[p] == contacts[p]).any(), contacts[p].min())
        ):
            free = [new_id for new_id in ids[component].tolist() if new_id not in taken]
            new_id = min(free or contacts[component].tolist())
            taken.add(new_id)
            self.group_id[here[component]] = new_id


def _connected_components(joined: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the node numbers of each connected component of a graph (k, k)."""
    reach = joined | np.eye(len(joined), dtype=np.bool_)
    for _ in range(len(joined).bit_length()):
        reach = reach @ reach
    firsts = np.unique(reach.argmax(axis=1))
    return [np.flatnonzero(reach[first]) for first in firsts]
