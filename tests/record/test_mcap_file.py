"""Truncated and damaged recordings are readable up to the fault."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch.record.mcap_file import RecordingFile
from handtouch.record.recording import Recording


@given(st.floats(0, 1))
@settings(max_examples=15, deadline=None)
def test_a_file_truncated_anywhere_is_readable_up_to_there(recorded: Path, part: float) -> None:
    whole = recorded.read_bytes()
    cut = recorded.with_name("cut.mcap")
    cut.write_bytes(whole[: int(part * len(whole))])
    complete = list(Recording(recorded))
    recording = Recording(cut)
    read = list(recording)
    assert read == complete[: len(read)]
    assert recording.truncation or part == 1 or len(read) == len(complete)


def test_a_chunk_truncated_at_any_byte_keeps_the_chunks_before(tmp_path: Path) -> None:
    file = RecordingFile(tmp_path / "whole.mcap", {"host": "here"})
    ends = []
    for number in range(9):
        file.write("service", b'{"n": %d, "noise": "%s"}' % (number, os.urandom(9).hex().encode()), 1)
        if number % 3 == 2:
            file.flush()
            ends.append((file.size, number + 1))
    file.finish({"messages": "9"})
    whole, cut = file.path.read_bytes(), tmp_path / "cut.mcap"
    (begin, _), (end, _) = ends[-2:]
    for size in range(begin, end):
        cut.write_bytes(whole[:size])
        recording = Recording(cut)
        numbers = [entry.payload["n"] for entry in recording]
        assert numbers == list(range(len(numbers)))
        assert len(numbers) in (6, 9)  # the chunk is followed by its index
        assert recording.truncation


@given(st.integers(8, 10**9), st.integers(1, 255))
@settings(max_examples=25, deadline=None)
def test_a_damaged_byte_loses_at_most_what_follows(recorded: Path, at: int, change: int) -> None:
    data = bytearray(recorded.read_bytes())
    data[at % len(data)] ^= change
    damaged = recorded.with_name("damaged.mcap")
    damaged.write_bytes(data)
    try:
        for entry in Recording(damaged):
            assert isinstance(entry.payload, dict)
    except ValueError as error:
        assert "isn't an MCAP file" in str(error)  # noqa: PT017 - the only permitted error


def test_another_file_is_rejected_by_name(tmp_path: Path) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("nothing of that kind")
    with pytest.raises(ValueError, match=r"notes\.txt: isn't an MCAP"):
        Recording(other)
    with pytest.raises(ValueError, match="is a folder"):
        Recording(tmp_path)
    with pytest.raises(FileNotFoundError):
        Recording(tmp_path / "absent.mcap")


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(FileExistsError):
        RecordingFile(path, {})
    assert path.read_text() == "precious"


_WRITER = """
import sys
from pathlib import Path
from handtouch.record.mcap_file import RecordingFile
file = RecordingFile(Path(sys.argv[1]), {"host": "here"})
for number in range(10**9):
    file.write("service", b'{"n": %d}' % number, number)
    if number % 100 == 99:
        file.flush()
        print(number + 1, flush=True)
"""


def test_a_killed_recorder_leaves_all_flushed_messages(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        flushed = [int(process.stdout.readline()) for _ in range(20)][-1]
        process.kill()
        assert process.wait() == -signal.SIGKILL
    recording = Recording(path)
    numbers = [entry.payload["n"] for entry in recording]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= flushed
    assert recording.truncation
    assert recording.metadata == {"host": "here"}


_ON_A_TINY_DISK = """
set -e
mount -t tmpfs -o size=64k tmpfs "$1"
exec "$2" -c "$3" "$1/full.mcap" "$4"
"""
_FILLER = """
import errno, os, shutil, sys
from pathlib import Path
from handtouch.record.mcap_file import RecordingFile
path = Path(sys.argv[1])
file, flushed = RecordingFile(path, {"host": "here"}), 0
try:
    for number in range(10**6):
        file.write("service", b'{"n": %d, "noise": "%s"}' % (number, os.urandom(20).hex().encode()), 1)
        if number % 10 == 9:
            file.flush()
            flushed = number + 1
except OSError as error:
    assert error.errno == errno.ENOSPC, error
file.abandon()
shutil.copy(path, sys.argv[2])
print(flushed)
"""


def test_a_full_disk_leaves_all_flushed_messages(tmp_path: Path) -> None:
    disk, out = tmp_path / "disk", tmp_path / "full.mcap"
    disk.mkdir()
    alone = ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--map-root-user"])]
    if subprocess.run([*alone, "mount", "-t", "tmpfs", "tmpfs", str(disk)], capture_output=True).returncode:
        assert os.environ.get("CI") != "true", "CI needs a mount namespace, for a disk of 64 kB"
        pytest.skip("no mount namespaces here: a disk of 64 kB can't be made")
    done = subprocess.run(
        [*alone, "sh", "-c", _ON_A_TINY_DISK, "sh", str(disk), sys.executable, _FILLER, str(out)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    recording = Recording(out)
    numbers = [entry.payload["n"] for entry in recording]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= int(done.stdout) > 100
    assert recording.truncation
    assert out.stat().st_size <= 64 * 1024


def _fill(file: RecordingFile, flushed: list[int]) -> None:
    for number in range(10**6):
        noise = os.urandom(20).hex().encode()
        file.write("service", b'{"n": %d, "noise": "%s"}' % (number, noise), 1)
        if number % 10 == 9:
            file.flush()
            flushed.append(number + 1)


def test_a_file_size_limit_leaves_all_flushed_messages(tmp_path: Path) -> None:
    path = tmp_path / "full.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    flushed: list[int] = []
    try:
        file = RecordingFile(path, {})
        with pytest.raises(OSError, match="too large"):
            _fill(file, flushed)
        file.abandon()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert flushed
    assert path.stat().st_size <= 20_000
    numbers = [entry.payload["n"] for entry in Recording(path)]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= flushed[-1]  # the limit may fall between the last messages and their index
