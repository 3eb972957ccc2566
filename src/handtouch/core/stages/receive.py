"""Samples of a batch of CAN frames, stored in the slab's memory.

Public names: `SampleMemory`, `FrameBatch`, `PacketMemory`, `store_samples`, `unpack_packets`,
`frame_arrival_ns`, `begin_cycle`, `unpack_counts`, `HEADER_WORDS`, `FRAME_WORDS`, `CONTROL_WORDS`,
`PACKET_WORDS`, `PATTERN_WORDS`, `ROUTE_WORDS`, `FIELD_WORDS`. Memory is read in words of 64 bits; the layouts
are those of Linux on 64-bit little-endian processors.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_HEADER, _FRAME, _CONTROL, _ROUTE = 8, 9, 4, 2
HEADER_WORDS, FRAME_WORDS, CONTROL_WORDS, ROUTE_WORDS = _HEADER, _FRAME, _CONTROL, _ROUTE
"""Words of a `struct mmsghdr`, of the longest frame (`struct canfd_frame`), of a control message with a
`struct timespec`, and of a route."""
_PACKET, _PATTERN = 40, 21
PACKET_WORDS, PATTERN_WORDS = _PACKET, _PATTERN
"""Words that a packet with a frame may take, and of the longest that is unpacked here."""
_FIELD = 4
FIELD_WORDS = _FIELD
"""Words that describe a channel's field."""
_CONTROL_SIZE, _MESSAGE_SIZE = 5, 7  # words of a `struct mmsghdr`
_STAMP_BYTES = 32
_STAMP_KIND = 35 << 32 | 1  # SCM_TIMESTAMPNS of SOL_SOCKET
_FRAME_BYTES = 16
_DATA_BYTES, _IDENTIFIERS = 8, 0x800
_WORDS_OF_SLOT = 16
WORDS_OF_SLOT = _WORDS_OF_SLOT
"""Words of a slot's PDOs: the most that a pad's channels may be spread over, one for each of 16."""
_LOW_HALF = 0xFFFFFFFF


class SampleMemory:
    """Memory of a slab, `arrays` by their names; a row a slot.

    words: (slots WORDS_OF_SLOT,) PDOs. arrival_ns, repeat_counts, contrary_counts: (slots,). fresh: (slots,).
    single, contrary: (slots,), 1 where a sample is one PDO, and where two differed in this cycle.
    `new_fresh` and `stored_bytes` are those of the last call of `store_samples`. counts: (slots channels,),
    written by `unpack_counts`; of each, low_limits and high_limits, at which a channel is saturated, and
    fields (slots channels FIELD_WORDS,): index of its word, first bit, mask of its bits, and the value of its
    sign bit, 0 without sign.
    """

    def __init__(self, arrays: Mapping[str, Any]) -> None:
        self.words, self.arrival_ns = arrays["words"], arrays["arrival_ns"]
        self.repeat_counts, self.contrary_counts = arrays["repeat_counts"], arrays["contrary_counts"]
        self.fresh, self.single, self.contrary = arrays["fresh"], arrays["single"], arrays["contrary"]
        self.counts, self.fields = arrays["counts"], arrays["fields"]
        self.low_limits, self.high_limits = arrays["low_limits"], arrays["high_limits"]
        self.channels = len(self.counts) // max(len(self.arrival_ns), 1)
        self.new_fresh = self.stored_bytes = 0


class FrameBatch:
    """Memory that `recvmmsg` writes frames to: headers, frames and control messages, each a row a frame.

    Their stamps are of the wall clock: monotonic minus wall clock is `offset_ns`. An arrival isn't before
    `earliest_ns`, when the queue was last empty, nor after `latest_ns`, when the batch had been read; a step
    of the wall clock would falsify it.
    """

    def __init__(self, headers: memoryview[int], frames: memoryview[int], control: memoryview[int]) -> None:
        self.headers, self.frames, self.control = headers, frames, control
        self.offset_ns = self.earliest_ns = self.latest_ns = 0


class PacketMemory:
    """Packets with one frame each, as udp_multicast sends them, and what that of a data frame looks like.

    words: (packets PACKET_WORDS,), octets: the same memory in bytes. masks, patterns: (9 PATTERN_WORDS,), of
    packets of 0 to 8 bytes of data, bits that are alike in all, and their values; empty_size: bytes of one
    without data. id_at, data_at: bytes before the identifier (two bytes, big-endian) and the data.
    """

    def __init__(
        self,
        words: memoryview[int],
        octets: memoryview[int],
        masks: memoryview[int],
        patterns: memoryview[int],
        empty_size: int,
        id_at: int,
        data_at: int,
    ) -> None:
        self.words, self.octets, self.masks, self.patterns = words, octets, masks, patterns
        self.empty_size, self.id_at, self.data_at = empty_size, id_at, data_at


def unpack_packets(packets: PacketMemory, batch: FrameBatch, first: int, count: int) -> int:
    """Write the frames in packets of a batch of `count`, from `first` up to the next that looks otherwise, to
    the frames of the batch; return its number, `count` without one."""
    for i in range(first, count):
        size = (batch.headers[_HEADER * i + _MESSAGE_SIZE] & _LOW_HALF) - packets.empty_size
        if size < 0 or size > _DATA_BYTES:
            return i
        for k in range(_PATTERN):
            masked = packets.words[_PACKET * i + k] & packets.masks[_PATTERN * size + k]
            if masked != packets.patterns[_PATTERN * size + k]:
                return i
        begin = 8 * _PACKET * i
        can_id = 256 * packets.octets[begin + packets.id_at] + packets.octets[begin + packets.id_at + 1]
        if can_id >= _IDENTIFIERS:
            return i
        data, scale = 0, 1
        for k in range(size):
            octet = packets.octets[begin + packets.data_at + k]
            if k == _DATA_BYTES - 1 and octet >= 128:
                octet -= 256
            data += octet * scale
            scale = scale * 256 if k < _DATA_BYTES - 1 else scale
        batch.frames[_FRAME * i] = can_id + (size << 32)
        batch.frames[_FRAME * i + 1] = data
        batch.headers[_HEADER * i + _MESSAGE_SIZE] = _FRAME_BYTES
    return count


def store_samples(
    memory: SampleMemory, batch: FrameBatch, routes: memoryview[int], first: int, count: int
) -> int:
    """Store the samples of a batch of `count` frames, from frame `first` up to the next that is no sample.

    routes: (2048 ROUTE_WORDS,) by identifier, slot (-1: none) and bytes of data. Return the number of the
    frame that is no sample, `count` if all were; a frame shorter than its route's is no sample, nor is one
    of several PDOs of a sample.
    """
    memory.new_fresh = memory.stored_bytes = 0
    for i in range(first, count):
        head = batch.frames[_FRAME * i]
        can_id = head & _LOW_HALF
        message_size = batch.headers[_HEADER * i + _MESSAGE_SIZE] & _LOW_HALF
        if can_id >= _IDENTIFIERS or message_size != _FRAME_BYTES:
            return i
        slot, size = routes[_ROUTE * can_id], routes[_ROUTE * can_id + 1]
        length = head >> 32 & 0xFF
        if slot < 0 or length < size or length > _DATA_BYTES or not memory.single[slot]:
            return i
        if memory.fresh[slot] and memory.words[_WORDS_OF_SLOT * slot] != batch.frames[_FRAME * i + 1]:
            memory.contrary[slot] = 1
        memory.words[_WORDS_OF_SLOT * slot] = batch.frames[_FRAME * i + 1]
        memory.arrival_ns[slot] = frame_arrival_ns(batch, i)
        if memory.fresh[slot]:
            memory.repeat_counts[slot] += 1
        else:
            memory.fresh[slot] = 1
            memory.new_fresh += 1
        memory.stored_bytes += length
    return count


def begin_cycle(memory: SampleMemory, sync_ns: int) -> int:
    """Mark the samples that arrived since a SYNC as fresh; return their number."""
    count = 0
    for slot in range(len(memory.arrival_ns)):
        memory.contrary_counts[slot] += memory.contrary[slot]
        memory.contrary[slot] = 0
        memory.fresh[slot] = 1 if memory.arrival_ns[slot] >= sync_ns else 0
        count += memory.fresh[slot]
    return count


def unpack_counts(memory: SampleMemory) -> None:
    """Unpack all channels; of a REAL32 field, its bits as an integer."""
    for i in range(len(memory.counts)):
        field = _FIELD * i
        count = memory.words[memory.fields[field]] >> memory.fields[field + 1] & memory.fields[field + 2]
        if count & memory.fields[field + 3]:
            count -= 2 * memory.fields[field + 3]
        memory.counts[i] = count


def frame_arrival_ns(batch: FrameBatch, i: int) -> int:
    """Return the arrival of a frame on the monotonic clock; prepare its header for the next batch."""
    header, control = _HEADER * i, _CONTROL * i
    if batch.headers[header + _CONTROL_SIZE] != _STAMP_BYTES:  # it has no stamp
        batch.headers[header + _CONTROL_SIZE] = _STAMP_BYTES
        batch.control[control + 1] = 0
    arrival_ns = batch.latest_ns
    if batch.control[control + 1] == _STAMP_KIND:
        arrival_ns = batch.control[control + 2] * 1_000_000_000 + batch.control[control + 3] + batch.offset_ns
    if arrival_ns < batch.earliest_ns:
        return batch.earliest_ns
    return arrival_ns if arrival_ns < batch.latest_ns else batch.latest_ns
