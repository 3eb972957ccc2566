"""`handtouch calibrations`: look at the calibration store, go back in it, take calibrations out and in."""

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
from handtouch.supervise.calibration import Calibration, MismatchError, Provenance, Version, changes, fit
from handtouch.supervise.store import Store, StoreError, Unit, store_path

FORMAT = "handtouch-calibrations"
_FORMAT_VERSION = 1
_TAKEN = "a daemon that uses this store takes it within seconds; `handtouch status` tells what it applies"


def run_list(store: Path | None, deployment: Path | None, as_json: bool) -> int:
    """`handtouch calibrations list`; exit status 0, 1 (damaged stores lie beside it), 2 (no store)."""

    def work(opened: Store) -> int:
        units = opened.units()
        if as_json:
            rows = [{"versions": unit.versions, "newest": _heading(unit.newest)} for unit in units]
            print(json.dumps({"store": str(opened.path), "units": rows, "damaged": _names(opened)}, indent=2))
        else:
            print(f"{opened.path}: {len(units)} units")
            for unit in units:
                print(f"{unit.serial:<10} {unit.versions:>4} x  {_line(unit.newest)}")
        return _tell_damaged(opened)

    return _run(store, deployment, work)


def run_show(
    store: Path | None, deployment: Path | None, unit: str, number: int | None, as_json: bool
) -> int:
    """`handtouch calibrations show`; exit status 0, or 2 (there is none such)."""

    def work(opened: Store) -> int:
        version = _find(opened, unit, number)
        if as_json:
            print(json.dumps(version.to_json(), indent=2))
            return 0
        for old in opened.versions(version.serial):
            print(f"{'>' if old == version else ' '} {_line(old)}")
        origin = version.provenance
        print(f"\nserial {version.serial}, version {version.number}, under {version.config}")
        print(f"written {version.written_utc} by {origin.program or '?'} on {origin.host or '?'}")
        for text in (origin.note, origin.foreign and f"NOT THIS UNIT'S OWN: {origin.foreign}"):
            if text:
                print(text)
        for name, _, value in changes(Calibration(), version.calibration):
            print(f"{name:<22} {_text(value)}")
        for name in ("gains", "law"):
            if part := getattr(version.calibration, name):
                deviations = [part.covariance[i][i] ** 0.5 for i in range(len(part.covariance))]
                print(f"{name + ' std':<22} {_text(deviations)}")
        return 0

    return _run(store, deployment, work)


def run_diff(
    store: Path | None, deployment: Path | None, unit: str, before: int | None, after: int | None
) -> int:
    """`handtouch calibrations diff`; exit status 0 (the same), 1 (they differ), 2 (there is none such)."""

    def work(opened: Store) -> int:
        new = _find(opened, unit, after)
        old = opened.get(new.serial, max(new.number - 1, 1) if before is None else before)
        print(f"--- {_line(old)}\n+++ {_line(new)}")
        rows: list[tuple[str, Any, Any]] = list(changes(old.calibration, new.calibration))
        if old.config != new.config:
            rows.insert(0, ("config", old.config, new.config))
        for name, one, other in rows:
            print(f"{name}\n  - {_text(one)}\n  + {_text(other)}")
        return 1 if rows else 0

    return _run(store, deployment, work)


def run_roll_back(store: Path | None, deployment: Path | None, unit: str, number: int) -> int:
    """`handtouch calibrations rollback`; exit status 0, or 2 (there is none such)."""

    def work(opened: Store) -> int:
        serial = _find(opened, unit, number).serial
        made = opened.roll_back(serial, number, _here(f"rolled back to version {number}"), _now())
        print(f"serial {serial}: version {made.number} is what version {number} was; none is lost")
        print(_TAKEN)
        return 0

    return _run(store, deployment, work)


def run_export(
    store: Path | None, deployment: Path | None, units: Sequence[str], history: bool, out: Path | None
) -> int:
    """`handtouch calibrations export`; exit status 0, or 2 (there is none such, or it can't be written)."""

    def work(opened: Store) -> int:
        newest = [_find(opened, unit, None) for unit in units] or [unit.newest for unit in opened.units()]
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

    return _run(store, deployment, work)


def run_import(
    store: Path | None, deployment: Path | None, file: Path, serial: int | None, other_unit: bool
) -> int:
    """`handtouch calibrations import`; exit status 0, or 2 (it is none, or another unit's)."""

    def work(opened: Store) -> int:
        found = exported(file)
        if serial is not None and len(found) != 1:
            raise StoreError(f"{file}: holds {len(found)} calibrations: --serial takes a file of one")
        # all are looked at before any is written
        try:
            fitting = [
                fit(v, v.serial if serial is None else serial, v.config, accept_mismatch=other_unit)
                for v in found
            ]
        except MismatchError as error:
            raise StoreError(f"{file}: {error}, by --other-unit") from error
        for one in fitting:
            version, target = one.version, one.version.serial if serial is None else serial
            note = _here(f"imported from {file.name}")
            origin = replace(
                version.provenance, host=note.host, program=note.program, note=note.note, foreign=one.mismatch
            )
            made = opened.write(target, version.config, version.calibration, origin, _now())
            print(f"serial {target}: version {made.number}" + (f", {one.mismatch}" if one.mismatch else ""))
        print(_TAKEN)
        return 0

    return _run(store, deployment, work, create=True)


def exported(file: Path) -> list[Version]:
    """The calibrations of an exported file. Raises StoreError naming the file and what is wrong with it."""
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise ValueError(
                f'is not what `handtouch calibrations export` writes: "format" is not "{FORMAT}"'
            )
        if record.get("v") != _FORMAT_VERSION:
            raise ValueError(f"has format version {record.get('v')}, this handtouch knows {_FORMAT_VERSION}")
        return [Version.from_json(version) for version in record["versions"]]
    except OSError as error:
        raise StoreError(f"{file}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{file}: {error}") from error


def _run(
    store: Path | None, deployment: Path | None, work: Callable[[Store], int], create: bool = False
) -> int:
    try:
        if store is None:
            loaded = None if deployment is None else config.load(deployment)
            beside = None if deployment is None else deployment.parent
            store = store_path(None if loaded is None else loaded.daemon.store, beside)
        with Store(store, create=create) as opened:
            return work(opened)
    except (StoreError, MismatchError, config.ConfigError) as error:
        print(error, file=sys.stderr)
        return 2


def _find(store: Store, unit: str, number: int | None) -> Version:
    """By serial number, or by the link that it was on last, as "thumb_distal" or "right/thumb_distal"."""
    with suppress(ValueError):
        serial = int(unit, 0)
        newest = store.newest(serial)
        if number is not None or newest is None:
            return store.get(serial, 1 if number is None else number)
        return store.get(serial, max(version.number for version in store.versions(serial)))
    units = store.units()
    found = [known for known in units if unit in _places(known)]
    if len(found) != 1:
        known = ", ".join(f"{u.serial} ({_places(u)[1]})" for u in units) or "none yet"
        many = "more than one unit was" if found else "no unit was"
        raise StoreError(f"{unit}: {many} calibrated there last; give a serial number: {known}")
    return found[0].newest if number is None else store.get(found[0].serial, number)


def _places(unit: Unit) -> tuple[str, str]:
    origin = unit.newest.provenance
    return origin.link, f"{origin.hand}/{origin.link}"


def _tell_damaged(store: Store) -> int:
    for path in store.damaged:
        print(f"{path}: a damaged store; delete it when nothing in it is missed", file=sys.stderr)
    return 1 if store.damaged else 0


def _names(store: Store) -> list[str]:
    return [str(path) for path in store.damaged]


def _line(version: Version) -> str:
    origin = version.provenance
    parts = [name for name in ("gains", "offsets", "law", "sheet") if getattr(version.calibration, name)]
    return (
        f"version {version.number:<4} {version.written_utc[:19]}Z  {origin.hand}/{origin.link:<18} "
        f"{'+'.join(parts)}: {origin.method}, {origin.contacts} contacts"
        f"{'  NOT ITS OWN' if origin.foreign else ''}{f'  ({origin.note})' if origin.note else ''}"
    )


def _heading(version: Version) -> dict[str, Any]:
    return {k: v for k, v in version.to_json().items() if k not in ("calibration", "sheet")}


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return "  ".join(_text(v) for v in value) if isinstance(value, list | tuple) else str(value)


def _here(note: str) -> Provenance:
    program = f"{getpass.getuser()}, handtouch {handtouch.__version__}"
    return Provenance("", host=platform.node(), program=program, note=note)


def _now() -> datetime:
    return datetime.now(UTC)
