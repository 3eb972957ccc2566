"""Which node is which pad's, so far, and what the deployment file is to say of that.

Public name: `Ledger`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from handtouch.canbus.nodes.spec import NodeStatus

from .edit import Edit
from .outcome import Outcome, Result


class Ledger:
    """The slot of each pad, at first as configured; always each slot one pad's.

    `outcomes` of the pads, whose `slot` it sets; `nodes`: what is known of each slot's node at present.
    """

    def __init__(self, outcomes: Sequence[Outcome], nodes: Callable[[], list[NodeStatus]]) -> None:
        self._outcomes, self._nodes = outcomes, nodes
        self._slots = list(range(len(outcomes)))

    def slot(self, row: int) -> int:
        """The node that a pad has, as far as is known."""
        return self._slots[row]

    def row(self, slot: int) -> int:
        """The pad that a node has, as far as is known."""
        return self._slots.index(slot)

    def holder(self, slot: int, row: int) -> str | None:
        """The pad that was found to have this node, now and not in an earlier run, if it is another one."""
        other = self.row(slot)
        known = other != row and self._outcomes[other].slot is not None
        return self._outcomes[other].name if known else None

    def take(self, row: int, slot: int) -> None:
        """A node is this pad's; the pad that had it so far gets the other one's."""
        other = self.row(slot)
        self._slots[other], self._slots[row] = self._slots[row], slot
        self._outcomes[row].slot = slot
        if other != row and self._outcomes[other].result is Result.BEFORE:
            self._outcomes[other].result = Result.LEFT

    def edits(self) -> dict[tuple[str, str], Edit]:
        """What the file is to say of the pads that were found, and of those they swapped with."""
        outcomes = self._outcomes
        rows = [row for row, slot in enumerate(self._slots) if outcomes[row].slot is not None or slot != row]
        found = {row: self.edit(row) for row in rows}
        kept = [row for row in range(len(outcomes)) if row not in found]
        while robbed := self._robbed(kept, found):  # each may need a serial number that another pad has
            found |= {row: self.edit(row) for row in robbed}
            kept = [row for row in kept if row not in found]
        return {(outcomes[row].hand, outcomes[row].pad.link): edit for row, edit in found.items()}

    def edit(self, row: int) -> Edit:
        """A pad with the node that it is known or believed to have."""
        outcome, slot = self._outcomes[row], self._slots[row]
        node = self._outcomes[slot].pad  # as configured, what the slot stands for
        electrodes = outcome.electrodes or outcome.pad.electrodes
        return Edit(node.bus, node.node_id, node.node, self._serial(slot), electrodes)

    def _robbed(self, kept: Sequence[int], found: Mapping[int, Edit]) -> list[int]:
        """Pads whose serial number turned out to be another node's."""
        serials = {edit.serial for edit in found.values()} - {None}
        return [row for row in kept if self._outcomes[row].pad.serial in serials]

    def _serial(self, slot: int) -> int | None:
        """As read from the node; none where it has none, or one that others have too."""
        nodes = self._nodes()
        told = [node.serial for node in nodes]
        if nodes[slot].identity is None:  # never heard: nothing better is known
            configured = self._outcomes[slot].pad.serial
            return None if configured in told else configured
        serial = nodes[slot].serial
        return serial if serial and told.count(serial) == 1 else None
