"""Arguments of the setup commands: `check`, `doctor`, `scan`, `conformance`, `commission` and drawings."""

from __future__ import annotations

from pathlib import Path

from handtouch.cli.options import (
    Subparsers,
    add_bus,
    add_command,
    add_config,
    add_json,
    add_output,
    integer,
    positive_number,
)


def add(commands: Subparsers) -> None:
    """Add `check`, `doctor`, `scan`, `conformance`, `commission`, `figures` and `design`."""
    check = add_command(
        commands,
        "check",
        "handtouch.cli.check_text:run",
        "check a deployment file: errors, bus load, warnings (exit status 1)",
    )
    add_config(check, nargs="?")
    add_bus(check)
    add_json(check)
    check.add_argument(
        "--schema", action="store_true", help="print the JSON schema of deployment files instead"
    )

    doctor = add_command(
        commands,
        "doctor",
        "handtouch.cli.doctor_text:run",
        "check that this machine can run the daemon: packages, clock, socket buffers, CAN interfaces, "
        "endpoints",
    )
    add_config(doctor, "deployment file, to check its buses and endpoints too", nargs="?")
    add_json(doctor)

    _add_scan(commands)
    _add_conformance(commands)
    _add_commission(commands)

    figures = add_command(
        commands,
        "figures",
        "handtouch.cli.drawing_text:run_figures",
        "draw the theoretical figures of the paper that the sensor model comes from",
    )
    add_output(
        figures, "out", "folder to write to (default: figures)", default=Path("figures"), metavar="FOLDER"
    )
    add_json(figures)

    _add_design(commands)


def _add_design(commands: Subparsers) -> None:
    design = add_command(
        commands,
        "design",
        "handtouch.cli.design_text:run",
        "draw a pad's expected position error, or find the best electrodes for a goal (docs/design.md)",
    )
    add_config(design)
    design.add_argument("--link", metavar="LINK", help="pad to design (default: the first)")
    add_output(
        design, "out", "folder to write to (default: design)", default=Path("design"), metavar="FOLDER"
    )
    add_json(design)
    design.add_argument(
        "--goal",
        choices=("position", "force", "two-contacts", "linearity"),
        help="optimise: standard deviation of position or of force, least separation of two contacts, error "
        "of plain log-ratios; default: draw the pad as it is",
    )
    design.add_argument(
        "--statistic",
        choices=("worst", "mean"),
        default="worst",
        help="of the goal over the inner 80 %% of the pad (default: worst; mean: root mean square)",
    )
    design.add_argument(
        "--world",
        choices=("ideal", "default", "harsh"),
        default="default",
        help="tolerances of the parts (default: default; ideal: none, the nominal optimum)",
    )
    design.add_argument(
        "--force",
        dest="force_n",
        type=positive_number,
        default=1.0,
        metavar="N",
        help="force of the contacts to design for (default: 1)",
    )
    design.add_argument(
        "--electrodes",
        type=integer(4, 12, "4 to 12 electrodes"),
        metavar="COUNT",
        help="electrodes anywhere on the boundary, for a node of as many channels; default: one on each "
        "side, which a deployment can describe",
    )
    for name, default, text in (
        ("min-gap-mm", 0.3, "least bare length at an end of an electrode"),
        ("min-electrode-mm", 3.0, "least length of an electrode"),
    ):
        design.add_argument(
            f"--{name}",
            type=positive_number,
            default=default,
            metavar="MM",
            help=f"{text} (default: {default})",
        )
    design.add_argument(
        "--max-series-ohm",
        type=float,
        default=1000.0,
        metavar="OHM",
        help="largest series resistor; 0: none are used (default: 1000)",
    )
    design.add_argument(
        "--no-check", dest="check", action="store_false", help="skip the check by the simulator"
    )


def _add_scan(commands: Subparsers) -> None:
    scan = add_command(
        commands,
        "scan",
        "handtouch.cli.scan_text:run",
        "find the nodes on CAN buses, compare them with a deployment file, and print the tables to add to it",
    )
    add_config(scan, "deployment file to compare with", nargs="?")
    add_bus(
        scan,
        "bus to scan, e.g. can0=socketcan:can0; with CONFIG, the interface to open for bus NAME instead of "
        "the one in the file; repeatable",
    )
    scan.add_argument(
        "--seconds",
        type=positive_number,
        metavar="S",
        help="time to listen before nodes are queried (default: 1, with --listen 5)",
    )
    add_json(scan)
    mode = scan.add_mutually_exclusive_group()
    mode.add_argument("--listen", action="store_true", help="only listen: send no frame at all")
    mode.add_argument(
        "--lss", action="store_true", help="also find nodes without a node id (LSS); changes none"
    )
    mode.add_argument(
        "--assign",
        type=integer(1, 127, "a node id, 1 to 127 (0x01 to 0x7F)"),
        metavar="FIRST_ID",
        help="find nodes without a node id and store one in each: the deployment's for that serial number, "
        "else the first free one from FIRST_ID upwards, in the order of serial numbers",
    )
    scan.add_argument(
        "--lss-wait-ms",
        type=positive_number,
        default=5.0,
        metavar="MS",
        help="minimum time to wait for an LSS response (default: 5)",
    )


def _add_conformance(commands: Subparsers) -> None:
    conformance = add_command(
        commands,
        "conformance",
        "handtouch.cli.conformance_text:run",
        "test sensor nodes on a bus against docs/firmware.md: objects, NMT, heartbeat, EMCY, PDO timing, LSS",
    )
    conformance.add_argument(
        "names",
        nargs="*",
        metavar="NODE",
        help='node id (5, 0x05, can0:5) or, with --config, pad ("right/index_distal", "thumb_*")',
    )
    conformance.add_argument(
        "--all", dest="all_nodes", action="store_true", help="all nodes: of the deployment, or that respond"
    )
    conformance.add_argument(
        "--config",
        dest="config_path",
        type=Path,
        metavar="CONFIG",
        help="deployment file with the buses, and what it states about the nodes (channels, EDS, identity, "
        "noise, excitation)",
    )
    add_bus(
        conformance,
        "bus, e.g. can0=socketcan:can0; with --config, the interface to open for bus NAME instead of the one "
        "in the file; repeatable",
    )
    conformance.add_argument(
        "--eds", type=Path, metavar="FILE", help="EDS to compare the object dictionary with"
    )
    conformance.add_argument(
        "--sync-ms",
        type=positive_number,
        metavar="MS",
        help="shortest SYNC period; twice and four times that are tested, too (default: that of the "
        "deployment, or 5)",
    )
    conformance.add_argument(
        "--no-reset",
        action="store_true",
        help="send no NMT reset, by which a node loses settings that it hasn't stored",
    )
    conformance.add_argument("--no-lss", action="store_true", help="send no LSS request")
    output = conformance.add_mutually_exclusive_group()  # prompts are no JSON
    output.add_argument(
        "--interactive",
        action="store_true",
        help="also prompt for a power cycle, a press and an error (keys: s skips a step, q quits)",
    )
    add_json(output)
    conformance.add_argument(
        "--report",
        dest="report_path",
        type=Path,
        metavar="FILE",
        help="also write the report to a file: JSON if its name ends in .json, else text",
    )


def _add_commission(commands: Subparsers) -> None:
    commission = add_command(
        commands,
        "commission",
        "handtouch.cli.commission_text:run",
        "identify each pad's node, electrode order and dead channels from guided presses, and write "
        "them to the deployment file",
    )
    add_config(commission)
    add_bus(commission)
    commission.add_argument(
        "--link",
        dest="links",
        action="append",
        default=[],
        metavar="PATTERN",
        help='pads to commission, such as "thumb_*" or "left/index_distal"; repeatable (default: all that '
        "are not done yet)",
    )
    commission.add_argument(
        "--dry-run", action="store_true", help="print the changes of the file instead of writing them"
    )
    commission.add_argument(
        "--yes",
        dest="assume_yes",
        action="store_true",
        help="accept nodes found on each other's links without confirmation",
    )
    commission.add_argument(
        "--seconds",
        dest="timeout_s",
        type=positive_number,
        default=60.0,
        metavar="S",
        help="time limit for a press or a key (default: 60)",
    )
    add_json(commission)
