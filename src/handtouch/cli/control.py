"""Arguments of the commands that send a request to a running daemon: `tare`, `scene`, `calibrate`, ..."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from handtouch.cli.options import (
    LIVE_HELP,
    Subparsers,
    add_command,
    add_endpoint,
    add_json,
    comma_separated,
    integer,
    positive_number,
)
from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT

_TEXT = "handtouch.cli.control_text"


def add(commands: Subparsers) -> None:
    """Add `tare`, `scene`, `snapshot`, `calibrate`, `disable`, `enable`, `reload` and `log`."""
    tare = _add_request(commands, "tare", f"{_TEXT}:run_tare", "zero (tare) pads; refused for loaded pads")
    _add_pads(tare, nargs="*", default=["*"], text="(default: all)")

    _add_scene(commands)
    _add_request(
        commands,
        "snapshot",
        f"{_TEXT}:run_snapshot",
        "print every pad once: touched or not, and its contact with position and force",
    )
    _add_calibrate(commands)

    disable = _add_request(
        commands, "disable", f"{_TEXT}:run_disable", "disable pads: no contacts, excitation off"
    )
    _add_pads(disable, nargs="+")
    disable.add_argument(
        "--name", help="name shown as the reason in `status` and health messages (default: your login name)"
    )
    _add_pads(
        _add_request(commands, "enable", f"{_TEXT}:run_enable", "enable disabled pads again"), nargs="+"
    )

    reload = _add_request(
        commands,
        "reload",
        f"{_TEXT}:run_reload",
        "make the daemon read its deployment file again; pads that don't change are not disturbed",
    )
    reload.add_argument("--dry-run", action="store_true", help="print the changes without applying them")

    log = _add_request(commands, "log", f"{_TEXT}:run_log", "set the daemon's log level")
    log.add_argument(
        "level", choices=("debug", "info", "warning", "error"), help="least severity that is logged"
    )


def _add_calibrate(commands: Subparsers) -> None:
    calibrate = _add_request(
        commands,
        "calibrate",
        "handtouch.cli.calibrate_text:run",
        "measure a pad's contact law (force against current) with known weights (--weights), or set values "
        "of its calibration (--gains, --offsets, --law); with neither, print the active calibration",
    )
    calibrate.add_argument("pad", metavar="PAD", help='pad, such as "left/index_distal"')

    _add_guided(calibrate.add_argument_group("guided measurement with known weights"))
    _add_direct(calibrate.add_argument_group("direct setting; omitted values are left unchanged"))


def _add_guided(guided: argparse._ArgumentGroup) -> None:
    guided.add_argument(
        "--weights",
        default="",
        metavar="LIST",
        help="weights to place, such as 20,50,100,200,500 (unit: --unit); 200@4: on a base of radius 4 mm",
    )
    guided.add_argument(
        "--config", type=Path, metavar="CONFIG", help="deployment file that the daemon runs with (required)"
    )
    guided.add_argument(
        "--unit",
        dest="weight_unit",
        choices=("gf", "n"),
        default="gf",
        help="unit of the weights: gram-force or newton (default: gf)",
    )
    guided.add_argument(
        "--repeats",
        type=integer(1, 100, "an integer, 1 to 100"),
        default=3,
        metavar="N",
        help="measurements per weight (default: 3)",
    )
    guided.add_argument(
        "--radius-mm",
        type=positive_number,
        metavar="MM",
        help="radius of the contact under the weights (default: the sheet's contact_radius_mm); of a round "
        "base at hertz_force_n, else at the geometric mean of the weights",
    )
    guided.add_argument(
        "--radius-std-mm",
        type=positive_number,
        metavar="MM",
        help="error of that radius, 1 sigma (default: contact_radius_std_mm, or 5 %% of --radius-mm)",
    )
    guided.add_argument("--log", type=Path, metavar="FILE", help="record the readings to this file")
    guided.add_argument(
        "--from",
        dest="from_file",
        type=Path,
        metavar="FILE",
        help="fit readings recorded with --log instead of measuring",
    )
    guided.add_argument("--plot", type=Path, metavar="PNG", help="plot current against force")
    guided.add_argument("--yes", action="store_true", help="apply the law without confirmation")
    guided.add_argument(
        "--no-store",
        dest="store",
        action="store_false",
        help="don't store the calibration: it lasts until the daemon exits",
    )
    guided.add_argument(
        "--seconds",
        dest="timeout_s",
        type=positive_number,
        default=60.0,
        metavar="S",
        help="time limit for placing a weight or pressing a key (default: 60)",
    )
    guided.add_argument(
        "--live", default=LIVE_ENDPOINT, metavar="ENDPOINT", help=f"{LIVE_HELP} (default: {LIVE_ENDPOINT})"
    )


def _add_direct(direct: argparse._ArgumentGroup) -> None:
    direct.add_argument("--name", help="id of the new calibration, published in contact messages (required)")
    direct.add_argument(
        "--gains",
        type=float,
        nargs="+",
        metavar="G",
        help="relative gains of the electrodes' channels: x0, xa, y0, yb, or those of electrode_arcs_mm",
    )
    direct.add_argument(
        "--offsets", type=float, nargs="+", metavar="COUNTS", help="counts of the untouched channels"
    )
    direct.add_argument(
        "--law",
        type=float,
        nargs=3,
        metavar=("K", "ALPHA", "OHM"),
        help="contact_ohm_mm2, alpha and ohm_per_square, as in [sheet.NAME]",
    )
    direct.add_argument(
        "--hertz-force-n",
        type=positive_number,
        metavar="N",
        help="with --law: hertz_force_n, as in [sheet.NAME] (default: the same radius at every force)",
    )


def _add_scene(commands: Subparsers) -> None:
    scene = _add_request(
        commands,
        "scene",
        f"{_TEXT}:run_scene",
        "show or change the scene: the links and outputs that a task uses, and at what rate; the rest isn't "
        "computed",
    )
    scene.add_argument(
        "--links",
        type=comma_separated,
        metavar="PATTERNS",
        help='links in use, such as "thumb_*,index_*"; the other pads are switched off',
    )
    scene.add_argument(
        "--outputs",
        type=comma_separated,
        metavar="NAMES",
        help="outputs in use, of position, force, raw (samples), palm and base (positions in these frames), "
        'motion (slip), stiffness, shape, texture, friction; "": only whether a pad is touched',
    )
    scene.add_argument("--rate-hz", type=float, metavar="HZ", help="rate of contact updates; 0: one per SYNC")
    scene.add_argument(
        "--name",
        help="owner of a temporary scene, which is added to the other scenes; without it, the default scene "
        "is changed",
    )
    scene.add_argument(
        "--lease-s", type=positive_number, metavar="S", help="lifetime of the temporary scene (default: 10)"
    )
    scene.add_argument(
        "--reset",
        action="store_true",
        default=None,
        help="restore the deployment file's scene; with --name: end that scene",
    )


def _add_pads(parser: argparse.ArgumentParser, text: str = "", **options: Any) -> None:
    parser.add_argument(
        "pads", metavar="PAD", help=f'pads such as "thumb_*" or "left/index_distal" {text}'.strip(), **options
    )


def _add_request(commands: Subparsers, name: str, function: str, text: str) -> argparse.ArgumentParser:
    """Add a command with the options of the control endpoint."""
    parser = add_command(commands, name, function, text)
    add_endpoint(parser, CONTROL_ENDPOINT, "control endpoint")
    add_json(parser)
    return parser
