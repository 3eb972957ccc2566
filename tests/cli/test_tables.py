"""Tables on terminals of any width: nothing is cut, the verdict comes first."""

from __future__ import annotations

import re
import sys
from dataclasses import asdict, replace
from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from handtouch.canbus.find.survey import NodeFacts
from handtouch.cli import scan, status
from handtouch.cli.tables import make_table, print_table
from handtouch.procedures.scan import BusReport, buses_to_scan
from tests.view.test_terminal import HEALTH, SERVICE

WIDTHS = (80, 120)
LINKS = [
    f"{finger}_{part}" for finger in ("thumb", "index", "middle", "ring") for part in ("proximal", "distal")
]
BUS = {
    "state": "active", "load": 0.43, "problem": "", "causes": {}, "frames": 4_000_000_000,
    "sync": {"by": "kernel", "problem": "", "jitter_us": {"p99": 80.0, "max": 90.0}},
}  # fmt: skip


def _answer(**values: Any) -> dict[str, Any]:
    pads = [
        asdict(replace(HEALTH, link=link, node_id=17 + i, serial=4_000_000_000 + i, **values))
        for i, link in enumerate(LINKS)
    ]
    service = asdict(SERVICE) | {
        "supervisor": None, "buses": {"can0": BUS}, "congestion_episodes": {},
        "loop": {"stages": {}, "late": {}},
        "process": {"memory_bytes": 10**8, "cpu_s": 3.5, "loop_cpu_s": 3.0},
    }  # fmt: skip
    return {"service": service, "scene": {"scenes": [], "pads": []}, "pads": pads}


def _printed(width: int, verbose: bool = False, **values: Any) -> str:
    file = StringIO()
    status.print_status(_answer(**values), Console(file=file, width=width), verbose)
    assert max(map(len, file.getvalue().splitlines())) <= width
    return file.getvalue()


@pytest.mark.parametrize("width", WIDTHS)
def test_status_begins_with_a_verdict_and_fits_the_terminal(width: int) -> None:
    lines = _printed(width, state="clear", reason="").splitlines()
    assert lines[0] == "8 of 8 pads ok, 200 Hz, can0 43 %"
    assert len(lines) == 2 + len(LINKS)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("verbose", [False, True])
def test_status_cuts_neither_headings_nor_names(width: int, verbose: bool) -> None:
    reason = "heartbeat timeout after 352 ms; check the node's supply and its cable, then power it up again"
    text = _printed(width, verbose, state="lost", reason=reason)
    assert text.startswith("0 of 8 pads ok (8 lost), 200 Hz, can0 43 %")
    assert "…" not in text
    assert all(f"right/{link}" in text for link in LINKS)
    assert " ".join(text.split()).count(reason) == 1
    if verbose:
        assert all(word in text for word in ("serial", "missed", "reboots"))
        assert all(str(4_000_000_000 + row) in text for row in range(len(LINKS)))


def test_status_fits_a_terminal_while_all_pads_have_one_reason() -> None:
    answer = _answer(reason="no sample for 84 ms, as from every pad of bus can0; check the host's load")
    for row, pad in enumerate(answer["pads"][:-1]):
        pad["reason"] = pad["reason"].replace("84", str(50 + row))
    answer["pads"][-1]["reason"] = "another one"
    answer["service"] |= {"rate_hz": 17.0, "overruns": 500}
    answer["service"]["loop"]["late"] = {"tick": 2, "wake_up_delay": 498}
    file = StringIO()
    status.print_status(answer, Console(file=file, width=80))
    lines = file.getvalue().splitlines()
    assert lines[0] == "8 of 8 pads ok, 17 of 200 Hz, can0 43 %"
    assert "wake_up_delay" in lines[1]
    assert len(lines) <= 6 + len(LINKS)
    assert sum("as above" in line for line in lines) == len(LINKS) - 1
    assert "another one" in lines[-1]


@pytest.mark.parametrize("width", WIDTHS)
def test_scan_cuts_neither_headings_nor_identities(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    node = NodeFacts(
        17, state="pre-operational", vendor_id=0x12345678, product_code=0x9ABCDEF0, revision=0x10002,
        serial=4_000_000_000, name="a touch sensor of ours",
    )  # fmt: skip
    (bus,) = buses_to_scan(None, ["can0=virtual:tables"])
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    text = scan.to_text([BusReport(bus, nodes=[node], durations_s={"listen": 1.0})], [], None, ok=True)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    assert "…" not in plain
    assert all(word in plain for word in ("0x12345678", "0x9ABCDEF0", "0x10002", "4000000000"))
    assert max(map(len, plain.splitlines())) <= width


def test_a_row_that_does_not_fit_becomes_a_paragraph() -> None:
    table = make_table("link", "id", "reason", right=("id",), wrapped=("reason",))
    table.add_row("right/thumb", "17", "no answer")
    table.add_row("right/index", "18", "")
    file = StringIO()
    print_table(Console(file=file, width=30), table)
    assert re.sub(r" +\n", "\n", file.getvalue()) == (
        "right/thumb\n  id 17, reason no answer\nright/index\n  id 18\n"
    )
