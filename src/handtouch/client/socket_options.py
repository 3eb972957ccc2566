"""Options of ZeroMQ sockets of clients and the daemon.

Public names: `KEEPALIVE_OPTIONS`, `RECONNECT_OPTIONS`.
"""

from collections.abc import Mapping

import zmq

KEEPALIVE_OPTIONS: Mapping[int, int] = {
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 1,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 2,
}
"""Socket options: the kernel detects a dead connection within 3 s.

Not ZeroMQ's heartbeats: with them, libzmq 4.3 aborts a process whose queue was full for longer than their
timeout (zeromq/libzmq issues 3937, 4364 and 4767).
"""
RECONNECT_OPTIONS: Mapping[int, int] = {
    **KEEPALIVE_OPTIONS,
    zmq.CONNECT_TIMEOUT: 2000,
    zmq.RECONNECT_IVL: 50,
    zmq.RECONNECT_IVL_MAX: 1000,
}
"""Socket options: a dead connection is detected within 3 s, and retried at least once a second."""
