"""Hostile clients: a daemon whose clients stall, flood and send garbage beside well-behaved ones.

A daemon without keys, its four endpoints over TCP on loopback, and a simulated hand of 15 pads at 200 Hz; 35
well-behaved subscribers to `hand/*` beside 15 hostile clients: 5 read nothing; 5 subscribe without pause, 3
of them to prefixes without topic, and connect again when they are disconnected; 3 request `status`,
`snapshot` and `tare` with 100 requests under way each; 2 connect and send random bytes to all endpoints, with
200 connections open each. Then the same subscribers beside processes that use as much processor time as each
hostile client did and don't connect. Hostile clients and burners run 10 nice levels below the others, as
`handtouch@.service` puts the daemon before ordinary processes. Latency is from SYNC to the message in the
subscriber. *Others*: processors used by what doesn't belong to the test: the two rows can be compared only
where these agree. A checker beside the other clients knows the scenario, and when the daemon died: nothing
may contradict it. No touched pad is shown as clear, nor the reverse, from 0.3 s after a change on; what isn't
sampled is unknown, also in sums; no frame is older than its limit; a dead daemon is known within 50 ms.
ARGS="--minutes 2" sets how long each of the two takes.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from benchmarks.client_checks import Truth, longest_age_s, watch_hand, watch_ros
from benchmarks.cycled_processes import scenario_text
from benchmarks.page import ROOT, Report, options, progress
from benchmarks.served_hand import PORT, descriptors, in_own_network, on_loopback, processor_s, resident_mb
from handtouch.client import connect, request
from handtouch.config import load

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


def run_hostile(kind: str, endpoints: Endpoints, seed: int, stop: Event) -> None:
    """Run a client of a kind."""
    os.nice(ORDINARY_NICE)
    HOSTILE[kind][1](endpoints, stop, seed)


def run_burner(share: float, stop: Event) -> None:
    """Use a share of one processor."""
    os.nice(ORDINARY_NICE)
    while not stop.is_set():
        begin_s = time.process_time()
        period_end_s = time.monotonic() + BURN_PERIOD_S
        while time.process_time() - begin_s < share * BURN_PERIOD_S:
            pass
        time.sleep(max(0.0, period_end_s - time.monotonic()))


WELL_BEHAVED = 35
READERS_PER_PROCESS = 7
JOINING_S, LEAVING_S = 5.0, 10.0
PATIENCE_S = 300.0  # of a request for `status`, on a machine with other load
SAMPLES_OF_MEMORY = 50
ORDINARY_NICE = 10
"""Nice levels of hostile clients and burners below the others, as `handtouch@.service` puts the daemon before
ordinary processes. Without them, a flood on the same processors takes what the scheduler gives to any busy
process, whatever the daemon does"""
MAX_RATIO = 1.1
MAX_GROWTH_MB = 5.0
"""Growth after a third of the time; until then the queues of stalled subscribers fill"""


def run_readers(endpoint: str, measure: Event, results: Any, stop: Event) -> None:
    """Run well-behaved subscribers in a process; put their latencies [s] and losses into a queue."""
    late_s: list[float] = []
    with ExitStack() as stack:
        readers = [
            stack.enter_context(connect("hand/*", endpoint=endpoint)) for _ in range(READERS_PER_PROCESS)
        ]
        lost_before: list[int] = []
        while not stop.is_set():
            if measure.is_set() and not lost_before:
                lost_before = [reader.lost_messages for reader in readers]
            waited = readers[0].recv(0.1)
            for reader in readers:
                message = waited if reader is readers[0] else reader.recv(0)
                now_ns = time.monotonic_ns()
                if message is not None and lost_before and not message.retained:
                    late_s.append((now_ns - message.t_ns) * 1e-9)
                while reader.recv(0) is not None:
                    pass  # what waited while this process did; its age isn't the daemon's
        lost = [reader.lost_messages for reader in readers]
    results.put((late_s, sum(lost) - sum(lost_before)))


@contextmanager
def running(targets: list[tuple[Callable[..., None], tuple[Any, ...]]]) -> Iterator[tuple[list[int], Event]]:
    """Run functions in processes, their last argument an event that stops them; yield ids and event."""
    stop = multiprocessing.Event()
    started = [multiprocessing.Process(target=call, args=(*given, stop)) for call, given in targets]
    for process in started:
        process.start()
    try:
        yield [process.pid or 0 for process in started], stop
    finally:
        stop.set()
        for process in started:
            process.join(5)
            process.kill()


def phase(
    endpoints: dict[str, str],
    own: list[int],
    seconds: float,
    others: list[tuple[Callable[..., None], tuple[Any, ...]]],
) -> dict[str, Any]:
    """Measure the daemon and well-behaved clients beside other processes; `own`: daemon and nodes."""
    pid = own[0]
    results: multiprocessing.Queue[tuple[list[float], int]] = multiprocessing.Queue()
    measure = multiprocessing.Event()
    count = WELL_BEHAVED // READERS_PER_PROCESS
    late_s: list[float] = []
    lost = 0
    readers = [(run_readers, (endpoints["live"], measure, results))] * count
    with running(readers) as (reader_pids, stop_readers), running(others) as (pids, _):
        time.sleep(JOINING_S)
        measure.set()
        before = request("status", endpoint=endpoints["control"], timeout_s=PATIENCE_S)["service"]
        used_s = [processor_s(other) for other in pids]
        memory_mb, begin_s = [], time.monotonic()
        busy_s = outside_seconds([*own, *reader_pids, *pids])
        while (passed_s := time.monotonic() - begin_s) < seconds:
            memory_mb.append(resident_mb(pid))
            if len(memory_mb) % (SAMPLES_OF_MEMORY // 5) == 1:
                progress(f"{passed_s:.0f} of {seconds:.0f} s, {memory_mb[-1]:.0f} MB")
            time.sleep(seconds / SAMPLES_OF_MEMORY)
        busy_s = outside_seconds([*own, *reader_pids, *pids]) - busy_s
        asked_s = time.monotonic()
        after = request("status", endpoint=endpoints["control"], timeout_s=PATIENCE_S)["service"]
        answered_s = time.monotonic() - asked_s
        took_s = (after["t_ns"] - before["t_ns"]) * 1e-9
        shares = [(processor_s(p) - used) / took_s for p, used in zip(pids, used_s, strict=True)]
        stop_readers.set()
        for _ in range(count):
            times, missed = results.get(timeout=60)
            late_s += times
            lost += missed
    rejected = {cause: n - before["rejected"].get(cause, 0) for cause, n in after["rejected"].items()}
    episodes = [sum(service["congestion_episodes"].values()) for service in (before, after)]
    return {
        "row": {
            "ticks/s": (after["ticks"] - before["ticks"]) / took_s,
            "overruns": after["overruns"] - before["overruns"],
            "p50, ms": 1e3 * float(np.percentile(late_s, 50)),
            "p99, ms": 1e3 * float(np.percentile(late_s, 99)),
            "messages": len(late_s),
            "lost": lost,
            "status, ms": 1e3 * answered_s,
            "congestion": episodes[1] - episodes[0],
            "MB": memory_mb[0],
            "after a third": memory_mb[len(memory_mb) // 3],
            "at the end": memory_mb[-1],
            "others": busy_s / seconds,
        },
        "rejected": {cause: n for cause, n in rejected.items() if n},
        "shares": shares,
    }


def outside_seconds(pids: list[int]) -> float:
    """Return the CPU time that all processes of the machine but these have used."""
    user, nice, system = map(int, Path("/proc/stat").read_text().split()[1:4])
    total_s = (user + nice + system) / os.sysconf("SC_CLK_TCK")
    return total_s - sum(processor_s(pid) for pid in [*pids, os.getpid()])


def over_tcp(config: Path) -> Path:
    """Give a deployment TCP endpoints on free ports."""
    text = config.read_text()
    with ExitStack() as stack:
        for name in ("live", "complete", "control", "inputs"):
            probe = stack.enter_context(socket.socket())
            probe.bind(("127.0.0.1", 0))
            old = getattr(load(config).daemon, name)
            text = text.replace(f'"{old}"', f'"tcp://127.0.0.1:{probe.getsockname()[1]}"')
    config.write_text(text)
    return config


def measure(config: Path, seconds: float) -> dict[str, Any]:
    """Run the daemon with simulated nodes, and both phases."""
    settings = load(config).daemon
    endpoints = {name: getattr(settings, name) for name in ("live", "complete", "control", "inputs")}
    deployment = load(config)
    scenario, started = config.with_name("scenario.toml"), config.with_name("started")
    scenario.write_text(scenario_text([pad.link for _, pad in deployment.pads], [], 0)[0])
    truth = Truth.of_process(scenario, started)
    command = [sys.executable, "-m"]
    played = [*command, "benchmarks.client_checks", str(config), str(scenario), str(started)]
    nodes = subprocess.Popen(played, cwd=ROOT)
    daemon = subprocess.Popen([*command, "handtouch", "run", str(config)], stderr=subprocess.DEVNULL)
    checked = ExitStack()
    try:
        with connect("hand/*", endpoint=endpoints["live"]) as hands:
            hands.recv()
        limit_s = longest_age_s(deployment)
        hand = checked.enter_context(watch_hand(endpoints["live"], endpoints["control"], truth, limit_s))
        ros = checked.enter_context(watch_ros(endpoints["complete"], truth))
        time.sleep(JOINING_S)
        kinds = [kind for kind, (count, _) in HOSTILE.items() for _ in range(count)]
        hostile = phase(
            endpoints,
            [daemon.pid, nodes.pid],
            seconds,
            [(run_hostile, (kind, endpoints, seed)) for seed, kind in enumerate(kinds)],
        )
        time.sleep(LEAVING_S)
        left = {"memory_mb": resident_mb(daemon.pid), "descriptors": descriptors(daemon.pid)}
        burners = [(run_burner, (share,)) for share in hostile["shares"]]
        control = phase(endpoints, [daemon.pid, nodes.pid], seconds, burners)
        found = [hand.finish(), ros.found]
    finally:
        checked.close()
        for process in (daemon, nodes):
            process.terminate()
            process.wait()
    used = {
        kind: sum(share for k, share in zip(kinds, hostile["shares"], strict=True) if k == kind)
        for kind in HOSTILE
    }
    return {
        "hostile": hostile,
        "control": control,
        "left": left,
        "used": used,
        "checked": [part.figures() for part in found],
        "contradictions": [text for part in found for text in part.texts],
    }


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    asked = parser.parse_args()
    in_own_network()
    report = Report(asked.quick, minutes=asked.minutes)
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        config = over_tcp(on_loopback(Path(folder), PORT + 2))
        results = measure(config, 15.0 if asked.quick else 60 * asked.minutes)
    hostile, control = results["hostile"]["row"], results["control"]["row"]
    report.table("Service", [{"beside": "15 hostile clients", **hostile}, {"beside": "burners", **control}])
    report.table("Processors of the hostile clients", [results["used"]])
    report.table("What clients showed", results["checked"])
    report.table("Contradictions of the truth", [{"what": text} for text in results["contradictions"]])
    report.table("Rejected", [results["hostile"]["rejected"]])
    report.table(f"{LEAVING_S:.0f} s after they left", [results["left"]])
    beside = "beside hostile clients / beside burners"
    rate, tail = (hostile[key] / control[key] for key in ("ticks/s", "p99, ms"))
    report.limit(f"tick rate, {beside}", rate, 1 / MAX_RATIO, at_least=True)
    report.limit(f"p99, {beside}", tail, MAX_RATIO)
    report.limit(
        "memory, last two thirds", hostile["at the end"] - hostile["after a third"], MAX_GROWTH_MB, "MB"
    )
    report.limit("contradictions of the truth", len(results["contradictions"]), 0)
    return int(not report.keep())


if __name__ == "__main__":
    sys.exit(main())
