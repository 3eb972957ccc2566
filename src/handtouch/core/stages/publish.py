"""Output of a tick's contacts: columns with statuses, NaN where there is no value, and contact messages as
msgpack, whose bytes are those of the codec of `handtouch.wire`.

Public names: `ContactColumns`, `ContactEncoder`.
"""

from __future__ import annotations

import typing
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields
from typing import TYPE_CHECKING, Any

import msgpack
import numpy as np

from handtouch import wire
from handtouch.core.columns import PUBLISHED, PadColumns
from handtouch.core.memory import RowArray, row_count, slices_of, view_memory, view_rows
from handtouch.core.pad_tables import MAX_SQUARED_MISFIT
from handtouch.core.stages.force import BOUNDED, WIDE
from handtouch.core.stages.rows import CONTACT_FRAMES, MISFIT_COUNT, PART_FRAMES, PART_ROW, VALUE_ROW
from handtouch.wire import ContactEvent, EndReason
from handtouch.wire.status import (
    MAX_SILENT_PERIODS,
    ContactRadiusStatus,
    ForceStatus,
    FrameStatus,
    PositionStatus,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from handtouch.core.pad_model import PadModel
    from handtouch.core.state import TickState

COLUMN_ROW = np.dtype(
    [
        ("before", "<i8"),  # published values of a pad before its column
        ("width", "<i8"),  # of its column
        ("place", "<i8"),  # in a row of values
        ("added", "<i8"),  # place of the covariance of the mount that is added, -1 for none
    ]
)
"""A published value of a contact"""
FIELD_ROW = np.dtype(
    [
        ("kind", "<i8"),  # number in FIELD_KINDS
        (
            "absence",
            "<i8",
        ),  # when it is absent: 0 never, 1 where it is unknown, 2 where a condition isn't met
        ("condition", "<i8"),  # of numbers: number in CONDITIONS
        ("first", "<i8"),  # their first place in the state
        ("step", "<i8"),  # from one pad, or one of two contacts on it, to the next
        ("count", "<i8"),  # 0 of a single number
        ("integer", "<i8"),  # of others: number in INTEGERS, or among the texts of a pad
        ("default", "<i8"),
        ("name", "<i8"),  # number of the first of their names among the texts
    ]
)
"""A field of a contact message, or of one of two contacts on a pad"""
_VALUES = row_count(VALUE_ROW)
_PLACES_OF_VALUES = slices_of(VALUE_ROW)
_MAX_SQUARED_MISFIT, _MISFIT_COUNT = MAX_SQUARED_MISFIT, MISFIT_COUNT
_MAX_LASTING_MISFIT = MAX_SQUARED_MISFIT / 2
"""Mean squared misfit of a pad's last contacts, each at most MAX_SQUARED_MISFIT, beyond which the next is no
better known: with a dead channel, 1 of 10 contacts fits, at a wrong place. Crosstalk of 1 % has 2 to 3."""
_BOUNDED_ESTIMATE, _WIDE_ESTIMATE = float(BOUNDED), float(WIDE)
_NAN = float("nan")
_MAX_NUMBER, _MIN_NUMBER = float(np.finfo(np.float32).max), float(np.finfo(np.float32).tiny)
"""Largest and smallest of single precision, in which columns are"""
_NOT_COMPUTED, _POSITION_VALID, _POSITION_UNRELIABLE, _POSITION_INVALID = map(int, PositionStatus)
_MAX_RADIUS_STATUS = float(max(ContactRadiusStatus))
_NOT_COMPUTED, _FORCE_VALID, _FORCE_LOWER_BOUND, _FORCE_UNRELIABLE, _FORCE_INVALID = map(int, ForceStatus)
_EVIDENCE_MISSING = 0  # ForceReliability.UNRELIABLE
_FRAME_VALID = int(FrameStatus.VALID)
_END = 2  # number of the event
_HEADER_BYTES, _NUMBER_BYTES = 3, 9
_MAX_SILENT_PERIODS = MAX_SILENT_PERIODS
_SECONDS_PER_NS = 1e-9
FIELD_KINDS = "integer", "seconds", "name", "truth", "numbers", "covariance", "whole", "text", "parts"
"""How a field is written: four kinds from one of INTEGERS; from the memory of the state; as that, plus the
covariance of the mount; as a whole number of it; as a text of the pad; as the two contacts of a pad."""
_INTEGER, _SECONDS, _NAME, _TRUTH, _NUMBERS, _SUM, _WHOLE, _TEXT, _PARTS = range(len(FIELD_KINDS))
CONDITIONS = (
    "always",
    "located",
    "std",
    "frames",
    "palm",
    "base",
    "modelled",
    "vector",
    "part_palm",
    "part_base",
)
"""What a contact must have for a field of numbers not to be nil or absent: a position; the standard deviation
of its force; requested frames; a position in the palm; in the base; a sheet with a model; a force vector; of
one of two contacts, a position in the palm; in the base."""
_ALWAYS, _LOCATED, _STD, _FRAMES, _PALM, _BASE, _MODELLED, _VECTOR, _PART_PALM, _PART_BASE = range(
    len(CONDITIONS)
)
INTEGERS = (
    "seq",
    "t_ns",
    "event",
    "id",
    "begin_ns",
    "position_status",
    "force_status",
    "end_reason",
    "retained",
    "group",
    "palm_status",
    "base_status",
    "fresh",
    "force_vector_status",
    "duration_s",
    "age_s",
    "contact_radius_status",
)
"""Integers, truth values, numbers of names, and durations in nanoseconds."""
(
    _SEQ,
    _T,
    _EVENT,
    _ID,
    _BEGIN,
    _POSITION_STATUS,
    _FORCE_STATUS,
    _REASON,
    _RETAINED,
    _GROUP,
    _PALM_STATUS,
    _BASE_STATUS,
    _FRESH,
    _VECTOR_STATUS,
    _DURATION,
    _AGE,
    _RADIUS_STATUS,
) = range(len(INTEGERS))
_EVENTS: tuple[ContactEvent, ...] = typing.get_args(ContactEvent)
_END_REASONS: tuple[EndReason, ...] = typing.get_args(EndReason)
_NAMES: dict[str, tuple[str, ...]] = {
    "event": _EVENTS,
    "end_reason": _END_REASONS,
    "position_status": tuple(status.text for status in PositionStatus),
    "force_status": tuple(status.text for status in ForceStatus),
    "palm_status": tuple(status.text for status in FrameStatus),
    "base_status": tuple(status.text for status in FrameStatus),
    "force_vector_status": tuple(status.text for status in ForceStatus),
    "contact_radius_status": tuple(status.text for status in ContactRadiusStatus),
}
"""Texts of a field by its number"""
_TRUTHS, _DURATIONS = ("retained", "fresh"), ("duration_s", "age_s")
_PAD_TEXTS = (
    "hand",
    "link",
    "frame",
    "begin_threshold_n",
    "end_threshold_n",
    "calibration_id",
    "diagnoses",
)
"""Fields that change with a pad's calibration only"""
_PLACES = {
    **{name: (name[:4], "palm_values", at) for name, at in slices_of(CONTACT_FRAMES).items()},
    **{name: ("located", "values", _PLACES_OF_VALUES[name]) for name in ("position_m", "normal", "pad_m")},
    "covariance_m2": ("located", "values", _PLACES_OF_VALUES["covariance_m2"]),
    "mount_covariance_m2": ("located", "values", _PLACES_OF_VALUES["mount_covariance_m2"]),
    "force_std_n": ("std", "values", _PLACES_OF_VALUES["force_std_n"]),
    "joints_age_s": ("frames", "palm_values", slices_of(CONTACT_FRAMES)["joints_age_s"]),
    "uncompensated_force_n": ("modelled", "uncompensated_force_n", slice(0, 1)),
    "force_vector_n": ("vector", "force_vector", slice(0, 3)),
    "force_vector_covariance_n2": ("vector", "force_vector", slice(3, 12)),
    "palm_force_vector_n": ("vector", "frame_force_vector", slice(0, 3)),
    "base_force_vector_n": ("vector", "frame_force_vector", slice(3, 6)),
}
"""Numbers that are known under a condition: that, an array of the state, and their place in its rows. Others
are those of the same name in _PLACES_OF_VALUES, or in the state."""
_PART_PLACES = {
    **{name: ("always", "parts", at) for name, at in slices_of(PART_ROW).items()},
    **{name: (f"part_{name[:4]}", "part_frames", at) for name, at in slices_of(PART_FRAMES).items()},
}
"""The same of the fields of `wire.ContactPart`"""
_PART_FIELDS = tuple(wire.ContactPart.__annotations__)
_PART_STEPS = {"parts": row_count(PART_ROW), "part_frames": row_count(PART_FRAMES)}
_MAX_VALUE_BYTES = 4096  # numbers and names of statuses


class ContactColumns:
    """Columns of n pads: statuses and published values of contacts, of the state's last solved ones."""

    def __init__(self, model: PadModel, state: TickState, columns: PadColumns) -> None:
        memory = state.memory
        self.pads, self.position_unreliable = model.size, view_memory(model.position_unreliable)
        self.columns = _column_rows()
        self.count = len(self.columns)
        self.published = view_memory(columns.published_values)
        self.published_current_a = view_memory(columns.published["total_current_a"])
        self.position_status, self.force_status = (
            view_memory(columns.position_status),
            view_memory(columns.force_status),
        )
        self.radius_status = view_memory(columns.contact_radius_status)
        self.values, self.contacts = memory["values"], view_rows(state.values, VALUE_ROW)
        self.total_current_a = memory["total_current_a"]
        self.contact_id, self.solved = memory["contact_id"], memory["solved"]
        self.position_requested, self.force_requested = (
            memory["position_requested"],
            memory["force_requested"],
        )
        self.uncompensated_force_n = memory["uncompensated_force_n"]
        self.uncompensated_std_n = memory["uncompensated_std_n"]
        self.misfits = memory["misfits"]
        self.known, self.reliability = memory["known"], memory["force_reliability"]
        self.peak_force_n = memory["peak_force_n"]

    def store_solved(self, pads: memoryview[int]) -> None:
        """Note that these contacts were solved; keep their forces, which compensation replaces."""
        for k in range(len(pads)):
            pad = pads[k]
            self.solved[pad] = 1
            self.uncompensated_force_n[pad] = self.contacts[pad].force_n
            self.uncompensated_std_n[pad] = self.contacts[pad].force_std_n

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
                self.radius_status[pad] = _NOT_COMPUTED
                for i in range(self.count):
                    self.published[_published_index(self, pad, i)] = _NAN


def _column_rows() -> RowArray:
    """Return the published values as COLUMN_ROWs."""
    mount, rows, before = _PLACES_OF_VALUES["mount_covariance_m2"].start, list[tuple[int, ...]](), 0
    for name, at in PUBLISHED.items():
        width = at.stop - at.start
        for k in range(width):
            rows.append((before, width, at.start + k, mount + k if name == "covariance_m2" else -1))
        before += width
    return view_rows(np.array(rows, COLUMN_ROW), COLUMN_ROW)


def _published_index(columns: ContactColumns, pad: int, i: int) -> int:
    """Return the position of a pad's value i in the published columns."""
    before = columns.columns[i].before
    index: int = columns.pads * before + pad * columns.columns[i].width + i - before
    return index


def _is_finite(value: float) -> bool:
    return -_MAX_NUMBER < float(value) < _MAX_NUMBER  # a number of a row isn't one of Python's


def _is_located(contacts: RowArray, pad: int) -> bool:
    """Return True if a contact's position is known."""
    located = _is_finite(contacts[pad].pad_m[0]) and _is_finite(contacts[pad].pad_m[1])
    for i in range(3):
        if not (_is_finite(contacts[pad].position_m[i]) and _is_finite(contacts[pad].normal[i])):
            located = False
    return located


def _has_mount(contacts: RowArray, pad: int) -> bool:
    """Return True if a contact has a covariance of its pad's mount."""
    known = True
    for i in range(9):
        if not _is_finite(contacts[pad].mount_covariance_m2[i]):
            known = False
    return known


def _publish_contact(columns: ContactColumns, pad: int) -> None:
    first, has_mount = pad * _VALUES, _has_mount(columns.contacts, pad)
    for i in range(columns.count):
        value = columns.values[first + columns.columns[i].place]
        if has_mount and columns.columns[i].added >= 0:
            value += columns.values[first + columns.columns[i].added]
        columns.published[_published_index(columns, pad, i)] = value if _is_finite(value) else _NAN
    misfit, estimate = columns.contacts[pad].squared_misfit, columns.contacts[pad].force_status
    is_odd = misfit > _MAX_SQUARED_MISFIT or columns.misfits[_MISFIT_COUNT * pad] > _MAX_LASTING_MISFIT
    position = _POSITION_INVALID if columns.position_requested[pad] else _NOT_COMPUTED
    if _is_located(columns.contacts, pad):
        no_point = is_odd or columns.contacts[pad].is_bound != 0.0
        position = _POSITION_VALID
        if no_point or columns.position_unreliable[pad]:
            position = _POSITION_UNRELIABLE
    columns.position_status[pad] = position
    value = columns.contacts[pad].force_n
    std, is_bounded = columns.contacts[pad].force_std_n, estimate == _BOUNDED_ESTIMATE
    force = _NOT_COMPUTED
    if columns.force_requested[pad]:
        force = _FORCE_VALID
        if not (_is_finite(value) and (is_bounded or _MIN_NUMBER < std < _MAX_NUMBER)):
            force = _FORCE_INVALID
        elif is_bounded:
            force = _FORCE_LOWER_BOUND
        elif not columns.known[pad] or columns.reliability[pad] == _EVIDENCE_MISSING:
            force = _FORCE_UNRELIABLE
        if force == _FORCE_VALID and (is_odd or estimate == _WIDE_ESTIMATE):
            force = _FORCE_UNRELIABLE
    columns.force_status[pad] = force
    radius = columns.contacts[pad].contact_radius_status
    columns.radius_status[pad] = _NOT_COMPUTED
    if columns.force_requested[pad] and 0.0 <= radius <= _MAX_RADIUS_STATUS:
        columns.radius_status[pad] = int(radius)
    if value == value and not columns.peak_force_n[pad] >= value:
        columns.peak_force_n[pad] = value


class ContactEncoder:
    """Encoder of the contact messages of a model's pads from the arrays of a tick; `session` is the daemon's.

    has_sheet_model: (n,) pads whose sheet has a model.

    fields: FIELD_ROWs, `field_count` of a contact, then those of one of two contacts on a pad. state: memory
    of all arrays as numbers, state_bits as integers of their bits. texts: packed keys of the fields, then
    names; text_ends: where each begins, and the last ends. pad_texts, pad_text_ends: the same of packed
    fields of the pads with keys, empty where they are absent. `message` is written; summed (9,), integers
    and conditions: working memory.
    """

    def __init__(
        self,
        model: PadModel,
        state: TickState,
        columns: PadColumns,
        has_sheet_model: NDArray[np.bool_],
        session: int,
    ) -> None:
        memory = state.memory
        self.model, self.pack = model, msgpack.Packer().pack
        pack = self.pack
        contact_fields = [field for field in fields(wire.Contact) if field.name not in ("v", "session")]
        names = [name for field in contact_fields for name in _NAMES.get(field.name, ())]
        keys = [pack(name) for name in (*(field.name for field in contact_fields), *_PART_FIELDS)]
        keys[0] = pack("v") + pack(wire.SCHEMA_VERSION) + pack("session") + pack(session) + keys[0]
        self.fields = _field_rows(state, contact_fields, len(keys))
        self.field_count, self.row_count = len(contact_fields), len(keys)
        self.topics = [f"contact/{hand}/{link}" for hand, link in zip(model.hands, model.links, strict=True)]
        self.calibrations = list(model.calibrations)
        self.own_texts = [text for pad in range(model.size) for text in self.texts_of(pad)]
        texts = [*keys, *map(pack, names)]
        self.texts, self.text_ends, self.pad_text_count = (
            _text_memory(texts),
            _ends_of(texts),
            len(_PAD_TEXTS),
        )
        self.state, self.state_bits = (
            view_memory(state.block.view("<f8")),
            view_memory(state.block.view("<u8")),
        )
        summed = np.zeros(9)
        self.summed, self.summed_bits = view_memory(summed), view_memory(summed.view("<u8"))
        self.integers = view_memory(np.zeros(len(INTEGERS), np.int64))
        self.conditions = view_memory(np.zeros(len(CONDITIONS), np.uint8))
        self.contacts, self.parts = view_rows(state.values, VALUE_ROW), view_rows(state.parts, PART_ROW)
        frames = view_rows(state.part_frames, PART_FRAMES)
        self.parts_palm, self.parts_base = frames["palm"], frames["base"]
        self.position_status = view_memory(columns.position_status)
        self.force_status = view_memory(columns.force_status)
        self.radius_status = view_memory(columns.contact_radius_status)
        self.has_sheet_model = view_memory(has_sheet_model)
        self.contact_seq, self.contact_id = memory["contact_seq"], memory["contact_id"]
        self.sample_ns, self.begin_ns = memory["sample_ns"], memory["begin_ns"]
        self.group_id = memory["group_id"]
        self.silent_ns, self.synchronous = memory["silent_ns"], memory["synchronous"]
        self.max_sample_period_ns = memory["max_sample_period_ns"]
        self.palm_requested, self.base_requested = memory["palm_requested"], memory["base_requested"]
        self.palm_status, self.base_status = memory["palm_status"], memory["base_status"]
        self.vector_status = memory["force_vector_status"]
        self.written = self.written_fields = 0
        self.set_pad_texts()

    def encode(
        self, pad: int, event: ContactEvent, sync_ns: int, now_ns: int, end_reason: EndReason, retained: bool
    ) -> wire.EncodedMessage:
        """Encode the contact on a pad; `sync_ns`: of the tick in which it ended."""
        calibration = self.model.calibrations[pad]
        if calibration is not self.calibrations[pad]:
            self.calibrations[pad] = calibration
            self.own_texts[len(_PAD_TEXTS) * pad : len(_PAD_TEXTS) * (pad + 1)] = self.texts_of(pad)
            self.set_pad_texts()
        size = self.encode_contact(
            pad, _EVENTS.index(event), sync_ns, now_ns, _END_REASONS.index(end_reason), retained
        )
        return wire.EncodedMessage(self.topics[pad], bytes(self.buffer[:size]))

    def texts_of(self, pad: int) -> list[bytes]:
        """Return the packed fields of a pad that change with its calibration only, empty where absent."""
        model, calibration, pack = self.model, self.model.calibrations[pad], self.pack
        values: dict[str, Any] = {
            "hand": model.hands[pad],
            "link": model.links[pad],
            "frame": model.frame_links[pad],
            "begin_threshold_n": float(model.touch.begin_threshold_n[pad]),
            "end_threshold_n": float(model.touch.end_threshold_n[pad]),
            "calibration_id": calibration.calibration_id,
            "diagnoses": calibration.diagnoses,
        }
        return [pack(name) + pack(values[name]) if values[name] != () else b"" for name in _PAD_TEXTS]

    def set_pad_texts(self) -> None:
        """Take the pads' own texts over."""
        self.pad_texts, self.pad_text_ends = _text_memory(self.own_texts), _ends_of(self.own_texts)
        longest = max(np.diff(np.asarray(self.pad_text_ends)[:: len(_PAD_TEXTS)]))
        size = np.asarray(self.text_ends).max() + longest + _MAX_VALUE_BYTES
        self.buffer = np.zeros(size, np.uint8).data
        self.message = self.buffer

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
        self.written, self.written_fields = _HEADER_BYTES, 2  # v and session are with the first key
        for row in range(self.field_count):
            _write_field(self, row, pad, pad)
        self.message[0], self.message[1], self.message[2] = 0xDE, 0, self.written_fields
        return self.written


def _field_rows(state: TickState, contact_fields: Sequence[Field[Any]], first_name: int) -> RowArray:
    """Return the FIELD_ROWs of the fields of `wire.Contact`, as declared, then of `wire.ContactPart`.

    `first_name`: number of the first name among the texts.
    """
    rows: list[tuple[int, ...]] = []
    for field in contact_fields:
        name, absence = field.name, int(field.default is not MISSING)
        if name == "parts":
            rows.append(_row(kind=_PARTS, absence=1))
        elif name in _PAD_TEXTS:
            rows.append(_row(kind=_TEXT, absence=absence, integer=_PAD_TEXTS.index(name)))
        elif name in INTEGERS:
            kind = _SECONDS if name in _DURATIONS else _TRUTH if name in _TRUTHS else _INTEGER
            if name in _NAMES:
                kind = _NAME
            integer, default = INTEGERS.index(name), int(field.default is True)
            rows.append(_row(kind=kind, absence=absence, integer=integer, default=default, name=first_name))
            first_name += len(_NAMES.get(name, ()))
        else:
            at = _PLACES_OF_VALUES.get(name)
            plain = "always", name if at is None else "values", slice(0, 1) if at is None else at
            rows.append(_number_row(state, name, absence, _PLACES.get(name, plain)))
    for name in _PART_FIELDS:
        absence = 2 * (name in wire.ContactPart.__optional_keys__)
        rows.append(_number_row(state, name, absence, _PART_PLACES[name]))
    return view_rows(np.array(rows, FIELD_ROW), FIELD_ROW)


def _number_row(state: TickState, name: str, absence: int, place: tuple[str, str, slice]) -> tuple[int, ...]:
    condition, array, at = place
    count = at.stop - at.start
    return _row(
        kind=_SUM if name == "covariance_m2" else _WHOLE if name == "id" else _NUMBERS,
        absence=absence,
        condition=CONDITIONS.index(condition),
        first=state.number_of(array) + at.start,
        step=_PART_STEPS.get(array, getattr(state, array)[0].size),
        count=count if count > 1 else 0,
    )


def _row(**values: int) -> tuple[int, ...]:
    """Return a FIELD_ROW of these values, 0 where none is given."""
    return tuple(values.get(name, 0) for name in FIELD_ROW.names or ())


def _text_memory(texts: Sequence[bytes]) -> memoryview:
    return memoryview(bytearray(b"".join(texts)))


def _ends_of(texts: Sequence[bytes]) -> memoryview[int]:
    """Return where each text begins, and the last ends."""
    return view_memory(np.cumsum([0, *map(len, texts)]))


def _is_fresh(encoder: ContactEncoder, pad: int) -> bool:
    """Return False while samples of a pad are missing."""
    max_silent_ns = 0 if encoder.synchronous[pad] else _MAX_SILENT_PERIODS * encoder.max_sample_period_ns[pad]
    return not encoder.silent_ns[pad] > max_silent_ns


def _read_statuses(encoder: ContactEncoder, pad: int) -> None:
    """Set group, statuses and conditions of a contact; in no frame where none is requested."""
    in_frames = encoder.palm_requested[pad] or encoder.base_requested[pad]
    force = encoder.force_status[pad]
    encoder.integers[_POSITION_STATUS], encoder.integers[_FORCE_STATUS] = encoder.position_status[pad], force
    encoder.integers[_GROUP] = encoder.group_id[pad] if in_frames else 0
    encoder.integers[_PALM_STATUS] = encoder.palm_status[pad] if in_frames else _NOT_COMPUTED
    encoder.integers[_BASE_STATUS] = encoder.base_status[pad] if in_frames else _NOT_COMPUTED
    encoder.integers[_VECTOR_STATUS] = encoder.vector_status[pad]
    encoder.integers[_RADIUS_STATUS] = encoder.radius_status[pad]
    encoder.conditions[_ALWAYS], encoder.conditions[_FRAMES] = True, in_frames
    encoder.conditions[_LOCATED] = _is_located(encoder.contacts, pad)
    encoder.conditions[_STD] = force in (_FORCE_VALID, _FORCE_UNRELIABLE)
    encoder.conditions[_PALM] = encoder.integers[_PALM_STATUS] == _FRAME_VALID
    encoder.conditions[_BASE] = encoder.integers[_BASE_STATUS] == _FRAME_VALID
    encoder.conditions[_MODELLED] = encoder.has_sheet_model[pad]
    encoder.conditions[_VECTOR] = encoder.vector_status[pad] != _NOT_COMPUTED


def _are_known(encoder: ContactEncoder, first: int, count: int) -> bool:
    """Return True if all of these numbers of the state are finite."""
    finite = True
    for i in range(first, first + count):
        if not _is_finite(encoder.state[i]):
            finite = False
    return finite


def _write_field(encoder: ContactEncoder, row: int, pad: int, number: int) -> None:
    """Write a field of the layout with its key, unless it is absent; `number` counts its places."""
    kind = encoder.fields[row].kind
    if kind in (_NUMBERS, _SUM, _WHOLE):
        _write_numbers(encoder, row, pad, number)
    elif kind == _TEXT:
        _write_pad_text(encoder, pad * encoder.pad_text_count + encoder.fields[row].integer)
    elif kind == _PARTS:
        if encoder.parts[2 * pad].position_m[0] == encoder.parts[2 * pad].position_m[0]:
            _write_key(encoder, row)
            _write_parts(encoder, pad)
    else:
        value = encoder.integers[encoder.fields[row].integer]
        if encoder.fields[row].absence and value == encoder.fields[row].default:
            return
        _write_key(encoder, row)
        if kind == _INTEGER:
            _write_integer(encoder, value)
        elif kind == _SECONDS:
            encoder.summed[0] = value * _SECONDS_PER_NS
            _write_bits(encoder.message, encoder.written, encoder.summed_bits[0])
            encoder.written += _NUMBER_BYTES
        elif kind == _NAME:
            name = encoder.fields[row].name + value
            _write_text(encoder, encoder.text_ends[name], encoder.text_ends[name + 1])
        else:
            _write_byte(encoder, 0xC3 if value else 0xC2)


def _write_numbers(encoder: ContactEncoder, row: int, pad: int, number: int) -> None:
    """Write an array of at most 15 numbers, or one; nil or absent where they are unknown."""
    absent, count = encoder.fields[row].absence, encoder.fields[row].count
    first, size = encoder.fields[row].first + number * encoder.fields[row].step, count if count else 1
    is_met = encoder.conditions[encoder.fields[row].condition]
    if not is_met and absent:
        return
    is_known = is_met and _are_known(encoder, first, size)
    is_sum = encoder.fields[row].kind == _SUM
    if is_known and is_sum:
        is_known = _sum_covariance(encoder, first, pad)
    if not is_known and absent == 1:
        return
    _write_key(encoder, row)
    if not is_known:
        _write_byte(encoder, 0xC0)
        return
    if encoder.fields[row].kind == _WHOLE:
        _write_integer(encoder, int(encoder.state[first]))
        return
    if count:
        _write_byte(encoder, 0x90 + count)
    message, end = encoder.message, encoder.written
    for i in range(size):
        _write_bits(message, end, encoder.summed_bits[i] if is_sum else encoder.state_bits[first + i])
        end += _NUMBER_BYTES
    encoder.written = end


def _sum_covariance(encoder: ContactEncoder, first: int, pad: int) -> bool:
    """Set `summed` to a covariance on the pad, plus that of its mount, if the pad's contact has one; return
    True if it is finite."""
    has_mount, finite = _has_mount(encoder.contacts, pad), True
    for i in range(9):
        encoder.summed[i] = encoder.state[first + i]
        if has_mount:
            encoder.summed[i] += encoder.contacts[pad].mount_covariance_m2[i]
        if not _is_finite(encoder.summed[i]):
            finite = False
    return finite


def _write_parts(encoder: ContactEncoder, pad: int) -> None:
    """Write the two contacts of a pad as maps."""
    fields = encoder.written_fields
    in_palm, in_base = encoder.palm_status[pad] == _FRAME_VALID, encoder.base_status[pad] == _FRAME_VALID
    _write_byte(encoder, 0x92)
    for number in range(2 * pad, 2 * pad + 2):
        palm, base = encoder.parts_palm[number].position_m[0], encoder.parts_base[number].position_m[0]
        encoder.conditions[_PART_PALM] = in_palm and _is_finite(palm)
        encoder.conditions[_PART_BASE] = in_base and _is_finite(base)
        encoder.written_fields, header = 0, encoder.written
        _write_byte(encoder, 0x80)
        for row in range(encoder.field_count, encoder.row_count):
            _write_field(encoder, row, pad, number)
        encoder.message[header] = 0x80 + encoder.written_fields
    encoder.written_fields = fields


def _write_text(encoder: ContactEncoder, begin: int, end: int) -> None:
    _copy(encoder.message, encoder.written, encoder.texts, begin, end)
    encoder.written += end - begin


def _copy(message: memoryview[int], at: int, texts: memoryview[int], begin: int, end: int) -> None:
    for i in range(end - begin):
        message[at + i] = texts[begin + i]


def _write_key(encoder: ContactEncoder, row: int) -> None:
    encoder.written_fields += 1
    _write_text(encoder, encoder.text_ends[row], encoder.text_ends[row + 1])


def _write_pad_text(encoder: ContactEncoder, row: int) -> None:
    if encoder.pad_text_ends[row + 1] > encoder.pad_text_ends[row]:
        encoder.written_fields += 1
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
