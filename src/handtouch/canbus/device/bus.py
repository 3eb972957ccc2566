"""Many simulated nodes on one python-can bus, served by whoever calls or by a thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from handtouch import shipped
from handtouch.canbus.find import lss

from .agenda import Agenda, Job
from .inputs import CHANNELS
from .node import NMT_COMMANDS, RESETS, Device
from .objects import Address
from .pdo import Tpdo
from .unit import ANALOGUE_INPUTS, Unit
from .unnamed import Unnamed

Sampler = Callable[[int], NDArray[np.signedinteger[Any]]]
"""Host's monotonic time [ns] -> counts (n, 4) in each node's own scale, one row a node in the order they were
added, one column an electrode; int64 or narrower. What is beyond the type of a node's object is clipped."""

_NMT_ID, _SYNC_ID, _SDO_ID, _NMT_ERROR_ID = 0x000, 0x080, 0x600, 0x700
_SAMPLE_BYTES = 2 * CHANNELS  # of the usual node: int16
_LOW, _HIGH = np.int64(-32768), np.int64(32767)
_LONGEST_WAIT_S = 0.1  # so that `stop` is prompt whatever the heartbeats
_MOST_WAITING = 100_000  # frames; a bus that never falls silent doesn't hold the start up
_BACK_OFF_S = 0.1  # between attempts on a bus that fails

_log = logging.getLogger(__name__)


class DeviceBus:
    """Simulated nodes on one python-can bus, which the caller opens and shuts down.

    `sample` is asked once for all nodes at every SYNC, and every `sample_period_ns` while an operational node
    has an event-driven TPDO. `rejected` counts malformed frames, `send_failures` frames that the bus did not
    take, `bus_errors` failed reads, `syncs` the SYNCs answered, `number` the samples taken.
    """

    def __init__(
        self,
        bus: can.BusABC,
        sample: Sampler,
        clock: Callable[[], int] = time.monotonic_ns,
        sample_period_ns: int = 1_000_000,
    ) -> None:
        self.devices: dict[int, Device] = {}
        self.lock = threading.RLock()
        self.rejected = self.send_failures = self.bus_errors = self.syncs = self.number = 0
        self._bus = bus
        self._sample = sample
        self._sample_period_ns = sample_period_ns
        self._clock = clock
        self._now_ns = clock()
        self._everyone: list[Device] = []  # twins too
        self._unnamed: list[Unnamed] = []
        self._rows = 0
        self._agenda = Agenda()
        self._look_ns = 0  # when event-driven nodes sample next
        self._counts: NDArray[np.signedinteger[Any]] = np.zeros((0, CHANNELS), np.int64)
        self._listed: list[list[int]] | None = None  # the same, once somebody asks
        self._changed = True
        self._usual: list[tuple[can.Message, int]] = []  # four int16 at every SYNC, and where these begin
        self._on_sync: list[tuple[Device, Tpdo]] = []
        self._on_event: list[tuple[Device, Tpdo]] = []
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def add(
        self,
        node_id: int,
        *,
        eds: Path | str | None = None,
        vendor_id: int | None = None,
        product_code: int | None = None,
        serial: int | None = None,
        channels: tuple[Address, ...] = ANALOGUE_INPUTS,
        excitation: Address | None = None,
        strict_pdo: bool = False,
    ) -> Device:
        """A new node, its row of `sample` the next one; it is silent until `Device.plug` or `start`.

        The EDS is the shipped one unless another is given, the identity that of the EDS. `channels` are the
        objects (index, sub-index) that carry the four channels, `excitation` the one that switches the supply
        of the sheet, by default 0x2100 where the EDS calls that so. A `strict_pdo` node refuses to change a
        PDO's transmission type, timers or identifier while the PDO is valid.

        Raises ValueError for a node id out of range or taken, and for an EDS that can't be read or without
        the objects of such a node.
        """
        if not 1 <= node_id <= 127 or node_id in self.devices:
            raise ValueError(f"node_id must be 1 to 127 and used once, got {node_id}")
        unit = Unit(_path(eds), vendor_id, product_code, serial, channels, excitation, strict_pdo)
        device = Device(self, self._rows, node_id, unit)
        self._rows += 1
        self.join(device)
        return device

    def add_twin(self, node_id: int, *, serial: int) -> Device:
        """A second node with the id of one that is there, of the same kind and on the same row of `sample`.

        Raises KeyError for an id that no node has.
        """
        first = self.devices[node_id]
        twin = Device(self, first.row, node_id, replace(first.unit, serial=serial))
        self.join(twin)
        return twin

    def add_unconfigured(
        self,
        *,
        eds: Path | str | None = None,
        vendor_id: int | None = None,
        product_code: int | None = None,
        serial: int | None = None,
        channels: tuple[Address, ...] = ANALOGUE_INPUTS,
    ) -> Unnamed:
        """A node without an id, which boots as soon as LSS has given it one; otherwise as `add`."""
        unnamed = Unnamed(self, self._rows, Unit(_path(eds), vendor_id, product_code, serial, channels))
        self._rows += 1
        with self.lock:
            self._unnamed.append(unnamed)
        return unnamed

    def handle(self, frame: can.Message, t_ns: int) -> None:
        """Take a frame that arrived at `t_ns`; others than a node's (our own too) are ignored."""
        identifier = frame.arbitration_id
        if frame.is_extended_id or frame.is_error_frame:
            return
        with self.lock:
            self._now_ns = t_ns
            if frame.is_remote_frame:
                for device in self._of(identifier - _NMT_ERROR_ID):
                    device.on_guard(t_ns)
            elif identifier == _SYNC_ID:
                self._answer_sync(t_ns)
            elif identifier == _NMT_ID:
                self._command(bytes(frame.data))
            elif identifier == lss.REQUEST_ID:
                self._answer_lss(bytes(frame.data))
            elif devices := self._of(identifier - _SDO_ID):
                if len(frame.data) != 8:
                    self.rejected += 1
                    return
                for device in devices:
                    device.on_sdo(bytes(frame.data))

    def advance(self, t_ns: int) -> int | None:
        """Do what is due at `t_ns`; returns the time of what is next, None if there is nothing."""
        with self.lock:
            self._now_ns = t_ns
            next_ns = self._agenda.next_ns
            if next_ns is not None and next_ns <= t_ns:
                self._agenda.run(t_ns)
                next_ns = self._agenda.next_ns
            if self._changed:
                self._plan()
            if not self._on_event:
                return next_ns
            if self._look_ns <= t_ns:
                self._measure(t_ns)
                self._offer_events(t_ns)
            return self._look_ns if next_ns is None else min(next_ns, self._look_ns)

    def poll(self, timeout_s: float = 0.0) -> None:
        """Wait up to `timeout_s` for a frame or heartbeat, then serve all that have come."""
        now_ns = self._clock()
        due_ns = self.advance(now_ns)
        if due_ns is not None:
            timeout_s = min(timeout_s, max(0.0, (due_ns - now_ns) * 1e-9))
        frame = self._bus.recv(timeout_s)
        self.advance(self._clock())
        while frame is not None:
            now_ns = self._clock()
            self.handle(frame, now_ns)
            self.advance(now_ns)  # a flood must not keep the heartbeats back
            frame = self._bus.recv(0.0)

    def start(self) -> None:
        """Plug in every node and serve them from a thread of its own; what waits already is dropped."""
        if self._thread is not None:
            raise RuntimeError("the nodes are already served")
        self._drop_waiting()
        self.advance(self._clock())
        for device in self._everyone:
            device.plug()
        for unnamed in self._unnamed:
            unnamed.plug()
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name="canopen-nodes", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the nodes fall silent where they are. Without effect if it isn't running."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    # What `Device` calls, under the lock.

    @property
    def now_ns(self) -> int:
        """The time: that of the latest `handle` or `advance`, or the clock's where that is later."""
        return max(self._now_ns, self._clock())

    def at(self, due_ns: int, job: Job) -> None:
        """Do something later."""
        self._agenda.at(due_ns, job)

    def changed(self) -> None:
        """What a node sends may have changed."""
        self._changed = True

    def electrodes(self, row: int) -> list[int]:
        """Counts of a row at the latest sample, 0 before the first."""
        if self._listed is None:
            self._listed = self._counts.tolist()
        return self._listed[row] if row < len(self._listed) else [0] * CHANNELS

    def transmit(self, message: can.Message) -> None:
        """Send; a bus that doesn't take it costs the frame and nothing else, as on a real node."""
        try:
            self._bus.send(message)
        except (can.CanError, OSError):
            self.send_failures += 1

    def join(self, device: Device) -> None:
        """A node is connected to the bus."""
        with self.lock:
            self._everyone.append(device)
            self.devices.setdefault(device.node_id, device)

    def leave(self, device: Device) -> None:
        """A node is taken off the bus."""
        self._everyone.remove(device)
        others = self._of(device.node_id)
        if self.devices[device.node_id] is device:
            del self.devices[device.node_id]
            self.devices |= {other.node_id: other for other in others}
        self.changed()

    def _of(self, node_id: int) -> list[Device]:
        """The nodes with an id: one, or two with a twin."""
        if node_id not in self.devices:
            return []
        return [device for device in self._everyone if device.node_id == node_id]

    def _drop_waiting(self) -> None:
        """A node without power hears nothing, so what came before it is plugged in gets no answer."""
        try:
            for _ in range(_MOST_WAITING):
                if self._bus.recv(0.0) is None:
                    break
        except (can.CanError, OSError):
            self.bus_errors += 1

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                self.poll(_LONGEST_WAIT_S)
            except (can.CanError, OSError) as error:
                self.bus_errors += 1
                _log.log(logging.WARNING if self.bus_errors == 1 else logging.DEBUG, "bus fails: %s", error)
                self._stop.wait(_BACK_OFF_S)

    def _plan(self) -> None:
        """Sort what the nodes send at present, so that the usual node costs a SYNC no more than a copy."""
        self._changed = False
        self._usual, self._on_sync, self._on_event = [], [], []
        for device in self._everyone:
            for tpdo in device.tpdos:
                if tpdo.on_event:
                    self._on_event.append((device, tpdo))
                elif tpdo.on_sync and tpdo.standard and tpdo.every == 1 and device.undisturbed:
                    self._usual.append((tpdo.message, _SAMPLE_BYTES * device.row))
                elif tpdo.on_sync:
                    self._on_sync.append((device, tpdo))
            if not device.settled:
                self._changed = True

    def _measure(self, t_ns: int) -> None:
        self._counts, self._listed = self._sample(t_ns), None
        self.number += 1
        self._look_ns = t_ns + self._sample_period_ns

    def _answer_sync(self, t_ns: int) -> None:
        self.syncs += 1
        self._measure(t_ns)
        if self._changed:
            self._plan()
        if self._usual:
            self._send_usual()
        for device, tpdo in self._on_sync:
            message = tpdo.sync(t_ns)
            if message is not None:
                device.transmit(message, is_data=True)
        if self._on_event:
            self._offer_events(t_ns)

    def _send_usual(self) -> None:
        counts: NDArray[Any] = self._counts
        if counts.dtype != np.int16:
            counts = np.minimum(np.maximum(counts, _LOW), _HIGH)
        samples = bytearray(counts.astype("<i2", copy=False).tobytes())
        for message, start in self._usual:
            message.data = samples[start : start + _SAMPLE_BYTES]
            self.transmit(message)

    def _offer_events(self, t_ns: int) -> None:
        for device, tpdo in self._on_event:
            message = tpdo.event(t_ns)
            if message is not None:
                device.transmit(message, is_data=True)

    def _command(self, data: bytes) -> None:
        if len(data) != 2 or data[0] not in NMT_COMMANDS:
            self.rejected += 1
            return
        command, node_id = data
        addressed = self._of(node_id) if node_id else list(self._everyone)
        if command in RESETS:
            for unnamed in self._unnamed:  # one may boot under another id now
                unnamed.on_reset(node_id)
        for device in addressed:
            device.on_nmt(command)

    def _answer_lss(self, data: bytes) -> None:
        for unnamed in self._unnamed:
            answer = unnamed.on_request(data)
            if answer is not None:
                self.transmit(can.Message(arbitration_id=lss.ANSWER_ID, data=answer, is_extended_id=False))


def _path(eds: Path | str | None) -> str:
    return str(eds or shipped.path("handtouch-node.eds"))
