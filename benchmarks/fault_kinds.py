"""The kinds of faults of the campaign in stress_faults.py.

How each is caused on a node or on the bus, how it is removed, and the expected report of each. Public names:
`KINDS` -> `Kind`, `Fault`.
"""

from __future__ import annotations

import contextlib
import os
import random
import re
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
import numpy as np

from benchmarks.served_hand import CHANNEL, PORT
from handtouch.config import Deployment
from handtouch.device import Device, DeviceBus, LineFaults

S = 1_000_000_000
TPDO = 0x280
PRESSED = ("thumb_distal", "index_distal", "palm_heel")
TOUCH = np.array([900, 700, 800, 600])
LONG_NS = 250_000_000  # a pause that may cost a node its heartbeats


class Cable:
    """The nodes' bus: can be cut, counts the samples that went out, and notes the nodes' pauses."""

    def __init__(self, bus: can.BusABC, period_ns: int) -> None:
        self.silent = False
        self.samples = 0
        self.pauses: list[tuple[int, int, int]] = []  # node id, from, to
        self._bus, self._period_ns = bus, period_ns
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
        if now_ns - before_ns > 1.5 * self._period_ns:
            self.pauses.append((node_id, before_ns, now_ns))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = self._bus.recv(timeout)
        return None if self.silent else message

    def paused(self, node_id: int, t_ns: int, lag: float = 0.0) -> bool:
        """Return True if the node's program or SYNC paused at this time, for two periods less `lag`.

        A pad is stale after three, counted from the SYNC of its newest sample, not from its sending. After a
        long pause the node has to be restarted.
        """
        least_ns = (2 - lag) * self._period_ns
        return any(
            node == node_id
            and end - start > least_ns
            and start <= t_ns <= end + (S if end - start > LONG_NS else S // 10)
            for node, start, end in self.pauses
        )


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


class UnknownDevice:
    """Another device on the bus; `pump` sends what is due."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._jobs: dict[int, tuple[Callable[[], can.Message], int, int]] = {}  # fault -> next, period, due

    def start(self, key: int, frame: Callable[[], can.Message], rate_hz: float) -> None:
        self._jobs[key] = (frame, int(S / rate_hz), time.monotonic_ns())

    def stop(self, key: int) -> None:
        self._jobs.pop(key, None)

    @property
    def busy(self) -> bool:
        return bool(self._jobs)

    def pump(self, t_ns: int) -> None:
        for key, (frame, period_ns, due_ns) in list(self._jobs.items()):
            due_ns = max(due_ns, t_ns - 20 * period_ns)
            while due_ns <= t_ns:
                self.send(frame())
                due_ns += period_ns
            self._jobs[key] = (frame, period_ns, due_ns)

    def send(self, message: can.Message) -> None:
        with contextlib.suppress(can.CanError, OSError):
            self._bus.send(message)


@dataclass
class Bench:
    """Devices, bus and frames that faults act on."""

    devices: DeviceBus
    unknown_device: UnknownDevice
    period_ns: int
    cable: Any
    """the nodes' side of the bus, with `silent` to cut it"""


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


SYNC_ID, NMT, SDO_ANSWER, HEARTBEAT = 0x080, 0x000, 0x580, 0x700
BOOT_REQUESTS = (1, 4, *range(7, 14), *range(15, 18))
"""SDO requests of the boot of a shipped node; an abort of each is reported. The others read what a node may
refuse: product code and revision, error register and history, inhibit time."""
ABORT = 0x08000000
OBJECTS = ((0x1018, 1), (0x1018, 4), (0x1A01, 0), (0x1A01, 2), (0x1801, 1), (0x1801, 2), (0x1017, 0))


@dataclass
class Fault:
    """One fault while it lasts, on a node or (device None) on the bus. Times in ns, monotonic."""

    kind: Kind
    number: int
    device: Device | None
    nodes: tuple[int, ...]
    """ids of the nodes that it may disturb"""
    chance: random.Random
    start_ns: int
    end_ns: int
    health: dict[int, Any]
    """node id -> its message before"""
    bus: Mapping[str, Any]
    """its statistics in `service` before, and now"""
    bus_now: Mapping[str, Any] = field(default_factory=dict)
    ended_ns: int = 0
    reported_ns: dict[int, int] = field(default_factory=dict)
    """node id, 0 for the bus -> when the right cause was reported"""
    well_ns: dict[int, int] = field(default_factory=dict)
    history: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    disturbed_ns: list[int] = field(default_factory=list)
    """when it changed a state that must not change"""
    kept: Any = None
    """whatever has to be restored"""

    @property
    def node(self) -> Device:
        """Device with the fault."""
        assert self.device is not None
        return self.device


ReportCheck = Callable[[Fault, Any], bool]
"""Returns True if a health message reports the cause"""


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    `begin` and `end` cause and remove it; `lasts_s` are the shortest and longest time between. A fault with
    `has_acted` isn't removed before that returns True. `reported` checks that a health message of the node
    reports it, `reported_by_bus` that the bus statistics in `service` do; with neither no report is required.
    `quiet`: the node must stay operational and its samples valid; `loose`: the node must stay operational,
    but its samples are wrong, which the supervisor diagnoses. `within_s` limits the time to the report since
    the beginning, or with `has_acted` since the end; `well_s` the time to recovery.
    """

    name: str
    expected: str
    begin: Callable[[Fault, Any], None]
    end: Callable[[Fault, Any], None]
    lasts_s: tuple[float, float] = (0.4, 1.5)
    has_acted: Callable[[Fault], bool] | None = None
    reported: ReportCheck | None = None
    reported_by_bus: Callable[[Fault], bool] | None = None
    quiet: bool = False
    loose: bool = False
    bus_wide: bool = False
    alone: bool = False
    lag: float = 0.0
    """periods by which its samples are late; shortens the pause that makes it stale"""
    within_s: float = 1.0
    well_s: float = 2.0
    unstable: bool = False
    """the node doesn't stay operational: it has no other fault until it is stable again"""
    repaired: bool = False
    """changed settings, which are repaired a few times in a row only"""
    weight: float = 1.0


# How faults begin and end --------------------------------------------------------------------------------


def nothing(_: Fault, __: Any) -> None:
    """Do nothing: the fault ends by itself."""


def line(**settings: Any) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, _: Any) -> None:
        fault.node.line = LineFaults(**settings, seed=fault.number)

    return begin


def node(method: str, *arguments: Any) -> Callable[[Fault, Any], None]:
    """Call a method of the node."""
    return lambda fault, _: getattr(fault.node, method)(*arguments)


def restore(name: str, value: Any) -> Callable[[Fault, Any], None]:
    """Set an attribute of the node."""
    return lambda fault, _: setattr(fault.node, name, value)


def every_node(method: str) -> Callable[[Fault, Any], None]:
    """Call a method of all nodes."""

    def act(_: Fault, bench: Any) -> None:
        for device in list(bench.devices.devices.values()):
            getattr(device, method)()

    return act


def cable(silent: bool) -> Callable[[Fault, Any], None]:
    """Cut or mend the nodes' cable."""
    return lambda _, bench: setattr(bench.cable, "silent", silent)


def one_channel(method: str) -> Callable[[Fault, Any], None]:
    """Call a method of the node with a random channel."""
    return lambda fault, _: getattr(fault.node, method)(fault.chance.randrange(4))


def dead(fault: Fault, _: Any) -> None:
    fault.node.open_electrodes = {fault.chance.randrange(4)}


def brown_out(fault: Fault, _: Any) -> None:
    fault.node.brown_out(fault.end_ns - fault.start_ns)


def late(fault: Fault, bench: Any) -> None:
    """Delay samples until after their tick, before the next SYNC."""
    fault.node.line = LineFaults(late_ns=round(fault.kind.lag * bench.period_ns))


def no_line(fault: Fault, _: Any) -> None:
    fault.node.line = None


def attribute(name: str, during: Any, after: Any) -> dict[str, Any]:
    """Set an attribute of the node, and restore it."""
    return {
        "begin": lambda fault, _: setattr(fault.node, name, during),
        "end": lambda fault, _: setattr(fault.node, name, after),
    }


def brown_outs(fault: Fault, _: Any) -> None:
    """Cause three brown-outs in quick succession, during the boot."""
    away_ms = fault.chance.randrange(2, 60)
    every_ms = away_ms + fault.chance.randrange(3, 120)
    fault.node.brown_out(away_ms * 1_000_000, times=3, every_ns=every_ms * 1_000_000)


def bus_off(fault: Fault, _: Any) -> None:
    fault.node.bus_off(fault.end_ns - fault.start_ns, boots=fault.kind.name.endswith("boots"))


def swap(fault: Fault, _: Any) -> None:
    fault.kept = fault.node.serial
    fault.node.replace_device(fault.kept + 5000)


def twin(fault: Fault, bench: Any) -> None:
    fault.kept = bench.devices.add_twin(fault.node.node_id, serial=fault.node.serial + 7000)
    fault.kept.plug()


def no_twin(fault: Fault, bench: Any) -> None:
    with bench.devices.lock:
        fault.kept.unplug()
        bench.devices.leave(fault.kept)


def fail_at_step(code: int | None) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        with bench.devices.lock:
            server = fault.node.sdo
            fault.kept = server.requests + fault.chance.choice(BOOT_REQUESTS)
            server.fail_nth = {fault.kept: code}
            fault.node.reboot()

    return begin


def step_reached(fault: Fault) -> bool:
    """Return True after the request of `fail_at_step`, however long a busy machine takes to get there."""
    return bool(fault.node.sdo.requests >= fault.kept)


def fail_object(fault: Fault, bench: Any) -> None:
    with bench.devices.lock:
        fault.node.sdo.fail[fault.chance.choice(OBJECTS)] = ABORT
        fault.node.reboot()


def garble(how: str) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        with bench.devices.lock:
            fault.node.sdo.garble = how  # type: ignore[assignment]
            fault.node.reboot()

    return begin


def freeze(reboot: bool) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        with bench.devices.lock:
            fault.node.sdo.frozen = True
            if reboot:
                fault.node.reboot()

    return begin


def heal_sdo(fault: Fault, bench: Any) -> None:
    with bench.devices.lock:
        server = fault.node.sdo
        server.frozen, server.garble = False, None
        server.fail.clear()
        server.fail_nth = {}


def emergency(fault: Fault, _: Any) -> None:
    fault.kept = 0xFF00 + fault.number % 256
    fault.node.send_emergency(fault.kept, 0x81, b"hand")


def latch(code: int, reboot: bool) -> Callable[[Fault, Any], None]:
    """Give the node an error that keeps it from being operational."""

    def begin(fault: Fault, bench: Any) -> None:
        with bench.devices.lock:
            if reboot:
                fault.node.unplug()
            fault.node.latch_error(code, 1)
            fault.node.plug()

    return begin


def boot_loop(fault: Fault, _: Any) -> None:
    fault.node.start_boot_loop(fault.chance.randrange(80, 250) * 1_000_000)


def illegal_state(fault: Fault, _: Any) -> None:
    fault.kept = fault.chance.choice((1, 2, 3, 6, 99, 126))
    fault.node.heartbeat_state = fault.kept


def disable_tpdo(fault: Fault, _: Any) -> None:
    fault.node.write_object(0x1801, 1, 0x80000000 | TPDO + fault.node.node_id)


def change(index: int, sub: int, value: int) -> Callable[[Fault, Any], None]:
    """Change a setting, as another client would."""
    return lambda fault, _: fault.node.write_object(index, sub, value)


def nmt(command: int) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        bench.unknown_device.send(message(NMT, bytes((command, fault.node.node_id))))

    return begin


def sending(make: Callable[[random.Random, Sequence[int]], can.Message], rate_hz: float) -> dict[str, Any]:
    """Send frames of an unknown device."""

    def begin(fault: Fault, bench: Any) -> None:
        nodes = sorted(bench.devices.devices)
        bench.unknown_device.start(fault.number, lambda: make(fault.chance, nodes), rate_hz)

    return {"begin": begin, "end": lambda fault, bench: bench.unknown_device.stop(fault.number)}


def message(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def foreign(chance: random.Random, _: Sequence[int]) -> can.Message:
    """Frames with identifiers that no node uses: node ids 0x60 to 0x7F, and 29-bit ones."""
    if chance.random() < 0.1:
        return can.Message(arbitration_id=chance.randrange(1 << 29), data=b"\x01\x02", is_extended_id=True)
    base = chance.choice((0x180, 0x280, 0x580, 0x700, 0x080))
    return message(base + chance.randrange(0x60, 0x80), chance.randbytes(chance.randint(0, 8)))


def sync(_: random.Random, __: Sequence[int]) -> can.Message:
    """SYNC of another producer."""
    return message(SYNC_ID)


def malformed(chance: random.Random, nodes: Sequence[int]) -> can.Message:
    """Samples, heartbeats, EMCY and SDO answers with our nodes' identifiers and wrong lengths."""
    base = chance.choice((TPDO, HEARTBEAT, SDO_ANSWER, SYNC_ID))
    size = chance.choice((0, 2, 3, 4, 5, 6, 7) if base != HEARTBEAT else (0, 2, 5, 8))
    return message(base + chance.choice(nodes), chance.randbytes(size))


def answers(chance: random.Random, nodes: Sequence[int]) -> can.Message:
    """Unrequested SDO answers."""
    return message(SDO_ANSWER + chance.choice(nodes), b"\x43\x18\x10\x04" + chance.randbytes(4))


release = node("release_channels")
saturate = node("saturate_channels")
hush = node("stop_babbling")
babble = node("start_babbling", 1000)
chatter = node("start_babbling", 400, 0x1F0, b"\x01")
no_emergency = node("send_emergency", 0)
unlatch = node("clear_error")
no_boot_loop = node("stop_boot_loop")
no_beat_time = change(0x1017, 0, 0)
reboot = node("reboot")
unplug = node("unplug")
plug = node("plug")
silence = cable(silent=True)
sound = cable(silent=False)
all_off = every_node("unplug")
all_on = every_node("plug")
all_reboot = every_node("reboot")
stick = one_channel("stick_channel")
alive, legal_state = restore("open_electrodes", frozenset()), restore("heartbeat_state", None)


def swap_back(fault: Fault, _: Any) -> None:
    fault.node.replace_device(fault.kept)


ALONE: dict[str, Any] = {"bus_wide": True, "alone": True, "weight": 0.25}


# Checks of reports --------------------------------------------------------------------------------------


def matches(pattern: str) -> ReportCheck:
    """Return a check that the reason matches a pattern."""
    compiled = re.compile(pattern)
    return lambda _, health: bool(compiled.search(health.reason))


def rebooted(fault: Fault, health: Any) -> bool:
    return bool(health.reboots > fault.health[health.node_id].reboots)


def rebooted_or_away(fault: Fault, health: Any) -> bool:
    """Check for a node without power for about as long as it takes to be lost."""
    return rebooted(fault, health) or _LOST(fault, health)


def missed(fault: Fault, health: Any) -> bool:
    return bool(health.missed_samples > fault.health[health.node_id].missed_samples)


def beats_missed(fault: Fault, health: Any) -> bool:
    return bool(health.heartbeats_missed > fault.health[health.node_id].heartbeats_missed)


def _is_reason_as_before(fault: Fault, health: Any) -> bool:
    """Check that an EMCY is no reason of the pad's state; it may have one, such as unknown zeros."""
    return bool(health.reason == fault.health[health.node_id].reason)


def emergency_reported(fault: Fault, health: Any) -> bool:
    found = [error for error in health.emergencies if error["code"] == fault.kept]
    return bool(found) and found[-1]["cleared_ns"] is None and _is_reason_as_before(fault, health)


def emergency_cleared(fault: Fault, health: Any) -> bool:
    found = [error for error in health.emergencies if error["code"] == fault.kept]
    return bool(found) and found[-1]["cleared_ns"] is not None and _is_reason_as_before(fault, health)


def illegal_reported(fault: Fault, health: Any) -> bool:
    return f"heartbeat with illegal NMT state {fault.kept};" in health.reason


def reset_reported(fault: Fault, health: Any) -> bool:
    return rebooted(fault, health) and "reset by an NMT command of another master" in health.reason


def grew(counter: str, by: int = 1) -> Callable[[Fault], bool]:
    """Return a check that a counter of the bus has grown."""
    return lambda fault: bool(fault.bus_now[counter] >= fault.bus[counter] + by)


def other_sync(fault: Fault) -> bool:
    now, before = fault.bus_now["sync"], fault.bus["sync"]
    return now["other_syncs"] > before["other_syncs"] and "another SYNC producer" in now["problem"]


_LOST = matches("lost: no heartbeat")
_STALE = matches("no sample for three SYNC periods|no sample for .* heartbeat present")
_GONE = matches("lost: no heartbeat|no sample for")
_NO_BEAT = matches("heartbeat: none for .* while its samples arrive")
_HEARTBEAT_CHANGED = matches("0x1017:00, heartbeat time, is (?:0|1000) instead of|lost: no heartbeat")
_REFUSED = matches("refused by the node")
_NO_ANSWER = matches("no answer within 200 ms in 2 attempts")


KINDS = (
    # quiet: nothing but counters may change
    Kind("lost: 1 sample in 20", "`missed_samples`", line(lost_every=20), no_line,
         reported=missed, quiet=True, within_s=2.8),
    Kind("late samples", "`missed_samples`", late, no_line, lag=0.8,
         reported=missed, quiet=True, within_s=2.8),
    Kind("duplicate samples", "nothing", line(duplicate=0.5), no_line, quiet=True),
    Kind("heartbeats lost, two at most", "`heartbeats_missed`", **attribute("send_heartbeat", False, True),
         lasts_s=(0.15, 0.2), reported=beats_missed, quiet=True, within_s=1.6),
    Kind("EMCY", "in `emergencies`, not cleared", emergency, no_emergency, lasts_s=(0.3, 0.8),
         reported=emergency_reported, quiet=True, within_s=0.3),
    Kind("EMCY, cleared", "in `emergencies`, cleared", emergency, no_emergency, lasts_s=(0.1, 0.8),
         reported=emergency_cleared, quiet=True, within_s=1.0),
    Kind("SDO server frozen, node runs", "nothing", freeze(reboot=False), heal_sdo, quiet=True),
    Kind("babbles with unknown identifiers", "`unknown_frames`", chatter, hush,
         reported_by_bus=grew("unknown_frames", 100), quiet=True, within_s=1.6),
    # loose: the pad is wrong, the node isn't
    Kind("stuck channel", "none here", stick, release, loose=True),
    Kind("dead electrode", "none here", dead, alive, loose=True),
    # the pad is reported
    Kind("corrupt samples", "faulted: no such currents", line(corrupt=1.0), no_line,
         reported=matches("at the end of its range|electrode currents can't be negative")),
    Kind("saturated", "faulted: end of range", saturate, release,
         reported=matches("at the end of its range")),
    # the node is reported
    Kind("short samples", "stale: both lengths", **attribute("frame_bytes", 7, None),
         reported=matches(r"no sample for .* its PDO has \d bytes, its mapping 8")),
    Kind("heartbeat without data", "stale", **attribute("send_data", False, True), reported=_STALE),
    Kind("data without heartbeat", "slow heartbeat",
         **attribute("send_heartbeat", False, True),
         lasts_s=(0.8, 3.0), reported=_NO_BEAT),
    Kind("all frames lost", "lost: no heartbeat", line(lost=1.0, data_only=False), no_line,
         lasts_s=(0.8, 2.5), reported=_LOST),
    Kind("one frame in three lost", "`missed_samples`, stale or lost", line(lost=0.33, data_only=False),
         no_line,
         reported=lambda fault, health: missed(fault, health) or _GONE(fault, health),
         within_s=2.8, well_s=7.0),
    Kind("heartbeat disabled by another client", "the object, both values", no_beat_time, nothing,
         lasts_s=(0.5, 0.5), repaired=True, reported=_HEARTBEAT_CHANGED),
    Kind("heartbeat slowed by another client", "the object, both values", change(0x1017, 0, 1000), nothing,
         lasts_s=(0.5, 0.5), repaired=True,
         reported=_HEARTBEAT_CHANGED),
    Kind("reboot", "`reboots`", reboot, nothing, lasts_s=(0.0, 0.0), reported=rebooted, weight=3.0),
    Kind("brown-out, up to 0.7 s", "`reboots`, or lost", brown_out, nothing,
         lasts_s=(0.005, 0.7), reported=rebooted_or_away, within_s=1.5, weight=3.0),
    Kind("three brown-outs", "`reboots`", brown_outs, nothing, lasts_s=(0.6, 0.6),
         reported=rebooted, weight=2.0),
    Kind("unplugged for long", "lost: no heartbeat", unplug, plug,
         lasts_s=(0.8, 5.0), reported=_LOST, weight=2.0),
    Kind("bus-off, short", "stale", bus_off, nothing, lasts_s=(0.1, 0.25), reported=_GONE),
    Kind("bus-off, long", "lost: no heartbeat", bus_off, nothing, lasts_s=(0.7, 1.5), reported=_LOST),
    Kind("bus-off, then boots", "`reboots`, or lost", bus_off, nothing,
         lasts_s=(0.1, 1.0), reported=rebooted_or_away, within_s=1.8),
    Kind("reboot, refuses OPERATIONAL", "faulted: error register and EMCY", latch(0x5000, True), unlatch,
         lasts_s=(0.8, 3.0), well_s=7.0, unstable=True,
         reported=matches(r"refuses OPERATIONAL, error register 0x01 .*EMCY 0x5000")),
    Kind("leaves OPERATIONAL upon an error", "error register and EMCY", latch(0x2310, False), unlatch,
         lasts_s=(0.8, 3.0), well_s=7.0, unstable=True,
         reported=matches(r"left OPERATIONAL by itself.*error register 0x01 .*EMCY 0x2310")),
    Kind("boot loop", "faulted: boot loop", boot_loop, no_boot_loop,
         lasts_s=(1.5, 3.0), well_s=7.0, unstable=True, reported=matches(r"boot loop: \d+ boot-up messages")),
    Kind("illegal heartbeat state", "faulted: the state", illegal_state, legal_state,
         lasts_s=(0.5, 3.0), well_s=7.0, unstable=True, reported=illegal_reported),
    Kind("transmission type changed", "the object, both values", change(0x1801, 2, 240), nothing,
         lasts_s=(0.5, 0.5), repaired=True,
         reported=matches("0x1801:02, transmission type of TPDO2, is 240 instead of 1")),
    Kind("TPDO disabled by another client", "the object, both values", disable_tpdo, nothing,
         lasts_s=(0.5, 0.5), repaired=True,
         reported=matches("0x1801:01, COB-ID of TPDO2, is 0x800002")),
    Kind("node replaced", "faulted: identity mismatch, both numbers", swap, swap_back,
         lasts_s=(0.3, 2.0), weight=2.0,
         reported=matches(r"identity mismatch: serial number is (\d+) .* configured is (\d+)")),
    Kind("two nodes with its id", "faulted: duplicate node id, or identity mismatch", twin, no_twin,
         lasts_s=(4.5, 7.0), within_s=5.0, well_s=9.0,
         reported=matches("duplicate node id|identity mismatch: serial number")),
    Kind("reboot, SDO abort at a step", "faulted: refused", fail_at_step(ABORT), heal_sdo,
         lasts_s=(0.5, 0.5), has_acted=step_reached, reported=_REFUSED, weight=3.0),
    Kind("reboot, silence at a step", "`reboots`", fail_at_step(None), heal_sdo,
         lasts_s=(0.5, 0.5), has_acted=step_reached, reported=rebooted, weight=2.0),
    Kind("reboot, an object refused", "faulted: refused", fail_object, heal_sdo,
         reported=_REFUSED, well_s=7.0),
    Kind("reboot, SDO answers are noise", "faulted: 0x1018:01", garble("noise"), heal_sdo,
         reported=matches("0x1018:01"), well_s=7.0),
    Kind("reboot, SDO answers name another object", "faulted: 0x1018:01", garble("object"), heal_sdo,
         reported=matches("0x1018:01"), well_s=7.0),
    Kind("reboot, SDO server frozen", "faulted: no answer", freeze(reboot=True), heal_sdo,
         lasts_s=(0.8, 2.0), reported=_NO_ANSWER, within_s=1.5, well_s=7.0),
    Kind("stopped by another master", "NMT state", nmt(2), nothing, lasts_s=(0.3, 0.3),
         reported=matches("made stopped by an NMT command of another master")),
    Kind("made pre-operational by another master", "NMT state", nmt(128), nothing, lasts_s=(0.3, 0.3),
         reported=matches("made pre-operational by an NMT command of another master")),
    Kind("reset by another master", "`reboots`, NMT command", nmt(129), nothing, lasts_s=(0.0, 0.0),
         reported=reset_reported),
    Kind("babbles as itself", "faulted: too many samples", babble, hush,
         lasts_s=(1.5, 2.5), reported=matches("samples per SYNC"), within_s=2.0, well_s=4.0),
    # the bus; no pad may be disturbed by what others send
    Kind("flood of unknown identifiers", "`unknown_frames`", **sending(foreign, 1000),
         reported_by_bus=grew("unknown_frames", 100), bus_wide=True, within_s=1.6, weight=0.7),
    Kind("wrong lengths with our nodes' identifiers", "`wrong_length`", **sending(malformed, 200),
         reported_by_bus=grew("wrong_length", 20), bus_wide=True, within_s=1.6, weight=0.7),
    Kind("unrequested SDO answers", "nothing", **sending(answers, 100), bus_wide=True, weight=0.7),
    Kind("another SYNC producer", "problem of the bus", **sending(sync, 40),
         lasts_s=(2.0, 3.0), reported_by_bus=other_sync, bus_wide=True, within_s=3.0, weight=0.5),
    # the bus; all pads are disturbed, so nothing else happens meanwhile
    Kind("bus silent, short", "all stale", silence, sound, lasts_s=(0.1, 0.25), reported=_GONE, **ALONE),
    Kind("bus silent, long", "all lost", silence, sound, lasts_s=(0.8, 2.0), reported=_LOST, **ALONE),
    Kind("all nodes without power", "all lost", all_off, all_on, lasts_s=(0.8, 3.0), reported=_LOST, **ALONE),
    Kind("all nodes reboot", "`reboots`", all_reboot, nothing, lasts_s=(0.0, 0.0),
         reported=rebooted, **ALONE),
)  # fmt: skip
