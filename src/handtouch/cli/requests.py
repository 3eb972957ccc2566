"""Output of the commands that send a request to a running daemon: tare, scene, snapshot, enable, ...

Each `run_...` sends one request and prints the answer. Exit status 0, 1 (no daemon answers, it refuses, or a
pad was refused), 2 (an invalid endpoint or key file).
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from handtouch import wire
from handtouch.cli.options import (
    add_endpoint,
    add_json,
    comma_separated,
    positive_number,
)
from handtouch.cli.scene_text import scene_lines
from handtouch.client import request
from handtouch.host.json_output import print_json
from handtouch.host.user import user_name

_SHORT_TIMEOUT_S, _LONG_TIMEOUT_S = 3.0, 60.0
Reply = Mapping[str, Any]


def add_tare(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tare`."""
    add_request(parser, run_tare)
    _add_pads(parser, nargs="*", default=["*"], text="(default: all)")


def add_snapshot(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `snapshot`."""
    add_request(parser, run_snapshot)


def add_disable(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `disable`."""
    add_request(parser, run_disable)
    _add_pads(parser, nargs="+")
    parser.add_argument(
        "--name", help="name shown as the reason in `status` and health messages (default: your login name)"
    )


def add_enable(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `enable`."""
    add_request(parser, run_enable)
    _add_pads(parser, nargs="+")


def add_reload(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `reload`."""
    add_request(parser, run_reload)
    parser.add_argument("--dry-run", action="store_true", help="print the changes without applying them")


def add_log(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `log`."""
    add_request(parser, run_log)
    parser.add_argument(
        "level", choices=("debug", "info", "warning", "error"), help="least severity that is logged"
    )


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `scene`."""
    add_request(parser, run_scene)
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
        'motion (slip), shape, friction; "": only whether a pad is touched',
    )
    parser.add_argument(
        "--rate-hz", type=float, metavar="HZ", help="rate of contact updates; 0: one per SYNC"
    )
    parser.add_argument(
        "--name",
        help="owner of a temporary scene, which is added to the other scenes; without it, the default scene "
        "is changed",
    )
    parser.add_argument(
        "--lease-s", type=positive_number, metavar="S", help="lifetime of the temporary scene (default: 10)"
    )
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


def run_tare(endpoint: str, key: str | None, as_json: bool, pads: Sequence[str]) -> int:
    """`handtouch tare`: exit status 1 if a pad could not be tared."""
    target = ControlTarget(endpoint, key, as_json)
    return target.request_and_print(
        "tare",
        lambda answer: map(_tare_line, answer["pads"]),
        lambda answer: all(pad["tared"] for pad in answer["pads"]),
        long=True,
        pads=list(pads),
    )


def run_scene(endpoint: str, key: str | None, as_json: bool, **values: Any) -> int:
    """`handtouch scene`: show the scenes, or change one; values that are None are left unchanged."""
    changes = {name: value for name, value in values.items() if value is not None}
    return ControlTarget(endpoint, key, as_json).request_and_print("scene", scene_lines, **changes)


def run_snapshot(endpoint: str, key: str | None, as_json: bool) -> int:
    """`handtouch snapshot`: the present state of all pads; as JSON with columns as lists."""
    return ControlTarget(endpoint, key, as_json).request_and_print("snapshot", _snapshot_lines)


def run_calibrate(endpoint: str, key: str | None, as_json: bool, pad: str, **values: Any) -> int:
    """`handtouch calibrate` without a measurement: set gains, offsets or law, or print the active ones."""
    target = ControlTarget(endpoint, key, as_json)
    return target.request_and_print("calibrate", _calibration_lines, pad=pad, **values)


def run_enable(endpoint: str, key: str | None, as_json: bool, pads: Sequence[str]) -> int:
    """`handtouch enable`."""
    return _switch(ControlTarget(endpoint, key, as_json), "enable", pads, None)


def run_disable(endpoint: str, key: str | None, as_json: bool, pads: Sequence[str], name: str | None) -> int:
    """`handtouch disable`."""
    return _switch(ControlTarget(endpoint, key, as_json), "disable", pads, name)


def run_reload(endpoint: str, key: str | None, as_json: bool, dry_run: bool) -> int:
    """`handtouch reload`: make the daemon read its deployment file again."""
    target = ControlTarget(endpoint, key, as_json)
    return target.request_and_print("reload", _reload_lines, long=True, dry_run=dry_run)


def run_log(endpoint: str, key: str | None, as_json: bool, level: str) -> int:
    """`handtouch log`: set the daemon's log level."""
    return ControlTarget(endpoint, key, as_json).request_and_print(
        "log", lambda answer: [f"log level {answer['level']}, was {answer['previous_level']}"], level=level
    )


@dataclass(frozen=True)
class ControlTarget:
    """A control endpoint with its key, and the format of the output."""

    endpoint: str
    key: str | None
    as_json: bool

    def request_and_print(
        self,
        command: str,
        format_lines: Callable[[Reply], Iterable[str]],
        is_ok: Callable[[Reply], bool] = lambda _: True,
        long: bool = False,
        **arguments: Any,
    ) -> int:
        """Send a request, print the answer and return the exit status; `long`: it may take a while."""
        try:
            if long:  # report a missing daemon without the long timeout
                request("scene", endpoint=self.endpoint, key=self.key, timeout_s=_SHORT_TIMEOUT_S)
            timeout_s = _LONG_TIMEOUT_S if long else _SHORT_TIMEOUT_S
            answer = request(command, endpoint=self.endpoint, key=self.key, timeout_s=timeout_s, **arguments)
        except (OSError, RuntimeError) as error:
            print(error, file=sys.stderr)
            return 1
        except ValueError as error:
            print(error, file=sys.stderr)
            return 2
        if self.as_json:
            print_json(to_json_lists(answer))
        else:
            for line in format_lines(answer):
                print(line)
        return 0 if is_ok(answer) else 1


def _switch(target: ControlTarget, command: str, pads: Sequence[str], name: str | None) -> int:
    return target.request_and_print(command, _disabled_lines, pads=list(pads), name=name or user_name())


def to_json_lists(answer: Reply) -> dict[str, Any]:
    """Convert an answer for JSON: columns of a snapshot become lists, NaN becomes None."""
    if "hands" not in answer:
        return dict(answer)
    columns = wire.COLUMNS[wire.HandFrame]
    hands = {
        name: {
            key: _column_rows(columns[key], value) if key in columns else value
            for key, value in frame.items()
        }
        for name, frame in answer["hands"].items()
    }
    return {**answer, "hands": hands}


def _column_rows(column: wire.Column, data: bytes) -> list[Any]:
    """Return the rows of a column, NaN as None."""
    rows = column.to_array(data).tolist()
    if column.elements == 1:
        return [_none_if_nan(value) for value in rows]
    return [[_none_if_nan(value) for value in row] for row in rows]


def _none_if_nan(value: float) -> float | None:
    return None if math.isnan(value) else value


def _tare_line(pad: Reply) -> str:
    name, offsets = f"{pad['hand']}/{pad['link']}", pad["offset_counts"]
    if not pad["tared"]:
        return f"{name}: not tared: {pad['reason']}"
    counts = ", ".join(f"{offset:.1f}" for offset in offsets)
    return f"{name}: tared at {counts} counts ({pad['samples']} samples)"


def _calibration_lines(answer: Reply) -> Iterable[str]:
    active, previous = answer["calibration_id"], answer["previous_calibration_id"]
    was = "" if previous == active else f", was {previous}"
    yield f"{answer['hand']}/{answer['link']}: calibration {active}{was}"
    law = answer["law"]
    yield f"gains    {'  '.join(f'{gain:.5g}' for gain in answer['gains'])}"
    yield f"offsets  {'  '.join(f'{offset:.1f}' for offset in answer['offset_counts'])} counts"
    yield (
        f"law      contact_ohm_mm2 {law['contact_ohm_mm2']:.5g}, alpha {law['alpha']:.4g}, "
        f"ohm_per_square {law['ohm_per_square']:.5g}"
        + (f", hertz_force_n {law['hertz_force_n']:.4g}" if law["hertz_force_n"] else "")
    )


def _snapshot_lines(answer: Reply) -> Iterable[str]:
    contacts = {(contact["hand"], contact["link"]): contact for contact in answer["contacts"]}
    for hand, frame in to_json_lists(answer)["hands"].items():
        for link, state in zip(frame["links"], frame["state"], strict=True):
            line = f"{hand}/{link}: {wire.PadState(state).name.lower()}"
            if contact := contacts.get((hand, link)):
                line += _contact_suffix(contact)
            yield line


def _contact_suffix(contact: Reply) -> str:
    position, force = contact["position_m"], contact["force_n"]
    at = f" at ({', '.join(f'{1e3 * x:.1f}' for x in position)}) mm" if position else ""
    return at + (f" with {force:.2f} N" if force is not None else "") + f" for {contact['duration_s']:.1f} s"


def _disabled_lines(answer: Reply) -> Iterable[str]:
    if not answer["disabled"]:
        yield "all pads are enabled"
    for name, by in answer["disabled"].items():
        yield f"{name}: disabled by {by}"


def _reload_lines(answer: Reply) -> Iterable[str]:
    would = "" if answer["applied"] else "would be "
    for table in answer["tables"]:
        yield f"[{table}]: {would}changed"
    for name, keys in answer["pads"].items():
        yield f"{name}: {would}changed: {', '.join(keys)}"
    if not answer["tables"] and not answer["pads"]:
        yield "no changes"
