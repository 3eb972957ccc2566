"""One TPDO of a node: when it is sent and what is in it, as objects 0x1800 and 0x1A00 (+ number - 1) say."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import can
from canopen.sdo import SdoAbortedError
from canopen.sdo import constants as sdo

from handtouch.canbus.objects.eds import TpdoDefault

from .objects import Address, Objects

_COMMUNICATION, _MAPPING = 0x1800, 0x1A00
_INTERRUPT_ENABLE, _DELTA = (0x6423, 0), 0x6426
"""CiA 401: analogue input global interrupt enable; interrupt delta, one sub-index per input [counts]."""
_NOT_VALID, _NO_REMOTE, _IDENTIFIER = 1 << 31, 1 << 30, 0x7FF
_SYNCHRONOUS, _EVENT_DRIVEN = range(241), (254, 255)
_INHIBIT_UNIT_NS, _EVENT_UNIT_NS = 100_000, 1_000_000
_PDO_BITS = 64
_DUMMIES = range(1, 0x20)  # data types: entries that only fill
_RESTRICTED = (
    range(0x80),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x800),
)
_STANDARD = ((0, 0, 0xFFFF), (1, 16, 0xFFFF), (2, 32, 0xFFFF), (3, 48, 0xFFFF))


@dataclass(frozen=True, slots=True)
class _Entry:
    """An entry of a mapping."""

    index: int
    sub: int
    bits: int


class Tpdo:
    """`default` is how the node has it after power-on, `sample` gives the counts of the four channels, and
    `channels` says which object carries which. A `strict` one isn't changed while it is valid.

    `every` is its period in SYNCs, 0 if it isn't cyclic; `standard` whether it is four int16 in order.
    """

    def __init__(
        self,
        default: TpdoDefault,
        objects: Objects,
        channels: Mapping[Address, int],
        sample: Callable[[], Sequence[int]],
        strict: bool,
    ) -> None:
        self.message = can.Message(is_extended_id=False, data=bytes(8))
        self._communication, self._mapping = (
            _COMMUNICATION + default.number - 1,
            _MAPPING + default.number - 1,
        )
        self._objects, self._channels, self._sample, self._strict = objects, channels, sample, strict
        self._deltas = [0] * len(channels)
        cob_id = default.cob_id | objects.integer(self._communication, 1) & _NO_REMOTE
        self._defaults = (
            cob_id if default.enabled else cob_id | _NOT_VALID,
            default.transmission,
            len(default.entries),
        )
        places = ((self._communication, 1), (self._communication, 2), (self._mapping, 0))
        for (index, sub), value in zip(places, self._defaults, strict=True):
            objects.preset(index, sub, value)

    def load(self) -> None:
        """Take over what the objects say."""
        record, read = self._communication, self._objects.integer
        cob_id, self._type, count = self._defaults  # where the node has no object for it
        cob_id, self._type = read(record, 1, cob_id), read(record, 2, self._type)
        self._valid = not cob_id & _NOT_VALID
        self.message.arbitration_id = cob_id & _IDENTIFIER
        self._inhibit_ns = read(record, 3) * _INHIBIT_UNIT_NS
        self._event_ns = read(record, 5) * _EVENT_UNIT_NS
        self._load_events()
        self._load_mapping(self._entries(read(self._mapping, 0, count)))
        self.every = self._type if self._valid and self._type in _SYNCHRONOUS else 0
        self.restart()

    def changed(self, index: int) -> None:
        """An object with this index was written."""
        if index in (self._communication, self._mapping):
            self.load()
        elif index in (_INTERRUPT_ENABLE[0], _DELTA):
            self._load_events()

    def restart(self) -> None:
        """Forget what was sent: the node was started, or the PDO changed."""
        self._syncs = 0
        self._last: Sequence[int] | None = None
        self._sent_ns = 0

    @property
    def on_sync(self) -> bool:
        """Whether a SYNC can make it go."""
        return self._sends and self._type in _SYNCHRONOUS

    @property
    def on_event(self) -> bool:
        """Whether a change or a timer can make it go."""
        return self._sends and self._type in _EVENT_DRIVEN

    def sync(self, t_ns: int) -> can.Message | None:
        """What to send after a SYNC; type 0 sends if there is news, type n every nth time."""
        if self._type == 0:
            return self._fill(t_ns) if self._last is None or self._moved(self._sample()) else None
        self._syncs += 1
        if self._syncs < self._type:
            return None
        self._syncs = 0
        return self._fill(t_ns)

    def event(self, t_ns: int) -> can.Message | None:
        """What to send now by itself: at first, at a change, or when the event timer runs out."""
        if self._last is None:
            return self._fill(t_ns)
        waited_ns = t_ns - self._sent_ns
        expired = 0 < self._event_ns <= waited_ns
        if waited_ns < self._inhibit_ns or not (expired or self._moved(self._sample())):
            return None
        return self._fill(t_ns)

    def check(self, index: int, sub: int, value: int) -> None:
        """Raises SdoAbortedError for a value that CiA 301 doesn't allow, or not now."""
        if index == self._mapping:
            self._check_mapping(sub, value)
        elif index == self._communication and sub == 1:
            self._check_identifier(value)
        elif index == self._communication:
            if self._strict and self._valid and sub in (2, 3, 5):
                raise SdoAbortedError(sdo.ABORT_APPLICATION_DEVICE_STATE)
            if sub == 2 and value not in _SYNCHRONOUS and value not in _EVENT_DRIVEN:
                raise SdoAbortedError(sdo.ABORT_INVALID_VALUE)

    @property
    def _sends(self) -> bool:
        return self._valid and self._length > 0

    def _load_events(self) -> None:
        read = self._objects.integer
        self._reports = bool(read(*_INTERRUPT_ENABLE, missing=1))
        for (index, sub), channel in self._channels.items():
            analogue = index >> 8 == _DELTA >> 8
            self._deltas[channel] = read(_DELTA, sub if analogue else channel + 1)

    def _load_mapping(self, entries: Sequence[_Entry]) -> None:
        self._length = (sum(entry.bits for entry in entries) + 7) // 8
        self._counts: list[tuple[int, int, int]] = []  # channel, first bit, mask
        self._others: list[tuple[Address, int, int]] = []
        at = 0
        for entry in entries:
            address, mask = (entry.index, entry.sub), (1 << entry.bits) - 1
            if address in self._channels:
                self._counts.append((self._channels[address], at, mask))
            elif entry.index not in _DUMMIES and address in self._objects:
                self._others.append((address, at, mask))
            at += entry.bits
        types = [self._objects.integer_type(*address) for address in self._channels]
        self.standard = tuple(self._counts) == _STANDARD and not self._others and types == [(16, True)] * 4
        self.message.dlc = self._length

    def _entries(self, count: int) -> list[_Entry]:
        raw = [self._objects.integer(self._mapping, sub) for sub in range(1, count + 1)]
        return [_Entry(value >> 16, value >> 8 & 0xFF, value & 0xFF) for value in raw]

    def _moved(self, counts: Sequence[int]) -> bool:
        """Whether a channel in it is further from what was sent last than its delta."""
        last, deltas = self._last, self._deltas
        if last is None or not self._reports:
            return False
        return any(abs(counts[c] - last[c]) > deltas[c] for c, _, _ in self._counts)

    def _fill(self, t_ns: int) -> can.Message:
        counts = self._sample()
        word = 0
        for channel, at, mask in self._counts:
            word |= (counts[channel] & mask) << at
        for address, at, mask in self._others:
            word |= (self._objects.integer(*address) & mask) << at
        self._last, self._sent_ns = counts, t_ns
        message = self.message
        message.data, message.dlc = bytearray(word.to_bytes(self._length, "little")), self._length
        return message

    def _check_identifier(self, value: int) -> None:
        identifier, valid = value & _IDENTIFIER, not value & _NOT_VALID
        beyond = value & ~_NOT_VALID & ~_NO_REMOTE & ~_IDENTIFIER  # 29-bit identifiers are not offered
        if beyond or (valid and any(identifier in taken for taken in _RESTRICTED)):
            raise SdoAbortedError(sdo.ABORT_INVALID_VALUE)
        if self._strict and self._valid and valid and identifier != self.message.arbitration_id:
            raise SdoAbortedError(sdo.ABORT_APPLICATION_DEVICE_STATE)

    def _check_mapping(self, sub: int, value: int) -> None:
        """CiA 301, 7.5.2.36: PDO off, count 0, entries, count, PDO on."""
        if self._valid or (sub and self._objects.integer(self._mapping, 0)):
            raise SdoAbortedError(sdo.ABORT_UNSUPPORTED_ACCESS)
        if sub:
            entry = _Entry(value >> 16, value >> 8 & 0xFF, value & 0xFF)
            if value and not self._mappable(entry):
                raise SdoAbortedError(sdo.ABORT_PDO_CANNOT_MAP)
            return
        if any((self._mapping, number) not in self._objects for number in range(1, value + 1)):
            raise SdoAbortedError(sdo.ABORT_PDO_LENGTH_EXCEEDED)
        entries = self._entries(value)
        if not all(map(self._mappable, entries)):
            raise SdoAbortedError(sdo.ABORT_PDO_CANNOT_MAP)
        if sum(entry.bits for entry in entries) > _PDO_BITS:
            raise SdoAbortedError(sdo.ABORT_PDO_LENGTH_EXCEEDED)

    def _mappable(self, entry: _Entry) -> bool:
        variable = self._objects.find(entry.index, entry.sub)
        if variable is None or len(variable) != entry.bits:
            return False
        return entry.index in _DUMMIES or bool(variable.pdo_mappable and variable.readable)
