"""Who may connect to a daemon with keys, and that nobody else disturbs it. Real sockets, real handshakes."""

from __future__ import annotations

import asyncio
import contextlib
import random
import re
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtouch import keys, wire
from handtouch.client import connect, request
from handtouch.daemon.control import Control
from handtouch.daemon.publisher import Publisher
from handtouch.daemon.security import CAUSES, Gate

_SECOND_NS = 1_000_000_000
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00"
NULL = GREETING + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)
CURVE = GREETING + b"CURVE".ljust(20, b"\0") + b"\0" + bytes(31)
READY = b"\x04\x19\x05READY\x0bSocket-Type\0\0\0\x03"
HUGE = b"\x02\x7f" + b"\xff" * 7 + b"x" * 1000
"""a frame that says it has 2^63 bytes"""

GARBAGE = {
    "another protocol": b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n" * 50,
    "nothing": b"",
    "half a greeting": GREETING,
    "no security": NULL + READY + b"SUB",
    "no security, a huge frame": NULL + READY + b"SUB" + HUGE,
    "no security, a request": NULL + READY + b"REQ" + b"\x01\x00\x00\x05hello",
    "a false hello": CURVE + b"\x04\xc8\x05HELLO" + b"x" * 194,
    "a huge frame": CURVE + HUGE,
    "noise": random.Random(7).randbytes(20_000),
    "noise after the greeting": CURVE + random.Random(8).randbytes(20_000),
}


def _health(seq: int) -> wire.Health:
    """A message; only its topic and its number matter here."""
    zero: dict[str, Any] = {"int": 0, "float": 0.0, "str": "", "bool": False, "tuple[str, ...]": ()}
    values: dict[str, Any] = {
        field.name: zero.get(str(field.type)) for field in fields(wire.Health) if field.default is MISSING
    }
    return wire.Health(**{**values, "v": wire.SCHEMA_VERSION, "seq": seq, "hand": "h", "link": "thumb"})


class Served:
    """A gate with a publisher and a control endpoint behind it, polled by a thread as the hot thread does."""

    def __init__(self, folder: Path | None) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.gate = Gate(self.context, folder)
        self.publisher = Publisher(self.context, "tcp://127.0.0.1:*", "tcp://127.0.0.1:*", self.gate)
        self.control = Control(self.context, "tcp://127.0.0.1:*", self.gate)
        self.control.commands["status"] = lambda _, __: {"answer": 42}
        self.live = self.publisher.endpoints["live"]
        self.skipped_ns = self.sent = 0
        self.now_ns = _SECOND_NS
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        time_ns = _SECOND_NS
        while not self._stop.wait(0.001):
            time_ns += 10_000_000
            self.now_ns = time_ns + self.skipped_ns
            self.gate.poll(self.now_ns)
            self.publisher.take_subscriptions(self.now_ns)
            self.control.poll(self.now_ns)
            self.sent += 1
            self.publisher.send(_health(self.sent))

    def until(self, met: Callable[[], bool]) -> None:
        for _ in range(2000):
            if met():
                return
            self._stop.wait(0.005)
        raise AssertionError(f"refused {dict(self.gate.refused)}")

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.publisher.close()
        self.control.close()
        self.gate.close()
        self.context.destroy(0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    keys.make(tmp_path / "keys", "robot1")
    keys.add_client(tmp_path / "keys", "reader", "read", tmp_path / "reader.key")
    keys.add_client(tmp_path / "keys", "pilot", "control", tmp_path / "pilot.key")
    return tmp_path / "keys"


@pytest.fixture
def served(folder: Path) -> Iterator[Served]:
    made = Served(folder)
    yield made
    made.close()


@pytest.fixture
def unguarded() -> Iterator[Served]:
    made = Served(None)
    yield made
    made.close()


@pytest.fixture
def foreign(tmp_path: Path, folder: Path) -> Path:
    """The key of a client of another daemon."""
    del folder
    keys.make(tmp_path / "elsewhere", "robot2")
    keys.add_client(tmp_path / "elsewhere", "stranger", "control", tmp_path / "foreign.key")
    return tmp_path / "foreign.key"


@pytest.fixture
def unknown(tmp_path: Path, folder: Path) -> Path:
    """A key for this daemon that it doesn't know, any more."""
    keys.add_client(folder, "gone", "control", tmp_path / "gone.key")
    keys.revoke(folder, "gone")
    return tmp_path / "gone.key"


def _hears(endpoint: str, key: Path | str) -> bool:
    with connect("health/*/*", endpoint=endpoint, key=key) as messages:
        return messages.recv(30) is not None


@pytest.mark.parametrize("name", ["reader", "pilot"])
def test_whoever_may_read_reads_both_streams(served: Served, tmp_path: Path, name: str) -> None:
    assert all(_hears(endpoint, tmp_path / f"{name}.key") for endpoint in served.publisher.endpoints.values())
    assert not served.gate.refused


def test_whoever_may_control_controls(served: Served, tmp_path: Path) -> None:
    answer = request("status", endpoint=served.control.endpoint, key=tmp_path / "pilot.key", timeout_s=30)
    assert answer["answer"] == 42


def test_a_readers_key_controls_nothing(
    served: Served, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(PermissionError, match="doesn't let reader in"):
        request("status", endpoint=served.control.endpoint, key=tmp_path / "reader.key", timeout_s=30)
    assert served.gate.refused == {"no_right": 1}
    assert "refused a client that may read, but not control: reader from 127.0.0.1" in caplog.text


def test_without_a_key_nobody_gets_anything(served: Served) -> None:
    with pytest.raises(PermissionError, match="handtouch keys client"):
        _hears(served.live, "")
    with pytest.raises(PermissionError, match="handtouch keys client"):
        request("status", endpoint=served.control.endpoint, key="", timeout_s=30)
    served.until(lambda: served.gate.refused.total() >= 2)
    assert set(served.gate.refused) <= {"no_key", "garbage"}  # garbage: who sees the mismatch first hangs up
    assert not served.publisher.subscriptions


def test_a_key_that_is_not_known_gets_nothing(served: Served, unknown: Path) -> None:
    with pytest.raises(PermissionError, match="not known there"):
        _hears(served.live, unknown)
    with pytest.raises(PermissionError, match="not known there"):
        request("status", endpoint=served.control.endpoint, key=unknown, timeout_s=30)
    assert served.gate.refused == {"unknown_key": 2}


def test_a_key_for_another_daemon_gets_nothing(served: Served, foreign: Path) -> None:
    with pytest.raises(PermissionError, match="for robot2: this is another daemon"):
        _hears(served.live, foreign)
    served.until(lambda: served.gate.refused["wrong_server_key"] >= 1)


def test_a_daemon_without_keys_is_not_spoken_to_with_one(
    unguarded: Served, tmp_path: Path, folder: Path
) -> None:
    """It could be anybody: the key says which daemon is meant."""
    del folder
    with pytest.raises(PermissionError, match="another daemon"):
        _hears(unguarded.live, tmp_path / "reader.key")


def test_a_client_that_is_refused_hears_so_in_asyncio_too(served: Served, unknown: Path) -> None:
    async def first(key: Path) -> object:
        with connect("health/*/*", endpoint=served.live, key=key) as messages:
            async for message in messages:
                return message
        return None

    with pytest.raises(PermissionError, match="not known there"):
        asyncio.run(asyncio.wait_for(first(unknown), 30))
    assert asyncio.run(asyncio.wait_for(first(unknown.parent / "reader.key"), 30)) is not None


def test_the_environment_names_a_key(served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HANDTOUCH_KEY", str(tmp_path / "pilot.key"))
    assert request("status", endpoint=served.control.endpoint, timeout_s=30)["answer"] == 42
    monkeypatch.setenv("HANDTOUCH_KEY", str(tmp_path / "absent.key"))
    with pytest.raises(ValueError, match=r"absent\.key"):
        connect(endpoint=served.live)


def test_clients_come_and_go_without_a_restart(served: Served, folder: Path, tmp_path: Path) -> None:
    keys.add_client(folder, "late", "read", tmp_path / "late.key")
    assert _hears(served.live, tmp_path / "late.key")
    entry = folder / "clients/late.pub"
    entry.write_text(entry.read_text().replace('"read"', '"control"'))
    request("status", endpoint=served.control.endpoint, key=tmp_path / "late.key", timeout_s=30)
    keys.revoke(folder, "late")
    with pytest.raises(PermissionError):
        _hears(served.live, tmp_path / "late.key")
    assert _hears(served.live, tmp_path / "reader.key")


def test_nobody_is_let_in_while_others_could_write_the_list(
    served: Served, folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "clients").chmod(0o777)
    with pytest.raises(PermissionError):
        _hears(served.live, tmp_path / "reader.key")
    assert f"chmod go-w {folder / 'clients'}" in caplog.text
    (folder / "clients").chmod(0o755)
    assert _hears(served.live, tmp_path / "reader.key")


def test_a_flood_of_refusals_is_told_in_few_words(
    served: Served, unknown: Path, caplog: pytest.LogCaptureFixture
) -> None:
    start_ns = served.now_ns
    for _ in range(10):
        with pytest.raises(PermissionError):
            _hears(served.live, unknown)
    served.skipped_ns = 11 * _SECOND_NS
    with pytest.raises(PermissionError):
        _hears(served.live, unknown)
    told = [r.getMessage() for r in caplog.records if CAUSES["unknown_key"] in r.getMessage()]
    assert 2 <= len(told) <= 1 + (served.now_ns - start_ns) // (10 * _SECOND_NS)
    more = [int(found[1]) for text in told if (found := re.search(r"(\d+) more since", text))]
    assert len(told) + sum(more) == served.gate.refused["unknown_key"] == 11


def _throw(endpoint: str, data: bytes) -> socket.socket:
    host, port = endpoint.removeprefix("tcp://").split(":")
    thrown = socket.create_connection((host, int(port)), timeout=30)
    with contextlib.suppress(OSError):  # it may hang up while we still talk
        thrown.sendall(data)
    return thrown


@pytest.mark.parametrize("what", GARBAGE)
def test_garbage_gets_nothing_and_disturbs_nobody(served: Served, tmp_path: Path, what: str) -> None:
    key = tmp_path / "pilot.key"
    with (
        connect("health/*/*", endpoint=served.live, key=key) as messages,
        contextlib.ExitStack() as open_still,
    ):
        first = messages.recv(30)
        assert first is not None
        for endpoint in (*served.publisher.endpoints.values(), served.control.endpoint):
            for _ in range(3):
                open_still.enter_context(_throw(endpoint, GARBAGE[what]))
        assert request("status", endpoint=served.control.endpoint, key=key, timeout_s=30)["answer"] == 42
        for _ in range(20):
            assert messages.recv(30) is not None
        assert messages.gaps == 0
    assert served.control.refused == 0  # nothing of it came through as a request


@pytest.mark.parametrize("what", GARBAGE)
def test_garbage_disturbs_no_daemon_without_keys_either(unguarded: Served, what: str) -> None:
    with contextlib.ExitStack() as open_still:
        for endpoint in (*unguarded.publisher.endpoints.values(), unguarded.control.endpoint):
            open_still.enter_context(_throw(endpoint, GARBAGE[what]))
        assert request("status", endpoint=unguarded.control.endpoint, key="", timeout_s=30)["answer"] == 42
        assert _hears(unguarded.live, "")


def test_what_speaks_zeromq_but_wrongly_is_counted(served: Served) -> None:
    with _throw(served.live, GARBAGE["a false hello"]), _throw(served.live, GARBAGE["no security"]):
        served.until(lambda: set(served.gate.refused) == {"garbage", "no_key"})


@given(data=st.binary(max_size=400), lead=st.sampled_from([b"", NULL, CURVE, NULL + READY + b"REQ"]))
@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
def test_whatever_comes_control_answers_on(unguarded: Served, data: bytes, lead: bytes) -> None:
    with _throw(unguarded.control.endpoint, lead + data):
        assert request("status", endpoint=unguarded.control.endpoint, key="", timeout_s=30)["answer"] == 42


def test_a_request_too_large_is_cut_off(unguarded: Served) -> None:
    with zmq.Context() as context, context.socket(zmq.REQ) as asker:
        asker.setsockopt(zmq.LINGER, 0)
        asker.connect(unguarded.control.endpoint)
        asker.send(bytes(2_000_000))
        assert request("status", endpoint=unguarded.control.endpoint, key="", timeout_s=30)["answer"] == 42
        assert asker.poll(100) == 0
    assert unguarded.control.refused == 0


def test_ipc_is_the_file_systems_business(folder: Path, endpoints: dict[str, str]) -> None:
    with zmq.Context() as context:
        gate = Gate(context, folder)
        publisher = Publisher(context, endpoints["live"], endpoints["complete"], gate)
        control = Control(context, endpoints["control"], gate)
        control.commands["status"] = lambda _, __: {}
        with context.socket(zmq.REQ) as asker:
            asker.setsockopt(zmq.LINGER, 0)
            asker.connect(endpoints["control"])
            asker.send(b"?")
            while not asker.poll(5):
                gate.poll(0)
                control.poll(_SECOND_NS)
        publisher.close()
        control.close()
        gate.close()


def test_a_gate_without_its_keys_does_not_open(folder: Path) -> None:
    (folder / "server.key").chmod(0o644)
    with zmq.Context() as context, pytest.raises(keys.KeysError, match="chmod 600"):
        Gate(context, folder)
