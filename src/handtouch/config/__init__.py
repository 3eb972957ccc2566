"""Deployment file (TOML) -> frozen, checked objects; every mistake named with its place, value and remedy.

Public names: `load`, `parse`, `with_bus`, `json_schema`, `ConfigError`, `Deployment` and its tables.
Keys carry their unit (`width_mm`, `sync_period_ms`); the objects keep the units of the file, and
`handtouch.hand` converts them to SI once.
"""

from __future__ import annotations

import contextlib
import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from handtouch import shipped
from handtouch.config.checks import problems_in
from handtouch.config.problems import ConfigError, Problem, problems_of
from handtouch.config.tables import (
    SURFACES,
    TABLES,
    Behaviour,
    Bus,
    Cone,
    Cylinder,
    Daemon,
    Deployment,
    Hand,
    Mount,
    Node,
    Pad,
    Plane,
    Sheet,
    Sphere,
    Surface,
    Table,
    Touch,
)

__all__ = [
    "Behaviour",
    "Bus",
    "Cone",
    "ConfigError",
    "Cylinder",
    "Daemon",
    "Deployment",
    "Hand",
    "Mount",
    "Node",
    "Pad",
    "Plane",
    "Problem",
    "Sheet",
    "Sphere",
    "Surface",
    "Table",
    "Touch",
    "json_schema",
    "load",
    "parse",
    "with_bus",
]


def load(path: Path | str) -> Deployment:
    """Read and check a deployment file; paths in it start in its folder.

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
        raise ConfigError(file, problems_of(raw, error, TABLES, SURFACES)) from error
    nodes = {
        name: node.model_copy(update={"eds": str((folder or Path()) / node.eds)}) if node.eds else node
        for name, node in deployment.nodes.items()
    }
    hands = tuple(
        hand.model_copy(update={"urdf": _found(hand.urdf, folder or Path())}) if hand.urdf else hand
        for hand in deployment.hands
    )
    daemon = deployment.daemon
    if daemon.keys:
        daemon = daemon.model_copy(update={"keys": str((folder or Path()) / daemon.keys)})
    return _checked(deployment.model_copy(update={"nodes": nodes, "daemon": daemon, "hands": hands}), file)


def with_bus(deployment: Deployment, text: str) -> Deployment:
    """The deployment with one bus on another wire: NAME=INTERFACE:CHANNEL[,option=value...].

    Name, bit rate and SYNC stay; the options of the old interface go. A udp_multicast channel may end in
    :PORT. Values are read as TOML where they are numbers or truth values, else as text. Raises ConfigError.
    """
    file = f"--bus {text}"
    form = re.fullmatch(
        r"(?P<name>[^=:,]+)=(?P<interface>[^:,]+):(?P<channel>[^,]+)(?P<options>(,[^,=]+=[^,]*)*)", text
    )
    if not form:
        remedy = "must be NAME=INTERFACE:CHANNEL[,option=value...], e.g. can0=socketcan:can1"
        raise ConfigError(file, (Problem("the bus", "", remedy),))
    names = [bus.name for bus in deployment.buses]
    if form["name"] not in names:
        known = f"the deployment has no bus of that name; there are: {', '.join(names)}"
        raise ConfigError(file, (Problem("NAME", f" = {form['name']}", known),))
    pairs = [pair.split("=", 1) for pair in form["options"].split(",")[1:]]
    options = {key: _scalar(value) for key, value in pairs}
    channel = form["channel"]
    if form["interface"] == "udp_multicast" and (split := re.fullmatch(r"([0-9.]+):(\d+)", channel)):
        channel, options["port"] = split[1], int(split[2])
    update = {
        "interface": form["interface"],
        "channel": int(channel) if channel.isdecimal() else channel,
        "options": options,
    }
    buses = tuple(
        bus.model_copy(update=update) if bus.name == form["name"] else bus for bus in deployment.buses
    )
    return _checked(deployment.model_copy(update={"buses": buses}), file)


def json_schema() -> dict[str, Any]:
    """JSON schema of a deployment file, for editors; made from the same definitions that check it."""
    schema = Deployment.model_json_schema(by_alias=True)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "handtouch deployment",
    }


def _found(name: str, folder: Path) -> str:
    """Path of a file beside the deployment, or of a shipped one: copies of a deployment leave it behind."""
    if not (folder / name).is_file() and Path(name).name == name:
        with contextlib.suppress(FileNotFoundError):
            return str(shipped.path(name))
    return str(folder / name)


def _checked(deployment: Deployment, file: str) -> Deployment:
    if problems := tuple(problems_in(deployment)):
        raise ConfigError(file, problems)
    return deployment


def _scalar(text: str) -> str | int | float | bool:
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, int | float) else text
