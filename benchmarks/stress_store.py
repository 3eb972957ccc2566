"""The calibration store: kills at random instants, writes and openings.

A process opens the store, estimates gains by contacts and writes versions of three nodes without a pause, and
is killed at a random instant of any of that. It reports what it begins and every commit on a pipe; the store
must hold what it had committed. A kill doesn't lose what the kernel has; for power loss see
[calibrations](../calibrations.md). *The store*: a whole calibration a write;
opening checks the digest of all rows.
"""

from __future__ import annotations

import os
import signal
import sqlite3
import struct
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.page import Report, options, progress

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from handtouch.calibration.calibration import (
    Calibration,
    Gains,
    LawParameters,
    Offsets,
    Provenance,
    StoredSheetState,
    channel_values,
    matrix,
)
from handtouch.calibration.gains import GainEstimator
from handtouch.calibration.store import Store
from handtouch.field import Rectangle

ROOT = Path(__file__).parent.parent
KILLS = 500
MOST_COMMITS = 4
"""That a process makes before it is killed, at most."""
SERIALS = (1001, 1002, 1003)
CONFIG = "nominal-0123456789ab"
_RECORD = struct.Struct("<BII")
OPENING, CALIBRATING, STORING, COMMITTED = range(4)
PHASES = ("opening", "calibrating", "storing", "between")


def calibration(serial: int, number: int, estimator: GainEstimator) -> Calibration:
    """Gains from contacts, and values that only this version of this node has."""
    generator = np.random.default_rng((serial, number))
    pad = Rectangle(1.4, 1.0)
    x, y = generator.uniform(0.1, 0.9, (2, 32)) * [[pad.a], [pad.b]]
    estimator.add_contacts(pad.fractions(x, y) + 1e-3 * generator.normal(size=(4, 32)), 1e-3, number)
    found = estimator.estimate
    return Calibration(
        Gains(channel_values(found.gains), matrix(found.covariance)),
        Offsets(channel_values(generator.normal(0, 3, 4)), (1.0, 1.0, 1.0, 1.0)),
        LawParameters(20_000.0, 1.5, 2400.0, matrix(np.diag([1e-4] * 3))),
        StoredSheetState("stress", number, mark(serial, number)),
    )


def mark(serial: int, number: int) -> bytes:
    """Return the expected sheet state of a version: 200 to 20,000 bytes."""
    generator = np.random.default_rng((serial, number, 1))
    return generator.bytes(int(200 * 10 ** generator.uniform(0, 2)))


def calibrate_and_store(path: Path, pipe: int) -> None:
    """Calibrate and store endlessly; report each phase and commit on the pipe before continuing."""
    with Store(path) as store:
        estimators = {serial: GainEstimator(Rectangle(1.4, 1.0)) for serial in SERIALS}
        while True:
            for serial, estimator in estimators.items():
                newest = store.newest(serial)
                number = 1 if newest is None else newest.number + 1
                os.write(pipe, _RECORD.pack(CALIBRATING, serial, number))
                found = calibration(serial, number, estimator)
                os.write(pipe, _RECORD.pack(STORING, serial, number))
                provenance = Provenance("stress", 32 * number)
                made = store.write(serial, CONFIG, found, provenance, datetime.now(UTC))
                os.write(pipe, _RECORD.pack(COMMITTED, serial, made.number))


class Killer:
    """Chooses instants: after so many steps of the process, and then a part of what such a step takes."""

    def __init__(self) -> None:
        self._generator = np.random.default_rng(1)
        self._usual_s = dict.fromkeys(range(4), 0.05)  # of each phase, on this machine, under its load
        self.phases = dict.fromkeys(PHASES, 0)

    def kill(self, path: Path) -> list[tuple[int, int]]:
        """Start a process and kill it; what it committed."""
        steps = 3 * int(self._generator.integers(MOST_COMMITS)) + int(self._generator.integers(3))
        child, reading = _start(path)
        reported = []
        for _ in range(steps):
            begin = time.monotonic()
            reported.append(_RECORD.unpack(os.read(reading, _RECORD.size)))
            self._saw(reported[-2][0] if len(reported) > 1 else OPENING, time.monotonic() - begin)
        last = reported[-1][0] if reported else OPENING
        time.sleep(float(self._generator.uniform(0, 1.2 * self._usual_s[last])))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            raise RuntimeError(f"the writer ended by itself with status {status}")
        with os.fdopen(reading, "rb") as pipe:
            reported += _RECORD.iter_unpack(pipe.read())
        self.phases[PHASES[reported[-1][0] if reported else OPENING]] += 1
        return [(serial, number) for phase, serial, number in reported if phase == COMMITTED]

    def _saw(self, phase: int, took_s: float) -> None:
        self._usual_s[phase] += 0.1 * (took_s - self._usual_s[phase])


def _start(path: Path) -> tuple[int, int]:
    """Start a writer; return its process number and the reading end of its pipe."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        try:
            calibrate_and_store(path, writing)
        finally:
            os._exit(1)
    os.close(writing)
    return child, reading


def kills(folder: Path, count: int) -> dict[str, Any]:
    """`count` times: kill, open, compare the versions with the reported ones."""
    path, killer = folder / "store.db", Killer()
    reported: dict[int, int] = dict.fromkeys(SERIALS, 0)
    counts = dict.fromkeys(("undone", "unreported", "lost", "wrong", "unopened"), 0)
    for kill in range(count):
        if kill % 50 == 0:
            progress(f"kill {kill} of {count}")
        for serial, number in killer.kill(path):
            reported[serial] = max(reported[serial], number)
        journal = path.with_name("store.db-journal")
        counts["undone"] += journal.exists() and journal.stat().st_size > 0
        try:
            store = Store(path)
        except Exception as error:  # noqa: BLE001 what the benchmark counts
            print(error, file=sys.stderr)
            counts["unopened"] += 1
            continue
        with store:
            for serial in SERIALS:
                versions = store.versions(serial)
                counts["lost"] += len(versions) < reported[serial]
                # one commit more than reported: killed between the two
                counts["unreported"] += len(versions) == reported[serial] + 1
                counts["wrong"] += len(versions) > reported[serial] + 1
                counts["wrong"] += [v.number for v in versions] != list(range(1, len(versions) + 1))
                for version in versions[reported[serial] - 5 :]:
                    sheet = version.calibration.sheet
                    counts["wrong"] += sheet is None or sheet.data != mark(serial, version.number)
                reported[serial] = len(versions)
    return {
        "kills": count,
        **{f"while {phase}": count for phase, count in killer.phases.items()},
        "commits": sum(reported.values()),
        "interrupted writes undone": counts["undone"],
        "committed but not reported yet": counts["unreported"],
        "lost commits": counts["lost"],
        "wrong contents": counts["wrong"],
        "not opened": counts["unopened"],
    }


def writes_and_openings(folder: Path, largest: int) -> list[dict[str, Any]]:
    """`Store.write` of a whole calibration, and opening (which checks everything), by versions."""
    path, rows, took = folder / "long.db", [], []
    estimator = GainEstimator(Rectangle(1.4, 1.0))
    made = calibration(1, 1, estimator)
    for number in range(1, largest + 1):
        if number == 1:
            store = Store(path)
        begin = time.perf_counter()
        store.write(1 + number % 15, CONFIG, made, Provenance("long"), datetime.now(UTC))
        took.append(1e3 * (time.perf_counter() - begin))
        if number in (100, 1000, 3000):
            store.close()
            opened = []
            for _ in range(5):
                begin = time.perf_counter()
                Store(path).close()
                opened.append(1e3 * (time.perf_counter() - begin))
            rows.append(
                {
                    "versions": number,
                    "file, MB": path.stat().st_size / 1e6,
                    "opening, ms": float(np.median(opened)),
                    **{f"write {name}": value for name, value in _quantiles(took[-100:]).items()},
                }
            )
            store = Store(path)
    store.close()
    return rows


def _quantiles(took_ms: list[float]) -> dict[str, float]:
    return {
        "median, ms": float(np.median(took_ms)),
        "99 %, ms": float(np.quantile(took_ms, 0.99)),
        "most, ms": max(took_ms),
    }


def main() -> int:
    quick = options(__doc__).parse_args().quick
    report = Report(quick, sqlite=sqlite3.sqlite_version)
    with tempfile.TemporaryDirectory(dir=ROOT, prefix=".stress-") as name:  # on a disk: /tmp may be memory
        killed = kills(Path(name), 5 if quick else KILLS)
        report.table("Kill -9 while calibrating and storing", [killed])
        report.table("The store", writes_and_openings(Path(name), 100 if quick else 3000))
    for failure in ("lost commits", "wrong contents", "not opened"):
        report.limit(failure, killed[failure], 0)
    return int(not report.keep())


if __name__ == "__main__":
    sys.exit(main())
