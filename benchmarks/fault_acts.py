"""Faults of stress_faults.py: how each is caused on a node or on the bus, and how it is removed.

Public names: `Kind`, `Fault`, and the acts that the kinds are made of.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import can

from benchmarks.fault_bench import TPDO
from handtouch.device import Device, LineFaults

SYNC_ID, NMT, SDO_ANSWER, HEARTBEAT = 0x080, 0x000, 0x580, 0x700
BOOT_REQUESTS = (*range(1, 5), *range(7, 17))
"""SDO requests of the boot of a shipped node; an abort of each is reported. The fifth and the sixth read the
error register and history, which a node may refuse."""
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

    `begin` and `end` cause and remove it; `lasts_s` are the shortest and longest time between. `reported`
    checks that a health message of the node reports it, `reported_by_bus` that the bus statistics in
    `service` do; with neither no report is required. `quiet`: the node must stay operational and its samples
    valid; `loose`: the node must stay operational, but its samples are wrong, which the supervisor diagnoses.
    `within_s` limits the time to the report, `well_s` the time to recovery.
    """

    name: str
    expected: str
    begin: Callable[[Fault, Any], None]
    end: Callable[[Fault, Any], None]
    lasts_s: tuple[float, float] = (0.4, 1.5)
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


def stick(fault: Fault, _: Any) -> None:
    fault.node.stick_channel(fault.chance.randrange(4))


def dead(fault: Fault, _: Any) -> None:
    fault.node.open_electrodes = {fault.chance.randrange(4)}


def alive(fault: Fault, _: Any) -> None:
    fault.node.open_electrodes = frozenset()


def saturate(fault: Fault, _: Any) -> None:
    fault.node.saturate_channels()


def release(fault: Fault, _: Any) -> None:
    fault.node.release_channels()


def brown_out(fault: Fault, _: Any) -> None:
    fault.node.brown_out(fault.end_ns - fault.start_ns)


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


def swap_back(fault: Fault, _: Any) -> None:
    fault.node.replace_device(fault.kept)


def twin(fault: Fault, bench: Any) -> None:
    fault.kept = bench.devices.add_twin(fault.node.node_id, serial=fault.node.serial + 7000)
    fault.kept.plug()


def no_twin(fault: Fault, bench: Any) -> None:
    with bench.devices.lock:
        fault.kept.unplug()
        bench.devices.leave(fault.kept)


def babble(fault: Fault, _: Any) -> None:
    fault.node.start_babbling(1000)


def chatter(fault: Fault, _: Any) -> None:
    fault.node.start_babbling(400, 0x1F0, b"\x01")


def hush(fault: Fault, _: Any) -> None:
    fault.node.stop_babbling()


def fail_at_step(code: int | None) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        with bench.devices.lock:
            server = fault.node.sdo
            server.fail_nth = {server.requests + fault.chance.choice(BOOT_REQUESTS): code}
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
    fault.kept = 0xFF00 + fault.number % 256
    fault.node.send_emergency(fault.kept, 0x81, b"hand")


def no_emergency(fault: Fault, _: Any) -> None:
    fault.node.send_emergency(0)


def latch(code: int, reboot: bool) -> Callable[[Fault, Any], None]:
    """Give the node an error that keeps it from being operational."""

    def begin(fault: Fault, bench: Any) -> None:
        with bench.devices.lock:
            if reboot:
                fault.node.unplug()
            fault.node.latch_error(code, 1)
            fault.node.plug()

    return begin


def unlatch(fault: Fault, _: Any) -> None:
    fault.node.clear_error()


def boot_loop(fault: Fault, _: Any) -> None:
    fault.node.start_boot_loop(fault.chance.randrange(80, 250) * 1_000_000)


def no_boot_loop(fault: Fault, _: Any) -> None:
    fault.node.stop_boot_loop()


def illegal_state(fault: Fault, _: Any) -> None:
    fault.kept = fault.chance.choice((1, 2, 3, 6, 99, 126))
    fault.node.heartbeat_state = fault.kept


def legal_state(fault: Fault, _: Any) -> None:
    fault.node.heartbeat_state = None


def disable_tpdo(fault: Fault, _: Any) -> None:
    fault.node.write_object(0x1801, 1, 0x80000000 | TPDO + fault.node.node_id)


def change(index: int, sub: int, value: int) -> Callable[[Fault, Any], None]:
    """Change a setting, as another client would."""
    return lambda fault, _: fault.node.write_object(index, sub, value)


def nmt(command: int) -> Callable[[Fault, Any], None]:
    def begin(fault: Fault, bench: Any) -> None:
        bench.unknown_device.send(message(NMT, bytes((command, fault.node.node_id))))

    return begin


def no_beat_time(fault: Fault, _: Any) -> None:
    fault.node.write_object(0x1017, 0, 0)


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
