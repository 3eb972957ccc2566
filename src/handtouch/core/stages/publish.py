"""Published columns of contacts: values of solved contacts, with their statuses; NaN where there is none.

Public names: `ContactColumns`, `PUBLISHED_SLICES`, `PUBLISHED_VALUES`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handtouch.core.stages.solve import MAX_SQUARED_MISFIT, VALUE_COUNT, VALUE_SLICES

_VALUES, _FIRST = VALUE_COUNT, VALUE_SLICES["pad_m"].start
_COUNT = VALUE_SLICES["covariance_m2"].stop - _FIRST
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
_LOWER_BOUND_ESTIMATE = 1.0  # ForceEstimateStatus
_NAN, _INFINITY = float("nan"), float("inf")
_NOT_COMPUTED = 0  # PositionStatus, ForceStatus
_POSITION_VALID, _POSITION_UNRELIABLE, _POSITION_INVALID = 1, 2, 3
_FORCE_VALID, _FORCE_LOWER_BOUND, _FORCE_UNRELIABLE, _FORCE_INVALID = 1, 2, 3, 4
_EVIDENCE_MISSING = 0  # ForceReliability.UNRELIABLE


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


def _is_finite(values: memoryview[float], first: int, count: int) -> bool:
    """Return True if all of these values are finite."""
    finite = True
    for i in range(first, first + count):
        if not -_INFINITY < values[i] < _INFINITY:
            finite = False
    return finite


def _publish_contact(columns: ContactColumns, pad: int) -> None:
    values, first = columns.values, pad * _VALUES
    for i in range(_COUNT):
        value = values[first + _FIRST + i]
        columns.published[_published_index(columns, pad, i)] = (
            value if -_INFINITY < value < _INFINITY else _NAN
        )
    located = _is_finite(values, first + _FIRST, 2) and _is_finite(values, first + _POSITION, 6)
    position = _POSITION_INVALID if columns.position_requested[pad] else _NOT_COMPUTED
    if located:
        no_point = values[first + _MISFIT] > _MAX_SQUARED_MISFIT
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
        elif values[first + _ESTIMATE] == _LOWER_BOUND_ESTIMATE:
            force = _FORCE_LOWER_BOUND
        elif not columns.known[pad] or columns.reliability[pad] == _EVIDENCE_MISSING:
            force = _FORCE_UNRELIABLE
    columns.force_status[pad] = force
    if value == value and not columns.peak_force_n[pad] >= value:
        columns.peak_force_n[pad] = value
