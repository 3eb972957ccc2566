"""The hand in Foxglove, live: a subscriber that serves the topics of a recording over Foxglove's WebSocket.

Public names: `FoxgloveServer`, `open_server`, `serve`, `PATTERNS`. Needs the extra `foxglove`.
"""

from __future__ import annotations

import secrets
import threading
import time
from typing import Any, Self
from urllib.parse import quote

import foxglove

from handtouch.client import Subscriber
from handtouch.record.foxglove import FoxgloveConverter
from handtouch.record.recorder import MessageRecorder, RotationLimits
from handtouch.record.schemas import MessageFormat, wire_format
from handtouch.view.origin_gate import OriginGate

PORT = 8765
"""The port that Foxglove proposes."""
PATTERNS = ("config", "service", "health/*/*", "contact/*/*", "joints/*")
QUEUE_MESSAGES = 20_000
_POLL_S = 0.2


class FoxgloveServer:
    """A WebSocket server for Foxglove, whose channels begin with their first message; a `MessageFile`.

    A client that doesn't keep up loses the oldest messages. Pages of other websites are refused. Raises
    RuntimeError if the address can't be used.
    """

    size = 0

    def __init__(self, host: str, port: int) -> None:
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        inner = _hidden_address()
        self._server = foxglove.start_server(name="handtouch", host=inner, port=0, context=self._context)
        try:
            self._gate = OriginGate(host, port, (inner, self._server.port))
        except RuntimeError:
            self._server.stop()
            raise
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.port}"
        self.app_url = f"https://app.foxglove.dev?ds=foxglove-websocket&ds.url={quote(self.url, safe='')}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._gate.__exit__()
        self._server.stop()

    def write(
        self,
        topic: str,
        data: bytes,
        t_ns: int,
        seq: int = 0,  # noqa: ARG002
        form: MessageFormat | None = None,
    ) -> None:
        """Send a message to the clients that subscribe to its topic; without `form` one of the wire's."""
        encoding, name, schema_encoding, text = form or wire_format(topic.split("/")[0])
        if encoding == "msgpack":  # which Foxglove doesn't read
            return
        channel = self._channels.get(topic)
        if channel is None:
            schema = foxglove.Schema(name=name, encoding=schema_encoding, data=text)
            channel = foxglove.Channel(topic, schema=schema, message_encoding=encoding, context=self._context)
            self._channels[topic] = channel
        channel.log(data, log_time=t_ns)

    def flush(self) -> None:
        """Do nothing: messages are sent at once."""

    def finish(self, summary: dict[str, str]) -> None:
        """Do nothing: the server stops at the end of its context."""


def _hidden_address() -> str:
    """Return a loopback address for Foxglove's own server, which checks no Origin: a page can't guess it."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


def open_server(host: str, port: int, percepts: bool) -> FoxgloveServer:  # noqa: ARG001
    """Listen at an address. Raises RuntimeError if it can't be used."""
    return FoxgloveServer(host, port)


def serve(messages: Subscriber[Any], server: FoxgloveServer, stop: threading.Event, end_s: float) -> None:
    """Forward messages until `stop` or the monotonic time `end_s`.

    Raises PermissionError when the daemon rejects this client.
    """
    recorder = MessageRecorder(lambda _: server, RotationLimits(), FoxgloveConverter)
    while not stop.is_set() and time.monotonic() < end_s:
        parts = messages.recv_unchecked(_POLL_S)
        if parts is not None:
            recorder.add_message(parts, time.monotonic_ns())
