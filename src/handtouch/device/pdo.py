"""One TPDO of a node: its transmission and contents by objects 0x1800 and 0x1A00 (+ number - 1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import can
from canopen.sdo import SdoAbortedError
from canopen.sdo import constants as sdo

from handtouch.canbus import cia301
from handtouch.config.eds import TpdoDefault
from handtouch.device.object_values import Address, ObjectValues

_INTERRUPT_ENABLE, _DELTA = (0x6423, 0), 0x6426
"""CiA 401: analogue input global interrupt enable; interrupt delta, one sub-index per input [counts]."""
_INHIBIT_UNIT_NS, _EVENT_UNIT_NS = 100_000, 1_000_000
_PDO_BITS = 8 * cia301.PDO_BYTES
_RESTRICTED_IDENTIFIERS = (
    range(0x80),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x800),
)
_STANDARD_LAYOUT = ((0, 0, 0xFFFF), (1, 16, 0xFFFF), (2, 32, 0xFFFF), (3, 48, 0xFFFF))


_Entry = tuple[int, int, int]
"""Entry of a PDO mapping: index, sub-index, bits."""


class DeviceTpdo:
    """TPDO of a simulated node.

    `period_syncs` is its period in SYNCs, 0 if it isn't cyclic; `has_standard_layout` is true for the four
    channels in order as int16.
    """

    def __init__(
        self,
        default: TpdoDefault,
        objects: ObjectValues,
        channels: Mapping[Address, int],
        sample: Callable[[], Sequence[int]],
        encode: Callable[[int, int], int],
        strict: bool,
    ) -> None:
        """Set the defaults of its objects.

        `default` : its state after power-on
        `channels` : the objects of the channels
        `sample` : returns the counts of the channels
        `encode` : bits of a channel at a count, as in its object
        `strict` : refuse changes while it is valid
        """
        self.message = can.Message(is_extended_id=False, data=bytes(8))
        self._communication = cia301.TPDO_COMMUNICATION + default.number - 1
        self._mapping = cia301.TPDO_MAPPING + default.number - 1
        self._objects, self._channels, self._sample, self._is_strict = objects, channels, sample, strict
        self._encode = encode
        self._deltas = [0] * len(channels)
        cob_id = default.cob_id | objects.get_integer(self._communication, 1) & cia301.NO_RTR_BIT
        self._defaults = (
            cob_id if default.enabled else cob_id | cia301.INVALID_BIT,
            default.transmission_type,
            len(default.entries),
        )
        addresses = ((self._communication, 1), (self._communication, 2), (self._mapping, 0))
        for (index, sub), value in zip(addresses, self._defaults, strict=True):
            objects.set_default(index, sub, value)

    def load_settings(self) -> None:
        """Load the settings from the objects."""
        record, read = self._communication, self._objects.get_integer
        cob_id, self._transmission_type, count = self._defaults  # for a node without the object
        cob_id, self._transmission_type = read(record, 1, cob_id), read(record, 2, self._transmission_type)
        self._is_valid = not cob_id & cia301.INVALID_BIT
        self.message.arbitration_id = cob_id & cia301.IDENTIFIER_MASK
        self._inhibit_ns = read(record, 3) * _INHIBIT_UNIT_NS
        self._event_ns = read(record, 5) * _EVENT_UNIT_NS
        self._start_count = read(record, cia301.SYNC_START_SUB)
        self._load_events()
        self._load_mapping(self._read_entries(read(self._mapping, 0, count)))
        self.period_syncs = (
            self._transmission_type
            if self._is_valid and self._transmission_type in cia301.SYNCHRONOUS_TYPES
            else 0
        )
        self.reset_history()

    def handle_write(self, index: int) -> None:
        """Reload the settings after a write to an object with this index."""
        if index in (self._communication, self._mapping):
            self.load_settings()
        elif index in (_INTERRUPT_ENABLE[0], _DELTA):
            self._load_events()

    def reset_history(self) -> None:
        """Forget the data sent, when the node is started or the PDO changed."""
        self._sync_count = 0
        self._last_counts: Sequence[int] | None = None
        self._sent_ns = 0

    @property
    def is_sync_driven(self) -> bool:
        """True if it is sent by SYNC."""
        return self._is_enabled and self._transmission_type in cia301.SYNCHRONOUS_TYPES

    @property
    def is_event_driven(self) -> bool:
        """True if it is sent by a change or the event timer."""
        return self._is_enabled and self._transmission_type in cia301.EVENT_DRIVEN_TYPES

    def make_sync_message(self, now_ns: int, counter: int | None = None) -> can.Message | None:
        """Return the message to send at a SYNC: for type 0 after a change, for type n at each n-th.

        counter: that of the SYNC, if it has one. With a SYNC start value and 0x1019 it decides which are the
        n-th, so that a lost SYNC doesn't shift them; without a counter none is.
        """
        if self._transmission_type == 0:
            has_changed = self._last_counts is None or self._exceeds_delta(self._sample())
            return self._make_message(now_ns) if has_changed else None
        if self._start_count and self._objects.get_integer(cia301.SYNC_OVERFLOW, 0):
            if counter is None or (counter - self._start_count) % self._transmission_type:
                return None
            return self._make_message(now_ns)
        self._sync_count += 1
        if self._sync_count < self._transmission_type:
            return None
        self._sync_count = 0
        return self._make_message(now_ns)

    def make_event_message(self, now_ns: int) -> can.Message | None:
        """Return the message of an event: the first one, a change, or the end of the event timer."""
        if self._last_counts is None:
            return self._make_message(now_ns)
        elapsed_ns = now_ns - self._sent_ns
        expired = 0 < self._event_ns <= elapsed_ns
        if elapsed_ns < self._inhibit_ns or not (expired or self._exceeds_delta(self._sample())):
            return None
        return self._make_message(now_ns)

    def check_write(self, index: int, sub: int, value: int) -> None:
        """Raise SdoAbortedError for a value that CiA 301 doesn't allow in the present state."""
        if index == self._mapping:
            self._check_mapping(sub, value)
        elif index == self._communication and sub == 1:
            self._check_identifier(value)
        elif index == self._communication:
            if self._is_strict and self._is_valid and sub in (2, 3, 5, cia301.SYNC_START_SUB):
                raise SdoAbortedError(sdo.ABORT_APPLICATION_DEVICE_STATE)
            if sub == 2 and value not in cia301.SYNCHRONOUS_TYPES and value not in cia301.EVENT_DRIVEN_TYPES:
                raise SdoAbortedError(sdo.ABORT_INVALID_VALUE)

    @property
    def _is_enabled(self) -> bool:
        return self._is_valid and self._length > 0

    def _load_events(self) -> None:
        read = self._objects.get_integer
        self._interrupt_enabled = bool(read(*_INTERRUPT_ENABLE, missing=1))
        for (index, sub), channel in self._channels.items():
            analogue = index >> 8 == _DELTA >> 8
            self._deltas[channel] = read(_DELTA, sub if analogue else channel + 1)

    def _load_mapping(self, entries: Sequence[_Entry]) -> None:
        self._length = (sum(bits for _, _, bits in entries) + 7) // 8
        self._channel_entries: list[tuple[int, int, int]] = []  # channel, first bit, mask
        self._object_entries: list[tuple[Address, int, int]] = []
        first_bit = 0
        for index, sub, bits in entries:
            address, mask = (index, sub), (1 << bits) - 1
            if address in self._channels:
                self._channel_entries.append((self._channels[address], first_bit, mask))
            elif index not in cia301.DUMMY_ENTRIES and address in self._objects:
                self._object_entries.append((address, first_bit, mask))
            first_bit += bits
        types = [self._objects.integer_type(*address) for address in self._channels]
        self.has_standard_layout = (
            tuple(self._channel_entries) == _STANDARD_LAYOUT
            and not self._object_entries
            and types == [(16, True)] * 4
        )
        self.message.dlc = self._length

    def _read_entries(self, count: int) -> list[_Entry]:
        raw = [self._objects.get_integer(self._mapping, sub) for sub in range(1, count + 1)]
        return [_entry(value) for value in raw]

    def _exceeds_delta(self, counts: Sequence[int]) -> bool:
        """Return True if a channel differs from the last value sent by more than its delta."""
        last, deltas = self._last_counts, self._deltas
        if last is None or not self._interrupt_enabled:
            return False
        return any(abs(counts[c] - last[c]) > deltas[c] for c, _, _ in self._channel_entries)

    def _make_message(self, now_ns: int) -> can.Message:
        counts = self._sample()
        word = 0
        for channel, first_bit, mask in self._channel_entries:
            word |= (self._encode(channel, counts[channel]) & mask) << first_bit
        for address, first_bit, mask in self._object_entries:
            word |= (self._objects.get_integer(*address) & mask) << first_bit
        self._last_counts, self._sent_ns = counts, now_ns
        message = self.message
        message.data, message.dlc = bytearray(word.to_bytes(self._length, "little")), self._length
        return message

    def _check_identifier(self, value: int) -> None:
        identifier, valid = value & cia301.IDENTIFIER_MASK, not value & cia301.INVALID_BIT
        # 29-bit identifiers are not supported
        unsupported = value & ~cia301.INVALID_BIT & ~cia301.NO_RTR_BIT & ~cia301.IDENTIFIER_MASK
        if unsupported or (valid and any(identifier in ids for ids in _RESTRICTED_IDENTIFIERS)):
            raise SdoAbortedError(sdo.ABORT_INVALID_VALUE)
        if self._is_strict and self._is_valid and valid and identifier != self.message.arbitration_id:
            raise SdoAbortedError(sdo.ABORT_APPLICATION_DEVICE_STATE)

    def _check_mapping(self, sub: int, value: int) -> None:
        """Check the order of CiA 301, 7.5.2.36: disable the PDO, count 0, entries, count, enable the PDO."""
        if self._is_valid or (sub and self._objects.get_integer(self._mapping, 0)):
            raise SdoAbortedError(sdo.ABORT_UNSUPPORTED_ACCESS)
        if sub:
            if value and not self._is_mappable(_entry(value)):
                raise SdoAbortedError(sdo.ABORT_PDO_CANNOT_MAP)
            return
        if any((self._mapping, number) not in self._objects for number in range(1, value + 1)):
            raise SdoAbortedError(sdo.ABORT_PDO_LENGTH_EXCEEDED)
        entries = self._read_entries(value)
        if not all(map(self._is_mappable, entries)):
            raise SdoAbortedError(sdo.ABORT_PDO_CANNOT_MAP)
        if sum(bits for _, _, bits in entries) > _PDO_BITS:
            raise SdoAbortedError(sdo.ABORT_PDO_LENGTH_EXCEEDED)

    def _is_mappable(self, entry: _Entry) -> bool:
        index, sub, bits = entry
        variable = self._objects.find_variable(index, sub)
        if variable is None or len(variable) != bits:
            return False
        return index in cia301.DUMMY_ENTRIES or bool(variable.pdo_mappable and variable.readable)


def _entry(value: int) -> _Entry:
    return value >> 16, value >> 8 & 0xFF, value & 0xFF
