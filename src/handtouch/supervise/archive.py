"""The calibration store as the slow half uses it: what can't be kept is told, and the work goes on.

Public: `Archive`. Its store is opened when it is first needed, and again after a while where that failed.
"""

from __future__ import annotations

import logging
import platform
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import handtouch
from handtouch.supervise.calibration import (
    Calibration,
    Gains,
    MismatchError,
    Offsets,
    Provenance,
    SheetState,
    Version,
    fit,
)
from handtouch.supervise.store import DamagedStore, Store, StoreError

_log = logging.getLogger("handtouch.supervise")
_AGAIN = timedelta(seconds=60)
_DRIFT_PER_DAY = 1e-3
"""Standard deviation of a log gain's random walk, after a day."""
_FROM_UNIT_TO_UNIT = 0.05
"""Standard deviation of a log gain, from one unit to another."""


@dataclass(frozen=True)
class Place:
    """Where a unit sits: hand, link, and the name of the calibration that the deployment file is there."""

    hand: str
    link: str
    config: str


class Archive:
    """The store at a path. trouble: what is wrong with it, in words with a remedy; empty if nothing is."""

    def __init__(self, path: Path) -> None:
        self.trouble = ""
        self._path = path
        self._store: Store | None = None
        self._again: datetime | None = None
        self._damage = ""
        self._news = False

    def close(self) -> None:
        """Close the store."""
        if self._store is not None:
            self._store.close()
        self._store = None

    def changed(self, now: datetime) -> bool:
        """Whether others may have stored anything since the last call: by a guided session, say."""
        store = self._opened(now)
        if store is None:
            return False
        news, self._news = self._news, False
        try:
            return store.changed() or news
        except StoreError as error:
            self._fail(error, now)
            return False

    def own(self, serial: int, place: Place, now: datetime) -> tuple[Version | None, str]:
        """The newest calibration of a unit that may be applied in this place, and why one is refused.

        Another unit's that a person took over expressly may be; its provenance says so.
        """
        store = self._opened(now)
        if store is None:
            return None, ""
        try:
            version = store.newest(serial, place.config)
            if version is None:
                return None, ""
            taken_over = replace(version, provenance=replace(version.provenance, foreign=""))
            fit(taken_over, serial, place.config)
            return version, ""
        except MismatchError as error:
            return None, str(error)
        except StoreError as error:
            self._fail(error, now)
            return None, ""

    def last_in(self, place: Place, now: datetime) -> int | None:
        """Serial number of the unit that was calibrated in this place last, None if none ever was."""
        store = self._opened(now)
        if store is None:
            return None
        try:
            here = [
                unit.newest
                for unit in store.units()
                if (unit.newest.provenance.hand, unit.newest.provenance.link) == (place.hand, place.link)
            ]
        except StoreError as error:
            self._fail(error, now)
            return None
        return max(here, key=lambda version: version.written_utc).serial if here else None

    def keep(
        self, serial: int, place: Place, provenance: Provenance, now: datetime,
        *, gains: Gains | None = None, offsets: Offsets | None = None, sheet: SheetState | None = None,
    ) -> Version | None:  # fmt: skip
        """Store what is new of a unit, with the rest of its newest calibration; None if that can't be."""
        store = self._opened(now)
        if store is None:
            return None
        before, _ = self.own(serial, place, now)
        known = before.calibration if before else Calibration()
        lasts = known.law or (known.gains and gains is None)
        changed = replace(
            known, gains=gains or known.gains, offsets=offsets or known.offsets, sheet=sheet or known.sheet
        )
        origin = replace(
            provenance,
            hand=place.hand,
            link=place.link,
            host=platform.node(),
            program=f"handtouch {handtouch.__version__}",
            foreign=before.provenance.foreign if before and lasts else "",
        )
        try:
            return store.write(serial, place.config, changed, origin, now)
        except (StoreError, ValueError) as error:
            self._fail(error, now)
            return None

    def _opened(self, now: datetime) -> Store | None:
        if self._store is not None or (self._again is not None and now < self._again):
            return self._store
        try:
            self._store, self._news = self._open(), True
            self.trouble = self._damage
        except (StoreError, OSError) as error:
            self._fail(error, now)
        return self._store

    def _open(self) -> Store:
        try:
            return Store(self._path)
        except DamagedStore as damaged:
            self._damage = str(damaged)
            _log.error("%s", damaged)
            return Store(self._path)  # a new one, the damaged file lies beside it

    def _fail(self, error: Exception, now: datetime) -> None:
        """Go on without the store for a while."""
        self.trouble, self._again = str(error), now + _AGAIN
        _log.error("nothing is kept for now: %s", error)
        self.close()


def age_s(version: Version, now: datetime) -> float:
    """How long ago it was written [s]; 0 if the clock says that it will be."""
    written = datetime.fromisoformat(version.written_utc).astimezone(UTC)
    return max(0.0, (now - written).total_seconds())


def grown_old(version: Version, now: datetime) -> Gains | None:
    """The gains of a version, less certain by what they may have drifted since, or if another unit's."""
    gains = version.calibration.gains
    if gains is None:
        return None
    drift = _DRIFT_PER_DAY**2 * age_s(version, now) / 86400
    if version.provenance.foreign:
        drift += _FROM_UNIT_TO_UNIT**2
    # a walk of four gains that leaves their product alone
    covariance = tuple(
        tuple(value + drift * ((i == j) - 0.25) for j, value in enumerate(row))
        for i, row in enumerate(gains.covariance)
    )
    return Gains(gains.factors, covariance)
