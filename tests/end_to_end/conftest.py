"""A whole deployment for end-to-end tests: nodes and daemon as processes of their own, on a real bus."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch import shipped
from handtouch.client import Subscriber, connect, request

START_S = 30.0
"""Longest that anything may take on a busy machine; nothing waits so long when all is well."""


class Rig:
    """Starts `handtouch simulate` and `handtouch run` for a deployment, and subscribes to it."""

    def __init__(self, folder: Path, endpoints: dict[str, str], prefix: list[str], bus: list[str]) -> None:
        self.folder = folder
        self.endpoints = endpoints
        self.bus = bus
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self._prefix = prefix
        self.config = folder / "hand.toml"
        settings = "\n".join(f'{stream} = "{endpoint}"' for stream, endpoint in endpoints.items())
        text = shipped.path("utah_mit.toml").read_text()
        assert "[daemon]\n" in text
        self.config.write_text(text.replace("[daemon]\n", f"[daemon]\n{settings}\n"))

    def command(self, *arguments: str) -> list[str]:
        return [*self._prefix, sys.executable, "-m", "handtouch", *arguments]

    def start(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        """Start `handtouch NAME hand.toml --bus ... ARGUMENTS`, printing to a file beside the deployment."""
        buses = [word for bus in self.bus for word in ("--bus", bus)]
        with (self.folder / f"{name}.txt").open("a") as output:
            process = subprocess.Popen(
                self.command(name, str(self.config), *buses, *arguments),
                stdout=output,
                stderr=subprocess.STDOUT,
                text=True,
            )
        self.processes[name] = process
        return process

    def printed(self, name: str) -> str:
        return (self.folder / f"{name}.txt").read_text()

    def subscribe(self, *patterns: str) -> Subscriber:
        return connect(*patterns, endpoint=self.endpoints["live"], queue=100_000)

    def status(self) -> dict[str, Any]:
        return request("status", endpoint=self.endpoints["control"], timeout_s=START_S)

    def wait(
        self, what: str, met: Callable[[dict[str, Any]], bool], longest_s: float = START_S
    ) -> dict[str, Any]:
        """Ask for the status until a condition is met."""
        end_s = time.monotonic() + longest_s
        while True:
            status = self.status()
            if met(status):
                return status
            assert time.monotonic() < end_s, (
                f"never {what}: {json.dumps(status, indent=1)}\n{self.all_printed()}"
            )
            time.sleep(0.02)

    def wait_operational(self, count: int = 15) -> dict[str, Any]:
        return self.wait(
            f"{count} nodes operational",
            lambda status: sum(pad["node"] == "operational" for pad in status["pads"]) == count,
        )

    def all_printed(self) -> str:
        return "\n".join(f"--- {path.name}\n{path.read_text()}" for path in self.folder.glob("*.txt"))

    def end(self, name: str, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal and wait for the process to end; its exit status."""
        process = self.processes.pop(name)
        process.send_signal(number)
        return process.wait(START_S)

    def end_all(self) -> None:
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
        for process in self.processes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@pytest.fixture
def rig(tmp_path: Path, endpoints: dict[str, str], network: list[str], free_port: int) -> Iterator[Rig]:
    """A deployment on a udp_multicast bus in a network of its own."""
    made = Rig(tmp_path, endpoints, network, [f"can0=udp_multicast:239.74.163.2,port={free_port}"])
    yield made
    made.end_all()


@pytest.fixture
def vcan_rig(tmp_path: Path, endpoints: dict[str, str]) -> Iterator[Rig]:
    """A deployment on SocketCAN; only inside vcan-run."""
    os.environ.setdefault("PYTHONDONTWRITEBYTECODE", "1")
    made = Rig(tmp_path, endpoints, [], ["can0=socketcan:vcan0"])
    yield made
    made.end_all()
