"""Expected load of a CAN bus, from its bit rate, the pads on it and the periods of SYNC and heartbeat.

Public names: `frame_bits`, `bus_load`, `burst_s`. Every figure is the worst case of bit
stuffing, so a real bus carries somewhat less.
"""

from __future__ import annotations

SAMPLE_DATA_BYTES = 8
HEARTBEAT_DATA_BYTES = 1


def frame_bits(data_bytes: int) -> int:
    """Bits on the wire of a data frame with an 11-bit identifier, with interframe space and all stuff bits.

    44 bits of frame, 3 of space and 8 a byte; of these the first 34 + 8 a byte are stuffed, at worst after
    every fourth bit (ISO 11898-1). Raises ValueError outside 0 to 8 bytes.
    """
    if not 0 <= data_bytes <= 8:
        raise ValueError(f"a classic CAN frame has 0 to 8 bytes of data, not {data_bytes}")
    return 47 + 8 * data_bytes + (33 + 8 * data_bytes) // 4


def bus_load(bit_rate: float, pads: int, sync_period_s: float, heartbeat_s: float) -> float:
    """Fraction of a bus that SYNC, one sample of each pad per SYNC and the pads' heartbeats take (1: full).

    `bit_rate` in bit/s. Start-up (some 30 SDO frames a node) and foreign traffic come on top.
    """
    cycle = frame_bits(0) + pads * frame_bits(SAMPLE_DATA_BYTES)
    heartbeats = pads * frame_bits(HEARTBEAT_DATA_BYTES)
    return (cycle / sync_period_s + heartbeats / heartbeat_s) / bit_rate


def burst_s(bit_rate: float, pads: int) -> float:
    """Seconds from the start of SYNC until every pad's sample has passed, without other traffic."""
    return (frame_bits(0) + pads * frame_bits(SAMPLE_DATA_BYTES)) / bit_rate
