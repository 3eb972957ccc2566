"""Deployment file (TOML) -> frozen, checked objects; every mistake named with its place, value and remedy.

Public names: `load`, `parse`, `json_schema`, `ConfigError`, `Deployment` and the tables it is made of.
Keys carry their unit (`width_mm`, `sync_period_ms`); the objects keep the units of the file, and
`handtouch.hand` converts them to SI once.
"""

from __future__ import annotations

import difflib
import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Three = Annotated[tuple[float, float, float], Field(strict=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$", max_length=64)]
NodeId = Annotated[int, Field(ge=1, le=127)]
_LOOPBACK = ("tcp://127.", "tcp://localhost:", "tcp://[::1]:")

Unsigned32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class Table(BaseModel):
    """A table of the file: frozen, no unknown keys, no silent conversion of types, no NaN or infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=False
    )


class Daemon(Table):
    """`[daemon]`: where the daemon is reached and how fast it works."""

    live: str = Field("tcp://127.0.0.1:5580", description="ZeroMQ endpoint of the live stream")
    complete: str = Field("tcp://127.0.0.1:5582", description="ZeroMQ endpoint of the complete stream")
    control: str = Field("tcp://127.0.0.1:5581", description="ZeroMQ endpoint of request-reply control")
    inputs: str = Field("tcp://127.0.0.1:5583", description="ZeroMQ endpoint of joint states and forces")
    sync_period_ms: float = Field(5.0, ge=0.5, le=1000, description="period of SYNC and of the tick")
    window: Fraction = Field(0.6, description="part of the period after SYNC that a tick waits for samples")


class Bus(Table):
    """`[[bus]]`: one CAN bus, by python-can's names."""

    name: Name
    interface: str = Field(description="python-can interface: socketcan, udp_multicast, virtual, slcan …")
    channel: str | int = Field(description="python-can channel: can0, 239.74.163.2, /dev/ttyACM0 …")
    bitrate_bit_s: int = Field(1_000_000, ge=10_000, le=1_000_000, description="bit rate, for the bus load")
    sync: Literal["producer", "consumer"] = Field(
        "producer", description="who sends SYNC on this bus: this daemon, or somebody else"
    )
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict, description="further options of the python-can interface, passed on as they are"
    )


class Node(Table):
    """`[node.NAME]`: a kind of sensor node, its electronics and its supervision."""

    eds: str | None = Field(
        None, description="EDS file beside this one; left out: the shipped four-channel node"
    )
    vendor_id: Unsigned32 | None = Field(None, description="checked against 0x1018 sub 1 when given")
    product_code: Unsigned32 | None = Field(None, description="checked against 0x1018 sub 2 when given")
    drive_v: Positive = Field(description="potential of the conducting layer against the electrodes, volt")
    full_scale_ma: Positive = Field(description="electrode current at the greatest positive count")
    noise_counts: Positive = Field(description="standard deviation of one channel's reading, counts")
    heartbeat_ms: int = Field(100, ge=10, le=60_000, description="producer heartbeat time, written to 0x1017")
    heartbeat_timeout_ms: int = Field(
        350, ge=20, le=300_000, description="silence after which a node is lost"
    )


class Sheet(Table):
    """`[sheet.NAME]`: a kind of resistive sandwich with its contact law, k / pressure^alpha (paper eq. 12)."""

    ohm_per_square: Positive = Field(description="sheet resistance rho/w")
    contact_ohm_mm2: Positive = Field(description="contact resistance times area at the reference pressure")
    reference_kpa: Positive = Field(100.0, description="the pressure at which contact_ohm_mm2 holds")
    alpha: float = Field(gt=0, le=5, description="exponent of pressure in the contact law")
    contact_radius_mm: Positive = Field(description="radius assumed for a contact")
    contact_radius_std_mm: NonNegative = Field(
        description="how far from that a contact's radius may be (1 sigma)"
    )


class Plane(Table):
    """A flat pad."""

    kind: Literal["plane"]
    length_mm: Positive = Field(description="from electrode x0 to electrode xa")
    width_mm: Positive = Field(description="from electrode y0 to electrode yb")


class Cylinder(Table):
    """A patch of a cylinder; its x axis runs along the cylinder."""

    kind: Literal["cylinder"]
    radius_mm: Positive
    length_mm: Positive = Field(description="along the axis, from electrode x0 to electrode xa")
    arc_deg: float = Field(gt=0, le=360, description="around the axis, from electrode y0 to electrode yb")


class Cone(Table):
    """A patch of a cone between two of its circles."""

    kind: Literal["cone"]
    near_radius_mm: Positive = Field(description="radius of the circle at electrode x0")
    far_radius_mm: Positive = Field(description="radius of the circle at electrode xa")
    slant_mm: Positive = Field(description="along the surface, from electrode x0 to electrode xa")
    arc_deg: float = Field(gt=0, le=360, description="around the axis, from electrode y0 to electrode yb")


class Sphere(Table):
    """A patch of a sphere between two parallels and two meridians."""

    kind: Literal["sphere"]
    radius_mm: Positive
    from_deg: float = Field(gt=-90, lt=90, description="latitude of electrode x0")
    to_deg: float = Field(gt=-90, lt=90, description="latitude of electrode xa")
    arc_deg: float = Field(gt=0, le=360, description="around the axis, from electrode y0 to electrode yb")


Surface = Annotated[Plane | Cylinder | Cone | Sphere, Field(discriminator="kind")]


class Mount(Table):
    """Where the pad frame (origin at its centre, x towards xa, y towards yb, z outward) sits on its link."""

    position_mm: Three = Field((0.0, 0.0, 0.0), description="origin of the pad frame in the link frame")
    rpy_deg: Three = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw about fixed axes, as in URDF")


class Touch(Table):
    """`[touch]`: when a pad counts as touched."""

    on_n: Positive = Field(0.06, description="a touch begins above this force")
    off_n: Positive = Field(0.03, description="and ends below this one")
    begin_samples: int = Field(2, ge=1, le=100, description="samples in a row above on_n before it begins")
    end_samples: int = Field(2, ge=1, le=100, description="samples in a row below off_n before it ends")


class Pad(Table):
    """`[[hand.pad]]`: one area touch sensor on a link of the hand."""

    link: Name = Field(description="link that carries the pad; also its name in topics")
    bus: Name
    node_id: NodeId
    serial: Unsigned32 | None = Field(
        None, description="serial number (0x1018 sub 4) of the node calibrated here"
    )
    node: Name = Field(description="kind of node, a [node.NAME] table")
    sheet: Name = Field(description="kind of sheet, a [sheet.NAME] table")
    surface: Surface
    gap_mm: NonNegative = Field(
        description="bare length from each corner along each side, on the pad's rectangle"
    )
    series_ohm: Annotated[tuple[NonNegative, NonNegative, NonNegative, NonNegative], Field(strict=False)] = (
        Field((0.0, 0.0, 0.0, 0.0), description="resistors from the electrodes x0, xa, y0, yb to ground")
    )
    mount: Mount = Mount()
    touch: Touch | None = Field(None, description="thresholds of this pad alone; left out: those of [touch]")


class Hand(Table):
    """`[[hand]]`: a hand and its pads."""

    name: Name
    pads: Annotated[tuple[Pad, ...], Field(strict=False, min_length=1)] = Field(alias="pad")


class Deployment(Table):
    """The whole file."""

    daemon: Daemon = Daemon()
    buses: Annotated[tuple[Bus, ...], Field(strict=False, min_length=1)] = Field(alias="bus")
    nodes: dict[Name, Node] = Field(alias="node")
    sheets: dict[Name, Sheet] = Field(alias="sheet")
    touch: Touch = Touch()
    hands: Annotated[tuple[Hand, ...], Field(strict=False, min_length=1)] = Field(alias="hand")


@dataclass(frozen=True)
class Problem:
    """One mistake: where it is, what stands there, and what would be right."""

    place: str
    value: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.place}{self.value}: {self.remedy}"


class ConfigError(ValueError):
    """A deployment file that can't be used; `problems` holds every mistake found, `str` a line for each."""

    def __init__(self, file: str, problems: tuple[Problem, ...]) -> None:
        super().__init__("\n".join(f"{file}: {problem}" for problem in problems))
        self.file = file
        self.problems = problems


def load(path: Path | str) -> Deployment:
    """Read and check a deployment file; EDS paths in it become absolute.

    Raises ConfigError naming every mistake, also when the file can't be read or isn't TOML.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
        raise ConfigError(
            str(path), (Problem("the file", "", f"{reason}; give the path of a deployment file"),)
        ) from error
    return parse(text, str(path), path.parent)


def parse(text: str, file: str = "deployment.toml", folder: Path | None = None) -> Deployment:
    """Check the text of a deployment file; its relative paths start in `folder` (default: here)."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(file, (Problem("TOML", "", f"{error}; mend the syntax there"),)) from error
    try:
        deployment = Deployment.model_validate(raw)
    except ValidationError as error:
        found = tuple(_problem(raw, item) for item in error.errors() if not _is_echo(item))
        raise ConfigError(file, found) from error
    nodes = {
        name: node.model_copy(update={"eds": str((folder or Path()) / node.eds)}) if node.eds else node
        for name, node in deployment.nodes.items()
    }
    deployment = deployment.model_copy(update={"nodes": nodes})
    if problems := tuple(_cross_check(deployment)):
        raise ConfigError(file, problems)
    return deployment


def json_schema() -> dict[str, Any]:
    """JSON schema of a deployment file, for editors; made from the same definitions that check it."""
    schema = Deployment.model_json_schema(by_alias=True)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "handtouch deployment",
    }


_SURFACES: dict[str, type[Table]] = {"plane": Plane, "cylinder": Cylinder, "cone": Cone, "sphere": Sphere}
_TABLES: dict[str, type[Table]] = {
    "": Deployment,
    "daemon": Daemon,
    "bus": Bus,
    "node.*": Node,
    "sheet.*": Sheet,
    "touch": Touch,
    "hand": Hand,
    "hand.pad": Pad,
    "hand.pad.mount": Mount,
    "hand.pad.touch": Touch,
}
_UNITS = ("_mm", "_ms", "_deg", "_n", "_v", "_ma", "_ohm", "_bit_s", "_mm2", "_kpa", "_counts", "_samples")


def _problem(raw: Mapping[str, Any], error: Any) -> Problem:
    """What pydantic found, in the words of the file."""
    path, place, table = _locate(raw, tuple(error["loc"]))
    key = path[-1] if path else ""
    model = _model(path[:-1], table)
    kind, value = error["type"], error["input"]
    if kind == "extra_forbidden":
        return Problem(place, f" = {_show(value)}", _unknown_key(key, model))
    if kind == "missing":
        near = _near(key, [k for k in table if model is None or k not in _keys(model)])
        hint = f'; "{near}" stands there: did you mean "{key}"?' if near else ""
        return Problem(place, "", f"is missing{hint}{_meaning(key, model)}")
    if kind.startswith("union_tag"):
        known = ", ".join(f'kind = "{name}"' for name in _SURFACES)
        return Problem(place, f" = {_show(value)}", f"needs one of {known}")
    message = (
        str(error["msg"])
        .replace("Input should be", "must be")
        .replace("Input", "value")
        .replace("Tuple", "list")
    )
    return Problem(place, f" = {_show(value)}", message + _meaning(key, model))


def _is_echo(error: Any) -> bool:
    """A list is also called too short when all its entries are wrong; those are reported by themselves."""
    return error["type"] == "too_short" and len(error["input"]) >= error["ctx"]["min_length"]


def _locate(raw: Mapping[str, Any], loc: tuple[str | int, ...]) -> tuple[list[str], str, Mapping[str, Any]]:
    """Follow pydantic's location to (keys, place in the words of the file, innermost table)."""
    here: Any = raw
    table: Mapping[str, Any] = raw
    path: list[str] = []
    section = ""
    shown: list[str] = []
    for step in loc:
        if isinstance(step, int):
            here = here[step] if isinstance(here, list) and step < len(here) else None
            if isinstance(here, dict):
                name = here.get("link") or here.get("name")
                section = f"[[{'.'.join(path)}]] {step + 1}" + (f' "{name}"' if isinstance(name, str) else "")
                table, shown = here, []
            elif shown:
                shown[-1] += f"[{step}]"
            continue
        if step == "[key]" or (
            isinstance(here, dict) and here.get("kind") == step and path[-1:] == ["surface"]
        ):
            continue  # pydantic's own marks, not keys of the file
        if isinstance(here, dict):
            table = here
            here = here.get(step)
        path.append(step)
        shown.append(step)
    if not section and len(shown) > 1:
        section, shown = f"[{'.'.join(shown[:-1])}]", shown[-1:]
    return path, ": ".join(part for part in (section, ".".join(shown)) if part) or "top level", table


def _model(path: list[str], table: Mapping[str, Any]) -> type[Table] | None:
    """The definition that the table at a path must follow."""
    if path[-1:] == ["surface"]:
        return _SURFACES.get(str(table.get("kind")))
    return _TABLES.get(".".join(path)) or _TABLES.get(".".join([*path[:-1], "*"]))


def _keys(model: type[Table]) -> dict[str, str]:
    """Keys of a table as the file spells them, with their meaning."""
    return {field.alias or name: field.description or "" for name, field in model.model_fields.items()}


def _meaning(key: str, model: type[Table] | None) -> str:
    meaning = _keys(model).get(key.split("[")[0], "") if model else ""
    return f" ({key}: {meaning})" if meaning else ""


def _unknown_key(key: str, model: type[Table] | None) -> str:
    keys = list(_keys(model)) if model else []
    if near := _near(key, keys):
        unit = (
            "; keys carry their unit"
            if near != key and near.startswith(key) and near.endswith(_UNITS)
            else ""
        )
        return f'unknown key; did you mean "{near}"{unit}?'
    return f"unknown key; known here: {', '.join(keys)}"


def _near(key: str, candidates: list[str]) -> str | None:
    """The candidate that differs from the key by a forgotten unit or a slip of the pen."""
    for candidate in candidates:
        if any(candidate == key + unit or key == candidate + unit for unit in _UNITS):
            return candidate
    return next(iter(difflib.get_close_matches(key, candidates, n=1, cutoff=0.6)), None)


def _show(value: object) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."


def _cross_check(deployment: Deployment) -> Iterator[Problem]:
    """Mistakes that no single key shows."""
    yield from _check_endpoints(deployment.daemon)
    yield from _check_names("bus", [bus.name for bus in deployment.buses])
    yield from _check_names("hand", [hand.name for hand in deployment.hands])
    for name, node in deployment.nodes.items():
        if node.heartbeat_timeout_ms <= node.heartbeat_ms:
            yield Problem(
                f"[node.{name}]: heartbeat_timeout_ms",
                f" = {node.heartbeat_timeout_ms}",
                f"must be longer than heartbeat_ms = {node.heartbeat_ms}; three times it is usual",
            )
        if node.eds and not Path(node.eds).is_file():
            yield Problem(
                f"[node.{name}]: eds", f" = {_show(node.eds)}", "no such file; give its path beside this one"
            )
    yield from _check_touch("[touch]", deployment.touch)
    taken: dict[tuple[str, int], str] = {}
    for hand in deployment.hands:
        yield from _check_names("hand.pad", [pad.link for pad in hand.pads])
        for number, pad in enumerate(hand.pads, 1):
            place = f'[[hand.pad]] {number} "{pad.link}"'
            yield from _check_references(place, pad, deployment)
            yield from _check_shape(place, pad)
            if pad.touch:
                yield from _check_touch(f"{place}: touch", pad.touch)
            owner = taken.setdefault((pad.bus, pad.node_id), f"{hand.name}/{pad.link}")
            if owner != f"{hand.name}/{pad.link}":
                yield Problem(
                    f"{place}: node_id",
                    f" = {pad.node_id}",
                    f'is already the node of "{owner}" on bus "{pad.bus}"; every node needs an id of its own',
                )


def _check_names(section: str, names: list[str]) -> Iterator[Problem]:
    key = "link" if section == "hand.pad" else "name"
    for number, name in enumerate(names, 1):
        if name in names[: number - 1]:
            yield Problem(
                f"[[{section}]] {number}: {key}", f" = {_show(name)}", "is used twice; names must differ"
            )


def _check_endpoints(daemon: Daemon) -> Iterator[Problem]:
    seen: dict[str, str] = {}
    for key in ("live", "complete", "control", "inputs"):
        endpoint = getattr(daemon, key)
        place, value = f"[daemon]: {key}", f" = {_show(endpoint)}"
        if not endpoint.startswith(("tcp://", "ipc://")):
            yield Problem(
                place,
                value,
                "must be a ZeroMQ endpoint such as tcp://127.0.0.1:5580 or ipc:///run/handtouch/live",
            )
        elif endpoint.startswith("tcp://") and not endpoint.startswith(_LOOPBACK):
            yield Problem(
                place, value, "reaches beyond this machine; only loopback (127.0.0.1) is open without keys"
            )
        elif endpoint in seen and not endpoint.endswith(":*"):
            yield Problem(place, value, f"is the endpoint of {seen[endpoint]} too; give each its own port")
        seen[endpoint] = key


def _check_touch(place: str, touch: Touch) -> Iterator[Problem]:
    if touch.off_n >= touch.on_n:
        yield Problem(
            f"{place}: off_n", f" = {touch.off_n}", f"must be below on_n = {touch.on_n}, or contacts flicker"
        )


def _check_references(place: str, pad: Pad, deployment: Deployment) -> Iterator[Problem]:
    known = {
        "bus": [bus.name for bus in deployment.buses],
        "node": list(deployment.nodes),
        "sheet": list(deployment.sheets),
    }
    for key, names in known.items():
        value = getattr(pad, key)
        if value not in names:
            header = "[[bus]]" if key == "bus" else f"[{key}.NAME]"
            yield Problem(
                f"{place}: {key}",
                f" = {_show(value)}",
                f"no {header} of that name; there are: {', '.join(names)}",
            )


def _check_shape(place: str, pad: Pad) -> Iterator[Problem]:
    """What the geometry of a pad forbids; lengths of sides along the surface, in mm."""
    surface = pad.surface
    if isinstance(surface, Plane):
        sides = (surface.length_mm, surface.width_mm)
    elif isinstance(surface, Cylinder):
        sides = (surface.length_mm, surface.radius_mm * math.radians(surface.arc_deg))
    elif isinstance(surface, Cone):
        narrow = min(surface.near_radius_mm, surface.far_radius_mm)
        sides = (surface.slant_mm, narrow * math.radians(surface.arc_deg))
        if surface.slant_mm < abs(surface.far_radius_mm - surface.near_radius_mm):
            yield Problem(
                f"{place}: surface.slant_mm",
                f" = {surface.slant_mm}",
                "is shorter than the difference of the two radii; no cone has that shape",
            )
    else:
        widest = max(abs(surface.from_deg), abs(surface.to_deg))
        narrow = surface.radius_mm * math.cos(math.radians(widest))
        sides = (
            surface.radius_mm * math.radians(surface.to_deg - surface.from_deg),
            narrow * math.radians(surface.arc_deg),
        )
        if surface.to_deg <= surface.from_deg:
            yield Problem(
                f"{place}: surface.to_deg",
                f" = {surface.to_deg}",
                f"must be above from_deg = {surface.from_deg}",
            )
            return
    if 2 * pad.gap_mm >= min(sides):
        yield Problem(
            f"{place}: gap_mm",
            f" = {pad.gap_mm}",
            f"leaves no electrode on a side of {min(sides):.4g} mm; it must be below {min(sides) / 2:.4g}",
        )
