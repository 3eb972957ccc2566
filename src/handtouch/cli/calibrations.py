"""The command `calibrations`: list, compare, roll back, export and import calibrations."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from handtouch import config
from handtouch.calibration import exchange
from handtouch.calibration.calibration import Calibration, CalibrationVersion, differences
from handtouch.calibration.store import Store, StoreError, damaged_files
from handtouch.calibration.store_path import store_path
from handtouch.cli.options import Subparsers, add_command, add_json, add_output, integer
from handtouch.cli.tables import make_table, output_console, print_table
from handtouch.host.json_output import print_json

_APPLIED_NOTE = "a daemon that uses this store applies it within seconds; see `handtouch status`"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of `calibrations`."""
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for action in (
        _add_list(actions),
        _add_show(actions),
        _add_diff(actions),
        _add_rollback(actions),
        _add_export(actions),
        _add_import(actions),
    ):
        _add_store(action)


def _add_list(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(actions, "list", run_list, "list every sensor and its newest calibration")
    add_json(parser)
    return parser


def _add_show(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(
        actions, "show", run_show, "show a sensor's versions and the contents of one of them"
    )
    _add_sensor(parser)
    parser.add_argument(
        "--version", dest="number", type=int, metavar="N", help="version to show (default: the newest)"
    )
    add_json(parser)
    return parser


def _add_diff(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(actions, "diff", run_diff, "compare two versions; exit status 1 if they differ")
    _add_sensor(parser)
    parser.add_argument(
        "--from", dest="before", type=int, metavar="N", help="older version (default: the one before --to)"
    )
    parser.add_argument(
        "--to", dest="after", type=int, metavar="N", help="newer version (default: the newest)"
    )
    add_json(parser)
    return parser


def _add_rollback(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(actions, "rollback", run_roll_back, "make a copy of an older version the newest one")
    _add_sensor(parser)
    parser.add_argument("number", metavar="VERSION", type=int, help="version to restore")
    add_json(parser)
    return parser


def _add_export(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(actions, "export", run_export, "export calibrations as JSON")
    parser.add_argument(
        "sensors",
        metavar="SENSOR",
        nargs="*",
        help="serial number, or link that it was last on (default: all)",
    )
    parser.add_argument("--history", action="store_true", help="export every version, not only the newest")
    add_output(parser, "out", "file to write (default: standard output)", metavar="FILE")
    return parser


def _add_import(actions: Subparsers) -> argparse.ArgumentParser:
    parser = add_command(actions, "import", run_import, "import exported calibrations as new versions")
    parser.add_argument(
        "file", metavar="FILE", type=Path, help="file written by `handtouch calibrations export`"
    )
    parser.add_argument(
        "--serial",
        type=integer(1, 0xFFFFFFFF, "a serial number, 1 to 4294967295"),
        help="sensor to import for (default: the one that was exported)",
    )
    parser.add_argument(
        "--other-sensor",
        action="store_true",
        help="allow the calibration of another sensor, which stays marked as such",
    )
    add_json(parser)
    return parser


def _add_sensor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sensor", metavar="SENSOR", help="serial number, or link that it was last on")


def _add_store(parser: argparse.ArgumentParser) -> None:
    store = parser.add_mutually_exclusive_group()
    store.add_argument(
        "--config",
        dest="deployment",
        type=Path,
        metavar="CONFIG",
        help="deployment file, for its [daemon] store (default: the store of the current user)",
    )
    store.add_argument("--store", type=Path, metavar="FILE", help="path of the store")


def run_list(store: Path | None, deployment: Path | None, as_json: bool) -> int:
    """List every sensor; exit status 0, 1 (damaged stores exist beside it), 2 (no store)."""
    with _opened_store(store, deployment) as opened:
        newest, damaged = opened.newest_of_all(), damaged_files(opened.path)
        if as_json:
            sensors = [{"versions": one.number, "newest": _summary_fields(one)} for one in newest]
            record = {"store": str(opened.path), "sensors": sensors, "damaged": [*map(str, damaged)]}
            print_json(record)
        else:
            print(f"{opened.path}: {len(newest)} sensor{'s' * (len(newest) != 1)}")
            table = make_table(
                "serial", "versions", "newest", "link", "content", right=("versions",), wrapped=("content",)
            )
            for one in newest:
                link = f"{one.provenance.hand}/{one.provenance.link}"
                table.add_row(
                    str(one.serial), str(one.number), f"{one.written_utc[:16]}Z", link, _content_text(one)
                )
            print_table(output_console(), table)
        for path in damaged:
            print(f"{path}: a damaged store; delete it once its content isn't needed", file=sys.stderr)
        return 1 if damaged else 0


def run_show(
    store: Path | None, deployment: Path | None, sensor: str, number: int | None, as_json: bool
) -> int:
    """Show versions of a sensor; exit status 0, or 2 (no such version)."""
    with _opened_store(store, deployment) as opened:
        version = exchange.find_version(opened, sensor, number)
        if as_json:
            print_json(version.to_json())
        else:
            for old in opened.versions(version.serial):
                print(f"{'>' if old == version else ' '} {_summary_line(old)}")
            _print_version(version)
        return 0


def run_diff(
    store: Path | None,
    deployment: Path | None,
    sensor: str,
    before: int | None,
    after: int | None,
    as_json: bool,
) -> int:
    """Compare two versions; exit status 0 (equal), 1 (different), 2 (no such version)."""
    with _opened_store(store, deployment) as opened:
        new = exchange.find_version(opened, sensor, after)
        old = opened.get(new.serial, max(new.number - 1, 1) if before is None else before)
        rows: list[tuple[str, Any, Any]] = list(differences(old.calibration, new.calibration))
        if old.config != new.config:
            rows.insert(0, ("config", old.config, new.config))
        if as_json:
            changes = [{"key": name, "before": one, "after": other} for name, one, other in rows]
            print_json({"before": _summary_fields(old), "after": _summary_fields(new), "changes": changes})
            return 1 if rows else 0
        print(f"--- {_summary_line(old)}\n+++ {_summary_line(new)}")
        for name, one, other in rows:
            print(f"{name}\n  - {_format_value(one)}\n  + {_format_value(other)}")
        return 1 if rows else 0


def run_roll_back(
    store: Path | None, deployment: Path | None, sensor: str, number: int, as_json: bool
) -> int:
    """Write an older version again; exit status 0, or 2 (no such version)."""
    with _opened_store(store, deployment) as opened:
        made = exchange.roll_back(opened, sensor, number, datetime.now(UTC))
        if as_json:
            print_json(_summary_fields(made))
            return 0
        print(f"serial {made.serial}: version {made.number} is a copy of version {number}; all are kept")
        print(_APPLIED_NOTE)
        return 0


def run_export(
    store: Path | None, deployment: Path | None, sensors: Sequence[str], history: bool, out: Path | None
) -> int:
    """Export calibrations as JSON; exit status 0, or 2 (no such sensor, or the file can't be written)."""
    with _opened_store(store, deployment) as opened:
        newest = [exchange.find_version(opened, sensor) for sensor in sensors] or opened.newest_of_all()
        versions = [
            version for one in newest for version in (opened.versions(one.serial) if history else [one])
        ]
        if out is None:
            print(exchange.export_text(versions), end="")
            return 0
        try:
            out.write_text(exchange.export_text(versions), encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{out}: can't be written: {error.strerror}") from error
        print(f"wrote {len(versions)} calibrations to {out}")
        return 0


def run_import(
    store: Path | None,
    deployment: Path | None,
    file: Path,
    serial: int | None,
    other_sensor: bool,
    as_json: bool,
) -> int:
    """Import exported calibrations; exit status 0, or 2 (no export, or another sensor's)."""
    with _opened_store(store, deployment, create=True) as opened:
        versions = exchange.import_versions(
            opened, file, serial, accept_mismatch=other_sensor, now=datetime.now(UTC)
        )
        if as_json:
            print_json([_summary_fields(made) for made in versions])
            return 0
        for made in versions:
            foreign = made.provenance.foreign
            print(f"serial {made.serial}: version {made.number}{f', {foreign}' if foreign else ''}")
        print(_APPLIED_NOTE)
        return 0


@contextmanager
def _opened_store(store: Path | None, deployment: Path | None, create: bool = False) -> Iterator[Store]:
    """Open a store by its path or its deployment file, by default the user's."""
    if store is None:
        loaded = None if deployment is None else config.load(deployment)
        store = store_path(loaded, None if deployment is None else deployment.parent)
    with Store(store, create=create) as opened:
        yield opened


def _print_version(version: CalibrationVersion) -> None:
    origin = version.provenance
    print(f"\nserial {version.serial}, version {version.number}, under the tables {version.config}")
    print(f"written {version.written_utc} by {origin.program or '?'} on {origin.host or '?'}")
    for text in (origin.note, origin.foreign and f"FROM ANOTHER SENSOR: {origin.foreign}"):
        if text:
            print(text)
    for name, _, value in differences(Calibration(), version.calibration):
        print(f"{name:<22} {_format_value(value)}")
    for name in ("gains", "law", "second_law"):
        if part := getattr(version.calibration, name):
            deviations = [part.covariance[i][i] ** 0.5 for i in range(len(part.covariance))]
            print(f"{name + ' std':<22} {_format_value(deviations)}")


def _summary_line(version: CalibrationVersion) -> str:
    origin = version.provenance
    return (
        f"version {version.number:<4} {version.written_utc[:19]}Z  {origin.hand}/{origin.link:<18} "
        f"{_content_text(version)}"
    )


def _content_text(version: CalibrationVersion) -> str:
    origin = version.provenance
    names = "gains", "offsets", "law", "second_law", "sheet"
    parts = [name for name in names if getattr(version.calibration, name)]
    return (
        f"{'+'.join(parts)}: {origin.method}, {origin.contacts} contacts"
        f"{'  FROM ANOTHER SENSOR' if origin.foreign else ''}{f'  ({origin.note})' if origin.note else ''}"
    )


def _summary_fields(version: CalibrationVersion) -> dict[str, Any]:
    return {k: v for k, v in version.to_json().items() if k != "calibration"}


def _format_value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return "  ".join(_format_value(v) for v in value) if isinstance(value, list | tuple) else str(value)
