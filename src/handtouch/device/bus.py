"""Simulated nodes on one python-can bus, served by the caller or by a thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from handtouch.canbus import cia301
from handtouch.config import shipped
from handtouch.config.base import MAX_CHANNELS
from handtouch.device.inputs import CHANNELS
from handtouch.device.lss import StoreId
from handtouch.device.node import NMT_COMMANDS, RESETS, Device
from handtouch.device.object_values import Address
from handtouch.device.pdo import DeviceTpdo
from handtouch.device.scheduler import ScheduledJob, Scheduler
from handtouch.device.spec import ANALOGUE_INPUTS, DeviceSpec
from handtouch.device.unconfigured import UnconfiguredDevice

Sampler = Callable[[int], NDArray[np.signedinteger[Any]]]
"""Host's monotonic time [ns] -> counts (n, c) in each node's own scale: one row per node in the order of
their addition, one column per electrode of the node that has most, int64 or narrower. Values beyond the type
of a node's object are clipped.
"""

_COUNT_BYTES, _SAMPLE_BYTES = 2, 2 * CHANNELS  # bytes of the standard layout: int16
_MIN_INT16, _MAX_INT16 = np.int64(-32768), np.int64(32767)
_MAX_WAIT_S = 0.1  # so that `stop` is prompt
_MAX_DISCARDED_FRAMES = 100_000  # so that constant traffic doesn't delay the start
_MAX_WAITING_SYNCS = 8  # of a short pause, which are answered late; more are a backlog
_MAX_FRAMES_AT_ONCE = 1000
_RETRY_S = 0.1  # between attempts on a failing bus

_log = logging.getLogger(__name__)


class DeviceBus:
    """Simulated nodes on one python-can bus, which the caller opens and shuts down.

    `sample` is called once for all nodes at every SYNC, and every `sample_period_ns` while an operational
    node has an event-driven TPDO. Counters: `rejected` malformed frames, `send_failures` frames that the bus
    refused, `bus_errors` failed reads, `sync_count` SYNCs handled, `skipped_syncs` SYNCs left unanswered
    because newer ones were waiting, `sample_count` samples taken.
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
        self.rejected = self.send_failures = self.bus_errors = 0
        self.sync_count = self.skipped_syncs = self.sample_count = 0
        self._bus = bus
        self._sample = sample
        self._sample_period_ns = sample_period_ns
        self._clock = clock
        self._now_ns = clock()
        self._all_devices: list[Device] = []  # including twins
        self._unconfigured: list[UnconfiguredDevice] = []
        self._rows = 0
        self._scheduler = Scheduler()
        self._next_sample_ns = 0  # next sample of event-driven nodes
        self._counts: NDArray[np.signedinteger[Any]] = np.zeros((0, CHANNELS), np.int64)
        self._count_lists: list[list[int]] | None = None  # the same, made on demand
        self._changed = True
        # messages of four int16 at every SYNC, and their offsets in the sample's bytes
        self._standard_tpdos: list[tuple[can.Message, int]] = []
        self._sync_tpdos: list[tuple[Device, DeviceTpdo]] = []
        self._event_tpdos: list[tuple[Device, DeviceTpdo]] = []
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def add(
        self,
        node_id: int,
        *,
        eds: Path | str | None = None,
        kind: tuple[int | None, int | None] = (None, None),
        serial: int | None = None,
        channels: tuple[Address, ...] = ANALOGUE_INPUTS,
        counts_per_unit: tuple[float | None, ...] | None = None,
        excitation: Address | None = None,
        strict_pdo: bool = False,
    ) -> Device:
        """Add a node on the next row of `sample`; it is silent until `Device.plug` or `start`.

        `eds` : by default the one shipped with handtouch, for 4 or 32 channels
        `kind` (vendor id, product code), `serial` : by default those of the EDS
        `channels` : the objects (index, sub-index) of the channels
        `counts_per_unit` : channels that are REAL32 carry the count divided by this, by default by 1
        `excitation` : the object that switches the sheet's excitation, by default 0x2100 if it has that name
        in the EDS
        `strict_pdo` : the node refuses to change a PDO's transmission type, timers or identifier while the
        PDO is valid

        Raises ValueError for a node id out of range or in use, and for an EDS that can't be read or lacks
        required objects.
        """
        if not 1 <= node_id <= 127 or node_id in self.devices:
            raise ValueError(f"node_id must be 1 to 127 and used once, got {node_id}")
        vendor_id, product_code = kind
        spec = DeviceSpec(
            _eds_path(eds, len(channels)),
            vendor_id=vendor_id,
            product_code=product_code,
            serial=serial,
            channels=channels,
            counts_per_unit=counts_per_unit or (None,) * len(channels),
            excitation=excitation,
            strict_pdo=strict_pdo,
        )
        device = Device(self, self._rows, node_id, spec)
        self._rows += 1
        self.join(device)
        return device

    def add_twin(self, node_id: int, *, serial: int) -> Device:
        """Add a second node with the id, the kind and the row of `sample` of an existing one.

        Raises KeyError for an id that no node has.
        """
        first = self.devices[node_id]
        twin = Device(self, first.row, node_id, replace(first.spec, serial=serial))
        self.join(twin)
        return twin

    def add_unconfigured(
        self,
        *,
        eds: Path | str | None = None,
        kind: tuple[int | None, int | None] = (None, None),
        serial: int | None = None,
        channels: tuple[Address, ...] = ANALOGUE_INPUTS,
        lss_compares: bool = True,
    ) -> UnconfiguredDevice:
        """Add a node without an id, which boots when LSS has assigned one; parameters as in `add`.

        `lss_compares` : as `LssSlave.compares`
        """
        spec = DeviceSpec(_eds_path(eds), *kind, serial, channels)
        return self._append_lss_device(UnconfiguredDevice(self, self._rows, spec, lss_compares=lss_compares))

    def add_stored(
        self,
        serial: int,
        node_id: int | None,
        store: StoreId,
        channels: int = CHANNELS,
        *,
        is_packed: bool = False,
    ) -> UnconfiguredDevice:
        """Add a node of a shipped EDS with a stored id, None for none, whose inputs the sampler measures.

        `is_packed` : its channels have 12 bits, up to five in one TPDO; `store` is called for an id that LSS
        has stored. Raises ValueError for an id in use.
        """
        if node_id in (device.lss.stored_id for device in self._unconfigured if node_id is not None):
            raise ValueError(f"node_id must be used once, got {node_id}")
        addresses = tuple((cia301.ANALOGUE_INPUTS, sub + 1) for sub in range(channels))
        spec = DeviceSpec(
            _eds_path(shipped.path("handtouch-node-12bit.eds") if is_packed else None, channels),
            None,
            None,
            serial,
            addresses,
            counts_per_unit=(None,) * channels,
            simulates_excitation=False,
        )
        return self._append_lss_device(
            UnconfiguredDevice(self, self._rows, spec, node_id=node_id, store=store)
        )

    def _append_lss_device(self, device: UnconfiguredDevice) -> UnconfiguredDevice:
        self._rows += 1
        with self.lock:
            self._unconfigured.append(device)
        return device

    def handle_frame(self, frame: can.Message, now_ns: int) -> None:
        """Handle a frame received at `now_ns`; frames that aren't for a node are ignored."""
        identifier = frame.arbitration_id
        if frame.is_extended_id or frame.is_error_frame:
            return
        with self.lock:
            self._now_ns = now_ns
            if frame.is_remote_frame:
                for device in self._devices_with_id(identifier - cia301.NMT_ERROR_CONTROL):
                    device.handle_guard_request(now_ns)
            elif identifier == cia301.SYNC:
                self._handle_sync(now_ns, frame.data[0] if frame.dlc else None)
            elif identifier == cia301.NMT:
                self._handle_nmt(bytes(frame.data))
            elif identifier == cia301.LSS_REQUEST:
                self._handle_lss(bytes(frame.data))
            elif devices := self._devices_with_id(identifier - cia301.SDO_REQUEST):
                if len(frame.data) != 8:
                    self.rejected += 1
                    return
                for device in devices:
                    device.handle_sdo(bytes(frame.data))

    def advance(self, now_ns: int) -> int | None:
        """Run what is due at `now_ns`; return the next due time, None if there is none."""
        with self.lock:
            self._now_ns = now_ns
            next_ns = self._scheduler.next_ns
            if next_ns is not None and next_ns <= now_ns:
                self._scheduler.run_due(now_ns)
                next_ns = self._scheduler.next_ns
            if self._changed:
                self._group_tpdos()
            if not self._event_tpdos:
                return next_ns
            if self._next_sample_ns <= now_ns:
                self._take_sample(now_ns)
                self._send_event_tpdos(now_ns)
            return self._next_sample_ns if next_ns is None else min(next_ns, self._next_sample_ns)

    def poll(self, timeout_s: float = 0.0) -> None:
        """Wait up to `timeout_s` for a frame or due time, then handle the frames received until now.

        Of more SYNCs than `_MAX_WAITING_SYNCS` the oldest aren't answered, so that nodes whose samples take
        longer than a period answer everything else in time; `skipped_syncs` counts them.
        """
        now_ns = self._clock()
        due_ns = self.advance(now_ns)
        if due_ns is not None:
            timeout_s = min(timeout_s, max(0.0, (due_ns - now_ns) * 1e-9))
        first = self._bus.recv(timeout_s)
        self.advance(self._clock())
        if first is None:
            return
        others = islice(iter(partial(self._bus.recv, 0.0), None), _MAX_FRAMES_AT_ONCE)
        for frame in self._without_stale_syncs([first, *others]):
            now_ns = self._clock()
            self.handle_frame(frame, now_ns)
            self.advance(now_ns)  # a flood of frames must not delay heartbeats

    def _without_stale_syncs(self, frames: list[can.Message]) -> list[can.Message]:
        syncs = [k for k, frame in enumerate(frames) if frame.arbitration_id == cia301.SYNC]
        stale = set(syncs[:-_MAX_WAITING_SYNCS])
        if not stale:
            return frames
        if not self.skipped_syncs:
            _log.warning("nodes don't keep up with SYNC: %d not answered; lower its rate", len(stale))
        self.skipped_syncs += len(stale)
        return [frame for k, frame in enumerate(frames) if k not in stale]

    def start(self) -> None:
        """Plug in every node and serve them from a thread; frames received before are dropped."""
        if self._thread is not None:
            raise RuntimeError("the nodes are already served")
        self._discard_received()
        self.advance(self._clock())
        for device in self._all_devices:
            device.plug()
        for unconfigured in self._unconfigured:
            unconfigured.plug()
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name="canopen-nodes", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the nodes keep their states. No effect if it isn't running."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    # Called by `Device`, under the lock.

    @property
    def now_ns(self) -> int:
        """Time of the latest `handle_frame` or `advance`, or of the clock if that is later."""
        return max(self._now_ns, self._clock())

    def schedule(self, due_ns: int, job: ScheduledJob) -> None:
        """Run a job at `due_ns`."""
        self._scheduler.schedule(due_ns, job)

    def mark_changed(self) -> None:
        """Regroup the TPDOs before the next use, since a node's TPDOs may have changed."""
        self._changed = True

    def electrode_counts(self, row: int) -> list[int]:
        """Return the counts of a row at the latest sample, 0 before the first."""
        if self._count_lists is None:
            self._count_lists = self._counts.tolist()
        return self._count_lists[row] if row < len(self._count_lists) else [0] * MAX_CHANNELS

    def transmit(self, message: can.Message) -> None:
        """Send a frame; if the bus refuses it, the frame is lost and counted, as on a real node."""
        try:
            self._bus.send(message)
        except (can.CanError, OSError):
            self.send_failures += 1

    def join(self, device: Device) -> None:
        """Connect a node to the bus."""
        with self.lock:
            self._all_devices.append(device)
            self.devices.setdefault(device.node_id, device)

    def leave(self, device: Device) -> None:
        """Disconnect a node from the bus."""
        self._all_devices.remove(device)
        others = self._devices_with_id(device.node_id)
        if self.devices[device.node_id] is device:
            del self.devices[device.node_id]
            self.devices |= {other.node_id: other for other in others}
        self.mark_changed()

    def _devices_with_id(self, node_id: int) -> list[Device]:
        """Return the nodes with an id: one, or two with a twin."""
        if node_id not in self.devices:
            return []
        return [device for device in self._all_devices if device.node_id == node_id]

    def _discard_received(self) -> None:
        """Discard the frames received while the nodes had no power."""
        try:
            for _ in range(_MAX_DISCARDED_FRAMES):
                if self._bus.recv(0.0) is None:
                    break
        except (can.CanError, OSError):
            self.bus_errors += 1

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                self.poll(_MAX_WAIT_S)
            except (can.CanError, OSError) as error:
                self.bus_errors += 1
                level = logging.WARNING if self.bus_errors == 1 else logging.DEBUG
                _log.log(level, "simulated nodes: bus read failed: %s; retrying", error)
                self._stop.wait(_RETRY_S)

    def _group_tpdos(self) -> None:
        """Group the TPDOs sent at present, so that one of standard layout costs only a copy per SYNC."""
        self._changed = False
        self._standard_tpdos, self._sync_tpdos, self._event_tpdos = [], [], []
        for device in self._all_devices:
            for tpdo in device.active_tpdos:
                if tpdo.is_event_driven:
                    self._event_tpdos.append((device, tpdo))
                elif (
                    tpdo.is_sync_driven
                    and tpdo.has_standard_layout
                    and tpdo.period_syncs == 1
                    and device.sends_sampled_counts
                ):
                    start = _COUNT_BYTES * self._counts.shape[1] * device.row
                    self._standard_tpdos.append((tpdo.message, start))
                elif tpdo.is_sync_driven:
                    self._sync_tpdos.append((device, tpdo))
            if not device.inputs_settled:
                self._changed = True

    def _take_sample(self, now_ns: int) -> None:
        self._counts, self._count_lists = self._sample(now_ns), None
        self.sample_count += 1
        self._next_sample_ns = now_ns + self._sample_period_ns

    def _handle_sync(self, now_ns: int, counter: int | None) -> None:
        self.sync_count += 1
        self._take_sample(now_ns)
        if self._changed:
            self._group_tpdos()
        if self._standard_tpdos:
            self._send_standard_tpdos()
        for device, tpdo in self._sync_tpdos:
            message = tpdo.make_sync_message(now_ns, counter)
            if message is not None:
                device.transmit(message, is_data=True)
        if self._event_tpdos:
            self._send_event_tpdos(now_ns)

    def _send_standard_tpdos(self) -> None:
        counts: NDArray[Any] = self._counts
        if counts.dtype != np.int16:
            counts = np.minimum(np.maximum(counts, _MIN_INT16), _MAX_INT16)
        samples = bytearray(counts.astype("<i2", copy=False).tobytes())
        for message, start in self._standard_tpdos:
            message.data = samples[start : start + _SAMPLE_BYTES]
            self.transmit(message)

    def _send_event_tpdos(self, now_ns: int) -> None:
        for device, tpdo in self._event_tpdos:
            message = tpdo.make_event_message(now_ns)
            if message is not None:
                device.transmit(message, is_data=True)

    def _handle_nmt(self, data: bytes) -> None:
        if len(data) != 2 or data[0] not in NMT_COMMANDS:
            self.rejected += 1
            return
        command, node_id = data
        addressed = self._devices_with_id(node_id) if node_id else list(self._all_devices)
        if command in RESETS:
            for unconfigured in self._unconfigured:  # one may boot with a changed id
                unconfigured.handle_reset(node_id)
        for device in addressed:
            device.handle_nmt(command)

    def _handle_lss(self, data: bytes) -> None:
        for unconfigured in self._unconfigured:
            response = unconfigured.handle_lss(data)
            if response is not None:
                identifier = cia301.LSS_RESPONSE
                self.transmit(can.Message(arbitration_id=identifier, data=response, is_extended_id=False))


def _eds_path(eds: Path | str | None, channels: int = CHANNELS) -> str:
    name = "handtouch-node.eds" if channels <= CHANNELS else "handtouch-node-32.eds"
    return str(eds or shipped.path(name))
