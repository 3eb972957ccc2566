"""Checks across the tables of a deployment: duplicate names, unknown references, impossible shapes.

Public names: `problems_in`, `problems_in_buses`, `endpoint_problem`, `UDP_MULTICAST_PORT`.
"""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from handtouch.config.base import MAX_CHANNELS, MIN_CHANNELS
from handtouch.config.meshes import surface_triangles
from handtouch.config.problems import Problem, suggest_name
from handtouch.config.responses import ResponseTable, presses_of
from handtouch.config.roles import CHANNEL_ROLES, channel_count
from handtouch.config.shear import Shear
from handtouch.config.surfaces import film_of
from handtouch.config.tables import (
    SIDE_ELECTRODES,
    Bus,
    Daemon,
    Deployment,
    Node,
    Pad,
    Touch,
)
from handtouch.config.units import pad_unit_problems, unit_problems
from handtouch.field.surface_base import MIN_CLEARANCE, SURFACES, surface_keys
from handtouch.host.endpoints import is_loopback

UDP_MULTICAST_PORT = 43113
"""python-can's default port of a udp_multicast bus."""
_SURFACES_ABOVE_SHEAR = ("plane", "cylinder", "cone", "sphere", "revolution")
_MAX_VALUE_LENGTH = 60  # of a text in an error: embedded files are longer
_MAX_BESIDE = 0.2  # of a side, that places where a film was measured may be beside the pad
_MAX_MEAN_RATIO = 1.5  # of a film's mean resistance and the stated one: three standard deviations of films
_SIDE_KEYS = ("gap_mm", "gap_offsets_mm", "series_ohm")  # 0 where there are no electrodes
MIN_ALPHA_DIFFERENCE = 0.2
"""Of two sheets: below it, errors of alpha (0.05 each as stated by default) leave the radius open"""
_MAX_OVERLAP_MM = 1e-6  # rounding where arcs end in one point


def problems_in(deployment: Deployment) -> Iterator[Problem]:
    """Yield the errors of a deployment whose tables are valid one by one."""
    yield from _check_endpoints(deployment.daemon)
    yield from problems_in_buses(deployment.buses)
    for name, node in deployment.nodes.items():
        yield from _check_node(f"[node.{name}]", node)
    for name, shear in deployment.shears.items():
        yield from _check_shear(f"[shear.{name}]", shear)
    yield from _check_touch("[touch]: ", deployment.touch)
    yield from _check_names("[[hand]]", "name", [hand.name for hand in deployment.hands])
    yield from _check_scene(deployment)
    yield from _check_objects(deployment)
    yield from unit_problems(deployment)
    taken: dict[tuple[str, int], str] = {}
    owners: dict[int, str] = {}
    for hand in deployment.hands:
        yield from _check_names("[[hand.pad]]", "link", [pad.link for pad in hand.pads])
        for number, pad in enumerate(hand.pads, 1):
            name = f"{hand.name}/{pad.link}"
            location = f'[[hand.pad]] {number} "{name}": '
            yield from _check_references(location, pad, deployment)
            if not isinstance(pad.response, str):  # of which nothing is known
                in_wrong_unit = list(pad_unit_problems(location, pad))
                yield from in_wrong_unit or _check_shape(location, pad, deployment)
                yield from _check_electrodes(location, pad, deployment)
            yield from _check_schedule(location, pad, deployment)
            yield from _check_shear_pad(location, pad)
            yield from _check_second_sheet(location, pad, deployment)
            if pad.touch:
                yield from _check_touch(f"{location}touch.", pad.touch)
            if (pad.bus, pad.node_id) in taken:
                yield Problem(
                    f"{location}node_id",
                    f" = {pad.node_id}",
                    f'is already the node id of "{taken[pad.bus, pad.node_id]}" on bus "{pad.bus}"; '
                    "node ids must be unique on a bus",
                )
            taken.setdefault((pad.bus, pad.node_id), name)
            if pad.serial is not None and owners.setdefault(pad.serial, name) != name:
                yield Problem(
                    f"{location}serial",
                    f" = {pad.serial}",
                    f'is already that of "{owners[pad.serial]}"; serial numbers must be unique',
                )


def problems_in_buses(buses: Sequence[Bus]) -> Iterator[Problem]:
    """Yield the errors of buses: names used twice, unknown interfaces, one channel for two buses."""
    yield from _check_names("[[bus]]", "name", [bus.name for bus in buses])
    yield from _check_buses(buses)


def _check_scene(deployment: Deployment) -> Iterator[Problem]:
    for pattern in deployment.scene.links:
        if not deployment.rows_matching(pattern):
            pads = ", ".join(deployment.pad_names)
            yield Problem("[scene]: links", _format_value(pattern), f"matches no pad; pads: {pads}")


def _check_objects(deployment: Deployment) -> Iterator[Problem]:
    for number, hand in enumerate(deployment.hands, 1):
        if hand.object is not None and hand.object not in deployment.objects:
            hint = suggest_name(hand.object, list(deployment.objects))
            known = ", ".join(deployment.objects) or "none"
            yield Problem(
                f'[[hand]] {number} "{hand.name}": object',
                f" = {json.dumps(hand.object)}",
                f"there is no [object.{hand.object}]; {hint}known: {known}",
            )
    for name, entry in deployment.objects.items():
        if entry.shape.kind == "bolt" and entry.shape.head_diameter_mm <= entry.shape.diameter_mm:
            yield Problem(
                f"[object.{name}]: shape.head_diameter_mm",
                f" = {entry.shape.head_diameter_mm:g}",
                "must be more than diameter_mm; a bolt without a head is a cylinder",
            )
        if entry.shape.kind == "mesh":
            try:
                surface_triangles(entry.shape.file, 1.0)
            except ValueError as error:
                yield Problem(f"[object.{name}]: shape.file", _format_value(entry.shape.file), str(error))


def _check_names(section: str, key: str, names: list[str]) -> Iterator[Problem]:
    for number, name in enumerate(names, 1):
        if name in names[: number - 1]:
            yield Problem(
                f"{section} {number}: {key}", _format_value(name), "is used twice; names must differ"
            )


def _check_endpoints(daemon: Daemon) -> Iterator[Problem]:
    if daemon.keys is not None and not Path(daemon.keys).is_dir():
        yield Problem(
            "[daemon]: keys",
            _format_value(daemon.keys),
            f"no such folder; create it with `handtouch keys make {daemon.keys or 'keys'}`",
        )
    if daemon.metrics is not None and (error := _metrics_problem(daemon.metrics)):
        yield Problem("[daemon]: metrics", _format_value(daemon.metrics), error)
    seen: dict[str, str] = {}
    for key in ("live", "complete", "control", "inputs"):
        endpoint = getattr(daemon, key)
        location, value = f"[daemon]: {key}", _format_value(endpoint)
        same = endpoint.replace("//localhost:", "//127.0.0.1:").replace("//0.0.0.0:", "//*:")
        if error := endpoint_problem(endpoint, daemon.keys is not None):
            yield Problem(location, value, error)
        elif other := _conflicting_endpoint(same, seen):
            yield Problem(location, value, f"is also the endpoint of {other}; give each its own")
        seen.setdefault(same, key)


def _conflicting_endpoint(endpoint: str, seen: dict[str, str]) -> str:
    """Return the key of an endpoint that is the same, or has the same port on a common interface; else ''."""
    host, _, port = endpoint.rpartition(":")
    if port == "*":
        return ""
    for known, key in seen.items():
        on, _, theirs = known.rpartition(":")
        if known == endpoint or (port == theirs and "tcp://*" in (host, on)):
            return key
    return ""


def endpoint_problem(endpoint: str, keys: bool) -> str:
    """Return the error of a ZeroMQ endpoint with its remedy; empty if it is valid."""
    transport, _, address = endpoint.partition("://")
    if transport == "ipc" and address:
        return ""
    if transport != "tcp" or not address:
        return "must be a ZeroMQ endpoint such as tcp://127.0.0.1:5580 or ipc:///run/handtouch/hand/live"
    host, colon, port = address.rpartition(":")
    if not colon:
        return f"needs a port: tcp://{address}:5580, or :* for any free one"
    if port != "*" and not (port.isascii() and port.isdigit() and 1 <= int(port[:6]) <= 65535):
        return "must end in a port, 1 to 65535, or * for any free one"
    if not keys and not _is_ipv4_loopback(host):
        return (
            "is reachable from other machines, which requires CURVE keys: create them beside this file with "
            '`handtouch keys make FOLDER` and set keys = "FOLDER" in [daemon], or use loopback (127.0.0.1)'
        )
    if not re.fullmatch(r"\*|[A-Za-z0-9][A-Za-z0-9_.\-]*", host):
        return "needs the IPv4 address or the name of a network interface, such as eth0, or * for all"
    return ""


def _metrics_problem(address: str) -> str:
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and int(port[:6]) <= 65535):
        return "must be HOST:PORT such as 127.0.0.1:9580"
    if not _is_ipv4_loopback(host):
        return (
            "is reachable from other machines, and CURVE keys don't protect HTTP; use "
            f"127.0.0.1:{port}, and a TLS proxy or an SSH tunnel for other machines"
        )
    return ""


def _is_ipv4_loopback(host: str) -> bool:
    return ":" not in host and is_loopback(host)  # the sockets use IPv4 only


def _check_buses(buses: Iterable[Bus]) -> Iterator[Problem]:
    from can.interfaces import VALID_INTERFACES  # takes 0.1 s: only for deployments

    seen: dict[str, str] = {}
    for number, bus in enumerate(buses, 1):
        location = f'[[bus]] {number} "{bus.name}": '
        if bus.interface not in VALID_INTERFACES:
            known = sorted(VALID_INTERFACES)
            remedy = f"{suggest_name(bus.interface, known)}python-can knows {', '.join(known)}"
            yield Problem(f"{location}interface", _format_value(bus.interface), remedy)
        if bus.interface == "udp_multicast" and not _is_multicast(str(bus.channel)):
            yield Problem(
                f"{location}channel",
                _format_value(bus.channel),
                "must be a multicast address such as 239.74.163.2",
            )
        if bus.interface == "udp_multicast":
            yield from _check_port(location, bus, seen)
            continue
        medium = json.dumps([bus.interface, bus.channel])
        if medium in seen:
            yield Problem(
                f"{location}channel",
                _format_value(bus.channel),
                f'is also the channel of bus "{seen[medium]}"; list each channel once',
            )
        seen.setdefault(medium, bus.name)


def _check_port(location: str, bus: Bus, seen: dict[str, str]) -> Iterator[Problem]:
    """Check the UDP port: a socket receives every multicast group on its port, so ports separate buses."""
    port = bus.options.get("port", UDP_MULTICAST_PORT)
    if isinstance(port, bool) or not isinstance(port, int) or not 1 <= port <= 65535:
        yield Problem(f"{location}options.port", _format_value(port), "must be a UDP port, 1 to 65535")
        return
    medium = f"udp port {port}"
    if medium in seen:
        free = next(p for p in range(UDP_MULTICAST_PORT, 65536) if f"udp port {p}" not in seen)
        value = f" = {port}" if "port" in bus.options else ""
        yield Problem(
            f"{location}options.port",
            value,
            f'bus "{seen[medium]}" has UDP port {port} too, and multicast groups don\'t separate buses; '
            f"give each its own port, e.g. options = {{ port = {free} }}",
        )
    seen.setdefault(medium, bus.name)


def _is_multicast(channel: str) -> bool:
    try:
        return ipaddress.ip_address(channel).is_multicast
    except ValueError:
        return False


def _check_node(location: str, node: Node) -> Iterator[Problem]:
    if node.heartbeat_timeout_ms <= node.heartbeat_ms:
        yield Problem(
            f"{location}: heartbeat_timeout_ms",
            _format_value(node.heartbeat_timeout_ms),
            f"must be longer than heartbeat_ms = {node.heartbeat_ms}; usually three times as long",
        )
    if (node.unit is None) != (node.full_scale is None):
        key, other = ("unit", "full_scale") if node.full_scale is None else ("full_scale", "unit")
        yield Problem(f"{location}: {key}", _format_value(getattr(node, key)), f"goes with {other}; add that")
    if node.full_scale is not None and node.full_scale_ma != 1e3 * node.full_scale:
        yield Problem(
            f"{location}: full_scale_ma",
            _format_value(node.full_scale_ma),
            "is for currents, and full_scale for other signals; leave one of them out",
        )
    lists: dict[str, Sequence[object]] = {"channel_scale": node.channel_scale}
    if node.idle is not None:
        lists["idle.delta_objects"] = node.idle.delta_objects
    for key, values in lists.items():
        if len(values) != len(node.channels):
            remedy = f"needs {len(node.channels)} values, one for each of channels, has {len(values)}"
            yield Problem(f"{location}: {key}", _format_value(values), remedy)
    if node.eds and not Path(node.eds).is_file():
        yield Problem(
            f"{location}: eds",
            _format_value(node.eds),
            "no such file; give its path relative to the folder of the deployment file",
        )


def _check_touch(location: str, touch: Touch) -> Iterator[Problem]:
    if touch.end_threshold_n >= touch.begin_threshold_n:
        yield Problem(
            f"{location}end_threshold_n",
            _format_value(touch.end_threshold_n),
            f"must be below begin_threshold_n = {touch.begin_threshold_n}, or contacts flicker",
        )


def _check_references(location: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    known = (
        ("bus", "[[bus]]", [bus.name for bus in deployment.buses]),
        ("node", "[node.NAME]", list(deployment.nodes)),
        ("sheet", "[sheet.NAME]", list(deployment.sheets)),
        ("response", "[response.NAME]", list(deployment.responses)),
        ("shear", "[shear.NAME]", list(deployment.shears)),
        ("second_sheet", "[sheet.NAME]", list(deployment.sheets)),
    )
    for key, header, names in known:
        value = getattr(pad, key)
        if key == "sheet" and pad.response:
            continue
        if isinstance(value, str) and value not in names:
            there = f"known: {', '.join(names)}" if names else "none is defined"
            yield Problem(
                f"{location}{key}",
                _format_value(value),
                f"no {header} of that name; {suggest_name(value, names)}{there}",
            )


def _check_response(location: str, pad: Pad, response: ResponseTable, node: Node | None) -> Iterator[Problem]:
    """Check that a response exists on the pad's surface, and that nothing is stated of electrodes."""
    for key in ("electrode_arcs_mm", "switch_states", "resistance_map", *_SIDE_KEYS):
        value = np.any(getattr(pad, key)) if key in _SIDE_KEYS else getattr(pad, key) is not None
        if value:
            remedy = (
                f'is of sheets with electrodes on a conductor, not of kind "{response.kind}"; leave it out'
            )
            yield Problem(f"{location}{key}", _format_value(getattr(pad, key)), remedy)
    if node is not None and node.full_scale is None and not response.is_current:
        remedy = f"[node.{pad.node}] measures a current; give it unit and full_scale, as `response` has it"
        yield Problem(f"{location}node", _format_value(pad.node), remedy)
    for key, remedy in response.problems(pad.surface.build()):
        yield Problem(f"{location}response.{key}", _format_value(getattr(response, key)), remedy)


def _check_electrodes(location: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    """Check the names of a pad's electrodes, and that each of them has a channel."""
    names = pad.electrode_names
    if sorted(pad.electrodes) != sorted(names):
        once = f"must name each of {', '.join(names)} once"
        yield Problem(f"{location}electrodes", _format_value(pad.electrodes), once)
    for key in ("gap_offsets_mm", "series_ohm"):
        values = getattr(pad, key)
        if len(values) != len(names):
            remedy = f"needs {len(names)} values, one for each electrode, has {len(values)}"
            yield Problem(f"{location}{key}", _format_value(values), remedy)
    node = deployment.nodes.get(pad.node)
    if node is not None and len(node.channels) != channel_count(pad):
        counts = [(role.text, len(role.wired(pad))) for role in CHANNEL_ROLES.values()]
        needed = " and ".join(text.format(count) for text, count in counts if count)
        yield Problem(
            f"{location}node",
            _format_value(pad.node),
            f"has {len(node.channels)} channels, the pad {needed}; list as many "
            f"objects in channels of [node.{pad.node}], or of a kind of node for this pad",
        )


def _check_schedule(location: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    """Check that each electrode of a schedule is in one state, and that nothing else excludes a schedule."""
    if not pad.switch_states:
        return
    key, value = f"{location}switch_states", _format_value(pad.switch_states)
    if pad.electrode_arcs_mm is None:
        remedy = "names electrodes of electrode_arcs_mm, which the pad lacks; add it, or leave this out"
        yield Problem(key, value, remedy)
        return
    if sorted(name for state in pad.switch_states for name in state) != sorted(pad.electrode_names):
        yield Problem(key, value, f"must name each of {', '.join(pad.electrode_names)} in one state")
    elif len({len(state) for state in pad.switch_states}) > 1:
        remedy = "electrodes at the same place of every state share a channel; name as many in each state"
        yield Problem(key, value, remedy)
    if pad.shear is not None:
        remedy = "a pad with a shear pad beneath it has no schedule; leave out shear or switch_states"
        yield Problem(key, value, remedy)
    node = deployment.nodes.get(pad.node)
    if node is not None and node.idle is not None:
        remedy = (
            f"its samples follow SYNC, but [node.{pad.node}.idle] makes the node event-driven; leave that "
            "out, or give the pad a kind of node without it"
        )
        yield Problem(key, value, remedy)


def _check_shear(location: str, shear: Shear) -> Iterator[Problem]:
    """Check that a shear pad's pattern can exist and gives both components of the force."""
    try:
        components = shear.build_pattern().components
    except ValueError as error:
        yield Problem(f"{location}: pattern", "", f"{error}")
        return
    if "y" not in components:
        yield Problem(
            f"{location}: pattern.kind",
            _format_value(shear.pattern.kind),
            "senses the component x only, which is no force vector; use crossed_bars, discs or pinwheel",
        )


def _check_shear_pad(location: str, pad: Pad) -> Iterator[Problem]:
    """Check the surface above a shear pad, and the names of its electrodes."""
    if pad.shear is None:
        return
    if pad.surface.kind not in _SURFACES_ABOVE_SHEAR:
        *others, last = _SURFACES_ABOVE_SHEAR
        yield Problem(
            f"{location}shear",
            _format_value(pad.shear),
            f"lies beneath a smooth pad whose surface.kind is {', '.join(others)} or {last}, "
            f'not "{pad.surface.kind}"',
        )
    if sorted(pad.shear_electrodes) != sorted(SIDE_ELECTRODES):
        once = f"must name each of {', '.join(SIDE_ELECTRODES)} once"
        yield Problem(f"{location}shear_electrodes", _format_value(pad.shear_electrodes), once)


def _check_second_sheet(location: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    """Check that a pad's two sheets separate force from area, and that nothing else excludes the second."""
    if pad.second_sheet is None:
        return
    key, value = f"{location}second_sheet", _format_value(pad.second_sheet)
    sheets = [deployment.sheets.get(name) for name in (pad.sheet, pad.second_sheet)]
    alphas = [sheet.alpha for sheet in sheets if sheet is not None]
    if len(alphas) > 1 and abs(alphas[1] - alphas[0]) < MIN_ALPHA_DIFFERENCE:
        yield Problem(
            key,
            value,
            f"has alpha = {alphas[1]:g}, the pad's first sheet {alphas[0]:g}: they must differ by "
            f"{MIN_ALPHA_DIFFERENCE:g} or more, or force and area can't be told apart; choose another sheet",
        )
    for other in ("switch_states", "resistance_map"):
        if getattr(pad, other) is not None:
            yield Problem(key, value, f"isn't supported together with {other}; leave one of them out")


def _check_arcs(location: str, pad: Pad) -> Iterator[Problem]:
    """Check that electrodes on arcs follow each other along the outline of a pad with possible gaps."""
    key, value = f"{location}electrode_arcs_mm", _format_value(pad.electrode_arcs_mm)
    surface = pad.surface.build()
    if surface.perimeter_m is None:
        yield Problem(key, value, "only pads with an outline or on a mesh have arcs; leave it out")
        return
    if not MIN_CHANNELS <= len(pad.arcs_mm) <= MAX_CHANNELS:
        remedy = f"names {len(pad.arcs_mm)} electrodes; {MIN_CHANNELS} to {MAX_CHANNELS} are supported"
        yield Problem(key, value, remedy)
        return
    whole = 1e3 * surface.perimeter_m
    if any(not -whole < end < 2 * whole for arc in pad.arcs_mm for end in arc):
        yield Problem(key, value, f"the edge is {whole:.5g} mm long; lengths must be within it")
        return
    first = pad.arcs_mm[0][0]
    lengths = [(stop - start) % whole for start, stop in pad.arcs_mm]
    starts = [(start - first) % whole for start, _ in pad.arcs_mm] + [whole]
    for number, (name, length, gaps) in enumerate(
        zip(pad.electrode_names, lengths, pad.gaps_mm, strict=True)
    ):
        if sum(gaps) >= length:
            remedy = f"gap_mm leaves no electrode {name}, which covers {length:.4g} mm"
            yield Problem(f"{location}gap_mm", _format_value(pad.gap_mm), remedy)
        bare = starts[number + 1] - starts[number] - length
        after = pad.electrode_names[(number + 1) % len(lengths)]
        if starts[number + 1] <= starts[number]:
            remedy = f"{after} must follow {name} counter-clockwise along the outline"
            yield Problem(key, value, remedy)
            return
        least = MIN_CLEARANCE * whole - gaps[1] - pad.gaps_mm[(number + 1) % len(lengths)][0]
        if bare < max(least, -_MAX_OVERLAP_MM):
            yield Problem(key, value, f"{name} and {after} touch or overlap; leave a gap between them")


def _check_film(location: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    """Check the file of a film's measured resistance, and that it is of this pad."""
    if pad.resistance_map is None:
        return
    key, value = f"{location}resistance_map", _format_value(pad.resistance_map)
    try:
        film = film_of(pad.resistance_map)
    except ValueError as error:
        yield Problem(key, value, str(error))
        return
    is_mesh = any(shape.is_file for shape in surface_keys(SURFACES[pad.surface.kind]).values())
    if is_mesh != (film.place_m.shape[1] == 3):
        missing = "needs z_mm: places in the frame of its STL file"
        yield Problem(key, value, missing if is_mesh else "has z_mm, which is for meshes")
        return
    place = film.fractions(pad.surface.build())
    if not ((place > -_MAX_BESIDE) & (place < 1 + _MAX_BESIDE)).all():
        away = int(np.abs(place - 0.5).max(axis=1).argmax())
        remedy = f"place {away + 1} isn't on the pad; x_mm and y_mm are millimetres from electrodes x0 and y0"
        yield Problem(key, value, remedy)
    if (sheet := deployment.sheets.get(pad.sheet)) is None:
        return
    ratio = float(np.exp(np.mean(np.log(film.ohm_per_square)))) / sheet.ohm_per_square
    if not 1 / _MAX_MEAN_RATIO < ratio < _MAX_MEAN_RATIO:
        remedy = f"its mean is {ratio:.3g} of ohm_per_square of [sheet.{pad.sheet}]; state that as measured"
        yield Problem(key, value, remedy)


def _check_presses(location: str, pad: Pad) -> Iterator[Problem]:
    """Check the file of a pad's presses, and that it is of this pad."""
    if pad.press_map is None:
        return
    key, value = f"{location}press_map", _format_value(pad.press_map)
    if pad.switch_states:
        yield Problem(key, value, "isn't supported together with switch_states; leave one of them out")
        return
    try:
        presses = presses_of(pad.press_map)
        place = pad.surface.build().fractions_of_places(presses.place_m)
    except ValueError as error:
        yield Problem(key, value, str(error))
        return
    count = presses.signals.shape[1]
    if count != len(pad.electrode_names):
        yield Problem(key, value, f"signals of {count} channels; the pad has {len(pad.electrode_names)}")
    elif not ((place > -_MAX_BESIDE) & (place < 1 + _MAX_BESIDE)).all():
        away = int(np.abs(place - 0.5).max(axis=1).argmax())
        remedy = f"press {away + 1} isn't on the pad; x_mm and y_mm are millimetres from its corner x0, y0"
        yield Problem(key, value, remedy)


def _check_shape(location: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    """Check that a pad's surface, gaps and series resistors are possible."""
    surface = pad.surface
    problems = list(surface.problems())
    for key, remedy in problems:
        value = getattr(surface, key or "kind")
        yield Problem(f"{location}surface.{key or 'kind'}", _format_value(value), remedy)
    if problems:
        return
    yield from _check_presses(location, pad)
    if isinstance(pad.response, ResponseTable):
        yield from _check_response(location, pad, pad.response, deployment.nodes.get(pad.node))
        return
    yield from _check_film(location, pad, deployment)
    if pad.electrode_arcs_mm is not None:
        yield from _check_arcs(location, pad)
        return
    side = 1e3 * min(*surface.build().side_lengths_m())
    if not 2 * pad.gap_mm < side:
        yield Problem(
            f"{location}gap_mm",
            _format_value(pad.gap_mm),
            f"leaves no electrode on a side of {side:.4g} mm; must be below {side / 2:.4g}",
        )
    else:
        profile, near, far = surface.build().side_lengths_m()
        lengths = (near, far, profile, profile)
        for name, length, gaps in zip(("x0", "xa", "y0", "yb"), lengths, pad.gaps_mm, strict=True):
            if not sum(gaps) < 1e3 * length:
                yield Problem(
                    f"{location}gap_offsets_mm",
                    _format_value(pad.gap_offsets_mm),
                    f"with gap_mm leaves no electrode {name} on a side of {1e3 * length:.4g} mm",
                )
    if pad.gap_mm == 0 and any(pad.series_ohm):
        yield Problem(
            f"{location}gap_mm",
            _format_value(pad.gap_mm),
            "touching electrodes share their currents, so series_ohm needs a gap above 0",
        )


def _format_value(value: object) -> str:
    if isinstance(value, str) and len(value) > _MAX_VALUE_LENGTH:
        value = f"{value[:_MAX_VALUE_LENGTH]}..."
    return f" = {json.dumps(value, ensure_ascii=False)}"
