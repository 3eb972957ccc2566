"""handtouch: middleware that gives a robot hand a sense of touch.

`connect` subscribes to a running daemon, `request` asks it something; both load on first use, so that
`import handtouch.field` stays light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handtouch.client import Subscriber, connect, request

__version__ = "0.1.0"
__all__ = ["Subscriber", "__version__", "connect", "request"]


def __getattr__(name: str) -> Any:
    if name in ("connect", "request", "Subscriber"):
        from handtouch import client

        return getattr(client, name)
    raise AttributeError(f"module 'handtouch' has no attribute {name!r}")
