"""Edits of a deployment file: changed keys are written, everything else is preserved.

Public names: `PadEdit`, `PadEdits`, `edit_text`, `apply_edits`, `write_atomically`.
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

_INSERT_AFTER = {"serial": "node_id", "electrodes": "node"}
"""Optional keys, and the key after which each is inserted."""


@dataclass(frozen=True)
class PadEdit:
    """Keys of a pad's table that describe its node; None for no serial number."""

    bus: str
    node_id: int
    node: str
    serial: int | None
    electrodes: tuple[str, ...]

    @classmethod
    def from_pad(cls, pad: config.Pad) -> PadEdit:
        """Return the present keys of a pad."""
        return cls(pad.bus, pad.node_id, pad.node, pad.serial, pad.electrodes)

    def as_keys(self) -> dict[str, Any]:
        """Return the keys with their values."""
        return {
            "bus": self.bus,
            "node_id": self.node_id,
            "node": self.node,
            "serial": self.serial,
            "electrodes": self.electrodes,
        }


PadEdits = Mapping[tuple[str, str], PadEdit]
"""Edits by (hand, link)."""


def apply_edits(deployment: config.Deployment, edits: PadEdits) -> config.Deployment:
    """Return the deployment with the edits."""

    def edited(hand: str, pad: config.Pad) -> config.Pad:
        edit = edits.get((hand, pad.link))
        return pad if edit is None else pad.model_copy(update=edit.as_keys())

    return deployment.with_pads(edited)


def edit_text(text: str, edits: PadEdits) -> str:
    """Return the text of a deployment file with the edits; comments, order and number formats are preserved.

    Raises KeyError for a pad that the text doesn't have, tomlkit's ParseError for invalid TOML.
    """
    document = tomlkit.parse(text)
    pads = {(str(hand["name"]), str(pad["link"])): pad for hand in document["hand"] for pad in hand["pad"]}
    for name, edit in edits.items():
        pad = pads[name]
        for key, value in edit.as_keys().items():
            _set_key(pad, key, value)
    return tomlkit.dumps(document)


def write_atomically(path: Path, text: str) -> None:
    """Replace a file's contents atomically. Raises OSError."""
    path = path.resolve()  # replace the target of a link
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


def _set_key(pad: Any, key: str, value: Any) -> None:
    if key not in pad:
        if value is None or (key == "electrodes" and value == ("x0", "xa", "y0", "yb")):
            return
        item = tomlkit.item(list(value) if key == "electrodes" else value)
        item.trivia.trail = pad[_INSERT_AFTER[key]].trivia.trail  # its line end
        # tomlkit's `append` would insert below the comments before the next table
        pad.value._insert_after(_INSERT_AFTER[key], key, item)
    elif value is None:
        del pad[key]
    elif _unwrap(pad[key]) != _unwrap(value):
        pad[key] = _format_like(pad[key], value)


def _unwrap(value: Any) -> Any:
    """Return a plain value, for comparison."""
    if isinstance(value, Item):
        value = value.unwrap()
    return list(value) if isinstance(value, tuple) else value


def _format_like(old: Item, value: Any) -> Item:
    """Return a value in the format of the one that it replaces, with its comment."""
    new: Item
    if isinstance(old, Integer):
        raw = old.as_string()
        new = Integer(value, old.trivia, _format_integer_like(raw, value))
    elif isinstance(old, String):
        new = tomlkit.string(value, literal=old.as_string().startswith("'"))
    elif isinstance(old, Array):
        for index, name in enumerate(value):
            old[index] = name
        return old
    else:
        new = tomlkit.item(value)
    new.trivia.comment_ws, new.trivia.comment = old.trivia.comment_ws, old.trivia.comment
    new.trivia.trail = old.trivia.trail
    return new


def _format_integer_like(old: str, value: int) -> str:
    """Format a number in the base of another one."""
    old = old.replace("_", "")
    prefix = old[:2]
    if prefix not in ("0x", "0o", "0b"):
        return str(value)
    digits = format(value, prefix[1]).rjust(len(old) - 2, "0")
    return prefix + (digits if any(letter in "abcdef" for letter in old[2:]) else digits.upper())
