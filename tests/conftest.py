"""Fixtures for tests of whole processes: endpoints, CAN buses and networks that no other test shares."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

_STREAMS = ("live", "complete", "control", "inputs")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests that need SocketCAN where there is none; inside vcan-run there must be, so they run."""
    if "VCAN_RUN" in os.environ or Path("/sys/class/net/vcan0").exists():
        return
    skip = pytest.mark.skip(reason="no vcan0 here; `make socketcan` runs these tests where there is one")
    for item in items:
        if item.get_closest_marker("socketcan"):
            item.add_marker(skip)


@pytest.fixture
def endpoints() -> Iterator[dict[str, str]]:
    """ZeroMQ endpoints for a `[daemon]` table, nobody else's; seen from every network namespace."""
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:  # tmp_path is longer than ipc paths may be
        yield {stream: f"ipc://{folder}/{stream}" for stream in _STREAMS}


@pytest.fixture
def free_port() -> int:
    """A TCP and UDP port that is free on loopback (until somebody takes it)."""
    while True:
        with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", 0))
            port = int(tcp.getsockname()[1])
            try:
                udp.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port


@pytest.fixture(scope="session")
def network() -> Iterator[list[str]]:
    """Prefix of commands that are to meet in a network of their own, with loopback up and multicast over it.

    `[*network, sys.executable, "-m", "handtouch", ...]` sees the same files; its ports and its
    udp_multicast buses are nobody else's.
    """
    rootless = [] if os.geteuid() == 0 else ["--map-root-user"]
    ready = "ip link set lo up && ip route add 239.0.0.0/8 dev lo && echo ready && exec cat"
    try:
        keeper = subprocess.Popen(
            ["unshare", "--net", *rootless, "sh", "-c", ready],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    except FileNotFoundError:
        pytest.skip("unshare (util-linux) is missing")
    assert keeper.stdin is not None
    assert keeper.stdout is not None
    with keeper:
        answer = keeper.stdout.readline().strip()
        if answer != "ready" or shutil.which("nsenter") is None:
            keeper.kill()
            pytest.skip(f"no network namespace to be had: {answer or 'nsenter is missing'}")
        user = ["--user", "--preserve-credentials"] if rootless else []
        yield ["nsenter", "--target", str(keeper.pid), *user, "--net", "--"]
        keeper.stdin.close()
