"""Forward tables on disk are those that would be computed; a bad cache costs time, and nothing else."""

from __future__ import annotations

import logging
import os
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from handtouch.core.pad_tables import ForwardTable
from handtouch.daemon.table_cache import TableCache, cache_path
from handtouch.field.network import ElectrodeNetwork


def network(a: float = 0.024) -> ElectrodeNetwork:
    return ElectrodeNetwork(a, 0.018, 0.001, 2400.0, (10.0, 0.0, 0.0, 0.0))


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[ElectrodeNetwork]:
    """The networks whose tables are computed from now on."""
    found: list[ElectrodeNetwork] = []
    compute = ForwardTable.from_network

    def counted(of: ElectrodeNetwork) -> ForwardTable:
        found.append(of)
        return compute(of)

    monkeypatch.setattr(ForwardTable, "from_network", counted)
    return found


def tables(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def assert_equal(one: ForwardTable, other: ForwardTable) -> None:
    """Compare bit for bit, in the layout that the stages read."""
    for ours, theirs in zip(astuple(one), astuple(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)
        assert ours.flags.c_contiguous
        assert ours.dtype == theirs.dtype


def test_a_cached_table_is_the_computed_one(tmp_path: Path, computed: list[ElectrodeNetwork]) -> None:
    expected = ForwardTable.from_network(network())
    for _ in range(2):
        assert_equal(TableCache(tmp_path / "new").forward_table(network()), expected)
    assert len(computed) == 2  # the expected one, and the first
    assert len(tables(tmp_path / "new")) == 1


def test_every_parameter_has_a_table_of_its_own(tmp_path: Path) -> None:
    cache = TableCache(tmp_path)
    other_series = network().with_series_ohm((0.0, 10.0, 0.0, 0.0))
    for distinct in (network(), network(0.025), other_series):
        assert_equal(cache.forward_table(distinct), ForwardTable.from_network(distinct))
    assert len(tables(tmp_path)) == 3


@pytest.mark.parametrize("damage", ["truncated", "changed", "empty", "other contents"])
def test_a_damaged_file_is_computed_again_and_logged(
    tmp_path: Path, damage: str, computed: list[ElectrodeNetwork], caplog: pytest.LogCaptureFixture
) -> None:
    expected = TableCache(tmp_path).forward_table(network())
    (file,) = tables(tmp_path)
    whole = file.read_bytes()
    middle = len(whole) // 2
    file.write_bytes(
        {
            "truncated": whole[:middle],
            "changed": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
            "empty": b"",
            "other contents": b"no table",
        }[damage]
    )
    with caplog.at_level(logging.WARNING):
        assert_equal(TableCache(tmp_path).forward_table(network()), expected)
    assert [str(file) in record.getMessage() for record in caplog.records] == [True]
    assert_equal(TableCache(tmp_path).forward_table(network()), expected)
    assert len(computed) == 2  # it was written again


def test_a_cache_that_cannot_be_written_is_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    cache = TableCache(tmp_path / "file" / "folder")  # also root can't make that
    with caplog.at_level(logging.WARNING):
        for a in (0.02, 0.03):
            assert_equal(cache.forward_table(network(a)), ForwardTable.from_network(network(a)))
    assert len(caplog.records) == 1


def test_a_write_that_fails_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", fail)
    assert_equal(TableCache(tmp_path).forward_table(network()), ForwardTable.from_network(network()))
    assert tables(tmp_path) == []


def test_tables_used_least_recently_are_removed(tmp_path: Path, computed: list[ElectrodeNetwork]) -> None:
    cache = TableCache(tmp_path)
    cache.forward_table(network(0.02))
    (first,) = tables(tmp_path)
    cache.forward_table(network(0.03))
    (second,) = set(tables(tmp_path)) - {first}
    for age_s, file in ((2000, first), (1000, second)):
        os.utime(file, (file.stat().st_atime, file.stat().st_mtime - age_s))
    (tmp_path / "unrelated").write_bytes(bytes(1 << 20))
    bounded = TableCache(tmp_path, max_bytes=5 * first.stat().st_size // 2)
    bounded.forward_table(network(0.02))  # now the second is the oldest
    bounded.forward_table(network(0.04))
    assert first in tables(tmp_path)
    assert second not in tables(tmp_path)
    assert len(computed) == 3
    assert (tmp_path / "unrelated").exists()


def test_the_folder_is_the_services_or_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/tmp/of-user")
    assert cache_path() == Path("/tmp/of-user/handtouch")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative is ignored")
    assert cache_path() == Path.home() / ".cache/handtouch"
    monkeypatch.setenv("CACHE_DIRECTORY", "/var/cache/handtouch")
    assert cache_path() == Path("/var/cache/handtouch")
