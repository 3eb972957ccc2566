"""Output of the commands that draw: `figures` and `design`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from handtouch.cli.progress import ProgressLine
from handtouch.host.json_output import print_json


def run_figures(out: Path, as_json: bool = False) -> int:
    """Draw the paper's theoretical figures and print their paths; return the exit status, as `run_design`."""
    from handtouch.field.figures import draw_figures

    paths: list[Path] = []
    if status := draw_with_progress("figures", lambda progress: paths.extend(draw_figures(out, progress))):
        return status
    if as_json:
        print_json({"files": paths})
    else:
        print(*paths, sep="\n")
    return 0


def run_design(config_path: Path, link: str | None, out: Path, as_json: bool = False) -> int:
    """Draw one pad of a deployment, print the paths and its expected errors; return the exit status.

    2 for an invalid file or link, or without matplotlib; 1 if the folder cannot be written.
    """
    from handtouch import config
    from handtouch.hand.design import FIRM_TOUCH_N, draw_design, error_summary, pad_design

    try:
        pad = pad_design(config.load(config_path), link)
    except (config.ConfigError, ValueError) as error:
        print(f"handtouch design: {error}", file=sys.stderr)
        return 2
    paths: list[Path] = []
    if status := draw_with_progress("design", lambda progress: paths.extend(draw_design(pad, out, progress))):
        return status
    errors = [(force_n, *error_summary(pad, force_n)) for force_n in (pad.light_touch_n, FIRM_TOUCH_N)]
    if as_json:
        rows = [{"force_n": force, "median_m": median, "worst_m": worst} for force, median, worst in errors]
        print_json({"pad": pad.name, "files": paths, "expected_error": rows})
        return 0
    print(*paths, sep="\n")
    for force_n, *errors_m in errors:
        median_mm, worst_mm = (1e3 * error_m for error_m in errors_m)
        print(f"{force_n:g} N: expected location error {median_mm:.3g} mm median, {worst_mm:.3g} mm at worst")
    return 0


def draw_with_progress(command: str, draw: Callable[[Callable[[str], None]], None]) -> int:
    """Draw with a progress line; exit status 0, 1 (folder can't be written), 2 (without matplotlib)."""
    try:
        with ProgressLine() as progress:
            draw(progress.update)
    except (ImportError, OSError) as error:
        print(f"handtouch {command}: {error}", file=sys.stderr)
        return 2 if isinstance(error, ImportError) else 1
    return 0
