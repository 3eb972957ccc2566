"""From a daemon's complete stream to Zenoh: the same topics below a root, the same bytes.

Public names: `Relay`, `Commands`, `open_session`, `ENCODING`.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
from collections.abc import Sequence
from typing import Any

import msgpack
import zenoh

from handtouch import wire
from handtouch.bridge import BridgeError, Options, Robot
from handtouch.client import Subscriber, request

ENCODING = zenoh.Encoding("application/msgpack")
_QUEUE = 20_000
"""Messages kept here while Zenoh is busy; the daemon keeps as many again."""
_AT_ONCE = 1000
_COMMANDS = 16
_log = logging.getLogger("handtouch.bridge")

Session = zenoh.Session


def open_session(options: Options) -> Session:
    """A peer that knows the endpoints it was given and looks for no others, unless its file says so.

    It comes back by itself when they do. Raises BridgeError for what Zenoh doesn't take.
    """
    try:
        config = zenoh.Config.from_file(str(options.zenoh)) if options.zenoh else zenoh.Config()
        if not options.zenoh:
            config.insert_json5("mode", '"peer"')
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("listen/endpoints", "[]")
        for key, endpoints in (("connect", options.connect), ("listen", options.listen)):
            if endpoints:
                config.insert_json5(f"{key}/endpoints", json.dumps(list(endpoints)))
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = " at /"  # in its source: of no use to whoever reads it
        raise BridgeError(f"Zenoh can't be opened: {str(error).split(where)[0]}") from error


class Relay:
    """Carries one daemon. `carried` counts messages; losses and malformed ones are counted in `source`.

    While the daemon lives there is a liveliness token at `root`. Queries below it are answered with the
    latest message of every topic; of a daemon that is gone, with nothing.
    """

    def __init__(
        self, session: Session, root: str, robot: Robot, topics: Sequence[str], key: str | None
    ) -> None:
        self.root = root
        self.source = _Source(tuple(topics), robot.stream, _QUEUE, key)
        self.carried = 0
        self._session = session
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._latest: dict[str, tuple[zenoh.KeyExpr, bytes]] = {}
        self._lock = threading.Lock()
        self._token: zenoh.LivelinessToken | None = None
        self._gaps = 0
        self._queryable = session.declare_queryable(f"{root}/**", self._answer, complete=True)

    def step(self, longest_s: float) -> None:
        """Carry what comes within a time. Raises PermissionError when the daemon doesn't let us in."""
        parts = self.source.recv(longest_s)
        if self.source.heard and self.source.alive != (self._token is not None):
            self._tell(self.source.alive)
        for _ in range(_AT_ONCE):
            if parts is None:
                return
            self._put(*parts)
            parts = self.source.recv(0)
        if parts is not None:
            self._put(*parts)

    def close(self) -> None:
        """Leave both sides."""
        self._queryable.undeclare()
        if self._token is not None:
            self._tell(False)
        self.source.close()
        _log.info("%s: %d messages carried, %d lost before", self.root, self.carried, self.source.gaps)

    def _put(self, topic: bytes, payload: bytes) -> None:
        name = topic.decode()
        publisher = self._publishers.get(name)
        if publisher is None:
            publisher = self._publishers[name] = self._session.declare_publisher(
                f"{self.root}/{name}",
                encoding=ENCODING,
                congestion_control=zenoh.CongestionControl.BLOCK,  # it is us who wait, not the daemon
                express=True,
            )
        publisher.put(payload)
        with self._lock:
            self._latest[name] = publisher.key_expr, payload
        self.carried += 1
        if self.source.gaps != self._gaps:
            lost, self._gaps = self.source.gaps - self._gaps, self.source.gaps
            _log.warning("%s: %d messages were lost on the way here", self.root, lost)

    def _tell(self, alive: bool) -> None:
        """Whether the daemon is there."""
        if alive:
            self._token = self._session.liveliness().declare_token(self.root)
        elif self._token is not None:
            self._token.undeclare()
            self._token = None
            with self._lock:
                self._latest.clear()
        _log.info("%s: the daemon is %s", self.root, "there" if alive else "gone")

    def _answer(self, query: zenoh.Query) -> None:
        with self._lock:
            latest = list(self._latest.values())
        for key, payload in latest:
            if query.key_expr.intersects(key):
                query.reply(key, payload, encoding=ENCODING)


class Commands:
    """Passes queries at ROOT/control on to the daemon: payload and answer as in docs/wire.md, "Control"."""

    def __init__(self, session: Session, root: str, endpoint: str, key: str | None) -> None:
        self._at = f"{root}/control"
        self._endpoint, self._key = endpoint, key
        self._queue: queue.Queue[zenoh.Query | None] = queue.Queue(_COMMANDS)
        self._thread = threading.Thread(target=self._serve, name=f"control-{root}", daemon=True)
        self._thread.start()
        self._queryable = session.declare_queryable(self._at, self._take)

    def close(self) -> None:
        """Take no more."""
        self._queryable.undeclare()
        self._queue.put(None)
        self._thread.join()

    def _take(self, query: zenoh.Query) -> None:
        if str(query.key_expr) != self._at:
            return  # a wildcard asks for topics; it is no command to everybody
        try:
            self._queue.put_nowait(query)
        except queue.Full:
            query.reply_err(msgpack.packb(_refusal("too many commands at once")), encoding=ENCODING)

    def _serve(self) -> None:
        while (query := self._queue.get()) is not None:
            answer = self.answer(bytes(query.payload) if query.payload is not None else b"")
            query.reply(query.key_expr, msgpack.packb(answer), encoding=ENCODING)
            query.drop()

    def answer(self, payload: bytes) -> dict[str, Any]:
        """The daemon's answer to a request, whatever its bytes."""
        try:
            asked = msgpack.unpackb(payload)
            version, command = asked.pop("v"), asked.pop("command")
            if version != wire.SCHEMA_VERSION or not isinstance(command, str) or set(asked) & _OURS:
                return _refusal(f"malformed request: v must be {wire.SCHEMA_VERSION}, command a text")
            return request(command, endpoint=self._endpoint, key=self._key, **asked)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            return _refusal(f"malformed request: send a msgpack map with v and command ({error!r:.80})")
        except (OSError, RuntimeError, msgpack.exceptions.UnpackException) as error:
            return _refusal(str(error))


class _Source(Subscriber[Any]):
    """A subscriber that yields messages as they came, two parts each, once they are known to be whole."""

    def _accept(self, parts: list[bytes]) -> Any:
        return parts if super()._accept(parts) is not None else None


_OURS = {"endpoint", "key", "timeout_s"}


def _refusal(why: str) -> dict[str, Any]:
    return {"v": wire.SCHEMA_VERSION, "ok": False, "error": why}
