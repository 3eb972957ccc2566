"""The calibration store: nothing is overwritten, lost in silence, or applied to the wrong unit in silence."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from handtouch.supervise import store_file
from handtouch.supervise.calibration import (
    Calibration,
    Gains,
    Law,
    MismatchError,
    Offsets,
    Provenance,
    SheetState,
    Version,
    fit,
    four,
    matrix,
)
from handtouch.supervise.store import DamagedStore, NewerStore, Store, StoreError, store_path

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
CONFIG = "nominal-0123456789ab"
DATA = Path(__file__).parents[1] / "data"


def calibration(seed: int) -> Calibration:
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(4, 4)) * 1e-3
    return Calibration(
        Gains(four(np.exp(generator.normal(0, 0.02, 4))), matrix(root @ root.T)),
        Offsets(four(generator.normal(0, 3, 4)), (0.5, 0.4, 0.3, 0.2)),
        Law(20_000.0 + seed, 1.5, 2400.0, matrix(np.diag([1e-4, 1e-4, 1e-6]))),
        SheetState("creep", 3, generator.bytes(40)),
    )


def told(seed: int) -> Provenance:
    return Provenance("gains from contacts", 100 * seed, 1.01, "right", "thumb_distal", "robot1", "0.1")


def filled(path: Path, count: int = 6) -> list[Version]:
    """Versions of two units."""
    with Store(path) as store:
        return [
            store.write(1001 + k % 2, CONFIG, calibration(k), told(k), NOW + timedelta(seconds=k))
            for k in range(count)
        ]


def content(path: Path) -> list[Version]:
    with Store(path, create=False) as store:
        return sorted(
            (version for unit in store.units() for version in store.versions(unit.serial)),
            key=lambda version: version.written_utc,
        )


def test_what_was_written_is_read_bit_by_bit_after_opening_again(tmp_path: Path) -> None:
    written = filled(tmp_path / "store.db")
    assert content(tmp_path / "store.db") == written
    assert [version.number for version in written] == [1, 1, 2, 2, 3, 3]


def test_every_write_is_a_new_version_and_old_ones_stay(tmp_path: Path) -> None:
    with Store(tmp_path / "store.db") as store:
        first = store.write(7, CONFIG, calibration(1), told(1), NOW)
        second = store.write(7, CONFIG, calibration(2), told(2), NOW)
        back = store.roll_back(7, 1, Provenance("", host="robot2", note="because"), NOW)
        assert store.versions(7) == [first, second, back]
        assert (back.number, back.calibration) == (3, first.calibration)
        assert back.provenance == replace(told(1), host="robot2", program="", note="because")
        assert store.newest(7) == back
        with pytest.raises(StoreError, match="no version 9 of serial 7; there are: 1, 2, 3"):
            store.roll_back(7, 9, told(1), NOW)
        with pytest.raises(StoreError, match="none of that serial"):
            store.get(8, 1)


@pytest.mark.parametrize("part", ["gains", "offsets", "law", "sheet"])
def test_a_calibration_may_lack_any_part(tmp_path: Path, part: str) -> None:
    some = replace(calibration(1), **{part: None})
    with Store(tmp_path / "store.db") as store:
        assert store.write(7, CONFIG, some, Provenance("x"), NOW).calibration == some
        assert store.get(7, 1).calibration == some


def test_a_version_survives_json(tmp_path: Path) -> None:
    for version in filled(tmp_path / "store.db"):
        assert Version.from_json(version.to_json()) == version


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: four([1, 1, 1]), r"has shape \(3,\)"),
        (lambda: Gains((1, 1, 1, 0), matrix(np.eye(4))), "above 0"),
        (lambda: Gains((1, 1, 1, float("nan")), matrix(np.eye(4))), "finite"),
        (lambda: Gains((1, 1, 1, 1), matrix(-np.eye(4))), "negative eigenvalues"),
        (lambda: Gains((1, 1, 1, 1), matrix(np.triu(np.ones((4, 4))))), "symmetric"),
        (lambda: Offsets((0, 0, 0, 0), (1, 1, 1, -1)), "not negative"),
        (lambda: Law(1.0, -1.0, 1.0, matrix(np.eye(3))), "law.alpha"),
        (lambda: Calibration.from_json({"gain": {}}), "calibration.gain: is not known"),
        (lambda: Calibration.from_json({"gains": {"factors": [1, 1, 1, 1]}}), "gains"),
        (lambda: Calibration.from_json([]), "must be a table"),
        (lambda: Provenance.from_json({"method": 5}), "provenance.method"),
        (lambda: Version.from_json({"serial": "x"}), "serial"),
    ],
)
def test_values_that_cannot_be_are_refused_by_name(make: Callable[[], object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()


@pytest.mark.parametrize("serial", [0, -1, 2**32])
def test_a_serial_that_binds_nothing_is_refused(tmp_path: Path, serial: int) -> None:
    with Store(tmp_path / "store.db") as store:
        with pytest.raises(ValueError, match="serial = "):
            store.write(serial, CONFIG, calibration(1), told(1), NOW)
        assert store.units() == []


def test_a_calibration_of_another_unit_or_other_tables_is_not_applied_without_saying_so() -> None:
    version = Version(7, CONFIG, 1, "", Provenance("x"), calibration(1))
    assert fit(version, 7, CONFIG).mismatch == ""
    for serial, config, said in ((8, CONFIG, "serial 7, not for 8"), (7, "nominal-other", "nominal-other")):
        with pytest.raises(MismatchError, match=said):
            fit(version, serial, config)
        assert said in fit(version, serial, config, accept_mismatch=True).mismatch
    foreign = replace(version, provenance=Provenance("x", foreign="values of serial 9"))
    with pytest.raises(MismatchError, match="values of serial 9"):
        fit(foreign, 7, CONFIG)


def test_the_newest_under_the_same_tables_goes_before_a_newer_one_under_others(tmp_path: Path) -> None:
    with Store(tmp_path / "store.db") as store:
        own = store.write(7, CONFIG, calibration(1), told(1), NOW)
        other = store.write(7, "nominal-other", calibration(2), told(2), NOW)
        assert store.newest(7, CONFIG) == own
        assert store.newest(7) == other
        assert store.newest(7, "nominal-third") == other
        assert store.newest(8, CONFIG) is None


# --- damage


def test_a_file_cut_anywhere_is_moved_aside_with_words_and_never_read_as_empty(tmp_path: Path) -> None:
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
        with pytest.raises(DamagedStore, match="damaged") as caught:
            Store(path)
        assert caught.value.aside is not None
        assert caught.value.aside.read_bytes() == data[:length]
        assert str(caught.value.aside) in str(caught.value)
        assert not path.exists()
        with Store(path) as fresh:  # begins empty, and says where the rest is
            assert fresh.units() == []
            assert fresh.damaged == [caught.value.aside]


def test_a_flipped_byte_is_found_or_changes_nothing(tmp_path: Path) -> None:
    whole = tmp_path / "whole.db"
    written = filled(whole, 3)
    data = whole.read_bytes()
    used = [k for k, byte in enumerate(data) if byte or k < 200]
    found = 0
    for k in [*used[:300], *used[300::7]]:
        path = tmp_path / f"{k}.db"
        path.write_bytes(data[:k] + bytes([data[k] ^ (1 << k % 8)]) + data[k + 1 :])
        told = ""
        try:
            assert content(path) == written, k
        except DamagedStore as damage:
            found += 1
            told = str(damage.aside)
        assert path.exists() != Path(told).is_file(), k
        path.unlink(missing_ok=True)
    assert found > 500


def test_a_row_taken_out_or_changed_by_hand_is_found(tmp_path: Path) -> None:
    for number, change in enumerate(
        (
            "DELETE FROM calibration WHERE id = 2",
            "DELETE FROM calibration WHERE id = 6",
            "UPDATE calibration SET serial = 1 WHERE id = 3",
            "UPDATE calibration SET state = x'00' WHERE id = 3",
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
        with pytest.raises(DamagedStore):
            Store(path)


_TORN = """
import os, sys
from handtouch.supervise.store import Store
store = Store(sys.argv[1])
connection = store._connection
connection.execute("PRAGMA cache_size = 1")  # so that pages are spilled before the commit
connection.execute("PRAGMA cache_spill = 1")
connection.execute("BEGIN IMMEDIATE")
connection.execute("UPDATE calibration SET state = randomblob(9000)")
connection.execute("UPDATE head SET digest = randomblob(32)")
os.kill(os.getpid(), 9)
"""


@pytest.fixture
def torn(tmp_path: Path) -> tuple[Path, list[Version]]:
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


def test_a_write_interrupted_half_way_is_undone(torn: tuple[Path, list[Version]]) -> None:
    path, written = torn
    assert content(path) == written
    assert not path.with_name("store.db-journal").exists()


def test_a_torn_journal_never_gives_other_values_in_silence(
    torn: tuple[Path, list[Version]], tmp_path: Path
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
        except DamagedStore:
            outcomes.add("told")
        assert not copy.with_name("store.db-journal").exists()  # or it would be played into a new store
    assert "told" in outcomes


def test_a_journal_without_its_store_is_not_played_into_a_new_one(torn: tuple[Path, list[Version]]) -> None:
    path, _ = torn
    path.unlink()
    with pytest.raises(DamagedStore, match="its journal is there"):
        Store(path)
    with Store(path) as fresh:
        assert fresh.units() == []
        assert len(list(path.parent.glob("*.damaged-*-journal"))) == 1


@pytest.mark.parametrize(
    "data", [b"[daemon]\nsync_period_ms = 5.0\n" * 40, b"x", b"SQLite format 2\0" + b"x" * 600]
)
def test_a_file_that_is_no_store_is_left_alone(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "hand.toml"
    path.write_bytes(data)
    with pytest.raises(StoreError, match="is not a calibration store"):
        Store(path)
    assert path.read_bytes() == data
    assert list(tmp_path.iterdir()) == [path]


def test_another_programs_database_is_left_alone(tmp_path: Path) -> None:
    connection = sqlite3.connect(tmp_path / "mail.db")
    connection.execute("CREATE TABLE letters (text)")
    connection.close()
    with pytest.raises(StoreError, match="is not a calibration store"):
        Store(tmp_path / "mail.db")
    assert len(list(tmp_path.iterdir())) == 1


# --- schemas


def test_an_older_schema_is_migrated_and_the_old_file_kept(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    shutil.copy(DATA / "calibrations_schema1.db", path)
    versions = content(path)
    assert [(v.serial, v.number) for v in versions] == [(1001, 1), (1002, 1), (1001, 2)]
    assert versions[2].calibration.gains is not None
    assert versions[2].calibration.gains.factors == (1.02, 0.99, 1.0, 0.99)
    assert versions[2].provenance.link == "thumb_distal"
    assert all(version.calibration.sheet is None for version in versions)
    old = tmp_path / "store.db.schema-1"
    connection = sqlite3.connect(old)
    assert connection.execute("PRAGMA user_version").fetchone() == (1,)
    assert connection.execute("SELECT count(*) FROM calibration").fetchone() == (3,)
    connection.close()
    with Store(path) as store:
        store.write(1001, CONFIG, calibration(1), told(1), NOW)
    assert len(content(path)) == 4


def test_a_damaged_store_of_an_older_schema_is_not_migrated(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    path.write_bytes((DATA / "calibrations_schema1.db").read_bytes().replace(b"0.99", b"0.98", 1))
    with pytest.raises(DamagedStore):
        Store(path)


def test_a_newer_schema_is_refused_with_the_remedy_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    filled(path)
    connection = sqlite3.connect(path)
    connection.execute(f"PRAGMA user_version = {store_file.SCHEMA + 1}")
    connection.execute("UPDATE head SET schema = ?", (store_file.SCHEMA + 1,))
    connection.commit()
    connection.close()
    before = path.read_bytes()
    with pytest.raises(NewerStore, match="update handtouch"):
        Store(path)
    assert path.read_bytes() == before


# --- several processes, rights, places

_WRITER = """
import sys
from datetime import datetime, UTC
from handtouch.supervise.calibration import Calibration, Provenance
from handtouch.supervise.store import Store
with Store(sys.argv[1]) as store:
    for k in range(int(sys.argv[2])):
        store.write(5, "c", Calibration(), Provenance("x", k), datetime.now(UTC))
"""


def test_readers_see_whole_versions_while_two_writers_write(tmp_path: Path) -> None:
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
                assert len(other.units()) >= 2
    assert [writer.returncode for writer in writers] == [0, 0]
    with Store(path) as store:
        assert [version.number for version in store.versions(5)] == list(range(1, 81))


def test_a_store_that_was_moved_aside_under_its_writer_takes_no_more(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    with Store(path) as store:
        path.rename(tmp_path / "elsewhere.db")
        with pytest.raises(StoreError, match="open it again"):
            store.write(7, CONFIG, calibration(1), told(1), NOW)


def test_a_failed_write_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    written = filled(path)
    with Store(path) as store:
        bad = Calibration(sheet=SheetState("creep", 2**70, b""))  # SQLite has no such integer
        with pytest.raises((StoreError, OverflowError)):
            store.write(7, CONFIG, bad, told(1), NOW)
        store.write(7, CONFIG, calibration(1), told(1), NOW + timedelta(days=1))
    assert content(path)[:-1] == written


def test_all_may_read_a_store_and_its_owner_alone_may_write_it(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        filled(tmp_path / "store.db")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "store.db").stat().st_mode) == 0o644
    assert [entry.name for entry in tmp_path.iterdir()] == ["store.db"]  # one file at rest


def test_a_store_that_cannot_be_made_says_what_helps(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"\[daemon\] store"):
        Store(tmp_path / "file" / "store.db")
    with pytest.raises(StoreError, match="no calibration store here yet"):
        Store(tmp_path / "store.db", create=False)


def test_where_the_store_lives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert store_path() == tmp_path / ".local/state/handtouch/calibrations.db"
    monkeypatch.setenv("XDG_STATE_HOME", "relative")  # to be ignored, says the XDG specification
    assert store_path() == tmp_path / ".local/state/handtouch/calibrations.db"
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert store_path() == tmp_path / "state/handtouch/calibrations.db"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/handtouch/right")
    assert store_path() == Path("/var/lib/handtouch/right/calibrations.db")
    assert store_path("cal.db", tmp_path) == tmp_path / "cal.db"
    assert store_path("/srv/cal.db", tmp_path) == Path("/srv/cal.db")
