"""One simulated node: NMT slave, heartbeat or node guarding, EMCY, SDO server and TPDOs (CiA 301)."""

from __future__ import annotations

import random
import struct
from functools import partial
from typing import TYPE_CHECKING

import can
from canopen.nmt import COMMAND_TO_STATE, NMT_STATES

from handtouch.canbus.objects import eds

from . import inputs
from .faults import Switches
from .objects import Address, Objects
from .pdo import Tpdo
from .sdo import Server
from .unit import IDENTITY, SERIAL, Unit

if TYPE_CHECKING:
    from .bus import DeviceBus

_PRE_OPERATIONAL, _OPERATIONAL = 127, 5
_RESET_NODE, _RESET_COMMUNICATION = 129, 130
RESETS = (_RESET_NODE, _RESET_COMMUNICATION)
NMT_COMMANDS = (1, 2, 128, *RESETS)
_NMT_ERROR_ID, _EMCY_ID = 0x700, 0x080
_ERROR_REGISTER, _GUARD_TIME, _LIFE_FACTOR, _EMCY = (0x1001, 0), (0x100C, 0), (0x100D, 0), (0x1014, 0)
_HEARTBEAT = (0x1017, 0)
_NOT_VALID, _IDENTIFIER = 1 << 31, 0x7FF
_LIFE_GUARD_ERROR = 0x8130
_LONGEST_ARREARS_NS = 100_000_000  # of a babbling node, after a pause of the program


class Device(Switches):
    """One simulated node; made by `DeviceBus.add`. Its methods may be called from any thread.

    `sdo` : its SDO server, with switches of its own; see `sdo.Server`
    """

    def __init__(self, bus: DeviceBus, row: int, node_id: int, unit: Unit) -> None:
        self.node_id, self.row, self.unit = node_id, row, unit
        self.plugged = False
        self._bus = bus
        self._state = 0
        self._off_bus = False
        self._sampled = -1
        self._noise = random.Random(node_id)
        self._power = self._beat = self._chatter = self._life = 0  # each counts up to void what was planned
        self._toggle = 0
        self._channels = {address: channel for channel, address in enumerate(unit.channels)}
        dictionary = unit.dictionary(node_id)
        self._objects = Objects(dictionary, self._live, self._check, self._changed)
        unit.identify(self._objects)
        self._limits = unit.limits(self._objects)
        self._excitation = unit.switch(self._objects)
        self._excited_at: int | None = -inputs.SETTLE_SAMPLES - 1
        self.sdo = Server(node_id, self._objects, self._send)
        self._tpdos = [
            Tpdo(default, self._objects, self._channels, self.sample, unit.strict_pdo)
            for default in eds.tpdos(dictionary)
        ]
        self._load()

    @property
    def state(self) -> str:
        """NMT state by its CANopen name, "UNPLUGGED" without power."""
        return str(NMT_STATES[self._state]) if self.plugged else "UNPLUGGED"

    @property
    def serial(self) -> int:
        """Serial number, 0x1018 sub 4; 0 without one."""
        return self._objects.integer(IDENTITY, SERIAL)

    @property
    def fail_sdo(self) -> dict[Address, int | None]:
        """`sdo.fail`: object -> abort code that answers every request for it, None for silence."""
        return self.sdo.fail

    def plug(self) -> None:
        """Power on: boot-up message, everything at its default, pre-operational; without effect if on."""
        with self._bus.lock:
            self._power += 1
            if not self.plugged:
                self._boot(power=True)

    def unplug(self) -> None:
        """Power off: says nothing and hears nothing until `plug`."""
        with self._bus.lock:
            self._power += 1
            self.plugged = self._off_bus = False
            self.refresh()

    def reboot(self) -> None:
        """Reset by itself, as its watchdog would make it."""
        self.unplug()
        self.plug()

    def brown_out(self, away_ns: int, *, times: int = 1, every_ns: int = 0) -> None:
        """Lose power now for `away_ns`, `times` in all, `every_ns` from one to the next."""
        if times < 1 or away_ns < 0 or (times > 1 and every_ns <= away_ns):
            raise ValueError(
                f"need times >= 1 and every_ns > away_ns >= 0, got {times}, {every_ns}, {away_ns}"
            )
        with self._bus.lock:
            self.unplug()
            back = partial(self._power_back, self._power, (away_ns, times - 1, every_ns))
            self._bus.at(self._bus.now_ns + away_ns, back)

    def bus_off(self, away_ns: int, *, boots: bool = False) -> None:
        """Neither send nor hear for `away_ns`; then go on as it was, or boot if `boots`."""
        with self._bus.lock:
            self._off_bus = self.plugged
            self.refresh()
            self._bus.at(self._bus.now_ns + away_ns, partial(self._bus_back, self._power, boots))

    def swap(self, serial: int) -> None:
        """Another unit of the same kind is plugged in its place."""
        with self._bus.lock:
            self.unplug()
            self._objects.preset(IDENTITY, SERIAL, serial)
            self.plug()

    def read(self, index: int, sub: int) -> int:
        """Value of an object, unsigned, as the node itself sees it; 0 without such an object."""
        with self._bus.lock:
            return self._objects.integer(index, sub)

    def write(self, index: int, sub: int, value: int, *, keep: bool = False) -> None:
        """Set an object from inside the node, read-only or not; `keep` makes it the value after power-on."""
        with self._bus.lock:
            if keep:
                self._objects.preset(index, sub, value)
            self._objects.put(index, sub, value)
            self._changed(index, sub, value)

    def saturate(self) -> None:
        """All channels at the upper end of their ranges, until `release`."""
        self.held = {channel: high for channel, (_, high) in enumerate(self._limits)}

    def stick(self, channel: int) -> None:
        """Let a channel (0-3) keep its present count, until `release`."""
        with self._bus.lock:
            self.held = {**self.held, channel: self.sample()[channel]}

    def release(self) -> None:
        """Let all channels show what they measure."""
        self.held = {}

    def emergency(self, code: int, register: int = 0, data: bytes = b"") -> None:
        """Send an EMCY message; `data` are up to five bytes of the manufacturer's own."""
        with self._bus.lock:
            self._objects.put(*_ERROR_REGISTER, register)
            cob_id = self._objects.integer(*_EMCY) or _EMCY_ID + self.node_id
            if self._talks and not cob_id & _NOT_VALID:
                self._send(cob_id & _IDENTIFIER, struct.pack("<HB5s", code, register, data))

    def babble(self, rate_hz: float, identifier: int | None = None, data: bytes = bytes(8)) -> None:
        """Flood the bus with one frame, by default as its first TPDO, whatever its state, until `hush`."""
        if rate_hz <= 0 or not 0 <= (identifier or 0) <= _IDENTIFIER:
            raise ValueError(f"need rate_hz > 0 and an 11-bit identifier, got {rate_hz} and {identifier}")
        with self._bus.lock:
            self._chatter += 1
            frame = _message(
                self._tpdos[0].message.arbitration_id if identifier is None else identifier, data
            )
            period_ns = max(round(1e9 / rate_hz), 1)
            self._bus.at(self._bus.now_ns, partial(self._babble, self._chatter, frame, period_ns))

    def hush(self) -> None:
        """End `babble`."""
        self._chatter += 1

    def refresh(self) -> None:
        """What it sends may have changed."""
        self._sampled = -1
        self._bus.changed()

    # What `DeviceBus` calls, under its lock.

    @property
    def tpdos(self) -> list[Tpdo]:
        """Those that it sends at present."""
        running = self.plugged and not self._off_bus and self._state == _OPERATIONAL and self.send_data
        return self._tpdos if running else []

    @property
    def settled(self) -> bool:
        """Whether its inputs show what is so; not for a while after the excitation came on."""
        return self._excited_at is None or self._bus.number - self._excited_at > inputs.SETTLE_SAMPLES

    @property
    def excited(self) -> bool:
        """Whether its pad is under potential."""
        return self.plugged and self._excited_at is not None

    @property
    def undisturbed(self) -> bool:
        """Whether its TPDOs carry what the sampler gives, unchanged."""
        straight = self.settled and self._excited_at is not None and tuple(self.wired) == inputs.STRAIGHT
        return straight and not (self.held or self.dead) and self.line is None and self.frame_bytes is None

    def sample(self) -> list[int]:
        """Counts of the four channels at the latest sample."""
        if self._sampled != self._bus.number:
            self._sampled = self._bus.number
            self._counts = inputs.read(
                self._bus.electrodes(self.row),
                self._limits,
                self._noise,
                wired=self.wired,
                dead=self.dead,
                held=self.held,
                excited=self._excited_at is not None,
                settled=max(self._bus.number - (self._excited_at or 0) - 1, 0),
            )
        return self._counts

    def on_nmt(self, command: int) -> None:
        if not self.plugged or self._off_bus:
            return
        if command in RESETS:
            self._boot(power=command == _RESET_NODE)
            return
        state = COMMAND_TO_STATE[command]
        if state != self._state:
            self._enter(state)

    def on_sdo(self, data: bytes) -> None:
        if self._talks:
            self.sdo.request(data)

    def on_guard(self, t_ns: int) -> None:
        """Node guarding: answer with state and toggle bit, and watch over the master's life time."""
        guards = _GUARD_TIME in self._objects and not self._objects.integer(*_HEARTBEAT)
        if not guards or not self.plugged or self._off_bus:
            return
        if self.send_heartbeat:
            self._send(_NMT_ERROR_ID + self.node_id, bytes((self._toggle | self._state,)))
        self._toggle ^= 0x80
        life_ms = self._objects.integer(*_GUARD_TIME) * self._objects.integer(*_LIFE_FACTOR)
        self._life += 1
        if life_ms:
            self._bus.at(t_ns + life_ms * 1_000_000, partial(self._life_guard, self._life))

    def transmit(self, message: can.Message, is_data: bool = False) -> None:
        """Send; what becomes of it is up to the line."""
        line = self.line
        if not self.plugged or self._off_bus:
            return
        if is_data and self.frame_bytes is not None:
            data = bytes(message.data).ljust(self.frame_bytes, b"\0")[: self.frame_bytes]
            message = _message(message.arbitration_id, data)
        if line is None or (line.data_only and not is_data):
            self._bus.transmit(message)
            return
        for frame in line.frames(message):
            if line.late_ns:
                self._bus.at(self._bus.now_ns + line.late_ns, partial(self._late, frame))
            else:
                self._bus.transmit(frame)

    @property
    def _talks(self) -> bool:
        """Whether SDO and EMCY work: in pre-operational and operational."""
        return self.plugged and not self._off_bus and self._state in (_OPERATIONAL, _PRE_OPERATIONAL)

    def _boot(self, power: bool) -> None:
        """Initialisation as CiA 301 has it: defaults, boot-up message, pre-operational by itself."""
        self._objects.reset(application=power)
        self.sdo.reset()
        self._toggle = 0
        self._life += 1
        self.plugged = True
        self._load()
        self._send(_NMT_ERROR_ID + self.node_id, b"\0")
        self._enter(_PRE_OPERATIONAL)
        self._start_heartbeat(self._objects.integer(*_HEARTBEAT))

    def _enter(self, state: int) -> None:
        self._state = state
        for tpdo in self._tpdos:
            tpdo.restart()
        self.refresh()

    def _load(self) -> None:
        """Take over what the objects say."""
        for tpdo in self._tpdos:
            tpdo.load()
        self._excite(self._excitation is None or bool(self._objects.integer(*self._excitation)))
        self.refresh()

    def _excite(self, on: bool) -> None:
        if not on:
            self._excited_at = None
        elif self._excited_at is None:
            self._excited_at = self._bus.number

    # Objects that do something.

    def _live(self, index: int, sub: int) -> int | None:
        channel = self._channels.get((index, sub))
        return None if channel is None else self.sample()[channel]

    def _check(self, index: int, sub: int, value: int) -> None:
        for tpdo in self._tpdos:
            tpdo.check(index, sub, value)

    def _changed(self, index: int, sub: int, value: int) -> None:
        if (index, sub) == _HEARTBEAT:
            self._start_heartbeat(value)
        elif (index, sub) == self._excitation:
            self._excite(bool(value))
        for tpdo in self._tpdos:
            tpdo.changed(index)
        self.refresh()

    # What is done later.

    def _start_heartbeat(self, period_ms: int) -> None:
        self._beat += 1
        if period_ms:
            period_ns = period_ms * 1_000_000
            self._bus.at(self._bus.now_ns + period_ns, partial(self._heartbeat, self._beat, period_ns))

    def _heartbeat(self, beat: int, period_ns: int, due_ns: int, t_ns: int) -> int | None:
        if beat != self._beat or not self.plugged:
            return None
        if self.send_heartbeat:
            self._send(_NMT_ERROR_ID + self.node_id, bytes((self._state,)))
        return due_ns + period_ns * (1 + (t_ns - due_ns) // period_ns)

    def _life_guard(self, life: int, *_: int) -> None:
        """The master hasn't asked for too long."""
        if life != self._life or not self.plugged:
            return
        self.emergency(_LIFE_GUARD_ERROR, 0x11)
        if self._state == _OPERATIONAL:
            self._enter(_PRE_OPERATIONAL)

    def _babble(self, chatter: int, frame: can.Message, period_ns: int, due_ns: int, t_ns: int) -> int | None:
        if chatter != self._chatter:
            return None
        self.transmit(frame, is_data=True)
        return max(due_ns + period_ns, t_ns - _LONGEST_ARREARS_NS)

    def _power_back(self, power: int, again: tuple[int, int, int], due_ns: int, _t_ns: int) -> None:
        if power != self._power:
            return  # somebody has switched it since
        self.plug()
        away_ns, times, every_ns = again
        if times:
            self._bus.at(due_ns + every_ns - away_ns, partial(self._brown_again, self._power, again))

    def _brown_again(self, power: int, again: tuple[int, int, int], *_: int) -> None:
        if power == self._power:
            self.brown_out(again[0], times=again[1], every_ns=again[2])

    def _bus_back(self, power: int, boots: bool, *_: int) -> None:
        if power != self._power or not self._off_bus:
            return
        self._off_bus = False
        self.refresh()
        if boots:
            self._boot(power=True)

    def _late(self, frame: can.Message, *_: int) -> None:
        self._bus.transmit(frame)

    def _send(self, can_id: int, data: bytes) -> None:
        self.transmit(_message(can_id, data))


def _message(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
