"""Where to press, in words: from a pad's surface and mount to directions in the frame of its link.

Public names: `where`, `instruction`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.hand import mount_of, surface_of

from .order import ASKED, Near

_ASIDE = 0.6  # of the greatest component: a direction that has this much is named too
_OPPOSITE: dict[Near, Near] = {"x0": "xa", "xa": "x0", "y0": "yb", "yb": "y0"}
_CLOSER = 0.97  # of the other end's distance from the link's origin: not worth telling otherwise


def where(pad: config.Pad, near: Near) -> str:
    """The place near an electrode: "the end towards +x of the link, away from its origin"."""
    origin, other, place = (_place(pad, fractions) for fractions in _fractions(near))
    text = f"{_part(pad, near)} towards {_direction(place - origin)} of the link"
    here, there = float(np.linalg.norm(place)), float(np.linalg.norm(other))
    if near in ("x0", "xa") and not _CLOSER < here / there < 1 / _CLOSER:
        text += ", away from its origin" if here > there else ", near its origin"
    return text


def instruction(pad: config.Pad, near: Near) -> str:
    """Tell a person where to press, with the place in millimetres of the link's frame."""
    *_, place = (_place(pad, fractions) for fractions in _fractions(near))
    x, y, z = (round(1e3 * value) for value in place.tolist())
    across = "across" if near in ("x0", "xa") else "lengthwise"
    return f"{where(pad, near)}; in the middle {across} (about x {x}, y {y}, z {z} mm)"


def _fractions(near: Near) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    return (0.5, 0.5), ASKED[_OPPOSITE[near]], ASKED[near]


def _place(pad: config.Pad, fractions: tuple[float, float]) -> NDArray[np.float64]:
    """A point of the pad [m] in its link's frame."""
    surface = surface_of(pad)
    rotation, translation = mount_of(pad)
    x, _ = surface.to_rectangle(fractions[0] * surface.extent_m[0], 0.0)
    return np.asarray(rotation @ surface.point(x, fractions[1] * surface.b) + translation)


def _direction(vector: NDArray[np.float64]) -> str:
    """ "+x", or "+x and -z" where it points well aside of an axis."""
    size = np.abs(vector)
    named = [axis for axis in np.argsort(-size) if size[axis] >= _ASIDE * size.max()]
    return " and ".join(f"{'-' if vector[axis] < 0 else '+'}{'xyz'[axis]}" for axis in named[:2])


def _part(pad: config.Pad, near: Near) -> str:
    """What the surface has there: an edge, an end, a side."""
    surface = pad.surface
    if near in ("y0", "yb"):
        return "the edge" if surface.kind == "plane" else "the side"
    if isinstance(surface, config.Sphere):
        here, there = (
            (surface.to_deg, surface.from_deg) if near == "xa" else (surface.from_deg, surface.to_deg)
        )
        return "the tip" if abs(here) > abs(there) else "the rim"
    if isinstance(surface, config.Cone):
        near_mm, far_mm = surface.near_radius_mm, surface.far_radius_mm
        narrow = (far_mm < near_mm) == (near == "xa")
        if min(near_mm, far_mm) < 0.8 * max(near_mm, far_mm):
            return "the narrow end" if narrow else "the wide end"
    return "the edge" if surface.kind == "plane" else "the end"
