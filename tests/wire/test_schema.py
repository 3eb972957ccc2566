"""docs/wire.md and docs/wire.schema.json are as declared, and every message conforms to the schema."""

from __future__ import annotations

import json
import re
import typing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docs.wire_tables import with_tables
from handtouch import wire
from handtouch.wire import inputs
from handtouch.wire.contact import Output
from handtouch.wire.declarations import FieldDeclaration, declared_fields
from handtouch.wire.health import Emergency
from handtouch.wire.schema import json_schema
from tests.wire.schema_check import SchemaCheck

DOCS = Path(__file__).parents[2] / "docs"
UPDATE = "the declarations have changed: run `make tables`"
ENVELOPE = {"v", "session", "seq", "t_ns", "retained"}


def test_the_tables_of_the_page_are_as_declared() -> None:
    page = (DOCS / "wire.md").read_text()
    assert page == with_tables(page), UPDATE


def test_the_schema_file_is_as_declared() -> None:
    assert json.loads((DOCS / "wire.schema.json").read_text()) == json_schema(), UPDATE


def test_every_map_of_the_schema_has_its_table() -> None:
    shown = re.findall(r"<!-- table: (\w+)( required| optional)? -->", (DOCS / "wire.md").read_text())
    maps = json_schema()["$defs"].keys() - {"published", "inputs"}
    assert {name for name, _ in shown} >= maps
    for name in maps:
        selections = [selection for shown_name, selection in shown if shown_name == name]
        assert selections in ([""], [" required", " optional"]), name


@pytest.mark.parametrize("kind", [topic.payload for topic in (*wire.TOPICS, *wire.INTERNAL_TOPICS)])
def test_every_field_has_a_meaning(kind: type[Any]) -> None:
    without = {field.name for field in declared_fields(kind) if not field.meaning}
    assert without == ENVELOPE - {"t_ns"}


def test_every_output_is_described() -> None:
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", (DOCS / "wire.md").read_text(), flags=re.M)
    described = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert set(typing.get_args(Output)) <= described


def test_declared_columns_are_those_of_the_codec() -> None:
    for kind, columns in wire.COLUMNS.items():
        assert {f.name: f.column for f in declared_fields(kind) if f.column is not None} == columns


def _declared(kind: type[Any], name: str) -> FieldDeclaration:
    return next(field for field in declared_fields(kind) if field.name == name)


def test_a_declaration_has_type_values_and_meaning() -> None:
    event = _declared(wire.Contact, "event")
    assert (event.hint, event.is_optional, event.meaning) == (str, False, "`begin`, `update` or `end`")
    assert event.values is not None
    assert event.values.names == ("begin", "update", "end")
    assert _declared(wire.Contact, "palm_status").codes is wire.FrameStatus
    supervisor = _declared(wire.Service, "supervisor")
    assert supervisor.is_nilable
    assert supervisor.is_optional
    assert typing.is_typeddict(supervisor.hint)


JOINTS = inputs.JointState("right", None, ("a", "b"), np.array([0.1, 0.2]), gravity=np.array([0.0, 0.0, 1.0]))
FORCES = inputs.LinkForces("right", 7, ("tip",), np.array([1.0]), np.array([0.1]))


@pytest.mark.parametrize("message", [JOINTS, FORCES])
def test_inputs_conform_to_the_schema(message: inputs.InputMessage) -> None:
    assert SchemaCheck("inputs").errors(inputs.encode(message)) == []


def test_emergencies_conform_to_the_schema() -> None:
    lasting = Emergency(0x5000, 1, "2f74000000", "0x5000 device hardware (register: generic)", 10**9)
    errors = tuple(error.to_map() for error in (replace(lasting, cleared_ns=2 * 10**9, count=3), lasting))
    health = wire.Health(
        wire.SCHEMA_VERSION, 1, 1, 1, "h", "x", "can0", 1, "clear", "operational", 0, "sync", "", None, 0.0,
        0, 0, None, 0, 0, errors, False, error_register=1, error_history=(0x5000,),
    )  # fmt: skip
    check = SchemaCheck("published")
    assert check.errors(wire.encode(health)) == []
    nameless = {name: value for name, value in errors[0].items() if name != "text"}
    for wrong in ("0x5000 device hardware", nameless, {**errors[0], "more": 1}):
        parts = wire.encode(replace(health, emergencies=(wrong,)))  # type: ignore[arg-type]
        assert check.errors(parts)


def test_violations_are_found() -> None:
    topic, payload = inputs.encode(FORCES)
    check = SchemaCheck("inputs")
    assert check.errors([b"joints/right", payload])
    assert check.errors([b"force/right/tip", payload])
    assert check.errors([topic, payload.replace(b"std_n", b"std_x")])
    assert SchemaCheck("published").errors([topic, payload])
