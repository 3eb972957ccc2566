"""The deployment file during commissioning, and beside it a list of the pads that are done.

Public name: `CommissioningRecord`.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path

from handtouch import config
from handtouch.procedures.commission.deployment_edit import apply_edits, edit_text, write_atomically
from handtouch.procedures.commission.outcome import PadResult
from handtouch.procedures.commission.procedure import CommissioningProcedure


class CommissioningRecord:
    """Writes results to the deployment file `path` and keeps the progress, so that it can be resumed.

    `original` and `text`: contents of the file before, and with the results. `dry_run`: write nothing.
    """

    def __init__(self, path: Path, dry_run: bool) -> None:
        self.path, self.dry_run = path, dry_run
        self.backup = path.with_name(f"{path.name}.bak")
        self.original = _read_text(path)
        self.text = self.original
        self._progress_file = path.with_name(f"{path.name}.commissioned")

    def restore_progress(self, procedure: CommissioningProcedure, repeat: Collection[int]) -> int:
        """Mark the pads done in an earlier session, but for the rows to repeat, and return their number."""
        try:
            done = set(self._progress_file.read_text(encoding="utf-8").split())
        except OSError:
            return 0
        for row, outcome in enumerate(procedure.outcomes):
            if outcome.name in done and row not in repeat:
                outcome.result = PadResult.DONE_BEFORE
        return sum(outcome.result is PadResult.DONE_BEFORE for outcome in procedure.outcomes)

    def save(self, procedure: CommissioningProcedure) -> None:
        """Write the results so far. Raises OSError; ValueError or KeyError if the file can't be edited."""
        text = _read_text(self.path)  # read again: it may have been edited meanwhile
        edits = procedure.assignment.pad_edits()
        new = edit_text(text, edits)
        before = config.parse(text, str(self.path), self.path.parent)
        if config.parse(new, str(self.path), self.path.parent) != apply_edits(before, edits):
            raise ValueError(f"{self.path}: the results can't be entered in this file; enter them by hand")
        self.text = new
        if self.dry_run:
            return
        if new != text:
            if text == self.original and not self._progress_file.exists():
                shutil.copy2(self.path, self.backup)
            write_atomically(self.path, new)
        done = [outcome.name for outcome in procedure.outcomes if outcome.ok]
        if len(done) == len(procedure.outcomes):
            self._progress_file.unlink(missing_ok=True)
        elif done:
            write_atomically(self._progress_file, "\n".join(done) + "\n")


def _read_text(path: Path) -> str:
    """Read a file with its line ends unchanged."""
    return path.read_bytes().decode("utf-8")
