"""The interface of every surface of a sensor, and what surfaces of revolution share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


class Meridian(NamedTuple):
    """The profile at given x: position relative to the pad's centre [m], stretch and direction of travel."""

    axial: FloatArray
    radial: FloatArray
    scale: FloatArray
    cosine: FloatArray  # d axial / du
    sine: FloatArray  # d radial / du


class Surface(ABC):
    """A patch of surface and its conformal rectangle; see `handtouch.field.surface` for the coordinates."""

    @property
    @abstractmethod
    def a(self) -> float:
        """Side of the rectangle along the profile, from electrode x0 to xa [m at the centre of the pad]."""

    @property
    @abstractmethod
    def b(self) -> float:
        """Side of the rectangle around, from electrode y0 to yb [m at the centre of the pad]."""

    @property
    @abstractmethod
    def extent_m(self) -> tuple[float, float]:
        """Size along the surface [m]: length of the profile, and length of the parallel half way along it."""

    @abstractmethod
    def from_rectangle(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Arc lengths (u, v) [m] of the rectangle's (x, y); exact inverse of `to_rectangle`."""

    @abstractmethod
    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Rectangle coordinates (x, y) of the arc lengths (u, v) [m]."""

    @abstractmethod
    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Position in the pad frame [m], shape (3, ...)."""

    @abstractmethod
    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Unit vectors along +x and +y on the surface, in the pad frame, shape (2, 3, ...); orthogonal."""

    @abstractmethod
    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Outward unit normal in the pad frame, shape (3, ...): tangents[0] cross tangents[1]."""

    @abstractmethod
    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Metres on the surface per rectangle unit along x and along y, shape (2, ...).

        A covariance of (x, y) becomes one along the two tangents, in m^2, by cov[i, j] * scales[i] *
        scales[j].
        """

    @np.errstate(all="ignore")
    def scale(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """What divides a contact's radius [m] to give its radius on the rectangle: metres per rectangle unit.

        On an anisotropic sheet a round contact becomes an ellipse, which spreads current as a disc with the
        mean of its half axes for radius does (its logarithmic capacity), so this is the harmonic mean of
        `scales`.
        """
        along, around = self.scales(x, y)
        return np.asarray(2 / (1 / along + 1 / around))


class Revolved(Surface):
    """A meridian swept round an axis; the plane is the case of curvature zero."""

    @property
    @abstractmethod
    def _curvature(self) -> float:
        """1 / r_mid [1/m]."""

    @abstractmethod
    def _meridian(self, x: FloatArray) -> Meridian: ...

    @abstractmethod
    def _arc_length(self, x: FloatArray) -> FloatArray:
        """U of x."""

    @abstractmethod
    def _conformal(self, u: FloatArray) -> FloatArray:
        """X of u."""

    @property
    @abstractmethod
    def _middle(self) -> float:
        """X at u = u_max / 2."""

    @cached_property
    def _tilt(self) -> tuple[float, float]:
        middle = self._meridian(np.float64(self._middle) * np.ones(()))
        return float(middle.cosine), float(middle.sine)

    @np.errstate(all="ignore")
    def from_rectangle(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = pair(x, y)
        return self._arc_length(x), np.asarray(y * self._meridian(x).scale)

    @np.errstate(all="ignore")
    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        u, v = pair(u, v)
        x = self._conformal(u)
        return x, np.asarray(v / self._meridian(x).scale)

    @np.errstate(all="ignore")
    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = pair(x, y)
        at = self._meridian(x)
        across = y - self.b / 2
        angle = across * self._curvature
        # r sin and r (1 - cos), written with sinc so that the plane is no exception
        aside = at.scale * across * np.sinc(angle / np.pi)
        drop = at.scale * across * (angle / 2) * np.sinc(angle / (2 * np.pi)) ** 2
        return self._into_pad_frame(at.axial, aside, at.radial - drop)

    @np.errstate(all="ignore")
    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = pair(x, y)
        at = self._meridian(x)
        angle = (y - self.b / 2) * self._curvature
        cos, sin = np.cos(angle), np.sin(angle)
        along = self._into_pad_frame(at.cosine, at.sine * sin, at.sine * cos)
        around = self._into_pad_frame(np.zeros_like(cos), cos, -sin)
        return np.stack([along, around])

    @np.errstate(all="ignore")
    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = pair(x, y)
        at = self._meridian(x)
        angle = (y - self.b / 2) * self._curvature
        return self._into_pad_frame(-at.sine, at.cosine * np.sin(angle), at.cosine * np.cos(angle))

    @np.errstate(all="ignore")
    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = pair(x, y)
        scale = self._meridian(x).scale
        return np.stack([scale, scale])

    @np.errstate(all="ignore")
    def scale(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = pair(x, y)
        return self._meridian(x).scale

    def _into_pad_frame(self, axial: FloatArray, aside: FloatArray, radial: FloatArray) -> FloatArray:
        cos, sin = self._tilt
        return np.stack([cos * axial + sin * radial, aside, cos * radial - sin * axial])


def pair(first: npt.ArrayLike, second: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Both as float64 arrays of one shape, infinity as NaN."""
    one, two = np.broadcast_arrays(np.asarray(first, np.float64), np.asarray(second, np.float64))
    return np.where(np.isinf(one), np.nan, one), np.where(np.isinf(two), np.nan, two)


def ratio_or_one(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Numerator / denominator, 1 where the denominator vanishes (expm1(t) / t and its like)."""
    vanishes = denominator == 0
    return np.asarray(np.where(vanishes, 1.0, numerator / np.where(vanishes, 1.0, denominator)))


def check_lengths(**lengths: float) -> None:
    """Raise ValueError for the first that is not positive and finite."""
    for name, length in lengths.items():
        if not (length > 0 and math.isfinite(length)):
            raise ValueError(f"{name} must be positive and finite, got {length}")


def check_arc(arc_rad: float) -> None:
    """Raise ValueError unless 0 < arc <= 2 pi."""
    if not 0 < arc_rad <= 2 * math.pi:
        raise ValueError(f"arc_rad must be above 0 and at most 2 pi, got {arc_rad}")
