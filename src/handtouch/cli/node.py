"""Arguments of the command that runs sensor nodes: `node`."""

from __future__ import annotations

from pathlib import Path

from handtouch.cli.options import Subparsers, add_command, add_config, add_json, integer, positive_number


def add(commands: Subparsers) -> None:
    """Add `node`."""
    node = add_command(
        commands,
        "node",
        "handtouch.cli.node_text:run_command",
        "run sensor nodes on this computer: four ADC channels per pad (Linux IIO), CANopen on its CAN "
        "interface, until SIGINT or SIGTERM",
    )
    add_config(node, "file of the node (TOML), see docs/build.md", nargs="?")
    node.add_argument(
        "--measure-noise",
        action="store_true",
        help="measure the noise of every channel of untouched pads, in counts and A, instead",
    )
    node.add_argument(
        "--deployment",
        type=Path,
        metavar="FILE",
        help="deployment file, to also print the position noise that results on its pads",
    )
    node.add_argument(
        "--samples",
        type=integer(10, 100_000, "a number of samples, 10 to 100000"),
        default=400,
        metavar="N",
        help="samples to measure noise with (default: 400)",
    )
    node.add_argument(
        "--period-ms",
        type=positive_number,
        default=5.0,
        metavar="MS",
        help="time between these samples (default: 5)",
    )
    add_json(node, "print the noise as JSON")
    node.add_argument(
        "--schema", action="store_true", help="print the JSON schema of the node's file instead"
    )
