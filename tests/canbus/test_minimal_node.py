"""A node with the objects of docs/canopen.md, "Build a node", and no others is sufficient."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from handtouch.canbus.nodes.lifecycle_types import NodeState

DOCS = Path(__file__).parents[2] / "docs" / "canopen.md"
TYPES = {"u8": 5, "u16": 6, "u32": 7, "i16": 3}


def rows() -> Iterator[tuple[int, range, list[str], str, list[str]]]:
    """Yield index, sub-indices, types, access and defaults of the table's rows."""
    section = DOCS.read_text(encoding="utf-8").split("\n## Build a node\n")[1].split("\n## ")[0]
    for line in section.splitlines():
        row = re.match(r"\| 0x(\w{4}):00(?: to :(\d\d))?[^|]* \| ([^|]*) \| (\w+)[^|]* \| ([^|]*) \|", line)
        if row and "excitation" not in line:
            index, last, kinds, access, values = row.groups()
            subs = range(int(last or 0) + 1)
            yield int(index, 16), subs, kinds.split(", "), access, re.split(r", | or ", values)


def minimal_eds() -> str:
    """Return the EDS of a node with the table's objects."""
    text = ""
    for index, subs, kinds, access, values in rows():
        if len(subs) > 1:
            text += f"[{index:04X}]\nParameterName=x\nObjectType=9\n"
        for sub in subs:
            section = f"{index:04X}sub{sub}" if len(subs) > 1 else f"{index:04X}"
            value = values[min(sub, len(values) - 1)]
            default = "+".join("$NODEID" if term == "id" else term for term in value.split(" + "))
            if not re.fullmatch(r"(0x)?[0-9A-F]+(\+\$NODEID)?", default):
                default = "0"
            kind = TYPES[kinds[min(sub, len(kinds) - 1)]]
            text += f"[{section}]\nParameterName=x\nObjectType=7\nDataType={kind}\nAccessType={access}\n"
            text += f"DefaultValue={default}\nPDOMapping={int(index == 0x6401)}\n"
    return text


def test_a_node_with_the_documented_objects_boots_and_its_counts_arrive(
    make_rig: Callable[..., Any], tmp_path: Path
) -> None:
    assert [row[0] for row in rows()] == [0x1000, 0x1001, 0x1014, 0x1017, 0x1018, 0x1801, 0x1A01, 0x6401]
    eds = tmp_path / "minimal.eds"
    eds.write_text(minimal_eds())
    rig = make_rig(2, device={"eds": str(eds)}, eds=str(eds))
    rig.counts[:] = (-32768, 32767, -1, 2)
    rig.boot()
    rig.run(10)
    assert [rig.state(n) for n in (1, 2)] == [NodeState.OPERATIONAL] * 2
    assert rig.slab.unpack_counts().tolist() == [[-32768, 32767, -1, 2]] * 2
    assert rig.node(1).read_object(0x1801, 2) == 1
    assert rig.node(1).read_object(0x1017, 0) == 100
