"""Types of numpy's arrays by what they hold.

Public names: `FloatArray`, `IntArray` (indices), `BoolArray`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
