"""`handtouch node`: run sensor nodes, or print the noise of their channels."""

from __future__ import annotations

import argparse
import logging
from contextlib import closing
from pathlib import Path
from typing import Any

from handtouch import config
from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_config, add_json, add_number, integer
from handtouch.cli.tables import make_table, output_console
from handtouch.host import logs
from handtouch.host.json_output import print_json
from handtouch.host.signals import stop_on_signals
from handtouch.node import service
from handtouch.node.adc_fault import AdcError
from handtouch.node.noise import PadNoise, measure_noise, position_noise
from handtouch.node.settings import NodeFile, json_schema, load

_PREFIX = "handtouch node: "


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `node`."""
    parser.set_defaults(command=run_command)
    add_config(parser, "file of the node (TOML), see docs/build.md", nargs="?")
    parser.add_argument(
        "--measure-noise",
        action="store_true",
        help="measure the noise of every channel of untouched pads, in counts and A, instead",
    )
    parser.add_argument(
        "--deployment",
        type=Path,
        metavar="FILE",
        help="deployment file, to also print the position noise that results on its pads",
    )
    parser.add_argument(
        "--samples",
        type=integer(10, 100_000, "a number of samples, 10 to 100000"),
        default=400,
        metavar="N",
        help="samples to measure noise with (default: 400)",
    )
    add_number(parser, "--period-ms", "MS", "time between these samples", default=5.0)
    add_json(parser, "print the noise as JSON")
    parser.add_argument(
        "--schema", action="store_true", help="print the JSON schema of the node's file instead"
    )


def run_command(config_path: Path | None, *, schema: bool, measure_noise: bool, **options: Any) -> int:
    """Run the command; exit status 0, 1 (bus, ADC or state file), 2 (wrong usage or invalid file)."""
    if schema:
        print_json(json_schema())
        return 0
    if config_path is None:
        raise CommandError("handtouch node: give the file of the node, or --schema", 2)
    file = load(config_path)
    deployment = config.load(options["deployment"]) if options["deployment"] else None
    if measure_noise:
        return _print_noise(
            file, deployment, options["samples"], options["period_ms"] * 1e-3, options["as_json"]
        )
    return _run(file)


def _run(file: NodeFile) -> int:
    stop = stop_on_signals()
    logging.getLogger("canopen").setLevel(logging.CRITICAL)
    with (
        closing(logs.start_logging(file.settings.log_level)),
        failing(1, OSError, ValueError, prefix=_PREFIX),
    ):
        service.run(file, stop)
    return 0


def _print_noise(
    file: NodeFile, deployment: config.Deployment | None, samples: int, period_s: float, as_json: bool
) -> int:
    with failing(1, AdcError, ValueError, prefix=_PREFIX):
        measured = measure_noise(file, samples, period_s)
        positions = [position_noise(noise, deployment) if deployment else [] for noise in measured]
    pairs = list(zip(measured, positions, strict=True))
    if as_json:
        print_json([_noise_map(noise, errors) for noise, errors in pairs])
        return 0
    for noise, errors in pairs:
        print(f"pad {noise.pad.name}: {noise.samples} samples")
        scale, unit = (1e-3, ", A") if noise.pad.full_scale is None else (1.0, "")
        names = f"mean{unit}", f"1 sigma{unit}", "1 sigma, counts"
        table = make_table("channel", *names, right=names)
        columns = zip(noise.pad.channels, noise.mean_ma, noise.std_ma, noise.std_counts, strict=True)
        for channel, mean, std, counts in columns:
            table.add_row(channel, f"{scale * mean:.3e}", f"{scale * std:.3e}", f"{counts:.2f}")
        output_console().print(table)
        for link, force, median, worst in errors:
            print(
                f"  position noise on {link} at {force:g} N: {1e3 * median:.2g} mm median, "
                f"{1e3 * worst:.2g} mm at worst"
            )
    if deployment is None:
        print("give --deployment FILE for the position noise on its pads")
    return 0


def _noise_map(noise: PadNoise, errors: list[tuple[str, float, float, float]]) -> dict[str, Any]:
    scale, unit = (1e-3, "_a") if noise.pad.full_scale is None else (1.0, "")
    return {
        "pad": noise.pad.name,
        "samples": noise.samples,
        "channels": noise.pad.channels,
        f"mean{unit}": scale * noise.mean_ma,
        f"std{unit}": scale * noise.std_ma,
        "std_counts": noise.std_counts,
        "position": [
            {"link": link, "force_n": force, "median_m": median, "worst_m": worst}
            for link, force, median, worst in errors
        ],
    }
