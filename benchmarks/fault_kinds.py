"""The kinds of faults of the campaign in stress_faults.py: how each begins, ends and is to be told.

Public names: `Kind`, `Fault`, `KINDS`, `Stranger`.
"""

from __future__ import annotations

import contextlib
import random
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import can

from handtouch.canbus.device import Device, DeviceBus, Line

S = 1_000_000_000
SYNC_ID, NMT, TPDO, SDO_ANSWER, HEARTBEAT = 0x080, 0x000, 0x280, 0x580, 0x700
BOOT_REQUESTS = 14  # SDO requests of the boot of a shipped node; an abort of each is told
ABORT = 0x08000000
OBJECTS = ((0x1018, 1), (0x1018, 4), (0x1A01, 0), (0x1A01, 2), (0x1801, 1), (0x1801, 2), (0x1017, 0))
ALONE: dict[str, Any] = {"bus_wide": True, "alone": True, "weight": 0.25}


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
    """its figures in `service` before, and now"""
    bus_now: Mapping[str, Any] = field(default_factory=dict)
    ended_ns: int = 0
    told_ns: dict[int, int] = field(default_factory=dict)
    """node id, 0 for the bus -> when the right cause was told"""
    well_ns: dict[int, int] = field(default_factory=dict)
    history: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    disturbed_ns: list[int] = field(default_factory=list)
    """when it changed what it mustn't"""
    kept: Any = None
    """whatever has to be taken back"""

    @property
    def node(self) -> Device:
        """The node that it is on."""
        assert self.device is not None
        return self.device


Told = Callable[[Fault, Any], bool]
"""Whether a health message tells the cause."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    `begin` and `end` cause it and take it back; `lasts_s` the shortest and longest time between. `told` is
    how a health message of the node tells it, `told_by_bus` how the bus's figures in `service` do; with
    neither nothing is required. `quiet`: the node must stay operational and trusted all the while; `loose`:
    operational it must stay, but what its pad shows is wrong, which is for the supervisor of pads to tell.
    `within_s` for the telling, `well_s` for being operational again.
    """

    name: str
    expected: str
    begin: Callable[[Fault, Any], None]
    end: Callable[[Fault, Any], None]
    lasts_s: tuple[float, float] = (0.4, 1.5)
    told: Told | None = None
    told_by_bus: Callable[[Fault], bool] | None = None
    quiet: bool = False
    loose: bool = False
    bus_wide: bool = False
    alone: bool = False
    within_s: float = 1.0
    well_s: float = 2.0
    weight: float = 1.0


class Stranger:
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
    """What faults act on."""

    devices: DeviceBus
    stranger: Stranger
    period_ns: int
    cable: Any
    """the nodes' side of the bus, with `silent` to cut it"""


# How a message tells -------------------------------------------------------------------------------------


def says(pattern: str) -> Told:
    """The reason has words that match."""
    words = re.compile(pattern)
    return lambda _, health: bool(words.search(health.reason))


def rebooted(fault: Fault, health: Any) -> bool:
    return bool(health.reboots > fault.health[health.node_id].reboots)


def rebooted_or_away(fault: Fault, health: Any) -> bool:
    """For one that is dark for as long as it takes to be lost, more or less."""
    return rebooted(fault, health) or _LOST(fault, health)


def missed(fault: Fault, health: Any) -> bool:
    return bool(health.missed > fault.health[health.node_id].missed)


def beats_missed(fault: Fault, health: Any) -> bool:
    return bool(health.heartbeats_missed > fault.health[health.node_id].heartbeats_missed)


def emergency_told(fault: Fault, health: Any) -> bool:
    return any(fault.kept in text for text in health.emergencies)


def grew(counter: str, by: int = 1) -> Callable[[Fault], bool]:
    """A counter of the bus."""
    return lambda fault: bool(fault.bus_now[counter] >= fault.bus[counter] + by)


def other_sync(fault: Fault) -> bool:
    now, before = fault.bus_now["sync"], fault.bus["sync"]
    return now["others"] > before["others"] and "another SYNC producer" in now["problem"]


_LOST = says("lost: no heartbeat")
_STALE = says("its heartbeat comes, its samples don't|no sample for .* its heartbeat is there")
_GONE = says("lost: no heartbeat|its heartbeat comes, its samples don't|no sample for")
_REFUSED = says("refused by the node")
_NO_ANSWER = says("no answer within 200 ms, asked 2 times")


# How faults begin and end --------------------------------------------------------------------------------


def nothing(_: Fault, __: Any) -> None:
    """It ends by itself."""


def line(**settings: Any) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, _: Any) -> None:
        fault.node.line = Line(**settings, seed=fault.number)

    return begin


def late(fault: Fault, bench: Any) -> None:
    """For the tick of the next period."""
    fault.node.line = Line(late_ns=round(1.2 * bench.period_ns))


def no_line(fault: Fault, _: Any) -> None:
    fault.node.line = None


def attribute(name: str, during: Any, after: Any) -> dict[str, Any]:
    """A switch of the node."""
    return {
        "begin": lambda fault, _: setattr(fault.node, name, during),
        "end": lambda fault, _: setattr(fault.node, name, after),
    }


def stick(fault: Fault, _: Any) -> None:
    fault.node.stick(fault.chance.randrange(4))


def dead(fault: Fault, _: Any) -> None:
    fault.node.dead = {fault.chance.randrange(4)}


def alive(fault: Fault, _: Any) -> None:
    fault.node.dead = frozenset()


def saturate(fault: Fault, _: Any) -> None:
    fault.node.saturate()


def release(fault: Fault, _: Any) -> None:
    fault.node.release()


def brown_out(fault: Fault, _: Any) -> None:
    fault.node.brown_out(fault.end_ns - fault.start_ns)


def brown_outs(fault: Fault, _: Any) -> None:
    """Three, so close that they hit the boot."""
    away_ms = fault.chance.randrange(2, 60)
    every_ms = away_ms + fault.chance.randrange(3, 120)
    fault.node.brown_out(away_ms * 1_000_000, times=3, every_ns=every_ms * 1_000_000)


def bus_off(fault: Fault, _: Any) -> None:
    fault.node.bus_off(fault.end_ns - fault.start_ns, boots=fault.kind.name.endswith("boots"))


def swap(fault: Fault, _: Any) -> None:
    fault.kept = fault.node.serial
    fault.node.swap(fault.kept + 5000)


def swap_back(fault: Fault, _: Any) -> None:
    fault.node.swap(fault.kept)


def twin(fault: Fault, bench: Any) -> None:
    fault.kept = bench.devices.add_twin(fault.node.node_id, serial=fault.node.serial + 7000)
    fault.kept.plug()


def no_twin(fault: Fault, bench: Any) -> None:
    with bench.devices.lock:
        fault.kept.unplug()
        bench.devices.leave(fault.kept)


def babble(fault: Fault, _: Any) -> None:
    fault.node.babble(1000)


def chatter(fault: Fault, _: Any) -> None:
    fault.node.babble(400, 0x1F0, b"\x01")


def hush(fault: Fault, _: Any) -> None:
    fault.node.hush()


def fail_at_step(code: int | None) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        with bench.devices.lock:
            server = fault.node.sdo
            server.fail_nth = {server.requests + fault.chance.randint(1, BOOT_REQUESTS): code}
            fault.node.reboot()

    return begin


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
    code = 0xFF00 + fault.number % 256
    fault.kept = f"0x{code:04X}"
    fault.node.emergency(code, 0x81, b"hand")


def nmt(command: int) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        bench.stranger.send(message(NMT, bytes((command, fault.node.node_id))))

    return begin


def no_beat_time(fault: Fault, _: Any) -> None:
    fault.node.write(0x1017, 0, 0)


def reboot(fault: Fault, _: Any) -> None:
    fault.node.reboot()


def unplug(fault: Fault, _: Any) -> None:
    fault.node.unplug()


def plug(fault: Fault, _: Any) -> None:
    fault.node.plug()


def silence(_: Fault, bench: Any) -> None:
    bench.cable.silent = True


def sound(_: Fault, bench: Any) -> None:
    bench.cable.silent = False


def all_off(_: Fault, bench: Any) -> None:
    for device in list(bench.devices.devices.values()):
        device.unplug()


def all_on(_: Fault, bench: Any) -> None:
    for device in list(bench.devices.devices.values()):
        device.plug()


def all_reboot(_: Fault, bench: Any) -> None:
    for device in list(bench.devices.devices.values()):
        device.reboot()


def sending(make: Callable[[random.Random, Sequence[int]], can.Message], rate_hz: float) -> dict[str, Any]:
    """Frames of the stranger."""

    def begin(fault: Fault, bench: Any) -> None:
        nodes = sorted(bench.devices.devices)
        bench.stranger.start(fault.number, lambda: make(fault.chance, nodes), rate_hz)

    return {"begin": begin, "end": lambda fault, bench: bench.stranger.stop(fault.number)}


def message(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def foreign(chance: random.Random, _: Sequence[int]) -> can.Message:
    """Identifiers that no node uses: those of ids 0x60 to 0x7F, and 29-bit ones."""
    if chance.random() < 0.1:
        return can.Message(arbitration_id=chance.randrange(1 << 29), data=b"\x01\x02", is_extended_id=True)
    base = chance.choice((0x180, 0x280, 0x580, 0x700, 0x080))
    return message(base + chance.randrange(0x60, 0x80), chance.randbytes(chance.randint(0, 8)))


def sync(_: random.Random, __: Sequence[int]) -> can.Message:
    """As another SYNC producer sends it."""
    return message(SYNC_ID)


def malformed(chance: random.Random, nodes: Sequence[int]) -> can.Message:
    """Samples, heartbeats, EMCY and SDO answers in the name of our nodes, of wrong lengths."""
    base = chance.choice((TPDO, HEARTBEAT, SDO_ANSWER, SYNC_ID))
    size = chance.choice((0, 2, 3, 4, 5, 6, 7) if base != HEARTBEAT else (0, 2, 5, 8))
    return message(base + chance.choice(nodes), chance.randbytes(size))


def answers(chance: random.Random, nodes: Sequence[int]) -> can.Message:
    """SDO answers that nobody asked for."""
    return message(SDO_ANSWER + chance.choice(nodes), b"\x43\x18\x10\x04" + chance.randbytes(4))


KINDS = (
    # quiet: nothing but counters may change
    Kind("lost: 1 sample in 20", "`missed`", line(lost_every=20), no_line,
         told=missed, quiet=True, within_s=2.8),
    Kind("late samples", "`missed`", late, no_line,
         told=missed, quiet=True, within_s=2.8),
    Kind("duplicate samples", "nothing", line(duplicate=0.5), no_line, quiet=True),
    Kind("heartbeats lost, two at most", "`heartbeats_missed`", **attribute("send_heartbeat", False, True),
         lasts_s=(0.15, 0.2), told=beats_missed, quiet=True, within_s=1.6),
    Kind("EMCY", "its text in `emergencies`", emergency, nothing,
         told=emergency_told, quiet=True, within_s=1.6),
    Kind("SDO server frozen, node runs", "nothing", freeze(reboot=False), heal_sdo, quiet=True),
    Kind("babbles as somebody unknown", "`foreign`", chatter, hush,
         told_by_bus=grew("foreign", 100), quiet=True, within_s=1.6),
    # loose: the pad is wrong, the node isn't
    Kind("stuck channel", "nothing yet", stick, release, loose=True),
    Kind("dead electrode", "nothing yet", dead, alive, loose=True),
    # the pad is told
    Kind("corrupt samples", "faulted: no such currents", line(corrupt=1.0), no_line,
         told=says("at the end of its range|no electrode can give current")),
    Kind("saturated", "faulted: end of range", saturate, release, told=says("at the end of its range")),
    # the node is told
    Kind("short samples", "stale; `short`", **attribute("frame_bytes", 7, None), told=_STALE),
    Kind("heartbeat without data", "stale", **attribute("send_data", False, True), told=_STALE),
    Kind("data without heartbeat", "lost: no heartbeat", **attribute("send_heartbeat", False, True),
         lasts_s=(0.8, 3.0), told=_LOST, well_s=7.0),
    Kind("all frames lost", "lost: no heartbeat", line(lost=1.0, data_only=False), no_line,
         lasts_s=(0.8, 2.5), told=_LOST),
    Kind("one frame in three lost", "`missed`, stale or lost", line(lost=0.33, data_only=False), no_line,
         told=lambda fault, health: missed(fault, health) or _GONE(fault, health), within_s=2.8, well_s=7.0),
    Kind("heartbeat switched off by somebody", "lost: no heartbeat", no_beat_time, nothing,
         lasts_s=(0.8, 1.0), told=_LOST),
    Kind("reboot", "`reboots`", reboot, nothing, lasts_s=(0.0, 0.0), told=rebooted, weight=3.0),
    Kind("brown-out, up to 0.7 s", "`reboots`, or lost", brown_out, nothing,
         lasts_s=(0.005, 0.7), told=rebooted_or_away, within_s=1.5, weight=3.0),
    Kind("three brown-outs", "`reboots`", brown_outs, nothing, lasts_s=(0.6, 0.6), told=rebooted, weight=2.0),
    Kind("unplugged for long", "lost: no heartbeat", unplug, plug,
         lasts_s=(0.8, 5.0), told=_LOST, weight=2.0),
    Kind("bus-off, short", "stale", bus_off, nothing, lasts_s=(0.1, 0.25), told=_GONE),
    Kind("bus-off, long", "lost: no heartbeat", bus_off, nothing, lasts_s=(0.7, 1.5), told=_LOST),
    Kind("bus-off, then boots", "`reboots`, or lost", bus_off, nothing,
         lasts_s=(0.1, 1.0), told=rebooted_or_away, within_s=1.8),
    Kind("another unit in its place", "faulted: another device, both numbers", swap, swap_back,
         lasts_s=(0.3, 2.0), weight=2.0,
         told=says(r"another device: serial number is (\d+) .* configured is (\d+)")),
    Kind("two nodes with its id", "faulted: two nodes, or another device", twin, no_twin,
         lasts_s=(2.0, 6.0), within_s=5.0, well_s=9.0,
         told=says("two nodes have its id|another device: serial number")),
    Kind("reboot, SDO abort at a step", "faulted: refused", fail_at_step(ABORT), heal_sdo,
         lasts_s=(0.5, 0.5), told=_REFUSED, weight=3.0),
    Kind("reboot, silence at a step", "`reboots`", fail_at_step(None), heal_sdo,
         lasts_s=(0.5, 0.5), told=rebooted, weight=2.0),
    Kind("reboot, an object refused", "faulted: refused", fail_object, heal_sdo, told=_REFUSED, well_s=7.0),
    Kind("reboot, SDO answers are noise", "faulted: 0x1018:01", garble("noise"), heal_sdo,
         told=says("0x1018:01"), well_s=7.0),
    Kind("reboot, SDO answers name another object", "faulted: 0x1018:01", garble("object"), heal_sdo,
         told=says("0x1018:01"), well_s=7.0),
    Kind("reboot, SDO server frozen", "faulted: no answer", freeze(reboot=True), heal_sdo,
         lasts_s=(0.8, 2.0), told=_NO_ANSWER, within_s=1.5, well_s=7.0),
    Kind("stopped by another master", "NMT state", nmt(2), nothing, lasts_s=(0.3, 0.3),
         told=says("node is stopped, though it was started|no sample|samples don't")),
    Kind("made pre-operational by another master", "NMT state", nmt(128), nothing, lasts_s=(0.3, 0.3),
         told=says("node is pre-operational, though it was started|no sample|samples don't")),
    Kind("reset by another master", "`reboots`", nmt(129), nothing, lasts_s=(0.0, 0.0), told=rebooted),
    Kind("babbles as itself", "faulted: too many samples", babble, hush,
         lasts_s=(1.5, 2.5), told=says("times as often"), within_s=2.0, well_s=4.0),
    # the bus; no pad may be disturbed by what others send
    Kind("flood of foreign identifiers", "`foreign`", **sending(foreign, 1000),
         told_by_bus=grew("foreign", 100), bus_wide=True, within_s=1.6, weight=0.7),
    Kind("wrong lengths in our nodes' names", "`short`", **sending(malformed, 200),
         told_by_bus=grew("short", 20), bus_wide=True, within_s=1.6, weight=0.7),
    Kind("SDO answers nobody asked for", "nothing", **sending(answers, 100), bus_wide=True, weight=0.7),
    Kind("another SYNC producer", "told of the bus", **sending(sync, 40),
         lasts_s=(2.0, 3.0), told_by_bus=other_sync, bus_wide=True, within_s=3.0, weight=0.5),
    # the bus; all pads are disturbed, so nothing else happens meanwhile
    Kind("bus silent, short", "all stale", silence, sound, lasts_s=(0.1, 0.25), told=_GONE, **ALONE),
    Kind("bus silent, long", "all lost", silence, sound, lasts_s=(0.8, 2.0), told=_LOST, **ALONE),
    Kind("all nodes without power", "all lost", all_off, all_on, lasts_s=(0.8, 3.0), told=_LOST, **ALONE),
    Kind("all nodes reboot", "`reboots`", all_reboot, nothing, lasts_s=(0.0, 0.0), told=rebooted, **ALONE),
)  # fmt: skip
