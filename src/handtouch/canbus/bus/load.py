"""Expected load of a CAN bus from its bit rate, its number of pads and the periods of SYNC and heartbeat.

Public names: `frame_bits`, `bus_load`, `burst_s`. All figures assume worst-case bit stuffing, so a real bus
carries somewhat less.
"""

from __future__ import annotations

SAMPLE_DATA_BYTES = 8
HEARTBEAT_DATA_BYTES = 1


def frame_bits(data_bytes: int) -> int:
    """Return the bits of a data frame with an 11-bit identifier, interframe space and all stuff bits.

    44 bits of frame, 3 of space and 8 a byte; of these the first 34 + 8 a byte are stuffed, at worst after
    every fourth bit (ISO 11898-1). Raises ValueError outside 0 to 8 bytes.
    """
    if not 0 <= data_bytes <= 8:
        raise ValueError(f"a classic CAN frame has 0 to 8 bytes of data, not {data_bytes}")
    return 47 + 8 * data_bytes + (33 + 8 * data_bytes) // 4


def bus_load(
    bit_rate: float, pads: int, sync_period_s: float, heartbeat_s: float, further_bits: int = 0
) -> float:
    """Return the bus load of SYNC, one sample of each pad per SYNC and the nodes' heartbeats (1: full).

    `bit_rate` in bit/s. further_bits: of second and later TPDOs, in each cycle. Start-up (some 30 SDO frames
    per node) and other traffic add to it."""
    cycle = frame_bits(0) + pads * frame_bits(SAMPLE_DATA_BYTES) + further_bits
    heartbeats = pads * frame_bits(HEARTBEAT_DATA_BYTES)
    return (cycle / sync_period_s + heartbeats / heartbeat_s) / bit_rate


def burst_s(bit_rate: float, pads: int, further_bits: int = 0) -> float:
    """Return the seconds from the start of SYNC to the end of the last sample, without other traffic."""
    return (frame_bits(0) + pads * frame_bits(SAMPLE_DATA_BYTES) + further_bits) / bit_rate
