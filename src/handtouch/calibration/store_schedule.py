"""Schedule of storing baselines and sheet states, which the daemon tracks.

Public: `StoreSchedule`; `RestoredSheet`, read from a stored sheet state by `restored_sheet`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.calibration.calibration import (
    CalibrationVersion,
    Offsets,
    StoredSheetState,
    channel_values,
)
from handtouch.sheet import BANK_LEARNED, check_learned

_STORE_PERIOD_NS, _FIRST_STORE_DELAY_NS = 3_600_000_000_000, 60_000_000_000
"""Period of storing for one node, and delay of the first."""
_MIN_OFFSET_CHANGE = 2.0
"""Least change of a channel's offset that is stored, in counts and standard deviations of a reading."""
_MIN_BACK_FORCE_CHANGE = 0.1
"""Least relative change of the back force that is stored, of 1 N at least."""
_MIN_LEARNED_CHANGE = 0.5
"""Least change of a log likelihood of the sheet's models that is stored."""
_STATE_KIND, _STATE_VERSION = "back force", 2
"""Back force, its standard deviation, and what was learned; version 1 has the first two only."""
_SHEET_RECOVERY_S = 3600.0
"""Time constant of a sheet without potential, assumed since the state was stored."""


class TrackedState(Protocol):
    """Baselines and sheet states of n pads, as `ipc.SampleBlock` carries them."""

    @property
    def offset_counts(self) -> FloatArray:
        """Return the offsets (n, c), c channels of the pad with most."""

    @property
    def offset_std(self) -> FloatArray:
        """Return the standard deviations (n,) of their sums, NaN if unknown."""

    @property
    def noise_counts(self) -> FloatArray:
        """Return the noise of readings (n, c)."""

    @property
    def back_n(self) -> FloatArray:
        """Return the back forces (n,) [N], NaN if unknown."""

    @property
    def back_std_n(self) -> FloatArray:
        """Return the standard deviations (n,) [N] of the back forces."""

    @property
    def learned_pad(self) -> NDArray[np.int32]:
        """Return the pad () whose learned behaviour this is."""

    @property
    def learned(self) -> FloatArray:
        """Return the learned behaviour (`BANK_LEARNED`,) of its sheet, NaN if not modelled."""


class StoreSchedule:
    """Schedule of pads with numbers of `channels` (n,); `update_block` with every block."""

    def __init__(self, channels: Sequence[int]) -> None:
        self._block: TrackedState | None = None
        self._channels, pads = channels, len(channels)
        self._stored_offset_counts: FloatArray = np.full((pads, max(channels)), np.nan)
        self._stored_back_force_n = np.full(pads, np.nan)
        self._learned, self._stored_learned = np.full((2, pads, BANK_LEARNED), np.nan)
        self._next_ns = np.full(pads, -1, dtype=np.int64)

    def update_block(self, block: TrackedState) -> None:
        """Keep the newest state that the daemon tracks."""
        self._block = block
        self._learned[int(block.learned_pad)] = block.learned

    def reset_pad(self, pad: int) -> None:
        """Restart the schedule of a pad, whose node was replaced."""
        self._forget_stored(pad)
        self._learned[pad] = np.nan
        self._next_ns[pad] = -1

    def retry_pad(self, pad: int, now_ns: int) -> None:
        """Store a pad's parts again in a minute: they couldn't be written."""
        self._forget_stored(pad)
        self._next_ns[pad] = now_ns + _FIRST_STORE_DELAY_NS

    def _forget_stored(self, pad: int) -> None:
        self._stored_offset_counts[pad] = self._stored_back_force_n[pad] = self._stored_learned[pad] = np.nan

    def due_parts(
        self, pad: int, now_ns: int, last: bool = False
    ) -> tuple[Offsets | None, StoredSheetState | None]:
        """Return the parts to store now, None for unchanged ones; `last`: before the process ends."""
        if self._next_ns[pad] < 0:
            self._next_ns[pad] = now_ns + _FIRST_STORE_DELAY_NS
        if self._block is None or (now_ns < self._next_ns[pad] and not last):
            return None, None
        self._next_ns[pad] = now_ns + _STORE_PERIOD_NS
        return self._due_offsets(pad, self._block), self._due_sheet_state(pad, self._block)

    def _due_offsets(self, pad: int, block: TrackedState) -> Offsets | None:
        count, std = self._channels[pad], block.offset_std[pad]
        offset, noise = block.offset_counts[pad, :count], block.noise_counts[pad, :count]
        if not np.isfinite(std):
            return None
        moved = np.abs(offset - self._stored_offset_counts[pad, :count])
        if (moved < _MIN_OFFSET_CHANGE * np.maximum(1.0, noise)).all():  # False for NaN
            return None
        self._stored_offset_counts[pad, :count] = offset
        variance = np.full(count, std**2 / count)
        return Offsets(channel_values(offset), channel_values(variance), channel_values(noise))

    def _due_sheet_state(self, pad: int, block: TrackedState) -> StoredSheetState | None:
        back, std = float(block.back_n[pad]), float(block.back_std_n[pad])
        before = self._stored_back_force_n[pad]
        learned = self._learned[pad]
        if not (math.isfinite(back) and np.isfinite(learned).all()):
            return None
        is_known = np.abs(learned - self._stored_learned[pad]).max() < _MIN_LEARNED_CHANGE  # False for NaN
        if is_known and abs(back - before) < _MIN_BACK_FORCE_CHANGE * max(before, 1.0):
            return None
        self._stored_back_force_n[pad], self._stored_learned[pad] = back, learned
        numbers = msgpack.packb([back, std, *learned.tolist()])
        return StoredSheetState(_STATE_KIND, _STATE_VERSION, numbers)


class RestoredSheet(NamedTuple):
    """State of a sheet from a store: back force and its standard deviation [N], and what was learned of its
    behaviour, (`BANK_LEARNED`,) or empty."""

    back_n: float
    back_std_n: float
    learned: tuple[float, ...]


def restored_sheet(version: CalibrationVersion, away_s: float) -> RestoredSheet | None:
    """Return the state of a sheet away_s after it was stored; None if unknown."""
    state = version.calibration.sheet
    if state is None or state.kind != _STATE_KIND or state.version > _STATE_VERSION:
        return None
    try:
        back, std, *learned = map(float, _unpack_numbers(state.data))
        if learned:
            check_learned(learned)
    except (ValueError, TypeError):
        return None
    std = math.hypot(std, back * -math.expm1(-away_s / _SHEET_RECOVERY_S))
    return RestoredSheet(back, std, tuple(learned))


def _unpack_numbers(data: bytes) -> Any:
    try:
        return msgpack.unpackb(data)
    except msgpack.exceptions.UnpackException as error:
        raise ValueError("no msgpack") from error
