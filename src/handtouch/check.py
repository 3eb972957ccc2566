"""`handtouch check CONFIG`: is the deployment right, what does it load the buses with, what is doubtful.

Public names: `run`, `summary`, `warnings`.
"""

from __future__ import annotations

import json as json_text
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from handtouch import config
from handtouch.canbus.bus.load import burst_s, bus_load
from handtouch.canbus.nodes.spec import checked
from handtouch.canbus.objects.channels import full_scale_counts, greatest_count
from handtouch.config.checks import rectangle_mm
from handtouch.hand.robot import check as check_robots
from handtouch.hand.robot import doubts as robot_doubts

BUSY_LOAD = 0.7
POOR_ASPECT = 3.0


def run(path: Path | None, json: bool, schema: bool) -> int:
    """Print what a deployment amounts to; exit status 0, 1 with warnings, 2 if it can't be used."""
    if schema:
        print(json_text.dumps(config.json_schema(), indent=2))
        return 0
    if path is None:
        print("handtouch check: give a deployment file, or --schema", file=sys.stderr)
        return 2
    try:
        deployment = check_robots(checked(config.load(path), str(path)), str(path))
    except config.ConfigError as error:
        _refuse(error, json)
        return 2
    doubts = list(warnings(deployment))
    if json:
        report = {"file": str(path), "ok": True, **summary(deployment), "warnings": doubts}
        print(json_text.dumps(report, indent=2))
    else:
        _print(path, summary(deployment), doubts)
    return 1 if doubts else 0


def summary(deployment: config.Deployment) -> dict[str, Any]:
    """Buses with their load, hands with the sizes of their pads, as plain data."""
    return {
        "sync_period_ms": deployment.daemon.sync_period_ms,
        "buses": [
            {
                "name": bus.name,
                "interface": bus.interface,
                "channel": bus.channel,
                "bitrate_bit_s": bus.bitrate_bit_s,
                "pads": len(_pads_on(deployment, bus)),
                "load": round(load_of(deployment, bus), 4),
                "burst_ms": round(_burst_ms(deployment, bus), 3),
            }
            for bus in deployment.buses
        ],
        "hands": [
            {"name": hand.name, "pads": [_pad_summary(pad) for pad in hand.pads]} for hand in deployment.hands
        ],
    }


def load_of(deployment: config.Deployment, bus: config.Bus) -> float:
    """Fraction of the bus that SYNC, samples and heartbeats take, at worst."""
    pads = _pads_on(deployment, bus)
    if not pads:
        return 0.0
    heartbeat_ms = len(pads) / sum(1 / deployment.nodes[pad.node].heartbeat_ms for pad in pads)
    return bus_load(
        bus.bitrate_bit_s, len(pads), deployment.daemon.sync_period_ms * 1e-3, heartbeat_ms * 1e-3
    )


def warnings(deployment: config.Deployment) -> Iterator[str]:
    """What is allowed, and still doubtful."""
    for bus in deployment.buses:
        yield from _bus_warnings(deployment, bus)
    for key, names in (("node", deployment.nodes), ("sheet", deployment.sheets)):
        used = {getattr(pad, key) for hand in deployment.hands for pad in hand.pads}
        for name in names:
            if name not in used:
                yield f"[{key}.{name}]: no pad uses it"
    for name, node in deployment.nodes.items():
        if node.heartbeat_timeout_ms < 2 * node.heartbeat_ms:
            yield (
                f"[node.{name}]: heartbeat_timeout_ms = {node.heartbeat_timeout_ms}: one late heartbeat of "
                f"{node.heartbeat_ms} ms makes a lost node; three periods are usual"
            )
        if node.full_scale_counts and node.full_scale_counts > (most := greatest_count(node)):
            yield (
                f"[node.{name}]: full_scale_counts = {node.full_scale_counts}: its channels count to {most} "
                "at most, so full_scale_ma is never reached; is the type of the channels right?"
            )
    yield from robot_doubts(deployment)
    for hand in deployment.hands:
        yield from _serial_warnings(hand)
        for pad in hand.pads:
            yield from _pad_warnings(f"{hand.name}/{pad.link}", pad, deployment)


def _bus_warnings(deployment: config.Deployment, bus: config.Bus) -> Iterator[str]:
    place = f'[[bus]] "{bus.name}"'
    if not _pads_on(deployment, bus):
        yield f"{place}: no pad is on it"
        return
    load, period_ms = load_of(deployment, bus), deployment.daemon.sync_period_ms
    window_ms = period_ms * deployment.daemon.window
    if load > 1:
        yield (
            f"{place}: load {load:.0%}: the bus can't carry this; raise sync_period_ms, or use another bus"
        )
    elif load > BUSY_LOAD:
        yield f"{place}: load {load:.0%}: above {BUSY_LOAD:.0%} samples come late when anything repeats"
    if _burst_ms(deployment, bus) > window_ms:
        yield (
            f"{place}: the samples take up to {_burst_ms(deployment, bus):.2f} ms after SYNC, and a tick "
            f"waits {window_ms:.2f} ms (window = {deployment.daemon.window}): the last come a period late"
        )


def _serial_warnings(hand: config.Hand) -> Iterator[str]:
    without = [pad.link for pad in hand.pads if pad.serial is None]
    if without:
        yield f"{hand.name}: no serial for {', '.join(without)}: a replaced sensor goes unnoticed"


def _pad_warnings(name: str, pad: config.Pad, deployment: config.Deployment) -> Iterator[str]:
    a, b = rectangle_mm(pad.surface)
    sheet, node = deployment.sheets[pad.sheet], deployment.nodes[pad.node]
    touch = pad.touch or deployment.touch
    if max(a / b, b / a) > POOR_ASPECT:
        long, short = ("x", "y") if a > b else ("y", "x")
        yield (
            f"{name}: {max(a / b, b / a):.1f} times longer along {long} than along {short}: the far "
            "electrodes see next to nothing, locations are poor"
        )
    if 2 * sheet.contact_radius_mm > min(a, b) / 2:
        yield (
            f"{name}: contact_radius_mm = {sheet.contact_radius_mm}: a contact covers the pad of "
            f"{min(a, b):.1f} mm, and forces are wrong near its edges"
        )
    noise_ma = node.noise_counts * node.full_scale_ma / full_scale_counts(node)
    noise_n = _force_of_current(sheet, node, 3 * noise_ma)
    if touch.off_n < noise_n:
        yield f"{name}: off_n = {touch.off_n}: below what noise alone can read, {noise_n:.3g} N"


def _force_of_current(sheet: config.Sheet, node: config.Node, current_ma: float) -> float:
    """Force [N] of the assumed contact that passes a small current [mA], which the sheet does not limit."""
    area_mm2 = math.pi * sheet.contact_radius_mm**2
    ohm = node.drive_v / (current_ma * 1e-3)
    pressure_kpa = sheet.reference_kpa * math.pow(sheet.contact_ohm_mm2 / area_mm2 / ohm, 1 / sheet.alpha)
    return pressure_kpa * 1e-3 * area_mm2


def _pads_on(deployment: config.Deployment, bus: config.Bus) -> list[config.Pad]:
    return [pad for hand in deployment.hands for pad in hand.pads if pad.bus == bus.name]


def _burst_ms(deployment: config.Deployment, bus: config.Bus) -> float:
    return burst_s(bus.bitrate_bit_s, len(_pads_on(deployment, bus))) * 1e3


def _pad_summary(pad: config.Pad) -> dict[str, Any]:
    a, b = rectangle_mm(pad.surface)
    return {
        "link": pad.link,
        "bus": pad.bus,
        "node_id": pad.node_id,
        "serial": pad.serial,
        "surface": pad.surface.kind,
        "rectangle_mm": [round(a, 2), round(b, 2)],
        "aspect": round(max(a / b, b / a), 3),
    }


def _refuse(error: config.ConfigError, json: bool) -> None:
    if json:
        problems = [
            {"place": problem.place, "value": problem.value.removeprefix(" = "), "remedy": problem.remedy}
            for problem in error.problems
        ]
        print(json_text.dumps({"file": error.file, "ok": False, "problems": problems}, indent=2))
    else:
        print(error, file=sys.stderr)


def _print(path: Path, facts: dict[str, Any], doubts: list[str]) -> None:
    print(f"{path}: {1e3 / facts['sync_period_ms']:.4g} Hz")
    for bus in facts["buses"]:
        print(
            f"  bus {bus['name']}: {bus['interface']} {bus['channel']}, "
            f"{bus['bitrate_bit_s'] / 1e3:g} kbit/s, {bus['pads']} pads, "
            f"load {bus['load']:.0%}, samples within {bus['burst_ms']:.2f} ms of SYNC"
        )
    for hand in facts["hands"]:
        print(f"  hand {hand['name']}: {len(hand['pads'])} pads")
        for pad in hand["pads"]:
            a, b = pad["rectangle_mm"]
            serial = "no serial" if pad["serial"] is None else f"serial {pad['serial']}"
            print(
                f"    {pad['link']:<16} {pad['bus']} node 0x{pad['node_id']:02X}  {pad['surface']:<8} "
                f"{a:5.1f} x {b:5.1f} mm  {serial}"
            )
    for doubt in doubts:
        print(f"  warning: {doubt}")
    if not doubts:
        print("  no warnings")
