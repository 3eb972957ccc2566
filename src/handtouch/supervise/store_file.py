"""The file of the calibration store: made whole, checked when opened, migrated, moved aside when damaged.

Public: `create`, `connect` (both durable as described in `docs/calibrations.md`), `verify`, `put_aside`,
`damaged_beside`, and what can be wrong: `StoreError`, `DamagedStore`, `NewerStore`.

SQLite keeps no checksum of its pages, so every row carries a digest over itself and the row before it, and
`head` holds the last one: a byte that flipped in a row, a row that is gone and a tail cut off all show.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

SCHEMA = 2
_APPLICATION_ID = 0x68746361  # "htca"
_MAGIC = b"SQLite format 3\0"
_BUSY_S = 10.0
_ORIGIN = b"\0" * 32  # stands for the row before the first

_COLUMNS = {
    1: ("id", "serial", "config", "number", "written_utc", "provenance", "payload"),
    2: (
        *("id", "serial", "config", "number", "written_utc", "provenance", "payload"),
        *("state_kind", "state_version", "state"),
    ),
}
COLUMNS = ", ".join(_COLUMNS[SCHEMA])
_CREATE = """
CREATE TABLE calibration (
    id INTEGER PRIMARY KEY, serial INTEGER NOT NULL, config TEXT NOT NULL, number INTEGER NOT NULL,
    written_utc TEXT NOT NULL, provenance TEXT NOT NULL, payload TEXT NOT NULL, digest BLOB NOT NULL,
    state_kind TEXT, state_version INTEGER, state BLOB, UNIQUE (serial, number));
CREATE TABLE head (
    only_row INTEGER PRIMARY KEY, schema INTEGER NOT NULL, id INTEGER NOT NULL, digest BLOB NOT NULL);
"""
_DAMAGE = {
    sqlite3.SQLITE_ERROR,  # no such table
    sqlite3.SQLITE_CORRUPT,
    sqlite3.SQLITE_NOTADB,
    sqlite3.SQLITE_FORMAT,
    sqlite3.SQLITE_TOOBIG,
    sqlite3.SQLITE_MISMATCH,
    sqlite3.SQLITE_NOMEM,  # a length that can't be
}


class StoreError(Exception):
    """The store can't be used; says why, and what helps."""


class NewerStore(StoreError):  # noqa: N818
    """It was written by a later handtouch."""


class DamagedStore(StoreError):  # noqa: N818
    """Its content isn't what was written. aside: where the file is now; None if it couldn't be moved."""

    def __init__(self, message: str, aside: Path | None) -> None:
        super().__init__(message)
        self.aside = aside


class _Damage(Exception):  # noqa: N818
    """What is wrong with the content."""


def create(path: Path) -> None:
    """Make an empty store, unless somebody else just did; it appears whole or not at all.

    Raises StoreError where that isn't possible, DamagedStore where a journal lies without its store.
    """
    if _journal(path).exists():
        aside = put_aside(path)
        raise DamagedStore(f"{path}: the store is gone but its journal is there, now {aside}", aside)
    made = path.with_name(f"{path.name}.new-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for name in (made, _journal(made)):
            name.unlink(missing_ok=True)
        os.close(os.open(made, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644))
        with contextlib.closing(_connection(made)) as connection:
            connection.execute("PRAGMA synchronous = EXTRA")
            connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
            connection.executescript(f"BEGIN; {_CREATE} PRAGMA user_version = {SCHEMA}; COMMIT")
            connection.execute("INSERT INTO head VALUES (1, ?, 0, ?)", (SCHEMA, _ORIGIN))
        with contextlib.suppress(FileExistsError):
            os.link(made, path)
        made.unlink()
        _sync_folder(path.parent)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(
            f"{path}: the calibration store can't be made: {error}; see that its folder is writable, or name "
            'another with [daemon] store = "FILE"'
        ) from error


def connect(path: Path) -> tuple[sqlite3.Connection, bool]:
    """Open a store, check all of it and migrate it; also whether it can be written.

    Raises NewerStore; DamagedStore, after moving the file aside; StoreError for what is no store at all, or
    can't be read. An interrupted write is undone on the way, by SQLite.
    """
    _refuse_foreign(path)
    writable = os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    try:
        inode = path.stat().st_ino
        connection = _connection(path, writable)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"{path}: the calibration store can't be opened: {error}") from error
    try:
        with _damage_told():
            connection.execute("PRAGMA synchronous = EXTRA")
            schema = verify(connection, path)
        if schema < SCHEMA:
            _migrate(connection, path, schema, writable)
    except _Damage as damage:
        connection.close()
        aside = put_aside(path, inode) if writable else None
        where = f"it is now {aside}" if aside else "it is left where it is, as it can't be written"
        raise DamagedStore(
            f"{path}: the calibration store is damaged: {damage}; {where}. Bring back a copy of it, or "
            "import exported calibrations into a new one, which begins empty",
            aside,
        ) from damage
    except sqlite3.Error as error:
        connection.close()
        raise StoreError(f"{path}: the calibration store can't be read: {error}") from error
    except BaseException:
        connection.close()
        raise
    return connection, writable


def verify(connection: sqlite3.Connection, path: Path) -> int:
    """Check structure, size and every digest in one read transaction; return the schema's number."""
    connection.execute("BEGIN")
    try:
        schema = _schema(connection, path)
        if connection.execute("PRAGMA journal_mode").fetchone()[0] != "delete":
            raise _Damage("its header tells another journal mode than it is written with")
        found = [row[0] for row in connection.execute("PRAGMA integrity_check(3)")]
        if found != ["ok"]:
            raise _Damage(f"SQLite finds: {'; '.join(map(str, found))}")
        pages, size = (
            connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size")
        )
        if path.stat().st_size != pages * size:
            raise _Damage(f"it has {path.stat().st_size} bytes instead of {pages * size}")
        last, before = 0, _ORIGIN
        for *content, kept in connection.execute(
            f"SELECT {', '.join(_COLUMNS[schema])}, digest FROM calibration ORDER BY id"
        ):
            last, before = content[0], digest(before, content)
            if kept != before:
                raise _Damage(f"entry {last} isn't what was written")
        head = connection.execute("SELECT id, digest FROM head").fetchall()
        if head != [(last, before)]:
            raise _Damage(f"its last entry is {last}, and {head} was written last")
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
    return schema


def digest(before: bytes, content: Sequence[Any]) -> bytes:
    """Digest of a row, chained to that of the row before."""
    plain = [value.hex() if isinstance(value, bytes) else value for value in content]
    return hashlib.sha256(before + json.dumps(plain).encode()).digest()


def put_aside(path: Path, inode: int | None = None) -> Path | None:
    """Rename a damaged store and its journal; None if it is not the file `inode` any more.

    The journal goes first: left alone, SQLite would play it into the next store of that name.
    """
    if inode is not None and (not path.exists() or path.stat().st_ino != inode):
        return None
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    aside, count = path.with_name(f"{path.name}.damaged-{stamp}"), 1
    while aside.exists() or _journal(aside).exists():
        count += 1
        aside = path.with_name(f"{path.name}.damaged-{stamp}-{count}")
    for old, new in ((_journal(path), _journal(aside)), (path, aside)):
        with contextlib.suppress(FileNotFoundError):
            old.rename(new)
    _sync_folder(path.parent)
    return aside


def damaged_beside(path: Path) -> list[Path]:
    """Damaged stores that were moved aside, oldest first."""
    return sorted(
        found for found in path.parent.glob(f"{path.name}.damaged-*") if not found.name.endswith("-journal")
    )


def _connection(path: Path, writable: bool = True) -> sqlite3.Connection:
    """Journal mode DELETE, SQLite's default; for the reasons in docs/calibrations.md."""
    uri = f"{path.absolute().as_uri()}?mode={'rw' if writable else 'ro'}"
    return sqlite3.connect(uri, uri=True, timeout=_BUSY_S, isolation_level=None)


def _refuse_foreign(path: Path) -> None:
    """Somebody else's file must not be moved aside as a damaged store; an empty or torn one may."""
    try:
        with path.open("rb") as file:
            begin = file.read(4096)
    except OSError as error:
        raise StoreError(f"{path}: the calibration store can't be read: {error}") from error
    torn = len(begin) < 512 and _MAGIC.startswith(begin[:16])
    ours = begin[68:72] == _APPLICATION_ID.to_bytes(4, "big") or b"CREATE TABLE calibration" in begin
    if not (torn or ours):
        raise StoreError(
            f"{path}: is not a calibration store, and is left alone; name another file with "
            '[daemon] store = "FILE"'
        )


def _schema(connection: sqlite3.Connection, path: Path) -> int:
    """Two places tell it, so that a flipped bit is no new schema."""
    told = int(connection.execute("PRAGMA user_version").fetchone()[0])
    schemas = [row[0] for row in connection.execute("SELECT schema FROM head")]
    if schemas != [told] or told < 1:
        raise _Damage(f"its schema is {told} by the header and {schemas} by its table")
    if told > SCHEMA:
        raise NewerStore(
            f"{path}: a later handtouch wrote this store (schema {told}, this one knows {SCHEMA}): update "
            f"handtouch, or go back to the copy that was kept before ({path.name}.schema-{SCHEMA})"
        )
    return told


def _migrate(connection: sqlite3.Connection, path: Path, schema: int, writable: bool) -> None:
    """From an older schema, all or nothing; the old file is kept beside it."""
    if not writable:
        raise StoreError(f"{path}: has the older schema {schema}; open it once as a user who may write it")
    with contextlib.closing(_connection_new(path.with_name(f"{path.name}.schema-{schema}"))) as copy:
        connection.backup(copy)
    connection.execute("BEGIN EXCLUSIVE")
    try:
        if _schema(connection, path) == schema:  # nobody else did it meanwhile
            for column in ("state_kind TEXT", "state_version INTEGER", "state BLOB"):
                connection.execute(f"ALTER TABLE calibration ADD COLUMN {column}")
            last, before = 0, _ORIGIN
            for row in connection.execute(f"SELECT {COLUMNS} FROM calibration ORDER BY id").fetchall():
                last, before = row[0], digest(before, row)
                connection.execute("UPDATE calibration SET digest = ? WHERE id = ?", (before, last))
            connection.execute("UPDATE head SET schema = ?, id = ?, digest = ?", (SCHEMA, last, before))
            connection.execute(f"PRAGMA user_version = {SCHEMA}")
        connection.execute("COMMIT")
    except BaseException:
        connection.execute("ROLLBACK")
        raise


def _connection_new(path: Path) -> sqlite3.Connection:
    path.unlink(missing_ok=True)
    return sqlite3.connect(path, isolation_level=None)


@contextlib.contextmanager
def _damage_told() -> Iterator[None]:
    """Errors that damaged content causes, as such."""
    try:
        yield
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", None)  # None: raised by the module, e.g. for text not UTF-8
        short = code == getattr(sqlite3, "SQLITE_IOERR_SHORT_READ", 522)
        if code is None or code & 0xFF in _DAMAGE or short:
            raise _Damage(f"SQLite says: {error}") from error
        raise
    except (ValueError, TypeError, OverflowError) as error:
        raise _Damage(str(error)) from error


def _journal(path: Path) -> Path:
    return path.with_name(f"{path.name}-journal")


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
