"""The kinds of faults of the campaign in stress_faults.py, and the expected report of each.

Public names: `KINDS`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from benchmarks.fault_acts import (
    ABORT,
    Fault,
    Kind,
    ReportCheck,
    alive,
    all_off,
    all_on,
    all_reboot,
    answers,
    attribute,
    babble,
    boot_loop,
    brown_out,
    brown_outs,
    bus_off,
    change,
    chatter,
    dead,
    disable_tpdo,
    emergency,
    fail_at_step,
    fail_object,
    foreign,
    freeze,
    garble,
    heal_sdo,
    hush,
    illegal_state,
    latch,
    late,
    legal_state,
    line,
    malformed,
    nmt,
    no_beat_time,
    no_boot_loop,
    no_emergency,
    no_line,
    no_twin,
    nothing,
    plug,
    reboot,
    release,
    saturate,
    sending,
    silence,
    sound,
    stick,
    swap,
    swap_back,
    sync,
    twin,
    unlatch,
    unplug,
)

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


def emergency_reported(fault: Fault, health: Any) -> bool:
    found = [error for error in health.emergencies if error["code"] == fault.kept]
    return bool(found) and found[-1]["cleared_ns"] is None and health.reason == ""


def emergency_cleared(fault: Fault, health: Any) -> bool:
    found = [error for error in health.emergencies if error["code"] == fault.kept]
    return bool(found) and found[-1]["cleared_ns"] is not None and health.reason == ""


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
         lasts_s=(0.5, 0.5), reported=_REFUSED, weight=3.0),
    Kind("reboot, silence at a step", "`reboots`", fail_at_step(None), heal_sdo,
         lasts_s=(0.5, 0.5), reported=rebooted, weight=2.0),
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
