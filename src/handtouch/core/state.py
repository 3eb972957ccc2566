"""The state of a pipeline between two ticks: everything that survives a tick, in named arrays of one block.

Public names: `TickState`, `StateLayoutError`.

The parts of the tick hold views of these arrays and write them in place, so that the block's bytes are the
state. What isn't here follows from it and the model (`TickProcessor.refresh`), or is an input of the tick.
"""

from __future__ import annotations

import hashlib
import math
import typing
from dataclasses import dataclass, field, fields
from functools import cache, cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import BoolArray, FloatArray
from handtouch.core.memory import row_count, view_memory
from handtouch.core.stages.rows import (
    CONTACT_FRAMES,
    MISFIT_COUNT,
    PART_FRAMES,
    PART_ROW,
    SHEAR_CHANNELS,
    SLIP_ROW,
    VALUE_ROW,
)
from handtouch.sheet import BANK_MODELS, BANK_WINDOW
from handtouch.wire import PadState

VERSION = 3
"""Version of the fields' meanings; their names, types and shapes are in the hash of the layout."""
SHEET_ELEMENTS = SHEET_PLAYS = 8
LOAD_TERMS = 9
"""terms of a polynomial of the second degree in three numbers, without the constant"""
_ALIGNMENT = 64
_MAX_PAUSE_NS = 3600 * 10**9
_NEVER_SAMPLED_NS = 1 << 60

IntArray = NDArray[np.int64]
Uint8Array = NDArray[np.uint8]
Uint32Array = NDArray[np.uint32]


class StateLayoutError(ValueError):
    """A state was saved with another layout, number of pads or number of hands."""


class Stored:
    """Type, shape and first value of a field.

    shape: for each dimension "pads", "hands", "channels", "second sheets", a number, or a row of named
    numbers."""

    def __init__(self, dtype: str, *shape: int | str | np.dtype[np.void], fill: float = 0) -> None:
        self.shape = tuple(row_count(size) if isinstance(size, np.dtype) else size for size in shape)
        self.dtype, self.fill = np.dtype(dtype), fill


_PADS, _HANDS, _CHANNELS, _SECOND = "pads", "hands", "channels", "second sheets"
_USUAL_CHANNELS = 4


@dataclass(frozen=True)
class TickState:
    """State of `pads` pads on `hands` hands; made by `empty`. All arrays are views of `block`.

    channels: number of electrodes of the pad that has most. second: of the second sheets of pads with two, as
    of so many pads with one channel: their baselines and behaviour; None without any."""

    pads: int
    hands: int
    channels: int
    block: Uint8Array = field(repr=False)

    ticks: Annotated[IntArray, Stored("<i8", 1)]
    """number of ticks"""

    # samples
    pad_state: Annotated[Uint8Array, Stored("u1", _PADS, fill=PadState.STARTING)]
    """PadState"""
    sample_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    """SYNC of the newest sample, 0 before the first"""
    arrival_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    """arrival of the newest sample used"""
    sample_counts: Annotated[IntArray, Stored("<i8", _PADS)]
    """samples received"""
    missed_sample_counts: Annotated[IntArray, Stored("<i8", _PADS)]
    """expected samples that arrived after their tick or not at all"""
    synchronous: Annotated[BoolArray, Stored("?", _PADS, fill=1)]
    """pads sampled by SYNC; the others are event-driven and not waited for"""
    max_sample_period_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    """longest regular time between two samples"""
    silent_ns: Annotated[IntArray, Stored("<i8", _PADS, fill=_NEVER_SAMPLED_NS)]
    """time in which cycles began and the pad sent no sample, since its last one or a change of sampling; a
    cycle counts for one sample period at most, however long it was"""
    total_current_a: Annotated[FloatArray, Stored("<f8", _PADS)]
    """sum of the channels"""

    # contacts
    touching: Annotated[BoolArray, Stored("?", _PADS)]
    contact_id: Annotated[Uint32Array, Stored("<u4", _PADS)]
    """0 without contact"""
    next_contact_id: Annotated[IntArray, Stored("<i8", 1, fill=1)]
    begin_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    """first sample of the contact above the begin threshold"""
    first_sample_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    """first of the contradicting samples"""
    contradicting_samples: Annotated[IntArray, Stored("<i8", _PADS)]
    """successive samples against `touching`"""
    peak_force_n: Annotated[FloatArray, Stored("<f8", _PADS, fill=math.nan)]
    solved: Annotated[BoolArray, Stored("?", _PADS)]
    """contacts that were solved since they began and their outputs were requested"""
    values: Annotated[FloatArray, Stored("<f8", _PADS, VALUE_ROW, fill=math.nan)]
    """values of the contact's last solved sample, see `stages.solve.VALUE_ROW`"""
    parts: Annotated[FloatArray, Stored("<f8", _PADS, np.dtype((PART_ROW, 2)), fill=math.nan)]
    """of each pad the two contacts of that sample, see `stages.solve.PART_ROW`; NaN if there is one"""
    misfits: Annotated[FloatArray, Stored("<f8", _PADS, MISFIT_COUNT)]
    """squared misfits of the pad's contacts, see `ContactSolver`"""
    uncompensated_force_n: Annotated[FloatArray, Stored("<f8", _PADS, fill=math.nan)]
    uncompensated_std_n: Annotated[FloatArray, Stored("<f8", _PADS, fill=math.nan)]

    # requested outputs
    position_requested: Annotated[BoolArray, Stored("?", _PADS, fill=1)]
    force_requested: Annotated[BoolArray, Stored("?", _PADS, fill=1)]
    palm_requested: Annotated[BoolArray, Stored("?", _PADS)]
    base_requested: Annotated[BoolArray, Stored("?", _PADS)]
    update_interval_ticks: Annotated[IntArray, Stored("<i8", _PADS, fill=1)]
    ticks_per_hand_frame: Annotated[IntArray, Stored("<i8", 1, fill=1)]

    # baselines, see `Baseline`
    offset: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS)]
    offset_std: Annotated[FloatArray, Stored("<f8", _PADS)]
    noise_squared: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS)]
    held: Annotated[BoolArray, Stored("?", _PADS)]
    unverified: Annotated[BoolArray, Stored("?", _PADS, fill=1)]
    known: Annotated[BoolArray, Stored("?", _PADS)]
    block_touching: Annotated[BoolArray, Stored("?", _PADS)]
    """contacts when the last block ended"""
    drift_speed: Annotated[FloatArray, Stored("<f8", _PADS)]
    drift_until_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    drift_anchor: Annotated[FloatArray, Stored("<f8", _PADS)]
    drift_anchored_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    common_drift: Annotated[FloatArray, Stored("<f8", _HANDS)]
    # what orientation and acceleration of links do to them, see `LinkLoad`
    felt: Annotated[FloatArray, Stored("<f8", _PADS, 3)]
    load_terms: Annotated[FloatArray, Stored("<f8", _PADS, LOAD_TERMS)]
    smoothed_load_terms: Annotated[FloatArray, Stored("<f8", _PADS, LOAD_TERMS)]
    load_term_sum: Annotated[FloatArray, Stored("<f8", _PADS, LOAD_TERMS)]
    """since the last block"""
    load_term_count: Annotated[FloatArray, Stored("<f8", 1)]
    load_coefficients: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS, LOAD_TERMS)]
    load_covariance: Annotated[FloatArray, Stored("<f8", _PADS, LOAD_TERMS, LOAD_TERMS)]
    block_sum: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS)]
    block_squares: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS)]
    block_count: Annotated[FloatArray, Stored("<f8", _PADS)]
    block_begin_ns: Annotated[IntArray, Stored("<i8", 1, fill=-_MAX_PAUSE_NS)]
    blocks: Annotated[IntArray, Stored("<i8", 1)]
    span_sum: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS)]
    """of all samples since the last block, touched or not, of channels within their ranges, so that what
    moves an untouched pad beyond a threshold is measured, too"""
    span_squares: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS)]
    span_count: Annotated[FloatArray, Stored("<f8", _PADS)]
    span_low: Annotated[FloatArray, Stored("<f8", _PADS)]
    """least sum of the channels among these samples [counts]"""
    span_crossings: Annotated[FloatArray, Stored("<f8", _PADS)]
    """changes of the sum from above to below `span_level`, or back"""
    span_level: Annotated[FloatArray, Stored("<f8", _PADS)]
    """mean sum of the samples of the block before [counts]"""
    span_above: Annotated[BoolArray, Stored("?", _PADS)]
    """the last of these sums was above `span_level`"""
    earlier_disturbance: Annotated[FloatArray, Stored("<f8", _PADS, 2, _CHANNELS)]
    """of the two blocks before"""
    disturbance: Annotated[FloatArray, Stored("<f8", _PADS, _CHANNELS)]
    """amplitude of hum and noise [counts]"""
    peak_level: Annotated[FloatArray, Stored("<f8", _PADS)]
    """largest mean of the sum of the channels in a block since the contact began; 0 without one"""
    still_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    """time for which what is left of a contact has been still"""
    threshold_factor: Annotated[FloatArray, Stored("<f8", _PADS, fill=1)]
    """by which hum and noise raise the thresholds of contacts"""

    # compensation of sheet behaviour, see `SheetForceCompensation`
    compensated_force_n: Annotated[FloatArray, Stored("<f8", _PADS, fill=math.nan)]
    compensated_std_n: Annotated[FloatArray, Stored("<f8", _PADS, fill=math.nan)]
    relative_std: Annotated[FloatArray, Stored("<f8", _PADS, fill=math.nan)]
    force_reliability: Annotated[Uint8Array, Stored("u1", _PADS)]
    evidence_contacts: Annotated[IntArray, Stored("<i8", _PADS)]
    touched_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    touched_at_begin_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    last_touch_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    new_contact: Annotated[BoolArray, Stored("?", _PADS)]
    force_confirmed: Annotated[BoolArray, Stored("?", _PADS)]
    log_gain: Annotated[FloatArray, Stored("<f8", _PADS)]
    log_gain_std: Annotated[FloatArray, Stored("<f8", _PADS)]
    compared_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    sheets_updated_ns: Annotated[IntArray, Stored("<i8", 1)]
    uncertainty_waited_s: Annotated[FloatArray, Stored("<f8", 1)]
    # rows below are pads with a sheet model, ordered by their behaviour; then behaviours
    sheet_elements: Annotated[FloatArray, Stored("<f8", _PADS, SHEET_ELEMENTS)]
    sheet_plays: Annotated[FloatArray, Stored("<f8", _PADS, SHEET_PLAYS)]
    back_n: Annotated[FloatArray, Stored("<f8", _PADS)]
    back_std_n: Annotated[FloatArray, Stored("<f8", _PADS)]
    press_n: Annotated[FloatArray, Stored("<f8", _PADS)]
    current_flow_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    flow_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    impulse_ns: Annotated[FloatArray, Stored("<f8", _PADS)]
    powered: Annotated[BoolArray, Stored("?", _PADS, fill=1)]
    back_waited_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    load_is_old: Annotated[BoolArray, Stored("?", _PADS)]
    # models of these sheets, see `sheet.ModelBank`
    bank_log_weight: Annotated[FloatArray, Stored("<f8", _PADS, BANK_MODELS)]
    bank_back_n: Annotated[FloatArray, Stored("<f8", _PADS, BANK_MODELS)]
    bank_exponent: Annotated[FloatArray, Stored("<f8", _PADS, BANK_MODELS)]
    bank_exponent_variance: Annotated[FloatArray, Stored("<f8", _PADS, BANK_MODELS)]
    bank_sum: Annotated[FloatArray, Stored("<f8", _PADS, BANK_MODELS)]
    bank_before: Annotated[FloatArray, Stored("<f8", _PADS, BANK_MODELS, fill=math.nan)]
    bank_window: Annotated[FloatArray, Stored("<f8", _PADS, BANK_WINDOW)]
    bank_age_s: Annotated[FloatArray, Stored("<f8", _PADS)]
    bank_growth: Annotated[FloatArray, Stored("<f8", _PADS, fill=1)]

    # palm and base frames, see `ContactTransforms` and `ContactGroups`
    palm_status: Annotated[Uint8Array, Stored("u1", _PADS)]
    base_status: Annotated[Uint8Array, Stored("u1", _PADS)]
    palm_values: Annotated[FloatArray, Stored("<f8", _PADS, CONTACT_FRAMES, fill=math.nan)]
    """see `stages.rows.CONTACT_FRAMES`"""
    palm_rotation: Annotated[FloatArray, Stored("<f8", _PADS, 3, 3, fill=math.nan)]
    joint_variance_m2: Annotated[FloatArray, Stored("<f8", _PADS)]
    group_id: Annotated[Uint32Array, Stored("<u4", _PADS)]
    grouped_contact_id: Annotated[Uint32Array, Stored("<u4", _PADS)]
    grouped: Annotated[BoolArray, Stored("?", _PADS, _PADS)]

    # slip, see `SlipDetector`
    slip: Annotated[FloatArray, Stored("<f8", _PADS, SLIP_ROW)]
    """see `stages.rows.SLIP_ROW`"""
    slip_contact_id: Annotated[Uint32Array, Stored("<u4", _PADS)]
    slip_sample_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    slip_requested: Annotated[BoolArray, Stored("?", _PADS)]

    # shear pads, see `ShearForces`
    shear_sample_ns: Annotated[IntArray, Stored("<i8", _PADS)]
    """newest sample processed"""
    shear_rest_m: Annotated[FloatArray, Stored("<f8", _PADS, 3, fill=math.nan)]
    """motion at rest, x, y [m] and twist [rad]; NaN while it isn't known"""
    shear_rest_sum: Annotated[FloatArray, Stored("<f8", _PADS, SHEAR_CHANNELS)]
    """counts of untouched samples, to measure it"""
    shear_rest_samples: Annotated[IntArray, Stored("<i8", _PADS)]
    shear_peak_n: Annotated[FloatArray, Stored("<f8", _PADS)]
    """greatest tangential force since the rest position was measured, which bounds the hysteresis"""
    force_vector: Annotated[FloatArray, Stored("<f8", _PADS, 12, fill=math.nan)]
    """force in the link's frame and its covariance, row by row"""
    force_vector_status: Annotated[Uint8Array, Stored("u1", _PADS)]
    """ForceStatus"""
    frame_force_vector: Annotated[FloatArray, Stored("<f8", _PADS, 6, fill=math.nan)]
    """force in the palm's frame, then in the base's"""
    part_frames: Annotated[FloatArray, Stored("<f8", _PADS, np.dtype((PART_FRAMES, 2)), fill=math.nan)]
    """of two contacts on a pad, see `stages.rows.PART_FRAMES`"""

    # pads with two sheets, see `SecondSheets`
    second_count: Annotated[IntArray, Stored("<i8", _SECOND)]
    """last count of a second sheet's channel"""
    equal_samples: Annotated[IntArray, Stored("<i8", _SECOND)]
    """touched samples in a row with this count"""
    joint_force_n: Annotated[FloatArray, Stored("<f8", _SECOND, fill=math.nan)]
    """force by both sheets; NaN where the second isn't used"""
    joint_std_n: Annotated[FloatArray, Stored("<f8", _SECOND, fill=math.nan)]

    # messages
    contact_seq: Annotated[IntArray, Stored("<i8", _PADS)]
    frame_seq: Annotated[IntArray, Stored("<i8", 1)]
    frame_tick: Annotated[IntArray, Stored("<i8", 1)]
    frame_sync_ns: Annotated[IntArray, Stored("<i8", 1)]

    second: TickState | None = field(default=None, repr=False)

    @classmethod
    def empty(
        cls, pads: int, hands: int = 1, channels: int = _USUAL_CHANNELS, second_sheets: int = 0
    ) -> TickState:
        """Return the state before the first tick."""
        sizes = {_PADS: pads, _HANDS: hands, _CHANNELS: channels, _SECOND: second_sheets}
        places: list[tuple[str, Stored, tuple[int, ...], int]] = []
        end = 0
        for name, stored in _stored_fields():
            shape = tuple(sizes[size] if isinstance(size, str) else size for size in stored.shape)
            places.append((name, stored, shape, end))
            end += -(-math.prod(shape) * stored.dtype.itemsize // _ALIGNMENT) * _ALIGNMENT
        block: Uint8Array = np.zeros(end, dtype=np.uint8)
        arrays: dict[str, NDArray[Any]] = {}
        for name, stored, shape, begin in places:
            size = math.prod(shape) * stored.dtype.itemsize
            arrays[name] = block[begin : begin + size].view(stored.dtype).reshape(shape)
            arrays[name].fill(stored.fill)
        second = cls.empty(second_sheets, hands, channels=1) if second_sheets else None
        return cls(pads, hands, channels, block, **arrays, second=second)

    def layout(self) -> str:
        """Return version and hash of the declared fields, and the number of channels if it isn't four."""
        layout = _declared_layout()
        if self.channels != _USUAL_CHANNELS:
            layout += f", {self.channels} channels"
        return layout + (f", {self.second.pads} second sheets" if self.second else "")

    @cached_property
    def memory(self) -> dict[str, memoryview[Any]]:
        """Return the memory of the arrays by name, flat, as the stages take it."""
        return {name: view_memory(getattr(self, name)) for name, _ in _stored_fields()}

    def number_of(self, name: str) -> int:
        """Return the number of floats in the block before those of an array."""
        start, _ = np.lib.array_utils.byte_bounds(self.block)
        return int(np.lib.array_utils.byte_bounds(getattr(self, name))[0] - start) // 8

    def save(self) -> bytes:
        """Return the bytes of all arrays."""
        return self.block.tobytes() + (self.second.save() if self.second else b"")

    def load(self, saved: bytes, layout: str) -> None:
        """Write a saved state into the arrays. Raises StateLayoutError, changing nothing."""
        if layout != self.layout():
            raise StateLayoutError(
                f"the state has the layout {layout or 'none'}, this handtouch {self.layout()}"
            )
        size = len(self.block) + (len(self.second.block) if self.second else 0)
        if len(saved) != size:
            raise StateLayoutError(
                f"the state has {len(saved)} bytes, one of {self.pads} pads on {self.hands} hands has {size}"
            )
        whole = np.frombuffer(saved, dtype=np.uint8)
        self.block[:] = whole[: len(self.block)]
        if self.second:
            self.second.block[:] = whole[len(self.block) :]


@cache
def _declared_layout() -> str:
    fields_text = "\n".join(
        f"{name} {stored.dtype.str} "
        f"{tuple(_USUAL_CHANNELS if size == _CHANNELS else size for size in stored.shape)}"
        for name, stored in _stored_fields()
    )
    return f"{VERSION}-{hashlib.sha256(fields_text.encode()).hexdigest()[:12]}"


@cache
def _stored_fields() -> tuple[tuple[str, Stored], ...]:
    """Return the declared fields with their storage; evaluating the annotations takes 7 ms."""
    hints = typing.get_type_hints(TickState, include_extras=True)
    return tuple(
        (declared.name, about)
        for declared in fields(TickState)
        for about in getattr(hints[declared.name], "__metadata__", ())
    )
