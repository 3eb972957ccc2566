"""Output of a tick's contacts: columns with statuses, NaN where there is no value, and contact messages as
msgpack, whose bytes are those of the codec of `handtouch.wire`.

Public names: `ContactColumns`, `PUBLISHED_SLICES`, `PUBLISHED_VALUES`, `ContactEncoder`, `WRITTEN_FIELDS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handtouch.core.stages.force import BOUNDED, WIDE
from handtouch.core.stages.frames import FRAME_VALUES, PART_FRAMES
from handtouch.core.stages.solve import (
    MAX_SQUARED_MISFIT,
    PART_COUNT,
    PART_SLICES,
    PARTS_COUNT,
    VALUE_COUNT,
    VALUE_SLICES,
)
from handtouch.wire.status import MAX_SILENT_PERIODS, ForceStatus, FrameStatus, PositionStatus

_VALUES, _FIRST = VALUE_COUNT, VALUE_SLICES["pad_m"].start
_COUNT = VALUE_SLICES["mount_covariance_m2"].stop - _FIRST
PUBLISHED_VALUES = _COUNT
PUBLISHED_SLICES = {
    name: slice(columns.start - _FIRST, columns.stop - _FIRST)
    for name, columns in VALUE_SLICES.items()
    if _FIRST <= columns.start < _FIRST + _COUNT
}
"""Values of a contact that are published: name -> numbers of its values. The columns are one behind another
in this order, each (n, values)."""
_POSITION, _FORCE = VALUE_SLICES["position_m"].start, VALUE_SLICES["force_n"].start
_FORCE_STD, _ESTIMATE = VALUE_SLICES["force_std_n"].start, VALUE_SLICES["force_status"].start
_MISFIT, _MAX_SQUARED_MISFIT = VALUE_SLICES["squared_misfit"].start, MAX_SQUARED_MISFIT
_IS_BOUND = VALUE_SLICES["is_bound"].start
_BOUNDED_ESTIMATE, _WIDE_ESTIMATE = float(BOUNDED), float(WIDE)
_NAN, _INFINITY = float("nan"), float("inf")
_NOT_COMPUTED, _POSITION_VALID, _POSITION_UNRELIABLE, _POSITION_INVALID = map(int, PositionStatus)
_NOT_COMPUTED, _FORCE_VALID, _FORCE_LOWER_BOUND, _FORCE_UNRELIABLE, _FORCE_INVALID = map(int, ForceStatus)
_EVIDENCE_MISSING = 0  # ForceReliability.UNRELIABLE
WRITTEN_FIELDS = (
    *("seq", "t_ns", "event", "id", "begin_ns", "duration_s", "age_s", "position_m", "normal"),
    *("covariance_m2", "pad_m", "position_status", "force_n", "force_std_n", "peak_force_n", "force_status"),
    *("total_current_a", "residual", "residual_std", "end_reason", "retained", "group"),
    *("palm_status", "palm_position_m", "palm_normal", "palm_covariance_m2"),
    *("base_status", "base_position_m", "base_normal", "base_covariance_m2"),
    *("joints_age_s", "uncompensated_force_n", "fresh", "force_vector_status", "force_vector_n"),
    *("force_vector_covariance_n2", "palm_force_vector_n", "base_force_vector_n", "parts"),
    "mount_covariance_m2",
)
"""Fields in the order in which they are written; the others are texts of the pad."""
_PALM_VALUES, _PAD_M = 2 * FRAME_VALUES + 1, VALUE_SLICES["pad_m"].start
_NORMAL, _COVARIANCE = VALUE_SLICES["normal"].start, VALUE_SLICES["covariance_m2"].start
_MOUNT = VALUE_SLICES["mount_covariance_m2"].start
_RESIDUAL, _RESIDUAL_STD = VALUE_SLICES["residual"].start, VALUE_SLICES["residual_std"].start
_BASE, _AGE = FRAME_VALUES, 2 * FRAME_VALUES  # in the values of a contact in palm and base
_VECTOR, _FRAME_VECTORS = 12, 6  # force vector with its covariance; in palm and base
_END = 2  # number of the event
_PART_COUNT, _PARTS_COUNT, _PART_COVARIANCE = PART_COUNT, PARTS_COUNT, PART_SLICES["covariance_m2"].start
_PART_FORCE = PART_SLICES["force_n"].start
_PART_FRAMES = PART_FRAMES
_KEY_POSITION, _KEY_NORMAL = WRITTEN_FIELDS.index("position_m"), WRITTEN_FIELDS.index("normal")
_KEY_COVARIANCE, _KEY_FORCE = WRITTEN_FIELDS.index("covariance_m2"), WRITTEN_FIELDS.index("force_n")
_KEY_FORCE_STD, _KEY_PARTS = WRITTEN_FIELDS.index("force_std_n"), WRITTEN_FIELDS.index("parts")
_KEY_MOUNT = WRITTEN_FIELDS.index("mount_covariance_m2")
_KEY_PALM, _KEY_BASE = WRITTEN_FIELDS.index("palm_position_m"), WRITTEN_FIELDS.index("base_position_m")
_EVENTS = len(WRITTEN_FIELDS)  # first of the names of events, statuses and reasons
_POSITION_STATUSES, _FORCE_STATUSES, _FRAME_STATUSES, _REASONS = (
    _EVENTS + 3,
    _EVENTS + 7,
    _EVENTS + 12,
    _EVENTS + 16,
)
_REQUIRED, _HEADER_BYTES = 29, 3
_PAD_TEXTS = 4
_FRAME_VALID = int(FrameStatus.VALID)
_MAX_SILENT_PERIODS = MAX_SILENT_PERIODS
_SECONDS_PER_NS = 1e-9


class ContactColumns:
    """Columns of n pads. arrays: flat memory of the arrays of `TickState` by their names.

    position_unreliable: (n,) of the model. value_columns: (2 PUBLISHED_VALUES,) of each value, values before
    its column, and of its column. Written: published (n PUBLISHED_VALUES,), total_current_a, position_status
    and force_status (n,).
    """

    def __init__(
        self,
        pads: int,
        arrays: Mapping[str, Any],
        position_unreliable: memoryview[int],
        value_columns: memoryview[int],
        published: memoryview[float],
        total_current_a: memoryview[float],
        position_status: memoryview[int],
        force_status: memoryview[int],
    ) -> None:
        self.pads, self.position_unreliable = pads, position_unreliable
        self.value_columns = value_columns
        self.published, self.published_current_a = published, total_current_a
        self.total_current_a = arrays["total_current_a"]
        self.position_status, self.force_status = position_status, force_status
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
                for i in range(_COUNT):
                    self.published[_published_index(self, pad, i)] = _NAN


def _published_index(columns: ContactColumns, pad: int, i: int) -> int:
    """Return the position of a pad's value i in the published columns."""
    before, width = columns.value_columns[2 * i], columns.value_columns[2 * i + 1]
    return columns.pads * before + pad * width + i - before


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
    for i in range(_COUNT):
        value = values[first + _FIRST + i]
        if has_mount and _COVARIANCE <= _FIRST + i < _COVARIANCE + 9:
            value += values[first + _MOUNT + _FIRST + i - _COVARIANCE]
        columns.published[_published_index(columns, pad, i)] = (
            value if -_INFINITY < value < _INFINITY else _NAN
        )
    located = _are_finite(values, first + _FIRST, 2) and _are_finite(values, first + _POSITION, 6)
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
        if force == _FORCE_VALID and values[first + _ESTIMATE] == _WIDE_ESTIMATE:
            force = _FORCE_UNRELIABLE
    columns.force_status[pad] = force
    if value == value and not columns.peak_force_n[pad] >= value:
        columns.peak_force_n[pad] = value


class ContactEncoder:
    """Encoder of contact messages. arrays: flat memory of the arrays of `TickState` by their names.

    position_status, force_status, has_sheet_model: (n,) of the pads. texts: packed keys of WRITTEN_FIELDS,
    then names of events, of position, force and frame statuses, and end reasons; text_ends: (count + 1,)
    where each begins, and the last ends. pad_texts: packed fields of each pad: hand to frame;
    begin_threshold_n to calibration_id; diagnoses, empty if there are none; pad_text_ends: (4 n,) where each
    begins, and the last of a pad ends. number: one, of which number_bytes is the memory. message: written.
    summed: (9,), working memory.
    """

    def __init__(
        self,
        arrays: Mapping[str, Any],
        position_status: memoryview[int],
        force_status: memoryview[int],
        has_sheet_model: memoryview[int],
        texts: memoryview[int],
        text_ends: memoryview[int],
        pad_texts: memoryview[int],
        pad_text_ends: memoryview[int],
        number: memoryview[float],
        number_bytes: memoryview[int],
        message: memoryview[int],
        summed: memoryview[float],
    ) -> None:
        self.summed = summed
        self.position_status, self.force_status = position_status, force_status
        self.has_sheet_model = has_sheet_model
        self.texts, self.text_ends = texts, text_ends
        self.number, self.number_bytes, self.message = number, number_bytes, message
        self.contact_seq, self.contact_id = arrays["contact_seq"], arrays["contact_id"]
        self.sample_ns, self.begin_ns = arrays["sample_ns"], arrays["begin_ns"]
        self.values, self.peak_force_n = arrays["values"], arrays["peak_force_n"]
        self.total_current_a = arrays["total_current_a"]
        self.uncompensated_force_n = arrays["uncompensated_force_n"]
        self.silent_ns, self.synchronous = arrays["silent_ns"], arrays["synchronous"]
        self.max_sample_period_ns = arrays["max_sample_period_ns"]
        self.palm_requested, self.base_requested = arrays["palm_requested"], arrays["base_requested"]
        self.palm_status, self.base_status = arrays["palm_status"], arrays["base_status"]
        self.palm_values, self.group_id = arrays["palm_values"], arrays["group_id"]
        self.vector, self.vector_status = arrays["force_vector"], arrays["force_vector_status"]
        self.frame_vector, self.parts = arrays["frame_force_vector"], arrays["parts"]
        self.part_frames = arrays["part_frames"]
        self.pad_texts, self.pad_text_ends = pad_texts, pad_text_ends
        self.written = self.field = self.fields = 0

    def encode_contact(
        self, pad: int, event: int, sync_ns: int, now_ns: int, end_reason: int, retained: bool
    ) -> int:
        """Write the message of a contact; return its size in bytes.

        event: 0 begin, 1 update, 2 end. sync_ns: of the tick in which the contact ended. end_reason: number
        of its name.
        """
        sample_ns, begin_ns = self.sample_ns[pad], self.begin_ns[pad]
        t_ns = sync_ns if event == _END else sample_ns
        first, status = pad * _VALUES, self.force_status[pad]
        located = _are_finite(self.values, first + _POSITION, 3) and _are_finite(
            self.values, first + _NORMAL, 3
        )
        located = located and _are_finite(self.values, first + _PAD_M, 2)
        self.written, self.field, self.fields = _HEADER_BYTES, 0, _REQUIRED
        _write_integer(self, self.contact_seq[pad])
        _write_integer(self, t_ns)
        _write_name(self, _EVENTS + event)
        _write_integer(self, self.contact_id[pad])
        _write_pad_text(self, pad, 0)
        _write_integer(self, begin_ns)
        _write_number(self, (t_ns - begin_ns) * _SECONDS_PER_NS)
        _write_number(self, (now_ns - sample_ns) * _SECONDS_PER_NS)
        _write_array(self, self.values, first + _POSITION, 3, located)
        _write_array(self, self.values, first + _NORMAL, 3, located)
        _sum_covariance(self, self.values, first + _COVARIANCE, first + _MOUNT)
        _write_array(self, self.summed, 0, 9, located)
        _write_array(self, self.values, first + _PAD_M, 2, located)
        _write_name(self, _POSITION_STATUSES + self.position_status[pad])
        _write_number(self, self.values[first + _FORCE])
        has_std = status in (_FORCE_VALID, _FORCE_UNRELIABLE)
        _write_number(self, self.values[first + _FORCE_STD] if has_std else _INFINITY)
        _write_number(self, self.peak_force_n[pad])
        _write_name(self, _FORCE_STATUSES + status)
        _write_number(self, self.total_current_a[pad])
        _write_number(self, self.values[first + _RESIDUAL])
        _write_number(self, self.values[first + _RESIDUAL_STD])
        _write_pad_text(self, pad, 1)
        _write_name(self, _REASONS + end_reason)
        _write_truth(self, retained)
        _write_frames(self, pad)
        if self.has_sheet_model[pad]:
            _write_optional_number(self, self.uncompensated_force_n[pad])
        else:
            self.field += 1
        if self.pad_text_ends[pad * _PAD_TEXTS + 3] > self.pad_text_ends[pad * _PAD_TEXTS + 2]:
            self.fields += 1
            _write_pad_text(self, pad, 2)
        max_silent_ns = 0 if self.synchronous[pad] else _MAX_SILENT_PERIODS * self.max_sample_period_ns[pad]
        if self.silent_ns[pad] > max_silent_ns:
            self.fields += 1
            _write_truth(self, False)
        else:
            self.field += 1
        if self.vector_status[pad] != _NOT_COMPUTED:
            self.fields += 1
            _write_name(self, _FORCE_STATUSES + self.vector_status[pad])
            _write_optional_array(self, self.vector, _VECTOR * pad, 3)
            _write_optional_array(self, self.vector, _VECTOR * pad + 3, 9)
            _write_optional_array(self, self.frame_vector, _FRAME_VECTORS * pad, 3)
            _write_optional_array(self, self.frame_vector, _FRAME_VECTORS * pad + 3, 3)
        if self.parts[_PARTS_COUNT * pad] == self.parts[_PARTS_COUNT * pad]:
            self.fields += 1
            _write_parts(self, pad)
        if located:
            self.field = _KEY_MOUNT
            _write_optional_array(self, self.values, first + _MOUNT, 9)
        self.message[0], self.message[1], self.message[2] = 0xDE, 0, self.fields
        return self.written


def _sum_covariance(encoder: ContactEncoder, values: memoryview[float], first: int, mount: int) -> None:
    """Set `summed` to a covariance on the pad, plus that of its mount, if the pad's contact has one."""
    known = _are_finite(encoder.values, mount, 9)
    for i in range(9):
        encoder.summed[i] = values[first + i]
        if known:
            encoder.summed[i] += encoder.values[mount + i]


def _write_frames(encoder: ContactEncoder, pad: int) -> None:
    """Write group, palm, base and age of the joints where they are requested and differ from the default."""
    if not (encoder.palm_requested[pad] or encoder.base_requested[pad]):
        encoder.field += 10
        return
    first = pad * _PALM_VALUES
    if encoder.group_id[pad] != 0:
        encoder.fields += 1
        _write_integer(encoder, encoder.group_id[pad])
    else:
        encoder.field += 1
    _write_frame(encoder, encoder.palm_status[pad], first)
    _write_frame(encoder, encoder.base_status[pad], first + _BASE)
    _write_optional_number(encoder, encoder.palm_values[first + _AGE])


def _write_frame(encoder: ContactEncoder, status: int, first: int) -> None:
    """Write status, and if that is valid position, normal and covariance in palm or base."""
    if status == 0:
        encoder.field += 4
        return
    encoder.fields += 1
    _write_name(encoder, _FRAME_STATUSES + status)
    if status != _FRAME_VALID:
        encoder.field += 3
        return
    _write_optional_array(encoder, encoder.palm_values, first, 3)
    _write_optional_array(encoder, encoder.palm_values, first + 3, 3)
    _write_optional_array(encoder, encoder.palm_values, first + 6, 9)


def _write_parts(encoder: ContactEncoder, pad: int) -> None:
    """Write the two contacts of a pad as maps."""
    in_palm, in_base = encoder.palm_status[pad] == _FRAME_VALID, encoder.base_status[pad] == _FRAME_VALID
    encoder.field = _KEY_PARTS
    _write_key(encoder)
    _write_byte(encoder, 0x92)
    for k in range(2):
        at = pad * _PARTS_COUNT + k * _PART_COUNT
        first = pad * _PART_FRAMES + 2 * k * _BASE
        has_palm = in_palm and _are_finite(encoder.part_frames, first, 1)
        has_base = in_base and _are_finite(encoder.part_frames, first + _BASE, 1)
        _write_byte(encoder, 0x85 + (3 if has_palm else 0) + (3 if has_base else 0))
        encoder.field = _KEY_POSITION
        _write_array(encoder, encoder.parts, at, 3, True)
        encoder.field = _KEY_NORMAL
        _write_array(encoder, encoder.parts, at + 3, 3, True)
        encoder.field = _KEY_COVARIANCE
        _sum_covariance(encoder, encoder.parts, at + _PART_COVARIANCE, pad * _VALUES + _MOUNT)
        _write_array(encoder, encoder.summed, 0, 9, True)
        encoder.field = _KEY_FORCE
        _write_number(encoder, encoder.parts[at + _PART_FORCE])
        encoder.field = _KEY_FORCE_STD
        _write_number(encoder, encoder.parts[at + _PART_FORCE + 1])
        if has_palm:
            encoder.field = _KEY_PALM
            _write_frame_values(encoder, first)
        if has_base:
            encoder.field = _KEY_BASE
            _write_frame_values(encoder, first + _BASE)


def _write_frame_values(encoder: ContactEncoder, at: int) -> None:
    """Write position, normal and covariance of one of two contacts in palm or base."""
    _write_array(encoder, encoder.part_frames, at, 3, True)
    _write_array(encoder, encoder.part_frames, at + 3, 3, True)
    _write_array(encoder, encoder.part_frames, at + 6, 9, True)


def _write_text(encoder: ContactEncoder, begin: int, end: int) -> None:
    for i in range(begin, end):
        encoder.message[encoder.written] = encoder.texts[i]
        encoder.written += 1


def _write_key(encoder: ContactEncoder) -> None:
    _write_text(encoder, encoder.text_ends[encoder.field], encoder.text_ends[encoder.field + 1])
    encoder.field += 1


def _write_name(encoder: ContactEncoder, name: int) -> None:
    _write_key(encoder)
    _write_text(encoder, encoder.text_ends[name], encoder.text_ends[name + 1])


def _write_pad_text(encoder: ContactEncoder, pad: int, number: int) -> None:
    row = pad * _PAD_TEXTS + number
    for i in range(encoder.pad_text_ends[row], encoder.pad_text_ends[row + 1]):
        encoder.message[encoder.written] = encoder.pad_texts[i]
        encoder.written += 1


def _write_byte(encoder: ContactEncoder, byte: int) -> None:
    encoder.message[encoder.written] = byte
    encoder.written += 1


def _write_truth(encoder: ContactEncoder, truth: bool) -> None:
    _write_key(encoder)
    _write_byte(encoder, 0xC3 if truth else 0xC2)


def _write_integer(encoder: ContactEncoder, value: int) -> None:
    """Write an integer that isn't negative, as short as it can be."""
    _write_key(encoder)
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


def _write_optional_number(encoder: ContactEncoder, value: float) -> None:
    """Write a number if it is finite."""
    if -_INFINITY < value < _INFINITY:
        encoder.fields += 1
        _write_number(encoder, value)
    else:
        encoder.field += 1


def _write_number(encoder: ContactEncoder, value: float) -> None:
    """Write a number, nil if it isn't finite."""
    _write_key(encoder)
    if -_INFINITY < value < _INFINITY:
        _write_double(encoder, value)
    else:
        _write_byte(encoder, 0xC0)


def _write_optional_array(encoder: ContactEncoder, values: memoryview[float], first: int, count: int) -> None:
    """Write an array of numbers if they are finite."""
    if _are_finite(values, first, count):
        encoder.fields += 1
        _write_array(encoder, values, first, count, True)
    else:
        encoder.field += 1


def _write_array(
    encoder: ContactEncoder, values: memoryview[float], first: int, count: int, valid: bool
) -> None:
    """Write an array of at most 15 numbers; nil unless it is valid and finite."""
    _write_key(encoder)
    if not valid or not _are_finite(values, first, count):
        _write_byte(encoder, 0xC0)
        return
    _write_byte(encoder, 0x90 + count)
    for i in range(first, first + count):
        _write_double(encoder, values[i])


def _write_double(encoder: ContactEncoder, value: float) -> None:
    encoder.number[0] = value
    encoder.message[encoder.written] = 0xCB
    for k in range(8):
        encoder.message[encoder.written + 1 + k] = encoder.number_bytes[7 - k]
    encoder.written += 9
