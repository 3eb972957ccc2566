"""ZeroMQ endpoints of the daemon: bind a socket with access control, or raise an error that names a remedy.

Public names: `EndpointError`, `bind_endpoint`, `remove_socket_file`, `is_readable`.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Protocol

import zmq

from handtouch.host.endpoints import check_ipc_path

_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)  # looking up enumeration members costs more


class EndpointError(OSError):
    """An endpoint that can't be opened; the text names purpose, endpoint and remedy."""

    exit_status = 1


class SocketGuard(Protocol):
    """Sets message-size limits and access control of a socket: `Authenticator`."""

    def secure_socket(self, socket: zmq.Socket[bytes], endpoint: str, right: str) -> None: ...


def bind_endpoint(
    socket: zmq.Socket[bytes], endpoint: str, purpose: str, guard: SocketGuard, right: str
) -> str:
    """Bind a socket and return its endpoint with the real port; close the socket if that fails.

    `right` is what clients need to connect: "read", "control" or "inputs" (granted with "control").
    Raises EndpointError.
    """
    try:
        check_ipc_path(endpoint)
        guard.secure_socket(socket, endpoint, right)
        socket.bind(endpoint)
    except (OSError, zmq.ZMQError) as error:
        socket.close()
        remedy = (
            "; is another daemon running there? Run `handtouch doctor CONFIG` to check, or set another "
            "endpoint in [daemon]"
        )
        why = f"{error.strerror}{remedy}" if isinstance(error, zmq.ZMQError) else error
        raise EndpointError(f"{purpose} can't be opened at {endpoint}: {why}") from error
    return socket.getsockopt_string(zmq.LAST_ENDPOINT)


def remove_socket_file(endpoint: str) -> None:
    """Remove the file of an ipc endpoint, which ZeroMQ leaves behind; call it before the socket is closed.

    Until then no other daemon can have replaced the file by its own.
    """
    if endpoint.startswith("ipc://") and not endpoint.startswith("ipc://@"):
        path = Path(endpoint.removeprefix("ipc://"))
        with contextlib.suppress(OSError):
            if path.is_socket():
                path.unlink()


def is_readable(socket: zmq.Socket[bytes]) -> bool:
    """Return True if a message waits; costs a third of a failed `recv` and keeps the interpreter lock."""
    return bool(int(socket.getsockopt(_EVENTS)) & _POLLIN)
