"""Commands that send one request to a running daemon: tare, scene, snapshot, enable, ...

Exit status 0, 1 (no daemon answers, it refuses, or a pad was refused), 2 (an invalid endpoint or key file).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

from handtouch import wire
from handtouch.cli.errors import failing
from handtouch.cli.options import (
    add_endpoint,
    add_json,
    add_number,
    comma_separated,
)
from handtouch.client import request
from handtouch.client.control import LONG_TIMEOUT_S, SHORT_TIMEOUT_S, SLOW_COMMANDS
from handtouch.host.json_output import print_json
from handtouch.host.user import user_name
from handtouch.view.message_lines import names_text

Reply = Mapping[str, Any]


def add_tare(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tare`."""
    add_request(parser, partial(run_request, "tare", _tare_lines))
    _add_pads(parser, nargs="*", default=["*"], text="(default: all)")


def add_snapshot(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `snapshot`."""
    add_request(parser, partial(run_request, "snapshot", _snapshot_lines))


def add_disable(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `disable`."""
    add_request(parser, partial(run_request, "disable", _disabled_lines))
    _add_pads(parser, nargs="+")
    parser.add_argument(
        "--name",
        default=user_name(),
        help="name shown as the reason in `status` and health messages (default: your login name)",
    )


def add_enable(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `enable`."""
    add_request(parser, partial(run_request, "enable", _disabled_lines))
    _add_pads(parser, nargs="+")
    parser.set_defaults(name=user_name())


def add_reload(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `reload`."""
    add_request(parser, partial(run_request, "reload", _reload_lines))
    parser.add_argument("--dry-run", action="store_true", help="print the changes without applying them")


def add_object(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `object`."""
    add_request(parser, partial(run_request, "object", _object_lines))
    parser.add_argument("hand", metavar="HAND", help="name of the hand")
    parser.add_argument(
        "name", metavar="NAME", nargs="?", help="object of the deployment (default: no change)"
    )
    parser.add_argument(
        "--table",
        type=json.loads,
        metavar="JSON",
        help='another object, as its table: {"shape": {"kind": "sphere", "diameter_mm": 60}}',
    )
    parser.add_argument("--none", action="store_true", default=None, help="the hand handles no known object")


def add_log(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `log`."""
    add_request(parser, partial(run_request, "log", _log_lines))
    parser.add_argument(
        "level", choices=("debug", "info", "warning", "error"), help="least severity that is logged"
    )


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `scene`."""
    add_request(parser, partial(run_request, "scene", scene_lines))
    parser.add_argument(
        "--links",
        type=comma_separated,
        metavar="PATTERNS",
        help='links in use, such as "thumb_*,index_*"; the other pads are switched off',
    )
    parser.add_argument(
        "--outputs",
        type=comma_separated,
        metavar="NAMES",
        help="outputs in use, of position, force, raw (samples), palm and base (positions in these frames), "
        'motion (slip), shape, friction, object; "": only whether a pad is touched',
    )
    parser.add_argument(
        "--rate-hz", type=float, metavar="HZ", help="rate of contact updates; 0: one per SYNC"
    )
    parser.add_argument(
        "--name",
        help="owner of a temporary scene, which is added to the other scenes; without it, the default scene "
        "is changed",
    )
    add_number(parser, "--lease-s", "S", "lifetime of the temporary scene (default: 10)")
    parser.add_argument(
        "--reset",
        action="store_true",
        default=None,
        help="restore the deployment file's scene; with --name: end that scene",
    )


def _add_pads(parser: argparse.ArgumentParser, text: str = "", **options: Any) -> None:
    parser.add_argument(
        "pads", metavar="PAD", help=f'pads such as "thumb_*" or "left/index_distal" {text}'.strip(), **options
    )


def add_request(parser: argparse.ArgumentParser, run: Callable[..., int], *, config: bool = True) -> None:
    """Set the function that runs a command, and add the options of the control endpoint."""
    parser.set_defaults(command=run)
    add_endpoint(parser, "control", config=config)
    add_json(parser)


def send_request(command: str, endpoint: str, key: str | None, **arguments: Any) -> dict[str, Any]:
    """Return the daemon's answer to a request; errors end the command."""
    with failing(2, ValueError), failing(1, OSError, RuntimeError):
        timeout_s = SHORT_TIMEOUT_S
        if command in SLOW_COMMANDS:  # report a missing daemon without the long timeout; any key may ask this
            request("status", endpoint=endpoint, key=key, timeout_s=timeout_s)
            timeout_s = LONG_TIMEOUT_S
        return request(command, endpoint=endpoint, key=key, timeout_s=timeout_s, **arguments)


def run_request(
    command: str,
    format_lines: Callable[[Reply], Iterable[str]],
    *,
    endpoint: str,
    key: str | None,
    as_json: bool,
    **arguments: Any,
) -> int:
    """Send a request with the arguments that aren't None, and print the answer, by default as lines."""
    given = {name: value for name, value in arguments.items() if value is not None}
    answer = _with_arrays(send_request(command, endpoint, key, **given))
    if as_json:
        print_json(answer)
    else:
        for line in format_lines(answer):
            print(line)
    return 0 if command != "tare" or all(pad["tared"] for pad in answer["pads"]) else 1


def _object_lines(answer: Reply) -> Iterator[str]:
    shape = (answer["table"] or {}).get("shape", {})
    keys = ", ".join(f"{key} {value}" for key, value in shape.items())
    yield (
        f"{answer['hand']}: {answer['name']}, {keys}"
        if answer["name"]
        else f"{answer['hand']}: no known object"
    )


def _log_lines(answer: Reply) -> Iterator[str]:
    yield f"log level {answer['level']}, was {answer['previous_level']}"


def _tare_lines(answer: Reply) -> Iterator[str]:
    for pad in answer["pads"]:
        counts = ", ".join(f"{offset:.1f}" for offset in pad["offset_counts"])
        done = f"tared at {counts} counts ({pad['samples']} samples)"
        if least := pad.get("least_begin_threshold_n"):
            done += f"; begin_threshold_n {pad['begin_threshold_n']:g}, least {least:.2g}"
        yield f"{pad['hand']}/{pad['link']}: {done if pad['tared'] else 'not tared: ' + pad['reason']}"


def calibration_lines(answer: Reply) -> Iterator[str]:
    active, previous = answer["calibration_id"], answer["previous_calibration_id"]
    was = "" if previous == active else f", was {previous}"
    yield f"{answer['hand']}/{answer['link']}: calibration {active}{was}"
    yield f"gains    {'  '.join(f'{gain:.5g}' for gain in answer['gains'])}"
    yield f"offsets  {'  '.join(f'{offset:.1f}' for offset in answer['offset_counts'])} counts"
    for name, law in (("law", answer["law"]), ("second", answer.get("second_law"))):
        if law is not None:
            hertz = f", hertz_force_n {law['hertz_force_n']:.4g}" if law["hertz_force_n"] else ""
            yield (
                f"{name:<8} contact_ohm_mm2 {law['contact_ohm_mm2']:.5g}, alpha {law['alpha']:.4g}, "
                f"ohm_per_square {law['ohm_per_square']:.5g}{hertz}"
            )


def _with_arrays(answer: Reply) -> Reply:
    """Return an answer with the columns of hands as arrays, which `snapshot` has."""
    if "hands" not in answer:
        return answer
    columns = wire.COLUMNS[wire.HandFrame]
    hands = {
        name: {key: columns[key].to_array(value) if key in columns else value for key, value in frame.items()}
        for name, frame in answer["hands"].items()
    }
    return {**answer, "hands": hands}


def _snapshot_lines(answer: Reply) -> Iterator[str]:
    contacts = {(contact["hand"], contact["link"]): contact for contact in answer["contacts"]}
    for hand, frame in answer["hands"].items():
        for link, state in zip(frame["links"], frame["state"], strict=True):
            line = f"{hand}/{link}: {wire.PadState(state).text}"
            if contact := contacts.get((hand, link)):
                line += _contact_suffix(contact)
            yield line


def _contact_suffix(contact: Reply) -> str:
    position, force = contact["position_m"], contact["force_n"]
    at = f" at ({', '.join(f'{1e3 * x:.1f}' for x in position)}) mm" if position else ""
    return at + (f" with {force:.2f} N" if force is not None else "") + f" for {contact['duration_s']:.1f} s"


def _disabled_lines(answer: Reply) -> Iterator[str]:
    if not answer["disabled"]:
        yield "all pads are enabled"
    for name, by in answer["disabled"].items():
        yield f"{name}: disabled by {by}"


def _reload_lines(answer: Reply) -> Iterator[str]:
    would = "" if answer["applied"] else "would be "
    for table in answer["tables"]:
        yield f"[{table}]: {would}changed"
    for name, keys in answer["pads"].items():
        yield f"{name}: {would}changed: {', '.join(keys)}"
    if not answer["tables"] and not answer["pads"]:
        yield "no changes"


def scene_lines(answer: Reply) -> Iterator[str]:
    """Format the daemon's answer to `scene`: active scenes, then pads grouped by their outputs."""
    for scene in answer["scenes"]:
        rate = "every SYNC" if scene["rate_hz"] is None else f"{scene['rate_hz']:g} Hz"
        lease = "" if scene["lease_s"] is None else f"; expires in {scene['lease_s']:.0f} s"
        yield (
            f"scene of {scene['owner']}: links {', '.join(scene['links']) or 'none'}; "
            f"{', '.join(scene['outputs']) or 'touched only'}; {rate}{lease}"
        )
    alike: dict[tuple[str, ...], list[str]] = {}
    for pad in answer["pads"]:
        alike.setdefault(_pad_text(pad), []).append(f"{pad['hand']}/{pad['link']}")
    for (computed, not_computed, clients), names in alike.items():
        yield f"{names_text(names)}: computed {computed}{clients}{not_computed}"


def _pad_text(pad: Reply) -> tuple[str, ...]:
    reasons: dict[str, list[str]] = {}
    for output, reason in pad["not_computed"].items():
        reasons.setdefault(reason, []).append(output)
    not_computed = "; ".join(f"{', '.join(outputs)} ({reason})" for reason, outputs in reasons.items())
    rate = f" at {pad['rate_hz']:g} Hz" if pad["computed"] else ""
    clients = [*pad["scenes"], *(f"subscriber to {prefix or 'all'}" for prefix in pad["subscriptions"])]
    return (
        (", ".join(pad["computed"]) or "nothing") + rate,
        f"; not computed {not_computed}" if not_computed else "",
        f", for {', '.join(clients)}" if clients and pad["computed"] else "",
    )
