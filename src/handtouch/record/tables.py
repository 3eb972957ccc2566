"""The messages of a recording as rows of tables, every name with its unit.

Public names: `TABLES`, `rows_of`, `Rows`.

`time_ns` is UTC, in ns since 1970; every other `_ns` is of the daemon's monotonic clock.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import MISSING, fields
from typing import Any

import numpy as np

from handtouch import wire
from handtouch.record.read import Entry, Recording

TABLES = ("contacts", "raw", "hand", "health", "service", "joints")
Row = dict[str, Any]
Rows = Iterator[tuple[str, Row]]

_AXES = {
    2: ("x", "y"),
    3: ("x", "y", "z"),
    9: ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"),
}
_CHANNELS = ("x0_counts", "xa_counts", "y0_counts", "yb_counts")
_LEFT_OUT = ("v", "repeat")
_STATES = [state.name.lower() for state in wire.PadState]
_PLAIN = (bool, int, float, str, type(None))


def rows_of(recording: Recording) -> Rows:
    """Table and row, for every row that the messages of a recording make."""
    names: list[tuple[str, str]] = []
    for entry in recording.read("config"):  # ticks may come before it
        names = names_of(entry.payload)
        break
    for entry in recording:
        prefix = entry.topic.split("/")[0]
        if prefix == "config":
            names = names_of(entry.payload)
        elif prefix == "contact" and not entry.payload["repeat"]:
            yield "contacts", {"time_ns": entry.t_ns} | flat(entry.payload | _absent(entry))
        elif prefix in ("health", "service"):
            yield prefix, {"time_ns": entry.t_ns} | flat(entry.payload | _absent(entry))
        elif prefix == "hand":
            yield from (("hand", row) for row in _hand(entry))
        elif prefix == "tick":
            yield from _tick(entry, names)


def names_of(config: dict[str, Any]) -> list[tuple[str, str]]:
    """Hand and link of each row of `tick`, from the payload of a `config` message."""
    hands = json.loads(config["deployment"])["hand"]
    return [(hand["name"], pad["link"]) for hand in hands for pad in hand["pad"]]


def flat(payload: dict[str, Any]) -> Row:
    """A payload's values; vectors as columns of their own, lists of words as one, maps left out."""
    row: Row = {}
    for name, value in payload.items():
        if name in _LEFT_OUT or isinstance(value, dict):
            continue
        length = _LENGTHS.get(name)
        if length is not None:
            parts = value if value is not None else [None] * length
            row |= dict(zip(split(name, length), parts, strict=True))
        elif isinstance(value, list):
            row[name] = "; ".join(map(str, value))
        elif isinstance(value, _PLAIN):
            row[name] = value
    return row


def split(name: str, length: int) -> list[str]:
    """Names for the parts of a vector or matrix: position_m -> position_x_m ..."""
    stem, underline, unit = name.rpartition("_")
    if not underline or unit not in ("m", "m2", "n", "a", "s"):
        stem, unit = name, ""
    return ["_".join(filter(None, (stem, axis, unit))) for axis in _AXES[length]]


def _absent(entry: Entry) -> Row:
    """What the message leaves out has a column all the same: it may come later."""
    defaults = _DEFAULTS[entry.topic.split("/")[0]]
    return {name: value for name, value in defaults.items() if name not in entry.payload}


def _tick(entry: Entry, names: list[tuple[str, str]]) -> Rows:
    payload = entry.payload
    if payload["stopped"] or not names:
        return
    columns = {
        name: np.frombuffer(payload[name], dtype=kind).reshape(-1, elements).tolist()
        for name, (kind, elements) in wire.INPUTS.items()
    }
    about = {
        "time_ns": entry.t_ns,
        "run": payload["run"],
        "tick": payload["tick"],
        "sync_ns": payload["t_ns"],
    }
    for (hand, link), counts, (arrived_ns,), (fresh,), (state,) in zip(
        names,
        columns["counts"],
        columns["arrived_ns"],
        columns["fresh"],
        columns["node_state"],
        strict=True,
    ):
        yield (
            "raw",
            {
                **about,
                "hand": hand,
                "link": link,
                **dict(zip(_CHANNELS, counts, strict=True)),
                "arrived_ns": arrived_ns,
                "fresh": bool(fresh),
                "node_state": _STATES[state],
            },
        )
    for hand, t_ns, positions, ages, _ in payload["others"].get("joints", ()):
        values = zip(np.frombuffer(positions).tolist(), np.frombuffer(ages).tolist(), strict=True)
        for number, (position, age) in enumerate(values):
            row = {
                **about,
                "hand": hand,
                "joints_ns": t_ns,
                "joint": number,
                "position": position,
                "age_s": age,
            }
            yield "joints", row


def _hand(entry: Entry) -> Iterator[Row]:
    payload = entry.payload
    columns: dict[str, Any] = {}
    for name, (kind, elements) in wire.COLUMNS[wire.HandFrame].items():
        if not payload.get(name):
            continue
        values = np.frombuffer(payload[name], dtype=kind).reshape(-1, elements)
        parts = split(name, elements) if elements > 1 else [name]
        columns |= dict(zip(parts, values.T.tolist(), strict=True))
    about = {"time_ns": entry.t_ns} | {key: payload[key] for key in ("run", "seq", "t_ns", "tick", "hand")}
    for number, link in enumerate(payload["links"]):
        row = {name: _known(column[number]) for name, column in columns.items()}
        yield {**about, "link": link, **row, "state": _STATES[row["state"]]}


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and value != value else value


def _lengths() -> dict[str, int]:
    """Length of each field of a fixed length, by name, of the payloads that are made rows of."""
    hints = {"Vector3 | None": 3, "Floats9 | None": 9, "tuple[float, float] | None": 2}
    told: dict[str, int] = {}
    for payload in (wire.Contact, wire.Health, wire.Service):
        told |= {
            name: hints[hint]
            for name, hint in payload.__annotations__.items()
            if isinstance(hint, str) and hint in hints
        }
    return told


_LENGTHS = _lengths()
_DEFAULTS: dict[str, Row] = {
    topic.prefix: {
        field.name: field.default for field in fields(topic.payload) if field.default is not MISSING
    }
    for topic in wire.TOPICS
}
