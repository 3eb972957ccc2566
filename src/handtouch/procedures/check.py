"""Checks of a deployment beyond its syntax: objects, robot descriptions, bus load, questionable values.

Public names: `load_deployment`, `summary`, `find_warnings`, `worst_bus_load`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from handtouch import config
from handtouch.canbus.bus.load import SAMPLE_DATA_BYTES, burst_s, bus_load, frame_bits
from handtouch.canbus.nodes.spec import check_mapping, check_nodes
from handtouch.config.channels import channel_states, full_scale_counts, max_count, node_channels
from handtouch.config.eds import EdsError
from handtouch.core.channel_currents import ChannelCurrents
from handtouch.core.pad_model import contact_law, law_of
from handtouch.hand import pad_channels, pad_surface
from handtouch.hand.robot_models import check_urdfs, unchecked_items
from handtouch.host.units import GRAM_FORCE_N

MAX_USUAL_LOAD = 0.7  # share of the bit rate that leaves reserve for retransmissions
MAX_USUAL_ASPECT = 3.0  # beyond it errors along the short side grow (docs/theory.md)
MAX_USUAL_THRESHOLD_N = 1.0
MAINS_HZ = (50, 60)
MAX_TOUCH_HZ = 30.0  # faster motion of an untouched pad is hum, see `core.baseline`
"""Largest usual threshold: fingers grasp with a few newtons; the shipped hands have 0.06 N"""
MIN_USUAL_SHEET_OHM = 20.0
"""Least usual resistance of a sheet: leads of 1 ohm are 5 % of it; the paper's sheets have 2.4 and 15 kohm"""
MIN_USUAL_COUNTS = 50
"""Fewest usual counts of 1 N: with fewer, one count is 0.02 N, the shipped hands' hysteresis"""
_ANY_FORCE_N = 1e3


def load_deployment(path: Path, buses: Iterable[str] = ()) -> config.Deployment:
    """Load a deployment and check its node objects and robot descriptions too. Raises ConfigError."""
    return check_urdfs(check_nodes(config.load(path, buses), str(path)), str(path))


def summary(deployment: config.Deployment) -> dict[str, Any]:
    """Return the buses with their load and the hands with the sizes of their pads, as JSON values."""
    return {
        "sync_period_ms": deployment.daemon.sync_period_ms,
        "buses": [
            {
                "name": bus.name,
                "interface": bus.interface,
                "channel": bus.channel,
                "bitrate_bit_s": bus.bitrate_bit_s,
                "pads": len(deployment.pads_on(bus.name)),
                "load": round(worst_bus_load(deployment, bus), 4),
                "burst_ms": round(_burst_ms(deployment, bus), 3),
            }
            for bus in deployment.buses
        ],
        "hands": [
            {"name": hand.name, "pads": [_pad_summary(pad, deployment) for pad in hand.pads]}
            for hand in deployment.hands
        ],
    }


def worst_bus_load(deployment: config.Deployment, bus: config.Bus) -> float:
    """Return the fraction of a bus that SYNC, samples and heartbeats take with worst-case bit stuffing."""
    pads = [entry.pad for entry in deployment.pads_on(bus.name)]
    if not pads:
        return 0.0
    heartbeat_ms = len(pads) / sum(1 / deployment.nodes[pad.node].heartbeat_ms for pad in pads)
    period_s = deployment.daemon.sync_period_ms * 1e-3
    further_bits = _further_bits(deployment, bus)
    return bus_load(bus.bitrate_bit_s, len(pads), period_s, heartbeat_ms * 1e-3, further_bits)


def _further_bits(deployment: config.Deployment, bus: config.Bus) -> int:
    """Return the bits on a bus of the second and later TPDOs of all its pads, in a cycle."""
    total = 0
    for _, pad in deployment.pads_on(bus.name):
        if pad.switch_states:  # one state, and one TPDO, in each cycle
            continue
        size = math.ceil(sum(channel.bits for channel in node_channels(deployment.nodes[pad.node])) / 8)
        for first in range(SAMPLE_DATA_BYTES, size, SAMPLE_DATA_BYTES):
            total += frame_bits(min(SAMPLE_DATA_BYTES, size - first))
    return total


def find_warnings(deployment: config.Deployment) -> Iterator[str]:
    """Yield what is valid but questionable."""
    for bus in deployment.buses:
        yield from _bus_warnings(deployment, bus)
    keys = (("node", deployment.nodes, ("node",)), ("sheet", deployment.sheets, ("sheet", "second_sheet")))
    for key, names, of_pad in keys:
        used = {getattr(pad, one) for _, pad in deployment.pads for one in of_pad}
        for name in names:
            if name not in used:
                yield f"[{key}.{name}]: no pad uses it"
    responses = [pad.response for _, pad in deployment.pads]
    for name, response in deployment.responses.items():
        if response not in responses:
            yield f"[response.{name}]: no pad uses it"
    for name, node in deployment.nodes.items():
        if node.heartbeat_timeout_ms < 2 * node.heartbeat_ms:
            yield (
                f"[node.{name}]: heartbeat_timeout_ms = {node.heartbeat_timeout_ms}: less than two heartbeat "
                f"periods of {node.heartbeat_ms} ms, so one late heartbeat is a timeout; three are usual"
            )
        if node.full_scale_counts and node.full_scale_counts > (limit := max_count(node)):
            yield (
                f"[node.{name}]: full_scale_counts = {node.full_scale_counts}: its channels reach at most "
                f"{limit}, so full_scale_ma is never reached; check the type of the channels"
            )
    yield from _hum_warnings(deployment.daemon.sync_period_ms)
    yield from _mapping_warnings(deployment)
    yield from unchecked_items(deployment)
    for hand in deployment.hands:
        yield from _serial_warnings(hand)
    alike: dict[str, list[str]] = {}
    for entry in deployment.pads:
        for text in _pad_warnings(entry.pad, deployment):
            alike.setdefault(text, []).append(entry.name)
    for text, pads in alike.items():
        yield f"{', '.join(pads)}: {text}"


def _hum_warnings(period_ms: float) -> Iterator[str]:
    """Warn where samples show the mains' hum as motion that is as slow as touches."""
    rate_hz = 1e3 / period_ms
    apparent_hz = {f: abs(f - rate_hz * round(f / rate_hz)) for f in MAINS_HZ}
    slow = {f: at for f, at in apparent_hz.items() if at < MAX_TOUCH_HZ}
    if slow:
        seen = " and ".join(f"{f} Hz as {at:.3g} Hz" for f, at in slow.items())
        longest_ms = 1e3 / (max(MAINS_HZ) + MAX_TOUCH_HZ)
        yield (
            f"[daemon]: sync_period_ms = {period_ms:g}: hum of the mains reads {seen}, as slow as touches, "
            f"so it can't be told from them; periods up to {longest_ms:.0f} ms tell them apart"
        )


def _bus_warnings(deployment: config.Deployment, bus: config.Bus) -> Iterator[str]:
    location = f'[[bus]] "{bus.name}"'
    if not deployment.pads_on(bus.name):
        yield f"{location}: no pad is on it"
        return
    load, period_ms = worst_bus_load(deployment, bus), deployment.daemon.sync_period_ms
    window_ms = period_ms * deployment.daemon.sample_window_fraction
    if load > 1:
        yield f"{location}: load {load:.0%}: exceeds the bus; raise sync_period_ms, or use another bus"
    elif load > MAX_USUAL_LOAD:
        yield f"{location}: load {load:.0%}: above {MAX_USUAL_LOAD:.0%} retransmissions delay samples"
    if _burst_ms(deployment, bus) > window_ms:
        yield (
            f"{location}: the samples take up to {_burst_ms(deployment, bus):.2f} ms after SYNC, and a tick "
            f"waits {window_ms:.2f} ms (sample_window_fraction = "
            f"{deployment.daemon.sample_window_fraction}): the last ones are used one period late"
        )


def _mapping_warnings(deployment: config.Deployment) -> Iterator[str]:
    """Yield what EDS files have instead of the channels; of a listener that is an error of the file."""
    asked = {bus.name for bus in deployment.buses if bus.role != "listener"}
    pads = (pad for _, pad in deployment.pads if pad.bus in asked and deployment.nodes[pad.node].eds)
    for pad in {(pad.node, channel_states(pad)): pad for pad in pads}.values():
        node = deployment.nodes[pad.node]
        try:
            check_mapping(node, pad)
        except EdsError as error:
            remapped = "has them mapped over SDO when it boots" if node.allow_pdo_remapping else "is faulted"
            yield f"[node.{pad.node}]: {error}; a node with this mapping {remapped}"


def _serial_warnings(hand: config.HandTable) -> Iterator[str]:
    without = [pad.link for pad in hand.pads if pad.serial is None]
    if without:
        yield f"{hand.name}: no serial for {', '.join(without)}: replaced sensors are not detected"


def _pad_warnings(pad: config.Pad, deployment: config.Deployment) -> Iterator[str]:
    a, b = pad.surface.rectangle_mm
    sheet, node = deployment.sheet_of(pad), deployment.nodes[pad.node]
    touch = deployment.touch_of(pad)
    has_electrodes = pad.response is None
    if (
        has_electrodes and not pad.arcs_mm and max(a / b, b / a) > MAX_USUAL_ASPECT
    ):  # electrodes on arcs are anywhere
        long, short = ("x", "y") if a > b else ("y", "x")
        yield (
            f"{max(a / b, b / a):.1f} times longer along {long} than along {short}: the far "
            "electrodes carry almost no current, so positions are inaccurate"
        )
    if has_electrodes and 2 * sheet.contact_radius_mm > min(a, b) / 2:
        yield (
            f"contact_radius_mm = {sheet.contact_radius_mm}: large for a pad of "
            f"{min(a, b):.1f} mm, so forces are wrong near its edges"
        )
    noise_ma = node.noise_counts * node.full_scale_ma / full_scale_counts(node)
    noise_n = _force_of_current(sheet, node, 3 * noise_ma)
    if touch.end_threshold_n < noise_n:
        yield (
            f"end_threshold_n = {touch.end_threshold_n}: below the force that noise alone can read, "
            f"{noise_n:.3g} N"
        )
    limit_n = min(MAX_USUAL_THRESHOLD_N, sheet.max_force_n or math.inf)
    if touch.begin_threshold_n > limit_n:
        bound = "max_force_n" if limit_n == sheet.max_force_n else f"{limit_n:g} N"
        yield (
            f"begin_threshold_n = {touch.begin_threshold_n}: above {bound}, so most touches aren't noticed; "
            f"forces are in newtons, and 1 gram-force is {GRAM_FORCE_N:.4f} N"
        )
    yield from _electronics_warnings(pad, node, sheet)


def _electronics_warnings(pad: config.Pad, node: config.Node, sheet: config.Sheet) -> Iterator[str]:
    """Warn where the electronics don't fit the sheet, as with a value in another unit."""
    full_scale_a = 1e-3 * node.full_scale_ma * min(node.channel_scale) / pad.state_count
    counts = _currents(pad, node, sheet).middle(1.0) / full_scale_a * full_scale_counts(node)
    hint = (
        f"check the units of full_scale_ma = {node.full_scale_ma} (mA), drive_v = {node.drive_v} (V), "
        f"ohm_per_square = {sheet.ohm_per_square} (ohm), contact_ohm_mm2 = {sheet.contact_ohm_mm2} (ohm mm2)"
    )
    if node.full_scale is not None:
        hint = f"check that full_scale = {node.full_scale} ({node.unit}) and signal_per_n have the same unit"
    if counts < MIN_USUAL_COUNTS:
        yield f"1 N in the pad's middle reads fewer than {MIN_USUAL_COUNTS} counts; {hint}"
    elif counts > full_scale_counts(node):
        yield f"1 N in the pad's middle exceeds the full scale of the channels; {hint}"
    if node.full_scale is None and sheet.ohm_per_square < MIN_USUAL_SHEET_OHM:
        yield (
            f"ohm_per_square = {sheet.ohm_per_square}: below {MIN_USUAL_SHEET_OHM} ohm the leads share the "
            "currents with the sheet; check the unit"
        )


def _force_of_current(sheet: config.Sheet, node: config.Node, current_ma: float) -> float:
    """Return the force [N] of the assumed contact at a current [mA] too small for the sheet to limit it."""
    area_mm2 = math.pi * sheet.contact_radius_mm**2
    ohm = node.drive_v / (current_ma * 1e-3)
    pressure_kpa = sheet.reference_kpa * math.pow(sheet.contact_ohm_mm2 / area_mm2 / ohm, 1 / sheet.alpha)
    return pressure_kpa * 1e-3 * area_mm2


def _burst_ms(deployment: config.Deployment, bus: config.Bus) -> float:
    pads = len(deployment.pads_on(bus.name))
    return burst_s(bus.bitrate_bit_s, pads, _further_bits(deployment, bus)) * 1e3


def _pad_summary(pad: config.Pad, deployment: config.Deployment) -> dict[str, Any]:
    a, b = pad.surface.rectangle_mm
    length_m, width_m = pad.surface.build().extent_m
    sheet, node = deployment.sheet_of(pad), deployment.nodes[pad.node]
    force_n, force_at, needed_ma = _range(pad, node, sheet)
    needed = {"needed_full_scale_ma": round(needed_ma, 2)}
    if node.full_scale is not None:  # no current
        needed = {"needed_full_scale": round(1e-3 * needed_ma, 4)}
    return {
        "link": pad.link,
        "bus": pad.bus,
        "node_id": pad.node_id,
        "serial": pad.serial,
        "surface": pad.surface.kind,
        "size_mm": [round(1e3 * length_m, 2), round(1e3 * width_m, 2)],
        "rectangle_mm": [round(a, 2), round(b, 2)],
        "aspect": round(max(a / b, b / a), 3),
        "measured_force_n": None if math.isinf(force_n) else round(force_n, 2),
        "measured_force_electrode": force_at,
        **needed,
    }


def _range(pad: config.Pad, node: config.Node, sheet: config.Sheet) -> tuple[float, str, float]:
    """Return the force up to which no channel reaches its full scale anywhere on the pad, beside which
    electrode one then does, and the full scale [mA] that the pad needs for `max_force_n`, or any force."""
    currents = _currents(pad, node, sheet)
    ratio = min(node.channel_scale) / pad.state_count
    force_n, peak = currents.measured_force(1e-3 * node.full_scale_ma * ratio)
    greatest_a = currents.peak(sheet.max_force_n or _ANY_FORCE_N).current_a
    return force_n, pad.electrode_names[peak.electrode], 1e3 * greatest_a / ratio


def _currents(pad: config.Pad, node: config.Node, sheet: config.Sheet) -> ChannelCurrents:
    return ChannelCurrents(
        pad_channels(pad, sheet, node),
        pad_surface(pad),
        contact_law(sheet, law_of(sheet)),
        node.drive_v,
        sheet.ohm_per_square,
    )
