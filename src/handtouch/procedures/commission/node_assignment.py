"""Assignment of nodes to pads, and the resulting edits of the deployment file.

Public name: `NodeAssignment`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from handtouch.canbus.nodes.spec import NodeStatus
from handtouch.procedures.commission.deployment_edit import PadEdit
from handtouch.procedures.commission.outcome import PadOutcome, PadResult


class NodeAssignment:
    """One-to-one map of pads (rows) to nodes (slots), initially as configured.

    `outcomes`: of the pads; their `slot` is set here. `nodes`: returns each slot's present node status.
    """

    def __init__(self, outcomes: Sequence[PadOutcome], nodes: Callable[[], list[NodeStatus]]) -> None:
        self._outcomes, self._nodes = outcomes, nodes
        self._slots = list(range(len(outcomes)))

    def slot_of(self, row: int) -> int:
        """Return the slot of a pad, as far as known."""
        return self._slots[row]

    def row_of(self, slot: int) -> int:
        """Return the pad of a slot, as far as known."""
        return self._slots.index(slot)

    def confirmed_owner(self, slot: int, row: int) -> str | None:
        """Return the name of another pad that was found at this slot in this session."""
        other = self.row_of(slot)
        known = other != row and self._outcomes[other].slot is not None
        return self._outcomes[other].name if known else None

    def assign_node(self, row: int, slot: int) -> None:
        """Assign a node to a pad; the pad that had it so far gets this pad's former node."""
        other = self.row_of(slot)
        self._slots[other], self._slots[row] = self._slots[row], slot
        self._outcomes[row].slot = slot
        if other != row and self._outcomes[other].result is PadResult.DONE_BEFORE:
            self._outcomes[other].result = PadResult.NOT_DONE

    def pad_edits(self) -> dict[tuple[str, str], PadEdit]:
        """Return the edits of the pads that were found, and of those swapped with them."""
        outcomes = self._outcomes
        rows = [row for row, slot in enumerate(self._slots) if outcomes[row].slot is not None or slot != row]
        found = {row: self.pad_edit(row) for row in rows}
        kept = [row for row in range(len(outcomes)) if row not in found]
        while moved := self._rows_with_moved_serial(kept, found):  # serial numbers must stay unique
            found |= {row: self.pad_edit(row) for row in moved}
            kept = [row for row in kept if row not in found]
        return {(outcomes[row].hand, outcomes[row].pad.link): edit for row, edit in found.items()}

    def pad_edit(self, row: int) -> PadEdit:
        """Return the edit of one pad."""
        outcome, slot = self._outcomes[row], self._slots[row]
        node = self._outcomes[slot].pad  # the slot's node, as configured
        electrodes = outcome.electrodes or outcome.pad.electrodes
        return PadEdit(node.bus, node.node_id, node.node, self._serial_of(slot), electrodes)

    def _rows_with_moved_serial(self, kept: Sequence[int], found: Mapping[int, PadEdit]) -> list[int]:
        """Return the rows whose configured serial number belongs to a node of another pad."""
        serials = {edit.serial for edit in found.values()} - {None}
        return [row for row in kept if self._outcomes[row].pad.serial in serials]

    def _serial_of(self, slot: int) -> int | None:
        """Return the serial number read from a node; None if it has none or shares it with others."""
        nodes = self._nodes()
        serials = [node.serial for node in nodes]
        if nodes[slot].identity is None:  # never responded
            configured = self._outcomes[slot].pad.serial
            return None if configured in serials else configured
        serial = nodes[slot].serial
        return serial if serial and serials.count(serial) == 1 else None
