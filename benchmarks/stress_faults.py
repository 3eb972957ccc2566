"""Fault campaign on a hand of 15 simulated nodes: is each fault reported with its cause until it ends?

The real daemon, in its own process, serves nodes on a bus over loopback in a separate network namespace, or
on SocketCAN. Faults of nodes and of their bus begin at random times (Poisson, seeded), several at once on
different nodes, last a random time and are removed. A client checks health, service and contacts: during
every fault no node without one changes its state, and no untouched pad reports a contact. Times are those of
the messages, after the fault began and after it was removed; counters that are published once a second
(`missed_samples`) or twice (`service`) are reported no sooner. A node has recovered when it is operational
and its samples are valid. A dash: not required. Stuck channels and dead electrodes are diagnosed by the
supervisor; here the node only has to stay operational and the others undisturbed. A busy machine pauses nodes
and daemon: reports while a fault-free node sent nothing are counted separately, as void. Exit status 1 if
anything was reported wrongly, did not recover, disturbed a node without a fault, lost a frame, leaked, or
raised. On SocketCAN by `tests/socketcan/vcan-run` with `--interface socketcan --faults 60 --rate 1
--period-ms 20 --patience 3`.
"""

from __future__ import annotations

import json
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
from typing import Any, cast

import can
import numpy as np

from benchmarks.fault_kinds import (
    KINDS,
    PRESSED,
    Bench,
    Cable,
    Fault,
    Kind,
    Resources,
    S,
    UnknownDevice,
    open_bus,
    sampler,
)
from benchmarks.page import Report, options
from benchmarks.served_hand import PORT, in_own_network, on_loopback
from handtouch import connect, wire
from handtouch.client import Subscriber
from handtouch.config import load
from handtouch.device import DeviceBus

LEAK_KB_PER_MIN = 300.0


def by_kind(done: list[Fault]) -> list[dict[str, Any]]:
    rows = []
    for kind in KINDS:
        faults = [fault for fault in done if fault.kind is kind and fault.failures != ["paused"]]
        if not faults:
            continue
        detect = [(max(f.reported_ns.values()) - f.start_ns) * 1e-9 for f in faults if f.reported_ns]
        recover = [(max(f.well_ns.values()) - f.ended_ns) * 1e-9 for f in faults if f.well_ns]
        required = kind.reported is not None or kind.reported_by_bus is not None
        failures = Counter(failure for f in faults for failure in set(f.failures))
        rows.append(
            {
                "kind": kind.name,
                "expected": kind.expected,
                "number": len(faults),
                "reported": len(faults) - failures["not reported"] if required else None,
                "detect_s": spread(detect) if required else None,
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
    """Return the failures; empty if there are none."""
    wrong = [
        f"{row['kind']}: {number} {failure}"
        for row in results["kinds"]
        for failure, number in row["failures"].items()
    ]
    unexpected = Counter(f"{s['state']}, {s['reason']}" for s in results["surprises"])
    wrong += [f"without a fault, {number} times: {what}" for what, number in unexpected.items()]
    wrong += [f"contact without a touch: {ghost}" for ghost in results["ghosts"]]
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


def rows_of(kinds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of the table of kinds, in seconds: median, 90 %, worst."""
    return [
        {
            "fault": row["kind"],
            "expected report": row["expected"],
            "number": row["number"],
            "reported, %": None if row["reported"] is None else 100 * row["reported"] / row["number"],
            "until reported": row["detect_s"] and list(row["detect_s"].values()),
            "until recovered": row["recover_s"] and list(row["recover_s"].values()),
        }
        for row in kinds
    ]


def campaign_row(results: dict[str, Any]) -> dict[str, Any]:
    """Return what the whole campaign took and left."""
    used = results["resources"]
    return {
        "faults": results["faults"],
        "s": results["seconds"],
        "samples sent": results["samples_sent"],
        "lost on the way": results["samples_lost"],
        "nodes without a fault: ticks without their sample": results["undisturbed"]["missed"],
        "of": results["undisturbed"]["samples"],
        "void: faults, states": [results["void"], results["excused"]],
        "ticks": results["ticks"],
        "overrun": results["overruns"],
        "memory of the daemon, MB: start, half, end": used["rss_mb"],
        "growth in the second half, kB a minute": used["rss_kb_per_min"],
        "descriptors: start, half, end, most": used["descriptors"],
        "threads: start, half, end, most": used["threads"],
        "exceptions": len(results["exceptions"]),
        "exit status": results["exit_status"],
    }


WELL = ("clear", "touched")
HOLD_NS = S // 3  # a node has to stay well for so long
GIVE_UP_S = 30.0
STABLE_S = 5.5  # an unstable node is stable after 5 s of operation; until then a reboot may be its boot loop
REPAIR_MEMORY_S = 60.0  # three repairs, each within this time of the one before, are the last
ALONE_AT_ONCE = 4


class Campaign:
    """Causes faults and checks their reports."""

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
        self._alone: list[Kind] = []  # waiting for all other faults to end
        self._draining = False
        self._active: list[Fault] = []
        self._busy: dict[int, Fault] = {}
        self._free_ns: dict[int, int] = {}
        self._repaired_ns: dict[int, int] = {}
        self._started = 0
        self._next_ns = 0

    def wait_operational(self, resources: Resources, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while self.service is None or sum(map(is_well, self.health.values())) < len(self._links):
            if time.monotonic() > end_s or not resources.alive:
                states = {h.link: (h.state, h.node_state, h.reason) for h in self.health.values()}
                raise RuntimeError(f"the hand never became operational: {states}")
            self._take(self._messages.recv(0.1))

    def take_last_figures(self) -> None:
        """Receive the `service` messages after the nodes have stopped."""
        silent_ns = time.monotonic_ns() + S // 2
        while self.service.t_ns < silent_ns:
            message = self._messages.recv(0.1)
            if isinstance(message, wire.Service):
                self.service = message

    def run(self, resources: Resources, faults: int) -> None:
        """Run until this many faults have ended."""
        self._next_ns = time.monotonic_ns() + S
        while self._started < faults or self._active:
            message = self._messages.recv(0.001 if self.bench.unknown_device.busy else 0.005)
            while message is not None:
                self._take(message)
                message = self._messages.recv(0)
            now_ns = time.monotonic_ns()
            self.bench.unknown_device.pump(now_ns)
            resources.look(now_ns)
            if self._started < faults:
                self._start_due(now_ns)
            for fault in list(self._active):
                self._follow(fault, now_ns)

    # Beginning ---------------------------------------------------------------------------------------

    def _start_due(self, now_ns: int) -> None:
        if now_ns < self._next_ns:
            return
        if self._draining or len(self._alone) >= ALONE_AT_ONCE:
            self._draining = bool(self._alone)
            ready = not self._active and all(self._may_begin(n, now_ns) for n in self._links.values())
            if self._alone and ready:  # everything else is over
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
            if kind.repaired:
                since_ns = now_ns - int(REPAIR_MEMORY_S * S)
                free = [n for n in free if self._repaired_ns.get(n, 0) < since_ns]
            if not free:
                if kind.repaired:
                    self._coming.rotate(-1)
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
                if fault.kind.reported_by_bus is not None and fault.kind.reported_by_bus(fault):
                    fault.reported_ns.setdefault(0, message.t_ns)
        elif isinstance(message, wire.Contact) and message.event == "begin":
            node_id = self._links[message.link]
            cause = self._busy.get(node_id)
            if message.link not in PRESSED and (cause is None or not may_touch(cause.kind)):
                self.ghosts.append(f"{message.link} {message.force_n} N, {cause.kind.name if cause else ''}")

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
            f"{(health.t_ns - fault.start_ns) * 1e-9:.3f} s {health.link}: {health.state}, "
            f"{health.node_state}, {health.reason}"
        )
        if fault.kind.reported is not None and fault.kind.reported(fault, health):
            fault.reported_ns.setdefault(node_id, health.t_ns)
        if (fault.kind.quiet and not well) or (fault.kind.loose and health.node_state != "operational"):
            fault.disturbed_ns.append(health.t_ns)
        if not well:
            fault.well_ns.pop(node_id, None)
        elif fault.ended_ns and health.t_ns > fault.ended_ns and self._is_reported(fault, node_id):
            fault.well_ns.setdefault(node_id, health.t_ns)

    def _take_undisturbed(self, health: Any, before: Any, well: bool) -> None:
        free_ns = self._free_ns.get(health.node_id, 0)
        if not well and self._started:
            self.surprises.append(
                {"t_ns": health.t_ns, "node_id": health.node_id, "link": health.link, "state": health.state,
                 "node": health.node_state, "reason": health.reason,
                 "meanwhile": [fault.kind.name for fault in self._active]}
            )  # fmt: skip
        if before is not None and before.t_ns > free_ns:
            self.quiet_samples += health.samples - before.samples
            self.quiet_missed += health.missed_samples - before.missed_samples

    # Checking ----------------------------------------------------------------------------------------

    def _is_reported(self, fault: Fault, node_id: int) -> bool:
        return fault.kind.reported is None or node_id in fault.reported_ns

    def _follow(self, fault: Fault, now_ns: int) -> None:
        kind, patience = fault.kind, self._asked.patience
        if not fault.ended_ns:
            waits = kind.has_acted is not None and not kind.has_acted(fault)
            if now_ns < fault.end_ns + (GIVE_UP_S * S if waits else 0):
                return
            kind.end(fault, self.bench)
            fault.ended_ns = now_ns if kind.lasts_s[1] else fault.start_ns
        expected = set(fault.nodes) if kind.reported else {0} if kind.reported_by_bus else set()
        reported = expected <= set(fault.reported_ns)
        since_ns = fault.ended_ns if kind.has_acted else fault.start_ns
        if not reported and now_ns - since_ns > (kind.within_s * patience) * S:
            _once(fault, "not reported")
        passed_s = (now_ns - fault.ended_ns) * 1e-9
        if kind.quiet or kind.loose or not fault.nodes:
            ended = passed_s > 0.5 and (reported or "not reported" in fault.failures)
        else:
            ended = set(fault.nodes) == set(fault.well_ns)
            ended = ended and now_ns - max(fault.well_ns.values(), default=0) > HOLD_NS
            if not ended and passed_s > max(kind.well_s, kind.within_s) * patience:
                _once(fault, "not recovered in time")
            if passed_s > GIVE_UP_S:
                _once(fault, "never recovered")
                ended = True
        if ended:
            self._finish(fault, now_ns)

    def _finish(self, fault: Fault, now_ns: int) -> None:
        self._active.remove(fault)
        self.done.append(fault)
        for node_id in fault.nodes:
            del self._busy[node_id]
            rebooted = self.health[node_id].reboots > fault.health[node_id].reboots
            rest_s = STABLE_S if rebooted or fault.kind.unstable else 0.0
            self._free_ns[node_id] = now_ns + int(rest_s * S)
            if fault.kind.repaired:
                self._repaired_ns[node_id] = now_ns
        for t_ns in fault.disturbed_ns:
            paused = self.bench.cable.paused(fault.nodes[0], t_ns, fault.kind.lag)
            _once(fault, "paused" if paused else "disturbed")
        if "paused" in fault.failures:
            fault.failures = ["paused"]  # void
        if fault.failures and fault.failures != ["paused"]:
            what = f"fault {fault.number}, {fault.kind.name}: {fault.failures}"
            print(what, *fault.history[:40], sep="\n  ", flush=True)
        if len(self.done) % 50 == 0:
            print(f"{len(self.done)} faults", flush=True)


def is_well(health: Any) -> bool:
    """Return True if the node is operational and its samples are valid."""
    return health.state in WELL and health.node_state == "operational"


def may_touch(kind: Kind) -> bool:
    """Return True if the fault may look like a touch."""
    return kind.loose or any(name in kind.name for name in ("corrupt", "saturated"))


def _once(fault: Fault, failure: str) -> None:
    if failure not in fault.failures:
        fault.failures.append(failure)


def measure(folder: Path, asked: Any) -> dict[str, Any]:
    config = on_loopback(folder, PORT)
    config.write_text(
        re.sub(
            r"sync_period_ms = [\d.]+",
            # a replaced node is a fault here
            f'sync_period_ms = {asked.period_ms}\non_node_replaced = "refuse"',
            config.read_text(),
        )
    )
    deployment = load(config)
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    raised: list[str] = []
    threading.excepthook = lambda args: raised.append(f"{args.exc_type.__name__}: {args.exc_value}")
    buses = [open_bus(asked.interface), open_bus(asked.interface)]
    cable = Cable(buses[0], round(asked.period_ms * 1e6))
    devices = DeviceBus(cast(can.BusABC, cable), sampler(deployment, asked.seed))
    for pad in pads:
        devices.add(pad.node_id, serial=pad.serial)
    unknown_device = UnknownDevice(buses[1])
    command = [sys.executable, "-m", "handtouch", "run", str(config)]
    if asked.interface == "socketcan":
        command += ["--bus", "can0=socketcan:vcan0"]
    stderr = folder / "daemon.txt"
    sys.setswitchinterval(0.0005)  # reading an EDS for a twin would block the other nodes
    devices.start()
    with stderr.open("w") as output:
        daemon = subprocess.Popen(command, stdout=output, stderr=output)
    resources = Resources(daemon)
    patterns = ("health/*/*", "service", "contact/*/*")
    try:
        with connect(*patterns, endpoint=deployment.daemon.complete, queue=100_000) as messages:
            campaign = Campaign(
                Bench(devices, unknown_device, round(asked.period_ms * 1e6), cable),
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
    if asked.keep is not None:
        (asked.keep / "faults.txt").write_text(text)
    bus = next(iter(campaign.service.buses.values()))
    excused = [s for s in campaign.surprises if cable.paused(s["node_id"], s["t_ns"])]
    return {
        "faults": len([f for f in campaign.done if f.failures != ["paused"]]),
        "seconds": seconds,
        "kinds": by_kind(campaign.done),
        "surprises": [s for s in campaign.surprises if s not in excused],
        "excused": len(excused),
        "void": sum("paused" in f.failures for f in campaign.done),
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
    parser = options(__doc__)
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=3.0, help="faults a second")
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--period-ms", type=float, default=10.0)
    parser.add_argument("--interface", choices=("udp_multicast", "socketcan"), default="udp_multicast")
    parser.add_argument("--patience", type=float, default=1.0, help="factor on the time limits of a robot")
    parser.add_argument(
        "--keep", type=Path, help="folder for what was found, as faults.json, and the daemon's log"
    )
    asked = parser.parse_args()
    if asked.quick:
        asked.faults = 20
    if asked.interface == "udp_multicast":
        in_own_network()
    settings = {key: getattr(asked, key) for key in ("rate", "seed", "period_ms", "patience")}
    report = Report(asked.quick or asked.keep is not None, asked.interface, **settings)
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        results = measure(Path(folder), asked)
    if asked.keep is not None:
        (asked.keep / "faults.json").write_text(json.dumps(results, indent=1) + "\n")
    report.table("Faults", rows_of(results["kinds"]))
    report.table("Campaign", [campaign_row(results)])
    wrong = verdict(results)
    report.table("Wrong report, no recovery, or disturbance", [{"what": line} for line in wrong])
    report.limit("of them", len(wrong), 0)
    return int(not report.keep())


if __name__ == "__main__":
    sys.exit(main())
