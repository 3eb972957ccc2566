"""The demo: one command, no hardware, and a summary of its accuracy."""

from __future__ import annotations

import math
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

import pytest

import handtouch
from handtouch.host.endpoints import LIVE_ENDPOINT
from tests.starter import Started, Starter


def test_demo_locates_touches_near_the_noise_bound_and_ends() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "handtouch", "demo", "--world", "ideal", "--seconds", "9", "--details"],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"begin +right/index_distal", done.stdout)
    row = r"^ *all +(\d+) +([\d.]+) +[\d.]+ +([\d.]+) +([\d.]+) .* (\d+)$"
    (total,) = re.findall(row, done.stdout, re.MULTILINE)
    samples, pad_error_mm, bound_mm, worst_mm, false_positives = map(float, total)
    assert samples > 20
    # without the weakest sample, which may lie anywhere on its pad, as its interval says
    rest_mm = math.sqrt(max(samples * pad_error_mm**2 - worst_mm**2, 0) / samples)
    assert rest_mm < 2.5 * bound_mm + 0.01
    assert false_positives == 0
    verdict = done.stdout.split("\n\n")[-1].splitlines()
    assert re.match(r"(\d+) of \1 touches found, no contacts", verdict[0])
    assert max(map(len, verdict)) <= 72


def test_demo_without_compiled_core_lowers_its_rate_and_shows_contacts(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "handtouch", "demo", "--plain", "--world", "ideal"]
    uncompiled = {**os.environ, "HANDTOUCH_UNCOMPILED": "1"}
    with (
        (tmp_path / "stderr").open("w") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=uncompiled) as demo,
    ):
        assert demo.stdout is not None
        try:
            assert any(" begin " in line for line in demo.stdout)
            demo.send_signal(signal.SIGINT)
            rest = demo.stdout.read()
            assert demo.wait(30) == 0
        finally:
            demo.kill()
    assert "touches found" in rest
    printed = (tmp_path / "stderr").read_text()
    lowered = re.search(r"core uncompiled: SYNC rate lowered from 200 to (\S+) Hz", printed)
    assert lowered, printed
    assert float(lowered[1]) < 200
    assert "HANDTOUCH_UNCOMPILED is set" in printed


STUCK = """

[[fault]]
kind = "stuck_channel"
link = "ring_distal"
from_s = 0.5
electrode = "xa"

[[touch]]
link = "index_distal"
from_s = 0.1
duration_s = 10.0
path = [[0.2, 0.3], [0.8, 0.5]]
force_n = [0.8]
"""


def test_demo_reports_fault_of_scenario_and_leaves_no_files(tmp_path: Path, host_starter: Starter) -> None:
    (tmp_path / "stuck.toml").write_text(STUCK)
    home = {"HOME": str(tmp_path), "XDG_STATE_HOME": str(tmp_path / "state")}
    options = ["--plain", "--seconds", "150", "--scenario", str(tmp_path / "stuck.toml")]
    with started(host_starter, *options, **home) as (demo, printed):
        assert any(re.search(r"right/ring_distal.*channel xa", line) for line in printed)
        demo.send_signal(signal.SIGINT)
        rest = printed.read()
        assert demo.wait(30) == 0
    assert re.search(r"^diagnosis: right/ring_distal: channel xa", rest, re.MULTILINE)
    assert "touches found" in rest
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize("occupied", [False, True])
def test_programs_beside_the_demo_receive_its_contacts(occupied: bool, host_starter: Starter) -> None:
    with socket.socket() as other:
        is_ours = False
        if occupied:
            with suppress(OSError):  # another program of this machine may have it, and leave it meanwhile
                other.bind(("127.0.0.1", 5580))
                other.listen()
                is_ours = True
        with started(host_starter, "--world", "ideal", "--plain") as (demo, printed):
            told = next(line for line in printed if "connect to this hand" in line)
            named = re.search(r"endpoint = (\S+)", told)
            assert named or not is_ours
            with handtouch.connect("contact/*/*", endpoint=named[1] if named else LIVE_ENDPOINT) as contacts:
                contact = contacts.recv(60.0)
            demo.send_signal(signal.SIGINT)
            printed.read()
    assert contact is not None
    assert contact.hand == "right"


def test_two_demos_run_concurrently(host_starter: Starter) -> None:
    options = ["--world", "ideal", "--plain", "--seconds", "2"]
    with started(host_starter, *options) as (one, _), started(host_starter, *options) as (other, _):
        assert [one.wait(100), other.wait(100)] == [0, 0]


@contextmanager
def started(starter: Starter, *options: str, **environment: str) -> Iterator[tuple[Started, TextIO]]:
    """Run `handtouch demo`, with its output; killed at the end of the block, if it still runs."""
    reader, writer = os.pipe()
    with open(reader) as printed:
        with open(writer, "w") as output:
            demo = starter.start(["demo", *options], output, **environment)
        try:
            yield demo, printed
        finally:
            demo.kill()
