"""Deployment file (TOML) -> frozen, checked objects; errors name location, value and remedy.

Public names: `load`, `parse`, `parse_bus`, `with_bus`, `json_schema`, `ConfigError`, `Problem`, `Deployment`
and its tables. Keys carry their unit (`width_mm`, `sync_period_ms`); the objects keep the units of the file,
and `handtouch.hand` converts them to SI once.
"""

from __future__ import annotations

import contextlib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from handtouch.config import shipped
from handtouch.config.base import Table
from handtouch.config.checks import problems_in, problems_in_buses
from handtouch.config.objects import ObjectTable
from handtouch.config.problems import ConfigError, Problem, problems_of
from handtouch.config.responses import ResponseTable, presses_of
from handtouch.config.shear import Shear
from handtouch.config.surfaces import SurfaceTable, film_of, surface_table
from handtouch.config.tables import (
    KINDS,
    TABLES,
    Behaviour,
    Bus,
    Daemon,
    Deployment,
    HandTable,
    Mount,
    NamedPad,
    Node,
    Pad,
    Sheet,
    Touch,
)
from handtouch.config.toml_text import parse_toml, read_text
from handtouch.field.embedded_file import embed_file

__all__ = [
    "Behaviour",
    "Bus",
    "ConfigError",
    "Daemon",
    "Deployment",
    "HandTable",
    "Mount",
    "NamedPad",
    "Node",
    "ObjectTable",
    "Pad",
    "Problem",
    "ResponseTable",
    "Shear",
    "Sheet",
    "SurfaceTable",
    "Table",
    "Touch",
    "film_of",
    "json_schema",
    "load",
    "parse",
    "parse_bus",
    "parse_buses",
    "presses_of",
    "surface_table",
    "with_bus",
]


def load(path: Path | str, buses: Iterable[str] = ()) -> Deployment:
    """Read and check a deployment file; paths in it are relative to its folder.

    `buses`: other interfaces, as for `with_bus`. Raises ConfigError with every error, also for a file that
    can't be read or isn't TOML.
    """
    path = Path(path)
    deployment = parse(read_text(path, "a deployment file"), str(path), path.parent)
    for text in buses:
        deployment = with_bus(deployment, text)
    return deployment


def parse(text: str, file: str = "deployment.toml", folder: Path | None = None) -> Deployment:
    """Check the text of a deployment file; its paths are relative to `folder` (default: current folder)."""
    raw, folder = parse_toml(text, file), folder or Path()
    if foreign := _foreign_tables(raw):
        raise ConfigError(file, (Problem("the file", "", foreign),))
    try:
        deployment = Deployment.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(file, problems_of(raw, error, TABLES, KINDS)) from error
    nodes = {
        name: node.model_copy(update={"eds": str(folder / node.eds)}) if node.eds else node
        for name, node in deployment.nodes.items()
    }
    hands = tuple(
        hand.model_copy(
            update={
                "urdf": _resolve_path(hand.urdf, folder) if hand.urdf else None,
                "pads": tuple(_with_embedded_files(pad, folder) for pad in hand.pads),
            }
        )
        for hand in deployment.hands
    )
    objects = {name: entry.with_embedded_files(folder) for name, entry in deployment.objects.items()}
    daemon = deployment.daemon
    if daemon.keys:
        daemon = daemon.model_copy(update={"keys": str(folder / daemon.keys)})
    return _check_deployment(
        deployment.model_copy(update={"nodes": nodes, "daemon": daemon, "hands": hands, "objects": objects}),
        file,
    )


def with_bus(deployment: Deployment, text: str) -> Deployment:
    """Return the deployment with one bus on another interface, as `parse_bus` reads it.

    Name, bit rate and SYNC stay; the options of the old interface are dropped. Raises ConfigError.
    """
    fields = _parse_bus_text(text)
    name = fields.pop("name")
    names = [bus.name for bus in deployment.buses]
    if name not in names:
        remedy = f"the deployment has no bus of that name; known: {', '.join(names)}"
        raise ConfigError(f"--bus {text}", (Problem("NAME", f" = {name}", remedy),))
    buses = tuple(bus.model_copy(update=fields) if bus.name == name else bus for bus in deployment.buses)
    return _check_deployment(deployment.model_copy(update={"buses": buses}), f"--bus {text}")


def parse_bus(text: str) -> Bus:
    """Return the bus of a text NAME=INTERFACE:CHANNEL[,option=value...].

    A udp_multicast channel may end in :PORT; the option `bitrate` is the bit rate. Values are read as TOML
    where they are numbers or booleans, else as strings. Raises ConfigError.
    """
    fields = _parse_bus_text(text)
    if "bitrate" in fields["options"]:
        fields["bitrate_bit_s"] = fields["options"].pop("bitrate")
    try:
        return Bus.model_validate(fields)
    except ValidationError as error:
        raise ConfigError(f"--bus {text}", problems_of(fields, error, {"": Bus}, {})) from error


def parse_buses(texts: Sequence[str]) -> tuple[Bus, ...]:
    """Return the buses of several `parse_bus` texts, checked together. Raises ConfigError."""
    buses = tuple(map(parse_bus, texts))
    if problems := tuple(problems_in_buses(buses)):
        raise ConfigError(" ".join(f"--bus {text}" for text in texts), problems)
    return buses


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of deployment files, for editors, from the models that validate them."""
    schema = Deployment.model_json_schema(by_alias=True)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "handtouch deployment",
    }


def _foreign_tables(raw: Mapping[str, Any]) -> str:
    """Return what to do with another kind of our files; empty for a deployment."""
    if raw.keys() & {"node", "sheet", "hand"}:
        return ""
    if raw.keys() & {"adc", "pad"}:
        return "this is the file of a sensor node, for `handtouch node`; give a deployment file"
    if raw.keys() & {"fault", "swap", "joint"} or isinstance(raw.get("touch"), list):
        return "this is a scenario, for `handtouch simulate CONFIG --scenario FILE`; give a deployment file"
    return ""


def _parse_bus_text(text: str) -> dict[str, Any]:
    """Return the keys name, interface, channel, options of a text for --bus. Raises ConfigError."""
    form = re.fullmatch(
        r"(?P<name>[^=:,]+)=(?P<interface>[^:,]+):(?P<channel>[^,]+)(?P<options>(,[^,=]+=[^,]*)*)", text
    )
    if not form:
        remedy = "must be NAME=INTERFACE:CHANNEL[,option=value...], e.g. can0=socketcan:can1"
        raise ConfigError(f"--bus {text}", (Problem("the bus", "", remedy),))
    pairs = [pair.split("=", 1) for pair in form["options"].split(",")[1:]]
    options = {key: _parse_scalar(value) for key, value in pairs}
    channel = form["channel"]
    if form["interface"] == "udp_multicast" and (split := re.fullmatch(r"([0-9.]+):(\d+)", channel)):
        channel, options["port"] = split[1], int(split[2])
    return {
        "name": form["name"],
        "interface": form["interface"],
        "channel": int(channel) if channel.isdecimal() else channel,
        "options": options,
    }


def _resolve_path(name: str, folder: Path) -> str:
    """Return the path of a file beside the deployment, else of the shipped file of that name."""
    if not (folder / name).is_file() and Path(name).name == name:
        with contextlib.suppress(FileNotFoundError):
            return str(shipped.path(name))
    return str(folder / name)


def _with_embedded_files(pad: Pad, folder: Path) -> Pad:
    """Return a pad with the content of the files that it names."""
    files = {key: getattr(pad, key) for key in ("resistance_map", "press_map")}
    embedded = {key: embed_file(file, folder) for key, file in files.items() if file}
    tables = {"surface": pad.surface, "response": pad.response}
    parts = {
        key: table.with_embedded_files(folder)
        for key, table in tables.items()
        if isinstance(table, SurfaceTable | ResponseTable)
    }
    return pad.model_copy(update=parts | embedded)


def _check_deployment(deployment: Deployment, file: str) -> Deployment:
    if problems := tuple(problems_in(deployment)):
        raise ConfigError(file, problems)
    return deployment


def _parse_scalar(text: str) -> str | int | float | bool:
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, int | float) else text
