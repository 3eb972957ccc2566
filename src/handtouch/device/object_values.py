"""Object values of one node: defaults of its EDS, values written, and the SDO aborts of CiA 301."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from canopen import ObjectDictionary
from canopen.objectdictionary import datatypes
from canopen.sdo import SdoAbortedError
from canopen.sdo import constants as sdo

from handtouch.config.eds_file import INTEGER_TYPES, variable_at

Address = tuple[int, int]
"""Index and sub-index."""

_FIRST_APPLICATION_INDEX = 0x2000  # objects from here on are not reset with the communication
_SIZED_TYPES = frozenset((datatypes.BOOLEAN, *datatypes.NUMBER_TYPES))


class ObjectValues:
    """Values by index and sub-index; canopen's SDO server calls `get_data` and `set_data`.

    `measured_value` returns the value of a measured object, None for any other; `check_write` may refuse a
    value with SdoAbortedError; `on_written` is called after a value was written.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        measured_value: Callable[[int, int], float | None],
        check_write: Callable[[int, int, int], None],
        on_written: Callable[[int, int, int], None],
    ) -> None:
        self.object_dictionary = dictionary
        self._measured_value, self._check_write, self._on_written = measured_value, check_write, on_written
        self._defaults: dict[Address, bytes] = {}
        self._written: dict[Address, bytes] = {}

    def __contains__(self, address: Address) -> bool:
        return self.find_variable(*address) is not None

    def find_variable(self, index: int, sub: int) -> Any:
        """Return the variable of the dictionary, None if there is none."""
        return variable_at(self.object_dictionary, index, sub)

    def integer_type(self, index: int, sub: int) -> tuple[int, bool] | None:
        """Return bits and signedness; None if there is no such integer."""
        variable = self.find_variable(index, sub)
        return None if variable is None else INTEGER_TYPES.get(variable.data_type)

    def is_real32(self, index: int, sub: int) -> bool:
        """Return True for a REAL32 object."""
        variable = self.find_variable(index, sub)
        return variable is not None and variable.data_type == datatypes.REAL32

    def set_default(self, index: int, sub: int, value: int) -> None:
        """Set the default of an integer, which a reset restores."""
        variable = self.find_variable(index, sub)
        if variable is not None:
            self._defaults[index, sub] = _encode_value(variable, value)

    def set_integer(self, index: int, sub: int, value: int) -> None:
        """Set an integer from inside the node, if there is such an object."""
        variable = self.find_variable(index, sub)
        if variable is not None:
            self._written[index, sub] = _encode_value(variable, value)

    def reset(self, application: bool) -> None:
        """Reset the communication objects, and those of the application if `application`."""
        self._written = {
            address: data
            for address, data in self._written.items()
            if address[0] >= _FIRST_APPLICATION_INDEX and not application
        }

    def get_integer(self, index: int, sub: int, missing: int = 0) -> int:
        """Return the value of an unsigned object, `missing` if there is none."""
        if self.find_variable(index, sub) is None:
            return missing
        return int.from_bytes(self.get_data(index, sub), "little")

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """Return a value as bytes. Raises SdoAbortedError with the codes of CiA 301."""
        variable = self._require_variable(index, subindex)
        if check_readable and not variable.readable:
            raise SdoAbortedError(sdo.ABORT_READ_WRITEONLY)
        value = self._measured_value(index, subindex)
        if value is not None:
            return _encode_value(variable, value)
        for values in (self._written, self._defaults):
            if (index, subindex) in values:
                return values[index, subindex]
        return _initial_value(variable)

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        """Set a value. Raises SdoAbortedError with the codes of CiA 301, and then changes nothing."""
        variable = self._require_variable(index, subindex)
        if check_writable and not variable.writable:
            raise SdoAbortedError(sdo.ABORT_WRITE_READONLY)
        if variable.data_type in _SIZED_TYPES and 8 * len(data) != len(variable):
            raise SdoAbortedError(sdo.ABORT_LENGTH_NOT_MATCHED)
        value = int.from_bytes(data, "little", signed=variable.data_type in datatypes.SIGNED_TYPES)
        if variable.data_type in datatypes.INTEGER_TYPES:
            if variable.max is not None and value > variable.max:
                raise SdoAbortedError(sdo.ABORT_VALUE_TOO_HIGH)
            if variable.min is not None and value < variable.min:
                raise SdoAbortedError(sdo.ABORT_VALUE_TOO_LOW)
        self._check_write(index, subindex, value)
        self._written[index, subindex] = bytes(data)
        self._on_written(index, subindex, value)

    def _require_variable(self, index: int, sub: int) -> Any:
        variable = self.find_variable(index, sub)
        if variable is None:
            known = index in self.object_dictionary
            raise SdoAbortedError(sdo.ABORT_NO_SUBINDEX if known else sdo.ABORT_NOT_IN_OD)
        return variable


def _initial_value(variable: Any) -> bytes:
    """Return the value after a reset: that of the EDS, else 0 for a number; a string has no data then."""
    value = variable.default if variable.value is None else variable.value
    if isinstance(value, str):
        unicode = variable.data_type == datatypes.UNICODE_STRING
        return value.encode("utf-16-le") if unicode else value.encode("latin-1", "replace")
    if value is None and variable.data_type not in _SIZED_TYPES:
        raise SdoAbortedError(sdo.ABORT_NO_DATA_AVAILABLE)
    return _encode_value(variable, value or 0)


def _encode_value(variable: Any, value: Any) -> bytes:
    if isinstance(value, int) and variable.data_type not in datatypes.FLOAT_TYPES:
        bits = len(variable)
        return (value & (1 << bits) - 1).to_bytes(bits // 8, "little")  # 0xFFFF as an int16 is -1
    return bytes(variable.encode_raw(value))
