"""Actions and output of `handtouch calibrations`: list, compare, roll back, export and import
calibrations."""

from __future__ import annotations

import getpass
import json
import platform
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import handtouch
from handtouch import config
from handtouch.calibration.calibration import (
    Calibration,
    CalibrationVersion,
    MismatchError,
    Provenance,
    check_match,
    differences,
)
from handtouch.calibration.store import (
    NodeHistory,
    Store,
    StoreError,
    store_path,
)

FORMAT = "handtouch-calibrations"
_FORMAT_VERSION = 1
_APPLIED_NOTE = "a daemon that uses this store applies it within seconds; see `handtouch status`"


def run_list(store: Path | None, deployment: Path | None, as_json: bool) -> int:
    """List every sensor; exit status 0, 1 (damaged stores exist beside it), 2 (no store)."""

    def action(opened: Store) -> int:
        nodes = opened.node_histories()
        if as_json:
            rows = [
                {"versions": node.version_count, "newest": _summary_fields(node.newest)} for node in nodes
            ]
            print(
                json.dumps(
                    {"store": str(opened.path), "sensors": rows, "damaged": _damaged_names(opened)}, indent=2
                )
            )
        else:
            print(f"{opened.path}: {len(nodes)} sensors")
            for node in nodes:
                print(f"{node.serial:<10} {node.version_count:>4} x  {_summary_line(node.newest)}")
        return _report_damaged(opened)

    return _run_with_store(store, deployment, action)


def run_show(
    store: Path | None, deployment: Path | None, unit: str, number: int | None, as_json: bool
) -> int:
    """Show versions of a sensor; exit status 0, or 2 (no such version)."""

    def action(opened: Store) -> int:
        version = _find_version(opened, unit, number)
        if as_json:
            print(json.dumps(version.to_json(), indent=2))
            return 0
        for old in opened.versions(version.serial):
            print(f"{'>' if old == version else ' '} {_summary_line(old)}")
        origin = version.provenance
        print(f"\nserial {version.serial}, version {version.number}, under the tables {version.config}")
        print(f"written {version.written_utc} by {origin.program or '?'} on {origin.host or '?'}")
        for text in (origin.note, origin.foreign and f"FROM ANOTHER SENSOR: {origin.foreign}"):
            if text:
                print(text)
        for name, _, value in differences(Calibration(), version.calibration):
            print(f"{name:<22} {_format_value(value)}")
        for name in ("gains", "law"):
            if part := getattr(version.calibration, name):
                deviations = [part.covariance[i][i] ** 0.5 for i in range(len(part.covariance))]
                print(f"{name + ' std':<22} {_format_value(deviations)}")
        return 0

    return _run_with_store(store, deployment, action)


def run_diff(
    store: Path | None, deployment: Path | None, unit: str, before: int | None, after: int | None
) -> int:
    """Compare two versions; exit status 0 (equal), 1 (different), 2 (no such version)."""

    def action(opened: Store) -> int:
        new = _find_version(opened, unit, after)
        old = opened.get(new.serial, max(new.number - 1, 1) if before is None else before)
        print(f"--- {_summary_line(old)}\n+++ {_summary_line(new)}")
        rows: list[tuple[str, Any, Any]] = list(differences(old.calibration, new.calibration))
        if old.config != new.config:
            rows.insert(0, ("config", old.config, new.config))
        for name, one, other in rows:
            print(f"{name}\n  - {_format_value(one)}\n  + {_format_value(other)}")
        return 1 if rows else 0

    return _run_with_store(store, deployment, action)


def run_roll_back(store: Path | None, deployment: Path | None, unit: str, number: int) -> int:
    """Write an older version again; exit status 0, or 2 (no such version)."""

    def action(opened: Store) -> int:
        serial = _find_version(opened, unit, number).serial
        made = opened.roll_back(serial, number, _local_provenance(f"rolled back to version {number}"), _now())
        print(f"serial {serial}: version {made.number} is a copy of version {number}; all versions are kept")
        print(_APPLIED_NOTE)
        return 0

    return _run_with_store(store, deployment, action)


def run_export(
    store: Path | None, deployment: Path | None, units: Sequence[str], history: bool, out: Path | None
) -> int:
    """Export calibrations as JSON; exit status 0, or 2 (no such sensor, or the file can't be written)."""

    def action(opened: Store) -> int:
        newest = [_find_version(opened, unit, None) for unit in units] or [
            unit.newest for unit in opened.node_histories()
        ]
        versions = [
            version for one in newest for version in (opened.versions(one.serial) if history else [one])
        ]
        record = {"format": FORMAT, "v": _FORMAT_VERSION, "versions": [v.to_json() for v in versions]}
        text = json.dumps(record, indent=1) + "\n"
        if out is None:
            print(text, end="")
            return 0
        try:
            out.write_text(text, encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{out}: can't be written: {error.strerror}") from error
        print(f"wrote {len(versions)} calibrations to {out}")
        return 0

    return _run_with_store(store, deployment, action)


def run_import(
    store: Path | None, deployment: Path | None, file: Path, serial: int | None, other_sensor: bool
) -> int:
    """Import exported calibrations; exit status 0, or 2 (no export, or another sensor's)."""

    def action(opened: Store) -> int:
        found = read_export(file)
        if serial is not None and len(found) != 1:
            raise StoreError(f"{file}: holds {len(found)} calibrations: --serial needs a file of one")
        # all are checked before any is written
        try:
            fitting = [
                check_match(v, v.serial if serial is None else serial, v.config, accept_mismatch=other_sensor)
                for v in found
            ]
        except MismatchError as error:
            raise StoreError(f"{file}: {error}, by --other-sensor") from error
        for one in fitting:
            version, target = one.version, one.version.serial if serial is None else serial
            note = _local_provenance(f"imported from {file.name}")
            origin = replace(
                version.provenance, host=note.host, program=note.program, note=note.note, foreign=one.mismatch
            )
            made = opened.write(target, version.config, version.calibration, origin, _now())
            print(f"serial {target}: version {made.number}" + (f", {one.mismatch}" if one.mismatch else ""))
        print(_APPLIED_NOTE)
        return 0

    return _run_with_store(store, deployment, action, create=True)


def read_export(file: Path) -> list[CalibrationVersion]:
    """Return the calibrations in an exported file. Raises StoreError naming file and problem."""
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise ValueError(
                f'was not written by `handtouch calibrations export`: "format" is not "{FORMAT}"'
            )
        if record.get("v") != _FORMAT_VERSION:
            raise ValueError(f"has format version {record.get('v')}, this handtouch reads {_FORMAT_VERSION}")
        return [CalibrationVersion.from_json(version) for version in record["versions"]]
    except OSError as error:
        raise StoreError(f"{file}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{file}: {error}") from error


def _run_with_store(
    store: Path | None, deployment: Path | None, action: Callable[[Store], int], create: bool = False
) -> int:
    try:
        if store is None:
            loaded = None if deployment is None else config.load(deployment)
            beside = None if deployment is None else deployment.parent
            store = store_path(None if loaded is None else loaded.daemon.store, beside)
        with Store(store, create=create) as opened:
            return action(opened)
    except (StoreError, MismatchError, config.ConfigError) as error:
        print(error, file=sys.stderr)
        return 2


def _find_version(store: Store, unit: str, number: int | None) -> CalibrationVersion:
    """Return a version by serial number, or by the last link, as "thumb_distal" or "right/thumb_distal"."""
    with suppress(ValueError):
        serial = int(unit, 0)
        newest = store.newest(serial)
        if number is not None or newest is None:
            return store.get(serial, 1 if number is None else number)
        return store.get(serial, max(version.number for version in store.versions(serial)))
    nodes = store.node_histories()
    found = [known for known in nodes if unit in _link_names(known)]
    if len(found) != 1:
        known = ", ".join(f"{u.serial} ({_link_names(u)[1]})" for u in nodes) or "none yet"
        count = "more than one sensor was" if found else "no sensor was"
        raise StoreError(f"{unit}: {count} calibrated there last; give a serial number: {known}")
    return found[0].newest if number is None else store.get(found[0].serial, number)


def _link_names(node: NodeHistory) -> tuple[str, str]:
    origin = node.newest.provenance
    return origin.link, f"{origin.hand}/{origin.link}"


def _report_damaged(store: Store) -> int:
    for path in store.damaged_files:
        print(f"{path}: a damaged store; delete it once its content isn't needed", file=sys.stderr)
    return 1 if store.damaged_files else 0


def _damaged_names(store: Store) -> list[str]:
    return [str(path) for path in store.damaged_files]


def _summary_line(version: CalibrationVersion) -> str:
    origin = version.provenance
    parts = [name for name in ("gains", "offsets", "law", "sheet") if getattr(version.calibration, name)]
    return (
        f"version {version.number:<4} {version.written_utc[:19]}Z  {origin.hand}/{origin.link:<18} "
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


def _local_provenance(note: str) -> Provenance:
    program = f"{getpass.getuser()}, handtouch {handtouch.__version__}"
    return Provenance("", host=platform.node(), program=program, note=note)


def _now() -> datetime:
    return datetime.now(UTC)
