"""Pads whose electrodes lie on the boundary of a rectangle: what their tables and tolerances vary.

Public names: `RectangleNetwork`, `ElectrodeEnd`.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple, Self

import numpy.typing as npt

from handtouch.field._series_resistors import FloatArray, GroundedElectrodes
from handtouch.field.estimate import PointEstimate, estimate


class ElectrodeEnd(NamedTuple):
    """End of an electrode at (x, y); `axis`: 0 where its side is along x, 1 along y."""

    x: float
    y: float
    axis: int


class RectangleNetwork(GroundedElectrodes):
    """A resistive rectangle [0, a] x [0, b] with m electrodes on its boundary; a `ForwardModel`."""

    def estimate(
        self, currents: npt.ArrayLike, noise: npt.ArrayLike, start: npt.ArrayLike | None = None
    ) -> PointEstimate:
        """Return the maximum-likelihood contact from all noisy currents (m, ...); see
        `handtouch.field.estimate`.
        """
        return estimate(self, currents, noise, start)

    @property
    @abstractmethod
    def ends(self) -> tuple[ElectrodeEnd, ...]:
        """Both ends of each electrode, in the order of the channels: (2 m,)."""

    @property
    @abstractmethod
    def centres(self) -> FloatArray:
        """Middle of each electrode, (m, 2)."""

    @abstractmethod
    def with_moved_end(self, end: int, step: float) -> Self:
        """Return the pad with an end (index of `ends`) moved inward, which makes its electrode shorter."""

    @abstractmethod
    def stretched(self, factor: float) -> Self:
        """Return the pad with a, and the electrodes along x, multiplied by a factor."""

    @abstractmethod
    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return R: the sheet's resistance to a contact of radius A at (x, y) is sheet / (2 pi) ln(R / A)."""
