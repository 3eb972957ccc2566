"""A fault campaign on a hand of 15 simulated nodes: is each fault told with its cause, and over when it ends?

The real daemon, a process of its own, serves nodes on a bus over loopback in a network namespace of its own
(or on SocketCAN with --interface). Faults of the kinds in fault_kinds.py begin at random times (Poisson,
seeded), several at once on different nodes, last a random while and are taken back. A client watches health,
service and contacts, and judges. Writes docs/benchmarks/faults.{md,json}; exit status 1 if anything was told
wrongly, did not recover, disturbed a node without a fault, lost a frame, leaked, or raised.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from pathlib import Path
from typing import Any

import can
import numpy as np
from bench_latency import CHANNEL, OUT, PORT, in_own_network, on_loopback
from fault_kinds import KINDS, TPDO, Bench, Fault, Kind, S, Stranger

from handtouch import connect, wire
from handtouch.canbus.device import DeviceBus
from handtouch.client import Subscriber
from handtouch.config import Deployment, load

PRESSED = ("thumb_distal", "index_distal", "palm_heel")
TOUCH = np.array([900, 700, 800, 600])
WELL = ("clear", "touched")
HOLD_NS = S // 3  # a node has to stay well for so long
GIVE_UP_S = 30.0
LEAK_KB_PER_MIN = 300.0


class Cable:
    """The nodes' bus: can be cut, counts the samples that went out, and notes the nodes' pauses."""

    def __init__(self, bus: can.BusABC, pause_ns: int) -> None:
        self.silent = False
        self.samples = 0
        self.pauses: list[tuple[int, int, int]] = []  # node id, from, to
        self._bus, self._pause_ns = bus, pause_ns
        self._last_ns: dict[int, int] = {}

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if self.silent:
            return
        self._bus.send(message, timeout)
        node_id = message.arbitration_id - TPDO
        if not 0 < node_id < 128:
            return
        self.samples += len(message.data) == 8
        now_ns = time.monotonic_ns()
        before_ns = self._last_ns.get(node_id, now_ns)
        self._last_ns[node_id] = now_ns
        if now_ns - before_ns > self._pause_ns:
            self.pauses.append((node_id, before_ns, now_ns))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = self._bus.recv(timeout)
        return None if self.silent else message

    def paused(self, node_id: int, t_ns: int) -> bool:
        """Whether the node sent nothing for several periods around this time."""
        return any(n == node_id and a <= t_ns <= b + S // 10 for n, a, b in self.pauses)


class Resources:
    """Memory, descriptors and threads of a process, once a second."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process, self._pid = process, process.pid
        self.rows: list[tuple[float, int, int, int]] = []

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def look(self, t_ns: int) -> None:
        if self.rows and t_ns * 1e-9 - self.rows[-1][0] < 1:
            return
        if not self.alive:
            raise RuntimeError("the daemon has ended")
        status = Path(f"/proc/{self._pid}/status").read_text()
        rss_kb, threads = (int(re.search(rf"{name}:\s+(\d+)", status)[1]) for name in ("VmRSS", "Threads"))  # type: ignore[index]
        self.rows.append((t_ns * 1e-9, rss_kb, len(os.listdir(f"/proc/{self._pid}/fd")), threads))

    def summary(self) -> dict[str, Any]:
        """The slope is that of the second half, if that is long enough: by then all has happened once."""
        rows = np.array(self.rows)
        late = rows[len(rows) // 2 :]
        slope = np.polyfit(late[:, 0], late[:, 1], 1)[0] * 60 if len(late) > 60 else 0.0
        return {
            "rss_mb": [round(float(v) / 1024, 1) for v in (rows[0, 1], late[0, 1], rows[-1, 1])],
            "rss_kb_per_min": round(float(slope), 1),
            "descriptors": [int(v) for v in (rows[0, 2], late[0, 2], rows[-1, 2], rows[:, 2].max())],
            "threads": [int(v) for v in (rows[0, 3], late[0, 3], rows[-1, 3], rows[:, 3].max())],
        }


class Campaign:
    """Causes faults and judges what is told of them."""

    def __init__(self, bench: Bench, messages: Subscriber[Any], links: dict[str, int], asked: Any) -> None:
        self.bench = bench
        self.done: list[Fault] = []
        self.surprises: list[dict[str, Any]] = []
        self.ghosts: list[str] = []
        self.quiet_samples = self.quiet_missed = 0
        self.health: dict[int, Any] = {}
        self.service: Any = None
        self._messages = messages
        self._links = links
        self._chance = random.Random(asked.seed)
        self._asked = asked
        self._coming: deque[Kind] = deque(self._chance.sample(KINDS, len(KINDS)))
        self._alone: list[Kind] = []
        self._active: list[Fault] = []
        self._busy: dict[int, Fault] = {}
        self._free_ns: dict[int, int] = {}
        self._started = 0
        self._next_ns = 0

    def wait_operational(self, resources: Resources, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while self.service is None or sum(map(is_well, self.health.values())) < len(self._links):
            if time.monotonic() > end_s or not resources.alive:
                told = {h.link: (h.state, h.node, h.reason) for h in self.health.values()}
                raise RuntimeError(f"the hand never became operational: {told}")
            self._take(self._messages.recv(0.1))

    def take_last_figures(self) -> None:
        """What `service` says once the nodes have fallen silent."""
        silent_ns = time.monotonic_ns() + S // 2
        while self.service.t_ns < silent_ns:
            message = self._messages.recv(0.1)
            if isinstance(message, wire.Service):
                self.service = message

    def run(self, resources: Resources, faults: int) -> None:
        """Until so many faults are over."""
        self._next_ns = time.monotonic_ns() + S
        while self._started < faults or self._active:
            message = self._messages.recv(0.001 if self.bench.stranger.busy else 0.005)
            while message is not None:
                self._take(message)
                message = self._messages.recv(0)
            now_ns = time.monotonic_ns()
            self.bench.stranger.pump(now_ns)
            resources.look(now_ns)
            if self._started < faults:
                self._start_due(now_ns)
            for fault in list(self._active):
                self._follow(fault, now_ns)

    # Beginning ---------------------------------------------------------------------------------------

    def _start_due(self, now_ns: int) -> None:
        if now_ns < self._next_ns:
            return
        if len(self._alone) >= 4 or (self._alone and self._active and self._active[0].kind.alone):
            if self._active:
                return  # everything else has to be over
            self._begin(self._alone.pop(), None, now_ns)
            while self._alone and not self._active:
                self._begin(self._alone.pop(), None, now_ns)
            return
        if not self._coming:
            self._coming.extend(self._chance.choices(KINDS, [kind.weight for kind in KINDS], k=100))
        kind = self._coming[0]
        if kind.alone:
            self._alone.append(self._coming.popleft())
            return
        if kind.bus_wide:
            if any(fault.kind is kind for fault in self._active):
                self._coming.rotate(-1)
                return
            self._begin(self._coming.popleft(), None, now_ns)
        else:
            free = [n for n in self._links.values() if self._may_begin(n, now_ns)]
            if not free:
                return
            self._begin(self._coming.popleft(), self._chance.choice(free), now_ns)
        self._next_ns = max(
            self._next_ns + int(self._chance.expovariate(self._asked.rate) * S), now_ns - S // 2
        )

    def _may_begin(self, node_id: int, now_ns: int) -> bool:
        health = self.health[node_id]
        rested = now_ns - self._free_ns.get(node_id, 0) > HOLD_NS
        return node_id not in self._busy and rested and is_well(health)

    def _begin(self, kind: Kind, node_id: int | None, now_ns: int) -> None:
        device = None if node_id is None else self.bench.devices.devices[node_id]
        nodes = tuple(self._links.values()) if kind.alone else () if node_id is None else (node_id,)
        lasts_ns = int(self._chance.uniform(*kind.lasts_s) * S)
        self._started += 1
        bus = next(iter(self.service.buses.values()))
        fault = Fault(
            kind, self._started, device, nodes, random.Random(self._started), now_ns, now_ns + lasts_ns,
            {n: self.health[n] for n in nodes}, bus, bus,
        )  # fmt: skip
        self._active.append(fault)
        self._busy |= dict.fromkeys(nodes, fault)
        kind.begin(fault, self.bench)

    # Watching ----------------------------------------------------------------------------------------

    def _take(self, message: Any) -> None:
        if isinstance(message, wire.Health):
            self._take_health(message)
        elif isinstance(message, wire.Service):
            self.service = message
            for fault in self._active:
                fault.bus_now = next(iter(message.buses.values()))
                if fault.kind.told_by_bus is not None and fault.kind.told_by_bus(fault):
                    fault.told_ns.setdefault(0, message.t_ns)
        elif isinstance(message, wire.Contact) and message.event == "begin":
            node_id = self._links[message.link]
            fault = self._busy.get(node_id)
            if message.link not in PRESSED and (fault is None or not may_touch(fault.kind)):
                self.ghosts.append(f"{message.link} {message.force_n} N, {fault.kind.name if fault else ''}")

    def _take_health(self, health: Any) -> None:
        node_id = health.node_id
        before, self.health[node_id] = self.health.get(node_id), health
        fault = self._busy.get(node_id)
        well = is_well(health)
        if fault is None:
            self._take_undisturbed(health, before, well)
            return
        if health.t_ns < fault.start_ns:
            return
        fault.history.append(
            f"{(health.t_ns - fault.start_ns) * 1e-9:.3f} s {health.link}: {health.state}, {health.node}, "
            f"{health.reason}"
        )
        if fault.kind.told is not None and fault.kind.told(fault, health):
            fault.told_ns.setdefault(node_id, health.t_ns)
        if (fault.kind.quiet and not well) or (fault.kind.loose and health.node != "operational"):
            fault.disturbed_ns.append(health.t_ns)
        if not well:
            fault.well_ns.pop(node_id, None)
        elif fault.ended_ns and health.t_ns > fault.ended_ns and self._is_told(fault, node_id):
            fault.well_ns.setdefault(node_id, health.t_ns)

    def _take_undisturbed(self, health: Any, before: Any, well: bool) -> None:
        free_ns = self._free_ns.get(health.node_id, 0)
        if not well and self._started:
            self.surprises.append(
                {"t_ns": health.t_ns, "node_id": health.node_id, "link": health.link, "state": health.state,
                 "node": health.node, "reason": health.reason,
                 "meanwhile": [fault.kind.name for fault in self._active]}
            )  # fmt: skip
        if before is not None and before.t_ns > free_ns:
            self.quiet_samples += health.samples - before.samples
            self.quiet_missed += health.missed - before.missed

    # Judging -----------------------------------------------------------------------------------------

    def _is_told(self, fault: Fault, node_id: int) -> bool:
        return fault.kind.told is None or node_id in fault.told_ns

    def _follow(self, fault: Fault, now_ns: int) -> None:
        kind, patience = fault.kind, self._asked.patience
        if not fault.ended_ns:
            if now_ns < fault.end_ns:
                return
            kind.end(fault, self.bench)
            fault.ended_ns = now_ns if kind.lasts_s[1] else fault.start_ns
        wanted = set(fault.nodes) if kind.told else {0} if kind.told_by_bus else set()
        told = wanted <= set(fault.told_ns)
        if not told and now_ns - fault.start_ns > (kind.within_s * patience) * S and fault.ended_ns:
            _once(fault, "not told")
        passed_s = (now_ns - fault.ended_ns) * 1e-9
        if kind.quiet or kind.loose or not fault.nodes:
            over = passed_s > 0.5 and (told or "not told" in fault.failures)
        else:
            over = set(fault.nodes) == set(fault.well_ns)
            over = over and now_ns - max(fault.well_ns.values(), default=0) > HOLD_NS
            if not over and passed_s > max(kind.well_s, kind.within_s) * patience:
                _once(fault, "not recovered in time")
            if passed_s > GIVE_UP_S:
                _once(fault, "never recovered")
                over = True
        if over:
            self._finish(fault, now_ns)

    def _finish(self, fault: Fault, now_ns: int) -> None:
        self._active.remove(fault)
        self.done.append(fault)
        for node_id in fault.nodes:
            del self._busy[node_id]
            self._free_ns[node_id] = now_ns
        for t_ns in fault.disturbed_ns:
            _once(fault, "paused" if self.bench.cable.paused(fault.nodes[0], t_ns) else "disturbed")
        if set(fault.failures) - {"paused"}:
            what = f"fault {fault.number}, {fault.kind.name}: {fault.failures}"
            print(what, *fault.history[:40], sep="\n  ", flush=True)
        if len(self.done) % 50 == 0:
            print(f"{len(self.done)} faults", flush=True)


def is_well(health: Any) -> bool:
    """Operational, its samples trusted."""
    return health.state in WELL and health.node == "operational"


def may_touch(kind: Kind) -> bool:
    """Whether a pad may look touched because of it."""
    return kind.loose or any(word in kind.name for word in ("corrupt", "saturated"))


def _once(fault: Fault, failure: str) -> None:
    if failure not in fault.failures:
        fault.failures.append(failure)


# Results ---------------------------------------------------------------------------------------------


def by_kind(done: list[Fault]) -> list[dict[str, Any]]:
    rows = []
    for kind in KINDS:
        faults = [fault for fault in done if fault.kind is kind]
        if not faults:
            continue
        detect = [(max(f.told_ns.values()) - f.start_ns) * 1e-9 for f in faults if f.told_ns]
        recover = [(max(f.well_ns.values()) - f.ended_ns) * 1e-9 for f in faults if f.well_ns]
        asked = kind.told is not None or kind.told_by_bus is not None
        failures = Counter(failure for f in faults for failure in set(f.failures))
        rows.append(
            {
                "kind": kind.name,
                "expected": kind.expected,
                "number": len(faults),
                "told": len(faults) - failures["not told"] if asked else None,
                "detect_s": spread(detect) if asked else None,
                "recover_s": None if kind.quiet or kind.loose else spread(recover),
                "failures": dict(failures),
            }
        )
    return rows


def spread(values: list[float]) -> dict[str, float] | None:
    """Median, 90 % and worst."""
    if not values:
        return None
    median, p90, worst = np.percentile(values, [50, 90, 100]).tolist()
    return {"median": round(median, 3), "p90": round(p90, 3), "worst": round(worst, 3)}


def verdict(results: dict[str, Any]) -> list[str]:
    """What is wrong; empty when all is as it should be."""
    wrong = [
        f"{row['kind']}: {number} {failure}"
        for row in results["kinds"]
        for failure, number in row["failures"].items()
        if failure != "paused"
    ]
    told = Counter(f"{s['state']}, {s['reason']}" for s in results["surprises"])
    wrong += [f"without a fault, {number} times: {what}" for what, number in told.items()]
    wrong += [f"contact out of nothing: {ghost}" for ghost in results["ghosts"]]
    wrong += [f"exception: {line}" for line in results["exceptions"]]
    if results["samples_lost"]:
        wrong.append(f"{results['samples_lost']} samples lost on the way")
    used = results["resources"]
    if used["rss_kb_per_min"] > LEAK_KB_PER_MIN:
        wrong.append(f"memory grows by {used['rss_kb_per_min']} kB a minute")
    if used["descriptors"][2] > used["descriptors"][1]:
        wrong.append(f"descriptors grow: {used['descriptors']}")
    if results["exit_status"]:
        wrong.append(f"exit status {results['exit_status']}")
    return wrong


def page(every: dict[str, dict[str, Any]]) -> str:
    parts = [
        "# Fault campaign\n\nFaults of simulated nodes and of their bus at random times (Poisson, seeded), "
        "several at once on different nodes;\neach lasts a random while and is taken back. The daemon is a "
        "process of its own; a client on its stream judges by\nwhat `health` and `service` say. Times are "
        "those of the messages, after the fault began and after it was taken\nback; figures that "
        "are published once a second (`missed`, `emergencies`) or twice (`service`) are told no sooner. "
        "A node is well\nagain when it is operational and its samples are trusted.\n\nBeside every fault: no "
        "node without one changes its state, no pad that nothing touches shows a contact.\n\n"
        "Made by `make stress ONLY=faults`; on SocketCAN by `tests/socketcan/vcan-run .venv/bin/python\n"
        "benchmarks/stress_faults.py --interface socketcan --faults 60 --rate 1 --period-ms 20 "
        "--patience 3`.\n"
    ]
    parts += [section(results) for results in every.values()]
    return "\n".join(parts)


def section(results: dict[str, Any]) -> str:
    rows = "\n".join(
        f"| {row['kind']} | {row['expected']} | {row['number']} | {share(row)} | {times(row['detect_s'])} "
        f"| {times(row['recover_s'])} |"
        for row in results["kinds"]
    )
    used, wrong = results["resources"], verdict(results)
    undisturbed = results["undisturbed"]

    def series(name: str) -> str:
        return ", ".join(map(str, used[name]))

    return f"""
## {results["interface"]}

{results["faults"]} faults in {results["seconds"]:.0f} s, {results["rate"]:g} a second, seed
{results["seed"]}, limits times {results["patience"]:g}; 15 nodes at {1000 / results["period_ms"]:.0f} Hz.
{results["machine"]}; load {results["load"]:.1f} at the end.

Seconds: median, 90 %, worst.

| fault | to be told | number | told | until told | until well |
| --- | --- | --- | --- | --- | --- |
{rows}

A dash: nothing of the kind is asked for. Stuck channels and dead electrodes are for the supervisor of pads to
name; here it is only asked that the node stays operational and the others undisturbed.

| | |
| --- | --- |
| told wrongly, not recovered, or disturbed | {"; ".join(wrong) or "nothing"} |
| samples sent by the nodes and lost on the way | {results["samples_lost"]} of {results["samples_sent"]} |
| nodes without a fault: ticks without their sample | {undisturbed["missed"]} of {undisturbed["samples"]} |
| of nodes without a fault, told because their process or SYNC paused | {results["excused"]} |
| ticks overrun | {results["overruns"]} of {results["ticks"]} |
| memory of the daemon, MB: start, half, end | {series("rss_mb")} |
| its slope in the second half, kB a minute | {used["rss_kb_per_min"]:+.0f} |
| file descriptors: start, half, end, most | {series("descriptors")} |
| threads: start, half, end, most | {series("threads")} |
| exceptions on stderr | {len(results["exceptions"])} |
| exit status | {results["exit_status"]} |
"""


def share(row: dict[str, Any]) -> str:
    return "-" if row["told"] is None else f"{100 * row['told'] / row['number']:.0f} %"


def times(values: dict[str, float] | None) -> str:
    return "-" if values is None else f"{values['median']:.2f}, {values['p90']:.2f}, {values['worst']:.2f}"


def open_bus(interface: str) -> can.BusABC:
    if interface == "socketcan":
        return can.Bus("vcan0", interface="socketcan", ignore_config=True)
    return can.Bus(CHANNEL, interface="udp_multicast", port=PORT, ignore_config=True)


def sampler(deployment: Deployment, seed: int) -> Any:
    """Counts of all pads: noise, and a steady touch on those that are pressed."""
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    noise = np.random.default_rng(seed)
    pressed = np.array([TOUCH if pad.link in PRESSED else 0 * TOUCH for pad in pads])
    return lambda _: pressed + np.rint(noise.standard_normal((len(pads), 4))).astype(np.int64)


def measure(folder: Path, asked: Any) -> dict[str, Any]:
    config = on_loopback(folder, PORT)
    config.write_text(
        re.sub(r"sync_period_ms = [\d.]+", f"sync_period_ms = {asked.period_ms}", config.read_text())
    )
    deployment = load(config)
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    raised: list[str] = []
    threading.excepthook = lambda args: raised.append(f"{args.exc_type.__name__}: {args.exc_value}")
    buses = [open_bus(asked.interface), open_bus(asked.interface)]
    cable = Cable(buses[0], round(3 * asked.period_ms * 1e6))
    devices = DeviceBus(cable, sampler(deployment, asked.seed))  # type: ignore[arg-type]  # it quacks like one
    for pad in pads:
        devices.add(pad.node_id, serial=pad.serial)
    stranger = Stranger(buses[1])
    command = [sys.executable, "-m", "handtouch", "run", str(config)]
    if asked.interface == "socketcan":
        command += ["--bus", "can0=socketcan:vcan0"]
    stderr = folder / "daemon.txt"
    sys.setswitchinterval(0.0005)  # or reading an EDS for a twin holds up the other nodes
    devices.start()
    with stderr.open("w") as output:
        daemon = subprocess.Popen(command, stdout=output, stderr=output)
    resources = Resources(daemon)
    patterns = ("health/*/*", "service", "contact/*/*")
    try:
        with connect(*patterns, endpoint=deployment.daemon.complete, queue=100_000) as messages:
            campaign = Campaign(
                Bench(devices, stranger, round(asked.period_ms * 1e6), cable),
                messages,
                {p.link: p.node_id for p in pads},
                asked,
            )
            campaign.wait_operational(resources, 60 * asked.patience)
            before, start_s = campaign.service, time.monotonic()
            campaign.run(resources, asked.faults)
            seconds = time.monotonic() - start_s
            campaign.wait_operational(resources, 20 * asked.patience)
            devices.stop()
            campaign.take_last_figures()
    finally:
        daemon.send_signal(signal.SIGTERM)
        status = daemon.wait(30)
        if sys.exc_info()[0] is not None:
            print(stderr.read_text()[-3000:])
        for bus in buses:
            bus.shutdown()
    text = stderr.read_text()
    if asked.keep:
        (asked.out / "faults.txt").write_text(text)
    bus = next(iter(campaign.service.buses.values()))
    excused = [s for s in campaign.surprises if cable.paused(s["node_id"], s["t_ns"])]
    return {
        "interface": asked.interface,
        "seed": asked.seed,
        "rate": asked.rate,
        "period_ms": asked.period_ms,
        "patience": asked.patience,
        "machine": f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}",
        "load": os.getloadavg()[0],
        "faults": len(campaign.done),
        "seconds": seconds,
        "kinds": by_kind(campaign.done),
        "surprises": [s for s in campaign.surprises if s not in excused],
        "excused": len(excused) + sum("paused" in f.failures for f in campaign.done),
        "ghosts": campaign.ghosts,
        "samples_sent": cable.samples,
        "samples_lost": cable.samples - bus["samples"],
        "overflow": bus["overflow"],
        "undisturbed": {"samples": campaign.quiet_samples, "missed": campaign.quiet_missed},
        "overruns": campaign.service.overruns - before.overruns,
        "ticks": campaign.service.ticks - before.ticks,
        "resources": resources.summary(),
        "exceptions": raised + re.findall(r"Traceback.*|.*unexpected \w+Error.*|.*Exception ignored.*", text),
        "exit_status": status,
        "bus_errors_of_nodes": devices.bus_errors,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=3.0, help="faults a second")
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--period-ms", type=float, default=10.0)
    parser.add_argument("--interface", choices=("udp_multicast", "socketcan"), default="udp_multicast")
    parser.add_argument("--patience", type=float, default=1.0, help="times the limits that hold on a robot")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for faults.md and faults.json")
    parser.add_argument("--keep", action="store_true", help="the daemon's log too, as faults.txt")
    asked = parser.parse_args()
    if asked.interface == "udp_multicast":
        in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        results = measure(Path(folder), asked)
    asked.out.mkdir(parents=True, exist_ok=True)
    kept = asked.out / "faults.json"
    every = json.loads(kept.read_text()) if kept.exists() else {}
    every[asked.interface] = results
    kept.write_text(json.dumps(every, indent=1) + "\n")
    (asked.out / "faults.md").write_text(page(every))
    print(section(results))
    return 1 if verdict(results) else 0


if __name__ == "__main__":
    sys.exit(main())
