"""Diagnosis of a contact law that force references contradict.

Public name: `LawReport`.
"""

from __future__ import annotations

import math

from handtouch.core.sheet_force import SheetForceCompensation
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

MIN_CONTACTS = 3
"""Contacts in succession whose references are refused, each more than four standard deviations off: once in
1e12 by errors that are normal, once in 1e6 where one in a hundred is so far off."""
_CONFIDENCE = 0.99


class LawReport:
    """Diagnoses of n pads whose forces references contradict."""

    def __init__(self, pads: int) -> None:
        self._since_ns: list[int | None] = [None] * pads

    def update(self, sheets: SheetForceCompensation, pad: int, now_ns: int) -> Diagnosis | None:
        """Return a pad's diagnosis, None if references don't contradict its forces."""
        contacts = int(sheets.refused_contacts[pad])
        if contacts < MIN_CONTACTS:
            self._since_ns[pad] = None
            return None
        since_ns = self._since_ns[pad] or now_ns
        self._since_ns[pad] = since_ns
        ratio = math.exp(float(sheets.refused_log_ratio[pad]))
        return Diagnosis(
            kind=FaultKind.SHEET_REPLACED,
            cause="another contact law than the stated or calibrated one, as of another sheet, or force "
            "references that aren't of this pad",
            evidence=f"force references of {contacts} contacts in succession were refused, the last was "
            f"{ratio:.2g} times the pad's force",
            remedy="after a new sheet, `handtouch calibrate PAD --new-sheet`; measure its law by weights; if "
            "the sheet is the same, check what sends the references",
            since_ns=since_ns,
            confidence=_CONFIDENCE,
        )
