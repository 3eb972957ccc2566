"""Declarations of payload fields: type, meaning and values.

Public names: `CLOSED`, `Values`, `FieldDeclaration`, `declared_fields`, `inner_fields`, `input_fields`.

The declarations are the only source of the tables in docs/wire.md and of docs/wire.schema.json (`make
tables`). A field's docstring is its meaning. Metadata refine the type that the code sees:

    state: Annotated[PadStateName, PadState]                   # texts of a status
    event: Annotated[Literal["begin", "end"], CLOSED]          # names
    force_n: Annotated[bytes, Column("<f4")]                   # a column
    force_n: Annotated[float | None, HandColumn()]             # a number with a column of hand frames
    buses: Annotated[dict[str, Any], dict[str, BusStatistics]]     # maps inside of a map
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import types
import typing
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Annotated, Any, Literal, NamedTuple, NotRequired, Union

from handtouch.wire.columns import Column, HandColumn


class Values(NamedTuple):
    """Values of a text field; a later version may add some unless they are `closed`."""

    names: tuple[str, ...]
    closed: bool


CLOSED = object()
"""Metadata of a text field: a later version adds no values."""


class FieldDeclaration(NamedTuple):
    """A field of a payload, or of a map inside of one."""

    name: str
    hint: Any
    """precise type, without None"""
    is_nilable: bool
    is_optional: bool
    """absent from the map where it has its default"""
    meaning: str
    column: Column | None
    values: Values | None
    codes: type[Enum] | None
    """status codes, of a column or as text"""
    hand_column: HandColumn | None = None


def declared_fields(kind: type[Any]) -> tuple[FieldDeclaration, ...]:
    """Return the fields of a dataclass or TypedDict, in order; its source must be readable."""
    meanings = _docstrings(kind)
    hints = typing.get_type_hints(kind, include_extras=True)
    if is_dataclass(kind):
        optional = {field.name for field in fields(kind) if field.default is not MISSING}
    else:
        optional = set(kind.__optional_keys__)
    return tuple(_declaration(name, hint, name in optional, meanings) for name, hint in hints.items())


def inner_fields(kind: type[Any]) -> tuple[FieldDeclaration, ...]:
    """Return the keys of a map inside of a payload; of a dataclass all are present, unlike in a payload."""
    declared = declared_fields(kind)
    return tuple(field._replace(is_optional=False) for field in declared) if is_dataclass(kind) else declared


def input_fields(kind: type[Any]) -> tuple[FieldDeclaration, ...]:
    """Return the keys of a message that a robot sends; its hand is in the topic, not in the map."""
    version = FieldDeclaration("v", int, False, False, "schema version", None, None, None)
    declared = (field for field in declared_fields(kind) if field.name != "hand")
    return version, *(field._replace(is_optional=field.is_nilable) for field in declared)


def _declaration(name: str, hint: Any, is_optional: bool, meanings: dict[str, str]) -> FieldDeclaration:
    column: Column | None = None
    values: Values | None = None
    codes: type[Enum] | None = None
    is_closed, hand_column = False, None
    is_nilable, hint = _without_none(hint)
    if typing.get_origin(hint) is Annotated:
        hint, *metadata = typing.get_args(hint)
        for extra in metadata:
            if isinstance(extra, Column):
                column, codes = extra, extra.codes
            elif isinstance(extra, HandColumn):
                hand_column = extra
            elif extra is CLOSED:
                is_closed = True
            elif isinstance(extra, type) and issubclass(extra, Enum):
                codes = extra
            else:
                hint = extra
    also_nilable, hint = _without_none(hint)
    if typing.get_origin(hint) is Literal:
        if codes is None:
            values = Values(typing.get_args(hint), is_closed)
        hint = str
    meaning = meanings.get(name, "")
    return FieldDeclaration(
        name=name,
        hint=hint,
        is_nilable=is_nilable or also_nilable,
        is_optional=is_optional,
        meaning=meaning,
        column=column,
        values=values,
        codes=codes,
        hand_column=hand_column,
    )


def _without_none(hint: Any) -> tuple[bool, Any]:
    """Return whether a type includes None, and the type without it."""
    if typing.get_origin(hint) is NotRequired:
        (hint,) = typing.get_args(hint)
    if typing.get_origin(hint) not in (Union, types.UnionType):
        return False, hint
    (other,) = (argument for argument in typing.get_args(hint) if argument is not type(None))
    return True, other


def _docstrings(kind: type[Any]) -> dict[str, str]:
    """Return the docstrings of a class' attributes, each on one line."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(definition, ast.ClassDef)
    found = {
        name: text
        for base in kind.__bases__
        if is_dataclass(base)
        for name, text in _docstrings(base).items()
    }
    for attribute, text in zip(definition.body, definition.body[1:], strict=False):
        match attribute, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(docstring))):
                found[name] = " ".join(docstring.split())
    return found
