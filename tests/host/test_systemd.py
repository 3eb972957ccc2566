"""systemd notifications: ready after the first tick, watchdog while ticks continue."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from handtouch.host.systemd import ServiceWatchdog, SystemdNotifier

SECOND = 1_000_000_000


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.bind(str(tmp_path / "notify"))
        made.setblocking(False)
        yield made


def received(systemd: socket.socket) -> list[str]:
    states = []
    while True:
        try:
            states.append(systemd.recv(4096).decode())
        except BlockingIOError:
            return states


def test_ready_is_sent_once_with_the_first_tick(systemd: socket.socket) -> None:
    notifier = SystemdNotifier.open(systemd.getsockname())
    watchdog = ServiceWatchdog(notifier, 0, lambda: "right: 15 of 15 nodes up")
    assert received(systemd) == []
    for tick in range(1000):
        watchdog.notify_tick(10 * SECOND + tick * 5_000_000)
    assert received(systemd) == ["READY=1\nSTATUS=right: 15 of 15 nodes up"]
    notifier.close()


def test_watchdog_is_notified_three_times_per_timeout_while_ticking(
    systemd: socket.socket,
) -> None:
    notifier = SystemdNotifier.open(systemd.getsockname())
    watchdog = ServiceWatchdog(notifier, 2 * SECOND, lambda: "well")
    notified = 0
    for tick in range(2000):
        watchdog.notify_tick(10 * SECOND + tick * 5_000_000)
        notified += received(systemd).count("WATCHDOG=1")  # the kernel queues few
    assert 14 <= notified <= 16
    assert received(systemd) == []
    watchdog.notify_tick(30 * SECOND)
    assert received(systemd) == ["WATCHDOG=1"]
    notifier.close()


def test_status_is_sent_on_change_at_most_once_a_second(systemd: socket.socket) -> None:
    notifier = SystemdNotifier.open(systemd.getsockname())
    up = 0

    def status() -> str:
        return f"{up} nodes up"

    watchdog = ServiceWatchdog(notifier, 0, status)
    for tick in range(1000):
        up = min(15, tick // 40)
        watchdog.notify_tick(10 * SECOND + tick * 5_000_000)
    states = received(systemd)
    assert len(states) <= 5
    assert states[-1] == "STATUS=15 nodes up"
    notifier.close()


def test_absent_listener_neither_blocks_nor_raises(tmp_path: Path) -> None:
    unreachable = SystemdNotifier.open(str(tmp_path / "absent"))
    unreachable.send("READY=1")
    assert unreachable.failures == 1
    unreachable.close()
    disabled = SystemdNotifier.open("")
    disabled.send("READY=1")
    assert disabled.failures == 0
    disabled.close()
