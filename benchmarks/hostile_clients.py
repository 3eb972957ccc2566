"""Clients that stall, flood or send garbage; and burners that use as much CPU without connecting.

Public names: `HOSTILE`, `hostile_client`, `burner`, `cpu_seconds`.
"""

from __future__ import annotations

import contextlib
import os
import random
import socket
import time
from collections.abc import Callable, Mapping
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import msgpack
import zmq

Endpoints = Mapping[str, str]
SUBSCRIPTIONS = 30_000
REQUESTS_UNDER_WAY = 100
CONNECTIONS_HELD = 200
BURN_PERIOD_S = 0.02


def stall(endpoints: Endpoints, stop: Event, seed: int) -> None:
    """Subscribe to everything and read nothing."""
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.LINGER, 0)
        subscriber.setsockopt(zmq.RCVHWM, 1)
        subscriber.subscribe("")
        subscriber.connect(endpoints["live" if seed % 2 else "complete"])
        stop.wait()


def flood_subscriptions(endpoints: Endpoints, stop: Event, seed: int) -> None:
    """Subscribe to other prefixes without pause, or to the same over and over."""
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.LINGER, 0)
        subscriber.setsockopt(zmq.SNDHWM, 0)
        subscriber.setsockopt(zmq.RECONNECT_IVL, 10)
        subscriber.connect(endpoints["live" if seed % 2 else "complete"])
        number = 0
        while not stop.is_set():
            prefixes = [f"contact/{seed}/{number + k}" if seed % 3 else "hand/" for k in range(100)]
            for prefix in prefixes:
                subscriber.subscribe(prefix)
            if number >= SUBSCRIPTIONS or not seed % 3:
                for prefix in prefixes:
                    subscriber.unsubscribe(prefix)
                time.sleep(0.001)  # with more, it would flood only its own memory
            number += 100
            while subscriber.poll(0):
                subscriber.recv_multipart()


def flood_control(endpoints: Endpoints, stop: Event, seed: int) -> None:
    """Ask for the status without pause, and for a snapshot or a tare now and then."""
    commands: list[dict[str, Any]] = [{"command": "status"}] * 20 + [
        {"command": "snapshot"},
        {"command": "tare", "pads": ["*"]},
    ]
    draw, under_way = random.Random(seed), 0
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 0)
        dealer.connect(endpoints["control"])
        while not stop.is_set():
            while under_way < REQUESTS_UNDER_WAY:
                dealer.send_multipart([b"", msgpack.packb({"v": 1, **draw.choice(commands)})])
                under_way += 1
            while dealer.poll(10 if under_way == REQUESTS_UNDER_WAY else 0):
                dealer.recv_multipart()
                under_way -= 1


def send_garbage(endpoints: Endpoints, stop: Event, seed: int) -> None:
    """Connect to every endpoint in turn, send random bytes, and hold many connections open."""
    draw, held = random.Random(seed), []
    ports = [int(endpoint.rpartition(":")[2]) for endpoint in endpoints.values()]
    while not stop.is_set():
        with contextlib.suppress(OSError):
            connection = socket.create_connection(("127.0.0.1", draw.choice(ports)), timeout=1)
            held.append(connection)
            connection.settimeout(0.1)
            connection.sendall(draw.randbytes(draw.choice([20, 200, 2000, 20_000])))
        if len(held) > CONNECTIONS_HELD:
            held.pop(0).close()


HOSTILE: dict[str, tuple[int, Callable[[Endpoints, Event, int], None]]] = {
    "stalled": (5, stall),
    "flood subscriptions": (5, flood_subscriptions),
    "flood control": (3, flood_control),
    "send garbage": (2, send_garbage),
}
"""Kind -> number of clients, and what each does until it is stopped"""


def hostile_client(kind: str, endpoints: Endpoints, stop: Event, seed: int) -> None:
    """Run a client of a kind."""
    HOSTILE[kind][1](endpoints, stop, seed)


def burner(share: float, stop: Event) -> None:
    """Use a share of one processor."""
    while not stop.is_set():
        begin_s = time.process_time()
        period_end_s = time.monotonic() + BURN_PERIOD_S
        while time.process_time() - begin_s < share * BURN_PERIOD_S:
            pass
        time.sleep(max(0.0, period_end_s - time.monotonic()))


def cpu_seconds(pid: int) -> float:
    """Return the CPU time that a process has used, all threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
