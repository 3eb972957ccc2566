"""Errors in a deployment file, each with its location in the file, the value and a remedy.

Public names: `Problem`, `ConfigError`, `problems_of`, `suggest_name`. The definitions of the tables are in
`handtouch.config.tables`.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError

from handtouch.config.former_keys import replacement

Tables = Mapping[str, type[BaseModel]]
"""Model of each table by its dotted path; "*" stands for a name chosen by the user."""

_UNIT_SUFFIXES = (
    "_mm",
    "_ms",
    "_deg",
    "_n",
    "_v",
    "_ma",
    "_ohm",
    "_bit_s",
    "_mm2",
    "_kpa",
    "_counts",
    "_samples",
)
_UNUSED_UNITS = frozenset(
    {"m", "cm", "um", "in", "s", "us", "hz", "khz", "rad", "kn", "mv", "a", "ua", "kohm", "pa", "mpa"}
)


@dataclass(frozen=True)
class Problem:
    """One error: its location in the file, the value there, and the remedy."""

    location: str
    value: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.location}{self.value}: {self.remedy}"


class ConfigError(ValueError):
    """A deployment file that can't be used; `problems` holds every error, `str` has a line for each kind."""

    exit_status = 2

    def __init__(self, file: str, problems: tuple[Problem, ...]) -> None:
        super().__init__("\n".join(f"{file}: {line}" for line in _lines(problems)))
        self.file = file
        self.problems = problems


_NUMBER = r"[+-]?(0[xob][0-9a-fA-F]+|[\d_]*\.?\d+([eE][+-]?\d+)?)"
"""A number as TOML has it"""
_ENTRY = re.compile(r'\[\[[\w.]+\]\] (\d+)(?: "([^"]*)")?')
"""Location of an entry of a list, as `_locate` writes it: its number and name"""


def _lines(problems: Sequence[Problem]) -> Iterator[str]:
    """Yield a line for each problem; one for those that are the same in several entries of a list."""
    alike: dict[tuple[str, str, str], list[Problem]] = {}
    for problem in problems:
        place = _ENTRY.sub("", problem.location, count=1)
        alike.setdefault((place, problem.value, problem.remedy), []).append(problem)
    for first, *others in alike.values():
        found = [_ENTRY.match(problem.location) for problem in others]
        names = [match[2] or match[1] for match in found if match]
        yield str(first) + (f"; the same in {', '.join(names)}" if names else "")


def problems_of(
    raw: Mapping[str, Any], error: ValidationError, tables: Tables, kinds: Mapping[str, Tables]
) -> tuple[Problem, ...]:
    """Return the errors that pydantic found in a file's tables.

    kinds: of each table that follows one of several models by its key `kind`, the models by kind.
    """
    found = [_ValidationMistake(raw, item, tables, kinds) for item in error.errors()]
    misspelled = {(mistake.section, mistake.closest_key) for mistake in found if mistake.closest_key}
    problems = (mistake.to_problem() for mistake in found if (mistake.section, mistake.key) not in misspelled)
    return tuple(dict.fromkeys(problem for problem in problems if problem))


_SCALAR_TYPES = ("str", "int", "float", "bool")  # pydantic's marks for the alternatives of a scalar union
_MESSAGE_REPLACEMENTS = (
    ("Input should be ", "must be "),
    ("Value error, ", ""),
    ("a valid dictionary", "a table of keys"),
    ("a valid ", "a "),
    ("a tuple", "a list"),
    ("a integer", "an integer"),
    ("Tuple should have", "must have"),
)


class _ValidationMistake:
    """One of pydantic's errors, located in the file."""

    def __init__(
        self, raw: Mapping[str, Any], error: Any, tables: Tables, kinds: Mapping[str, Tables]
    ) -> None:
        loc = tuple(error["loc"])
        self.error_type: str = error["type"]
        self.is_scalar_union = loc[-1] in _SCALAR_TYPES if loc else False
        self.error = error
        self.raw, self.kinds = raw, kinds
        path, self.section, self.key_path, self.table = _locate(
            raw, loc[:-1] if self.is_scalar_union else loc, kinds
        )
        self.path, self.tables = path, tables
        self.key = path[-1] if path else ""
        self.model = _table_model(path[:-1], self.table, tables, kinds)
        known = list(_key_descriptions(self.model))
        self.closest_key = _closest_key(self.key, known) if self.error_type == "extra_forbidden" else None

    @property
    def location(self) -> str:
        return ": ".join(part for part in (self.section, self.key_path) if part) or "top level"

    def to_problem(self) -> Problem | None:
        """Return the error in terms of the file; None where another one already covers it."""
        value = f" = {_format_input(self.error['input'])}"
        context = self.error.get("ctx", {})
        if self.error_type == "extra_forbidden":
            return self._unknown_key_problem(value)
        if self.error_type == "missing":
            return Problem(
                self.location, "", f"is missing{self._table_header_hint() or self._key_description()}"
            )
        if self.error_type.startswith("union_tag"):
            given = self.error["input"].get("kind") if isinstance(self.error["input"], dict) else None
            at, value = (".kind", f" = {_format_input(given)}") if given is not None else ("", value)
            is_whole = self.section.startswith("[") and not (self.section.startswith("[[") or self.key_path)
            at = at.replace(".", ": ") if is_whole else at
            kinds = self.kinds[_kind_table(self.path, self.kinds)]
            hint = suggest_name(str(given), list(kinds))
            known = _join_alternatives(map(_format_input, kinds))
            remedy = f"{hint}must be {known}" if given is not None else f"needs kind = {known}"
            return Problem(self.location + at, value, remedy)
        if self.error_type == "too_short" and len(self.error["input"]) >= context["min_length"]:
            return None  # pydantic also calls a list too short when all its entries are invalid
        if self.error_type == "string_pattern_mismatch":
            remedy = "must start with a letter and hold only letters, digits, _ and -"
        elif self.is_scalar_union:
            remedy = "must be a string or a number"
        else:
            remedy = str(self.error["msg"])
            for theirs, ours in _MESSAGE_REPLACEMENTS:
                remedy = remedy.replace(theirs, ours)
        if self.error_type in ("int_type", "float_type") and _is_number(given := self.error["input"]):
            remedy += f", without quotes: write {given}"
        if self.error_type == "tuple_type" and isinstance(self.error["input"], dict):
            return Problem(f"[{self.key}]", "", f"must be a list of tables: write [[{self.key}]]")
        if self.error_type == "value_error":  # error of a whole table; the message is complete
            return Problem(self.location, "", remedy)
        if self.error_type == "model_type":
            remedy = "must be a table of keys"
        return Problem(self.location, value, remedy + self._key_description())

    def _unknown_key_problem(self, value: str) -> Problem:
        if (found := replacement(self.key, self.error["input"], self.raw)) and self.section:
            key, number = found
            return Problem(
                self.location, value, f"is {key} now: write {key} = {number:g}{self._key_description(key)}"
            )
        if not self.section and isinstance(self.error["input"], dict | list):
            remedy = (
                f"did you mean [{self.closest_key}]?"
                if self.closest_key
                else f"known: {', '.join(_key_descriptions(self.model))}"
            )
            return Problem(f"[{self.key}]", "", f"unknown table; {remedy}")
        if not self.closest_key:
            known = _key_descriptions(self.model)
            remedy = (
                _period_of_rate(self.key, self.error["input"], known) or f"known here: {', '.join(known)}"
            )
            return Problem(self.location, value, f"unknown key; {remedy}")
        unit = " Keys carry their unit" if _without_unit(self.key) == _without_unit(self.closest_key) else ""
        return Problem(
            self.location,
            value,
            f'unknown key; did you mean "{self.closest_key}"?{unit}{self._key_description(self.closest_key)}',
        )

    def _table_header_hint(self) -> str:
        """Return a hint at the header of a missing table; empty for a plain key."""
        path = ".".join(self.path)
        header = (
            f"[[{path}]]" if path in self.tables else f"[{path}.NAME]" if f"{path}.*" in self.tables else ""
        )
        return f"; it is a table of its own, under a line {header}" if header else ""

    def _key_description(self, key: str = "") -> str:
        key = key or self.key
        meaning = _key_descriptions(self.model).get(key, "")
        return f" ({key}: {meaning})" if meaning else ""


def _locate(
    raw: Mapping[str, Any], loc: tuple[str | int, ...], kinds: Mapping[str, Tables]
) -> tuple[list[str], str, str, Mapping[str, Any]]:
    """Translate pydantic's location into (keys, section header, remaining keys, innermost table)."""
    here: Any = raw
    table: Mapping[str, Any] = raw
    path: list[str] = []
    section = owner = ""
    shown: list[str] = []
    for step in loc:
        if isinstance(step, int):
            here = here[step] if isinstance(here, list) and step < len(here) else None
            if isinstance(here, dict):
                name = next((here[key] for key in ("link", "name") if isinstance(here.get(key), str)), "")
                section = f"[[{'.'.join(path)}]] {step + 1}" + (f' "{owner}{name}"' if name else "")
                table, shown, owner = here, [], f"{name}/" if name else ""
            elif shown:
                shown[-1] += f"[{step}]"
            continue
        is_kind = isinstance(here, dict) and here.get("kind") == step and _kind_table(path, kinds)
        if step == "[key]" or is_kind:
            continue  # pydantic's own marks, not keys of the file
        if isinstance(here, dict):
            table = here
            here = here.get(step)
        path.append(step)
        shown.append(step)
    if not section and isinstance(here, dict) and path[:-1] == [_kind_table(path[:-1], kinds)]:
        section, shown = f"[{'.'.join(path)}]", []  # a table as a whole, such as [source.NAME]
    if not section and len(shown) > 1:
        section, shown = f"[{'.'.join(shown[:-1])}]", shown[-1:]
    return path, section, ".".join(shown), table


def _kind_table(path: list[str], kinds: Mapping[str, Tables]) -> str:
    """Return the name of the table of several kinds at a path, such as surface or source.NAME; else ""."""
    return next((name for name in reversed(path[-2:]) if name in kinds), "")


def _table_model(
    path: list[str], table: Mapping[str, Any], tables: Tables, kinds: Mapping[str, Tables]
) -> type[BaseModel] | None:
    """Return the model of the table at a path."""
    if name := _kind_table(path, kinds):
        return kinds[name].get(str(table.get("kind")))
    return tables.get(".".join(path)) or tables.get(".".join([*path[:-1], "*"]))


def _key_descriptions(model: type[BaseModel] | None) -> dict[str, str]:
    """Return the keys of a table as spelled in the file, with their descriptions."""
    fields = model.model_fields if model else {}
    return {field.alias or name: field.description or "" for name, field in fields.items()}


def _closest_key(key: str, candidates: list[str]) -> str | None:
    """Return the candidate that differs from the key by a missing unit or a misspelling."""
    for candidate in candidates:
        if any(candidate == key + unit or key == candidate + unit for unit in _UNIT_SUFFIXES):
            return candidate
    return next(iter(difflib.get_close_matches(key, candidates, n=1, cutoff=0.6)), None)


def _period_of_rate(key: str, value: object, known: Mapping[str, str]) -> str:
    """Return the key and value of the period that a rate in Hz stands for; empty if there is none."""
    period = f"{key.removesuffix('_hz')}_period_ms"
    if not key.endswith("_hz") or period not in known or not isinstance(value, int | float) or not value > 0:
        return ""
    return f"write {period} = {1e3 / value:.4g}"


def _is_number(value: object) -> bool:
    return isinstance(value, str) and re.fullmatch(_NUMBER, value) is not None


def _without_unit(key: str) -> str:
    """Return a key without its unit."""
    known = next((unit for unit in sorted(_UNIT_SUFFIXES, key=len, reverse=True) if key.endswith(unit)), "")
    if known:
        return key.removesuffix(known)
    stem, _, last = key.rpartition("_")
    return stem if last in _UNUSED_UNITS else key


def _join_alternatives(alternatives: Iterator[str]) -> str:
    *most, last = alternatives
    return f"{', '.join(most)} or {last}"


def _format_input(value: object) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."


def suggest_name(value: str, known: Sequence[str]) -> str:
    """Return a question that suggests the closest known name, followed by a space; empty if none is close."""
    close = difflib.get_close_matches(value, known, 1)
    return f'did you mean "{close[0]}"? ' if close else ""
