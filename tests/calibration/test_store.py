"""Calibration store: nothing is overwritten, silently lost, or silently applied to the wrong node."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import sqlite3
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from handtouch.calibration.calibration import (
    Calibration,
    CalibrationVersion,
    Gains,
    LawParameters,
    MismatchError,
    Offsets,
    Provenance,
    StoredSheetState,
    channel_values,
    check_match,
    matrix,
)
from handtouch.calibration.store import (
    DamagedStoreError,
    Store,
    StoreError,
    damaged_files,
)
from handtouch.calibration.store_file import SCHEMA_VERSION
from handtouch.calibration.store_path import store_path
from handtouch.config import load, shipped

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
CONFIG = "nominal-0123456789ab"


def calibration(seed: int) -> Calibration:
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(4, 4)) * 1e-3
    return Calibration(
        Gains(channel_values(np.exp(generator.normal(0, 0.02, 4))), matrix(root @ root.T)),
        Offsets(channel_values(generator.normal(0, 3, 4)), (0.5, 0.4, 0.3, 0.2)),
        LawParameters(20_000.0 + seed, 1.5, 2400.0, matrix(np.diag([1e-4, 1e-4, 1e-6]))),
        StoredSheetState("creep", 3, generator.bytes(40)),
    )


def provenance(seed: int) -> Provenance:
    return Provenance("gains from contacts", 100 * seed, 1.01, "right", "thumb_distal", "robot1", "0.1")


def filled(path: Path, count: int = 6) -> list[CalibrationVersion]:
    """Write versions of two nodes."""
    with Store(path) as store:
        return [
            store.write(1001 + k % 2, CONFIG, calibration(k), provenance(k), NOW + timedelta(seconds=k))
            for k in range(count)
        ]


def content(path: Path) -> list[CalibrationVersion]:
    with Store(path, create=False) as store:
        return sorted(
            (version for newest in store.newest_of_all() for version in store.versions(newest.serial)),
            key=lambda version: version.written_utc,
        )


def test_written_versions_are_read_back_exactly(tmp_path: Path) -> None:
    written = filled(tmp_path / "store.db")
    assert content(tmp_path / "store.db") == written
    assert [version.number for version in written] == [1, 1, 2, 2, 3, 3]


def test_every_write_adds_a_version(tmp_path: Path) -> None:
    with Store(tmp_path / "store.db") as store:
        first = store.write(7, CONFIG, calibration(1), provenance(1), NOW)
        second = store.write(7, CONFIG, calibration(2), provenance(2), NOW)
        back = store.roll_back(7, 1, Provenance("", host="robot2", note="because"), NOW)
        assert store.versions(7) == [first, second, back]
        assert (back.number, back.calibration) == (3, first.calibration)
        assert back.provenance == replace(provenance(1), host="robot2", program="", note="because")
        assert store.newest(7) == back
        with pytest.raises(StoreError, match="no version 9 of serial 7; there are: 1, 2, 3"):
            store.roll_back(7, 9, provenance(1), NOW)
        with pytest.raises(StoreError, match="none of that serial"):
            store.get(8, 1)


@pytest.mark.parametrize("part", ["gains", "offsets", "law", "sheet"])
def test_any_part_of_a_calibration_may_be_missing(tmp_path: Path, part: str) -> None:
    some = replace(calibration(1), **{part: None})
    with Store(tmp_path / "store.db") as store:
        assert store.write(7, CONFIG, some, Provenance("x"), NOW).calibration == some
        assert store.get(7, 1).calibration == some


def test_version_round_trips_through_json(tmp_path: Path) -> None:
    for version in filled(tmp_path / "store.db"):
        assert CalibrationVersion.from_json(version.to_json()) == version


def test_a_law_stored_without_its_age_holds_at_that_of_settled_weights() -> None:
    stated = CalibrationVersion(7, CONFIG, 1, "", Provenance("x"), calibration(1))
    record = stated.to_json()
    assert record["calibration"]["law"].pop("age_s") == 1.5
    assert CalibrationVersion.from_json(record) == stated


def from_record(**changes: object) -> CalibrationVersion:
    record = CalibrationVersion(7, CONFIG, 1, "", Provenance("x"), calibration(1)).to_json()
    return CalibrationVersion.from_json(record | changes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: channel_values([1, 1]), r"has shape \(2,\)"),
        (lambda: Gains(factors=(1, 1, 1, 0), covariance=matrix(np.eye(4))), r"factors\.3\n.*greater than 0"),
        (lambda: Gains((1, 1, 1, float("nan")), matrix(np.eye(4))), "finite number"),
        (lambda: Gains((1, 1, 1, 1), matrix(-np.eye(4))), "negative eigenvalues"),
        (lambda: Gains((1, 1, 1, 1), matrix(np.triu(np.ones((4, 4))))), "symmetric"),
        (lambda: Offsets(counts=(0, 0, 0, 0), variance=(1, 1, 1, -1)), r"variance\.3\n.*equal to 0"),
        (lambda: LawParameters(1.0, alpha=-1.0, ohm_per_square=1.0, covariance=matrix(np.eye(3))), "alpha"),
        (lambda: from_record(calibration={"gain": {}}), "version.calibration.gain: unknown key"),
        (
            lambda: from_record(calibration={"gains": {"factors": [1, 1, 1, 1]}}),
            "gains.covariance: missing key",
        ),
        (lambda: from_record(calibration=[]), "calibration: must be an object"),
        (lambda: from_record(provenance={"method": 5}), "provenance.method: must be a valid string"),
        (lambda: from_record(serial="x"), "version.serial"),
    ],
)
def test_invalid_values_are_refused_by_name(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("serial", [0, -1, 2**32])
def test_serial_number_out_of_range_is_refused(tmp_path: Path, serial: int) -> None:
    with Store(tmp_path / "store.db") as store:
        with pytest.raises(ValueError, match="serial = "):
            store.write(serial, CONFIG, calibration(1), provenance(1), NOW)
        assert store.newest_of_all() == []


def test_calibration_of_another_node_or_other_tables_needs_explicit_acceptance() -> None:
    version = CalibrationVersion(7, CONFIG, 1, "", Provenance("x"), calibration(1))
    assert check_match(version, 7, CONFIG) == ""
    for serial, config, message in (
        (8, CONFIG, "serial 7, not for 8"),
        (7, "nominal-other", "nominal-other"),
    ):
        with pytest.raises(MismatchError, match=message):
            check_match(version, serial, config)
        assert message in check_match(version, serial, config, accept_mismatch=True)
    foreign = replace(version, provenance=Provenance("x", foreign="values of serial 9"))
    with pytest.raises(MismatchError, match="values of serial 9"):
        check_match(foreign, 7, CONFIG)


def test_version_under_the_same_tables_precedes_a_newer_one_under_others(tmp_path: Path) -> None:
    with Store(tmp_path / "store.db") as store:
        own = store.write(7, CONFIG, calibration(1), provenance(1), NOW)
        other = store.write(7, "nominal-other", calibration(2), provenance(2), NOW)
        assert store.newest(7, CONFIG) == own
        assert store.newest(7) == other
        assert store.newest(7, "nominal-third") == other
        assert store.newest(8, CONFIG) is None


# --- damage


def test_file_truncated_anywhere_is_moved_aside_and_never_read_as_empty(tmp_path: Path) -> None:
    whole = tmp_path / "whole.db"
    filled(whole)
    data = whole.read_bytes()
    pages = range(0, len(data), 4096)
    lengths = {
        0,
        1,
        15,
        16,
        99,
        100,
        511,
        512,
        len(data) - 1,
        *pages,
        *(p + 1 for p in pages),
        *(p + 4095 for p in pages),
    }
    for length in sorted(length for length in lengths if length < len(data)):
        path = tmp_path / str(length) / "store.db"
        path.parent.mkdir()
        path.write_bytes(data[:length])
        with pytest.raises(DamagedStoreError, match="damaged") as caught:
            Store(path)
        (moved,) = damaged_files(path)
        assert moved.read_bytes() == data[:length]
        assert str(moved) in str(caught.value)
        assert not path.exists()
        with Store(path) as fresh:
            assert fresh.newest_of_all() == []


def test_flipped_byte_is_detected_or_has_no_effect(tmp_path: Path) -> None:
    whole = tmp_path / "whole.db"
    written = filled(whole, 3)
    data = whole.read_bytes()
    used = [k for k, byte in enumerate(data) if byte or k < 200]
    found = 0
    for k in [*used[:300], *used[300::7]]:
        path = tmp_path / f"{k}.db"
        path.write_bytes(data[:k] + bytes([data[k] ^ (1 << k % 8)]) + data[k + 1 :])
        try:
            assert content(path) == written, k
        except DamagedStoreError:
            found += 1
        assert path.exists() != (len(damaged_files(path)) == 1), k
        path.unlink(missing_ok=True)
    assert found > 500


def test_removed_or_edited_row_is_detected(tmp_path: Path) -> None:
    for number, change in enumerate(
        (
            "DELETE FROM calibration WHERE id = 2",
            "DELETE FROM calibration WHERE id = 6",
            "UPDATE calibration SET serial = 1 WHERE id = 3",
            "UPDATE calibration SET version = '{}' WHERE id = 3",
            "DELETE FROM calibration",
            "DELETE FROM head",
            "DROP TABLE calibration",
        )
    ):
        path = tmp_path / f"{number}.db"
        filled(path)
        connection = sqlite3.connect(path)
        connection.execute(change)
        connection.commit()
        connection.close()
        with pytest.raises(DamagedStoreError):
            Store(path)


_TORN = """
import os, sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("PRAGMA synchronous = EXTRA")
connection.execute("PRAGMA cache_size = 1")  # so that pages are spilled before the commit
connection.execute("PRAGMA cache_spill = 1")
connection.execute("BEGIN IMMEDIATE")
connection.execute("UPDATE calibration SET version = hex(randomblob(4500))")
connection.execute("UPDATE head SET digest = randomblob(32)")
os.kill(os.getpid(), 9)
"""


@pytest.fixture
def torn(tmp_path: Path) -> tuple[Path, list[CalibrationVersion]]:
    """A store whose writer was killed with some pages of its transaction in the file already."""
    path = tmp_path / "torn" / "store.db"
    path.parent.mkdir()
    written = filled(path, 12)
    whole = path.read_bytes()
    killed = subprocess.run([sys.executable, "-c", _TORN, str(path)], check=False)
    assert killed.returncode == -9
    assert path.read_bytes() != whole
    assert path.with_name("store.db-journal").stat().st_size > 4096
    return path, written


def test_interrupted_write_is_undone(torn: tuple[Path, list[CalibrationVersion]]) -> None:
    path, written = torn
    assert content(path) == written
    assert not path.with_name("store.db-journal").exists()


def test_torn_journal_never_changes_values_silently(
    torn: tuple[Path, list[CalibrationVersion]], tmp_path: Path
) -> None:
    path, written = torn
    journal = path.with_name("store.db-journal").read_bytes()
    outcomes = set()
    lengths = {0, 1, 27, 28, 511, 512, 513, *range(0, len(journal), 1031), len(journal) - 1}
    for length in sorted(lengths):
        copy = tmp_path / str(length) / "store.db"
        copy.parent.mkdir()
        shutil.copy(path, copy)
        copy.with_name("store.db-journal").write_bytes(journal[:length])
        try:
            assert content(copy) == written, length
            outcomes.add("undone")
        except DamagedStoreError:
            outcomes.add("detected")
        assert not copy.with_name("store.db-journal").exists()  # or it would be applied to a new store
    assert "detected" in outcomes


def test_journal_without_its_store_is_not_applied_to_a_new_one(
    torn: tuple[Path, list[CalibrationVersion]],
) -> None:
    path, _ = torn
    journal = path.with_name("store.db-journal")
    data = journal.read_bytes()
    path.unlink()
    for earlier in range(2):
        with pytest.raises(DamagedStoreError, match="journal without its store"):
            Store(path)
        kept = list(path.parent.glob("*.damaged-*-journal"))
        assert [file.read_bytes() for file in kept] == [data] * (earlier + 1)  # none replaces another
        with Store(path) as fresh:
            assert fresh.newest_of_all() == []
        path.unlink()
        journal.write_bytes(data)


def _open_count(path: Path) -> int:
    """Return how many descriptors of this process refer to the file at `path`."""
    inode, found = path.stat().st_ino, 0
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            found += os.fstat(int(name)).st_ino == inode
    return found


def test_store_that_replaced_a_damaged_one_meanwhile_is_not_moved_aside(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    filled(path)
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("DELETE FROM calibration WHERE id = 2")
    other.execute("BEGIN EXCLUSIVE")
    before = _open_count(path)
    with ThreadPoolExecutor(1) as pool:
        opening = pool.submit(Store, path)  # waits for the lock
        open_since = time.monotonic()
        while time.monotonic() - open_since < 0.1:
            if _open_count(path) == before:
                open_since = time.monotonic()
            time.sleep(0.005)
        path.rename(tmp_path / "damaged")
        written = filled(path)
        other.close()
        with pytest.raises(DamagedStoreError, match="another process moved it"):
            opening.result()
    assert content(path) == written


@pytest.mark.parametrize(
    "data", [b"[daemon]\nsync_period_ms = 5.0\n" * 40, b"x", b"SQLite format 2\0" + b"x" * 600]
)
def test_file_that_is_no_store_stays_unchanged(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "hand.toml"
    path.write_bytes(data)
    with pytest.raises(StoreError, match="is not a calibration store"):
        Store(path)
    assert path.read_bytes() == data
    assert list(tmp_path.iterdir()) == [path]


def test_database_of_another_program_stays_unchanged(tmp_path: Path) -> None:
    connection = sqlite3.connect(tmp_path / "mail.db")
    connection.execute("CREATE TABLE letters (text)")
    connection.close()
    with pytest.raises(StoreError, match="is not a calibration store"):
        Store(tmp_path / "mail.db")
    assert len(list(tmp_path.iterdir())) == 1


# --- schemas


@pytest.mark.parametrize(
    ("schema", "remedy"), [(1, "move it away"), (SCHEMA_VERSION + 1, "update handtouch")]
)
def test_store_of_another_schema_is_refused_with_the_remedy_and_stays_unchanged(
    tmp_path: Path, schema: int, remedy: str
) -> None:
    path = tmp_path / "store.db"
    filled(path)
    connection = sqlite3.connect(path)
    connection.execute(f"PRAGMA user_version = {schema}")
    connection.execute("UPDATE head SET schema = ?", (schema,))
    connection.commit()
    connection.close()
    before = path.read_bytes()
    with pytest.raises(StoreError, match=f"has schema {schema}, .*: {remedy}"):
        Store(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# --- several processes, permissions, paths

_WRITER = """
import sys
from datetime import datetime, UTC
from handtouch.calibration.calibration import Calibration, Provenance
from handtouch.calibration.store import Store
with Store(sys.argv[1]) as store:
    for k in range(int(sys.argv[2])):
        store.write(5, "c", Calibration(), Provenance("x", k), datetime.now(UTC))
"""


def test_readers_see_complete_versions_during_concurrent_writes(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    filled(path)
    writers = [subprocess.Popen([sys.executable, "-c", _WRITER, str(path), "40"]) for _ in range(2)]
    seen = 0
    with Store(path) as reader:
        while any(writer.poll() is None for writer in writers):
            numbers = [version.number for version in reader.versions(5)]
            assert numbers == list(range(1, len(numbers) + 1))
            assert len(numbers) >= seen
            seen = len(numbers)
            with Store(path) as other:  # checks everything
                assert len(other.newest_of_all()) >= 2
    assert [writer.returncode for writer in writers] == [0, 0]
    with Store(path) as store:
        assert [version.number for version in store.versions(5)] == list(range(1, 81))


def test_store_that_was_moved_while_open_refuses_writes(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    with Store(path) as store:
        path.rename(tmp_path / "elsewhere.db")
        with pytest.raises(StoreError, match="open it again"):
            store.write(7, CONFIG, calibration(1), provenance(1), NOW)


def test_failed_write_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    written = filled(path)
    large = Calibration(sheet=StoredSheetState("creep", 1, bytes(100_000)))
    with Store(path) as store:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, before[1]))  # as on a full disk
        try:
            with pytest.raises(StoreError, match="can't be written"):
                store.write(7, CONFIG, large, provenance(1), NOW)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        store.write(7, CONFIG, calibration(1), provenance(1), NOW + timedelta(days=1))
    assert content(path)[:-1] == written


def test_store_is_readable_by_all_and_writable_by_its_owner(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        filled(tmp_path / "store.db")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "store.db").stat().st_mode) == 0o644
    assert [entry.name for entry in tmp_path.iterdir()] == ["store.db"]  # a single file between writes


def test_store_that_cannot_be_created_reports_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"\[daemon\] store"):
        Store(tmp_path / "file" / "store.db")
    with pytest.raises(StoreError, match="no calibration store here yet"):
        Store(tmp_path / "store.db", create=False)


def test_a_full_disk_leaves_no_file_of_a_store_that_could_not_be_created(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(StoreError, match="can't be created"):
            Store(tmp_path / "cal.db")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_default_path_of_the_store(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert store_path() == tmp_path / ".local/state/handtouch/calibrations.db"
    monkeypatch.setenv("XDG_STATE_HOME", "relative")  # ignored according to the XDG specification
    assert store_path() == tmp_path / ".local/state/handtouch/calibrations.db"
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert store_path() == tmp_path / "state/handtouch/calibrations.db"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/handtouch/right")
    assert store_path() == Path("/var/lib/handtouch/right/calibrations.db")
    deployment = load(shipped.path("two_finger.toml"))
    named = [
        deployment.model_copy(update={"daemon": deployment.daemon.model_copy(update={"store": name})})
        for name in ("cal.db", "/srv/cal.db")
    ]
    assert [store_path(one, tmp_path) for one in named] == [tmp_path / "cal.db", Path("/srv/cal.db")]


@pytest.mark.parametrize(
    ("bus", "name"),
    [("socketcan:can0", "calibrations.db"), ("udp_multicast:239.74.163.2", "simulated.db")],
)
def test_simulated_nodes_have_a_store_of_their_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, bus: str, name: str
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    deployment = load(shipped.path("two_finger.toml"), [f"can0={bus}"])
    assert store_path(deployment) == tmp_path / name
