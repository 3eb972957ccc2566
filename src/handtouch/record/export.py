"""`handtouch export`: a recording as tables, CSV or Parquet.

Public names: `export`, `run`.
"""

from __future__ import annotations

import csv
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, Self

from handtouch.record.read import Recording
from handtouch.record.tables import Row, rows_of

_GROUP_ROWS = 50_000


class Sheet(Protocol):
    """A table that is written row by row; `rows` counts them."""

    rows: int

    def write(self, row: Row) -> None: ...

    def close(self) -> None: ...


class CsvSheet:
    """A CSV file; what isn't known is an empty cell. Its columns are those of the first row."""

    def __init__(self, path: Path, first: Row) -> None:
        self.rows = 0
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, list(first), extrasaction="ignore", restval="")
        self._writer.writeheader()

    def write(self, row: Row) -> None:
        """Add a row."""
        self.rows += 1
        self._writer.writerow(row)

    def close(self) -> None:
        """Write what is left."""
        self._file.close()


class ParquetSheet:
    """A Parquet file; what isn't known is null. Types are those of the first rows that know them."""

    def __init__(self, path: Path, first: Row) -> None:
        import pyarrow

        self.rows = 0
        self._arrow, self._path = pyarrow, path
        self._names = list(first)
        self._held: list[Row] = []
        self._writer: Any = None

    def write(self, row: Row) -> None:
        """Add a row."""
        self.rows += 1
        self._held.append(row)
        if len(self._held) >= _GROUP_ROWS:
            self._flush()

    def close(self) -> None:
        """Write what is left."""
        self._flush()
        self._writer.close()

    def _flush(self) -> None:
        from pyarrow import parquet

        columns = {name: [row.get(name) for row in self._held] for name in self._names}
        if self._writer is None:
            table = self._arrow.table(columns)
            fields = [
                self._arrow.field(f.name, self._arrow.float64() if f.type == self._arrow.null() else f.type)
                for f in table.schema
            ]
            self._writer = parquet.ParquetWriter(self._path, self._arrow.schema(fields), compression="zstd")
        self._writer.write_table(self._arrow.table(columns, schema=self._writer.schema))
        self._held = []


_SHEETS: dict[str, type[CsvSheet] | type[ParquetSheet]] = {"csv": CsvSheet, "parquet": ParquetSheet}


class _Book:
    """The tables of a folder, each made when its first row comes."""

    def __init__(self, folder: Path, format_: str) -> None:
        self.sheets: dict[str, Sheet] = {}
        self._folder, self._format, self._opened = folder, format_, ExitStack()

    def write(self, table: str, row: Row) -> None:
        sheet = self.sheets.get(table)
        if sheet is None:
            sheet = _SHEETS[self._format](self._folder / f"{table}.{self._format}", row)
            self._opened.callback(sheet.close)
            self.sheets[table] = sheet
        sheet.write(row)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()


def export(recording: Recording, folder: Path, format_: str = "csv") -> dict[str, int]:
    """Write the tables of a recording into a folder; rows of each. "parquet" needs pyarrow.

    Raises OSError, ImportError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _Book(folder, format_) as book:
        for table, row in rows_of(recording):
            book.write(table, row)
        return {name: sheet.rows for name, sheet in book.sheets.items()}


def run(path: Path, folder: Path, format_: str) -> int:
    """`handtouch export`; exit status 0, 1 (it can't be read, or holds nothing), 2 (pyarrow is missing)."""
    if format_ == "parquet":
        try:
            import pyarrow  # noqa: F401
        except ImportError as error:
            print(f"--format parquet: {error}; pip install 'handtouch[export]', or take csv", file=sys.stderr)
            return 2
    try:
        recording = Recording(path)
        counts = export(recording, folder, format_)
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    for name, rows in counts.items():
        print(f"{folder / name}.{format_}: {rows} rows")
    if recording.cut:
        print(f"{path}: {recording.cut}; all before it is in the tables", file=sys.stderr)
    if recording.damaged:
        print(f"{path}: {recording.damaged} messages can't be read", file=sys.stderr)
    if not counts:
        print(f"{path}: holds no message of a daemon", file=sys.stderr)
    return 0 if counts else 1
