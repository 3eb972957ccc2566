"""A hand that is not there: physics of its own, scenarios with ground truth, nodes on a bus.

`TactileSensor` is such a hand inside a MuJoCo simulation; it loads on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handtouch.simulate.tactile.reading import TactileReading
    from handtouch.simulate.tactile.sensor import TactileSensor

__all__ = ["TactileReading", "TactileSensor"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'handtouch.simulate' has no attribute {name!r}")
    from handtouch.simulate.tactile import sensor

    return getattr(sensor, name)
