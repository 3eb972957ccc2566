"""Calibration store: every calibration of every node, in one SQLite file; nothing is overwritten.

Public: `Store`; `damaged_files` and errors of `store_file`. Several processes may have it open.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from handtouch.calibration import store_file
from handtouch.calibration.calibration import Calibration, CalibrationVersion, Provenance
from handtouch.calibration.store_file import DamagedStoreError, StoreError, damaged_files

__all__ = ["DamagedStoreError", "Store", "StoreError", "damaged_files"]


class Store:
    """An open store; close it, or use it in a `with` block."""

    def __init__(self, path: Path | str, *, create: bool = True) -> None:
        """Open and verify a store; create it if there is none and `create`.

        Raises DamagedStoreError (the file is then moved aside, and opening again creates a new one), or
        StoreError.
        """
        self.path = Path(path)
        if not self.path.exists():
            if not create:
                raise StoreError(f"{self.path}: there is no calibration store here yet")
            store_file.create(self.path)
        self._connection = store_file.connect(self.path)
        self._inode = self.path.stat().st_ino
        self._seen_data_version: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def changed(self) -> bool:
        """Return whether another process has written since the last call; True at the first call."""
        with self._translate_errors("read"):
            (version,) = self._connection.execute("PRAGMA data_version").fetchone()
        before, self._seen_data_version = self._seen_data_version, version
        return bool(version != before)

    def write(
        self, serial: int, config: str, calibration: Calibration, provenance: Provenance, now: datetime
    ) -> CalibrationVersion:
        """Add a version for the node `serial` under the tables `config`; it is on disk on return.

        Raises ValueError for a serial that binds nothing (0: the node has none) or a naive `now`, StoreError
        if it can't be written; then nothing has changed.
        """
        if not 0 < serial <= 0xFFFFFFFF:
            raise ValueError(
                f"serial = {serial}: a calibration is bound to a serial number of 1 to 4294967295; a node "
                "without one (object 0x1018 sub 4) can't be distinguished from its replacement"
            )
        if now.tzinfo is None:
            raise ValueError("now: needs a time zone")
        written = now.astimezone(UTC).isoformat(timespec="milliseconds")
        with self._translate_errors("written"):
            if not self.path.exists() or self.path.stat().st_ino != self._inode:
                raise StoreError(f"{self.path}: was replaced or moved since it was opened; open it again")
            with self._connection as connection:  # commits, or rolls back after an error
                connection.execute("BEGIN IMMEDIATE")
                (newest,) = connection.execute(
                    "SELECT coalesce(max(number), 0) FROM calibration WHERE serial = ?", (serial,)
                ).fetchone()
                version = CalibrationVersion(serial, config, newest + 1, written, provenance, calibration)
                text = json.dumps(version.to_json(), sort_keys=True)
                store_file.append(connection, (serial, config, version.number, text))
        return version

    def roll_back(
        self, serial: int, number: int, provenance: Provenance, now: datetime
    ) -> CalibrationVersion:
        """Write an older version again, as the newest one. Raises StoreError if there is no such version.

        Host, program and note are those of `provenance`, the rest that of the older version.
        """
        old = self.get(serial, number)
        origin = replace(
            old.provenance, host=provenance.host, program=provenance.program, note=provenance.note
        )
        return self.write(serial, old.config, old.calibration, origin, now)

    def get(self, serial: int, number: int) -> CalibrationVersion:
        """Return one version. Raises StoreError listing the existing ones."""
        if found := self._select("WHERE serial = ? AND number = ?", serial, number):
            return found[0]
        known = [str(version.number) for version in self.versions(serial)]
        existing = f"there are: {', '.join(known)}" if known else "there is none of that serial"
        raise StoreError(f"{self.path}: no version {number} of serial {serial}; {existing}")

    def versions(self, serial: int) -> list[CalibrationVersion]:
        """Return all versions of a node, oldest first; their numbers count from 1."""
        return self._select("WHERE serial = ? ORDER BY number", serial)

    def newest(self, serial: int, config: str = "") -> CalibrationVersion | None:
        """Return the newest version of a node: under the tables `config` if there is one, else under any.

        `check_match` refuses a version of other tables.
        """
        order = "ORDER BY config = ? DESC, number DESC LIMIT 1"
        return next(iter(self._select(f"WHERE serial = ? {order}", serial, config)), None)

    def newest_of_all(self) -> list[CalibrationVersion]:
        """Return the newest version of every node, by serial number."""
        return self._select("WHERE id IN (SELECT max(id) FROM calibration GROUP BY serial) ORDER BY serial")

    def _select(self, condition: str, *values: object) -> list[CalibrationVersion]:
        with self._translate_errors("read"):
            rows = self._connection.execute(f"SELECT version FROM calibration {condition}", values).fetchall()
        return [CalibrationVersion.from_json(json.loads(text)) for (text,) in rows]

    @contextlib.contextmanager
    def _translate_errors(self, action: str) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            raise StoreError(f"{self.path}: the calibration store can't be {action}: {error}") from error
