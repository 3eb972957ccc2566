"""Client side: subscribe to a running daemon, send it requests and robot states, and manage keys."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT

if TYPE_CHECKING:
    from handtouch.client.names import UnknownNameError
    from handtouch.client.subscriber import SERVICE_TIMEOUT_S, Subscriber, columns, connect, request

__all__ = [
    "CONTROL_ENDPOINT",
    "LIVE_ENDPOINT",
    "SERVICE_TIMEOUT_S",
    "Subscriber",
    "UnknownNameError",
    "columns",
    "connect",
    "request",
]


def __getattr__(name: str) -> Any:
    """Load what subscribes when it is used: the daemon needs the keys only."""
    if name not in __all__:
        raise AttributeError(f"module 'handtouch.client' has no attribute {name!r}")
    module = "names" if name == "UnknownNameError" else "subscriber"
    return getattr(import_module(f"handtouch.client.{module}"), name)
