"""File of the calibration store: created atomically, verified when opened, moved aside when damaged.

Public: `create`, `connect`, `append`, `move_aside`, `damaged_files`, and the errors `StoreError`,
`DamagedStoreError`, `NewerStoreError`. Durability is described in `docs/calibrations.md`.

SQLite undoes an interrupted write and checks its structure, but keeps no checksum of its pages: a flipped
byte
or a journal cut short can change rows unnoticed. So every row carries a digest of itself and the row before,
and `head` the last one.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SCHEMA_VERSION = 3
_APPLICATION_ID = 0x68746361  # "htca"
_BUSY_TIMEOUT_S = 10.0
_TABLES_SQL = f"""
CREATE TABLE calibration (id INTEGER PRIMARY KEY, serial INTEGER NOT NULL, config TEXT NOT NULL,
    number INTEGER NOT NULL, version TEXT NOT NULL, digest BLOB NOT NULL, UNIQUE (serial, number));
CREATE TABLE head (
    only_row INTEGER PRIMARY KEY, schema INTEGER NOT NULL, id INTEGER NOT NULL, digest BLOB NOT NULL);
INSERT INTO head VALUES (1, {SCHEMA_VERSION}, 0, zeroblob(32));
PRAGMA application_id = {_APPLICATION_ID};
PRAGMA user_version = {SCHEMA_VERSION};
"""
_DAMAGE_ERRORS = (None, sqlite3.SQLITE_ERROR, 522)
"""Codes of an OperationalError that content causes: of the module (text not UTF-8), no such table, short
read."""


class StoreError(Exception):
    """The store can't be used; the text has cause and remedy."""


class NewerStoreError(StoreError):
    """A later handtouch wrote the store."""


class DamagedStoreError(StoreError):
    """The content isn't what was written. moved_to: new path of the file; None if it couldn't be moved."""

    def __init__(self, message: str, moved_to: Path | None) -> None:
        super().__init__(message)
        self.moved_to = moved_to


def create(path: Path) -> None:
    """Create an empty store, atomically, unless another process just did.

    Raises StoreError if that isn't possible, DamagedStoreError if a journal exists without its store.
    """
    if _journal_path(path).exists():
        moved = move_aside(path)
        raise DamagedStoreError(f"{path}: journal without its store; moved to {moved}", moved)
    new = path.with_name(f"{path.name}.new-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new.unlink(missing_ok=True)
        new.touch(mode=0o644, exist_ok=False)
        with contextlib.closing(_open_connection(new)) as connection:
            connection.executescript(f"PRAGMA journal_mode = MEMORY; BEGIN; {_TABLES_SQL} COMMIT;")
        with contextlib.suppress(FileExistsError):
            os.link(new, path)
        new.unlink()
        _sync_folder(path.parent)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(
            f"{path}: the calibration store can't be created: {error}; make its folder writable, or name "
            'another with [daemon] store = "FILE"'
        ) from error


def connect(path: Path) -> sqlite3.Connection:
    """Open, verify and migrate a store. SQLite undoes an interrupted write.

    Raises NewerStoreError; DamagedStoreError, after moving the file aside; StoreError for a file that is no
    store or can't be read.
    """
    _require_store_file(path)
    with contextlib.ExitStack() as on_error:
        try:
            inode = path.stat().st_ino
            connection = _open_connection(path)
            on_error.callback(connection.close)
            connection.execute("PRAGMA synchronous = EXTRA")
            if _verify(connection, path) < SCHEMA_VERSION:
                _migrate(connection, path)
        except (sqlite3.Error, OSError, ValueError, TypeError, OverflowError, MemoryError) as error:
            if _is_environment_error(error):
                raise StoreError(f"{path}: the calibration store can't be read: {error}") from error
            on_error.close()
            moved = None
            with contextlib.suppress(PermissionError):
                moved = move_aside(path, inode)
            raise DamagedStoreError(
                f"{path}: the calibration store is damaged: {error}; moved to {moved}. Restore a copy of it, "
                "or import exported calibrations into a new, empty one",
                moved,
            ) from error
        on_error.pop_all()
    return connection


def append(connection: sqlite3.Connection, row: tuple[int, str, int, str]) -> None:
    """Append serial, config, number and JSON of a version, within a transaction."""
    last, previous = connection.execute("SELECT id, digest FROM head").fetchone()
    content = (last + 1, *row)
    digest = _digest(previous, content)
    connection.execute("INSERT INTO calibration VALUES (?, ?, ?, ?, ?, ?)", (*content, digest))
    connection.execute("UPDATE head SET id = ?, digest = ?", (last + 1, digest))


def move_aside(path: Path, inode: int | None = None) -> Path | None:
    """Rename a damaged store and its journal; None if the path is no longer the file `inode`.

    The journal first: left alone, SQLite would apply it to the next store of that name.
    """
    if inode is not None and (not path.exists() or path.stat().st_ino != inode):
        return None
    number = len(damaged_files(path)) + 1
    while (moved := path.with_name(f"{path.name}.damaged-{number:03}")).exists():
        number += 1
    for old, new in ((_journal_path(path), _journal_path(moved)), (path, moved)):
        with contextlib.suppress(FileNotFoundError):
            old.rename(new)
    _sync_folder(path.parent)
    return moved


def damaged_files(path: Path) -> list[Path]:
    """Return damaged stores that were moved aside, oldest first."""
    found = path.parent.glob(f"{path.name}.damaged-*")
    return sorted(file for file in found if not file.name.endswith("-journal"))


def _open_connection(path: Path) -> sqlite3.Connection:
    """Connect with journal mode DELETE, SQLite's default, chosen for the reasons in docs/calibrations.md."""
    uri = f"{path.absolute().as_uri()}?mode=rw"  # read-only if the file is write-protected
    return sqlite3.connect(uri, uri=True, timeout=_BUSY_TIMEOUT_S, isolation_level=None)


def _require_store_file(path: Path) -> None:
    """Raise StoreError for any other file, which must not be moved aside; accept an empty or torn store."""
    try:
        with path.open("rb") as file:
            start = file.read(4096)
    except OSError as error:
        raise StoreError(f"{path}: the calibration store can't be read: {error}") from error
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


def _verify(connection: sqlite3.Connection, path: Path) -> int:
    """Check structure, size and every digest in one read transaction; return the schema version.

    Raises ValueError, or an error of SQLite, for damaged content.
    """
    with connection:  # ends the transaction
        connection.execute("BEGIN")
        schema = _read_schema_version(connection, path)
        problems = [row[0] for row in connection.execute("PRAGMA integrity_check(3)")]
        if problems != ["ok"]:
            raise ValueError(f"integrity check: {'; '.join(map(str, problems))}")
        pages, page_size = (
            connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size")
        )
        if path.stat().st_size != pages * page_size:
            raise ValueError(f"it has {path.stat().st_size} bytes instead of {pages * page_size}")
        last, digest = 0, bytes(32)
        rows = connection.execute("SELECT * FROM calibration ORDER BY id")
        column = [name for name, *_ in rows.description].index("digest")
        for row in rows:
            last, digest = row[0], _digest(digest, row[:column] + row[column + 1 :])
            if row[column] != digest:
                raise ValueError(f"entry {last} isn't what was written")
        head = connection.execute("SELECT id, digest FROM head").fetchall()
        if head != [(last, digest)]:
            raise ValueError(f"its last entry is {last}, but {head} was written last")
    return schema


def _digest(previous: bytes, content: Sequence[Any]) -> bytes:
    plain = [value.hex() if isinstance(value, bytes) else value for value in content]
    return hashlib.sha256(previous + json.dumps(plain).encode()).digest()


def _read_schema_version(connection: sqlite3.Connection, path: Path) -> int:
    """Return the schema version, which is in two places, so that a flipped bit is no new schema."""
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    in_table = [row[0] for row in connection.execute("SELECT schema FROM head")]
    if in_table != [version] or version < 1:
        raise ValueError(f"its schema version is {version} by the header and {in_table} by its table")
    if version > SCHEMA_VERSION:
        raise NewerStoreError(
            f"{path}: a later handtouch wrote this store (schema {version}, this one: {SCHEMA_VERSION}); "
            f"update handtouch, or restore the copy of the older schema ({path.name}.schema-{SCHEMA_VERSION})"
        )
    return version


def _migrate(connection: sqlite3.Connection, path: Path) -> None:
    """Migrate from schema 1 or 2 in one transaction; a copy of the old file is kept."""
    connection.execute("BEGIN EXCLUSIVE")
    with connection:  # commits, or rolls back after an error
        schema = _read_schema_version(connection, path)
        if schema == SCHEMA_VERSION:
            return  # another process migrated it meanwhile
        path.with_name(f"{path.name}.schema-{schema}").write_bytes(path.read_bytes())
        rows = connection.execute("SELECT * FROM calibration ORDER BY id").fetchall()
        for statement in ("DROP TABLE calibration", "DROP TABLE head", *_TABLES_SQL.split(";")):
            connection.execute(statement)
        for _, serial, config, number, written, provenance, payload, _, *state in rows:
            calibration = json.loads(payload)
            if state and state[0] is not None:
                data = base64.urlsafe_b64encode(state[2]).decode()
                calibration["sheet"] = {"kind": state[0], "version": state[1], "data": data}
            record = {"serial": serial, "config": config, "number": number, "written_utc": written}
            record |= {"provenance": json.loads(provenance), "calibration": calibration}
            append(connection, (serial, config, number, json.dumps(record)))


def _journal_path(path: Path) -> Path:
    return path.with_name(f"{path.name}-journal")


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
