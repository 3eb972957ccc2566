"""Selection, rollback, export and import of stored calibrations.

Public: `find_version`, `roll_back`, `export_text`, `read_export`, `import_versions`. A sensor is named by its
serial number, or by the link that it was calibrated on last, as "thumb_distal" or "right/thumb_distal".
"""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from handtouch.calibration.calibration import CalibrationVersion, MismatchError, Provenance, check_match
from handtouch.calibration.store import Store, StoreError
from handtouch.host.user import program_name

_FORMAT, _FORMAT_VERSION = "handtouch-calibrations", 1


def find_version(store: Store, sensor: str, number: int | None = None) -> CalibrationVersion:
    """Return a version of a sensor, by default the newest. Raises StoreError listing what there is."""
    if (serial := _parse_serial(sensor)) is not None:
        newest = store.newest(serial)
        if number is None and newest is not None:
            return newest
        return store.get(serial, 1 if number is None else number)
    all_newest = store.newest_of_all()
    found = [version for version in all_newest if sensor in _link_names(version)]
    if len(found) != 1:
        known = ", ".join(f"{version.serial} ({_link_names(version)[1]})" for version in all_newest)
        count = "more than one sensor was" if found else "no sensor was"
        raise StoreError(
            f"{sensor}: {count} calibrated there last; give a serial number: {known or 'none yet'}"
        )
    return found[0] if number is None else store.get(found[0].serial, number)


def roll_back(store: Store, sensor: str, number: int, now: datetime) -> CalibrationVersion:
    """Write an older version of a sensor again, as the newest one. Raises StoreError as `find_version`."""
    serial = find_version(store, sensor, number).serial
    return store.roll_back(serial, number, _local_provenance(f"rolled back to version {number}"), now)


def export_text(versions: Sequence[CalibrationVersion]) -> str:
    """Return versions as JSON that `read_export` and `import_versions` read."""
    record = {"format": _FORMAT, "v": _FORMAT_VERSION, "versions": [v.to_json() for v in versions]}
    return json.dumps(record, indent=1) + "\n"


def read_export(file: Path) -> list[CalibrationVersion]:
    """Return the calibrations in an exported file. Raises StoreError naming file and problem."""
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(record, dict) or record.get("format") != _FORMAT:
            raise ValueError(
                f'was not written by `handtouch calibrations export`: "format" is not "{_FORMAT}"'
            )
        if record.get("v") != _FORMAT_VERSION:
            raise ValueError(f"has format version {record.get('v')}, this handtouch reads {_FORMAT_VERSION}")
        return [CalibrationVersion.from_json(version) for version in record["versions"]]
    except OSError as error:
        raise StoreError(f"{file}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{file}: {error}") from error


def import_versions(
    store: Store, file: Path, serial: int | None, *, accept_mismatch: bool, now: datetime
) -> list[CalibrationVersion]:
    """Write the calibrations of an exported file as new versions, for their own sensors or for `serial`.

    Those of another sensor need `accept_mismatch`; `provenance.foreign` then marks them. Raises StoreError
    before anything is written.
    """
    found = read_export(file)
    if serial is not None and len(found) != 1:
        raise StoreError(f"{file}: holds {len(found)} calibrations: --serial needs a file of one")
    try:
        mismatches = [
            check_match(v, v.serial if serial is None else serial, v.config, accept_mismatch=accept_mismatch)
            for v in found
        ]
    except MismatchError as error:
        raise StoreError(f"{file}: {error}, by --other-sensor") from error
    local = _local_provenance(f"imported from {file.name}")
    written = []
    for version, mismatch in zip(found, mismatches, strict=True):
        origin = replace(
            version.provenance, host=local.host, program=local.program, note=local.note, foreign=mismatch
        )
        target = version.serial if serial is None else serial
        written.append(store.write(target, version.config, version.calibration, origin, now))
    return written


def _parse_serial(sensor: str) -> int | None:
    try:
        return int(sensor, 0)
    except ValueError:
        return None


def _link_names(version: CalibrationVersion) -> tuple[str, str]:
    origin = version.provenance
    return origin.link, f"{origin.hand}/{origin.link}"


def _local_provenance(note: str) -> Provenance:
    return Provenance("", host=platform.node(), program=program_name(), note=note)
