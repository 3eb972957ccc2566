"""Mistakes in a deployment file, in the words of the file: place, value, and what would be right.

Public names: `Problem`, `ConfigError`, `problems_of`. The definitions of the tables are in
`handtouch.config.tables`.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError

Tables = Mapping[str, type[BaseModel]]
"""Definition of each table by its dotted path; "*" stands for a name that the user chose."""

_UNITS = ("_mm", "_ms", "_deg", "_n", "_v", "_ma", "_ohm", "_bit_s", "_mm2", "_kpa", "_counts", "_samples")
_OTHER_UNITS = frozenset(
    {"m", "cm", "um", "in", "s", "us", "hz", "khz", "rad", "kn", "mv", "a", "ua", "kohm", "pa", "mpa"}
)


@dataclass(frozen=True)
class Problem:
    """One mistake: where it is, what stands there, and what would be right."""

    place: str
    value: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.place}{self.value}: {self.remedy}"


class ConfigError(ValueError):
    """A deployment file that can't be used; `problems` holds every mistake found, `str` a line for each."""

    def __init__(self, file: str, problems: tuple[Problem, ...]) -> None:
        super().__init__("\n".join(f"{file}: {problem}" for problem in problems))
        self.file = file
        self.problems = problems


def problems_of(
    raw: Mapping[str, Any], error: ValidationError, tables: Tables, kinds: Tables
) -> tuple[Problem, ...]:
    """Every mistake that pydantic found in a file's tables; `kinds` are the definitions by `kind`."""
    found = [_Mistake(raw, item, tables, kinds) for item in error.errors()]
    slips = {(mistake.section, mistake.meant) for mistake in found if mistake.meant}
    told = (mistake.tell() for mistake in found if (mistake.section, mistake.key) not in slips)
    return tuple(dict.fromkeys(problem for problem in told if problem))


_WITH_KINDS = (["surface"], ["fault"])  # tables that one of several definitions holds for, by their `kind`
_SCALARS = ("str", "int", "float", "bool")  # how pydantic marks the alternatives of a union of plain values
_PLAIN = (
    ("Input should be ", "must be "),
    ("Value error, ", ""),
    ("a valid dictionary", "a table of keys"),
    ("a valid ", "a "),
    ("a tuple", "a list"),
    ("a integer", "an integer"),
    ("Tuple should have", "must have"),
)


class _Mistake:
    """One of pydantic's findings, located in the file."""

    def __init__(self, raw: Mapping[str, Any], error: Any, tables: Tables, kinds: Tables) -> None:
        loc = tuple(error["loc"])
        self.kind: str = error["type"]
        self.union = loc[-1] in _SCALARS if loc else False
        self.error = error
        self.kinds = kinds
        path, self.section, self.shown, self.table = _locate(raw, loc[:-1] if self.union else loc)
        self.path, self.tables = path, tables
        self.key = path[-1] if path else ""
        self.model = _model(path[:-1], self.table, tables, kinds)
        known = list(_keys(self.model))
        self.meant = _near(self.key, known) if self.kind == "extra_forbidden" else None

    @property
    def place(self) -> str:
        return ": ".join(part for part in (self.section, self.shown) if part) or "top level"

    def tell(self) -> Problem | None:
        """The mistake in the words of the file; None where another one says the same."""
        value = f" = {_show(self.error['input'])}"
        context = self.error.get("ctx", {})
        if self.kind == "extra_forbidden":
            return self._unknown(value)
        if self.kind == "missing":
            return Problem(self.place, "", f"is missing{self._header() or self._meaning()}")
        if self.kind.startswith("union_tag"):
            given = self.error["input"].get("kind") if isinstance(self.error["input"], dict) else None
            at, value = (".kind", f" = {_show(given)}") if given is not None else ("", value)
            return Problem(self.place + at, value, "needs " + _either(f'kind = "{k}"' for k in self.kinds))
        if self.kind == "too_short" and len(self.error["input"]) >= context["min_length"]:
            return None  # a list is also called too short when all its entries are wrong
        if self.kind == "string_pattern_mismatch":
            remedy = "a name starts with a letter and holds letters, digits, _ and - only"
        elif self.union:
            remedy = "must be a string or a number"
        else:
            remedy = str(self.error["msg"])
            for theirs, ours in _PLAIN:
                remedy = remedy.replace(theirs, ours)
        if self.kind == "tuple_type" and isinstance(self.error["input"], dict):
            return Problem(f"[{self.key}]", "", f"must be a list of tables: write [[{self.key}]]")
        if self.kind == "value_error":  # of a whole table; it says itself what is wrong
            return Problem(self.place, "", remedy)
        if self.kind == "model_type":
            remedy = "must be a table of keys"
        return Problem(self.place, value, remedy + self._meaning())

    def _unknown(self, value: str) -> Problem:
        if not self.section and isinstance(self.error["input"], dict | list):
            remedy = (
                f"did you mean [{self.meant}]?" if self.meant else f"known: {', '.join(_keys(self.model))}"
            )
            return Problem(f"[{self.key}]", "", f"unknown table; {remedy}")
        if not self.meant:
            return Problem(self.place, value, f"unknown key; known here: {', '.join(_keys(self.model))}")
        unit = " Keys carry their unit" if _without_unit(self.key) == _without_unit(self.meant) else ""
        return Problem(
            self.place, value, f'unknown key; did you mean "{self.meant}"?{unit}{self._meaning(self.meant)}'
        )

    def _header(self) -> str:
        """How the file writes the table that is missing; empty where it is a plain key."""
        path = ".".join(self.path)
        header = (
            f"[[{path}]]" if path in self.tables else f"[{path}.NAME]" if f"{path}.*" in self.tables else ""
        )
        return f"; it is a table of its own, under a line {header}" if header else ""

    def _meaning(self, key: str = "") -> str:
        key = key or self.key
        meaning = _keys(self.model).get(key, "")
        return f" ({key}: {meaning})" if meaning else ""


def _locate(
    raw: Mapping[str, Any], loc: tuple[str | int, ...]
) -> tuple[list[str], str, str, Mapping[str, Any]]:
    """Follow pydantic's location to (keys, section as the file writes it, rest, innermost table)."""
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
        if step == "[key]" or (
            isinstance(here, dict) and here.get("kind") == step and path[-1:] in _WITH_KINDS
        ):
            continue  # pydantic's own marks, not keys of the file
        if isinstance(here, dict):
            table = here
            here = here.get(step)
        path.append(step)
        shown.append(step)
    if not section and len(shown) > 1:
        section, shown = f"[{'.'.join(shown[:-1])}]", shown[-1:]
    return path, section, ".".join(shown), table


def _model(
    path: list[str], table: Mapping[str, Any], tables: Tables, kinds: Tables
) -> type[BaseModel] | None:
    """The definition that the table at a path must follow."""
    if path[-1:] in _WITH_KINDS:
        return kinds.get(str(table.get("kind")))
    return tables.get(".".join(path)) or tables.get(".".join([*path[:-1], "*"]))


def _keys(model: type[BaseModel] | None) -> dict[str, str]:
    """Keys of a table as the file spells them, with their meaning."""
    fields = model.model_fields if model else {}
    return {field.alias or name: field.description or "" for name, field in fields.items()}


def _near(key: str, candidates: list[str]) -> str | None:
    """The candidate that differs from the key by a forgotten unit or a slip of the pen."""
    for candidate in candidates:
        if any(candidate == key + unit or key == candidate + unit for unit in _UNITS):
            return candidate
    return next(iter(difflib.get_close_matches(key, candidates, n=1, cutoff=0.6)), None)


def _without_unit(key: str) -> str:
    """The quantity that a key names; what follows its last _ counts as a unit, known here or not."""
    known = next((unit for unit in sorted(_UNITS, key=len, reverse=True) if key.endswith(unit)), "")
    if known:
        return key.removesuffix(known)
    stem, _, last = key.rpartition("_")
    return stem if last in _OTHER_UNITS else key


def _either(alternatives: Iterator[str]) -> str:
    *most, last = alternatives
    return f"{', '.join(most)} or {last}"


def _show(value: object) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."
