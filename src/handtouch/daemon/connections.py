"""Connections of clients to the daemon's endpoints: which one a message came over, and how to close one.

Public names: `connection_of`, `client_key_of`, `close_connection`, `block_connection`.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import struct

import zmq

_SO_ATTACH_FILTER = 26  # not in Python's module
_ACCEPT_NOTHING = struct.pack("HBBI", 0x06, 0, 0, 0)  # socket filter: return 0 bytes of every packet


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

    ZeroMQ can't disconnect a peer, so the receiving side is shut down below it: ZeroMQ reads what is there,
    and then the end. Meanwhile the descriptor may be another's: what isn't a connection to this endpoint is
    left alone, and another client of this endpoint reconnects within milliseconds.
    """
    with contextlib.suppress(OSError), _open_duplicate(descriptor) as connection:
        address = connection.getsockname()
        if _is_of_endpoint(address, endpoint):
            if isinstance(address, tuple):
                _drop_packets(connection)
            connection.shutdown(socket.SHUT_RD)
            return True
    return False


def block_connection(descriptor: int, endpoint: str) -> bool:
    """Drop whatever a TCP connection to an endpoint receives from now on; return False if there is none.

    Its client hears nothing, so it doesn't connect again at once, as it would to a closed connection. The
    kernel gives the connection up when the client has acknowledged nothing for 10 s.
    """
    with contextlib.suppress(OSError), _open_duplicate(descriptor) as connection:
        address = connection.getsockname()
        if isinstance(address, tuple) and _is_of_endpoint(address, endpoint):
            _drop_packets(connection)
            return True
    return False


def _open_duplicate(descriptor: int) -> socket.socket:
    return socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM)


def _drop_packets(connection: socket.socket) -> None:
    """Make the kernel drop whatever a TCP connection receives from now on.

    Linux would go on receiving after a shutdown. A shutdown of both sides, or a reset, must not be seen by
    ZeroMQ while it waits for the hot thread to take subscriptions: a heartbeat among them would abort it
    (zeromq/libzmq issue 4364).
    """
    instructions = ctypes.create_string_buffer(_ACCEPT_NOTHING)
    program = struct.pack("@HP", 1, ctypes.addressof(instructions))
    connection.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
    # the peer's answer to an orderly end would be dropped, too: reset the connection when ZeroMQ closes it
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def _is_of_endpoint(address: object, endpoint: str) -> bool:
    """Return True if the local address of a connection is an endpoint as bound."""
    if isinstance(address, tuple):
        return endpoint.startswith("tcp://") and endpoint.endswith(f":{address[1]}")
    if isinstance(address, str | bytes):
        return endpoint == "ipc://" + os.fsdecode(address).replace("\0", "@", 1)
    return False
