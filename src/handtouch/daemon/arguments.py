"""Validation of request arguments, with errors in terms of the message's keys and JSON types.

Public name: `parse_arguments`.
"""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import ValidationError

from handtouch.config import Table
from handtouch.daemon.control import RefusedError, format_value

_MAX_PROBLEMS = 5
_TEXTS = {
    "missing": "is missing",
    "extra_forbidden": "unknown argument",
    "tuple_type": "must be an array",
    "list_type": "must be an array",
    "string_type": "must be a string",
    "bool_type": "must be true or false",
    "int_type": "must be an integer",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "model_type": "must be an object",
    "model_attributes_type": "must be an object",
    "dict_type": "must be an object",
    "too_short": "must have at least {min_length} elements",
    "too_long": "must have at most {max_length} elements",
    "string_too_short": "must have at least {min_length} characters",
    "string_too_long": "must have at most {max_length} characters",
    "string_pattern_mismatch": "must match {pattern}",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
}
"""pydantic error type -> text, with the values of its context"""

_T = TypeVar("_T", bound=Table)


def parse_arguments(kind: type[_T], arguments: dict[str, Any]) -> _T:
    """Return the arguments as a table of the given kind. Raises RefusedError naming every mistake."""
    try:
        return kind.model_validate(arguments)
    except ValidationError as error:
        known = ", ".join(kind.model_fields) or "none"
        problems = [_describe(dict(item)) for item in error.errors(include_url=False)[:_MAX_PROBLEMS]]
        raise RefusedError("; ".join(problems) + f" (arguments: {known})") from error


def _describe(error: dict[str, Any]) -> str:
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in error["loc"]).lstrip(".")
    known = _TEXTS.get(error["type"])
    text = error["msg"] if known is None else known.format(**error.get("ctx", {})).replace("'", '"')
    return (
        f"{key} {text}" if error["type"] == "missing" else f"{key} = {format_value(error['input'])}: {text}"
    )
