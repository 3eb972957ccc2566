"""Contact messages as msgpack, written from the arrays of a tick.

Public names: `ContactEncoder`, `WRITTEN_FIELDS`. The bytes are those of the codec of `handtouch.wire`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handtouch.core.stages.solve import VALUE_COUNT, VALUE_SLICES

WRITTEN_FIELDS = (
    *("seq", "t_ns", "event", "id", "begin_ns", "duration_s", "age_s", "position_m", "normal"),
    *("covariance_m2", "pad_m", "position_status", "force_n", "force_std_n", "peak_force_n", "force_status"),
    *("total_current_a", "residual", "residual_std", "end_reason", "retained", "group"),
    *("palm_status", "palm_position_m", "palm_normal", "palm_covariance_m2"),
    *("base_status", "base_position_m", "base_normal", "base_covariance_m2"),
    *("joints_age_s", "uncompensated_force_n", "fresh"),
)
"""Fields in the order in which they are written; the others are texts of the pad."""
_VALUES, _PALM_VALUES = VALUE_COUNT, 31
_PAD_M, _POSITION = VALUE_SLICES["pad_m"].start, VALUE_SLICES["position_m"].start
_NORMAL, _COVARIANCE = VALUE_SLICES["normal"].start, VALUE_SLICES["covariance_m2"].start
_FORCE, _FORCE_STD = VALUE_SLICES["force_n"].start, VALUE_SLICES["force_std_n"].start
_RESIDUAL, _RESIDUAL_STD = VALUE_SLICES["residual"].start, VALUE_SLICES["residual_std"].start
_BASE, _AGE = 15, 30  # in the values of a contact in palm and base
_END = 2  # number of the event
_EVENTS = len(WRITTEN_FIELDS)  # first of the names of events, statuses and reasons
_POSITION_STATUSES, _FORCE_STATUSES, _FRAME_STATUSES, _REASONS = (
    _EVENTS + 3,
    _EVENTS + 7,
    _EVENTS + 12,
    _EVENTS + 16,
)
_REQUIRED, _HEADER_BYTES = 29, 3
_PAD_TEXTS = 4
_FORCE_VALID, _FORCE_UNRELIABLE, _FRAME_VALID = 1, 3, 1
_MAX_SILENT_PERIODS = 3
_INFINITY = float("inf")
_SECONDS_PER_NS = 1e-9


class ContactEncoder:
    """Encoder of contact messages. arrays: flat memory of the arrays of `TickState` by their names.

    position_status, force_status, has_sheet_model: (n,) of the pads. texts: packed keys of WRITTEN_FIELDS,
    then names of events, of position, force and frame statuses, and end reasons; text_ends: (count + 1,)
    where each begins, and the last ends. pad_texts: packed fields of each pad: hand to frame;
    begin_threshold_n to calibration_id; diagnoses, empty if there are none; pad_text_ends: (4 n,) where each
    begins, and the last of a pad ends. number: one, of which number_bytes is the memory. message: written.
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
    ) -> None:
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
        _write_array(self, self.values, first + _COVARIANCE, 9, located)
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
        self.message[0], self.message[1], self.message[2] = 0xDE, 0, self.fields
        return self.written


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


def _are_finite(values: memoryview[float], first: int, count: int) -> bool:
    """Return True if all of these values are finite."""
    finite = True
    for i in range(first, first + count):
        if not -_INFINITY < values[i] < _INFINITY:
            finite = False
    return finite


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
