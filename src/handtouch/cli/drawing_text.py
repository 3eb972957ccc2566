"""Output of the commands that draw: `figures` and `design`."""

from __future__ import annotations

import sys
from pathlib import Path


def run_figures(out: Path) -> int:
    """Draw the paper's theoretical figures and print their paths; return the exit status."""
    from handtouch.field.figures import draw_figures

    try:
        paths = draw_figures(out)
    except (ImportError, OSError) as error:
        print(f"handtouch figures: {error}", file=sys.stderr)
        return 1
    print(*paths, sep="\n")
    return 0


def run_design(config_path: Path, link: str | None, out: Path) -> int:
    """Draw one pad of a deployment, print the paths and its expected errors; return the exit status.

    2 for an invalid file or link, 1 without matplotlib or if the folder cannot be written.
    """
    from handtouch import config
    from handtouch.hand.design import FIRM_TOUCH_N, draw_design, error_summary, pad_design

    try:
        pad = pad_design(config.load(config_path), link)
    except (config.ConfigError, ValueError) as error:
        print(f"handtouch design: {error}", file=sys.stderr)
        return 2
    try:
        paths = draw_design(pad, out)
    except (ImportError, OSError) as error:
        print(f"handtouch design: {error}", file=sys.stderr)
        return 1
    print(*paths, sep="\n")
    for force in (pad.light_touch_n, FIRM_TOUCH_N):
        median, worst = (1e3 * value for value in error_summary(pad, force))
        print(f"{force:g} N: expected location error {median:.3g} mm median, {worst:.3g} mm at worst")
    return 0
