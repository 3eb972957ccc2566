"""Connections of clients to the daemon's endpoints: which one a message came over, how to close or delay one.

Public names: `connection_of`, `client_key_of`, `close_connection`, `block_connection`,
`drop_connection_requests`, `dropped_connection_requests`.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import struct

import zmq

_SO_ATTACH_FILTER, _SO_DETACH_FILTER, _SO_MEMINFO = 26, 27, 55  # not in Python's module
_MEMINFO_FORMAT = "9I"  # the last: packets that the socket has dropped

Instruction = tuple[int, int, int, int]
"""Instruction of a socket filter (classic BPF): code, jump if true, jump if false, operand"""
_LOAD_BYTE, _LOAD_WORD, _AND, _JUMP_IF_EQUAL, _RETURN = 0x30, 0x20, 0x54, 0x15, 0x06
_TCP_FLAGS, _SYN_ACK, _SYN = 13, 0x12, 0x02
_RANDOM = 0xFFFFF000 + 56
_ACCEPT, _DROP = (_RETURN, 0, 0, 0x40000), (_RETURN, 0, 0, 0)


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


def drop_connection_requests(listener: int, endpoint: str, halvings: int) -> bool:
    """Make the kernel drop requests to connect to a TCP endpoint at random; return False if that fails.

    `listener` is the descriptor that listens there; one request of 2^`halvings` gets through, each with
    `halvings` = 0. Established connections aren't affected. Who connects repeats its request after 1, 3, 7 s.
    """
    with contextlib.suppress(OSError), _open_duplicate(listener) as listening:
        if _is_of_endpoint(listening.getsockname(), endpoint):
            if halvings:
                _attach_filter(
                    listening,
                    (_LOAD_BYTE, 0, 0, _TCP_FLAGS),
                    (_AND, 0, 0, _SYN_ACK),
                    (_JUMP_IF_EQUAL, 0, 3, _SYN),
                    (_LOAD_WORD, 0, 0, _RANDOM),
                    (_AND, 0, 0, (1 << halvings) - 1),
                    (_JUMP_IF_EQUAL, 0, 1, 0),
                    _ACCEPT,
                    _DROP,
                )
            else:
                listening.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
            return True
    return False


def dropped_connection_requests(listener: int, endpoint: str) -> int | None:
    """Return how many requests to connect the kernel has dropped, modulo 2^32; None if it can't say."""
    with contextlib.suppress(OSError), _open_duplicate(listener) as listening:
        if _is_of_endpoint(listening.getsockname(), endpoint):
            size = struct.calcsize(_MEMINFO_FORMAT)
            return int(
                struct.unpack(_MEMINFO_FORMAT, listening.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, size))[-1]
            )
    return None


def _open_duplicate(descriptor: int) -> socket.socket:
    return socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM)


def _drop_packets(connection: socket.socket) -> None:
    """Make the kernel drop whatever a TCP connection receives from now on.

    Linux would go on receiving after a shutdown. A shutdown of both sides, or a reset, must not be seen by
    ZeroMQ while it waits for the hot thread to take subscriptions: a heartbeat among them would abort it
    (zeromq/libzmq issue 4364).
    """
    _attach_filter(connection, _DROP)
    # the peer's answer to an orderly end would be dropped, too: reset the connection when ZeroMQ closes it
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def _attach_filter(connection: socket.socket, *instructions: Instruction) -> None:
    """Make the kernel run a filter on the TCP header of each packet for a socket."""
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *each) for each in instructions))
    program = struct.pack("@HP", len(instructions), ctypes.addressof(code))
    connection.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)


def _is_of_endpoint(address: object, endpoint: str) -> bool:
    """Return True if the local address of a connection is an endpoint as bound."""
    if isinstance(address, tuple):
        return endpoint.startswith("tcp://") and endpoint.endswith(f":{address[1]}")
    if isinstance(address, str | bytes):
        return endpoint == "ipc://" + os.fsdecode(address).replace("\0", "@", 1)
    return False
