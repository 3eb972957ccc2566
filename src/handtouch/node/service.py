"""Run of a sensor node: its CANopen nodes, ADCs and excitation in one loop, until it is stopped.

Public names: `NodeService`, `run`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

import can
import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus import cia301
from handtouch.canbus.bus.port import open_bus
from handtouch.canbus.bus.receivers import arrival_ns
from handtouch.device import DeviceBus, UnconfiguredDevice
from handtouch.host.realtime import apply_realtime_settings
from handtouch.host.systemd import ServiceWatchdog, SystemdNotifier
from handtouch.node.adc_fault import AdcError
from handtouch.node.excitation import make_switch
from handtouch.node.identity_store import IdentityStore
from handtouch.node.pad_input import PadInput
from handtouch.node.sampling import Sampling, make_inputs
from handtouch.node.settings import PACKED_BITS, NodeFile, NodePad

_MAINTENANCE_PERIOD_NS = 20_000_000
_REPORT_PERIOD_NS = 60_000_000_000
_MAX_WAIT_S = 0.02
_MAX_FRAMES = 1000  # handled at a time
_RETRY_S = 0.1  # between attempts on a failing bus

_log = logging.getLogger("handtouch.node")


class NodeService:
    """The nodes of one file on an open CAN bus, which the caller shuts down.

    `missed_syncs` : SYNCs not answered, since a newer one had arrived

    Raises OSError if a new serial number can't be stored, ValueError for a damaged state file or an id that
    two nodes have.
    """

    def __init__(self, file: NodeFile, bus: can.BusABC, clock: Callable[[], int] = time.monotonic_ns) -> None:
        settings = file.settings
        self._bus, self._clock = bus, clock
        self._store = IdentityStore(file.state)
        self._store.load()
        self.devices = DeviceBus(bus, self._sample, clock, round(settings.event_sample_ms * 1e6))
        self.nodes = [self._add_node(pad) for pad in settings.pads]
        self.sampling = Sampling(make_inputs(file, self.nodes, clock))
        self._pads = [pad for adc in self.sampling.adcs for pad in adc.pads]
        self._switches = {pad.pad.name: make_switch(pad.pad.excitation) for pad in self._pads}
        self._excited: dict[str, bool] = {}
        self._bus_failed = False
        self.missed_syncs = 0
        self._bus_file = _file_of(bus)
        _limit_to_node_frames(bus)

    def start(self) -> None:
        """Open the ADCs and power the nodes on."""
        now_ns = self._clock()
        self._maintain(now_ns, now_ns)
        for node in self.nodes:
            node.plug()
        self.devices.schedule(now_ns, self._maintain)

    def serve(self, stop: threading.Event, watchdog: ServiceWatchdog) -> None:
        """Handle frames and everything due until `stop` is set; a failing bus is retried."""
        while not stop.is_set():
            try:
                self.poll(_MAX_WAIT_S)
                self._report_bus(None)
            except (can.CanError, OSError) as error:
                self._report_bus(error)
                stop.wait(_RETRY_S)
            watchdog.notify_tick(self._clock())

    def poll(self, timeout_s: float) -> None:
        """Wait for a frame or a due time, at most `timeout_s`, then handle all received frames.

        After a pause only the newest SYNC is answered: a TPDO that comes after the next SYNC is taken for
        that one's sample.
        """
        now_ns = self._clock()
        due_ns = self.devices.advance(now_ns)
        if due_ns is not None:
            timeout_s = min(timeout_s, max(0.0, (due_ns - now_ns) * 1e-9))
        frames = list(self._receive(timeout_s))
        syncs = [number for number, frame in enumerate(frames) if _is_sync(frame)]
        self.missed_syncs += len(syncs[:-1])
        for number, frame in enumerate(frames):
            if number in syncs[:-1]:
                continue
            now_ns = self._clock()
            self.sampling.sync_ns = arrival_ns(frame, now_ns) if _is_sync(frame) else None
            self.devices.handle_frame(frame, now_ns)
            self.sampling.sync_ns = None
            self.devices.advance(self._clock())  # a flood of frames must not delay heartbeats

    def status(self) -> str:
        """Return states, failures and timing as one line."""
        parts = []
        for pad in self._pads:
            node = pad.device
            state = "no node id" if node is None else f"0x{node.node_id:02X} {node.state.lower()}"
            faults = ", ".join(kind.text for kind in pad.faults)
            parts.append(f"{pad.pad.name} {state}" + (f" ({faults})" if faults else ""))
        for adc in self.sampling.adcs:
            parts += [f"{adc.name}: {text}" for text in (adc.timing.summary(), adc.describe()) if text]
        if self.missed_syncs:
            parts.append(f"{self.missed_syncs} SYNCs missed in pauses")
        return "; ".join(parts)

    def close(self) -> None:
        """Switch the excitation off and close the ADCs."""
        for switch in self._switches.values():
            if switch is not None:
                with contextlib.suppress(AdcError):
                    switch.set(False)
                switch.close()
        self.sampling.close()

    def _receive(self, timeout_s: float) -> Iterator[can.Message]:
        """Yield the received frames, at most _MAX_FRAMES; wait for one, or for data of a source."""
        frame = self._bus.recv(timeout_s if self._bus_file is None else 0.0)
        if frame is None and self._bus_file is not None:
            self._wait(self._bus_file, timeout_s)
            frame = self._bus.recv(0.0)
        for _ in range(_MAX_FRAMES):
            if frame is None:
                return
            yield frame
            frame = self._bus.recv(0.0)

    def _wait(self, bus_file: int, timeout_s: float) -> None:
        """Wait for a frame; what a source sends meanwhile is read when it comes, which is its time."""
        waiting = select.poll()
        for file in (bus_file, *self.sampling.files):
            waiting.register(file, select.POLLIN)
        if any(file != bus_file for file, _ in waiting.poll(1e3 * timeout_s)):
            self.sampling.drain(self._clock())

    def _sample(self, now_ns: int) -> NDArray[np.int64]:
        return self.sampling(now_ns)

    def _add_node(self, pad: NodePad) -> UnconfiguredDevice:
        identity = self._store.identity(pad.name, pad.serial, pad.node_id)
        node = self.devices.add_stored(
            identity.serial,
            identity.node_id,
            partial(self._store_id, pad.name),
            len(pad.channels),
            is_packed=pad.bits == PACKED_BITS,
        )
        shown = "none; assign one by LSS" if identity.node_id is None else f"0x{identity.node_id:02X}"
        _log.info("pad %s: serial number %d, node id %s", pad.name, identity.serial, shown)
        return node

    def _store_id(self, pad: str, node_id: int | None) -> bool:
        try:
            self._store.store_node_id(pad, node_id)
        except OSError as error:
            _log.error("pad %s: node id can't be stored: %s", pad, error)
            return False
        _log.info("pad %s: node id %s stored by LSS", pad, node_id)
        return True

    def _maintain(self, _due_ns: int, now_ns: int) -> int:
        for pad in self._pads:
            self._update_excitation(pad)
        self.sampling.maintain(now_ns)
        return now_ns + _MAINTENANCE_PERIOD_NS

    def _update_excitation(self, pad: PadInput) -> None:
        """Switch the excitation as object 0x2100 has it: off without a node, and before it boots."""
        switch, name = self._switches[pad.pad.name], pad.pad.name
        on = pad.device is not None and pad.device.is_excited
        if switch is None or self._excited.get(name) is on:
            return
        try:
            switch.set(on)
        except AdcError as error:
            pad.record_failure(error)
            return
        self._excited[name] = on
        pad.record_excitation()

    def _report_bus(self, error: Exception | None) -> None:
        if (error is not None) is self._bus_failed:
            return
        self._bus_failed = error is not None
        if error is not None:
            _log.error("bus: %s; retrying every %g s", error, _RETRY_S)
        else:
            _log.warning("bus: works again")


def run(file: NodeFile, stop: threading.Event) -> None:
    """Run the nodes until `stop` is set. Raises BusError, OSError and ValueError as `NodeService`."""
    settings = file.settings
    for refused in apply_realtime_settings(settings):
        _log.warning("%s", refused.replace("[daemon] ", ""))
    interface = settings.bus
    bus = open_bus(
        config.Bus(
            name="node", interface=interface.interface, channel=interface.channel, options=interface.options
        )
    )
    notifier = SystemdNotifier.open()
    try:
        with contextlib.closing(NodeService(file, bus)) as service:
            watchdog = _ReportingWatchdog(notifier, service.status)
            service.start()
            service.serve(stop, watchdog)
            _log.info("stopped: %s", service.status())
    finally:
        notifier.close()
        bus.shutdown()


class _ReportingWatchdog(ServiceWatchdog):
    """Watchdog of systemd that also logs the status every minute."""

    def __init__(self, notifier: SystemdNotifier, status: Callable[[], str]) -> None:
        super().__init__(notifier, int(os.environ.get("WATCHDOG_USEC", 0)) * 1000, status)
        self._report_status, self._report_ns = status, time.monotonic_ns() + _REPORT_PERIOD_NS

    def notify_tick(self, now_ns: int) -> None:
        """Send the notifications that are due, and log the status when that is due."""
        super().notify_tick(now_ns)
        if now_ns >= self._report_ns:
            self._report_ns = now_ns + _REPORT_PERIOD_NS
            _log.info("%s", self._report_status())


def _file_of(bus: can.BusABC) -> int | None:
    """Return the file that is readable when a frame has come, None for a bus without."""
    try:
        return bus.fileno()
    except NotImplementedError:
        return None


def _is_sync(frame: can.Message) -> bool:
    return frame.arbitration_id == cia301.SYNC and not frame.is_extended_id


def _limit_to_node_frames(bus: can.BusABC) -> None:
    """Let the kernel pass only frames for nodes: other nodes' TPDOs would wake the process all the time."""
    services = (cia301.NMT, cia301.SYNC, cia301.LSS_REQUEST)
    filters = [(identifier, 0x7FF) for identifier in services]
    filters += [(base, 0x780) for base in (cia301.SDO_REQUEST, cia301.NMT_ERROR_CONTROL)]
    bus.set_filters([{"can_id": base, "can_mask": mask, "extended": False} for base, mask in filters])
