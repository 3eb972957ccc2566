"""Export of recordings as tables, CSV or Parquet, with the unit in every column name.

Public names: `export`, `find_columns`; `TABLES`, `rows_of`, `Rows` (messages as rows). `time_ns` is UTC, in
ns since 1970; every other `_ns` is of the daemon's monotonic clock.
"""

from __future__ import annotations

import csv
import json
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from handtouch import wire
from handtouch.record.recording import RecordedMessage, Recording
from handtouch.wire.columns import vector_length

TABLES = ("contacts", "raw", "hand", "health", "service", "joints")
Row = dict[str, Any]
Rows = Iterator[tuple[str, Row]]

_AXES = {
    2: ("x", "y"),
    3: ("x", "y", "z"),
    9: ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"),
}
_CHANNELS = ("x0_counts", "xa_counts", "y0_counts", "yb_counts")
_PARTS, _MAX_PARTS = "parts", 2
_PART_COLUMNS = tuple(wire.ContactPart.__annotations__)
_OMITTED_KEYS = ("v", "retained")
_PAD_STATES = [state.name.lower() for state in wire.PadState]
_SCALAR_TYPES = (bool, int, float, str, type(None))


def pad_state_name(code: int) -> str:
    """Return the name of a pad's state; its number for one that a later version added."""
    return _PAD_STATES[code] if 0 <= code < len(_PAD_STATES) else str(code)


def rows_of(recording: Recording) -> Rows:
    """Yield table and row for the messages of a recording."""
    names: list[tuple[str, str]] = []
    for entry in recording.read("config"):  # ticks may precede it
        names = pads_of(entry.payload)
        break
    for entry in recording:
        prefix = entry.topic.split("/")[0]
        if prefix == "config":
            names = pads_of(entry.payload)
        elif prefix == "contact" and not entry.payload["retained"]:
            yield (
                "contacts",
                {"time_ns": entry.wall_ns} | flatten_payload(entry.payload | _missing_defaults(entry)),
            )
        elif prefix in ("health", "service"):
            yield (
                prefix,
                {"time_ns": entry.wall_ns} | flatten_payload(entry.payload | _missing_defaults(entry)),
            )
        elif prefix == "hand":
            yield from (("hand", row) for row in _hand_rows(entry))
        elif prefix == "tick":
            yield from _tick_rows(entry, names)


def pads_of(config: dict[str, Any]) -> list[tuple[str, str]]:
    """Return hand and link of each row of `tick`, from the payload of a `config` message."""
    hands = json.loads(config["deployment"])["hand"]
    return [(hand["name"], pad["link"]) for hand in hands for pad in hand["pad"]]


def flatten_payload(payload: dict[str, Any]) -> Row:
    """Return a payload as a row: a column per vector component, one for a list of strings, none for a map."""
    row: Row = {}
    for name, value in payload.items():
        if name in _OMITTED_KEYS or isinstance(value, dict):
            continue
        if name == _PARTS:
            row |= _part_columns(value)
            continue
        if name in _VECTOR_LENGTHS:
            row |= _component_columns(name, value)
        elif isinstance(value, list | tuple):
            row[name] = "; ".join(map(_item_text, value))
        elif isinstance(value, _SCALAR_TYPES):
            row[name] = value
    return row


def _part_columns(parts: Sequence[Mapping[str, Any]]) -> Row:
    """Return the columns of two contacts on a pad: part_1_position_x_m ...; empty for one."""
    row: Row = {}
    for number in range(_MAX_PARTS):
        part = parts[number] if number < len(parts) else {}
        for name in _PART_COLUMNS:
            value = part.get(name)
            columns = _component_columns(name, value) if name in _VECTOR_LENGTHS else {name: value}
            row |= {f"part_{number + 1}_{column}": one for column, one in columns.items()}
    return row


def _component_columns(name: str, values: Sequence[Any] | None) -> Row:
    """Return a column per component of a field that is a vector, empty ones for None."""
    columns = component_names(name, _VECTOR_LENGTHS[name])
    return dict.fromkeys(columns) if values is None else dict(zip(columns, values, strict=True))


def _item_text(item: Any) -> str:
    """Return an item of a list as text; of an EMCY message its text, of a diagnosis its kind."""
    return str(item.get("text", item.get("kind", ""))) if isinstance(item, dict) else str(item)


def component_names(name: str, length: int) -> list[str]:
    """Return the column names of a vector or matrix: position_m -> position_x_m ..."""
    stem, underline, unit = name.rpartition("_")
    if not underline or unit not in ("m", "m2", "n", "a", "s"):
        stem, unit = name, ""
    return ["_".join(filter(None, (stem, axis, unit))) for axis in _AXES[length]]


def _missing_defaults(entry: RecordedMessage) -> Row:
    """Return the defaults of fields that the message omits; they have columns too."""
    defaults = _DEFAULTS[entry.topic.split("/")[0]]
    return {name: value for name, value in defaults.items() if name not in entry.payload}


def _tick_rows(entry: RecordedMessage, names: list[tuple[str, str]]) -> Rows:
    payload = entry.payload
    if payload["stopped"] or not names:
        return
    columns = {
        name: column.to_array(payload[name], len(names)).tolist()
        for name, column in wire.COLUMNS[wire.TickInputs].items()
    }
    further = (f"channel{number}_counts" for number in range(5, len(columns["counts"][0]) + 1))
    channels = (*_CHANNELS, *further)
    about = {
        "time_ns": entry.wall_ns,
        "session": payload["session"],
        "tick": payload["tick"],
        "sync_ns": payload["t_ns"],
    }
    for (hand, link), counts, (arrival_ns,), (fresh,), (state,) in zip(
        names,
        columns["counts"],
        columns["arrival_ns"],
        columns["fresh"],
        columns["node_state"],
        strict=True,
    ):
        yield (
            "raw",
            {
                **about,
                "hand": hand,
                "link": link,
                **dict(zip(channels, counts, strict=True)),
                "arrival_ns": arrival_ns,
                "fresh": bool(fresh),
                "node_state": pad_state_name(state),
            },
        )
    for joints in payload.get("joints", ()):
        values = zip(
            *(np.frombuffer(joints[name]).tolist() for name in ("position_rad", "age_s")), strict=True
        )
        for number, (position, age) in enumerate(values):
            row = {
                **about,
                "hand": joints["hand"],
                "joints_ns": joints["t_ns"],
                "joint": number,
                "position": position,
                "age_s": age,
            }
            yield "joints", row


def _hand_rows(entry: RecordedMessage) -> Iterator[Row]:
    payload = entry.payload
    columns: dict[str, Any] = {}
    for name, column in wire.COLUMNS[wire.HandFrame].items():
        if not payload.get(name):
            continue
        values = column.to_array(payload[name]).reshape(-1, column.elements)
        parts = component_names(name, column.elements) if column.elements > 1 else [name]
        columns |= dict(zip(parts, values.T.tolist(), strict=True))
    about = {"time_ns": entry.wall_ns} | {
        key: payload[key] for key in ("session", "seq", "t_ns", "tick", "hand")
    }
    for number, link in enumerate(payload["links"]):
        row = {name: _none_if_nan(column[number]) for name, column in columns.items()}
        yield {**about, "link": link, **row, "state": pad_state_name(row["state"])}


def _none_if_nan(value: Any) -> Any:
    return None if isinstance(value, float) and value != value else value


def _vector_lengths() -> dict[str, int]:
    """Return the length of each vector field, by name, of the payloads in tables."""
    hints = [
        item
        for payload in (wire.Contact, wire.Health, wire.Service)
        for item in typing.get_type_hints(payload).items()
    ]
    return {name: length for name, hint in hints if (length := vector_length(hint))}


_VECTOR_LENGTHS = _vector_lengths()
_DEFAULTS: dict[str, Row] = {
    topic.prefix: {
        field.name: field.default for field in fields(topic.payload) if field.default is not MISSING
    }
    for topic in wire.TOPICS
}


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
