"""The calibration store: every calibration of every unit, in one SQLite file; nothing is overwritten.

Public: `Store` (open, write, read, roll back) and `store_path` (where it lives). Readers and one writer at a
time may be different processes. What can be wrong with the file is told by `store_file`'s errors.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from handtouch.supervise import store_file
from handtouch.supervise.calibration import Calibration, Provenance, SheetState, Version
from handtouch.supervise.store_file import DamagedStore, NewerStore, StoreError

__all__ = ["DamagedStore", "NewerStore", "Store", "StoreError", "Unit", "store_path"]


@dataclass(frozen=True)
class Unit:
    """A unit of the store: how many versions there are, and the newest."""

    serial: int
    versions: int
    newest: Version


def store_path(configured: str | None = None, beside: Path | None = None) -> Path:
    """Where the store lives: as `[daemon] store` says, relative to the deployment file's folder `beside`.

    Else the state folder that systemd gives, or $XDG_STATE_HOME/handtouch, or ~/.local/state/handtouch.
    """
    if configured is not None:
        return (beside or Path()) / Path(configured).expanduser()
    if folder := os.environ.get("STATE_DIRECTORY"):
        return Path(folder.split(":")[0]) / "calibrations.db"
    home = os.environ.get("XDG_STATE_HOME", "")
    state = Path(home) if Path(home).is_absolute() else Path.home() / ".local" / "state"
    return state / "handtouch" / "calibrations.db"


class Store:
    """An open store; close it, or use it in a `with` block."""

    def __init__(self, path: Path | str, *, create: bool = True) -> None:
        """Open a store, checking all of it; make it if there is none and `create`.

        Raises DamagedStore (the file is then moved aside, and opening again makes a new one), NewerStore, or
        StoreError; an older schema is migrated, and the old file kept beside.
        """
        self.path = Path(path)
        if not self.path.exists():
            if not create:
                raise StoreError(f"{self.path}: there is no calibration store here yet")
            store_file.create(self.path)
        self._connection, self.writable = store_file.connect(self.path)
        self._inode = self.path.stat().st_ino
        self._seen = self._data_version()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    @property
    def damaged(self) -> list[Path]:
        """Damaged stores that were moved aside here, oldest first: what this one lacks may be in them."""
        return store_file.damaged_beside(self.path)

    def changed(self) -> bool:
        """Whether anybody else has written into it since the last call, or since it was opened."""
        before, self._seen = self._seen, self._data_version()
        return self._seen != before

    def write(
        self,
        serial: int,
        config: str,
        calibration: Calibration,
        provenance: Provenance,
        now: datetime,
    ) -> Version:
        """Add a version for the unit `serial` under the tables `config`; on disk when this returns.

        Raises ValueError for a serial that can't bind anything (0: the node has none) or a naive `now`,
        StoreError if it can't be written; then nothing has changed.
        """
        if not 0 < serial <= 0xFFFFFFFF:
            raise ValueError(
                f"serial = {serial}: a calibration is bound to a serial number of 1 to 4294967295; a node "
                "that has none (object 0x1018 sub 4) can't be told from its replacement"
            )
        if now.tzinfo is None:
            raise ValueError("now: needs a time zone")
        written = now.astimezone(UTC).isoformat(timespec="milliseconds")
        with self._transaction() as connection:
            last, before = connection.execute("SELECT id, digest FROM head").fetchone()
            number = (
                1
                + connection.execute(
                    "SELECT coalesce(max(number), 0) FROM calibration WHERE serial = ?", (serial,)
                ).fetchone()[0]
            )
            version = Version(serial, config, number, written, provenance, calibration)
            row = (last + 1, *_row_of(version))
            digest = store_file.digest(before, row)
            marks = ", ".join("?" * (len(row) + 1))
            connection.execute(
                f"INSERT INTO calibration ({store_file.COLUMNS}, digest) VALUES ({marks})", (*row, digest)
            )
            connection.execute("UPDATE head SET id = ?, digest = ?", (last + 1, digest))
        return version

    def roll_back(self, serial: int, number: int, provenance: Provenance, now: datetime) -> Version:
        """Make an older version the newest again, as a new one. Raises StoreError if there is none such.

        What is told of its method, evidence and whether it is another unit's is that of the older version.
        """
        old = self.get(serial, number)
        kept = replace(old.provenance, host=provenance.host, program=provenance.program, note=provenance.note)
        return self.write(serial, old.config, old.calibration, kept, now)

    def get(self, serial: int, number: int) -> Version:
        """One version. Raises StoreError naming those that there are."""
        if found := self._select("serial = ? AND number = ?", serial, number):
            return found[0]
        known = [str(version.number) for version in self.versions(serial)]
        there = f"there are: {', '.join(known)}" if known else "there is none of that serial"
        raise StoreError(f"{self.path}: no version {number} of serial {serial}; {there}")

    def versions(self, serial: int) -> list[Version]:
        """All of a unit, oldest first."""
        return self._select("serial = ?", serial)

    def newest(self, serial: int, config: str | None = None) -> Version | None:
        """The newest of a unit: under the tables `config` if there is one, else under any; None without any.

        Give it to `calibration.fit`, which refuses what doesn't fit.
        """
        order = "ORDER BY config = ? DESC, number DESC LIMIT 1"
        found = self._select(f"serial = ? {order}", serial, config or "")
        return found[0] if found else None

    def units(self) -> list[Unit]:
        """All units, by serial number."""
        with self._errors_told("read"):
            counts = self._connection.execute(
                "SELECT serial, count(*), max(number) FROM calibration GROUP BY serial ORDER BY serial"
            ).fetchall()
        return [Unit(serial, count, self.get(serial, newest)) for serial, count, newest in counts]

    def _data_version(self) -> int:
        with self._errors_told("read"):
            return int(self._connection.execute("PRAGMA data_version").fetchone()[0])

    def _select(self, where: str, *values: object) -> list[Version]:
        order = "" if "ORDER BY" in where else "ORDER BY number"
        with self._errors_told("read"):
            rows = self._connection.execute(
                f"SELECT {store_file.COLUMNS} FROM calibration WHERE {where} {order}", values
            ).fetchall()
            return [_version_of(row) for row in rows]

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        if not self.writable:
            raise StoreError(f"{self.path}: may not be written by this user")
        with self._errors_told("written"):
            if not self.path.exists() or self.path.stat().st_ino != self._inode:
                raise StoreError(f"{self.path}: was replaced or moved since it was opened; open it again")
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

    @contextlib.contextmanager
    def _errors_told(self, what: str) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            raise StoreError(f"{self.path}: the calibration store can't be {what}: {error}") from error


def _row_of(version: Version) -> tuple[Any, ...]:
    sheet = version.calibration.sheet
    return (
        version.serial,
        version.config,
        version.number,
        version.written_utc,
        json.dumps(version.provenance.to_json(), sort_keys=True),
        json.dumps(version.calibration.to_json(), sort_keys=True),
        *((sheet.kind, sheet.version, sheet.data) if sheet else (None, None, None)),
    )


def _version_of(row: tuple[Any, ...]) -> Version:
    _, serial, config, number, written, provenance, payload, kind, version, state = row
    sheet = None if kind is None else SheetState(kind, version, state)
    return Version(
        serial,
        config,
        number,
        written,
        Provenance.from_json(json.loads(provenance)),
        Calibration.from_json(json.loads(payload), sheet),
    )
