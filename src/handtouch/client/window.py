"""All frames of the last seconds as arrays, for loops that are slower than touch.

Public name: `HandWindow`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.client.hand_arrays import SAMPLED_STATES, HandArrays

_COLUMNS = wire.COLUMNS[wire.HandFrame]


class HandWindow:
    """Frames of one hand and session, oldest first; columns are arrays (n, pads, ...), as attributes.

        window = hand.window(0.1)
        window.t_ns, window.force_n, window.touched

    The columns are those of `HandArrays`: NaN is unknown, and those that no frame of a scene has raise
    LookupError. `touched` is True where a contact is known; where `sampled` is False nobody knows.
    Raises ValueError for frames of different sessions or links.
    """

    def __init__(self, frames: Sequence[wire.HandFrame]) -> None:
        if len({(frame.session, frame.links) for frame in frames}) > 1:
            raise ValueError("the frames are of different sessions or links")
        self.frames = tuple(frames)
        """the messages it was made of"""
        self.links = frames[0].links if frames else ()

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def t_ns(self) -> NDArray[np.int64]:
        """(n,) SYNCs, on the daemon's monotonic clock."""
        return np.array([frame.t_ns for frame in self.frames], np.int64)

    @property
    def lost(self) -> int:
        """Frames between the first and the last that never came, by their numbers."""
        numbers = [frame.seq for frame in self.frames]
        return numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0

    def column(self, name: str) -> NDArray[Any]:
        """Return a column (n, pads, ...) by its name. Raises LookupError where a frame lacks it."""
        if name == "sampled":
            return np.isin(self.state, SAMPLED_STATES)
        if name == "touched":
            return np.asarray(self.state == wire.PadState.TOUCHED)
        if name not in _COLUMNS:
            raise LookupError(f"frames have no column {name!r}; they have {', '.join(_COLUMNS)}")
        data = [getattr(frame, name) for frame in self.frames]
        if self.links and not all(data):
            return np.stack([HandArrays(frame).column(name).array for frame in self.frames])  # raises
        array = _COLUMNS[name].to_array(b"".join(data))
        matrix = (3, 3) if array.shape[1:] == (9,) else array.shape[1:]
        return array.reshape(len(self), len(self.links), *matrix)

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name.startswith("_") or name not in (*_COLUMNS, "sampled", "touched"):
            raise AttributeError(f"a window has no {name!r}; its columns are {', '.join(_COLUMNS)}")
        column = self.column(name)
        self.__dict__[name] = column
        return column

    def __repr__(self) -> str:
        """Return hand, number of samples and their time."""
        if not self.frames:
            return "an empty window"
        seconds = 1e-9 * (self.frames[-1].t_ns - self.frames[0].t_ns)
        return f"{len(self)} frames of hand {self.frames[0].hand} in {seconds:.3f} s, {self.lost} lost"
