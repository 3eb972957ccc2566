"""Memory of arrays as the stages take it: flat memoryviews, which Python reads as its own numbers.

Public names: `view_memory`, `slices_of`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def view_memory(array: NDArray[Any]) -> memoryview[Any]:
    """Return the memory of an array of numbers or truth values, flat.

    Raises ValueError for an array that isn't contiguous, as a copy would be other memory.
    """
    if not array.flags.c_contiguous:
        raise ValueError(f"an array of shape {array.shape} isn't contiguous")
    memory: memoryview[Any] = (array.view(np.uint8) if array.dtype == np.bool_ else array).reshape(-1).data
    return memory


def slices_of(**sizes: int) -> dict[str, slice]:
    """Return the place of each named value in a row of numbers, in the order given."""
    places, first = {}, 0
    for name, size in sizes.items():
        places[name] = slice(first, first + size)
        first += size
    return places
