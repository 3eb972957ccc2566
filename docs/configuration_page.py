"""Reference of all keys of TOML files: `make tables` writes docs/configuration.md with it.

Types, defaults, ranges and meanings are those of the models that read the files. An example is the first of
the model's own, else the first value of the key in config/*.toml, else the default.
"""

from __future__ import annotations

import re
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, Union

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from handtouch.config import tables
from handtouch.node import settings

CONFIG = Path(__file__).parents[1] / "config"
HEAD = """# Configuration reference

<!-- written by `make tables` from the models that read the files -->

Every key of the two files that handtouch reads, both in TOML. A key's name carries its unit. Unknown keys, values
beyond the range, and lengths in metres or angles in radians are errors that name file, line, key, value and remedy:
`handtouch check hand.toml` reports all of them at once. Paths are relative to the file.

An editor that knows `#:schema handtouch.schema.json`, the first line of [the shipped files](../config/utah_mit.toml),
completes and checks keys; `handtouch check --schema` and `handtouch node --schema` print the schemas.

*required*: the file must give the key. *none*: the key has no value unless it is given; its meaning says what
that does. "this file": the one that has the key.
"""  # noqa: E501
DEPLOYMENT = """
## Deployment file

The file of `handtouch run`; [a new hand](hand.md) explains how to write one.
"""
NODE = """
## Sensor node's file

The file of `handtouch node` ([a node on Linux](node.md)); `trim` names a file of its own.
"""
UNITS = {
    "n_per_mm": "N/mm",
    "signal_per_n": "unit/N",
    "bit_s": "bit/s",
    "ohm_per_square": "Ω per square",
    "ohm_mm2": "Ω mm²",
    "std_mm": "mm",
    "std_deg": "°",
    "mm": "mm",
    "deg": "°",
    "ms": "ms",
    "us": "µs",
    "s": "s",
    "hz": "Hz",
    "n": "N",
    "kpa": "kPa",
    "ohm": "Ω",
    "ma": "mA",
    "v": "V",
    "counts": "counts",
    "fraction": "fraction",
    "share": "fraction",
}
NODE_FILE = "node file"
SAME = {"hand.pad.touch": "touch"}
KIND_TITLES = {
    "surface": "Surfaces",
    "pattern": "Shear patterns",
    "shape": "Shapes of objects",
    "response": "`[response.NAME]`",
    "source": "`[source.NAME]`",
}
KIND_ANCHORS = {
    "response": "responsename",
    "surface": "surfaces",
    "pattern": "shear-patterns",
    "shape": "shapes-of-objects",
}
TITLES = {"": "Keys before the first table", "trim file": "Trim file"}
TYPES = {str: "text", bool: "`true`, `false`", int: "integer", float: "number"}


def _is_table(annotation: Any) -> bool:
    """Return whether a value of this type is a table, or tables, with a section of its own."""
    if isinstance(annotation, type) and not typing.get_origin(annotation):
        return issubclass(annotation, BaseModel)
    return any(map(_is_table, typing.get_args(annotation)))


def _bare(annotation: Any) -> Any:
    """Return a type without `Annotated` and without None."""
    while typing.get_origin(annotation) is typing.Annotated:
        annotation = typing.get_args(annotation)[0]
    if typing.get_origin(annotation) in (Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(annotation) if kind is not type(None)]
        return _bare(kinds[0]) if len(kinds) == 1 else annotation
    return annotation


def _limits(annotation: Any) -> Iterator[Any]:
    """Yield the constraints that stand in a type itself, not in those of its elements."""
    if typing.get_origin(annotation) is typing.Annotated:
        first, *extra = typing.get_args(annotation)
        for entry in extra:
            yield from entry.metadata if isinstance(entry, FieldInfo) else (entry,)
        yield from _limits(first)
    elif typing.get_origin(annotation) in (Union, types.UnionType):
        for kind in typing.get_args(annotation):
            yield from _limits(kind)


def _range(annotation: Any, metadata: list[Any]) -> str:
    found = [*metadata, *_limits(annotation)]
    kind = _bare(annotation)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return ", ".join(f"`{choice}`" for choice in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(_range(choice, []) for choice in arguments)
    if origin is dict:
        return f"table of {_plural(_range(arguments[1], []))}"
    if origin is tuple:
        return _list_text(arguments, found)
    low = next(
        (
            f"{'>' if isinstance(one, Gt) else '≥'} {_number(one)}"
            for one in found
            if isinstance(one, Ge | Gt)
        ),
        "",
    )
    high = next(
        (
            f"{'<' if isinstance(one, Lt) else '≤'} {_number(one)}"
            for one in found
            if isinstance(one, Le | Lt)
        ),
        "",
    )
    bounds = ", ".join(filter(None, (low, high)))
    return f"{'integer ' if kind is int else ''}{bounds}" if bounds else TYPES[kind]


def _list_text(arguments: tuple[Any, ...], found: list[Any]) -> str:
    least = next((one.min_length for one in found if isinstance(one, MinLen)), None)
    most = next((one.max_length for one in found if isinstance(one, MaxLen)), None)
    inner = _plural(_range(arguments[0], []))
    if arguments[-1] is not Ellipsis:
        return f"list of {len(arguments)}: {inner}"
    count = f"{least} to {most}" if most else f"{least} or more" if least else ""
    return f"list of {count}: {inner}" if count else f"list: {inner}"


def _plural(text: str) -> str:
    return {"text": "texts", "number": "numbers", "integer": "integers"}.get(text, text)


def _number(limit: Any) -> str:
    value = next(getattr(limit, name) for name in ("ge", "gt", "le", "lt") if hasattr(limit, name))
    return (
        "2³² - 1"
        if value == 0xFFFFFFFF
        else f"{value:g}"
        if value < 1e6
        else f"{value:,.0f}".replace(",", " ")
    )


def _unit(key: str) -> str:
    fitting = [ending for ending in UNITS if key == ending or key.endswith(f"_{ending}")]
    return UNITS[max(fitting, key=len)] if fitting else ""


def _key(name: str) -> str:
    return name if re.fullmatch(r"[\w-]+", name) else f'"{name}"'


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, Mapping):
        return (
            f"{{ {', '.join(f'{_key(name)} = {_toml(inner)}' for name, inner in value.items())} }}"
            if value
            else "{}"
        )
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return str(value)


def _default(field: FieldInfo) -> Any:
    return field.get_default(call_default_factory=True)


def _default_text(field: FieldInfo) -> str:
    if field.is_required():
        return "*required*"
    value = _default(field)
    if value is None:
        return "*none*"
    return f"`{_toml(value)}`" if value not in ("", (), {}) or value is False or value == 0 else "empty"


def _shipped() -> dict[tuple[str, str], Any]:
    """Return the first value of every key in the shipped files, by table and key."""
    found: dict[tuple[str, str], Any] = {}

    def add(table: str, content: dict[str, Any], names: Mapping[str, Any]) -> None:
        for key, value in content.items():
            path = f"{table}.{key}".lstrip(".")
            named = f"{path}.*" in names
            entries = value if isinstance(value, list) else list(value.values()) if named else [value]
            if key in tables.KINDS:
                kinds = [value] if "kind" in value else value.values() if isinstance(value, dict) else []
                for entry in kinds:
                    add(entry["kind"], entry, {})
            elif key in settings.KINDS and table == NODE_FILE:
                for entry in value.values():
                    add(entry["kind"], entry, {})
            elif path in names or named:
                for entry in entries:
                    add(f"{path}.*" if named else path, entry, names)
            found.setdefault((table, key), value)

    for path in sorted(CONFIG.glob("*.toml")):
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        is_node = "adc" in content or "source" in content
        add(
            NODE_FILE if is_node else "",
            content,
            {f"{NODE_FILE}.{name}": None for name in settings.TABLES} if is_node else tables.TABLES,
        )
    return found


SHIPPED = _shipped()


def _example(table: str, key: str, field: FieldInfo) -> Any:
    if field.examples:
        return field.examples[0]
    if (table, key) in SHIPPED:
        return SHIPPED[table, key]
    value = PydanticUndefined if field.is_required() else _default(field)
    if value is None or value is PydanticUndefined or value in ("", (), {}):
        raise SystemExit(f"[{table}] {key}: neither its model nor a file in config/ has an example")
    return value


def _rows(table: str, model: type[BaseModel]) -> Iterator[str]:
    yield "| key | unit | default | range | meaning | example |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, field in model.model_fields.items():
        key = field.alias or name
        if _is_table(field.annotation):
            if table not in ("", NODE_FILE):  # whose tables follow
                yield _table_row(table, key, field)
            continue
        if key == "kind":
            continue
        cells = (
            f"`{key}`",
            _unit(key),
            _default_text(field),
            _range(field.annotation, field.metadata),
            str(field.description).replace("|", "\\|"),
            f"`{key} = {_toml(_example(table, key, field))}`",
        )
        yield f"| {' | '.join(cells)} |".replace("|  |", "| |")


def _table_row(table: str, key: str, field: FieldInfo) -> str:
    value = None if field.is_required() else _default(field)
    default = "*required*" if field.is_required() else "*none*" if value is None else "its defaults"
    name = f"{table}.{key}".removeprefix(f"{NODE_FILE}.").replace("*", "NAME")
    section = KIND_ANCHORS.get(key) or SAME.get(name) or _anchor(name)
    return f"| `{key}` | | {default} | table | {field.description} | [its keys](#{section}) |"


def _anchor(name: str) -> str:
    """Return the anchor of the heading of a table's section, as GitHub and MyST make it."""
    return re.sub(r"[^\w-]", "", name.lower())


def _has_rows(model: type[BaseModel]) -> bool:
    return any(not _is_table(field.annotation) for field in model.model_fields.values())


def _sections(models: Mapping[str, type[BaseModel]], prefix: str, lists: set[str]) -> Iterator[str]:
    for name, model in models.items():
        if name in SAME or not (name or _has_rows(model)):
            continue
        header = name.replace("*", "NAME")
        title = TITLES.get(name) or (f"[[{header}]]" if name in lists else f"[{header}]")
        text = (model.__doc__ or "").strip().rpartition("`: ")[2]
        yield f"\n### {title if name in TITLES else f'`{title}`'}\n"
        yield f"{text[0].upper()}{text[1:]}\n"
        yield from _rows(f"{prefix}.{name}".strip(".") if prefix else name, model)


def _kinds(key: str, head: str, models: Mapping[str, type[BaseModel]]) -> Iterator[str]:
    yield f"\n### {KIND_TITLES[key]}\n"
    yield f"{head}: its other keys depend on `kind`.\n"
    for kind, model in models.items():
        text = (model.__doc__ or "").strip().rpartition("`: ")[2]
        yield f'\n#### `kind = "{kind}"`\n'
        yield f"{text[0].upper()}{text[1:]}\n"
        yield from _rows(kind, model)


def page() -> Iterator[str]:
    """Yield the lines of the page."""
    yield HEAD
    yield DEPLOYMENT.strip()
    yield from _sections(tables.TABLES, "", {"bus", "hand", "hand.pad"})
    for key, models in tables.KINDS.items():
        head = "Tables of pads that aren't sheets with electrodes, see [responses](responses.md)"
        yield from _kinds(key, head if key == "response" else f"`{key} = {{ kind = ... }}`", models)
    yield NODE
    yield from _sections(settings.TABLES, NODE_FILE, {"pad"})
    for key, models in settings.KINDS.items():
        yield from _kinds(key, f"A table `[{key}.NAME]`, read instead of an ADC", models)
    yield from _sections({"trim file": settings.Trim}, NODE_FILE, set())


if __name__ == "__main__":
    print("\n".join(page()).replace("\n\n\n", "\n\n"))
