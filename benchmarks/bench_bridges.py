"""Bridges to ROS 2 and Zenoh: latency, losses and processor time, with simulated publishers.

A process publishes the messages of hands of 15 pads, as their daemons would. The real bridge relays them: to
ROS 2, with all pads touched; and those of 1, 10 and 50 hands, each with a bridge process and three touched
pads at 100 Hz besides hand frames, through a Zenoh router to one subscriber, all on this machine. Latency is
from sending by the publisher to a subscriber in Python; processor time of all processes of a kind per
received wrench or contact. *Hands of a core*: by that time, so many hands fill a core of each kind of
process; the least of them saturates first.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from benchmarks.page import Report, options
from benchmarks.served_hand import processor_s
from handtouch import config, wire
from handtouch.config import shipped
from tests.client.hand_messages import make_contact, make_frame, make_service

LINKS = tuple(pad.link for pad in config.load(shipped.path("utah_mit.toml")).hands[0].pads)
PREFIX = "lab"
TOUCHED, FLEET_HZ = 3, 100.0
START_S = 120.0
_SENTINEL = 0x7A5A5A5A5A5A5A5A
"""Of `t_ns` in encoded messages: eight bytes that are replaced by the time of sending."""


def contact(hand: str, link: str) -> wire.Contact:
    """Return an update of a contact whose values are all known."""
    return replace(
        make_contact(link, "update", 1, hand=hand), t_ns=_SENTINEL, begin_ns=1, duration_s=1.0,
        position_m=(0.01, 0.0, 0.01), normal=(0.0, 0.0, 1.0), pad_m=(0.01, 0.01), position_status="valid",
        covariance_m2=(1e-7, 0.0, 0.0, 0.0, 1e-7, 0.0, 0.0, 0.0, 0.0), residual=1.0, residual_std=0.1,
    )  # fmt: skip


def service(hands: Sequence[str]) -> wire.Service:
    """Return the state of a daemon, with the offset of the wall clock."""
    return make_service(
        t_ns=_SENTINEL,
        wall_offset_ns=time.time_ns() - time.monotonic_ns(),
        hands={hand: list(LINKS) for hand in hands},
        congestion_episodes={"complete": 0},
    )


def publish(endpoints: Sequence[str], touched: int, rate_hz: float, pipe: Connection) -> None:
    """Publish hands, one at each endpoint, until the pipe has a message; send the number of contacts."""
    stamp, context = _SENTINEL.to_bytes(8, "big"), zmq.Context()
    hands = [f"hand{number}" for number in range(len(endpoints))]
    publishers = [context.socket(zmq.XPUB) for _ in endpoints]
    messages = []
    for publisher, endpoint, hand in zip(publishers, endpoints, hands, strict=True):
        publisher.bind(endpoint)
        frame = make_frame(links=LINKS, hand=hand, t_ns=_SENTINEL)
        contacts = [wire.encode(contact(hand, link)) for link in LINKS[:touched]]
        encoded = [*contacts, wire.encode(frame)]
        messages.append([(topic, payload.partition(stamp)) for topic, payload in encoded])
    pipe.send("bound")
    while not pipe.poll():  # until the bridges have subscribed
        for publisher in publishers:
            while publisher.poll(0):
                publisher.recv()
        time.sleep(0.01)
    pipe.recv()
    ticks, begin_s, next_service_s = 0, time.monotonic(), 0.0
    while not pipe.poll():
        if (now_s := time.monotonic()) >= next_service_s:
            next_service_s = now_s + 1.0
            for publisher, hand in zip(publishers, hands, strict=True):
                topic, payload = wire.encode(service([hand]))
                publisher.send_multipart(
                    [topic, payload.replace(stamp, time.monotonic_ns().to_bytes(8, "big"))]
                )
        for publisher, parts in zip(publishers, messages, strict=True):
            now = time.monotonic_ns().to_bytes(8, "big")
            for topic, (head, _, tail) in parts:
                publisher.send_multipart([topic, head + now + tail])
        ticks += 1
        time.sleep(max(0.0, begin_s + ticks / rate_hz - time.monotonic()))
    pipe.send((ticks * touched * len(endpoints), time.monotonic() - begin_s))
    pipe.recv()
    context.destroy(linger=0)


def route(endpoint: str, pipe: Connection) -> None:
    """Be a Zenoh router until the pipe has a message."""
    import zenoh

    with zenoh.open(_zenoh_config("router", listen=[endpoint])):
        pipe.send("open")
        pipe.recv()


def subscribe_zenoh(endpoint: str, pipe: Connection) -> None:
    """Receive all contacts from the router; send their number, a sample of their latencies [s], and the
    number of hands that they are of."""
    import zenoh

    count, latencies, hands = 0, [], set()

    def receive(sample: zenoh.Sample) -> None:
        nonlocal count
        now_ns = time.monotonic_ns()
        count += 1
        hands.add(str(sample.key_expr).split("/", 2)[1])
        if count % 16 == 0:
            latencies.append(1e-9 * (now_ns - msgpack.unpackb(bytes(sample.payload))["t_ns"]))

    with zenoh.open(_zenoh_config("client", connect=[endpoint])) as session:
        session.declare_subscriber(f"{PREFIX}/*/contact/**", receive)
        _report_counts(pipe, lambda: (count, latencies, len(hands)))


def subscribe_ros(domain: int, pipe: Connection) -> None:
    """Receive the wrenches of all links; send their number, a sample of their latencies [s], and 1 if any."""
    from handtouch.bridge.ros2 import messages as ros
    from handtouch.bridge.ros2.network import Quality, RosNetwork

    network, stop = RosNetwork(domain, "handtouch"), threading.Event()
    topics = [f"hand0/{link}/wrench" for link in LINKS]
    readers = [network.reader(topic, ros.WrenchStamped, Quality.SENSOR_DATA) for topic in topics]
    count, latencies = 0, []

    def receive() -> None:
        nonlocal count
        while not stop.is_set():
            taken = [message for reader in readers for message in reader.take(100)]
            found = [message for message in taken if isinstance(message, ros.WrenchStamped)]
            now_ns = time.time_ns()
            for message in found:
                count += 1
                if count % 16 == 0:
                    stamp = message.header.stamp
                    latencies.append(1e-9 * (now_ns - stamp.nanosec) - stamp.sec)
            stop.wait(0.0005)

    thread = threading.Thread(target=receive)
    thread.start()
    _report_counts(pipe, lambda: (count, latencies, min(count, 1)))
    stop.set()
    thread.join()


def _report_counts(pipe: Connection, counts: Callable[[], Any]) -> None:
    """Answer each message of the pipe with the present counts, up to None."""
    pipe.send("open")
    while pipe.recv() is not None:
        pipe.send(counts())


def _zenoh_config(mode: str, **endpoints: Sequence[str]) -> Any:
    import zenoh

    made = zenoh.Config()
    made.insert_json5("mode", json.dumps(mode))
    made.insert_json5("scouting/multicast/enabled", "false")
    for key in ("listen", "connect"):
        made.insert_json5(f"{key}/endpoints", json.dumps(list(endpoints.get(key, ()))))
    return made


class Part:
    """A process of the benchmark, and the pipe to it."""

    def __init__(self, opened: ExitStack, run: Callable[..., None], *arguments: Any) -> None:
        self.pipe, other = multiprocessing.Pipe()
        spawn = multiprocessing.get_context("spawn")
        self._process = spawn.Process(target=run, args=(*arguments, other), daemon=True)
        self._process.start()
        opened.callback(self._process.join, 10)
        opened.callback(self._end)
        assert self.pipe.recv() in ("bound", "open")

    def _end(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self.pipe.send(None)

    @property
    def pid(self) -> int:
        """Its process."""
        assert self._process.pid is not None
        return self._process.pid


def start_bridge(opened: ExitStack, *arguments: str) -> int:
    """Start `handtouch bridge`; return its process."""
    command = [sys.executable, "-m", "handtouch", "bridge", *arguments]
    process = opened.enter_context(subprocess.Popen(command, stderr=subprocess.DEVNULL))
    opened.callback(process.terminate)
    return process.pid


def measure(
    publisher: Part,
    subscriber: Part,
    bridges: Sequence[int],
    router: Part | None,
    seconds: float,
    hands: int = 1,
) -> dict[str, Any]:
    """Publish for a time; return rates, losses, latencies, and processor time per contact of each process."""

    def count() -> tuple[int, list[float], int]:
        subscriber.pipe.send("count")
        found: tuple[int, list[float], int] = subscriber.pipe.recv()
        return found

    publisher.pipe.send("start")
    end_s = time.monotonic() + START_S
    while count()[2] < hands and time.monotonic() < end_s:
        time.sleep(0.2)
    if (relayed := count()[2]) < hands:
        raise RuntimeError(f"{relayed} of {hands} hands are received after {START_S:g} s")
    time.sleep(2.0)  # what waited until then has passed
    pids = {"publishers": [publisher.pid], "bridges": bridges, "subscriber": [subscriber.pid]}
    if router is not None:
        pids["router"] = [router.pid]
    before_s, (first, old, _), begin_s = (
        {name: processor_s(*ids) for name, ids in pids.items()},
        count(),
        time.monotonic(),
    )
    time.sleep(seconds)
    used_s = {name: processor_s(*ids) - before_s[name] for name, ids in pids.items()}
    (last, latencies, _), took_s = count(), time.monotonic() - begin_s
    publisher.pipe.send("stop")
    sent, sent_s = publisher.pipe.recv()
    received = last - first
    return {
        "sent per s": sent / sent_s,
        "received per s": received / took_s,
        "median ms": 1e3 * float(np.median(latencies[len(old) :])),
        "99 % ms": 1e3 * float(np.percentile(latencies[len(old) :], 99)),
        **{f"{name}, us": 1e6 * seconds_used / max(received, 1) for name, seconds_used in used_s.items()},
    }


def measure_ros(seconds: float, rate_hz: float) -> dict[str, Any]:
    """Measure the bridge to ROS 2 with 15 touched pads."""
    domain = 100 + os.getpid() % 100
    with ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="ht.")))
        endpoint = f"ipc://{folder}/complete"
        for path in shipped.path("utah_mit.toml").parent.iterdir():
            (folder / path.name).symlink_to(path)
        deployment = folder / "measured.toml"
        keys = f'[daemon]\ncomplete = "{endpoint}"\ninputs = "ipc://{folder}/inputs"\n'
        deployment.write_text(shipped.path("utah_mit.toml").read_text().replace("[daemon]\n", keys, 1))
        publisher = Part(opened, publish, [endpoint], len(LINKS), rate_hz)
        subscriber = Part(opened, subscribe_ros, domain)
        bridge = start_bridge(opened, "ros2", str(deployment), "--domain", str(domain))
        return {"pads": len(LINKS), "Hz": rate_hz, **measure(publisher, subscriber, [bridge], None, seconds)}


def measure_fleet(hands: int, touched: int, rate_hz: float, seconds: float) -> dict[str, Any]:
    """Measure hands that publish through a router, each with a bridge."""
    with ExitStack() as opened:
        folder = opened.enter_context(tempfile.TemporaryDirectory(prefix="ht."))
        endpoints = [f"ipc://{folder}/{number}" for number in range(hands)]
        with socket.create_server(("127.0.0.1", 0)) as free:
            address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        publisher = Part(opened, publish, endpoints, touched, rate_hz)
        router = Part(opened, route, address)
        subscriber = Part(opened, subscribe_zenoh, address)
        bridges = [
            start_bridge(
                opened,
                "zenoh",
                "--prefix",
                PREFIX,
                "--connect",
                address,
                "--endpoint",
                f"hand{number}={endpoint}",
            )
            for number, endpoint in enumerate(endpoints)
        ]
        return {"hands": hands, **measure(publisher, subscriber, bridges, router, seconds, hands)}


def main() -> None:
    """Measure and write the page."""
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, nargs="*", help="numbers of hands of the fleet")
    arguments = parser.parse_args()
    seconds = 3.0 if arguments.quick else 20.0
    fleet_hands = arguments.hands or ([1, 2] if arguments.quick else [1, 10, 50])
    report = Report(arguments.quick, seconds_of_a_case=seconds)
    report.table(
        "ROS 2", [measure_ros(seconds, hz) for hz in ((200.0,) if arguments.quick else (50.0, 200.0))]
    )
    fleet = [measure_fleet(hands, TOUCHED, FLEET_HZ, seconds) for hands in fleet_hands]
    report.table("Fleet over Zenoh", fleet)
    complete = [row for row in fleet if row["received per s"] > 0.98 * row["sent per s"]]
    kinds, each = ("bridges", "router", "subscriber"), TOUCHED * FLEET_HZ
    full = [
        {"by hands": row["hands"]} | {k: 1e6 / (row[f"{k}, us"] * each) for k in kinds} for row in complete
    ]
    report.table("Hands of a core, by fleets received completely", full)
    report.keep()


if __name__ == "__main__":
    main()
