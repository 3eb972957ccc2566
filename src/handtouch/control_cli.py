"""Commands that ask a running daemon over its control endpoint; `handtouch.view.control` does the work."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from handtouch.cli import CONTROL, Command, add_endpoint, command, positive

if TYPE_CHECKING:
    from handtouch.view import control


def add_control(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add them to the command line."""
    tare = _asking(commands, "tare", _tare, "take what untouched pads read for zero; loaded ones are refused")
    _add_pads(tare, nargs="*", default=["*"], text="(default: all)")

    _add_scene(commands)
    _asking(commands, "snapshot", _snapshot, "the whole hand as it is now")

    calibrate = _asking(commands, "calibrate", _calibrate, "give a pad gains and offsets, under a name")
    calibrate.add_argument("pad", help='pad, such as "left/index_distal"')
    calibrate.add_argument("--name", required=True, help="of the calibration, as contacts will tell it")
    calibrate.add_argument(
        "--gains", type=float, nargs=4, metavar="G", default=[1.0] * 4, help="of the channels x0, xa, y0, yb"
    )
    calibrate.add_argument(
        "--offsets", type=float, nargs=4, metavar="COUNTS", default=[0.0] * 4, help="what they read untouched"
    )

    for name, text in (("disable", "switch pads off: no contacts, no power"), ("enable", "switch pads on")):
        switch = _asking(commands, name, _switch, text)
        switch.set_defaults(on=name == "enable")
        _add_pads(switch, nargs="+")
        switch.add_argument("--name", default=None, help="who says so (default: your login name)")

    reload = _asking(commands, "reload", _reload, "have the daemon read its deployment file again")
    reload.add_argument("--dry-run", action="store_true", help="tell what would change, change nothing")

    log = _asking(commands, "log", _log, "how much the daemon says")
    log.add_argument("level", choices=("debug", "info", "warning", "error"))


def _add_scene(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
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


def _asking(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, function: Command, text: str
) -> argparse.ArgumentParser:
    parser = command(commands, name, function, text)
    add_endpoint(parser, CONTROL, "control endpoint")
    parser.add_argument("--json", action="store_true", help="as JSON")
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
    from handtouch.view import control

    return control.run_calibrate(
        _to(asked), pad=asked.pad, name=asked.name, gains=asked.gains, offset_counts=asked.offsets
    )


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
