"""Kinds of sources: handtouch's own, and those of other packages.

Public name: `source_kinds`. A package adds a kind by an entry point of the group `handtouch.sources`, whose
value is a subclass of `Source` (docs/node.md).
"""

from __future__ import annotations

from importlib.metadata import entry_points

from handtouch.node.dbc import DbcSource
from handtouch.node.lines import LinesSource
from handtouch.node.source import Source

_ENTRY_POINTS = "handtouch.sources"


def source_kinds() -> dict[str, type[Source]]:
    """Return the kinds of sources by name: handtouch's own, and those of entry points.

    Raises TypeError for an entry point that is no subclass of `Source`, naming its package.
    """
    kinds: dict[str, type[Source]] = {"lines": LinesSource, "dbc": DbcSource}
    for found in entry_points(group=_ENTRY_POINTS):
        kind = found.load()
        if not (isinstance(kind, type) and issubclass(kind, Source)):
            package = found.dist.name if found.dist else "an unknown package"
            raise TypeError(f"entry point {found.name} of {package}: {kind!r} is no subclass of Source")
        kinds[found.name] = kind
    return kinds
