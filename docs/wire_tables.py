"""Tables of docs/wire.md and the text of docs/wire.schema.json, from the declarations of the payloads.

Public names: `with_tables`, `schema_text`, `STATUS_HEADS` (kinds of status by their keys).

The page marks each table by a comment: `<!-- table: NAME -->` with `topics`, `internal topics`,
`status codes` or the name of a class; `required` or `optional` after it selects the keys that are always
present, or the others.
"""

from __future__ import annotations

import json
import re
import typing
from collections.abc import Iterator, Sequence
from enum import Enum
from itertools import zip_longest
from typing import Any

from handtouch.wire.columns import is_array
from handtouch.wire.declarations import (
    FieldDeclaration,
    declared_fields,
    inner_fields,
    input_fields,
)
from handtouch.wire.inputs import INPUT_TOPICS
from handtouch.wire.schema import json_schema
from handtouch.wire.status import (
    ContactRadiusStatus,
    ForceStatus,
    FrameStatus,
    PadState,
    PositionStatus,
    StatusCode,
)
from handtouch.wire.topics import INTERNAL_TOPICS, TOPICS, Topic

_TABLE = re.compile(r"(?<=<!-- table: )([\w ]+?)(?: (required|optional))?( -->\n)(?:\|.*\n)*")
_ENVELOPE = ("v", "session", "seq", "t_ns", "retained")
_TYPES = {int: "int", float: "float", str: "str", bool: "bool", bytes: "bin", Any: "any"}
STATUS_HEADS: dict[str, type[StatusCode]] = {
    "`state` of a pad": PadState,
    "`position_status`": PositionStatus,
    "`force_status`": ForceStatus,
    "`palm_status`, `base_status`": FrameStatus,
    "`contact_radius_status`": ContactRadiusStatus,
}


def with_tables(page: str) -> str:
    """Return a page with all marked tables as declared. Raises KeyError for a mark of an unknown class."""
    return _TABLE.sub(
        lambda mark: f"{mark[1]}{f' {mark[2]}' if mark[2] else ''}{mark[3]}{_table(mark[1], mark[2])}", page
    )


def schema_text() -> str:
    """Return the text of docs/wire.schema.json."""
    return json.dumps(json_schema(), indent=1, ensure_ascii=False) + "\n"


def _table(name: str, selection: str | None) -> str:
    if name == "topics":
        return _format_table(("topic", "published", "time in `t_ns`"), _topic_rows(TOPICS))
    if name == "internal topics":
        return _format_table(("topic", "sent", "time in `t_ns`"), _topic_rows(INTERNAL_TOPICS))
    if name == "status codes":
        return _format_table(("code", *STATUS_HEADS), _status_rows())
    rows = (
        (
            f"`{field.name}`{'?' if field.is_optional and selection is None else ''}",
            _type_text(field),
            _meaning(field),
        )
        for field in _FIELDS[name]
        if selection is None or field.is_optional is (selection == "optional")
    )
    return _format_table(("key", "type", "meaning"), rows)


def _format_table(head: Sequence[str], rows: Iterator[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n".replace("  ", " ") for cells in lines)


def _topic_rows(topics: Sequence[Topic]) -> Iterator[Sequence[str]]:
    for topic in topics:
        name = "/".join([topic.prefix, *(f"<{key}>" for key in topic.keys)])
        t_ns = next(field for field in declared_fields(topic.payload) if field.name == "t_ns")
        yield f"`{name}`", topic.published, t_ns.meaning


def _status_rows() -> Iterator[Sequence[str]]:
    names = [[code.text for code in codes] for codes in STATUS_HEADS.values()]
    for number, row in enumerate(zip_longest(*names)):
        yield str(number), *("" if name is None else f"`{name}`" for name in row)


def _meaning(field: FieldDeclaration) -> str:
    """Return the meaning, with the word for a status code as a link."""
    meaning = field.meaning
    return re.sub(r"\bstat(e|us)\b", r"[\g<0>](#status-codes)", meaning, count=1) if field.codes else meaning


def _type_text(field: FieldDeclaration) -> str:
    if field.column is not None:
        elements = f"{field.column.elements} " if field.column.elements > 1 else ""
        return f"column of {elements}{field.column.type_name}"
    return _type_name(field.hint) + (" or nil" if field.is_nilable else "")


def _type_name(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint in _TYPES:
        return _TYPES[hint]
    if is_array(hint):
        return "list of float"
    if origin in (tuple, list):
        item = _type_name(arguments[0])
        if origin is tuple and arguments[-1] is not Ellipsis:
            return f"{len(arguments)} {item}s"
        return "list of maps" if item == "map" else f"list of {item}"
    if origin is dict:
        item = _type_name(arguments[1])
        return {"any": "map", "map": "map of maps"}.get(item, f"map of {item}")
    if origin is not None:  # a type or None
        return " or ".join(
            "nil" if argument is type(None) else _type_name(argument) for argument in arguments
        )
    return "str" if issubclass(hint, Enum) else "map"


def _fields_by_class() -> dict[str, tuple[FieldDeclaration, ...]]:
    """Return the fields of each payload and of each map inside of one; those of the envelope are left out."""
    found: dict[str, tuple[FieldDeclaration, ...]] = {}

    def add(kind: type[Any], fields: tuple[FieldDeclaration, ...]) -> None:
        found[kind.__name__] = fields
        for field in fields:
            for inner in _classes_in(field.hint):
                add(inner, inner_fields(inner))

    for topic in (*TOPICS, *INTERNAL_TOPICS):
        fields = declared_fields(topic.payload)
        add(topic.payload, tuple(field for field in fields if field.name not in _ENVELOPE))
    for topic in INPUT_TOPICS:
        add(topic.payload, input_fields(topic.payload))
    return found


def _classes_in(hint: Any) -> Iterator[type[Any]]:
    """Yield the classes of maps in a type."""
    if typing.get_origin(hint) is not None and not is_array(hint):
        for argument in typing.get_args(hint):
            yield from _classes_in(argument)
    elif isinstance(hint, type) and (typing.is_typeddict(hint) or hasattr(hint, "__dataclass_fields__")):
        yield hint


_FIELDS = _fields_by_class()
