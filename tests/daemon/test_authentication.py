"""Access control of a daemon with keys, with real sockets and handshakes."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
import re
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtouch import wire
from handtouch.client import connect, key_maker, keys, request
from handtouch.client.connection import Connection
from handtouch.daemon.authentication import REFUSAL_CAUSES, Authenticator
from handtouch.daemon.control import ControlServer
from handtouch.daemon.inputs import InputReceiver
from handtouch.daemon.publisher import Publisher

_SECOND_NS = 1_000_000_000
TOPICS = wire.topics_of({"h": ["thumb"]})
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00"
NULL = GREETING + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)
CURVE = GREETING + b"CURVE".ljust(20, b"\0") + b"\0" + bytes(31)
READY = b"\x04\x19\x05READY\x0bSocket-Type\0\0\0\x03"
HUGE = b"\x02\x7f" + b"\xff" * 7 + b"x" * 1000
"""a frame that claims 2^63 bytes"""

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
    zero: dict[str, Any] = {"int": 0, "float": 0.0, "str": "", "bool": False}
    values: dict[str, Any] = {
        field.name: zero.get(str(field.type)) for field in fields(wire.Health) if field.default is MISSING
    }
    status = {"state": "clear", "node_state": "operational", "sampling": "sync", "emergencies": ()}
    about = {"v": wire.SCHEMA_VERSION, "seq": seq, "hand": "h", "link": "thumb"}
    return wire.Health(**{**values, **status, **about})


class Served:
    """A publisher and a control endpoint with access control, polled by a thread like the hot thread."""

    def __init__(self, folder: Path | None) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.authenticator = Authenticator.open(self.context, folder)
        self.publisher = Publisher.open(
            self.context, "tcp://127.0.0.1:*", "tcp://127.0.0.1:*", TOPICS, self.authenticator
        )
        self.control = ControlServer.open(self.context, "tcp://127.0.0.1:*", self.authenticator)
        self.control.commands["status"] = lambda _, __: {"answer": 42}
        self.inputs = InputReceiver.open(
            self.context, "tcp://127.0.0.1:*", self.authenticator, {}, [("h", "thumb")]
        )
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
            self.authenticator.poll(self.now_ns)
            self.publisher.poll_subscriptions(self.now_ns)
            self.control.poll(self.now_ns)
            self.inputs.poll(self.now_ns)
            self.sent += 1
            self.publisher.send(_health(self.sent))

    def until(self, met: Callable[[], bool]) -> None:
        for _ in range(2000):
            if met():
                return
            self._stop.wait(0.005)
        raise AssertionError(f"refused {dict(self.authenticator.refused)}")

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.publisher.close()
        self.control.close()
        self.inputs.close()
        self.authenticator.close()
        self.context.destroy(0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    key_maker.make_server_keys(tmp_path / "keys", "robot1")
    key_maker.add_client(tmp_path / "keys", "reader", "read", tmp_path / "reader.key")
    key_maker.add_client(tmp_path / "keys", "pilot", "control", tmp_path / "pilot.key")
    return tmp_path / "keys"


@pytest.fixture
def served(folder: Path) -> Iterator[Served]:
    made = Served(folder)
    yield made
    made.close()


@pytest.fixture
def without_keys() -> Iterator[Served]:
    made = Served(None)
    yield made
    made.close()


@pytest.fixture
def foreign(tmp_path: Path, folder: Path) -> Path:
    """Return the key of a client of another daemon."""
    del folder
    key_maker.make_server_keys(tmp_path / "elsewhere", "robot2")
    key_maker.add_client(tmp_path / "elsewhere", "stranger", "control", tmp_path / "foreign.key")
    return tmp_path / "foreign.key"


@pytest.fixture
def unknown(tmp_path: Path, folder: Path) -> Path:
    """Return a revoked key."""
    key_maker.add_client(folder, "revoked", "control", tmp_path / "revoked.key")
    key_maker.revoke(folder, "revoked")
    return tmp_path / "revoked.key"


def _receives(endpoint: str, key: Path | str) -> bool:
    with connect("health/*/*", endpoint=endpoint, key=key) as messages:
        return messages.recv(30) is not None


@pytest.mark.parametrize("name", ["reader", "pilot"])
def test_client_with_read_right_reads_both_streams(served: Served, tmp_path: Path, name: str) -> None:
    assert all(
        _receives(endpoint, tmp_path / f"{name}.key") for endpoint in served.publisher.endpoints.values()
    )
    assert not served.authenticator.refused


def test_client_with_control_right_controls(served: Served, tmp_path: Path) -> None:
    answer = request("status", endpoint=served.control.endpoint, key=tmp_path / "pilot.key", timeout_s=30)
    assert answer["answer"] == 42


def test_read_key_may_ask_for_the_status_and_change_nothing(served: Served, tmp_path: Path) -> None:
    served.control.commands["disable"] = lambda _, __: {}
    key = tmp_path / "reader.key"
    assert request("status", endpoint=served.control.endpoint, key=key, timeout_s=30)["answer"] == 42
    with pytest.raises(RuntimeError, match='this key has the right "read"; the command needs "control"'):
        request("disable", endpoint=served.control.endpoint, key=key, timeout_s=30)
    assert request("disable", endpoint=served.control.endpoint, key=tmp_path / "pilot.key", timeout_s=30)


def test_read_key_is_refused_by_inputs(
    served: Served, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    connection = Connection.open(zmq.PUB, served.inputs.endpoint, tmp_path / "reader.key", {zmq.LINGER: 0})
    served.until(lambda: served.authenticator.refused["no_right"] > 0)
    connection.close()
    text = 'connection refused: client has the right "read", but not "control": reader from 127.0.0.1'
    assert text in caplog.text


def test_client_without_key_is_refused(served: Served) -> None:
    with pytest.raises(PermissionError, match="handtouch keys client"):
        _receives(served.live, "")
    with pytest.raises(PermissionError, match="handtouch keys client"):
        request("status", endpoint=served.control.endpoint, key="", timeout_s=30)
    served.until(lambda: served.authenticator.refused.total() >= 2)
    assert set(served.authenticator.refused) <= {
        "no_key",
        "malformed",
    }  # malformed: the peer may notice the mismatch first
    assert not served.publisher.subscriptions


def test_unknown_key_is_refused(served: Served, unknown: Path) -> None:
    with pytest.raises(PermissionError, match="unknown there"):
        _receives(served.live, unknown)
    with pytest.raises(PermissionError, match="unknown there"):
        request("status", endpoint=served.control.endpoint, key=unknown, timeout_s=30)
    assert served.authenticator.refused == {"unknown_key": 2}


def test_key_for_another_daemon_is_refused(served: Served, foreign: Path) -> None:
    with pytest.raises(PermissionError, match="for robot2: this is another daemon"):
        _receives(served.live, foreign)
    served.until(lambda: served.authenticator.refused["wrong_server_key"] >= 1)


def test_client_with_key_refuses_a_daemon_without_keys(
    without_keys: Served, tmp_path: Path, folder: Path
) -> None:
    """The key identifies the daemon, so this could be any."""
    del folder
    with pytest.raises(PermissionError, match="another daemon"):
        _receives(without_keys.live, tmp_path / "reader.key")


def test_refusal_is_raised_in_asyncio_too(served: Served, unknown: Path) -> None:
    async def first(key: Path) -> object:
        with connect("health/*/*", endpoint=served.live, key=key) as messages:
            async for message in messages:
                return message
        return None

    with pytest.raises(PermissionError, match="unknown there"):
        asyncio.run(asyncio.wait_for(first(unknown), 30))
    assert asyncio.run(asyncio.wait_for(first(unknown.parent / "reader.key"), 30)) is not None


def test_key_from_the_environment(served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HANDTOUCH_KEY", str(tmp_path / "pilot.key"))
    assert request("status", endpoint=served.control.endpoint, timeout_s=30)["answer"] == 42
    monkeypatch.setenv("HANDTOUCH_KEY", str(tmp_path / "absent.key"))
    with pytest.raises(ValueError, match=r"absent\.key"):
        connect(endpoint=served.live)


def test_clients_are_added_and_revoked_without_restart(served: Served, folder: Path, tmp_path: Path) -> None:
    key_maker.add_client(folder, "late", "read", tmp_path / "late.key")
    assert _receives(served.live, tmp_path / "late.key")
    entry = folder / "clients/late.pub"
    entry.write_text(entry.read_text().replace('"read"', '"control"'))
    request("status", endpoint=served.control.endpoint, key=tmp_path / "late.key", timeout_s=30)
    key_maker.revoke(folder, "late")
    with pytest.raises(PermissionError):
        _receives(served.live, tmp_path / "late.key")
    assert _receives(served.live, tmp_path / "reader.key")


def test_open_connections_of_a_revoked_client_are_closed(
    served: Served, folder: Path, tmp_path: Path
) -> None:
    key, endpoint = tmp_path / "reader.key", served.control.endpoint
    asking = Connection.open(zmq.REQ, endpoint, key, {zmq.LINGER: 0})
    with (
        connect("health/*/*", endpoint=served.live, key=key) as revoked,
        connect("health/*/*", endpoint=served.live, key=tmp_path / "pilot.key") as other,
    ):
        asking.socket.send(msgpack.packb({"v": 1, "command": "status"}))
        served.until(lambda: asking.poll(0) and asking.readable)
        assert revoked.recv(30) is not None
        assert other.recv(30) is not None
        key_maker.revoke(folder, "reader")
        served.until(lambda: served.authenticator.refused["revoked"] == 2)
        with pytest.raises(PermissionError, match="rejects the key of reader"):
            list(itertools.islice(revoked, 10_000))
        for _ in range(100):
            assert other.recv(30) is not None
        assert other.lost_messages == 0
    asking.close()


def test_client_with_other_rights_has_them_at_once(served: Served, folder: Path, tmp_path: Path) -> None:
    key, endpoint = tmp_path / "pilot.key", served.inputs.endpoint
    entry = folder / "clients/pilot.pub"
    message = [
        b"force/h",
        msgpack.packb({"v": 1, "t_ns": None, "links": ["x"], "force_n": [1.0], "std_n": [1.0]}),
    ]
    connection = Connection.open(zmq.PUB, endpoint, key, {zmq.LINGER: 0})

    def received() -> bool:
        connection.socket.send_multipart(message)
        return served.inputs.dropped["unknown_link"] > 0

    served.until(received)
    entry.write_text(entry.read_text().replace('"control"', '"read"'))
    served.until(lambda: served.authenticator.refused["no_right"] > 0)
    served.inputs.dropped.clear()
    assert not any(received() for _ in range(20))
    connection.close()


def test_all_clients_are_refused_while_the_folder_is_writable_by_others(
    served: Served, folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "clients").chmod(0o777)
    with pytest.raises(PermissionError):
        _receives(served.live, tmp_path / "reader.key")
    assert f"chmod go-w {folder / 'clients'}" in caplog.text
    (folder / "clients").chmod(0o755)
    assert _receives(served.live, tmp_path / "reader.key")


def test_repeated_refusals_are_logged_at_a_limited_rate(
    served: Served, unknown: Path, caplog: pytest.LogCaptureFixture
) -> None:
    start_ns = served.now_ns
    for _ in range(10):
        with pytest.raises(PermissionError):
            _receives(served.live, unknown)
    served.skipped_ns = 11 * _SECOND_NS
    served.until(lambda: served.now_ns - start_ns > served.skipped_ns)  # what is polled now has that time
    with pytest.raises(PermissionError):
        _receives(served.live, unknown)
    lines = [r.getMessage() for r in caplog.records if REFUSAL_CAUSES["unknown_key"] in r.getMessage()]
    assert 2 <= len(lines) <= 1 + (served.now_ns - start_ns) // (10 * _SECOND_NS)
    more = [int(found[1]) for text in lines if (found := re.search(r"(\d+) more since", text))]
    assert len(lines) + sum(more) == served.authenticator.refused["unknown_key"] == 11


def _throw(endpoint: str, data: bytes) -> socket.socket:
    host, port = endpoint.removeprefix("tcp://").split(":")
    thrown = socket.create_connection((host, int(port)), timeout=30)
    with contextlib.suppress(OSError):  # the peer may disconnect early
        thrown.sendall(data)
    return thrown


@pytest.mark.parametrize("what", GARBAGE)
def test_garbage_is_refused_and_disturbs_no_client(served: Served, tmp_path: Path, what: str) -> None:
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
        assert messages.lost_messages == 0
    assert served.control.refused == 0  # none of it counts as a request


def test_bytes_that_are_not_zmtp_3_never_become_messages_without_keys(without_keys: Served) -> None:
    subscription, request_ = b"\x01contact/", b"\0\x01x"
    thrown = [
        *(b"\x01\0" + bytes([len(body) + 1, 0]) + body for body in (subscription, request_)),  # ZMTP 1.0
        *(random.Random(seed).randbytes(2000) for seed in range(20)),
    ]
    endpoints = (
        *without_keys.publisher.endpoints.values(),
        without_keys.control.endpoint,
        without_keys.inputs.endpoint,
    )
    with contextlib.ExitStack() as open_still:
        for data in thrown:
            for endpoint in endpoints:
                open_still.enter_context(_throw(endpoint, data))
        assert request("status", endpoint=without_keys.control.endpoint, key="", timeout_s=30)["answer"] == 42
        with connect("health/*/*", endpoint=without_keys.live) as messages:
            assert messages.recv(30) is not None
        assert without_keys.publisher.subscriptions <= {b"health/", b"service"}
    assert without_keys.publisher.refused == without_keys.inputs.dropped == {}
    assert without_keys.control.refused == 0


@pytest.mark.parametrize("what", GARBAGE)
def test_garbage_does_not_disturb_a_daemon_without_keys(without_keys: Served, what: str) -> None:
    with contextlib.ExitStack() as open_still:
        for endpoint in (*without_keys.publisher.endpoints.values(), without_keys.control.endpoint):
            open_still.enter_context(_throw(endpoint, GARBAGE[what]))
        assert request("status", endpoint=without_keys.control.endpoint, key="", timeout_s=30)["answer"] == 42
        assert _receives(without_keys.live, "")


def test_wrong_zmtp_is_counted(served: Served) -> None:
    with _throw(served.live, GARBAGE["a false hello"]), _throw(served.live, GARBAGE["no security"]):
        served.until(lambda: set(served.authenticator.refused) == {"malformed", "no_key"})


@given(data=st.binary(max_size=400), lead=st.sampled_from([b"", NULL, CURVE, NULL + READY + b"REQ"]))
@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
def test_control_keeps_answering_after_any_bytes(without_keys: Served, data: bytes, lead: bytes) -> None:
    with _throw(without_keys.control.endpoint, lead + data):
        assert request("status", endpoint=without_keys.control.endpoint, key="", timeout_s=30)["answer"] == 42


def test_oversized_request_closes_the_connection(without_keys: Served) -> None:
    with zmq.Context() as context, context.socket(zmq.REQ) as asker:
        asker.setsockopt(zmq.LINGER, 0)
        asker.connect(without_keys.control.endpoint)
        asker.send(bytes(2_000_000))
        assert request("status", endpoint=without_keys.control.endpoint, key="", timeout_s=30)["answer"] == 42
        assert asker.poll(100) == 0
    assert without_keys.control.refused == 0


def test_ipc_needs_no_key(folder: Path, endpoints: dict[str, str]) -> None:
    with zmq.Context() as context:
        authenticator = Authenticator.open(context, folder)
        publisher = Publisher.open(context, endpoints["live"], endpoints["complete"], TOPICS, authenticator)
        control = ControlServer.open(context, endpoints["control"], authenticator)
        control.commands["status"] = lambda _, __: {}
        with context.socket(zmq.REQ) as asker:
            asker.setsockopt(zmq.LINGER, 0)
            asker.connect(endpoints["control"])
            asker.send(b"?")
            while not asker.poll(5):
                authenticator.poll(0)
                control.poll(_SECOND_NS)
        publisher.close()
        control.close()
        authenticator.close()


def test_unusable_keys_raise_on_open(folder: Path) -> None:
    (folder / "server.key").chmod(0o644)
    with zmq.Context() as context, pytest.raises(keys.KeyFileError, match="chmod 600"):
        Authenticator.open(context, folder)
