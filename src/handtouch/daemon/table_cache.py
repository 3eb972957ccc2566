"""Cache on disk of the pad models' forward tables, so that a start needn't compute them again.

Public names: `TableCache`, `build_pad_model`, `cache_path`.

A file holds one table; its name is the hash of the pad's parameters and of the code that computes tables. A
cache that can't be written costs the next start a second, and one log line.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import zipfile
from dataclasses import asdict, fields
from functools import cache
from pathlib import Path

import numpy as np

import handtouch.field
from handtouch.config import Deployment
from handtouch.core import pad_tables
from handtouch.core.pad_model import PadModel
from handtouch.core.pad_tables import ForwardTable
from handtouch.field.model import ChannelModel

MAX_CACHE_BYTES = 256 << 20
"""Tables used least recently are removed beyond that; 130 distinct pads of four electrodes."""
_ENDING, _UNFINISHED_ENDING = ".table.npz", ".table.new"
_log = logging.getLogger("handtouch.tables")


def cache_path() -> Path:
    """Return the folder: $CACHE_DIRECTORY of systemd, or `handtouch` in $XDG_CACHE_HOME or ~/.cache."""
    if given := os.environ.get("CACHE_DIRECTORY", ""):
        return Path(given.split(":")[0])
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if home.startswith("/") else Path.home() / ".cache") / "handtouch"


def build_pad_model(deployment: Deployment) -> PadModel:
    """Return the pad model of a deployment, with forward tables from this user's cache."""
    return PadModel(deployment, TableCache(cache_path()).forward_table)


class TableCache:
    """Forward tables in a folder; may be used by several threads and processes."""

    def __init__(self, folder: Path, max_bytes: int = MAX_CACHE_BYTES) -> None:
        self._folder, self._max_bytes = folder, max_bytes
        self._is_writable = True  # until writing failed

    def forward_table(self, network: ChannelModel) -> ForwardTable:
        """Return the forward table of a pad, from the cache or computed."""
        file = self._folder / f"{_table_key(network)}{_ENDING}"
        table = self._read_table(file)
        if table is None:
            table = ForwardTable.from_network(network)
            self._write_table(file, table)
        return table

    def _read_table(self, file: Path) -> ForwardTable | None:
        try:
            # the archive's checksums detect corruption
            with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
                table = ForwardTable(**{field.name: arrays[field.name] for field in fields(ForwardTable)})
        except OSError:  # usually it isn't there; a folder that can't be used is logged by writing
            return None
        except (EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
            _log.warning("%s: damaged (%s); the table is computed again", file, error)
            return None
        with contextlib.suppress(OSError):  # read-only: nothing is removed there either
            os.utime(file)
        return table

    def _write_table(self, file: Path, table: ForwardTable) -> None:
        if not self._is_writable:
            return
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(
                dir=self._folder, suffix=_UNFINISHED_ENDING, delete=False
            ) as written:
                try:
                    np.savez(written, **asdict(table))
                    written.close()
                    Path(written.name).replace(file)
                except BaseException:
                    Path(written.name).unlink(missing_ok=True)
                    raise
            self._remove_old_tables()
        except OSError as error:
            self._is_writable = False
            _log.warning("tables of pads can't be cached, so that each start computes them: %s", error)

    def _remove_old_tables(self) -> None:
        """Remove the files used least recently until the rest is within the limit."""
        endings = _ENDING, _UNFINISHED_ENDING
        files = [file for ending in endings for file in self._folder.glob(f"*{ending}")]
        statuses = {}
        for file in files:
            with contextlib.suppress(FileNotFoundError):  # another daemon removed it
                statuses[file] = file.stat()
        kept_bytes = 0
        for file in sorted(statuses, key=lambda each: statuses[each].st_mtime, reverse=True):
            kept_bytes += statuses[file].st_size
            if kept_bytes > self._max_bytes:
                file.unlink(missing_ok=True)


def _table_key(network: ChannelModel) -> str:
    """Return the hash of everything that a table depends on."""
    parameters = (
        network.a,
        network.b,
        network.ends,
        network.sheet_ohm_per_square,
        network.series_ohm,
        network.states,
        network.digest,
        np.__version__,
        _code_hash(),
    )
    return hashlib.sha256(repr(parameters).encode()).hexdigest()[:32]


@cache
def _code_hash() -> str:
    """Return the hash of the sources that compute tables."""
    digest = hashlib.sha256()
    field_files = sorted(Path(handtouch.field.__path__[0]).glob("*.py"))
    for file in (Path(pad_tables.__file__), *field_files):
        digest.update(file.read_bytes())
    return digest.hexdigest()
