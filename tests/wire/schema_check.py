"""Checks received messages against docs/wire.schema.json, more strictly than a subscriber would."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgpack
import pytest

SCHEMA = Path(__file__).parents[2] / "docs" / "wire.schema.json"


class SchemaCheck:
    """Validates messages of `direction` "published" or "inputs"; undocumented keys and values are errors."""

    def __init__(self, direction: str) -> None:
        jsonschema = pytest.importorskip("jsonschema", reason="run `make dev`")
        schema = json.loads(SCHEMA.read_text())
        jsonschema.Draft202012Validator.check_schema(schema)
        for definition in schema["$defs"].values():
            if "properties" in definition:
                definition["additionalProperties"] = False
                for key in definition["properties"].values():
                    if "examples" in key:
                        key["enum"] = key["examples"]
        self._validators = {
            row["properties"]["topic"]["pattern"]: jsonschema.Draft202012Validator(
                {**row["properties"]["payload"], "$defs": schema["$defs"]}
            )
            for row in schema["$defs"][direction]["oneOf"]
        }

    def errors(self, parts: Sequence[bytes]) -> list[str]:
        """Return the violations of a message of two parts, as text."""
        topic, payload = parts[0].decode(), _as_json(msgpack.unpackb(parts[1]))
        found = [check for pattern, check in self._validators.items() if re.search(pattern, topic)]
        if len(found) != 1:
            return [f"{topic}: {len(found)} topics match"]
        return [f"{topic} {error.json_path}: {error.message:.200}" for error in found[0].iter_errors(payload)]


def _as_json(value: Any) -> Any:
    """Return msgpack values as JSON has them, binary ones in base64."""
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, dict):
        return {key: _as_json(item) for key, item in value.items()}
    return [_as_json(item) for item in value] if isinstance(value, list) else value
