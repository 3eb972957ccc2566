"""Interface and registry of sensor surfaces, and the base class of surfaces of revolution.

Public names: `Surface`, `SweptSurface`, `Meridian`, `SURFACES`, `SurfaceKinds`, `SurfaceKey`, `surface_key`,
`surface_keys`, `MIN_CLEARANCE`.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray


class SurfaceKinds(Mapping[str, "type[Surface]"]):
    """Surface classes by the `kind` that a deployment file names; a class that sets `kind` is entered here.

    The module of a kind of this package is imported when its class is first asked for.
    """

    def __init__(self, modules: Mapping[str, str]) -> None:
        self._modules = modules
        self._classes: dict[str, type[Surface]] = {}

    def enter_class(self, kind: str, shape: type[Surface]) -> None:
        """Enter a class; one of the same kind is replaced."""
        self._classes[kind] = shape

    def __getitem__(self, kind: str) -> type[Surface]:
        if kind not in self._classes:
            import_module(f"handtouch.field.{self._modules[kind]}")
        return self._classes[kind]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._modules, **self._classes})

    def __len__(self) -> int:
        return len({**self._modules, **self._classes})


SURFACES = SurfaceKinds(
    {
        **dict.fromkeys(("plane", "cylinder", "cone", "sphere"), "surface"),
        **dict.fromkeys(("outline", "outline_on_cylinder", "outline_on_sphere"), "outline_surface"),
        "prism": "_prism",
        "revolution": "_revolution",
        "mesh": "mesh_surface",
    }
)

MIN_CLEARANCE = 1e-4
"""Shortest edge of an outline, and distance of separate edges, over its larger extent."""
MAX_SIMILAR_END_RATIO = 0.8
"""Ratio of the ends' lengths below which one is called the narrow end."""
_NEAREST_POINTS = 100  # along each side, among which the nearest to a place is taken
_SI_PER_UNIT = {"mm": 1e-3, "deg": math.pi / 180}


@dataclass(frozen=True)
class SurfaceKey:
    """One key of a surface's table in a deployment file; the ending of its name is its unit, mm or deg.

    above, below: exclusive bounds; at_most: inclusive bound, all in the key's unit. is_list: the value is a
    list of numbers. is_file: it is the path of a file, see `embedded_file`. example: a value for the
    reference of keys, where no shipped file has one.
    """

    name: str
    description: str
    above: float | None = None
    below: float | None = None
    at_most: float | None = None
    is_list: bool = False
    is_file: bool = False
    example: Any = None

    def to_si(self, value: Any) -> Any:
        """Return a value of the file, or each of a list, in metres or radians."""
        if self.is_file:
            return value
        scale = _SI_PER_UNIT[self.name.rpartition("_")[2]]
        return tuple(scale * number for number in value) if self.is_list else scale * value


def surface_key(
    name: str,
    description: str,
    *,
    above: float | None = 0.0,
    below: float | None = None,
    at_most: float | None = None,
    is_list: bool = False,
    is_file: bool = False,
    example: Any = None,
) -> Any:
    """Return the dataclass field of a surface whose value a deployment file gives under the key `name`."""
    key = SurfaceKey(name, description, above, below, at_most, is_list, is_file, example)
    return dataclasses.field(metadata={"surface_key": key})


def arc_key() -> Any:
    """Return the field of the angle around the axis, common to all surfaces of revolution."""
    return surface_key(
        "arc_deg",
        "around the axis, from electrode y0 to electrode yb; 360: all round",
        at_most=360.0,
        example=150.0,
    )


def surface_keys(surface: type[Surface]) -> dict[str, SurfaceKey]:
    """Return the keys of a registered surface class by the names of its dataclass fields."""
    return {
        field.name: field.metadata["surface_key"]
        for field in dataclasses.fields(surface)  # type: ignore[arg-type]
        if "surface_key" in field.metadata
    }


class Meridian(NamedTuple):
    """The profile at given x: position relative to the pad's centre [m], stretch and direction of travel."""

    axial: FloatArray
    radial: FloatArray
    scale: FloatArray
    cosine: FloatArray  # d axial / du
    sine: FloatArray  # d radial / du


class Surface(ABC):
    """A patch of surface and its conformal rectangle; see `handtouch.field.surface` for the coordinates.

    A class that a deployment file can name is a dataclass that sets `kind` and whose fields are made by
    `surface_key`. The tables of `handtouch.config`, their checks, schema and error texts follow from that.
    """

    kind: ClassVar[str]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "kind" in cls.__dict__:
            SURFACES.enter_class(cls.kind, cls)

    @classmethod
    def from_keys(cls, values: Mapping[str, Any]) -> Surface:
        """Return the surface with the values of a deployment file, in the file's units, by key."""
        return cls(**{name: key.to_si(values[key.name]) for name, key in surface_keys(cls).items()})

    @classmethod
    def check_keys(cls, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:  # noqa: ARG003
        """Yield (key, remedy) for values that exclude each other; the constructor raises for the rest."""
        return iter(())

    @property
    def folds(self) -> FloatArray:
        """Coordinates y, increasing, of folds along x, at which the normal jumps; empty if there are none."""
        return np.zeros(0)

    @property
    def frame(self) -> tuple[FloatArray, FloatArray]:
        """Axes, the columns of (3, 3), and origin (3,) [m] of the pad frame in the frame that a mount is
        stated for; the same frame but for surfaces that are drawn in one of their own."""
        return np.eye(3), np.zeros(3)

    def describe_side(self, side: str) -> str:
        """Return what an operator sees at side x0, xa, y0 or yb: an edge, an end, a tip."""
        return "the end" if side in ("x0", "xa") else "the side"

    def grid_lines(self, cells: int) -> tuple[FloatArray, FloatArray]:
        """Return coordinates x and y of the lines of a drawing grid of about `cells` cells a side."""
        return np.linspace(0, self.a, cells + 1), np.linspace(0, self.b, cells + 1)

    def electrode_span(self, side: str, low_m: float, high_m: float) -> tuple[float, float]:
        """Return begin and end, in rectangle units along a side, of the electrode that leaves `low_m` and
        `high_m` [m] bare at the side's ends at the lower and the higher coordinate."""
        length_m = self.extent_m[0]
        if side in ("x0", "xa"):
            u_m = 0.0 if side == "x0" else length_m
            _, (start, margin) = self.to_rectangle([u_m, u_m], [low_m, high_m])
            return float(start), float(self.b - margin)
        (start, stop), _ = self.to_rectangle([low_m, length_m - high_m], [0.0, 0.0])
        return float(start), float(stop)

    def edge_m(self, cells: int) -> FloatArray:
        """Return the edge of the unrolled pad, about 2 `cells` points (k, 2): arc length from x0, and
        distance from the centre line."""
        x = np.linspace(0, self.a, cells + 1)
        u, widest = self.from_rectangle(x, np.full_like(x, self.b))
        upper = np.stack([u, widest / 2], axis=1)
        return np.concatenate([upper, (upper * [1, -1])[::-1]])

    def side_lengths_m(self) -> tuple[float, float, float]:
        """Return the lengths along the surface of the profile and of the sides x0 and xa [m]."""
        _, lengths = self.from_rectangle([0.0, self.a], [self.b, self.b])
        return self.extent_m[0], float(lengths[0]), float(lengths[1])

    @property
    def perimeter_m(self) -> float | None:
        """Length of the edge, of surfaces on which electrodes may lie on any parts of it; None for others."""
        return None

    def perimeter_positions(self, ends_m: npt.ArrayLike) -> FloatArray:
        """Return electrodes on arcs (m, 2) of the edge [m] as `ElectrodeNetwork.from_arcs` takes them.

        Begin and end of each, counter-clockwise; positions on the edge are modulo its length.
        """
        raise NotImplementedError

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
        """Return the arc lengths u and v [m], shape (...), at the rectangle's (x, y)."""

    @abstractmethod
    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the rectangle coordinates x and y, shape (...), of the arc lengths (u, v) [m]."""

    def fractions_of_places(self, place_m: FloatArray) -> FloatArray:
        """Return places as fractions (n, 2) of the rectangle.

        place_m: (n, 2) lengths along the surface, as `to_rectangle` takes them, or (n, 3) in the frame of the
        surface's file.
        """
        if place_m.shape[1] == 2:
            x, y = self.to_rectangle(*place_m.T)
            return np.stack([x / self.a, y / self.b], axis=1)
        from scipy.spatial import cKDTree  # not loaded with the package

        axes, origin = self.frame
        way = np.linspace(0, 1, _NEAREST_POINTS)
        at = np.stack(np.meshgrid(way, way), axis=-1).reshape(-1, 2)
        points = self.point(self.a * at[:, 0], self.b * at[:, 1]).T
        wanted = (place_m - origin) @ axes
        at = at[cKDTree(points).query(wanted)[1]]
        x, y = self.a * at[:, 0], self.b * at[:, 1]
        beside = (self.tangents(x, y) * (wanted.T - self.point(x, y))).sum(axis=1) / self.scales(x, y)
        return np.asarray(np.clip(at + beside.T / (self.a, self.b), 0.0, 1.0))

    @abstractmethod
    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the position in the pad frame [m], shape (3, ...)."""

    @abstractmethod
    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return unit vectors along +x and +y on the surface, in the pad frame, shape (2, 3, ...);
        orthogonal.
        """

    @abstractmethod
    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the outward unit normal in the pad frame, shape (3, ...): tangents[0] cross tangents[1]."""

    @abstractmethod
    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return metres on the surface per rectangle unit along x and along y, shape (2, ...).

        A covariance of (x, y) becomes one along the two tangents, in m^2, by cov[i, j] * scales[i] *
        scales[j].
        """

    @np.errstate(all="ignore")
    def scale(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the ratio of a contact's radius [m] to its radius on the rectangle, shape (...).

        On an anisotropic sheet a round contact becomes an ellipse, which spreads current as a disc with the
        mean of its half axes for radius does (its logarithmic capacity), so this is the harmonic mean of
        `scales`.
        """
        along, around = self.scales(x, y)
        return np.asarray(2 / (1 / along + 1 / around))


class SweptSurface(Surface):
    """A meridian swept round an axis; the plane is the case of curvature zero."""

    @property
    @abstractmethod
    def _curvature(self) -> float:
        """1 / r_mid [1/m]."""

    @abstractmethod
    def _meridian(self, x: FloatArray) -> Meridian: ...

    @abstractmethod
    def _arc_length(self, x: FloatArray) -> FloatArray:
        """Return the arc length u at x."""

    @abstractmethod
    def _conformal(self, u: FloatArray) -> FloatArray:
        """Return x at arc length u."""

    @property
    @abstractmethod
    def _middle(self) -> float:
        """Coordinate x half way along the profile, at u = u_max / 2."""

    def describe_side(self, side: str) -> str:
        _, near, far = self.side_lengths_m()
        if side in ("x0", "xa") and min(near, far) < MAX_SIMILAR_END_RATIO * max(near, far):
            return "the narrow end" if (far < near) == (side == "xa") else "the wide end"
        return super().describe_side(side)

    @cached_property
    def _tilt(self) -> tuple[float, float]:
        middle = self._meridian(np.float64(self._middle) * np.ones(()))
        return float(middle.cosine), float(middle.sine)

    @np.errstate(all="ignore")
    def from_rectangle(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = broadcast_finite(x, y)
        return self._arc_length(x), np.asarray(y * self._meridian(x).scale)

    @np.errstate(all="ignore")
    def to_rectangle(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        u, v = broadcast_finite(u, v)
        x = self._conformal(u)
        return x, np.asarray(v / self._meridian(x).scale)

    @np.errstate(all="ignore")
    def point(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = broadcast_finite(x, y)
        at = self._meridian(x)
        across = y - self.b / 2
        angle = across * self._curvature
        # r sin and r (1 - cos), written with sinc so that the plane is no exception
        aside = at.scale * across * np.sinc(angle / np.pi)
        drop = at.scale * across * (angle / 2) * np.sinc(angle / (2 * np.pi)) ** 2
        return self._into_pad_frame(at.axial, aside, at.radial - drop)

    @np.errstate(all="ignore")
    def tangents(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = broadcast_finite(x, y)
        at = self._meridian(x)
        angle = (y - self.b / 2) * self._curvature
        cos, sin = np.cos(angle), np.sin(angle)
        along = self._into_pad_frame(at.cosine, at.sine * sin, at.sine * cos)
        around = self._into_pad_frame(np.zeros_like(cos), cos, -sin)
        return np.stack([along, around])

    @np.errstate(all="ignore")
    def normal(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = broadcast_finite(x, y)
        at = self._meridian(x)
        angle = (y - self.b / 2) * self._curvature
        return self._into_pad_frame(-at.sine, at.cosine * np.sin(angle), at.cosine * np.cos(angle))

    @np.errstate(all="ignore")
    def scales(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = broadcast_finite(x, y)
        scale = self._meridian(x).scale
        return np.stack([scale, scale])

    @np.errstate(all="ignore")
    def scale(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        x, y = broadcast_finite(x, y)
        return self._meridian(x).scale

    def _into_pad_frame(self, axial: FloatArray, aside: FloatArray, radial: FloatArray) -> FloatArray:
        cos, sin = self._tilt
        return np.stack([cos * axial + sin * radial, aside, cos * radial - sin * axial])


def broadcast_finite(first: npt.ArrayLike, second: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both as float64 arrays of one shape, infinity as NaN."""
    one, two = np.broadcast_arrays(np.asarray(first, np.float64), np.asarray(second, np.float64))
    return np.where(np.isinf(one), np.nan, one), np.where(np.isinf(two), np.nan, two)


def ratio_or_one(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Return numerator / denominator, 1 where the denominator vanishes (expm1(t) / t and similar)."""
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
