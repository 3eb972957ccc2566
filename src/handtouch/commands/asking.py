"""Commands that ask a running daemon over its control endpoint; `handtouch.view.control` does the work."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handtouch.commands.options import (
    CONTROL,
    LIVE,
    Command,
    Commands,
    add_endpoint,
    add_json,
    command,
    positive,
)

if TYPE_CHECKING:
    from handtouch.view import control


def add(commands: Commands) -> None:
    """Add them to the command line."""
    tare = _asking(commands, "tare", _tare, "take what untouched pads read for zero; loaded ones are refused")
    _add_pads(tare, nargs="*", default=["*"], text="(default: all)")

    _add_scene(commands)
    _asking(commands, "snapshot", _snapshot, "the whole hand as it is now")

    _add_calibrate(commands)

    for name, text in (("disable", "switch pads off: no contacts, no power"), ("enable", "switch pads on")):
        switch = _asking(commands, name, _switch, text)
        switch.set_defaults(on=name == "enable")
        _add_pads(switch, nargs="+")
        switch.add_argument("--name", default=None, help="who says so (default: your login name)")

    reload = _asking(commands, "reload", _reload, "have the daemon read its deployment file again")
    reload.add_argument("--dry-run", action="store_true", help="tell what would change, change nothing")

    log = _asking(commands, "log", _log, "how much the daemon says")
    log.add_argument("level", choices=("debug", "info", "warning", "error"))


def _add_calibrate(commands: Commands) -> None:
    calibrate = _asking(
        commands,
        "calibrate",
        _calibrate,
        "find a pad's contact law by known weights (--weights), or give it a calibration (--name); with "
        "neither, show what is in force",
    )
    calibrate.add_argument("pad", metavar="PAD", help='pad, such as "left/index_distal"')

    guided = calibrate.add_argument_group("guided, by known weights")
    guided.add_argument(
        "--weights", metavar="LIST", help="such as 20,50,100,200,500; 200@4: on a radius of 4 mm"
    )
    guided.add_argument(
        "--config", type=Path, metavar="FILE", help="deployment file that the daemon runs with"
    )
    guided.add_argument("--unit", choices=("gf", "n"), default="gf", help="of the weights (default: gf)")
    guided.add_argument(
        "--repeats", type=_count, default=3, metavar="N", help="times that each is read (default: 3)"
    )
    guided.add_argument(
        "--radius-mm", type=positive, metavar="MM", help="of what they stand on (default: contact_radius_mm)"
    )
    guided.add_argument(
        "--radius-std-mm", type=positive, metavar="MM", help="how sure that is (default: the file's, or 5 %%)"
    )
    guided.add_argument("--log", type=Path, metavar="FILE", help="record the readings")
    guided.add_argument(
        "--from", dest="from_file", type=Path, metavar="FILE", help="fit a recorded session anew"
    )
    guided.add_argument("--plot", type=Path, metavar="PNG", help="draw current against force")
    guided.add_argument("--yes", action="store_true", help="put the law in force without asking")
    guided.add_argument("--no-store", dest="store", action="store_false", help="only until the daemon ends")
    guided.add_argument(
        "--seconds", type=positive, default=60.0, metavar="S", help="wait so long for a weight (default: 60)"
    )
    guided.add_argument("--live", default=LIVE, help=f"live endpoint (default: {LIVE})")

    direct = calibrate.add_argument_group("direct; what isn't given stays as it is")
    direct.add_argument("--name", help="of the calibration, as contacts will tell it")
    direct.add_argument("--gains", type=float, nargs=4, metavar="G", help="of the channels x0, xa, y0, yb")
    direct.add_argument("--offsets", type=float, nargs=4, metavar="COUNTS", help="what they read untouched")
    direct.add_argument(
        "--law",
        type=float,
        nargs=3,
        metavar=("K", "ALPHA", "OHM"),
        help="contact_ohm_mm2, alpha and ohm_per_square, as in [sheet.NAME]",
    )


def _add_scene(commands: Commands) -> None:
    scene = _asking(commands, "scene", _scene, "what is used of the hand: show it, or change it")
    scene.add_argument(
        "--links", type=_listed, metavar="PATTERNS", help='such as "thumb_*,index_*"; "" for none'
    )
    scene.add_argument(
        "--outputs", type=_listed, metavar="NAMES", help='of location, strength, raw; "" for touched only'
    )
    scene.add_argument(
        "--tolerance-mm", type=float, metavar="MM", help="error of a location that does no harm"
    )
    scene.add_argument("--rate-hz", type=float, metavar="HZ", help="updates that are enough; 0: every SYNC")
    scene.add_argument("--name", help="add a scene of this client's to the others, for --lease-s")
    scene.add_argument("--lease-s", type=positive, metavar="S", help="how long it lasts (default: 10)")
    scene.add_argument(
        "--reset",
        action="store_true",
        default=None,
        help="back to the deployment file's; with --name: end it",
    )


def _add_pads(parser: argparse.ArgumentParser, text: str = "", **options: Any) -> None:
    parser.add_argument(
        "pads", metavar="PAD", help=f'pads such as "thumb_*" or "left/index_distal" {text}'.strip(), **options
    )


def _asking(commands: Commands, name: str, function: Command, text: str) -> argparse.ArgumentParser:
    parser = command(commands, name, function, text)
    add_endpoint(parser, CONTROL, "control endpoint")
    add_json(parser)
    return parser


def _tare(asked: argparse.Namespace) -> int:
    from handtouch.view import control

    return control.run_tare(_to(asked), asked.pads)


def _scene(asked: argparse.Namespace) -> int:
    from handtouch.view import control

    keys = ("links", "outputs", "tolerance_mm", "rate_hz", "name", "lease_s", "reset")
    return control.run_scene(_to(asked), **{key: getattr(asked, key) for key in keys})


def _snapshot(asked: argparse.Namespace) -> int:
    from handtouch.view import control

    return control.run_snapshot(_to(asked))


def _calibrate(asked: argparse.Namespace) -> int:
    guided = asked.weights is not None or asked.from_file is not None
    direct = {"gains": asked.gains, "offset_counts": asked.offsets, "law": asked.law}
    given = {key: value for key, value in direct.items() if value is not None}
    if wrong := _mixed(asked, guided, bool(given)):
        print(f"handtouch calibrate: {wrong}", file=sys.stderr)
        return 2
    if guided:
        return _guided(asked)
    from handtouch.view import control

    if asked.law is not None:
        given["law"] = dict(zip(("contact_ohm_mm2", "alpha", "ohm_per_square"), asked.law, strict=True))
    if asked.name is not None:
        given["name"] = asked.name
    return control.run_calibrate(_to(asked), pad=asked.pad, **given)


def _mixed(asked: argparse.Namespace, guided: bool, given: bool) -> str:
    """What doesn't go together, and the remedy; empty if all does."""
    if guided and (given or asked.name is not None):
        return "--weights and --from find a law, --name, --gains, --offsets and --law give one: take either"
    if guided and asked.config is None:
        return "--config FILE is missing: the deployment file that the daemon runs with"
    if asked.weights is not None and asked.from_file is not None:
        return "--weights reads new weights, --from takes recorded ones: take either"
    if given and asked.name is None:
        return "--name NAME is missing: contacts tell the calibration by it"
    return ""


def _guided(asked: argparse.Namespace) -> int:
    from handtouch import calibrate

    keys = ("pad", "config", "unit", "repeats", "radius_mm", "radius_std_mm", "log", "from_file", "plot")
    options = calibrate.Options(
        **{key: getattr(asked, key) for key in (*keys, "yes", "store")},
        weights=asked.weights or "",
        as_json=asked.json,
        patience_s=asked.seconds,
    )
    return calibrate.run(options, calibrate.Asked(asked.live, asked.endpoint, asked.key))


def _switch(asked: argparse.Namespace) -> int:
    import getpass

    from handtouch.view import control

    return control.run_switch(_to(asked), asked.on, asked.pads, asked.name or getpass.getuser())


def _reload(asked: argparse.Namespace) -> int:
    from handtouch.view import control

    return control.run_reload(_to(asked), trial=asked.dry_run)


def _log(asked: argparse.Namespace) -> int:
    from handtouch.view import control

    return control.run_log(_to(asked), asked.level)


def _to(asked: argparse.Namespace) -> control.Asking:
    from handtouch.view import control

    return control.Asking(asked.endpoint, asked.key, asked.json)


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 100:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number, 1 to 100")
    return int(text)
