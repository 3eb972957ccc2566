"""docs/configuration.md has every key as its model declares it, with an example that the model accepts."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, create_model

from handtouch.config import surface_table
from handtouch.config.base import Table
from handtouch.config.tables import KINDS, TABLES
from handtouch.node import settings

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "configuration.md").read_text(encoding="utf-8")
DEPLOYMENT, NODE = PAGE.split("\n## Sensor node's file\n")
HEADINGS = {"": "Keys before the first table", "trim": "Trim file"}


def examples(part: str, heading: str) -> dict[str, Any]:
    """Return the examples in the section of a table, by key."""
    section = re.search(rf"^###+ `?{re.escape(heading)}`?\n(.*?)(?=^##|\Z)", part, re.MULTILINE | re.DOTALL)
    assert section is not None, heading
    found: dict[str, Any] = {}
    for line in re.findall(r"`([^`]+)` \|$", section[1], re.MULTILINE):
        found |= tomllib.loads(line)
    return found


def sections() -> list[Any]:
    lists = {"bus": "[[bus]]", "hand": "[[hand]]", "hand.pad": "[[hand.pad]]"}
    pages: dict[str, tuple[str, Mapping[str, type[BaseModel]], dict[str, str]]] = {
        "deployment": (DEPLOYMENT, {name: TABLES[name] for name in TABLES if name}, lists),
        "node": (NODE, {**settings.TABLES, "trim": settings.Trim}, {"pad": "[[pad]]"}),
    }
    found = [
        pytest.param(
            part,
            HEADINGS.get(name) or lists.get(name) or f"[{name.replace('*', 'NAME')}]",
            model,
            id=f"{file} {name}",
        )
        for file, (part, models, lists) in pages.items()
        for name, model in models.items()
        if name != "hand.pad.touch"  # the keys of [touch]
    ]
    for part, all_kinds in ((DEPLOYMENT, KINDS), (NODE, settings.KINDS)):
        kinds = ((kind, model) for models in all_kinds.values() for kind, model in models.items())
        found += [pytest.param(part, f'kind = "{kind}"', model, id=kind) for kind, model in kinds]
    return found


def test_the_page_is_current() -> None:
    written = subprocess.run(
        [sys.executable, str(DOCS / "configuration_page.py")], capture_output=True, text=True, check=True
    ).stdout
    assert written == PAGE, "run `make tables`"


@pytest.mark.parametrize(("part", "heading", "model"), sections())
def test_every_key_has_an_example_that_its_model_accepts(
    part: str, heading: str, model: type[BaseModel]
) -> None:
    found = examples(part, heading)
    for name, field in model.model_fields.items():
        key = field.alias or name
        if key in found:
            single = create_model("Single", __base__=Table, **{name: (field.annotation, field)})  # type: ignore[call-overload]
            single.model_validate({key: found[key]})
        else:
            assert key == "kind" or f"| `{key}` |" in part or f"`[{key}" in part or f"`[[{key}" in part


@pytest.mark.parametrize("kind", KINDS["surface"])
def test_the_examples_of_a_surface_make_one(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(DOCS.parent / "config")  # a mesh's example is the shipped file
    assert not list(surface_table(kind, **examples(DEPLOYMENT, f'kind = "{kind}"')).problems())
