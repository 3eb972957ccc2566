"""ZeroMQ endpoints of the daemon: bind a socket with access control, or raise an error that names a remedy.

Public names: `bind_endpoint`, `remove_socket_file`, `is_readable`.
"""

from __future__ import annotations

import contextlib
import socket as stdlib_socket
from pathlib import Path
from typing import Protocol

import zmq

_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)  # looking up enumeration members costs more


class SocketGuard(Protocol):
    """Sets message-size limits and access control of a socket: `Authenticator`."""

    def secure_socket(self, socket: zmq.Socket[bytes], endpoint: str, right: str) -> None: ...


def bind_endpoint(
    socket: zmq.Socket[bytes], endpoint: str, purpose: str, guard: SocketGuard, right: str
) -> str:
    """Bind a socket and return its endpoint with the real port; close the socket if that fails.

    `right` is what clients need to connect: "read", "control" or "inputs" (granted with "control").
    Raises OSError naming purpose, endpoint and remedy.
    """
    try:
        _check_ipc_endpoint(endpoint, purpose)
        guard.secure_socket(socket, endpoint, right)
        try:
            socket.bind(endpoint)
        except zmq.ZMQError as error:
            raise OSError(
                f"{purpose} can't be opened at {endpoint}: {error.strerror}; is another daemon running "
                "there? Run `handtouch doctor CONFIG` to check, or set another endpoint in [daemon]"
            ) from error
    except OSError:
        socket.close()
        raise
    return socket.getsockopt_string(zmq.LAST_ENDPOINT)


def remove_socket_file(endpoint: str) -> None:
    """Remove the file of an ipc endpoint, which ZeroMQ leaves behind; call it before the socket is closed.

    Until then no other daemon can have replaced the file by its own.
    """
    if endpoint.startswith("ipc://") and not endpoint.startswith("ipc://@"):
        with contextlib.suppress(OSError):
            Path(endpoint.removeprefix("ipc://")).unlink(missing_ok=True)


def is_readable(socket: zmq.Socket[bytes]) -> bool:
    """Return True if a message waits; costs a third of a failed `recv` and keeps the interpreter lock."""
    return bool(int(socket.getsockopt(_EVENTS)) & _POLLIN)


def _check_ipc_endpoint(endpoint: str, purpose: str) -> None:
    """Raise OSError if the folder is missing or another daemon listens; ZeroMQ would take over its file."""
    if not endpoint.startswith("ipc:///"):
        return
    path = Path(endpoint.removeprefix("ipc://"))
    if not path.parent.is_dir():
        raise OSError(
            f"{purpose} can't be opened at {endpoint}: folder {path.parent} doesn't exist; create it"
        )
    with stdlib_socket.socket(stdlib_socket.AF_UNIX) as probe:
        if probe.connect_ex(str(path)) == 0:
            raise OSError(
                f"{purpose} can't be opened at {endpoint}: another daemon is using it; stop that daemon, or "
                "set another endpoint in [daemon] of the deployment"
            )
