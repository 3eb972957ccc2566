"""The node's side of CANopen: many simulated four-channel nodes on one bus, each with fault switches.

Public names: `DeviceBus` hosts the nodes, `Device` is one of them, `Sampler` what they measure.

SDO server, NMT slave, heartbeat and EMCY are those of the `canopen` library; added here are what it lacks:
a boot-up message after every reset, PDOs triggered by SYNC, and heartbeats sent by the loop that serves the
node instead of by a thread each. All of it is driven by `handle` (a frame came) and `advance` (time has
passed), which touch no clock; `poll` and `start` do that for programs.
"""

from __future__ import annotations

import logging
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
from canopen.objectdictionary.eds import import_eds
from canopen.sdo import SdoAbortedError
from numpy.typing import NDArray

from handtouch import shipped
from handtouch.canbus.slab import FULL_SCALE

Sampler = Callable[[int], NDArray[np.int16]]
"""Host's monotonic time [ns] of a SYNC -> counts (n, 4), one row a node in the order they were added."""

_NMT_ID, _SYNC_ID, _SDO_ID = 0x000, 0x080, 0x600
_OPERATIONAL, _PRE_OPERATIONAL = 5, 127
_RESET_NODE, _RESET_COMMUNICATION, _ENTER_PRE_OPERATIONAL = 129, 130, 128
_NMT_COMMANDS = (1, 2, _ENTER_PRE_OPERATIONAL, _RESET_NODE, _RESET_COMMUNICATION)
_VALUE_RANGE_EXCEEDED = 0x06090030
_CHANNELS, _TPDO2, _IDENTITY = 0x6401, 0x1801, 0x1018
_PDO_OFF = 1 << 31
_LONGEST_WAIT_S = 0.1  # so that `stop` is prompt whatever the heartbeats
_MOST_WAITING = 100_000  # frames; a bus that never falls silent doesn't hold the start up
_BACK_OFF_S = 0.1  # between attempts on a bus that fails

_log = logging.getLogger(__name__)


class Device:
    """One simulated node; made by `DeviceBus.add`. Methods and flags are safe from any thread.

    Switches that last until they are taken back:
    `send_heartbeat`, `send_data` : False silences one and leaves the other
    `frame_bytes` : length of its TPDOs; other than 8 is a malformed one
    `held` : channel (0-3) -> count that this channel shows whatever it measures
    """

    def __init__(
        self, bus: DeviceBus, row: int, node_id: int, eds: str, identity: dict[int, int | None]
    ) -> None:
        self.node_id = node_id
        self.send_heartbeat = True
        self.send_data = True
        self.frame_bytes = 8
        self.held: dict[int, int] = {}
        self.plugged = False
        self._bus = bus
        self._row = row
        objects = import_eds(eds, node_id)
        if not {_TPDO2, _CHANNELS, _IDENTITY} <= set(objects):
            raise ValueError(f"{eds}: a simulated node needs objects 0x1018, 0x1801 and 0x6401")
        self._identity = {
            sub: value if value is not None else objects[_IDENTITY][sub].default or 0
            for sub, value in identity.items()
        }
        self._node: Any = canopen.LocalNode(node_id, objects)
        # until the first transfer has set them the library's own abort messages fail on these
        self._node.sdo._index = self._node.sdo._subindex = 0
        self._node.add_read_callback(self._read)
        self._node.add_write_callback(self._write)
        self._node.associate_network(_Port(bus, self))
        self._heartbeat: _Heartbeat | None = None
        self._tpdo = can.Message(is_extended_id=False, data=bytes(8))
        self._set_tpdo(cob_id=self._default(1), every=self._default(2))

    @property
    def state(self) -> str:
        """NMT state by its CANopen name, "UNPLUGGED" without power."""
        return str(self._node.nmt.state) if self.plugged else "UNPLUGGED"

    @property
    def serial(self) -> int:
        """Serial number, 0x1018 sub 4."""
        return self._identity[4]

    def plug(self) -> None:
        """Power on: boot-up message, everything at its default, pre-operational; without effect if on."""
        with self._bus.lock:
            if not self.plugged:
                self._boot()

    def unplug(self) -> None:
        """Power off: says nothing and hears nothing until `plug`."""
        with self._bus.lock:
            self.plugged = False
            self._node.nmt.stop_heartbeat()

    def reboot(self) -> None:
        """Reset by itself, as a brown-out or its watchdog would make it."""
        self.unplug()
        self.plug()

    def swap(self, serial: int) -> None:
        """Another unit of the same kind is plugged in its place."""
        self.unplug()
        self._identity = {**self._identity, 4: serial}
        self.plug()

    def saturate(self) -> None:
        """All channels at full scale, until `release`."""
        self.held = dict.fromkeys(range(4), FULL_SCALE)

    def stick(self, channel: int) -> None:
        """Let a channel (0-3) keep its present count, until `release`."""
        with self._bus.lock:
            self.held = {**self.held, channel: self._bus.latest(self._row, channel)}

    def release(self) -> None:
        """Let all channels show what they measure."""
        self.held = {}

    def emergency(self, code: int, register: int = 0, data: bytes = b"") -> None:
        """Send an EMCY message; `data` are up to five bytes of the manufacturer's own."""
        with self._bus.lock:
            if self.plugged:
                self._node.emcy.send(code, register, data)

    # What `DeviceBus` calls, under its lock.

    def on_nmt(self, command: int) -> None:
        if command in (_RESET_NODE, _RESET_COMMUNICATION):
            self._boot()
        else:
            self._node.nmt.on_command(_NMT_ID, bytes((command, self.node_id)), 0.0)
            self._syncs = 0

    def on_sdo(self, data: bytes) -> None:
        if self.plugged and self._node.nmt._state in (_OPERATIONAL, _PRE_OPERATIONAL):
            self._node.sdo.on_request(_SDO_ID + self.node_id, data, 0.0)

    def tpdo(self, sample: bytes) -> can.Message | None:
        """The TPDO that follows a SYNC, None if none does; `sample` are the 8 bytes measured at it."""
        if not self.plugged or self._node.nmt._state != _OPERATIONAL or not self._every:
            return None
        self._syncs += 1
        if self._syncs < self._every:
            return None
        self._syncs = 0
        if not self.send_data:
            return None
        if self.held:
            sample = self._hold(sample)
        if self.frame_bytes != 8:
            sample = (sample + bytes(8))[: self.frame_bytes]
        message = self._tpdo
        message.data, message.dlc = bytearray(sample), len(sample)
        return message

    def heartbeat_due_ns(self, t_ns: int) -> int | None:
        """Send the heartbeat if it is due; returns when the next one is, None without heartbeat."""
        return self._heartbeat.due_ns(t_ns) if self._heartbeat else None

    def new_heartbeat(self, can_id: int, data: bytes, period_s: float) -> _Heartbeat:
        self._heartbeat = _Heartbeat(self._bus, self, _message(can_id, data), period_s)
        return self._heartbeat

    def _boot(self) -> None:
        """Initialisation as CiA 301 has it: defaults, boot-up message, pre-operational by itself."""
        node = self._node
        node.nmt.stop_heartbeat()
        node.data_store.clear()
        node.data_store[_IDENTITY] = {sub: struct.pack("<I", value) for sub, value in self._identity.items()}
        self._set_tpdo(cob_id=self._default(1), every=self._default(2))
        self.plugged = True
        node.nmt.send_command(_RESET_NODE)  # sends the boot-up message
        node.nmt.send_command(_ENTER_PRE_OPERATIONAL)  # starts the heartbeat

    def _default(self, subindex: int) -> int:
        return int(self._node.object_dictionary[_TPDO2][subindex].default)

    def _set_tpdo(self, cob_id: int, every: int) -> None:
        self._cob_id, self._transmission = cob_id, every
        self._tpdo.arbitration_id = cob_id & 0x7FF
        self._every = 0 if cob_id & _PDO_OFF else every
        self._syncs = 0

    def _hold(self, sample: bytes) -> bytes:
        counts = list(struct.unpack("<4h", sample))
        for channel, count in self.held.items():
            counts[channel] = count
        return struct.pack("<4h", *counts)

    def _read(self, index: int, subindex: int, **_: object) -> int | None:
        if index != _CHANNELS or not 1 <= subindex <= 4:
            return None
        return self.held.get(subindex - 1, self._bus.latest(self._row, subindex - 1))

    def _write(self, index: int, subindex: int, data: bytes, **_: object) -> None:
        if index != _TPDO2:
            return
        value = int.from_bytes(data, "little")
        if subindex == 1:
            if value & ~_PDO_OFF & ~0x7FF:
                raise SdoAbortedError(_VALUE_RANGE_EXCEEDED)
            self._set_tpdo(value, self._transmission)
        elif subindex == 2:
            if not 1 <= value <= 240:  # synchronous and cyclic only
                raise SdoAbortedError(_VALUE_RANGE_EXCEEDED)
            self._set_tpdo(self._cob_id, value)


class DeviceBus:
    """Simulated nodes on one python-can bus, which the caller opens and shuts down.

    `sample` is asked once for all nodes at every SYNC. `rejected` counts malformed frames, `send_failures`
    frames that the bus did not take, `bus_errors` failed reads, `syncs` the SYNCs answered.
    """

    def __init__(
        self, bus: can.BusABC, sample: Sampler, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.devices: dict[int, Device] = {}
        self.lock = threading.RLock()
        self.rejected = self.send_failures = self.bus_errors = self.syncs = 0
        self._bus = bus
        self._sample = sample
        self._clock = clock
        self._now_ns = clock()
        self._counts = np.zeros((0, 4), np.int16)
        self._next_ns: int | None = None
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
    ) -> Device:
        """A new node, its row of `sample` the next one; it is silent until `Device.plug` or `start`.

        The EDS is the shipped one unless another is given, the identity that of the EDS. Raises ValueError
        for a node id out of range or taken, and for an EDS without the objects of such a node.
        """
        if not 1 <= node_id <= 127 or node_id in self.devices:
            raise ValueError(f"node_id must be 1 to 127 and used once, got {node_id}")
        identity = {1: vendor_id, 2: product_code, 3: None, 4: serial}
        path = str(eds or shipped.path("handtouch-node.eds"))
        device = Device(self, len(self.devices), node_id, path, identity)
        self.devices[node_id] = device
        return device

    def handle(self, frame: can.Message, t_ns: int) -> None:
        """Take a frame that arrived at `t_ns`; others than a node's (our own too) are ignored."""
        identifier = frame.arbitration_id
        special = frame.is_extended_id or frame.is_remote_frame or frame.is_error_frame
        if special or identifier > _SDO_ID + 127:
            return
        with self.lock:
            self._now_ns = t_ns
            if identifier == _SYNC_ID:
                self._answer_sync(t_ns)
            elif identifier == _NMT_ID:
                self._command(bytes(frame.data))
            elif identifier > _SDO_ID and (device := self.devices.get(identifier - _SDO_ID)):
                if len(frame.data) == 8:
                    device.on_sdo(bytes(frame.data))
                else:
                    self.rejected += 1

    def advance(self, t_ns: int) -> int | None:
        """Send the heartbeats due at `t_ns`; returns the time of the next one, None if there is none."""
        with self.lock:
            self._now_ns = t_ns
            if self._next_ns is not None and self._next_ns <= t_ns:
                due = [device.heartbeat_due_ns(t_ns) for device in self.devices.values()]
                self._next_ns = min((at for at in due if at is not None), default=None)
            return self._next_ns

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
        for device in self.devices.values():
            device.plug()
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name="canopen-nodes", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the nodes fall silent where they are. Without effect if it isn't running."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def latest(self, row: int, channel: int) -> int:
        """What a channel measured at the latest SYNC, 0 before the first."""
        return int(self._counts[row, channel]) if row < len(self._counts) else 0

    def transmit(self, message: can.Message) -> None:
        """Send; a bus that doesn't take it costs the frame and nothing else, as on a real node."""
        try:
            self._bus.send(message)
        except (can.CanError, OSError):
            self.send_failures += 1

    def expect(self, due_ns: int) -> None:
        """Something is due at `due_ns`."""
        self._next_ns = due_ns if self._next_ns is None else min(self._next_ns, due_ns)

    @property
    def now_ns(self) -> int:
        """Time of the latest `handle` or `advance`."""
        return self._now_ns

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

    def _answer_sync(self, t_ns: int) -> None:
        self.syncs += 1
        self._counts = self._sample(t_ns)
        samples = self._counts.astype("<i2", copy=False).tobytes()
        for row, device in enumerate(self.devices.values()):
            message = device.tpdo(samples[8 * row : 8 * row + 8])
            if message is not None:
                self.transmit(message)

    def _command(self, data: bytes) -> None:
        if len(data) != 2 or data[0] not in _NMT_COMMANDS:
            self.rejected += 1
            return
        command, node_id = data
        addressed = self.devices.values() if node_id == 0 else (self.devices.get(node_id),)
        for device in addressed:
            if device is not None and device.plugged:
                device.on_nmt(command)


class _Heartbeat:
    """A frame sent periodically, in the terms of the library's periodic task."""

    def __init__(self, bus: DeviceBus, device: Device, message: can.Message, period_s: float) -> None:
        self._bus, self._device, self._message = bus, device, message
        self._period_ns = round(period_s * 1e9)
        self._due_ns: int | None = bus.now_ns + self._period_ns
        bus.expect(self._due_ns)

    def update(self, data: bytes) -> None:
        self._message = _message(self._message.arbitration_id, data)

    def stop(self) -> None:
        self._due_ns = None

    def due_ns(self, t_ns: int) -> int | None:
        if self._due_ns is not None and self._due_ns <= t_ns:
            if self._device.send_heartbeat:
                self._bus.transmit(self._message)
            self._due_ns += self._period_ns * (1 + (t_ns - self._due_ns) // self._period_ns)
        return self._due_ns


class _Port:
    """What a `canopen.LocalNode` needs of a network: a way to send; `DeviceBus` brings it its frames."""

    def __init__(self, bus: DeviceBus, device: Device) -> None:
        self._bus, self._device = bus, device

    def subscribe(self, can_id: int, callback: object) -> None:
        """Nothing to do: `DeviceBus.handle` knows where a frame goes."""

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._bus.transmit(_message(can_id, data, remote))

    def send_periodic(self, can_id: int, data: bytes, period: float) -> _Heartbeat:
        return self._device.new_heartbeat(can_id, data, period)


def _message(can_id: int, data: bytes, remote: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=bytes(data), is_extended_id=False, is_remote_frame=remote)
