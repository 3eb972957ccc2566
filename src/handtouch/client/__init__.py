"""Client side: subscribe to a running daemon, send it requests and robot states, and manage keys."""

from handtouch.client.names import UnknownNameError
from handtouch.client.subscriber import (
    SERVICE_TIMEOUT_S,
    Subscriber,
    columns,
    connect,
    request,
)
from handtouch.host.endpoints import CONTROL_ENDPOINT, LIVE_ENDPOINT

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
