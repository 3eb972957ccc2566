"""Prisms: a strip folded along straight lines, as a sensor surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.surface_base import Surface, broadcast_finite, check_lengths, surface_key


@dataclass(frozen=True)
class PrismSurface(Surface):
    """A patch of a prism, a strip bent along lines parallel to x; developable, so rectangle units are metres.

    `length_m`: along x. `aside_m`, `up_m`: corners of the cross-section from electrode y0 to yb, at least
    two; the outside is the side of growing `up_m` where `aside_m` grows. On a fold the normal is that of
    the later face.
    """

    kind: ClassVar[str] = "prism"
    length_m: float = surface_key(
        "length_mm", "along the folds, from electrode x0 to electrode xa", example=30.0
    )
    aside_m: tuple[float, ...] = surface_key(
        "section_aside_mm",
        "corners of the cross-section from electrode y0 to electrode yb: coordinate across the pad",
        above=None,
        is_list=True,
        example=[0.0, 6.0, 18.0, 24.0],
    )
    up_m: tuple[float, ...] = surface_key(
        "section_up_mm",
        "height of the same corners; the outside is up",
        above=None,
        is_list=True,
        example=[0.0, 5.0, 5.0, 0.0],
    )

    @np.errstate(all="ignore")
    def __post_init__(self) -> None:
        check_lengths(length_m=self.length_m)
        if len(self.aside_m) < 2 or not np.isfinite(self.aside_m).all():
            raise ValueError("aside_m must be a sequence of at least two finite numbers")
        if len(self.up_m) != len(self.aside_m) or not np.isfinite(self.up_m).all():
            raise ValueError(f"up_m must have as many finite points as aside_m, {len(self.aside_m)}")
        if not (self._faces[0] > 0).all():
            raise ValueError("aside_m and up_m name the same corner twice running")

    def grid_lines(self, cells: int) -> tuple[FloatArray, FloatArray]:
        x, y = super().grid_lines(cells)
        return x, np.union1d(y, self.folds)

    @property
    def folds(self) -> FloatArray:
        return np.asarray(np.cumsum(self._faces[0])[:-1])

    def describe_side(self, side: str) -> str:  # noqa: ARG002
        return "the edge"

    @property
    def a(self) -> float:
        return self.length_m

    @cached_property
    def b(self) -> float:
        return float(self._faces[0].sum())

    @property
    def extent_m(self) -> tuple[float, float]:
        return self.a, self.b

    @cached_property
    def _faces(self) -> tuple[FloatArray, FloatArray]:
        """Widths (n,) and directions of travel (2, n) of the faces."""
        steps = np.stack([np.diff(self.aside_m), np.diff(self.up_m)])
        widths = np.hypot(*steps)
        return widths, steps / np.where(widths > 0, widths, 1.0)

    def _face(self, y: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
        """Return the index of the face that holds y, and the distance into it."""
        starts = np.concatenate([[0.0], np.cumsum(self._faces[0])[:-1]])
        index = np.clip(np.searchsorted(starts, y, side="right") - 1, 0, starts.size - 1)
        return index, np.asarray(y - starts[index])

    def _section(self, y: FloatArray) -> FloatArray:
        index, into = self._face(y)
        corners = np.stack([np.asarray(self.aside_m, float), np.asarray(self.up_m, float)])
        return np.asarray(corners[:, index] + into * self._faces[1][:, index])

    @cached_property
    def _centre(self) -> tuple[FloatArray, FloatArray]:
        """Position and direction of travel at the middle of the section."""
        middle = np.array(self.b / 2)
        return self._section(middle), self._faces[1][:, self._face(middle)[0]]

    def _into_pad_frame(self, aside: FloatArray, up: FloatArray) -> tuple[FloatArray, FloatArray]:
        cos, sin = self._centre[1]
        return np.asarray(cos * aside + sin * up), np.asarray(cos * up - sin * aside)

    def from_rectangle(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = broadcast_finite(x, y)
        return +x, +y

    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        u, v = broadcast_finite(u, v)
        return +u, +v

    @np.errstate(all="ignore")
    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = broadcast_finite(x, y)
        aside, up = self._section(y)
        return np.stack(
            [
                x - self.length_m / 2,
                *self._into_pad_frame(aside - self._centre[0][0], up - self._centre[0][1]),
            ]
        )

    @np.errstate(all="ignore")
    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = broadcast_finite(x, y)
        cos, sin = self._into_pad_frame(*self._faces[1][:, self._face(y)[0]])
        zero, one = np.zeros_like(x), np.ones_like(x)
        return np.stack([np.stack([one, zero, zero]), np.stack([zero, cos, sin])])

    @np.errstate(all="ignore")
    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        _, (zero, cos, sin) = self.tangents(x, y)
        return np.stack([zero, -sin, cos])

    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, _ = broadcast_finite(x, y)
        return np.ones((2, *x.shape))
