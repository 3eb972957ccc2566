"""Pairs of contacts that one object may bridge: close together on one hand, and not facing each other."""

from __future__ import annotations

from typing import Any

from handtouch.core.stages.frames import FRAME_VALUES

_ROW = 2 * FRAME_VALUES + 1
_SPLIT_DISTANCE2_RATIO = 1.25 * 1.25
"""Squared distance that splits two contacts over that which joins them: hysteresis against flicker."""
_MIN_NORMAL_COSINE = -0.5
"""Cosine of the angle between outward normals, 120 degrees: beyond it two pads grip an object."""
_INFINITY = float("inf")


class ContactPairs:
    """Pairs of contacts on n pads. arrays: flat memory of the arrays of `TickState` by their names.

    within2: (n,) squared distance [m^2] up to which contacts are joined. hands: (n,) number of each pad's
    hand, whose pads are one behind another.
    """

    def __init__(
        self, arrays: dict[str, memoryview[Any]], within2: memoryview[float], hands: memoryview[int]
    ) -> None:
        self.pads, self.within2, self.hands = len(hands), within2, hands
        self.palm_requested, self.base_requested = arrays["palm_requested"], arrays["base_requested"]
        self.contact_id, self.frame_values = arrays["contact_id"], arrays["palm_values"]
        self.group_id, self.grouped_contact_id = arrays["group_id"], arrays["grouped_contact_id"]
        self.joined = arrays["grouped"]

    def update_pairs(self) -> bool:
        """Update which contacts are joined, new ones with none; return True if a pair or a contact of several
        is another."""
        changed, contacts = False, 0
        for pad in range(self.pads):
            contact = self.contact_id[pad]
            if not (self.palm_requested[pad] or self.base_requested[pad]):
                contact = 0
            if contact != self.grouped_contact_id[pad]:
                changed = True
                self.group_id[pad] = self.grouped_contact_id[pad] = contact
                for other in range(self.pads):
                    self.joined[pad * self.pads + other] = self.joined[other * self.pads + pad] = 0
            if contact:
                contacts += 1
        if contacts < 2:
            return False
        for pad in range(self.pads):
            if self.grouped_contact_id[pad] and _update_pairs_of(self, pad):
                changed = True
        return changed


def _update_pairs_of(pairs: ContactPairs, pad: int) -> bool:
    """Update a contact's pairs with those on later pads; return True if one has changed. Two contacts, one of
    which is at an unknown position, stay joined or separate."""
    changed, at, values = False, pad * _ROW, pairs.frame_values
    for other in range(pad + 1, pairs.pads):
        if pairs.hands[other] != pairs.hands[pad]:
            break
        if not pairs.grouped_contact_id[other]:
            continue
        distance2 = cosine = 0.0
        for i in range(3):
            apart = values[at + i] - values[other * _ROW + i]
            distance2 += apart * apart
            cosine += values[at + 3 + i] * values[other * _ROW + 3 + i]
        if not distance2 < _INFINITY:
            continue
        before = pairs.joined[pad * pairs.pads + other]
        limit2 = pairs.within2[pad] * (_SPLIT_DISTANCE2_RATIO if before else 1.0)
        near = 1 if distance2 <= limit2 and cosine >= _MIN_NORMAL_COSINE else 0
        if near != before:
            changed = True
            pairs.joined[pad * pairs.pads + other] = pairs.joined[other * pairs.pads + pad] = near
    return changed
