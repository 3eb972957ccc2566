"""Output of `handtouch doctor`."""

from __future__ import annotations

import sys
from pathlib import Path

from handtouch import config
from handtouch.host.json_output import print_json
from handtouch.procedures.doctor import check_host


def run(config_path: Path | None, as_json: bool) -> int:
    """Print the results of all checks; exit status 0, 1 (a check failed), 2 (invalid file)."""
    deployment = None
    if config_path is not None:
        try:
            deployment = config.load(config_path)
        except config.ConfigError as error:
            print(error, file=sys.stderr)
            return 2
    checks = list(check_host(deployment))
    if as_json:
        print_json(checks)
    else:
        for check in checks:
            print(f"{check.state:<5} {check.subject}: {check.detail}")
            if check.remedy:
                print(f"      -> {check.remedy}")
    return 1 if any(check.state == "fail" for check in checks) else 0
