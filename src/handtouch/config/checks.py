"""What no single key of a deployment shows: names used twice, references to nothing, shapes that can't be.

Public names: `problems_in`, `rectangle_mm`, `UDP_MULTICAST_PORT`.
"""

from __future__ import annotations

import ipaddress
import json
import math
import re
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from handtouch.config.problems import Problem
from handtouch.config.tables import Bus, Daemon, Deployment, Node, Pad, Surface, Touch

UDP_MULTICAST_PORT = 43113
"""python-can's port of a udp_multicast bus that names none."""


def problems_in(deployment: Deployment) -> Iterator[Problem]:
    """Every mistake of a deployment whose tables are right one by one."""
    yield from _check_endpoints(deployment.daemon)
    yield from _check_names("[[bus]]", "name", [bus.name for bus in deployment.buses])
    yield from _check_buses(deployment.buses)
    for name, node in deployment.nodes.items():
        yield from _check_node(f"[node.{name}]", node)
    yield from _check_touch("[touch]: ", deployment.touch)
    yield from _check_names("[[hand]]", "name", [hand.name for hand in deployment.hands])
    yield from _check_scene(deployment)
    taken: dict[tuple[str, int], str] = {}
    owners: dict[int, str] = {}
    for hand in deployment.hands:
        yield from _check_names("[[hand.pad]]", "link", [pad.link for pad in hand.pads])
        for number, pad in enumerate(hand.pads, 1):
            name = f"{hand.name}/{pad.link}"
            place = f'[[hand.pad]] {number} "{name}": '
            yield from _check_references(place, pad, deployment)
            yield from _check_shape(place, pad)
            if len(set(pad.electrodes)) < 4:
                yield Problem(
                    f"{place}electrodes", _is(pad.electrodes), "must name each of x0, xa, y0, yb once"
                )
            if pad.touch:
                yield from _check_touch(f"{place}touch.", pad.touch)
            if (pad.bus, pad.node_id) in taken:
                yield Problem(
                    f"{place}node_id",
                    f" = {pad.node_id}",
                    f'is already the node of "{taken[pad.bus, pad.node_id]}" on bus "{pad.bus}"; '
                    "every node needs an id of its own",
                )
            taken.setdefault((pad.bus, pad.node_id), name)
            if pad.serial is not None and owners.setdefault(pad.serial, name) != name:
                yield Problem(
                    f"{place}serial",
                    f" = {pad.serial}",
                    f'is already that of "{owners[pad.serial]}"; a serial number belongs to one node',
                )


def _check_scene(deployment: Deployment) -> Iterator[Problem]:
    names = [f"{hand.name}/{pad.link}" for hand in deployment.hands for pad in hand.pads]
    for pattern in deployment.scene.links:
        full = pattern if "/" in pattern else f"*/{pattern}"
        if not any(fnmatchcase(name, full) for name in names):
            yield Problem("[scene]: links", _is(pattern), f"matches no pad; there are {', '.join(names)}")


def rectangle_mm(surface: Surface) -> tuple[float, float]:
    """Sides (a, b) [mm] of the conformal rectangle of a pad, as `handtouch.field.surface` has them.

    A surface of revolution of radius r(s) is scaled by its radius half way, r_mid: a = r_mid * integral of
    ds / r(s), b = r_mid * angle. NaN for a cone or sphere that doesn't exist. In plain arithmetic, so that a
    deployment loads without the numerical packages.
    """
    if surface.kind == "plane":
        return surface.length_mm, surface.width_mm
    arc = math.radians(surface.arc_deg)
    if surface.kind == "cylinder":
        return surface.length_mm, surface.radius_mm * arc
    if surface.kind == "cone":
        near, far = surface.near_radius_mm, surface.far_radius_mm
        middle = (near + far) / 2
        growth = (far - near) / near
        stretch = math.log1p(growth) / growth if growth else 1.0
        return surface.slant_mm * stretch * middle / near, middle * arc
    start, end = math.radians(surface.from_deg), math.radians(surface.to_deg)
    middle = surface.radius_mm * math.cos((start + end) / 2)
    return middle * (math.asinh(math.tan(end)) - math.asinh(math.tan(start))), middle * arc


def _check_names(section: str, key: str, names: list[str]) -> Iterator[Problem]:
    for number, name in enumerate(names, 1):
        if name in names[: number - 1]:
            yield Problem(f"{section} {number}: {key}", _is(name), "is used twice; names must differ")


def _check_endpoints(daemon: Daemon) -> Iterator[Problem]:
    if daemon.keys is not None and not Path(daemon.keys).is_dir():
        yield Problem(
            "[daemon]: keys",
            _is(daemon.keys),
            f"no such folder; `handtouch keys make {daemon.keys or 'keys'}` makes it",
        )
    if daemon.metrics is not None and (trouble := _metrics_trouble(daemon.metrics)):
        yield Problem("[daemon]: metrics", _is(daemon.metrics), trouble)
    seen: dict[str, str] = {}
    for key in ("live", "complete", "control", "inputs"):
        endpoint = getattr(daemon, key)
        place, value = f"[daemon]: {key}", _is(endpoint)
        same = endpoint.replace("//localhost:", "//127.0.0.1:").replace("//0.0.0.0:", "//*:")
        if trouble := _endpoint_trouble(endpoint, daemon.keys is not None):
            yield Problem(place, value, trouble)
        elif other := _taken(same, seen):
            yield Problem(place, value, f"is the endpoint of {other} too; give each its own")
        seen.setdefault(same, key)


def _taken(endpoint: str, seen: dict[str, str]) -> str:
    """Which endpoint is this one, or takes its port on all interfaces or on one of them."""
    host, _, port = endpoint.rpartition(":")
    if port == "*":
        return ""
    for known, key in seen.items():
        on, _, theirs = known.rpartition(":")
        if known == endpoint or (port == theirs and "tcp://*" in (host, on)):
            return key
    return ""


def _endpoint_trouble(endpoint: str, keys: bool) -> str:
    """What is wrong with a ZeroMQ endpoint, with what would be right; empty if nothing is."""
    transport, _, address = endpoint.partition("://")
    if transport == "ipc" and address:
        return ""
    if transport != "tcp" or not address:
        return "must be a ZeroMQ endpoint such as tcp://127.0.0.1:5580 or ipc:///run/handtouch/hand/live"
    host, colon, port = address.rpartition(":")
    if not colon:
        return f"needs a port: tcp://{address}:5580, or :* for any that is free"
    if port != "*" and not (port.isascii() and port.isdigit() and 1 <= int(port[:6]) <= 65535):
        return "must end in a port, 1 to 65535, or * for any that is free"
    if not keys and not _is_loopback(host):
        return (
            "reaches beyond this machine; only loopback (127.0.0.1) is open without keys: make some with "
            '`handtouch keys make FOLDER` beside this file, and give keys = "FOLDER" in [daemon]'
        )
    if not re.fullmatch(r"\*|[A-Za-z0-9][A-Za-z0-9_.\-]*", host):
        return "needs the IPv4 address or the name of a network interface, such as eth0, or * for all"
    return ""


def _metrics_trouble(address: str) -> str:
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and int(port[:6]) <= 65535):
        return "must be HOST:PORT such as 127.0.0.1:9580"
    if not _is_loopback(host):
        return (
            "reaches beyond this machine, and whoever asks gets an answer: keys don't guard HTTP; give "
            f"127.0.0.1:{port}, and let a proxy with TLS or an SSH tunnel carry it to others"
        )
    return ""


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.IPv4Address(host).is_loopback  # the sockets do without IPv6
    except ValueError:
        return False


def _check_buses(buses: Iterable[Bus]) -> Iterator[Problem]:
    from can.interfaces import VALID_INTERFACES  # costs 0.1 s, and only a deployment needs it

    seen: dict[str, str] = {}
    for number, bus in enumerate(buses, 1):
        place = f'[[bus]] {number} "{bus.name}": '
        if bus.interface not in VALID_INTERFACES:
            known = ", ".join(sorted(VALID_INTERFACES))
            yield Problem(f"{place}interface", _is(bus.interface), f"python-can knows {known}")
        if bus.interface == "udp_multicast" and not _is_multicast(str(bus.channel)):
            yield Problem(
                f"{place}channel", _is(bus.channel), "must be a multicast address such as 239.74.163.2"
            )
        if bus.interface == "udp_multicast":
            yield from _check_port(place, bus, seen)
            continue
        wire = json.dumps([bus.interface, bus.channel])
        if wire in seen:
            yield Problem(
                f"{place}channel", _is(bus.channel), f'is the wire of bus "{seen[wire]}" too; name each once'
            )
        seen.setdefault(wire, bus.name)


def _check_port(place: str, bus: Bus, seen: dict[str, str]) -> Iterator[Problem]:
    """A socket of udp_multicast hears every group on its port, so the port alone makes a wire."""
    port = bus.options.get("port", UDP_MULTICAST_PORT)
    if isinstance(port, bool) or not isinstance(port, int) or not 1 <= port <= 65535:
        yield Problem(f"{place}options.port", _is(port), "must be a UDP port, 1 to 65535")
        return
    wire = f"udp port {port}"
    if wire in seen:
        free = next(p for p in range(UDP_MULTICAST_PORT, 65536) if f"udp port {p}" not in seen)
        told = f" = {port}" if "port" in bus.options else ""
        yield Problem(
            f"{place}options.port",
            told,
            f'bus "{seen[wire]}" has UDP port {port} too, and groups don\'t separate buses on one port; '
            f"give each its own, e.g. options = {{ port = {free} }}",
        )
    seen.setdefault(wire, bus.name)


def _is_multicast(channel: str) -> bool:
    try:
        return ipaddress.ip_address(channel).is_multicast
    except ValueError:
        return False


def _check_node(place: str, node: Node) -> Iterator[Problem]:
    if node.heartbeat_timeout_ms <= node.heartbeat_ms:
        yield Problem(
            f"{place}: heartbeat_timeout_ms",
            _is(node.heartbeat_timeout_ms),
            f"must be longer than heartbeat_ms = {node.heartbeat_ms}; three times it is usual",
        )
    if node.eds and not Path(node.eds).is_file():
        yield Problem(
            f"{place}: eds",
            _is(node.eds),
            "no such file; give its path, starting at the folder of the deployment file",
        )


def _check_touch(place: str, touch: Touch) -> Iterator[Problem]:
    if touch.off_n >= touch.on_n:
        yield Problem(
            f"{place}off_n", _is(touch.off_n), f"must be below on_n = {touch.on_n}, or contacts flicker"
        )


def _check_references(place: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    known = (
        ("bus", "[[bus]]", [bus.name for bus in deployment.buses]),
        ("node", "[node.NAME]", list(deployment.nodes)),
        ("sheet", "[sheet.NAME]", list(deployment.sheets)),
    )
    for key, header, names in known:
        value = getattr(pad, key)
        if value not in names:
            there = f"there are: {', '.join(names)}" if names else "there are none"
            yield Problem(f"{place}{key}", _is(value), f"no {header} of that name; {there}")


def _check_shape(place: str, pad: Pad) -> Iterator[Problem]:
    """What the geometry of a pad forbids."""
    surface = pad.surface
    if surface.kind == "cone" and surface.slant_mm < abs(surface.far_radius_mm - surface.near_radius_mm):
        least = abs(surface.far_radius_mm - surface.near_radius_mm)
        yield Problem(
            f"{place}surface.slant_mm",
            _is(surface.slant_mm),
            f"no cone has that shape; it must be at least the difference of the two radii, {least:.4g}",
        )
        return
    if surface.kind == "sphere" and surface.to_deg <= surface.from_deg:
        yield Problem(
            f"{place}surface.to_deg", _is(surface.to_deg), f"must be above from_deg = {surface.from_deg}"
        )
        return
    side = min(_sides_mm(surface))
    if not 2 * pad.gap_mm < side:
        yield Problem(
            f"{place}gap_mm",
            _is(pad.gap_mm),
            f"leaves no electrode on a side of {side:.4g} mm; it must be below {side / 2:.4g}",
        )
    if pad.gap_mm == 0 and any(pad.series_ohm):
        yield Problem(
            f"{place}gap_mm",
            _is(pad.gap_mm),
            "electrodes that touch share their currents, so series_ohm needs a gap; give the bare length",
        )


def _sides_mm(surface: Surface) -> tuple[float, ...]:
    """Lengths of a pad's sides along its surface."""
    if surface.kind == "plane":
        return surface.length_mm, surface.width_mm
    arc = math.radians(surface.arc_deg)
    if surface.kind == "cylinder":
        return surface.length_mm, surface.radius_mm * arc
    if surface.kind == "cone":
        return surface.slant_mm, surface.near_radius_mm * arc, surface.far_radius_mm * arc
    latitudes = math.radians(surface.from_deg), math.radians(surface.to_deg)
    around = [surface.radius_mm * math.cos(latitude) * arc for latitude in latitudes]
    return surface.radius_mm * (latitudes[1] - latitudes[0]), *around


def _is(value: object) -> str:
    return f" = {json.dumps(value, ensure_ascii=False)}"
