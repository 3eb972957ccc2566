"""Node ids and serial numbers of a node, kept over restarts in a JSON file.

Public name: `IdentityStore`.
"""

from __future__ import annotations

import json
import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class PadIdentity:
    """Identity of one pad's node; `node_id` is None without an id."""

    serial: int
    node_id: int | None


class IdentityStore:
    """Identities by the names of pads; the file is replaced as a whole, so it survives a power failure."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._pads: dict[str, dict[str, int | None]] = {}

    def load(self) -> None:
        """Read the file, if there is one. Raises ValueError naming it if it is damaged, OSError."""
        try:
            text = self._path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return
        try:
            pads: Any = json.loads(text)
            self._pads = {
                str(name): {
                    "serial": _integer(pad["serial"], 1, 0xFFFFFFFF),
                    **({"node_id": _node_id(pad["node_id"])} if "node_id" in pad else {}),
                }
                for name, pad in pads.items()
            }
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(
                f"{self._path}: is damaged ({error}); delete it, and assign the node ids again"
            ) from error

    def identity(self, pad: str, serial: int | None, node_id: int | None) -> PadIdentity:
        """Return a pad's identity: the configured serial number, else the stored one, else a new random one;
        the id that LSS has stored, else the configured one. A new serial number is stored: raises OSError.
        """
        stored = self._pads.setdefault(pad, {})
        chosen = serial or stored.get("serial") or 1 + secrets.randbelow(0xFFFFFFFF)
        if stored.get("serial") != chosen:
            stored["serial"] = chosen
            self._save()
        return PadIdentity(chosen, stored.get("node_id", node_id))

    def store_node_id(self, pad: str, node_id: int | None) -> None:
        """Store an id assigned by LSS, None for none. Raises OSError."""
        self._pads[pad]["node_id"] = node_id
        self._save()

    def _save(self) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self._path.with_name(self._path.name + ".new")
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(self._pads, file, indent=2)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self._path)


def _node_id(value: object) -> int | None:
    return None if value is None else _integer(value, 1, 127)


def _integer(value: object, least: int, most: int) -> int:
    if not isinstance(value, int) or not least <= value <= most:
        raise ValueError(f"{value!r} is no integer from {least} to {most}")
    return value
