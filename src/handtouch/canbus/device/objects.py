"""The objects of one node: the defaults of its EDS, what SDO writes, and CiA 301's reasons to refuse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from canopen import ObjectDictionary
from canopen.objectdictionary import datatypes
from canopen.sdo import SdoAbortedError
from canopen.sdo import constants as sdo

from handtouch.canbus.objects.eds_file import INTEGERS, variable_at

Address = tuple[int, int]
"""Index and sub-index."""

_APPLICATION = 0x2000  # objects from here on are not reset with the communication
_SIZED = frozenset((datatypes.BOOLEAN, *datatypes.NUMBER_TYPES))


class Objects:
    """Values by index and sub-index; `get_data` and `set_data` are what canopen's SDO server asks for.

    `live` gives the value of an object that is measured, None for any other; `check` may refuse a value with
    SdoAbortedError; `changed` hears of a value that was written.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        live: Callable[[int, int], int | None],
        check: Callable[[int, int, int], None],
        changed: Callable[[int, int, int], None],
    ) -> None:
        self.object_dictionary = dictionary
        self._live, self._check, self._changed = live, check, changed
        self._fixed: dict[Address, bytes] = {}
        self._written: dict[Address, bytes] = {}

    def __contains__(self, address: Address) -> bool:
        return self.find(*address) is not None

    def find(self, index: int, sub: int) -> Any:
        """The variable of the dictionary; None if there is none."""
        return variable_at(self.object_dictionary, index, sub)

    def integer_type(self, index: int, sub: int) -> tuple[int, bool] | None:
        """Bits and signedness; None if there is no such integer."""
        variable = self.find(index, sub)
        return None if variable is None else INTEGERS.get(variable.data_type)

    def preset(self, index: int, sub: int, value: int) -> None:
        """Give an integer another default, which no reset takes away."""
        variable = self.find(index, sub)
        if variable is not None:
            self._fixed[index, sub] = _encode(variable, value)

    def put(self, index: int, sub: int, value: int) -> None:
        """Set an integer from inside the node, if there is such an object."""
        variable = self.find(index, sub)
        if variable is not None:
            self._written[index, sub] = _encode(variable, value)

    def reset(self, application: bool) -> None:
        """Communication objects at their defaults, those of the application only if told so."""
        self._written = {
            address: data
            for address, data in self._written.items()
            if address[0] >= _APPLICATION and not application
        }

    def integer(self, index: int, sub: int, missing: int = 0) -> int:
        """Value of an unsigned object, `missing` without one."""
        if self.find(index, sub) is None:
            return missing
        return int.from_bytes(self.get_data(index, sub), "little")

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """Value as bytes. Raises SdoAbortedError as CiA 301 has it."""
        variable = self._find(index, subindex)
        if check_readable and not variable.readable:
            raise SdoAbortedError(sdo.ABORT_READ_WRITEONLY)
        value = self._live(index, subindex)
        if value is not None:
            return _encode(variable, value)
        for values in (self._written, self._fixed):
            if (index, subindex) in values:
                return values[index, subindex]
        return _initial(variable)

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        """Set a value. Raises SdoAbortedError as CiA 301 has it, and then changes nothing."""
        variable = self._find(index, subindex)
        if check_writable and not variable.writable:
            raise SdoAbortedError(sdo.ABORT_WRITE_READONLY)
        if variable.data_type in _SIZED and 8 * len(data) != len(variable):
            raise SdoAbortedError(sdo.ABORT_LENGTH_NOT_MATCHED)
        value = int.from_bytes(data, "little", signed=variable.data_type in datatypes.SIGNED_TYPES)
        if variable.data_type in datatypes.INTEGER_TYPES:
            if variable.max is not None and value > variable.max:
                raise SdoAbortedError(sdo.ABORT_VALUE_TOO_HIGH)
            if variable.min is not None and value < variable.min:
                raise SdoAbortedError(sdo.ABORT_VALUE_TOO_LOW)
        self._check(index, subindex, value)
        self._written[index, subindex] = bytes(data)
        self._changed(index, subindex, value)

    def _find(self, index: int, sub: int) -> Any:
        variable = self.find(index, sub)
        if variable is None:
            known = index in self.object_dictionary
            raise SdoAbortedError(sdo.ABORT_NO_SUBINDEX if known else sdo.ABORT_NOT_IN_OD)
        return variable


def _initial(variable: Any) -> bytes:
    """Value after a reset: the file's, else 0 for a number; a text without one has no data."""
    value = variable.default if variable.value is None else variable.value
    if isinstance(value, str):
        unicode = variable.data_type == datatypes.UNICODE_STRING
        return value.encode("utf-16-le") if unicode else value.encode("latin-1", "replace")
    if value is None and variable.data_type not in _SIZED:
        raise SdoAbortedError(sdo.ABORT_NO_DATA_AVAILABLE)
    return _encode(variable, value or 0)


def _encode(variable: Any, value: Any) -> bytes:
    if isinstance(value, int) and variable.data_type not in datatypes.FLOAT_TYPES:
        bits = len(variable)
        return (value & (1 << bits) - 1).to_bytes(bits // 8, "little")  # 0xFFFF as an int16 is -1
    return bytes(variable.encode_raw(value))
