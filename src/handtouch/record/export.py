"""Export of recordings as tables, CSV or Parquet.

Public names: `export`, `find_columns`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from handtouch.record.recording import Recording
from handtouch.record.tables import Row, Rows, rows_of

_ROW_GROUP_ROWS = 50_000
_PROGRESS_ROWS = 1000


class CsvTableWriter:
    """A CSV file of these columns; unknown values are empty cells."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.rows = 0
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, list(columns), extrasaction="ignore", restval="")
        self._writer.writeheader()

    def write(self, row: Row) -> None:
        """Add a row."""
        self.rows += 1
        self._writer.writerow(row)

    def close(self) -> None:
        """Write pending rows and close the file."""
        self._file.close()


class ParquetTableWriter:
    """A Parquet file of these columns; unknown values are null. Types are those of the first rows with a
    value."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        import pyarrow

        self.rows = 0
        self._arrow, self._path = pyarrow, path
        self._names = list(columns)
        self._pending_rows: list[Row] = []
        self._writer: Any = None

    def write(self, row: Row) -> None:
        """Add a row."""
        self.rows += 1
        self._pending_rows.append(row)
        if len(self._pending_rows) >= _ROW_GROUP_ROWS:
            self._flush()

    def close(self) -> None:
        """Write pending rows and close the file."""
        self._flush()
        self._writer.close()

    def _flush(self) -> None:
        from pyarrow import parquet

        columns = {name: [row.get(name) for row in self._pending_rows] for name in self._names}
        if self._writer is None:
            table = self._arrow.table(columns)
            fields = [
                self._arrow.field(f.name, self._arrow.float64() if f.type == self._arrow.null() else f.type)
                for f in table.schema
            ]
            self._writer = parquet.ParquetWriter(self._path, self._arrow.schema(fields), compression="zstd")
        self._writer.write_table(self._arrow.table(columns, schema=self._writer.schema))
        self._pending_rows = []


TableWriter = CsvTableWriter | ParquetTableWriter
_TABLE_WRITERS: dict[str, type[TableWriter]] = {"csv": CsvTableWriter, "parquet": ParquetTableWriter}


class _TableFolder:
    """Tables in a folder, each created with its first row; `columns`: of each table."""

    def __init__(self, folder: Path, format_: str, columns: Mapping[str, Sequence[str]]) -> None:
        self.tables: dict[str, TableWriter] = {}
        self._columns = columns
        self._folder, self._format, self._open_tables = folder, format_, ExitStack()

    def write(self, table: str, row: Row) -> None:
        writer = self.tables.get(table)
        if writer is None:
            writer = _TABLE_WRITERS[self._format](
                self._folder / f"{table}.{self._format}", self._columns[table]
            )
            self._open_tables.callback(writer.close)
            self.tables[table] = writer
        writer.write(row)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open_tables.close()


def export(
    recording: Recording,
    folder: Path,
    format_: str = "csv",
    on_progress: Callable[[str], None] = lambda _: None,
) -> dict[str, int]:
    """Write the tables of a recording into a folder; return their rows. "parquet" needs pyarrow.

    A table has the columns that have a value in some row: the recording is read twice.
    `on_progress` is called with a description of the work done, every `_PROGRESS_ROWS` rows. Raises OSError,
    ImportError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    columns = find_columns(rows_of(recording), on_progress)
    with _TableFolder(folder, format_, columns) as tables:
        for count, (table, row) in enumerate(rows_of(recording)):
            if count % _PROGRESS_ROWS == 0:
                on_progress(f"{count} rows written to {folder}")
            tables.write(table, row)
        return {name: writer.rows for name, writer in tables.tables.items()}


def find_columns(rows: Rows, on_progress: Callable[[str], None] = lambda _: None) -> dict[str, list[str]]:
    """Return the columns of each table that have a value in some row, in the order of the rows' keys."""
    order: dict[str, dict[str, bool]] = {}
    for count, (table, row) in enumerate(rows):
        if count % _PROGRESS_ROWS == 0:
            on_progress(f"{count} rows read")
        found = order.setdefault(table, {})
        for name, value in row.items():
            found[name] = found.get(name, False) or (value is not None and value != "")
    return {table: [name for name, has_value in found.items() if has_value] for table, found in order.items()}
