"""Kinds of sources: handtouch's own, and those of other packages.

Public name: `source_kinds`. A package adds a kind by an entry point of the group `handtouch.sources`, whose
value is a subclass of `Source` (docs/node.md).
"""

from __future__ import annotations

from handtouch.host.plugins import load_plugins
from handtouch.node.dbc import DbcSource
from handtouch.node.lines import LinesSource
from handtouch.node.source import Source


def source_kinds() -> dict[str, type[Source]]:
    """Return the kinds of sources by name: handtouch's own, and those of entry points.

    Raises PluginError for an entry point that is no subclass of `Source`, naming its package.
    """
    return {"lines": LinesSource, "dbc": DbcSource, **load_plugins("handtouch.sources", Source)}
