"""Access to the calibration store that survives its faults: failures are logged, the store reopened later.

Public: `StoreClient`, `MountingPoint`. Without a store, nodes are calibrated all the same, and not stored.
"""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TypeVar

import handtouch
from handtouch.calibration.calibration import (
    Calibration,
    CalibrationVersion,
    Gains,
    MismatchError,
    Offsets,
    Provenance,
    StoredSheetState,
    check_match,
)
from handtouch.calibration.store import DamagedStoreError, Store, StoreError

_log = logging.getLogger("handtouch.supervisor")
_RETRY_PERIOD = timedelta(seconds=60)
Result = TypeVar("Result")


@dataclass(frozen=True)
class MountingPoint:
    """Position of a node: hand, link, and identifier of the deployment file's own calibration there."""

    hand: str
    link: str
    config: str


class StoreClient:
    """The store at a path, opened on first use. error: problem and remedy; empty without one."""

    def __init__(self, path: Path) -> None:
        self.error = ""
        self._path = path
        self._store: Store | None = None
        self._retry_at: datetime | None = None

    def close(self) -> None:
        """Close the store."""
        if self._store is not None:
            self._store.close()
        self._store = None

    def changed(self, now: datetime) -> bool:
        """Return whether other processes may have written since the last call, or since reopening."""
        return self._try(lambda store: store.changed(), False, now)

    def newest_applicable(
        self, serial: int, mounting_point: MountingPoint, now: datetime
    ) -> tuple[CalibrationVersion | None, str]:
        """Return the newest calibration of a node that may be applied, or the reason why it is refused.

        Another node's calibration that an operator took over may be applied; its provenance states it.
        """
        version = self._try(lambda store: store.newest(serial, mounting_point.config), None, now)
        if version is None:
            return None, ""
        taken_over = replace(version, provenance=replace(version.provenance, foreign=""))
        try:
            check_match(taken_over, serial, mounting_point.config)
        except MismatchError as error:
            return None, str(error)
        return version, ""

    def last_serial_at(self, mounting_point: MountingPoint, now: datetime) -> int | None:
        """Return the serial number of the node that was calibrated at this position last, if any."""
        newest: list[CalibrationVersion] = self._try(lambda store: store.newest_of_all(), [], now)
        position = (mounting_point.hand, mounting_point.link)
        here = [one for one in newest if (one.provenance.hand, one.provenance.link) == position]
        return max(here, key=lambda version: version.written_utc).serial if here else None

    def store_parts(
        self,
        serial: int,
        mounting_point: MountingPoint,
        provenance: Provenance,
        now: datetime,
        *,
        gains: Gains | None = None,
        offsets: Offsets | None = None,
        sheet: StoredSheetState | None = None,
    ) -> CalibrationVersion | None:
        """Store new parts of a calibration with the rest of the newest one; None if that fails."""
        before, _ = self.newest_applicable(serial, mounting_point, now)
        known = before.calibration if before else Calibration()
        keeps_foreign = known.law or known.second_law or (known.gains and gains is None)
        calibration = replace(
            known, gains=gains or known.gains, offsets=offsets or known.offsets, sheet=sheet or known.sheet
        )
        origin = replace(
            provenance,
            hand=mounting_point.hand,
            link=mounting_point.link,
            host=platform.node(),
            program=f"handtouch {handtouch.__version__}",
            foreign=before.provenance.foreign if before and keeps_foreign else "",
        )
        return self._try(
            lambda store: store.write(serial, mounting_point.config, calibration, origin, now), None, now
        )

    def _try(self, action: Callable[[Store], Result], default: Result, now: datetime) -> Result:
        """Return what the action does with the open store; the default without a store or after an error."""
        try:
            if self._store is None:
                if self._retry_at is not None and now < self._retry_at:
                    return default
                self._store, self.error = self._open()
            return action(self._store)
        except (StoreError, OSError, ValueError) as error:
            self.error, self._retry_at = str(error), now + _RETRY_PERIOD
            _log.error("calibration store: %s; retried in %d s", error, _RETRY_PERIOD.total_seconds())
            self.close()
            return default

    def _open(self) -> tuple[Store, str]:
        """Return the store, and a problem that leaves it usable."""
        try:
            return Store(self._path), self._write_problem()
        except DamagedStoreError as damage:
            _log.error("%s", damage)
            return Store(self._path), str(damage)  # a new one; the damaged file was moved aside

    def _write_problem(self) -> str:
        """Return why the store or its folder, for the journal, can't be written; empty if they can."""
        for path in (self._path, self._path.absolute().parent):
            if not os.access(path, os.W_OK):
                problem = (
                    f"{path} can't be written by user {os.geteuid()}: calibrations are read, but new ones "
                    "are not kept; change its owner or mode, or the file system's"
                )
                _log.error("calibration store: %s", problem)
                return problem
        return ""
