"""Groups of contacts that one object may bridge: close together, and not facing each other.

Public name: `ContactGroups`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.core.memory import view_memory
from handtouch.core.stages.groups import ContactPairs
from handtouch.core.state import TickState

FloatArray = NDArray[np.float64]


class ContactGroups:
    """Groups of the contacts on n pads where palm or base is requested, by their positions and normals in the
    palm, all in `held`; contacts of one `hand` (n,) within `within_m` (n,) are joined.

    `group_id` (n,) uint32: the contact id of one that is or was in the group; a single contact's own id; 0
    without contact. A group keeps its id as long as any of it remains; if it splits, the component with the
    contact that gave the id keeps it, else the one with the oldest contact.
    """

    def __init__(self, within_m: FloatArray, hand: NDArray[np.intp], held: TickState) -> None:
        self.group_id = held.group_id
        self._contact_id, self._joined = held.grouped_contact_id, held.grouped
        self._pairs = ContactPairs(held.memory, view_memory(within_m**2), view_memory(hand))

    def update_groups(self) -> None:
        """Update the groups. Two contacts, one of which is unknown, stay joined or separate as before."""
        if self._pairs.update_pairs():
            self._assign_group_ids()

    def _assign_group_ids(self) -> None:
        here = np.flatnonzero(self._contact_id)
        ids, contacts = self.group_id[here], self._contact_id[here]
        components = _connected_components(self._joined[np.ix_(here, here)])
        taken: set[int] = set()
        given = set(contacts.tolist())
        # the component with the contact that gave the id chooses first, then the oldest
        for component in sorted(
            components, key=lambda p: (not (ids[p] == contacts[p]).any(), contacts[p].min())
        ):
            own = contacts[component].tolist()
            reserved = taken | (given - set(own))  # another component may need the id of its own contact
            new_id = min([i for i in ids[component].tolist() if i not in reserved] or own)
            taken.add(new_id)
            self.group_id[here[component]] = new_id


def _connected_components(joined: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the node numbers of each connected component of a graph (k, k)."""
    reach = joined | np.eye(len(joined), dtype=np.bool_)
    for _ in range(len(joined).bit_length()):
        reach = reach @ reach
    firsts = np.unique(reach.argmax(axis=1))
    return [np.flatnonzero(reach[first]) for first in firsts]
