"""Reading CAN frames from a socket in batches, by one `recvmmsg` each, with the kernel's receive stamps.

Public names: `FrameReader`, `PacketReader`, `RawFrame`, `enable_stamps`, `BATCH_FRAMES`.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
import time
from typing import NamedTuple

import can
import numpy as np
from can.interfaces.udp_multicast.utils import pack_message
from numpy.typing import NDArray

from handtouch.core.stages.receive import (
    CONTROL_WORDS,
    FRAME_WORDS,
    HEADER_WORDS,
    PACKET_WORDS,
    PATTERN_WORDS,
    FrameBatch,
    PacketMemory,
    frame_arrival_ns,
    unpack_packets,
)

BATCH_FRAMES = 256
"""Most frames of a batch."""

_SO_TIMESTAMPNS = 35
CAN_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of <linux/can.h>
_WORD_BYTES = 8
_VECTOR_WORD, _VECTORS_WORD, _CONTROL_WORD, _CONTROL_SIZE_WORD, _SIZE_WORD = 2, 3, 4, 5, 7
"""Words of a `struct mmsghdr`."""

# Keeps the GIL, as the call doesn't wait: getting it back may take another thread's switch interval.
_recvmmsg = ctypes.PyDLL(None, use_errno=True).recvmmsg
_recvmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]


class RawFrame(NamedTuple):
    """A frame as received: identifier with flags, data length code, data (8 bytes), bytes of the datagram,
    arrival on the monotonic clock."""

    can_id: int
    size: int
    data: bytes
    datagram_bytes: int
    arrival_ns: int


class FrameReader:
    """Reads datagrams of one `struct can_frame` each, from SocketCAN or any other socket that carries them.

    `batch` : the frames of the last `receive`
    """

    def __init__(self) -> None:
        self._headers = np.zeros((BATCH_FRAMES, HEADER_WORDS), dtype=np.int64)
        self._frames = np.zeros((BATCH_FRAMES, FRAME_WORDS), dtype=np.int64)
        self._control = np.zeros((BATCH_FRAMES, CONTROL_WORDS), dtype=np.int64)
        self._vectors = np.zeros((BATCH_FRAMES, 2), dtype=np.int64)  # struct iovec: address, size
        self._receive_to(self._frames)
        self._headers[:, _VECTOR_WORD] = _row_addresses(self._vectors)
        self._headers[:, _VECTORS_WORD] = 1
        self._headers[:, _CONTROL_WORD] = _row_addresses(self._control)
        self._headers[:, _CONTROL_SIZE_WORD] = _WORD_BYTES * CONTROL_WORDS
        self._address = self._headers.ctypes.data
        self._frame_bytes = self._frames.reshape(-1).data.cast("B")
        self.batch = FrameBatch(
            self._headers.reshape(-1).data, self._frames.reshape(-1).data, self._control.reshape(-1).data
        )

    def receive(self, descriptor: int, offset_ns: int, earliest_ns: int) -> int:
        """Read the waiting frames, at most BATCH_FRAMES, without blocking; return their number.

        `offset_ns` : monotonic minus wall clock; `earliest_ns` : no frame arrived before. Raises OSError.
        """
        count = int(_recvmmsg(descriptor, self._address, BATCH_FRAMES, socket.MSG_DONTWAIT, None))
        if count < 0:
            code = ctypes.get_errno()
            if code not in (errno.EAGAIN, errno.EINTR):
                raise OSError(code, os.strerror(code))
            return 0
        batch = self.batch
        batch.offset_ns, batch.earliest_ns, batch.latest_ns = offset_ns, earliest_ns, time.monotonic_ns()
        return count

    def _receive_to(self, rows: NDArray[np.int64]) -> None:
        """Have datagrams written to these rows (BATCH_FRAMES, words)."""
        self._vectors[:, 0] = _row_addresses(rows)
        self._vectors[:, 1] = _WORD_BYTES * rows.shape[1]

    def frame(self, number: int) -> RawFrame:
        """Return a frame of the last batch."""
        can_id, size, data = CAN_FRAME.unpack_from(self._frame_bytes, number * _WORD_BYTES * FRAME_WORDS)
        datagram_bytes = int(self._headers[number, _SIZE_WORD]) & 0xFFFFFFFF
        return RawFrame(can_id, size, data, datagram_bytes, frame_arrival_ns(self.batch, number))


class PacketReader(FrameReader):
    """Reads datagrams of one packet of python-can's udp_multicast each; longer ones are cut."""

    def __init__(self) -> None:
        super().__init__()
        rows = np.zeros((BATCH_FRAMES, PACKET_WORDS), dtype=np.int64)
        self._receive_to(rows)
        self._packets = _packet_memory(rows)
        self._packet_bytes = rows.reshape(-1).data.cast("B")

    def unpack(self, first: int, count: int) -> int:
        """Unpack packets of a batch of `count`, from `first` up to the next that isn't a plain data frame.

        Return its number, `count` without one. Those before are frames of the batch from then on.
        """
        return unpack_packets(self._packets, self.batch, first, count)

    def packet(self, number: int) -> tuple[bytes, int]:
        """Return a packet that wasn't unpacked, and its arrival on the monotonic clock."""
        size = int(self._headers[number, _SIZE_WORD]) & 0xFFFFFFFF
        start = number * _WORD_BYTES * PACKET_WORDS
        return bytes(self._packet_bytes[start : start + size]), frame_arrival_ns(self.batch, number)


def _packet_memory(rows: NDArray[np.int64]) -> PacketMemory:
    """Return rows of packets (packets, PACKET_WORDS), and how python-can packs data frames."""
    masks, patterns = np.zeros((2, 9, _WORD_BYTES * PATTERN_WORDS), dtype=np.uint8)
    for size in range(9):
        packed = pack_message(can.Message(arbitration_id=0x7FF, data=bytes(size), is_extended_id=False))
        stamp_at, id_at, data_at = (
            packed.index(before) + len(before) for before in (b"timestamp\xcb", b"_id\xcd", b"data\xc4")
        )
        data_at += 1  # after the size
        masks[size, : len(packed)] = 0xFF
        for at, count in ((stamp_at, 8), (id_at, 2), (data_at, size)):
            masks[size, at : at + count] = 0
        patterns[size, : len(packed)] = np.frombuffer(packed, dtype=np.uint8) & masks[size, : len(packed)]
    words = rows.reshape(-1)
    octets, flat_masks, flat_patterns = (
        words.view(np.uint8).data,
        masks.reshape(-1).view(np.int64).data,
        patterns.reshape(-1).view(np.int64).data,
    )
    return PacketMemory(words.data, octets, flat_masks, flat_patterns, len(packed) - size, id_at, data_at)


def enable_stamps(target: socket.socket) -> None:
    """Have the kernel stamp each frame that it receives for this socket. Raises OSError."""
    target.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def _row_addresses(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return rows.ctypes.data + rows.strides[0] * np.arange(len(rows))
