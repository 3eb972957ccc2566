"""handtouch: middleware that gives a robot hand a sense of touch.

`Hand` is the newest state of a hand, for control loops. `connect` receives every message of a daemon,
`columns` reads its hand frames as arrays. `DaemonControl` has the daemon's commands as methods, `request`
sends any of them; `Robot` sends joint states. All load on first use, so that `import handtouch.field` stays
light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handtouch.client import Subscriber, UnknownNameError, columns, connect, request
    from handtouch.client.control import DaemonControl
    from handtouch.client.hand import Hand
    from handtouch.client.link_column import NotSampledError
    from handtouch.client.robot import Robot

__version__ = "0.1.0"
_MODULES = {
    "DaemonControl": "handtouch.client.control",
    "Hand": "handtouch.client.hand",
    "NotSampledError": "handtouch.client.link_column",
    "Robot": "handtouch.client.robot",
    "Subscriber": "handtouch.client",
    "UnknownNameError": "handtouch.client",
    "columns": "handtouch.client",
    "connect": "handtouch.client",
    "request": "handtouch.client",
}
__all__ = [
    "DaemonControl",
    "Hand",
    "NotSampledError",
    "Robot",
    "Subscriber",
    "UnknownNameError",
    "__version__",
    "columns",
    "connect",
    "request",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'handtouch' has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
