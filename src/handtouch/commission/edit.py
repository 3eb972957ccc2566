"""Writes what was found into a deployment file: the keys that changed, and nothing else.

Public names: `Edit`, `Edits`, `edited`, `applied`, `write`.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Array, Integer, Item, String

from handtouch import config

_AFTER = {"serial": "node_id", "electrodes": "node"}
"""Keys that may be left out, and the one below which they are written."""


@dataclass(frozen=True)
class Edit:
    """What a pad's table is to say of its node; None for no serial number."""

    bus: str
    node_id: int
    node: str
    serial: int | None
    electrodes: tuple[str, str, str, str]

    @classmethod
    def of(cls, pad: config.Pad) -> Edit:
        """What it says now."""
        return cls(pad.bus, pad.node_id, pad.node, pad.serial, pad.electrodes)

    def keys(self) -> dict[str, Any]:
        """Keys of the pad's table."""
        return {
            "bus": self.bus,
            "node_id": self.node_id,
            "node": self.node,
            "serial": self.serial,
            "electrodes": self.electrodes,
        }


Edits = Mapping[tuple[str, str], Edit]
"""By hand and link."""


def applied(deployment: config.Deployment, edits: Edits) -> config.Deployment:
    """The deployment with the edits."""
    hands = tuple(
        hand.model_copy(
            update={
                "pads": tuple(
                    pad.model_copy(update=edits[hand.name, pad.link].keys())
                    if (hand.name, pad.link) in edits
                    else pad
                    for pad in hand.pads
                )
            }
        )
        for hand in deployment.hands
    )
    return deployment.model_copy(update={"hands": hands})


def edited(text: str, edits: Edits) -> str:
    """The text of a deployment file with the edits; comments, order and forms of numbers stay.

    Raises KeyError for a pad that the text hasn't got, tomlkit's ParseError for text that is no TOML.
    """
    document = tomlkit.parse(text)
    pads = {(str(hand["name"]), str(pad["link"])): pad for hand in document["hand"] for pad in hand["pad"]}
    for name, edit in edits.items():
        pad = pads[name]
        for key, value in edit.keys().items():
            _set(pad, key, value)
    return tomlkit.dumps(document)


def write(path: Path, text: str) -> None:
    """Replace a file by one with this text, at once: at no time is there half a file. Raises OSError."""
    path = path.resolve()  # a link stays a link
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, name)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _set(pad: Any, key: str, value: Any) -> None:
    if key not in pad:
        if value is None or (key == "electrodes" and value == ("x0", "xa", "y0", "yb")):
            return
        item = tomlkit.item(list(value) if key == "electrodes" else value)
        item.trivia.trail = pad[_AFTER[key]].trivia.trail  # its line's end
        # tomlkit's `append` would put it below the comments before the next table
        pad.value._insert_after(_AFTER[key], key, item)
    elif value is None:
        del pad[key]
    elif _plain(pad[key]) != _plain(value):
        pad[key] = _like(pad[key], value)


def _plain(value: Any) -> Any:
    """A value by itself, to compare it."""
    if isinstance(value, Item):
        value = value.unwrap()
    return list(value) if isinstance(value, tuple) else value


def _like(old: Item, value: Any) -> Item:
    """A value in the form of the one that it replaces, with the comment behind that."""
    new: Item
    if isinstance(old, Integer):
        raw = old.as_string()
        new = Integer(value, old.trivia, _digits(raw, value))
    elif isinstance(old, String):
        new = tomlkit.string(value, literal=old.as_string().startswith("'"))
    elif isinstance(old, Array):
        for place, name in enumerate(value):
            old[place] = name
        return old
    else:
        new = tomlkit.item(value)
    new.trivia.comment_ws, new.trivia.comment = old.trivia.comment_ws, old.trivia.comment
    new.trivia.trail = old.trivia.trail
    return new


def _digits(old: str, value: int) -> str:
    """A number in the base of another one."""
    old = old.replace("_", "")
    prefix = old[:2]
    if prefix not in ("0x", "0o", "0b"):
        return str(value)
    digits = format(value, prefix[1]).rjust(len(old) - 2, "0")
    return prefix + (digits if any(letter in "abcdef" for letter in old[2:]) else digits.upper())
