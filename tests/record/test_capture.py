"""`handtouch record` as a process of its own, beside the streams of a daemon."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from handtouch import cli, wire
from handtouch.cli import record
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.publisher import Publisher
from handtouch.record.recording import Recording

from .conftest import Hand, service

LONGEST_S = 60.0


class Daemon:
    """A hand published like a daemon's, without a bus."""

    def __init__(self, hand: Hand, folder: Path) -> None:
        self.hand = hand
        self._context: zmq.Context[Any] = zmq.Context()
        topics = wire.topics_of(hand.deployment.links_by_hand)
        self._authenticator = Authenticator(self._context)
        self.publisher = Publisher.open(
            self._context, f"ipc://{folder}/live", f"ipc://{folder}/complete", topics, self._authenticator
        )
        self.endpoint = self.publisher.endpoints["complete"]
        self._seq = 0
        journal = hand.pipeline.journal
        journal.publish_config(hand.deployment, {}, {}, 0)
        self.publisher.retained_messages.update(journal.retained_messages())
        hand.sink.has_subscriber = self.publisher.has_subscriber  # type: ignore[method-assign]
        hand.sink.take = lambda parts: self.publisher.send(wire.decode(parts))

    def tick(self) -> None:
        self.hand.stroke(1, seed=self._seq)
        self._seq += 1
        if self._seq % 20 == 1:
            self.publisher.send(wire.decode(service(self._seq // 20 + 1, self.hand.t_ns)))
        self.publisher.poll_subscriptions(self.hand.t_ns)

    def close(self) -> None:
        self.publisher.close()
        self._authenticator.close()
        self._context.term()


@pytest.fixture
def daemon(make_hand: Callable[..., Hand], tmp_path: Path) -> Iterator[Daemon]:
    made = Daemon(make_hand(), tmp_path)
    yield made
    made.close()


def _record(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "handtouch", "record", *arguments]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _end(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, err = process.communicate(timeout=LONGEST_S)
    return process.returncode, err


def test_a_daemon_is_recorded_until_ctrl_c_and_every_file_is_listed(daemon: Daemon, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    process = _record("-o", str(out), "--endpoint", daemon.endpoint, "--rotate-mb", "0.02")
    end_s = time.monotonic() + LONGEST_S
    second = tmp_path / "out-002.mcap"
    while not second.exists() or second.stat().st_size < 3000:
        assert time.monotonic() < end_s, process.poll()
        daemon.tick()
        time.sleep(0.002)
    process.send_signal(signal.SIGINT)
    status, err = _end(process)
    assert status == 0, err
    assert "out.mcap" in err
    assert "out-002.mcap" in err
    ticks = []
    for path in (out, second):
        recording = Recording(path)
        topics = [entry.topic for entry in recording]
        assert {"config", "state", "tick", "service"} <= set(topics)
        assert not recording.truncation
        ticks += [entry.payload["tick"] for entry in recording.read("tick")]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))


def test_lines_on_standard_input_are_marks_and_every_reader_of_the_recording_takes_them(
    daemon: Daemon, tmp_path: Path
) -> None:
    out = tmp_path / "marked.mcap"
    process = _record("-o", str(out), "--endpoint", daemon.endpoint, "--marks")
    assert process.stdin is not None
    end_s = time.monotonic() + LONGEST_S
    while not out.exists() or out.stat().st_size < 3000:
        assert time.monotonic() < end_s, process.poll()
        daemon.tick()
        time.sleep(0.002)
    process.stdin.write("pick up\n\n")
    process.stdin.flush()
    for _ in range(200):  # the thread that reads lines has its time
        daemon.tick()
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    status, err = _end(process)
    assert status == 0, err
    marks = list(Recording(out).read("mark"))
    assert [mark.payload["text"] for mark in marks] == ["pick up", ""]
    assert marks[0].wall_ns <= marks[1].wall_ns
    for command in (["replay", str(out)], ["export", str(out), "-o", str(tmp_path / "tables")]):
        assert cli.main(command) == 0


def test_too_little_free_space_ends_recording_with_status_1(daemon: Daemon, tmp_path: Path) -> None:
    process = _record("-o", str(tmp_path / "out"), "--endpoint", daemon.endpoint, "--keep-free-mb", "1e9")
    status, err = _end(process)
    assert status == 1
    assert "are free" in err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--endpoint", "nonsense"], "nonsense"),
        (["absent.toml"], "absent.toml"),
        (["-o", "taken.mcap"], "exists already"),
        (["-o", "/proc/nowhere"], "/proc/nowhere"),
    ],
)
def test_wrong_usage_is_status_2_and_named(
    arguments: list[str],
    text: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from handtouch.cli import main

    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.mcap").write_text("precious")
    assert main(["record", *arguments]) == 2
    assert text in capsys.readouterr().err


def test_a_silent_endpoint_is_reported(tmp_path: Path) -> None:
    status, err = _end(
        _record("-o", str(tmp_path), "--endpoint", f"ipc://{tmp_path}/none", "--seconds", "0.2")
    )
    assert status == 1
    assert "no message received" in err


@pytest.mark.parametrize("is_installed", [True, False])
def test_a_recording_without_foxgloves_topics_names_the_extra(
    is_installed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if is_installed:
        pytest.importorskip("foxglove", reason="needs the extra foxglove")
    else:
        monkeypatch.setitem(sys.modules, "handtouch.record.foxglove", None)
    stopped = threading.Event()
    stopped.set()
    monkeypatch.setattr(record, "stop_on_signals", lambda: stopped)
    record.run(as_json=False, out=tmp_path / "out.mcap", endpoint=f"ipc://{tmp_path}/complete")
    assert ("[foxglove]'" in capsys.readouterr().err) is not is_installed
