"""Objects that other packages add by entry points (docs/extend.md).

Public names: `load_plugins`, `PluginError`.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any


class PluginError(TypeError):
    """An entry point isn't what its group asks for; the text names its package."""


def load_plugins(group: str, base: type[Any] | None = None) -> dict[str, Any]:
    """Return the objects of the entry points of a group by name; the group's modules are imported.

    Raises PluginError for one that is no subclass of `base`, or that can't be called.
    """
    found: dict[str, Any] = {}
    for point in entry_points(group=group):
        value = point.load()
        package = point.dist.name if point.dist else "an unknown package"
        if base is not None and not (isinstance(value, type) and issubclass(value, base)):
            raise PluginError(
                f"entry point {point.name} of {package}: {value!r} is no subclass of {base.__name__}"
            )
        if not callable(value):
            raise PluginError(f"entry point {point.name} of {package}: {value!r} can't be called")
        found[point.name] = value
    return found
