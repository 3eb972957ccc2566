"""Connections of clients to the daemon's endpoints: which one a message came over, and how to close one.

Public names: `connection_of`, `client_key_of`, `close_connection`.
"""

from __future__ import annotations

import contextlib
import os
import socket

import zmq


def connection_of(frame: zmq.Frame) -> int:
    """Return the file descriptor of the connection that a frame came over, -1 if it has none."""
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return -1


def client_key_of(frame: zmq.Frame) -> str | None:
    """Return the public key by which a frame's sender was authenticated, None without keys."""
    try:
        return str(frame.get("User-Id"))
    except zmq.ZMQError:
        return None


def close_connection(descriptor: int, endpoint: str) -> bool:
    """Close a connection to an endpoint as if its client had left; return False if it is closed already.

    ZeroMQ can't disconnect a peer, so the connection is shut down below it: ZeroMQ then ends it as any other
    that breaks. Meanwhile the descriptor may be another's: what isn't a connection to this endpoint is left
    alone, and another client of this endpoint reconnects within milliseconds.
    """
    with (
        contextlib.suppress(OSError),
        socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM) as connection,
    ):
        if _is_of_endpoint(connection.getsockname(), endpoint):
            connection.shutdown(socket.SHUT_RDWR)
            return True
    return False


def _is_of_endpoint(address: object, endpoint: str) -> bool:
    """Return True if the local address of a connection is an endpoint as bound."""
    if isinstance(address, tuple):
        return endpoint.startswith("tcp://") and endpoint.endswith(f":{address[1]}")
    if isinstance(address, str | bytes):
        return endpoint == "ipc://" + os.fsdecode(address).replace("\0", "@", 1)
    return False
