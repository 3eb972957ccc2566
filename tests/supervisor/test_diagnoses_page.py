"""docs/diagnoses.md has a section for each kind of fault: currents, confirmation, action."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from handtouch.wire.faults import FaultKind

PAGE = (Path(__file__).parents[2] / "docs/diagnoses.md").read_text()
SECTIONS = dict(re.findall(r"^### `(\w+)`\n(.*?)(?=^##|\Z)", PAGE, re.MULTILINE | re.DOTALL))


@pytest.mark.parametrize("kind", FaultKind)
def test_each_kind_has_its_section(kind: FaultKind) -> None:
    section = SECTIONS[kind]
    for part in ("**Currents**", "**Confirms**", "**Do**"):
        assert part in section


def test_sections_are_of_kinds_that_exist() -> None:
    assert set(SECTIONS) == {kind.value for kind in FaultKind}
