"""docs/firmware.md has the tables of the code.

`make tables` writes them; `HANDTOUCH_UPDATE_DOCS=1 pytest tests/procedures/conformance/test_page.py` that of
the faults.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from docs.firmware_tables import with_tables
from handtouch.procedures.conformance import NodeReport
from tests.minimal_node import minimal_eds
from tests.procedures.conformance.test_faults import CASES, NOT_ON_THE_BUS

PAGE = Path(__file__).parents[3] / "docs" / "firmware.md"
FAULTS = re.compile(r"(?<=<!-- table: faults -->\n)(?:\|.*\n)*")


def test_the_tables_are_those_of_the_code() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert with_tables(page) == page


def test_the_table_of_faults_is_what_the_tests_show() -> None:
    rows = ["| switch | named by |", "|---|---|"]
    rows += [f"| `{switch}` | `{name}` |" for switch, (_, name) in CASES.items()]
    rows += [f"| `{switch}` | {name} |" for switch, name in NOT_ON_THE_BUS.items()]
    table = "".join(f"{row}\n" for row in rows)
    page = PAGE.read_text(encoding="utf-8")
    if os.environ.get("HANDTOUCH_UPDATE_DOCS"):
        PAGE.write_text(FAULTS.sub(lambda _: table, page), encoding="utf-8")
        pytest.skip("written")
    assert FAULTS.findall(page) == [table]


def test_a_node_with_the_objects_of_the_page_and_no_others_conforms(
    line: Any, check: Callable[..., NodeReport], tmp_path: Path
) -> None:
    eds = tmp_path / "minimal.eds"
    eds.write_text(minimal_eds())
    line.add(eds=str(eds))
    report = check(eds=str(eds))
    assert report.failures == []
    assert report.verdict("pdo.event_timer") == "not tested"
