"""systemd hears of a daemon only what is so: ready after a tick, alive while it ticks."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from handtouch.daemon.notify import Notifier, Pulse

SECOND = 1_000_000_000


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.bind(str(tmp_path / "notify"))
        made.setblocking(False)
        yield made


def heard(systemd: socket.socket) -> list[str]:
    told = []
    while True:
        try:
            told.append(systemd.recv(4096).decode())
        except BlockingIOError:
            return told


def test_ready_comes_with_the_first_tick_and_never_again(systemd: socket.socket) -> None:
    notifier = Notifier(systemd.getsockname())
    pulse = Pulse(notifier, 0, lambda: "right: 15 of 15 nodes up")
    assert heard(systemd) == []
    for tick in range(1000):
        pulse.ticked(10 * SECOND + tick * 5_000_000)
    assert heard(systemd) == ["READY=1\nSTATUS=right: 15 of 15 nodes up"]
    notifier.close()


def test_the_watchdog_is_fed_three_times_in_its_time_while_ticks_come_and_not_else(
    systemd: socket.socket,
) -> None:
    notifier = Notifier(systemd.getsockname())
    pulse = Pulse(notifier, 2 * SECOND, lambda: "well")
    fed = 0
    for tick in range(2000):
        pulse.ticked(10 * SECOND + tick * 5_000_000)
        fed += heard(systemd).count("WATCHDOG=1")  # the kernel queues few
    assert 14 <= fed <= 16
    assert heard(systemd) == []
    pulse.ticked(30 * SECOND)
    assert heard(systemd) == ["WATCHDOG=1"]
    notifier.close()


def test_the_status_is_told_when_it_changed_at_most_once_a_second(systemd: socket.socket) -> None:
    notifier = Notifier(systemd.getsockname())
    up = 0

    def status() -> str:
        return f"{up} nodes up"

    pulse = Pulse(notifier, 0, status)
    for tick in range(1000):
        up = min(15, tick // 40)
        pulse.ticked(10 * SECOND + tick * 5_000_000)
    told = heard(systemd)
    assert len(told) <= 5
    assert told[-1] == "STATUS=15 nodes up"
    notifier.close()


def test_where_nobody_listens_nothing_happens_and_nothing_waits(tmp_path: Path) -> None:
    gone = Notifier(str(tmp_path / "nobody"))
    gone.send("READY=1")
    assert gone.failures == 1
    gone.close()
    nowhere = Notifier("")
    nowhere.send("READY=1")
    assert nowhere.failures == 0
    nowhere.close()
