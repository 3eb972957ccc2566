"""Arrays in payloads are recognised with every numpy: from 2.5 on, NDArray is an alias of its own kind."""

from __future__ import annotations

from dataclasses import make_dataclass
from typing import Any, TypeVar

import numpy as np
import pytest
from typing_extensions import TypeAliasType

from handtouch.wire.codec import WireError, check_fields
from handtouch.wire.columns import is_array

_Scalar = TypeVar("_Scalar", bound=np.generic)
_Alias: Any = TypeAliasType("NDArray", np.ndarray[Any, np.dtype[_Scalar]], type_params=(_Scalar,))  # type: ignore[arg-type]


@pytest.mark.parametrize("hint", [np.ndarray[Any, np.dtype[np.float64]], _Alias[np.float64]])
def test_an_array_is_checked_whatever_numpy_calls_its_type(hint: Any) -> None:
    assert is_array(hint)
    payload = make_dataclass("Payload", [("position", hint)])
    assert check_fields("inputs", {"position": [1, 2.5]}, payload)["position"].tolist() == [1.0, 2.5]
    with pytest.raises(WireError, match="position must be a list of numbers"):
        check_fields("inputs", {"position": "x"}, payload)
