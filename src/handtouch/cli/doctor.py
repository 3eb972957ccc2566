"""The command `doctor`: checks of this machine."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from handtouch import config
from handtouch.cli.options import add_bus, add_config, add_json
from handtouch.host.json_output import print_json
from handtouch.procedures.doctor import check_host


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `doctor`."""
    parser.set_defaults(command=run)
    add_config(parser, "deployment file, to check its buses and endpoints too", nargs="?")
    add_bus(parser)
    add_json(parser)


def run(config_path: Path | None, as_json: bool, buses: Sequence[str] = ()) -> int:
    """Print the results of all checks; exit status 0, 1 (a check failed), 2 (invalid file)."""
    checks = list(check_host(None if config_path is None else config.load(config_path, buses)))
    if as_json:
        print_json(checks)
    else:
        for check in checks:
            print(f"{check.state:<5} {check.subject}: {check.detail}")
            if check.remedy:
                print(f"      -> {check.remedy}")
    return 1 if any(check.state == "fail" for check in checks) else 0
