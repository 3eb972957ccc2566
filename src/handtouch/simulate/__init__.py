"""A hand that is not there: physics of its own, scenarios with ground truth, nodes on a bus.

`TactileSensor` is such a hand inside a MuJoCo simulation, `TactileNodes` its nodes for the real daemon; both
load on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handtouch.simulate.tactile.nodes import TactileNodes
    from handtouch.simulate.tactile.reading import TactileReading
    from handtouch.simulate.tactile.sensor import TactileSensor

__all__ = ["TactileNodes", "TactileReading", "TactileSensor"]
_MODULES = {"TactileNodes": "nodes", "TactileReading": "reading", "TactileSensor": "sensor"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'handtouch.simulate' has no attribute {name!r}")
    return getattr(import_module(f"handtouch.simulate.tactile.{_MODULES[name]}"), name)
