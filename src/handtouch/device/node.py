"""One simulated node: NMT slave, heartbeat or node guarding, EMCY, SDO server and TPDOs (CiA 301)."""

from __future__ import annotations

import random
import struct
from functools import partial

import can
from canopen.nmt import COMMAND_TO_STATE, NMT_STATES

from handtouch.canbus import cia301
from handtouch.config import eds
from handtouch.device import inputs
from handtouch.device.error_control import HEARTBEAT_TIME, ErrorControl
from handtouch.device.faults import FaultSwitches
from handtouch.device.object_values import ObjectValues
from handtouch.device.pdo import DeviceTpdo
from handtouch.device.scheduler import DeviceHost, JobGroup
from handtouch.device.sdo import DeviceSdoServer
from handtouch.device.spec import DeviceSpec

RESETS = (cia301.RESET_NODE, cia301.RESET_COMMUNICATION)
NMT_COMMANDS = (cia301.START_NODE, cia301.STOP_NODE, cia301.ENTER_PREOPERATIONAL, *RESETS)
_NO_CHANGE, _STOPS = 1, 2
"""0x1029: an error doesn't change the NMT state, or stops the node."""
_ERROR_REGISTER, _EMCY_COB_ID = (cia301.ERROR_REGISTER, 0), (cia301.EMCY_COB_ID, 0)
_LIFE_GUARD_ERROR = 0x8130
_HISTORY_LENGTH = 8
_MAX_BACKLOG_NS = 100_000_000  # backlog of a babbling node, after a pause of the program


class Device(FaultSwitches):
    """One simulated node; made by `DeviceBus.add`. Its methods may be called from any thread.

    `sdo` : its SDO server, with fault switches of its own
    """

    def __init__(self, bus: DeviceHost, row: int, node_id: int, spec: DeviceSpec) -> None:
        self.node_id, self.row, self.spec = node_id, row, spec
        self.plugged = False
        self._bus = bus
        self._nmt_state = 0
        self._is_bus_off = False
        self._counts_sample = -1
        self._noise = random.Random(node_id)
        self._power, self._babble, self._boot_loop = JobGroup(bus), JobGroup(bus), JobGroup(bus)
        self._latched_error: tuple[int, int, bytes] | None = None
        self._channels = {address: channel for channel, address in enumerate(spec.channels)}
        dictionary = spec.load_dictionary(node_id)
        self._objects = ObjectValues(dictionary, self._measured_value, self._check_write, self._handle_write)
        spec.write_identity(self._objects)
        self._limits = spec.channel_limits(self._objects)
        self._counts_per_unit = [
            (counts_per_unit or 1.0) if self._objects.is_real32(*address) else None
            for address, counts_per_unit in zip(spec.channels, spec.counts_per_unit, strict=True)
        ]
        self._excitation = spec.find_excitation(self._objects)
        self._excited_sample: int | None = -inputs.SETTLE_SAMPLES - 1
        self.sdo = DeviceSdoServer(node_id, self._objects, self._send)
        self._error_control = ErrorControl(bus, self._objects, self._send_state, self._leave_unguarded)
        self._tpdos = [
            DeviceTpdo(
                default,
                self._objects,
                self._channels,
                self.channel_counts,
                self._encode_channel,
                spec.strict_pdo,
            )
            for default in eds.default_tpdos(dictionary)
        ]
        self._load_objects()

    @property
    def state(self) -> str:
        """Name of the NMT state, "UNPLUGGED" without power."""
        return str(NMT_STATES[self._nmt_state]) if self.plugged else "UNPLUGGED"

    @property
    def serial(self) -> int:
        """Serial number, 0x1018 sub 4; 0 without one."""
        return self._objects.get_integer(cia301.IDENTITY, cia301.SERIAL_SUB)

    def plug(self) -> None:
        """Power on: boot-up message, defaults, pre-operational; no effect if powered."""
        with self._bus.lock:
            self._power.stop()
            if not self.plugged:
                self._boot(power=True)

    def unplug(self) -> None:
        """Power off: neither send nor receive until `plug`."""
        with self._bus.lock:
            self._power.stop()
            self.plugged = self._is_bus_off = False
            self._error_control.stop()
            self.refresh()

    def reboot(self) -> None:
        """Restart as by its watchdog."""
        self.unplug()
        self.plug()

    def brown_out(self, away_ns: int, *, times: int = 1, every_ns: int = 0) -> None:
        """Lose power now for `away_ns`, `times` times in all, with a period of `every_ns`."""
        if times < 1 or away_ns < 0 or (times > 1 and every_ns <= away_ns):
            raise ValueError(
                f"need times >= 1 and every_ns > away_ns >= 0, got {times}, {every_ns}, {away_ns}"
            )
        with self._bus.lock:
            self.unplug()
            restore = partial(self._restore_power, away_ns, times - 1, every_ns)
            self._power.schedule(self._bus.now_ns + away_ns, restore)

    def bus_off(self, away_ns: int, *, boots: bool = False) -> None:
        """Neither send nor receive for `away_ns`; then continue, or boot if `boots`."""
        with self._bus.lock:
            self._is_bus_off = self.plugged
            self.refresh()
            self._power.schedule(self._bus.now_ns + away_ns, partial(self._leave_bus_off, boots))

    def replace_device(self, serial: int) -> None:
        """Replace it by another device of the same kind."""
        with self._bus.lock:
            self.unplug()
            self._objects.set_default(cia301.IDENTITY, cia301.SERIAL_SUB, serial)
            self.plug()

    def read_object(self, index: int, sub: int) -> int:
        """Return the unsigned value of an object, 0 without such an object."""
        with self._bus.lock:
            return self._objects.get_integer(index, sub)

    def write_object(self, index: int, sub: int, value: int, *, keep: bool = False) -> None:
        """Set an object from inside the node, even if read-only; `keep` makes it the default."""
        with self._bus.lock:
            if keep:
                self._objects.set_default(index, sub, value)
            self._objects.set_integer(index, sub, value)
            self._handle_write(index, sub, value)

    def saturate_channels(self) -> None:
        """Set all channels to the upper end of their ranges until `release_channels`."""
        self.stuck_counts = {channel: high for channel, (_, high) in enumerate(self._limits)}

    def stick_channel(self, channel: int) -> None:
        """Keep a channel (from 0) at its present count until `release_channels`."""
        with self._bus.lock:
            self.stuck_counts = {**self.stuck_counts, channel: self.channel_counts()[channel]}

    def release_channels(self) -> None:
        """Undo `saturate_channels` and `stick_channel`."""
        self.stuck_counts = {}

    def send_emergency(self, code: int, register: int = 0, data: bytes = b"") -> None:
        """Send an EMCY message; `data` are up to five manufacturer-specific bytes."""
        with self._bus.lock:
            self._objects.set_integer(*_ERROR_REGISTER, register)
            if code:
                self._add_to_history(code | int.from_bytes(data[:2].ljust(2, b"\0"), "little") << 16)
            cob_id = self._objects.get_integer(*_EMCY_COB_ID) or cia301.EMCY + self.node_id
            if self._serves_sdo and not cob_id & cia301.INVALID_BIT:
                self._send(cob_id & cia301.IDENTIFIER_MASK, struct.pack("<HB5s", code, register, data))

    def latch_error(self, code: int, register: int = 1, data: bytes = b"") -> None:
        """Have an error until `clear_error`, through resets too: EMCY, and as 0x1029 sub 1 has it.

        Unless that is "no change", it leaves operational, and refuses it.
        """
        with self._bus.lock:
            self._latched_error = code, register, data
            self.send_emergency(code, register, data)
            if self._nmt_state == cia301.OPERATIONAL and self._is_inhibited:
                stops = self._objects.get_integer(cia301.ERROR_BEHAVIOUR, 1) == _STOPS
                self._enter_nmt_state(cia301.STOPPED if stops else cia301.PREOPERATIONAL)

    def clear_error(self) -> None:
        """Clear the error of `latch_error`: EMCY 0x0000, error register 0."""
        with self._bus.lock:
            if self._latched_error is not None:
                self._latched_error = None
                self.send_emergency(0)

    def start_boot_loop(self, period_ns: int) -> None:
        """Restart now and every `period_ns`, as by a watchdog or a weak supply, until `stop_boot_loop`."""
        if period_ns <= 0:
            raise ValueError(f"need period_ns > 0, got {period_ns}")
        with self._bus.lock:
            self._boot_loop.stop()
            self._boot_loop.schedule(self._bus.now_ns, partial(self._reboot_repeatedly, period_ns))

    def stop_boot_loop(self) -> None:
        """Stop what `start_boot_loop` started."""
        self._boot_loop.stop()

    def start_babbling(self, rate_hz: float, identifier: int | None = None, data: bytes = bytes(8)) -> None:
        """Send a frame at a high rate in any NMT state, by default with the identifier of its first TPDO."""
        if rate_hz <= 0 or not 0 <= (identifier or 0) <= cia301.IDENTIFIER_MASK:
            raise ValueError(f"need rate_hz > 0 and an 11-bit identifier, got {rate_hz} and {identifier}")
        with self._bus.lock:
            self._babble.stop()
            frame = _message(
                self._tpdos[0].message.arbitration_id if identifier is None else identifier, data
            )
            period_ns = max(round(1e9 / rate_hz), 1)
            self._babble.schedule(self._bus.now_ns, partial(self._send_babble, frame, period_ns))

    def stop_babbling(self) -> None:
        """Stop what `start_babbling` started."""
        self._babble.stop()

    def refresh(self) -> None:
        """Apply a change of switches, settings or state to the TPDOs sent."""
        self._counts_sample = -1
        self._bus.mark_changed()

    # Called by `DeviceBus` under its lock.

    @property
    def active_tpdos(self) -> list[DeviceTpdo]:
        """TPDOs that it sends at present."""
        is_connected = self.plugged and not self._is_bus_off
        is_sending = is_connected and self._nmt_state == cia301.OPERATIONAL and self.send_data
        return self._tpdos if is_sending else []

    @property
    def inputs_settled(self) -> bool:
        """True unless the excitation was switched on within the last SETTLE_SAMPLES samples."""
        return (
            self._excited_sample is None
            or not self.spec.simulates_excitation
            or self._bus.sample_count - self._excited_sample > inputs.SETTLE_SAMPLES
        )

    @property
    def is_excited(self) -> bool:
        """True while the excitation of its pad is on."""
        return self.plugged and self._excited_sample is not None

    @property
    def sends_sampled_counts(self) -> bool:
        """True if its TPDOs carry the sampler's counts unchanged."""
        return (
            self.inputs_settled
            and (self._excited_sample is not None or not self.spec.simulates_excitation)
            and tuple(self.wiring) == inputs.STRAIGHT_WIRING[: len(self.wiring)]
            and not (self.stuck_counts or self.open_electrodes)
            and self.line is None
            and self.frame_bytes is None
        )

    def channel_counts(self) -> list[int]:
        """Return the counts of the channels at the latest sample."""
        if self._counts_sample != self._bus.sample_count:
            self._counts_sample = self._bus.sample_count
            self._counts = inputs.read_channels(
                self._bus.electrode_counts(self.row),
                self._limits,
                self._noise,
                wiring=self.wiring,
                open_electrodes=self.open_electrodes,
                stuck_counts=self.stuck_counts,
                excited=self._excited_sample is not None or not self.spec.simulates_excitation,
                settled=max(self._bus.sample_count - (self._excited_sample or 0) - 1, 0)
                if self.spec.simulates_excitation
                else inputs.SETTLE_SAMPLES,
            )
        return self._counts

    def handle_nmt(self, command: int) -> None:
        """Handle an NMT command."""
        if not self.plugged or self._is_bus_off:
            return
        if command in RESETS:
            self._boot(power=command == cia301.RESET_NODE)
            return
        state = COMMAND_TO_STATE[command]
        if state == cia301.OPERATIONAL and self._is_inhibited:
            return
        if state != self._nmt_state:
            self._enter_nmt_state(state)

    def handle_sdo(self, data: bytes) -> None:
        """Handle an SDO request."""
        if self._serves_sdo:
            self.sdo.handle_request(data)

    def handle_guard_request(self, now_ns: int) -> None:
        """Respond to a guarding request, if it is guarded."""
        if self.plugged and not self._is_bus_off:
            self._error_control.handle_guard_request(now_ns)

    def transmit(self, message: can.Message, is_data: bool = False) -> None:
        """Send a frame through the line, which may be faulty."""
        line = self.line
        if not self.plugged or self._is_bus_off:
            return
        if is_data and self.frame_bytes is not None:
            data = bytes(message.data).ljust(self.frame_bytes, b"\0")[: self.frame_bytes]
            message = _message(message.arbitration_id, data)
        if line is None or (line.data_only and not is_data):
            self._bus.transmit(message)
            return
        for frame in line.received_copies(message):
            if line.late_ns:
                self._bus.schedule(self._bus.now_ns + line.late_ns, partial(self._send_delayed, frame))
            else:
                self._bus.transmit(frame)

    @property
    def _is_inhibited(self) -> bool:
        """True while an error keeps it from being operational."""
        behaviour = self._objects.get_integer(cia301.ERROR_BEHAVIOUR, 1)
        return self._latched_error is not None and behaviour != _NO_CHANGE

    @property
    def _serves_sdo(self) -> bool:
        """True in pre-operational and operational, in which SDO and EMCY work."""
        states = (cia301.OPERATIONAL, cia301.PREOPERATIONAL)
        return self.plugged and not self._is_bus_off and self._nmt_state in states

    def _boot(self, power: bool) -> None:
        """Initialise as in CiA 301: defaults, boot-up message, pre-operational."""
        self._objects.reset(application=power)
        self.sdo.reset()
        self._error_control.stop()
        self.plugged = True
        self._load_objects()
        self._send(cia301.NMT_ERROR_CONTROL + self.node_id, b"\0")
        self._enter_nmt_state(cia301.PREOPERATIONAL)
        self._error_control.start_heartbeat()
        if self._latched_error is not None:
            self.send_emergency(*self._latched_error)

    def _send_state(self, toggle_bit: int) -> None:
        """Send a heartbeat or a guarding response."""
        if self.send_heartbeat:
            state = self._nmt_state if self.heartbeat_state is None else self.heartbeat_state
            self._send(cia301.NMT_ERROR_CONTROL + self.node_id, bytes((toggle_bit | state,)))

    def _leave_unguarded(self) -> None:
        """Report an expired life time, and leave operational."""
        self.send_emergency(_LIFE_GUARD_ERROR, 0x11)
        if self._nmt_state == cia301.OPERATIONAL:
            self._enter_nmt_state(cia301.PREOPERATIONAL)

    def _add_to_history(self, entry: int) -> None:
        """Put an error first in the pre-defined error field, 0x1003."""
        index, get = cia301.ERROR_HISTORY, self._objects.get_integer
        kept = min(get(index, 0), _HISTORY_LENGTH - 1)
        for sub in range(kept, 0, -1):
            self._objects.set_integer(index, sub + 1, get(index, sub))
        self._objects.set_integer(index, 1, entry)
        self._objects.set_integer(index, 0, kept + 1)

    def _enter_nmt_state(self, state: int) -> None:
        self._nmt_state = state
        for tpdo in self._tpdos:
            tpdo.reset_history()
        self.refresh()

    def _load_objects(self) -> None:
        """Load the settings from the objects."""
        for tpdo in self._tpdos:
            tpdo.load_settings()
        self._set_excitation(self._excitation is None or bool(self._objects.get_integer(*self._excitation)))
        self.refresh()

    def _set_excitation(self, on: bool) -> None:
        if not on:
            self._excited_sample = None
        elif self._excited_sample is None:
            self._excited_sample = self._bus.sample_count

    # Objects with side effects.

    def _measured_value(self, index: int, sub: int) -> float | None:
        channel = self._channels.get((index, sub))
        if channel is None:
            return None
        count, counts_per_unit = self.channel_counts()[channel], self._counts_per_unit[channel]
        return count if counts_per_unit is None else count / counts_per_unit

    def _encode_channel(self, channel: int, count: int) -> int:
        """Return the bits of a channel's object at a count."""
        counts_per_unit = self._counts_per_unit[channel]
        if counts_per_unit is None:
            return count
        return int.from_bytes(struct.pack("<f", count / counts_per_unit), "little")

    def _check_write(self, index: int, sub: int, value: int) -> None:
        for tpdo in self._tpdos:
            tpdo.check_write(index, sub, value)

    def _handle_write(self, index: int, sub: int, value: int) -> None:
        if (index, sub) == HEARTBEAT_TIME:
            self._error_control.start_heartbeat()
        elif (index, sub) == self._excitation:
            self._set_excitation(bool(value))
        for tpdo in self._tpdos:
            tpdo.handle_write(index)
        self.refresh()

    # Scheduled jobs.

    def _reboot_repeatedly(self, period_ns: int, _due_ns: int, now_ns: int) -> int:
        self.reboot()
        return now_ns + period_ns

    def _send_babble(self, frame: can.Message, period_ns: int, due_ns: int, now_ns: int) -> int:
        self.transmit(frame, is_data=True)
        return max(due_ns + period_ns, now_ns - _MAX_BACKLOG_NS)

    def _restore_power(self, away_ns: int, times: int, every_ns: int, due_ns: int, _now_ns: int) -> None:
        self.plug()
        if times:
            again = partial(self.brown_out, away_ns, times=times, every_ns=every_ns)
            self._power.schedule(due_ns + every_ns - away_ns, lambda *_: again())

    def _leave_bus_off(self, boots: bool, *_: int) -> None:
        if not self._is_bus_off:
            return
        self._is_bus_off = False
        self.refresh()
        if boots:
            self._boot(power=True)

    def _send_delayed(self, frame: can.Message, *_: int) -> None:
        self._bus.transmit(frame)

    def _send(self, can_id: int, data: bytes) -> None:
        self.transmit(_message(can_id, data))


def _message(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
