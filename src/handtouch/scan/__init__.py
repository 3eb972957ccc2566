"""`handtouch scan [CONFIG]`: who is on the buses, what are they, and does that fit the deployment.

Public names: `run`, `Request`. `look` asks the buses, `judge` compares, `fragment` writes what a deployment
file needs, `show` prints. No NMT command is sent and no node is changed, unless LSS is to give ids to nodes
that have none.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError
from rich.console import Console

from handtouch import config, shipped
from handtouch.canbus.bus.port import BusError
from handtouch.doctor import Machine

from . import show
from .judge import judge
from .look import Request, scan

__all__ = ["Request", "run"]

_NO_BUS = (
    "give a deployment file, or a bus such as --bus can0=socketcan:can0 (`ip -br link` lists interfaces)"
)


def run(path: Path | None, buses: Sequence[str], request: Request, *, as_json: bool = False) -> int:
    """Scan and print; exit status 0, 1 (a node missing or wrong, none found, no bus), 2 (usage)."""
    try:
        deployment = None if path is None else config.load(path)
        wires = _without_deployment(buses) if deployment is None else _with(deployment, buses)
    except config.ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    console = Console(stderr=True)
    try:
        if console.is_terminal:
            with console.status("") as status:
                reports = scan(wires, request, deployment, status.update)
        else:
            reports = scan(wires, request, deployment)
    except BusError as error:
        print(error, file=sys.stderr)
        return 1
    verdicts = judge(deployment, reports)
    well = not any(verdict.wrong for verdict in verdicts) and not any(report.problems for report in reports)
    write = show.as_json if as_json else show.as_text
    print(write(reports, verdicts, deployment, well), end="")
    return 0 if well else 1


def _with(deployment: config.Deployment, buses: Sequence[str]) -> tuple[config.Bus, ...]:
    for text in buses:
        deployment = config.with_bus(deployment, text)
    return deployment.buses


def _without_deployment(buses: Sequence[str]) -> tuple[config.Bus, ...]:
    """Buses of the command line alone; an option `bitrate` is that of the bus. Raises ConfigError."""
    if not buses:
        raise config.ConfigError("handtouch scan", (config.Problem("no bus", "", _NO_BUS),))
    blank = tuple(_bus(text, name=text.partition("=")[0], channel=text) for text in buses)
    # the shipped hand with its first pad, so that `with_bus` reads and checks buses here as everywhere
    shipped_one = config.load(shipped.path("utah_mit.toml"))
    hand = shipped_one.hands[0]
    pad = hand.pads[0].model_copy(update={"bus": blank[0].name})
    hand = hand.model_copy(update={"pads": (pad,)})
    deployment = shipped_one.model_copy(update={"buses": blank, "hands": (hand,)})
    wires = zip(_with(deployment, buses), buses, strict=True)
    return tuple(_bus(text, **_with_bit_rate(bus)) for bus, text in wires)


def _with_bit_rate(bus: config.Bus) -> dict[str, object]:
    options = dict(bus.options)
    rate = options.pop("bitrate", None) or _kernels_bit_rate(bus) or bus.bitrate_bit_s
    return {**bus.model_dump(), "options": options, "bitrate_bit_s": rate}


def _kernels_bit_rate(bus: config.Bus) -> int | None:
    """What `ip link set` has given a SocketCAN interface, None for any other."""
    link = Machine().link(str(bus.channel)) if bus.interface == "socketcan" else None
    rate = (link or {}).get("linkinfo", {}).get("info_data", {}).get("bittiming", {}).get("bitrate")
    return rate if isinstance(rate, int) else None


def _bus(text: str, **keys: object) -> config.Bus:
    """A bus of the command line. Raises ConfigError."""
    try:
        return config.Bus.model_validate({"interface": "virtual", **keys})
    except ValidationError as error:
        problems = tuple(
            config.Problem(str(item["loc"][0]), f" = {item['input']}", item["msg"]) for item in error.errors()
        )
        raise config.ConfigError(f"--bus {text}", problems) from error
