"""Answers a controller's requests to a simulated gripper: ZeroMQ REP, msgpack maps (docs/simulate.md).

Public name: `GripperService`. A request that can't be used is refused with the reason.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from handtouch.simulate.gripper import GripperWorld

_LOOK_MS = 100
_LARGEST_BYTES = 65_536


class GripperService:
    """A thread that answers at `endpoint` until `close`; `since_s` turns monotonic ns into the world's time.

    Raises ValueError for an endpoint that can't be had.
    """

    def __init__(self, world: GripperWorld, since_s: Callable[[int], float], endpoint: str) -> None:
        self._world, self._since_s = world, since_s
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, _LARGEST_BYTES)
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self._socket.close()
            raise ValueError(
                f"--gripper {endpoint}: {error.strerror}; give a free one, e.g. tcp://127.0.0.1:5590"
            ) from error
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gripper", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answer no more."""
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            if self._socket.poll(_LOOK_MS):
                self._socket.send(msgpack.packb(self._answer(self._socket.recv(), time.monotonic_ns())))

    def _answer(self, request: bytes, t_ns: int) -> dict[str, Any]:
        try:
            asked = msgpack.unpackb(request)
            if not isinstance(asked, dict):
                raise ValueError("a request is a map")
            self._do(asked, self._since_s(t_ns))
        except KeyError as error:
            return {"ok": False, "error": f"the key {error} is missing"}
        except (ValueError, TypeError, AttributeError, msgpack.UnpackException) as error:
            return {"ok": False, "error": str(error) or type(error).__name__}
        return {"ok": True, "t_ns": t_ns, "position_m": self._world.position_m, "truth": self._world.truth()}

    def _do(self, asked: dict[str, Any], t_s: float) -> None:
        world = self._world
        match asked["do"]:
            case "move":
                world.command(t_s, asked["velocity_m_s"])
            case "look":
                world.advance(t_s)
            case "reset":
                world.advance(t_s)
                world.reset(asked["object"], **asked.get("numbers", {}))
            case "pull":
                world.pull(t_s, float(asked["force_n"]), float(asked.get("ramp_s", 0.0)))
            case other:
                raise ValueError(f"can't {other!r}; can move, look, reset, pull")
