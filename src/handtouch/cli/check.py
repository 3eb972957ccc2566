"""The command `check`: errors and warnings of a deployment file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from handtouch import config
from handtouch.cli.errors import CommandError
from handtouch.cli.options import add_bus, add_config, add_json
from handtouch.host.json_output import print_json
from handtouch.procedures.check import find_warnings, load_deployment, summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `check`."""
    parser.set_defaults(command=run)
    add_config(parser, nargs="?")
    add_bus(parser)
    add_json(parser)
    parser.add_argument(
        "--schema", action="store_true", help="print the JSON schema of deployment files instead"
    )


def run(config_path: Path | None, as_json: bool, schema: bool, buses: Sequence[str] = ()) -> int:
    """Print a deployment's summary and warnings; exit status 0, 1 (warnings), 2 (invalid file)."""
    if schema:
        print_json(config.json_schema())
        return 0
    if config_path is None:
        raise CommandError("handtouch check: give a deployment file, or --schema", 2)
    try:
        deployment = load_deployment(config_path, buses)
    except config.ConfigError as error:
        if not as_json:
            raise
        problems = [
            {"location": one.location, "value": one.value.removeprefix(" = "), "remedy": one.remedy}
            for one in error.problems
        ]
        print_json({"file": error.file, "ok": False, "problems": problems})
        return 2
    warnings = list(find_warnings(deployment))
    if as_json:
        report = {"file": str(config_path), "ok": True, **summary(deployment), "warnings": warnings}
        print_json(report)
    else:
        _print_summary(config_path, summary(deployment), warnings)
    return 1 if warnings else 0


def _measured(pad: dict[str, Any]) -> str:
    force_n = pad["measured_force_n"]
    if force_n is None:
        return "any force"
    return f"up to {force_n:.3g} N (at {pad['measured_force_electrode']})"


def _pads_text(count: int) -> str:
    return f"{count} pad{'s' * (count != 1)}"


def _print_summary(path: Path, facts: dict[str, Any], warnings: list[str]) -> None:
    print(f"{path}: {1e3 / facts['sync_period_ms']:.4g} Hz")
    for bus in facts["buses"]:
        print(
            f"  bus {bus['name']}: {bus['interface']} {bus['channel']}, "
            f"{bus['bitrate_bit_s'] / 1e3:g} kbit/s, {_pads_text(bus['pads'])}, "
            f"load {bus['load']:.0%}, samples within {bus['burst_ms']:.2f} ms of SYNC"
        )
    for hand in facts["hands"]:
        print(f"  hand {hand['name']}: {_pads_text(len(hand['pads']))}")
        for pad in hand["pads"]:
            length_mm, width_mm = pad["size_mm"]
            serial = "no serial" if pad["serial"] is None else f"serial {pad['serial']}"
            print(
                f"    {pad['link']:<16} {pad['bus']} node 0x{pad['node_id']:02X}  {pad['surface']:<8} "
                f"{length_mm:5.1f} x {width_mm:5.1f} mm  {_measured(pad)}  {serial}"
            )
        for key in ("needed_full_scale_ma", "needed_full_scale"):
            limited = [pad for pad in hand["pads"] if pad["measured_force_n"] is not None and key in pad]
            if not limited:
                continue
            needed = max(pad[key] for pad in limited)
            print(
                "    beyond these forces a contact beside an electrode exceeds its channel: it goes on, its "
                f"force is a lower bound; {key.removeprefix('needed_')} = {needed:.1f} measures max_force_n "
                "anywhere"
            )
    for warning in warnings:
        print(f"  warning: {warning}")
    if not warnings:
        print("  no warnings")
