"""docs/firmware.md has the tables of the code; `make tables` writes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from docs.firmware_tables import with_tables
from handtouch.procedures.conformance import NodeReport
from tests.minimal_node import minimal_eds

PAGE = Path(__file__).parents[3] / "docs" / "firmware.md"


def test_the_tables_are_those_of_the_code() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert with_tables(page) == page


def test_a_node_with_the_objects_of_the_page_and_no_others_conforms(
    line: Any, check: Callable[..., NodeReport], tmp_path: Path
) -> None:
    eds = tmp_path / "minimal.eds"
    eds.write_text(minimal_eds())
    line.add(eds=str(eds))
    report = check(eds=str(eds))
    assert report.failures == []
    assert report.verdict("pdo.event_timer") == "not tested"
