"""The control endpoint on the command line: tare, scene, snapshot, calibrate, enable, disable, reload, log.

Each `run_...` sends one command to a running daemon and prints its answer. Exit status 0, 1 (no daemon
answers, it refuses, or a pad was refused), 2 (an endpoint or a key file that can't be used).
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from handtouch import wire
from handtouch.client import request
from handtouch.view.scene import scene_lines

_PROMPT_S, _LONG_S = 3.0, 60.0
Answer = Mapping[str, Any]


@dataclass(frozen=True)
class Asking:
    """Where a command goes, and how its answer is to be shown."""

    endpoint: str
    key: str | None
    as_json: bool

    def ask(
        self,
        command: str,
        show: Callable[[Answer], Iterable[str]],
        well: Callable[[Answer], bool] = lambda _: True,
        long: bool = False,
        **arguments: Any,
    ) -> int:
        """Ask, print, and return the exit status; a `long` command's answer may take a while."""
        try:
            if long:  # so that a missing daemon is told at once
                request("scene", endpoint=self.endpoint, key=self.key, timeout_s=_PROMPT_S)
            wait_s = _LONG_S if long else _PROMPT_S
            answer = request(command, endpoint=self.endpoint, key=self.key, timeout_s=wait_s, **arguments)
        except (OSError, RuntimeError) as error:
            print(error, file=sys.stderr)
            return 1
        except ValueError as error:
            print(error, file=sys.stderr)
            return 2
        if self.as_json:
            print(json.dumps(listed(answer), indent=2))
        else:
            for line in show(answer):
                print(line)
        return 0 if well(answer) else 1


def run_tare(to: Asking, pads: Sequence[str]) -> int:
    """`handtouch tare`: exit status 1 if a pad could not be tared."""
    return to.ask(
        "tare",
        lambda answer: map(_tared, answer["pads"]),
        lambda answer: all(pad["tared"] for pad in answer["pads"]),
        long=True,
        pads=list(pads),
    )


def run_scene(to: Asking, **asked: Any) -> int:
    """`handtouch scene`: show the scenes, or change one; what is None stays as it is."""
    return to.ask("scene", scene_lines, **{key: value for key, value in asked.items() if value is not None})


def run_snapshot(to: Asking) -> int:
    """`handtouch snapshot`: the whole hand now; as JSON with its columns as lists."""
    return to.ask("snapshot", _snapshot)


def run_calibrate(to: Asking, **asked: Any) -> int:
    """`handtouch calibrate`: give a pad gains, offsets or a law under a name; without them, show its own."""
    return to.ask("calibrate", _calibrated, **asked)


def run_switch(to: Asking, on: bool, pads: Sequence[str], name: str) -> int:
    """`handtouch enable` and `disable`."""
    return to.ask("enable" if on else "disable", _disabled, pads=list(pads), name=name)


def run_reload(to: Asking, trial: bool) -> int:
    """`handtouch reload`: have the daemon read its deployment file again."""
    return to.ask("reload", _reloaded, long=True, trial=trial)


def run_log(to: Asking, level: str) -> int:
    """`handtouch log`: how much the daemon says."""
    return to.ask("log", lambda answer: [f"log level {answer['now']}, was {answer['before']}"], level=level)


def listed(answer: Answer) -> dict[str, Any]:
    """An answer for JSON: the columns of a snapshot as lists, NaN as None."""
    if "hands" not in answer:
        return dict(answer)
    columns = wire.COLUMNS[wire.HandFrame]
    hands = {
        name: {key: _rows(value, *columns[key]) if key in columns else value for key, value in frame.items()}
        for name, frame in answer["hands"].items()
    }
    return {**answer, "hands": hands}


def _rows(column: bytes, kind: str, elements: int) -> list[Any]:
    values = np.frombuffer(column, dtype=kind)
    plain = [None if isinstance(value, float) and math.isnan(value) else value for value in values.tolist()]
    return plain if elements == 1 else [plain[k : k + elements] for k in range(0, len(plain), elements)]


def _tared(pad: Answer) -> str:
    name, offsets = f"{pad['hand']}/{pad['link']}", pad["offset_counts"]
    if not pad["tared"]:
        return f"{name}: not tared: {pad['reason']}"
    told = ", ".join(f"{offset:.1f}" for offset in offsets)
    return f"{name}: tared at {told} counts ({pad['samples']} samples)"


def _calibrated(answer: Answer) -> Iterable[str]:
    was = "" if answer["before"] == answer["now"] else f", was {answer['before']}"
    yield f"{answer['hand']}/{answer['link']}: calibration {answer['now']}{was}"
    law = answer["law"]
    yield f"gains    {'  '.join(f'{gain:.5g}' for gain in answer['gains'])}"
    yield f"offsets  {'  '.join(f'{offset:.1f}' for offset in answer['offset_counts'])} counts"
    yield (
        f"law      contact_ohm_mm2 {law['contact_ohm_mm2']:.5g}, alpha {law['alpha']:.4g}, "
        f"ohm_per_square {law['ohm_per_square']:.5g}"
    )


def _snapshot(answer: Answer) -> Iterable[str]:
    under_way = {(contact["hand"], contact["link"]): contact for contact in answer["contacts"]}
    for hand, frame in listed(answer)["hands"].items():
        for link, state in zip(frame["links"], frame["state"], strict=True):
            line = f"{hand}/{link}: {wire.PadState(state).name.lower()}"
            if contact := under_way.get((hand, link)):
                line += _contact(contact)
            yield line


def _contact(contact: Answer) -> str:
    where, force = contact["position_m"], contact["force_n"]
    at = f" at ({', '.join(f'{1e3 * x:.1f}' for x in where)}) mm" if where else ""
    return at + (f" with {force:.2f} N" if force is not None else "") + f" for {contact['duration_s']:.1f} s"


def _disabled(answer: Answer) -> Iterable[str]:
    if not answer["disabled"]:
        yield "every pad is enabled"
    for name, by in answer["disabled"].items():
        yield f"{name}: disabled by {by}"


def _reloaded(answer: Answer) -> Iterable[str]:
    would = "" if answer["applied"] else "would be "
    for table in answer["tables"]:
        yield f"[{table}]: {would}changed"
    for name, what in answer["pads"].items():
        yield f"{name}: {would}changed: {', '.join(what)}"
    if not answer["tables"] and not answer["pads"]:
        yield "nothing has changed"
