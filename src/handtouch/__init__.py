"""handtouch: middleware that gives a robot hand a sense of touch.

`connect` subscribes to a running daemon, `columns` reads its hand frames as arrays, `request` asks it
something; they load on first use, so that `import handtouch.field` stays light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handtouch.client import (
        Subscriber,
        columns,
        connect,
        request,
    )
    from handtouch.client.robot import Robot

__version__ = "0.1.0"
__all__ = ["Robot", "Subscriber", "__version__", "columns", "connect", "request"]


def __getattr__(name: str) -> Any:
    if name in ("Subscriber", "columns", "connect", "request"):
        from handtouch import client

        return getattr(client, name)
    if name == "Robot":
        from handtouch.client.robot import Robot

        return Robot
    raise AttributeError(f"module 'handtouch' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
