"""A reader in JavaScript, written from docs/wire.md, reads from the daemon what the Python client reads."""

from __future__ import annotations

import json
import math
import subprocess
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zmq

from handtouch import wire
from handtouch.client import columns, connect

LONGEST_S = 60.0
PATTERNS = ("contact/*/*", "hand/*", "health/*/*", "raw/*", "service")


@pytest.fixture
def program(javascript: Path) -> list[str]:
    """Command that runs the reader."""
    return ["node", str(javascript / "reader.mjs")]


class Reader:
    """The reader as a process: `lines` are what it has printed so far."""

    def __init__(self, program: list[str], endpoint: str, *topics: str) -> None:
        self.lines: list[Any] = []
        self._process = subprocess.Popen(
            [*program, endpoint, *topics], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def wait(self, *values: Any) -> None:
        """Until it has printed these, in this order."""
        end_s = time.monotonic() + LONGEST_S
        while not _in_order(values, self.lines):
            assert time.monotonic() < end_s, self.lines[-5:]
            assert self._process.poll() is None
            time.sleep(0.01)

    def end(self) -> dict[str, int]:
        """Its summary; all its lines are there then."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        assert self._process.wait(LONGEST_S) == 0
        self._thread.join()
        assert self._process.stdout is not None
        self._process.stdout.close()
        summary: dict[str, int] = self.lines.pop()["summary"]
        return summary

    def messages(self) -> list[Any]:
        """Return the new messages that it printed, as (topic, payload)."""
        return [(line["topic"], line["payload"]) for line in self.lines if "topic" in line]

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(json.loads(line))


def _in_order(values: tuple[Any, ...], lines: list[Any]) -> bool:
    rest = iter(list(lines))
    return all(any(line == value for line in rest) for value in values)


def _plain(message: wire.Message) -> Any:
    """A message as the reader prints it."""
    plain = wire.to_map(message)
    if isinstance(message, wire.HandFrame | wire.Raw):
        plain |= {name: array.tolist() for name, array in columns(message).items()}
    return json.loads(json.dumps(_without_nan(plain)))


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def test_javascript_and_python_read_the_same_from_the_daemon(rig: Any, program: list[str]) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    endpoint = rig.endpoints["complete"]
    reader = Reader(program, endpoint, "contact/", "hand/", "health/", "raw/right", "service")
    try:
        reader.wait({"alive": True})
        python: dict[str, dict[int, Any]] = defaultdict(dict)
        contacts, ends, services = 0, 0, 0  # until the reader, which may be slower, has seen enough
        with connect(*PATTERNS, endpoint=endpoint, queue=100_000) as messages:
            while contacts < 200 or ends < 2 or services < 4:
                message = messages.recv(LONGEST_S)
                assert message is not None, rig.all_printed()
                if not message.retained:
                    python[wire.topic_of(message)][message.seq] = _plain(message)
                contacts += isinstance(message, wire.Contact)
                ends += isinstance(message, wire.Contact) and message.event == "end"
                services += isinstance(message, wire.Service)
        summary = reader.end()
    finally:
        reader.kill()
    assert summary == {"gaps": 0, "retained": summary["retained"], "restarts": 0, "malformed": 0}
    javascript: dict[str, dict[int, Any]] = defaultdict(dict)
    for topic, payload in reader.messages():
        if not payload["retained"]:
            javascript[topic][payload["seq"]] = payload
    compared = dict.fromkeys(("contact", "hand", "health", "raw", "service"), 0)
    for topic, messages_of in python.items():
        for seq, message in messages_of.items():
            if topic in javascript and min(javascript[topic]) <= seq <= max(javascript[topic]):
                assert javascript[topic][seq] == message
                compared[topic.split("/")[0]] += 1
    assert all(count >= 3 for count in compared.values()), compared
    assert compared["contact"] > 20
    normals = [
        frame["normal"][row]
        for frame in javascript["hand/right"].values()
        for row, state in enumerate(frame["state"])
        if (state, frame["position_status"][row]) == (wire.PadState.TOUCHED, wire.PositionStatus.VALID)
    ]
    assert len(normals) > 20
    assert all(math.dist(normal, (0, 0, 0)) > 0.99 for normal in normals)


def _service(seq: int, session: int = 1, retained: bool = False) -> wire.Service:
    values: dict[str, Any] = dict.fromkeys(wire.Service.__dataclass_fields__, 0)
    values |= {
        name: {}
        for name in ("hands", "tick_us", "loop", "rejected", "process", "buses", "congestion_episodes")
    }
    values |= {"v": 1, "session": session, "seq": seq, "t_ns": 2**62 + seq, "wall_offset_ns": -(2**60)}
    values |= {
        "version": "x",
        "uptime_s": 1.0,
        "period_s": 0.1,
        "rate_hz": 0.0,
        "core_compiled": True,
        "subscriptions": (),
    }
    values |= {"inputs": {}, "supervisor": None, "percepts": None}
    return wire.Service(**{**values, "retained": retained})


def _health(seq: int) -> wire.Health:
    return wire.Health(
        1, 1, seq, 1, "h", "x", "can0", 1, "clear", "operational",
        0, "sync", "", None, 0.0, 0, 0, None, 0, 0, (), False,
    )  # fmt: skip


@pytest.fixture
def publisher(endpoints: dict[str, str]) -> Iterator[Any]:
    with zmq.Context() as context, context.socket(zmq.XPUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind(endpoints["live"])
        yield socket


def test_javascript_and_python_count_the_same_gaps_retained_messages_and_restarts(
    publisher: Any, endpoints: dict[str, str], program: list[str]
) -> None:
    good = [
        _service(3), _service(4), _service(7), _service(7, retained=True), _service(5, retained=True),
        _service(9, retained=True), _service(10), _service(2, session=2),
        _service(2, session=2, retained=True),
        _service(3, session=2),
    ]  # fmt: skip
    encoded = [wire.encode(message) for message in good]
    malformed = [
        [b"service"],
        [b"service", b"\xc1"],
        [b"service", b"\x80"],
        [b"service", b"\x07"],
        wire.encode(replace(_service(11), v=2)),
        [b"service/x", encoded[0][1]],
        [b"service", encoded[0][1], b""],
    ]
    unsubscribed = [wire.encode(_health(1)), wire.encode(_health(9))]  # not subscribed
    reader = Reader(program, endpoints["live"], "service")
    try:
        with connect("service", endpoint=endpoints["live"]) as messages:
            first = wire.encode(_service(1, session=7))
            while messages.recv(0.05) is None or {"alive": True} not in reader.lines:
                publisher.send_multipart(first)
            while messages.recv(0.2) is not None:
                pass
            assert messages.lost_messages == 0
            for parts in [*encoded[:4], *malformed, *unsubscribed, *encoded[4:]]:
                publisher.send_multipart(parts)
            python = [message for _ in range(7) if (message := messages.recv(LONGEST_S)) is not None]
            assert messages.recv(0) is None
            counted = {"gaps": messages.lost_messages, "malformed": messages.malformed_messages}
        reader.wait({"topic": "service", "payload": _plain(good[-1])})
        reader.wait({"alive": True}, {"alive": False})
        summary = reader.end()
    finally:
        reader.kill()
    assert [(message.session, message.seq) for message in python] == [
        (1, 3), (1, 4), (1, 7), (1, 9), (1, 10), (2, 2), (2, 3),
    ]  # fmt: skip
    assert counted["gaps"] == 2 + 1
    assert [payload for _, payload in reader.messages() if payload["session"] != 7] == list(
        map(_plain, python)
    )
    assert summary["gaps"] == counted["gaps"]
    assert summary["retained"] == 3
    assert summary["restarts"] == 2
    assert (summary["malformed"], counted["malformed"]) == (6, 6)
