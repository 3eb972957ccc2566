"""Groups of contacts that one object may bridge: close together on one hand, and not facing each other.

Public name: `ContactGroups`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from handtouch.core.memory import RowArray, view_memory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from handtouch.arrays import FloatArray
    from handtouch.core.state import TickState


_SPLIT_DISTANCE2_RATIO = 1.25 * 1.25
"""Squared distance that splits two contacts over that which joins them: hysteresis against flicker."""
_MIN_NORMAL_COSINE = -0.5
"""Cosine of the angle between outward normals, 120 degrees: beyond it two pads grip an object."""
_INFINITY = float("inf")


class ContactGroups:
    """Groups of the contacts on n pads where palm or base is requested, all in `state`; contacts of one hand
    within `within_m` (n,) are joined by their positions and normals in the palm, `palm` (n,) FRAME_ROWs.

    hands: (n,) number of each pad's hand, whose pads are one behind another. `group_id` (n,) uint32 of the
    state: the contact id of one that is or was in the group; a single contact's own id; 0 without contact. A
    group keeps its id as long as any of it remains; if it splits, the component with the contact that gave
    the id keeps it, else the one with the oldest contact.
    """

    def __init__(
        self, within_m: FloatArray, hands: NDArray[np.intp], state: TickState, palm: RowArray
    ) -> None:
        self.held, self.palm = state, palm
        self.pads, self.within2, self.hands = len(hands), view_memory(within_m**2), view_memory(hands)
        memory = state.memory
        self.palm_requested, self.base_requested = memory["palm_requested"], memory["base_requested"]
        self.contact_id, self.group_id = memory["contact_id"], memory["group_id"]
        self.grouped_contact_id, self.joined = memory["grouped_contact_id"], memory["grouped"]

    def update_groups(self) -> None:
        """Update the groups. Two contacts, one of which is unknown, stay joined or separate as before."""
        if _update_pairs(self):
            self.assign_group_ids()

    def assign_group_ids(self) -> None:
        """Set the id of each group of joined contacts."""
        held = self.held
        here = np.flatnonzero(held.grouped_contact_id)
        ids, contacts = held.group_id[here], held.grouped_contact_id[here]
        components = _connected_components(held.grouped[np.ix_(here, here)])
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
            held.group_id[here[component]] = new_id


def _connected_components(joined: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the node numbers of each connected component of a graph (k, k)."""
    reach = joined | np.eye(len(joined), dtype=np.bool_)
    for _ in range(len(joined).bit_length()):
        reach = reach @ reach
    firsts = np.unique(reach.argmax(axis=1))
    return [np.flatnonzero(reach[first]) for first in firsts]


def _update_pairs(groups: ContactGroups) -> bool:
    """Update which contacts are joined, new ones with none; return True if a pair or a contact of several is
    another."""
    changed, contacts = False, 0
    for pad in range(groups.pads):
        contact = groups.contact_id[pad]
        if not (groups.palm_requested[pad] or groups.base_requested[pad]):
            contact = 0
        if contact != groups.grouped_contact_id[pad]:
            changed = True
            groups.group_id[pad] = groups.grouped_contact_id[pad] = contact
            for other in range(groups.pads):
                groups.joined[pad * groups.pads + other] = groups.joined[other * groups.pads + pad] = 0
        if contact:
            contacts += 1
    if contacts < 2:
        return False
    for pad in range(groups.pads):
        if groups.grouped_contact_id[pad] and _update_pairs_of(groups, pad):
            changed = True
    return changed


def _update_pairs_of(groups: ContactGroups, pad: int) -> bool:
    """Update a contact's pairs with those on later pads; return True if one has changed. Two contacts, one of
    which is at an unknown position, stay joined or separate."""
    changed = False
    for other in range(pad + 1, groups.pads):
        if groups.hands[other] != groups.hands[pad]:
            break
        if not groups.grouped_contact_id[other]:
            continue
        distance2 = cosine = 0.0
        for i in range(3):
            apart = groups.palm[pad].position_m[i] - groups.palm[other].position_m[i]
            distance2 += apart * apart
            cosine += groups.palm[pad].normal[i] * groups.palm[other].normal[i]
        if not distance2 < _INFINITY:
            continue
        before = groups.joined[pad * groups.pads + other]
        limit2 = groups.within2[pad] * (_SPLIT_DISTANCE2_RATIO if before else 1.0)
        near = 1 if distance2 <= limit2 and cosine >= _MIN_NORMAL_COSINE else 0
        if near != before:
            changed = True
            groups.joined[pad * groups.pads + other] = groups.joined[other * groups.pads + pad] = near
    return changed
