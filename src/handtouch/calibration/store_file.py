"""File of the calibration store: created atomically, verified when opened, moved aside when damaged.

Public: `create`, `connect`, `append`, `damaged_files`, and the errors `StoreError`, `DamagedStoreError`.
Durability is described in `docs/calibrations.md`.

SQLite undoes an interrupted write and checks its structure, but keeps no checksum of its pages: a flipped
byte or a journal cut short can change rows unnoticed. So `head` holds a digest of all rows.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path

SCHEMA_VERSION = 4
_APPLICATION_ID = 0x68746361  # "htca"
_BUSY_TIMEOUT_S = 10.0
_TABLES_SQL = f"""
CREATE TABLE calibration (id INTEGER PRIMARY KEY, serial INTEGER NOT NULL, config TEXT NOT NULL,
    number INTEGER NOT NULL, version TEXT NOT NULL, UNIQUE (serial, number));
CREATE TABLE head (schema INTEGER NOT NULL, digest BLOB NOT NULL);
INSERT INTO head VALUES ({SCHEMA_VERSION}, zeroblob(32));
PRAGMA application_id = {_APPLICATION_ID};
PRAGMA user_version = {SCHEMA_VERSION};
"""
_DAMAGE_ERRORS = (None, sqlite3.SQLITE_ERROR, 522)
"""Codes of an OperationalError that content causes: text not UTF-8 (no code), no such table, short read."""


class StoreError(Exception):
    """The store can't be used; the text has cause and remedy."""

    exit_status = 2


class DamagedStoreError(StoreError):
    """The content isn't what was written; the text has the new path of the file."""


def create(path: Path) -> None:
    """Create an empty store, atomically, unless another process just did.

    Raises StoreError if that isn't possible, DamagedStoreError if a journal exists without its store.
    """
    if _journal_path(path).exists():
        raise DamagedStoreError(f"{path}: journal without its store; {_move_aside(path)}")
    new = path.with_name(f"{path.name}.new-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new.unlink(missing_ok=True)
        new.touch(mode=0o644)
        with contextlib.closing(_open_connection(new)) as connection:
            connection.executescript(f"PRAGMA journal_mode = MEMORY; BEGIN; {_TABLES_SQL} COMMIT;")
        with contextlib.suppress(FileExistsError):
            os.link(new, path)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(
            f"{path}: the calibration store can't be created: {error}; make its folder writable, or name "
            'another with [daemon] store = "FILE"'
        ) from error
    finally:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)


def connect(path: Path) -> sqlite3.Connection:
    """Open and verify a store. SQLite undoes an interrupted write.

    Raises DamagedStoreError, after moving the file aside; StoreError for a file that is no store, has another
    schema or can't be read.
    """
    with contextlib.ExitStack() as on_error:
        try:
            _require_store_file(path)
            inode = path.stat().st_ino
            connection = _open_connection(path)
            on_error.callback(connection.close)
            connection.execute("PRAGMA synchronous = EXTRA")
            _verify(connection, path)
        except (sqlite3.Error, OSError, ValueError, TypeError, OverflowError, MemoryError) as error:
            if _is_environment_error(error):
                raise StoreError(f"{path}: the calibration store can't be read: {error}") from error
            on_error.close()
            raise DamagedStoreError(
                f"{path}: the calibration store is damaged: {error}; {_move_aside(path, inode)}. "
                "Restore a copy of it, or import exported calibrations into a new, empty one"
            ) from error
        on_error.pop_all()
    return connection


def append(connection: sqlite3.Connection, row: tuple[int, str, int, str]) -> None:
    """Append serial, config, number and JSON of a version, within a transaction."""
    (previous,) = connection.execute("SELECT digest FROM head").fetchone()
    entry = connection.execute("INSERT INTO calibration VALUES (NULL, ?, ?, ?, ?)", row).lastrowid
    connection.execute("UPDATE head SET digest = ?", (_digest(previous, (entry, *row)),))


def damaged_files(path: Path) -> list[Path]:
    """Return damaged stores that were moved aside here."""
    found = path.parent.glob(f"{path.name}.damaged-*")
    return sorted(file for file in found if not file.name.endswith("-journal"))


def _move_aside(path: Path, inode: int | None = None) -> str:
    """Rename a damaged store and its journal, unless the path isn't the file `inode` any more; report it.

    The journal first: left alone, SQLite would apply it to the next store of that name.
    """
    if inode is not None and (not path.exists() or path.stat().st_ino != inode):
        return "another process moved it meanwhile"
    names = (path.with_name(f"{path.name}.damaged-{number:03}") for number in itertools.count(1))
    moved = next(name for name in names if not name.exists() and not _journal_path(name).exists())
    try:
        for old, new in ((_journal_path(path), _journal_path(moved)), (path, moved)):
            if old.exists():
                old.rename(new)
    except OSError as error:
        return f"it can't be moved aside: {error}"
    return f"moved to {moved}"


def _open_connection(path: Path) -> sqlite3.Connection:
    """Connect with journal mode DELETE, SQLite's default, chosen for the reasons in docs/calibrations.md."""
    uri = f"{path.absolute().as_uri()}?mode=rw"  # read-only if the file is write-protected
    return sqlite3.connect(uri, uri=True, timeout=_BUSY_TIMEOUT_S, isolation_level=None)


def _require_store_file(path: Path) -> None:
    """Raise StoreError for any other file, which must not be moved aside; accept an empty or torn store."""
    with path.open("rb") as file:
        start = file.read(4096)
    torn = len(start) < 512 and b"SQLite format 3\0".startswith(start[:16])
    if not (torn or start[68:72] == _APPLICATION_ID.to_bytes(4, "big") or b"CREATE TABLE calibr" in start):
        raise StoreError(
            f"{path}: is not a calibration store and stays unchanged; name another file with "
            '[daemon] store = "FILE"'
        )


def _is_environment_error(error: Exception) -> bool:
    if isinstance(error, sqlite3.OperationalError):
        return getattr(error, "sqlite_errorcode", None) not in _DAMAGE_ERRORS
    return isinstance(error, OSError)


def _verify(connection: sqlite3.Connection, path: Path) -> None:
    """Check schema, structure and digest in one read transaction.

    Raises StoreError for another schema; ValueError, or an error of SQLite, for damaged content.
    """
    with connection:  # ends the transaction
        connection.execute("BEGIN")
        _require_schema(connection, path)
        problems = [row[0] for row in connection.execute("PRAGMA integrity_check(3)")]
        if problems != ["ok"]:
            raise ValueError(f"integrity check: {'; '.join(map(str, problems))}")
        digest = bytes(32)
        rows = connection.execute("SELECT id, serial, config, number, version FROM calibration ORDER BY id")
        for row in rows:
            digest = _digest(digest, row)
        if connection.execute("SELECT digest FROM head").fetchall() != [(digest,)]:
            raise ValueError("its entries aren't what was written")


def _require_schema(connection: sqlite3.Connection, path: Path) -> None:
    """Compare the schema, which is in two places, so that a flipped bit is damage and no other schema."""
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    in_table = [row[0] for row in connection.execute("SELECT schema FROM head")]
    if in_table != [version]:
        raise ValueError(f"its schema version is {version} by the header and {in_table} by its table")
    if version != SCHEMA_VERSION:
        remedy = "update handtouch" if version > SCHEMA_VERSION else "move it away, and calibrate again"
        raise StoreError(
            f"{path}: has schema {version}, this handtouch reads {SCHEMA_VERSION} only; the file stays "
            f"unchanged: {remedy}"
        )


def _digest(previous: bytes, row: Sequence[int | str | None]) -> bytes:
    return hashlib.sha256(previous + json.dumps(row).encode()).digest()


def _journal_path(path: Path) -> Path:
    return path.with_name(f"{path.name}-journal")
