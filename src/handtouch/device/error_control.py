"""NMT error control of a simulated node: producer heartbeat and node guarding (CiA 301)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from handtouch.canbus import cia301
from handtouch.device.object_values import ObjectValues
from handtouch.device.scheduler import DeviceHost, JobGroup

_GUARD_TIME, _LIFE_TIME_FACTOR = (cia301.GUARD_TIME, 0), (cia301.LIFE_TIME_FACTOR, 0)
HEARTBEAT_TIME = (cia301.HEARTBEAT_TIME, 0)
_MS = 1_000_000


class ErrorControl:
    """Heartbeats and guarding responses of one node, while they are scheduled or requested.

    `send` : sends its state with the toggle bit given
    `on_life_time_expired` : called when the guarding master has fallen silent
    """

    def __init__(
        self,
        bus: DeviceHost,
        objects: ObjectValues,
        send: Callable[[int], None],
        on_life_time_expired: Callable[[], None],
    ) -> None:
        self._bus, self._objects, self._send = bus, objects, send
        self._on_life_time_expired = on_life_time_expired
        self._toggle_bit = 0
        self._heartbeat, self._life_time = JobGroup(bus), JobGroup(bus)

    def stop(self) -> None:
        """Send no more heartbeats, and end the guarding."""
        self._toggle_bit = 0
        self._heartbeat.stop()
        self._life_time.stop()

    def start_heartbeat(self) -> None:
        """Send heartbeats with the period in 0x1017 from now on, none if it is 0."""
        self._heartbeat.stop()
        period_ns = self._objects.get_integer(*HEARTBEAT_TIME) * _MS
        if period_ns:
            self._heartbeat.schedule(self._bus.now_ns + period_ns, partial(self._emit_heartbeat, period_ns))

    def handle_guard_request(self, now_ns: int) -> None:
        """Respond to a guarding request with state and toggle bit, and restart the life time."""
        get = self._objects.get_integer
        if _GUARD_TIME not in self._objects or get(*HEARTBEAT_TIME):
            return
        self._send(self._toggle_bit)
        self._toggle_bit ^= 0x80
        life_ns = get(*_GUARD_TIME) * get(*_LIFE_TIME_FACTOR) * _MS
        self._life_time.stop()
        if life_ns:
            self._life_time.schedule(now_ns + life_ns, lambda *_: self._on_life_time_expired())

    def _emit_heartbeat(self, period_ns: int, due_ns: int, now_ns: int) -> int:
        self._send(0)
        return due_ns + period_ns * (1 + (now_ns - due_ns) // period_ns)
