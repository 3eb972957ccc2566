"""The EDS of a node with the objects of docs/firmware.md, and no others."""

from __future__ import annotations

import re

from handtouch.procedures.conformance import REQUIRED_OBJECTS

_TYPES = {"u8": 5, "u16": 6, "u32": 7, "i16": 3}
_MAPPABLE = 0x6401


def minimal_eds() -> str:
    """Return the text of the EDS, without the optional objects."""
    text = ""
    for row in REQUIRED_OBJECTS:
        if row.optional:
            continue
        if row.last_sub:
            text += f"[{row.index:04X}]\nParameterName=x\nObjectType=9\n"
        for sub in range(row.last_sub + 1):
            section = f"{row.index:04X}sub{sub}" if row.last_sub else f"{row.index:04X}"
            value = row.defaults[min(sub, len(row.defaults) - 1)].split(" or ")[-1]
            default = "+".join("$NODEID" if term == "id" else term for term in value.split(" + "))
            if not re.fullmatch(r"(0x)?[0-9A-F]+(\+\$NODEID)?", default):
                default = "0"
            kind = _TYPES[row.types[min(sub, len(row.types) - 1)]]
            access = row.access.split(" or ")[-1]
            if sub == 0 and row.last_sub:
                access = "const"
            text += f"[{section}]\nParameterName=x\nObjectType=7\nDataType={kind}\nAccessType={access}\n"
            text += f"DefaultValue={default}\nPDOMapping={int(row.index == _MAPPABLE)}\n"
    return text
