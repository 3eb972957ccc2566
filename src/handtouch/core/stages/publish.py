"""Output of a tick's contacts: columns with statuses, NaN where there is no value, and contact messages as
msgpack, whose bytes are those of the codec of `handtouch.wire`.

Public names: `ContactColumns`, `ContactEncoder`, `FIELD_KINDS`, `CONDITIONS`, `INTEGERS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handtouch.core.memory import row_count
from handtouch.core.pad_tables import MAX_SQUARED_MISFIT
from handtouch.core.stages.force import BOUNDED, WIDE
from handtouch.core.stages.frames import FRAME_ROW, PART_FRAMES
from handtouch.core.stages.solve import PARTS_COUNT, VALUE_COUNT, VALUE_SLICES
from handtouch.wire.status import MAX_SILENT_PERIODS, ForceStatus, FrameStatus, PositionStatus

_VALUES = VALUE_COUNT
_PAD_M, _POSITION, _NORMAL = (VALUE_SLICES[name].start for name in ("pad_m", "position_m", "normal"))
_COVARIANCE, _MOUNT = VALUE_SLICES["covariance_m2"].start, VALUE_SLICES["mount_covariance_m2"].start
_FORCE, _FORCE_STD = VALUE_SLICES["force_n"].start, VALUE_SLICES["force_std_n"].start
_ESTIMATE, _MISFIT = VALUE_SLICES["force_status"].start, VALUE_SLICES["squared_misfit"].start
_IS_BOUND, _MAX_SQUARED_MISFIT = VALUE_SLICES["is_bound"].start, MAX_SQUARED_MISFIT
_BOUNDED_ESTIMATE, _WIDE_ESTIMATE = float(BOUNDED), float(WIDE)
_NAN, _INFINITY = float("nan"), float("inf")
_NOT_COMPUTED, _POSITION_VALID, _POSITION_UNRELIABLE, _POSITION_INVALID = map(int, PositionStatus)
_NOT_COMPUTED, _FORCE_VALID, _FORCE_LOWER_BOUND, _FORCE_UNRELIABLE, _FORCE_INVALID = map(int, ForceStatus)
_EVIDENCE_MISSING = 0  # ForceReliability.UNRELIABLE
_FRAME_VALID = int(FrameStatus.VALID)
_END = 2  # number of the event
_HEADER_BYTES, _NUMBER_BYTES, _ROW_COUNT, _VALUE_NUMBERS = 3, 9, 6, 3
_FRAME_VALUES, _PART_FRAMES = row_count(FRAME_ROW), row_count(PART_FRAMES)
_PARTS_COUNT = PARTS_COUNT
_MAX_SILENT_PERIODS = MAX_SILENT_PERIODS
_SECONDS_PER_NS = 1e-9

FIELD_KINDS = "integer", "seconds", "name", "truth", "numbers", "covariance", "whole", "text", "parts"
"""How a field is written: four kinds from one of INTEGERS; from the memory of the state; as that, plus the
covariance of the mount; as a whole number of it; as a text of the pad; as the two contacts of a pad."""
_INTEGER, _SECONDS, _NAME, _TRUTH, _NUMBERS, _SUM, _WHOLE, _TEXT, _PARTS = range(len(FIELD_KINDS))
CONDITIONS = (
    "always", "located", "std", "frames", "palm", "base", "modelled", "vector", "part_palm", "part_base",
)  # fmt: skip
"""What a contact must have for a field of numbers not to be nil or absent: a position; the standard deviation
of its force; requested frames; a position in the palm; in the base; a sheet with a model; a force vector; of
one of two contacts, a position in the palm; in the base."""
_ALWAYS, _LOCATED, _STD, _FRAMES, _PALM, _BASE, _MODELLED, _VECTOR, _PART_PALM, _PART_BASE = range(
    len(CONDITIONS)
)
INTEGERS = (
    "seq", "t_ns", "event", "id", "begin_ns", "position_status", "force_status", "end_reason", "retained",
    "group", "palm_status", "base_status", "fresh", "force_vector_status", "duration_s", "age_s",
)  # fmt: skip
"""Integers, truth values, numbers of names, and durations in nanoseconds."""
(
    _SEQ, _T, _EVENT, _ID, _BEGIN, _POSITION_STATUS, _FORCE_STATUS, _REASON, _RETAINED,
    _GROUP, _PALM_STATUS, _BASE_STATUS, _FRESH, _VECTOR_STATUS, _DURATION, _AGE,
) = range(len(INTEGERS))  # fmt: skip


class ContactColumns:
    """Columns of n pads. arrays: flat memory of the arrays of `TickState` by their names.

    Among them are also position_unreliable, (n,) of the model; value_columns, (3 m,) of each of m published
    values the number of those before its column, that of its column, and its place in a row of values; and
    what is written: published (n m,), published_current_a, position_status and force_status (n,).
    """

    def __init__(self, pads: int, arrays: Mapping[str, Any]) -> None:
        self.pads, self.position_unreliable = pads, arrays["position_unreliable"]
        self.value_columns = arrays["value_columns"]
        self.count = len(self.value_columns) // _VALUE_NUMBERS
        self.published, self.published_current_a = arrays["published"], arrays["published_current_a"]
        self.total_current_a = arrays["total_current_a"]
        self.position_status, self.force_status = arrays["position_status"], arrays["force_status"]
        self.contact_id, self.solved, self.values = arrays["contact_id"], arrays["solved"], arrays["values"]
        self.position_requested = arrays["position_requested"]
        self.force_requested = arrays["force_requested"]
        self.uncompensated_force_n = arrays["uncompensated_force_n"]
        self.uncompensated_std_n = arrays["uncompensated_std_n"]
        self.known, self.reliability = arrays["known"], arrays["force_reliability"]
        self.peak_force_n = arrays["peak_force_n"]

    def store_solved(self, pads: memoryview[int]) -> None:
        """Note that these contacts were solved; keep their forces, which compensation replaces."""
        for k in range(len(pads)):
            pad = pads[k]
            self.solved[pad] = 1
            self.uncompensated_force_n[pad] = self.values[pad * _VALUES + _FORCE]
            self.uncompensated_std_n[pad] = self.values[pad * _VALUES + _FORCE_STD]

    def publish(self) -> None:
        """Write columns and statuses of all pads, and the greatest forces of contacts.

        A contact that ended is published until its id is cleared.
        """
        for pad in range(self.pads):
            self.published_current_a[pad] = self.total_current_a[pad]
            if self.contact_id[pad] != 0 and self.solved[pad]:
                _publish_contact(self, pad)
            elif self.position_status[pad] != _NOT_COMPUTED or self.force_status[pad] != _NOT_COMPUTED:
                self.position_status[pad] = self.force_status[pad] = _NOT_COMPUTED
                for i in range(self.count):
                    self.published[_published_index(self, pad, i)] = _NAN


def _published_index(columns: ContactColumns, pad: int, i: int) -> int:
    """Return the position of a pad's value i in the published columns."""
    before = columns.value_columns[_VALUE_NUMBERS * i]
    width = columns.value_columns[_VALUE_NUMBERS * i + 1]
    index: int = columns.pads * before + pad * width + i - before
    return index


def _are_finite(values: memoryview[float], first: int, count: int) -> bool:
    """Return True if all of these values are finite."""
    finite = True
    for i in range(first, first + count):
        if not -_INFINITY < values[i] < _INFINITY:
            finite = False
    return finite


def _publish_contact(columns: ContactColumns, pad: int) -> None:
    values, first = columns.values, pad * _VALUES
    has_mount = _are_finite(values, first + _MOUNT, 9)
    for i in range(columns.count):
        at = columns.value_columns[_VALUE_NUMBERS * i + 2]
        value = values[first + at]
        if has_mount and _COVARIANCE <= at < _COVARIANCE + 9:
            value += values[first + _MOUNT + at - _COVARIANCE]
        columns.published[_published_index(columns, pad, i)] = (
            value if -_INFINITY < value < _INFINITY else _NAN
        )
    located = _are_finite(values, first + _PAD_M, 2) and _are_finite(values, first + _POSITION, 6)
    position = _POSITION_INVALID if columns.position_requested[pad] else _NOT_COMPUTED
    if located:
        no_point = values[first + _MISFIT] > _MAX_SQUARED_MISFIT or values[first + _IS_BOUND] != 0.0
        position = _POSITION_VALID
        if no_point or columns.position_unreliable[pad]:
            position = _POSITION_UNRELIABLE
    columns.position_status[pad] = position
    value = values[first + _FORCE]
    force = _NOT_COMPUTED
    if columns.force_requested[pad]:
        force = _FORCE_VALID
        if not -_INFINITY < value < _INFINITY:
            force = _FORCE_INVALID
        elif values[first + _ESTIMATE] == _BOUNDED_ESTIMATE:
            force = _FORCE_LOWER_BOUND
        elif not columns.known[pad] or columns.reliability[pad] == _EVIDENCE_MISSING:
            force = _FORCE_UNRELIABLE
        is_odd = values[first + _ESTIMATE] == _WIDE_ESTIMATE or values[first + _MISFIT] > _MAX_SQUARED_MISFIT
        if force == _FORCE_VALID and is_odd:
            force = _FORCE_UNRELIABLE
    columns.force_status[pad] = force
    if value == value and not columns.peak_force_n[pad] >= value:
        columns.peak_force_n[pad] = value


class ContactEncoder:
    """Encoder of contact messages. arrays: flat memory of the arrays of `TickState` by their names.

    Among them are also `state`, the memory of all of them as numbers; position_status, force_status and
    has_sheet_model, (n,) of the pads; texts, packed keys of the fields, then names, and text_ends, where each
    begins, and the last ends; pad_texts, packed fields of the pads with keys, empty where they are absent,
    and pad_text_ends; message, which is written; and working memory: summed (9,), integers and conditions.
    state_bits, summed_bits: the numbers of state and summed as integers of their bits.

    layout: (6 m,), of each field its number in FIELD_KINDS; that in CONDITIONS; 0 if it is always present, 1
    if it is absent where it is unknown, 2 where its condition isn't met; of numbers their first place in the
    state, the step from one pad to the next, and their count, 0 of a single number; of others the first of
    their names, their default, and their number in INTEGERS. Behind the `fields` of a contact are those of
    one of two contacts on a pad, with the step from one to the next. first_value: place in the state of the
    first row of values.
    """

    def __init__(self, fields: int, pad_text_count: int, first_value: int, arrays: Mapping[str, Any]) -> None:
        self.row_count, self.pad_text_count, self.first_value = fields, pad_text_count, first_value
        self.layout, self.state, self.summed = arrays["layout"], arrays["state"], arrays["summed"]
        self.integers, self.conditions = arrays["integers"], arrays["conditions"]
        self.part_rows = len(self.layout) // _ROW_COUNT - fields
        self.position_status, self.force_status = arrays["position_status"], arrays["force_status"]
        self.has_sheet_model = arrays["has_sheet_model"]
        self.texts, self.text_ends = arrays["texts"], arrays["text_ends"]
        self.pad_texts, self.pad_text_ends = arrays["pad_texts"], arrays["pad_text_ends"]
        self.state_bits, self.summed_bits = arrays["state_bits"], arrays["summed_bits"]
        self.message = arrays["message"]
        self.contact_seq, self.contact_id = arrays["contact_seq"], arrays["contact_id"]
        self.sample_ns, self.begin_ns = arrays["sample_ns"], arrays["begin_ns"]
        self.group_id = arrays["group_id"]
        self.silent_ns, self.synchronous = arrays["silent_ns"], arrays["synchronous"]
        self.max_sample_period_ns = arrays["max_sample_period_ns"]
        self.palm_requested, self.base_requested = arrays["palm_requested"], arrays["base_requested"]
        self.palm_status, self.base_status = arrays["palm_status"], arrays["base_status"]
        self.vector_status, self.parts = arrays["force_vector_status"], arrays["parts"]
        self.part_frames = arrays["part_frames"]
        self.written = self.fields = 0

    def encode_contact(
        self, pad: int, event: int, sync_ns: int, now_ns: int, end_reason: int, retained: bool
    ) -> int:
        """Write the message of a contact; return its size in bytes.

        event: 0 begin, 1 update, 2 end. sync_ns: of the tick in which the contact ended. end_reason: number
        of its name.
        """
        sample_ns, begin_ns = self.sample_ns[pad], self.begin_ns[pad]
        t_ns = sync_ns if event == _END else sample_ns
        self.integers[_SEQ], self.integers[_T], self.integers[_EVENT] = self.contact_seq[pad], t_ns, event
        self.integers[_ID], self.integers[_BEGIN] = self.contact_id[pad], begin_ns
        self.integers[_DURATION], self.integers[_AGE] = t_ns - begin_ns, now_ns - sample_ns
        self.integers[_REASON], self.integers[_RETAINED] = end_reason, retained
        self.integers[_FRESH] = _is_fresh(self, pad)
        _read_statuses(self, pad)
        self.written, self.fields = _HEADER_BYTES, 2  # v and session are with the first key
        for row in range(self.row_count):
            _write_field(self, row, pad, pad)
        self.message[0], self.message[1], self.message[2] = 0xDE, 0, self.fields
        return self.written


def _is_fresh(encoder: ContactEncoder, pad: int) -> bool:
    """Return False while samples of a pad are missing."""
    max_silent_ns = 0 if encoder.synchronous[pad] else _MAX_SILENT_PERIODS * encoder.max_sample_period_ns[pad]
    return not encoder.silent_ns[pad] > max_silent_ns


def _read_statuses(encoder: ContactEncoder, pad: int) -> None:
    """Set group, statuses and conditions of a contact; in no frame where none is requested."""
    first = encoder.first_value + pad * _VALUES
    in_frames = encoder.palm_requested[pad] or encoder.base_requested[pad]
    force = encoder.force_status[pad]
    encoder.integers[_POSITION_STATUS], encoder.integers[_FORCE_STATUS] = encoder.position_status[pad], force
    encoder.integers[_GROUP] = encoder.group_id[pad] if in_frames else 0
    encoder.integers[_PALM_STATUS] = encoder.palm_status[pad] if in_frames else _NOT_COMPUTED
    encoder.integers[_BASE_STATUS] = encoder.base_status[pad] if in_frames else _NOT_COMPUTED
    encoder.integers[_VECTOR_STATUS] = encoder.vector_status[pad]
    encoder.conditions[_ALWAYS], encoder.conditions[_FRAMES] = True, in_frames
    encoder.conditions[_LOCATED] = (
        _are_known(encoder, first + _POSITION, 3)
        and _are_known(encoder, first + _NORMAL, 3)
        and _are_known(encoder, first + _PAD_M, 2)
    )
    encoder.conditions[_STD] = force in (_FORCE_VALID, _FORCE_UNRELIABLE)
    encoder.conditions[_PALM] = encoder.integers[_PALM_STATUS] == _FRAME_VALID
    encoder.conditions[_BASE] = encoder.integers[_BASE_STATUS] == _FRAME_VALID
    encoder.conditions[_MODELLED] = encoder.has_sheet_model[pad]
    encoder.conditions[_VECTOR] = encoder.vector_status[pad] != _NOT_COMPUTED


def _are_known(encoder: ContactEncoder, first: int, count: int) -> bool:
    """Return True if all of these numbers of the state are finite."""
    finite = True
    for i in range(first, first + count):
        if not -_INFINITY < encoder.state[i] < _INFINITY:
            finite = False
    return finite


def _write_field(encoder: ContactEncoder, row: int, pad: int, number: int) -> None:
    """Write a field of the layout with its key, unless it is absent; `number` counts its places."""
    at = row * _ROW_COUNT
    kind, is_optional = encoder.layout[at], encoder.layout[at + 2]
    if kind in (_NUMBERS, _SUM, _WHOLE):
        _write_numbers(encoder, row, pad, number)
    elif kind == _TEXT:
        _write_pad_text(encoder, pad * encoder.pad_text_count + encoder.layout[at + 5])
    elif kind == _PARTS:
        if encoder.parts[_PARTS_COUNT * pad] == encoder.parts[_PARTS_COUNT * pad]:
            _write_key(encoder, row)
            _write_parts(encoder, pad)
    else:
        value = encoder.integers[encoder.layout[at + 5]]
        if is_optional and value == encoder.layout[at + 4]:
            return
        _write_key(encoder, row)
        if kind == _INTEGER:
            _write_integer(encoder, value)
        elif kind == _SECONDS:
            encoder.summed[0] = value * _SECONDS_PER_NS
            _write_bits(encoder.message, encoder.written, encoder.summed_bits[0])
            encoder.written += _NUMBER_BYTES
        elif kind == _NAME:
            name = encoder.layout[at + 3] + value
            _write_text(encoder, encoder.text_ends[name], encoder.text_ends[name + 1])
        else:
            _write_byte(encoder, 0xC3 if value else 0xC2)


def _write_numbers(encoder: ContactEncoder, row: int, pad: int, number: int) -> None:
    """Write an array of at most 15 numbers, or one; nil or absent where they are unknown."""
    at = row * _ROW_COUNT
    absent, count = encoder.layout[at + 2], encoder.layout[at + 5]
    first, size = encoder.layout[at + 3] + number * encoder.layout[at + 4], count if count else 1
    is_met = encoder.conditions[encoder.layout[at + 1]]
    if not is_met and absent:
        return
    is_known = is_met and _are_known(encoder, first, size)
    is_sum = encoder.layout[at] == _SUM
    if is_known and is_sum:
        _sum_covariance(encoder, first, encoder.first_value + pad * _VALUES + _MOUNT)
        is_known = _are_finite(encoder.summed, 0, size)
    if not is_known and absent == 1:
        return
    _write_key(encoder, row)
    if not is_known:
        _write_byte(encoder, 0xC0)
        return
    if encoder.layout[at] == _WHOLE:
        _write_integer(encoder, int(encoder.state[first]))
        return
    if count:
        _write_byte(encoder, 0x90 + count)
    message, end = encoder.message, encoder.written
    for i in range(size):
        _write_bits(message, end, encoder.summed_bits[i] if is_sum else encoder.state_bits[first + i])
        end += _NUMBER_BYTES
    encoder.written = end


def _sum_covariance(encoder: ContactEncoder, first: int, mount: int) -> None:
    """Set `summed` to a covariance on the pad, plus that of its mount, if the pad's contact has one."""
    known = _are_known(encoder, mount, 9)
    for i in range(9):
        encoder.summed[i] = encoder.state[first + i]
        if known:
            encoder.summed[i] += encoder.state[mount + i]


def _write_parts(encoder: ContactEncoder, pad: int) -> None:
    """Write the two contacts of a pad as maps."""
    fields = encoder.fields
    in_palm, in_base = encoder.palm_status[pad] == _FRAME_VALID, encoder.base_status[pad] == _FRAME_VALID
    _write_byte(encoder, 0x92)
    for number in range(2 * pad, 2 * pad + 2):
        first = number * _PART_FRAMES
        palm, base = encoder.part_frames[first], encoder.part_frames[first + _FRAME_VALUES]
        encoder.conditions[_PART_PALM] = in_palm and -_INFINITY < palm < _INFINITY
        encoder.conditions[_PART_BASE] = in_base and -_INFINITY < base < _INFINITY
        encoder.fields, header = 0, encoder.written
        _write_byte(encoder, 0x80)
        for row in range(encoder.row_count, encoder.row_count + encoder.part_rows):
            _write_field(encoder, row, pad, number)
        encoder.message[header] = 0x80 + encoder.fields
    encoder.fields = fields


def _write_text(encoder: ContactEncoder, begin: int, end: int) -> None:
    _copy(encoder.message, encoder.written, encoder.texts, begin, end)
    encoder.written += end - begin


def _copy(message: memoryview[int], at: int, texts: memoryview[int], begin: int, end: int) -> None:
    for i in range(end - begin):
        message[at + i] = texts[begin + i]


def _write_key(encoder: ContactEncoder, row: int) -> None:
    encoder.fields += 1
    _write_text(encoder, encoder.text_ends[row], encoder.text_ends[row + 1])


def _write_pad_text(encoder: ContactEncoder, row: int) -> None:
    if encoder.pad_text_ends[row + 1] > encoder.pad_text_ends[row]:
        encoder.fields += 1
    begin, end = encoder.pad_text_ends[row], encoder.pad_text_ends[row + 1]
    _copy(encoder.message, encoder.written, encoder.pad_texts, begin, end)
    encoder.written += end - begin


def _write_byte(encoder: ContactEncoder, byte: int) -> None:
    encoder.message[encoder.written] = byte
    encoder.written += 1


def _write_integer(encoder: ContactEncoder, value: int) -> None:
    """Write an integer that isn't negative, as short as it can be."""
    if value < 0x80:
        _write_byte(encoder, value)
        return
    size, kind = 8, 0xCF
    if value < 0x100:
        size, kind = 1, 0xCC
    elif value < 0x10000:
        size, kind = 2, 0xCD
    elif value < 0x100000000:
        size, kind = 4, 0xCE
    _write_byte(encoder, kind)
    for k in range(size):
        _write_byte(encoder, value >> 8 * (size - 1 - k) & 0xFF)


def _write_bits(message: memoryview[int], at: int, bits: int) -> None:
    """Write the number that has these bits."""
    message[at] = 0xCB
    message[at + 1] = bits >> 56 & 0xFF
    message[at + 2] = bits >> 48 & 0xFF
    message[at + 3] = bits >> 40 & 0xFF
    message[at + 4] = bits >> 32 & 0xFF
    message[at + 5] = bits >> 24 & 0xFF
    message[at + 6] = bits >> 16 & 0xFF
    message[at + 7] = bits >> 8 & 0xFF
    message[at + 8] = bits & 0xFF
