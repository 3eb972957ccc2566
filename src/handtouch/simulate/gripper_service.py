"""Server for commands to a simulated gripper: ZeroMQ REP with msgpack maps (see docs/simulate.md).

Public name: `GripperService`. A request that can't be executed is answered with the reason.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from handtouch.host.endpoints import check_ipc_path, is_loopback
from handtouch.simulate.gripper import GripperWorld

_POLL_MS = 100
_MAX_REQUEST_BYTES = 65_536


class GripperService:
    """Thread that answers requests at `endpoint`, from `open` until `close`.

    `elapsed_s` converts monotonic nanoseconds to the time of the world.
    """

    def __init__(self, world: GripperWorld, elapsed_s: Callable[[int], float], endpoint: str) -> None:
        self._world, self._elapsed_s, self._endpoint = world, elapsed_s, endpoint
        self._socket: zmq.Socket[bytes] | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Bind the endpoint and start the thread.

        Raises ValueError if the endpoint can't be bound, or is reachable from other machines.
        """
        transport, _, address = self._endpoint.partition("://")
        if transport == "tcp" and not is_loopback(address.rpartition(":")[0].strip("[]")):
            raise ValueError(
                f"{self._endpoint}: is reachable from other machines, and the gripper has no keys; use "
                f"tcp://127.0.0.1:{address.rpartition(':')[2]}"
            )
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, _MAX_REQUEST_BYTES)
        try:
            check_ipc_path(self._endpoint)
            socket.bind(self._endpoint)
        except (OSError, zmq.ZMQError) as error:
            socket.close()
            raise ValueError(
                f"{self._endpoint}: {error.strerror or error}; choose a free endpoint, e.g. tcp://127.0.0.1:5590"
            ) from error
        self._socket = socket
        self._thread = threading.Thread(target=self._run, args=(socket,), name="gripper", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering and release the endpoint."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        if self._socket is not None:
            self._socket.close()

    def _run(self, socket: zmq.Socket[bytes]) -> None:
        while not self._stop.is_set():
            if socket.poll(_POLL_MS):
                socket.send(msgpack.packb(self._answer(socket.recv(), time.monotonic_ns())))

    def _answer(self, data: bytes, now_ns: int) -> dict[str, Any]:
        try:
            request = msgpack.unpackb(data)
            if not isinstance(request, dict):
                raise ValueError("a request must be a map")
            self._execute(request, self._elapsed_s(now_ns))
        except KeyError as error:
            return {"ok": False, "error": f"the key {error} is missing"}
        except (ValueError, TypeError, AttributeError, msgpack.UnpackException) as error:
            return {"ok": False, "error": str(error) or type(error).__name__}
        return {
            "ok": True,
            "t_ns": now_ns,
            "position_m": self._world.position_m,
            "truth": self._world.truth(),
        }

    def _execute(self, request: dict[str, Any], t_s: float) -> None:
        world = self._world
        match request["do"]:
            case "move":
                world.command_velocity(t_s, request["velocity_m_s"])
            case "state":
                world.advance(t_s)
            case "reset":
                world.advance(t_s)
                world.reset(request["object"], **request.get("parameters", {}))
            case "pull":
                world.pull_object(t_s, float(request["force_n"]), float(request.get("ramp_s", 0.0)))
            case other:
                raise ValueError(f"unknown command {other!r}; known: move, state, reset, pull")
