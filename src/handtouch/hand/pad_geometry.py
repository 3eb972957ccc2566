"""Transforms contacts on many pads to the frames of their links in one vectorised pass.

Public names: `PadGeometry`, `LinkContacts`.

Most surfaces are a meridian swept about an axis (a plane is the case without curvature). The meridian of
each pad is tabulated once as cubic splines over x, in components along the axis and away from it; the mount
is folded into each pad's basis, so that a tick costs a gather, a few sines and one small matrix product.
Other surfaces are evaluated pad by pad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.field.spline import spline_operator
from handtouch.field.surface import PlaneSurface
from handtouch.field.surface_base import Surface

FloatArray = NDArray[np.float64]
_INTERVALS = 64


@dataclass(frozen=True)
class LinkContacts:
    """Contacts in the frames of their links; n rows."""

    position_m: FloatArray
    """(n, 3)"""
    normal: FloatArray
    """(n, 3), unit vectors, outward"""
    covariance_m2: FloatArray
    """(n, 3, 3) of position_m; singular along the normal, because a contact lies on the surface"""
    pad_m: FloatArray
    """(n, 2) arc lengths from the electrodes x0 and y0"""
    scale_m_per_unit: FloatArray
    """(n,) metres on the surface per unit of the rectangle"""


class PadGeometry:
    """Geometry of the pads of a hand; `to_link_frame` transforms contacts on any of them at once.

    `pads` are (surface, rotation (3, 3), translation (3,)) triples, the mount carrying the pad's frame
    into the link's. Positions are within 1e-8 of a pad's size of the surface's own `point`.
    """

    def __init__(self, pads: Sequence[tuple[Surface, FloatArray, FloatArray]]) -> None:
        self._not_swept = {
            row: (surface, rotation)
            for row, (surface, rotation, _) in enumerate(pads)
            if not surface.is_swept
        }
        pads = [
            (surface if surface.is_swept else PlaneSurface(surface.a, surface.b), rotation, translation)
            for surface, rotation, translation in pads
        ]
        self._origin = np.stack([translation for _, _, translation in pads])
        self._mid_y = np.array([surface.b / 2 for surface, _, _ in pads])
        self._intervals_per_unit = np.array([_INTERVALS / surface.a for surface, _, _ in pads])
        self._curvature = np.array([_sweep_frame(surface)[0] for surface, _, _ in pads])
        self._basis = np.stack([_sweep_frame(surface)[1] @ rotation.T for surface, rotation, _ in pads])
        self._meridian = np.stack([_tabulate_meridian(surface) for surface, _, _ in pads])

    def to_link_frame(
        self, index: NDArray[np.intp], x: FloatArray, y: FloatArray, covariance: FloatArray
    ) -> LinkContacts:
        """Transform contacts at (x, y) [rectangle units, (n,)] with covariance (n, 2, 2) on pads `index`
        (n,).

        NaN in gives NaN out in the same row; points off the pad continue its surface.
        """
        per_x = self._intervals_per_unit.take(index)
        t = x * per_x
        step = np.where(np.isfinite(t), t, 0.0).astype(np.intp)
        interval = np.minimum(np.maximum(step, 0), _INTERVALS - 1)
        cubic = self._meridian[index, interval]  # (n, 4, 7)
        t = (t - interval)[:, None]
        axial, radial, cosine, sine, scale_x, scale_y, u = (
            ((cubic[:, 0] * t + cubic[:, 1]) * t + cubic[:, 2]) * t + cubic[:, 3]
        ).T
        off_middle = y - self._mid_y.take(index)
        half = off_middle * (self._curvature.take(index) / 2)
        across = scale_y * off_middle
        # by the half angle about the axis, exact also on a plane, where it is 0
        chord, cos_half = np.sinc(half / np.pi), np.cos(half)
        sin_half = chord * half
        cos, sin = 1 - 2 * sin_half * sin_half, 2 * sin_half * cos_half
        vectors = np.zeros((len(x), 4, 3))  # rows: point, tangents, normal; columns: axis, radial, aside
        point, along, around, normal = vectors[:, 0], vectors[:, 1], vectors[:, 2], vectors[:, 3]
        point[:, 0] = axial
        point[:, 1] = radial - across * sin_half * chord
        point[:, 2] = across * chord * cos_half
        along[:, 0], along[:, 1], along[:, 2] = cosine, sine * cos, sine * sin
        around[:, 1], around[:, 2] = -sin, cos
        normal[:, 0], normal[:, 1], normal[:, 2] = -sine, cosine * cos, cosine * sin
        vectors = np.matmul(vectors, self._basis.take(index, axis=0))
        tangents = vectors[:, 1:3]
        tangents[:, 0] *= scale_x[:, None]
        tangents[:, 1] *= scale_y[:, None]
        pad_m = np.empty((len(x), 2))
        pad_m[:, 0], pad_m[:, 1] = u, scale_y * y
        contacts = LinkContacts(
            vectors[:, 0] + self._origin.take(index, axis=0),
            vectors[:, 3],
            np.matmul(np.matmul(tangents.transpose(0, 2, 1), covariance), tangents),
            pad_m,
            2 / (1 / scale_x + 1 / scale_y),
        )
        for pad, (surface, rotation) in self._not_swept.items():
            rows = np.flatnonzero(index == pad)
            if len(rows):
                self._evaluate(contacts, rows, pad, surface, rotation, x[rows], y[rows], covariance[rows])
        return contacts

    def _evaluate(
        self,
        contacts: LinkContacts,
        rows: NDArray[np.intp],
        pad: int,
        surface: Surface,
        rotation: FloatArray,
        x: FloatArray,
        y: FloatArray,
        covariance: FloatArray,
    ) -> None:
        """Fill rows of `contacts` with those on one pad, from its surface's own functions."""
        scales = surface.scales(x, y)
        tangents = np.einsum("ij,tjn,tn->nti", rotation, surface.tangents(x, y), scales)
        contacts.position_m[rows] = (rotation @ surface.point(x, y)).T + self._origin[pad]
        contacts.normal[rows] = (rotation @ surface.normal(x, y)).T
        contacts.covariance_m2[rows] = tangents.transpose(0, 2, 1) @ covariance @ tangents
        contacts.pad_m[rows] = np.stack(surface.from_rectangle(x, y), axis=1)
        contacts.scale_m_per_unit[rows] = surface.scale(x, y)


def _sweep_frame(surface: Surface) -> tuple[float, FloatArray]:
    """Return the curvature about the axis [1/m] and the rows axis, radial, aside (3, 3) in the pad frame."""
    quarter = surface.b / 4  # off the centre line; less than a quarter turn, so the sine below has one sign
    aside, turned = surface.tangents(surface.a / 2, np.array([2, 3]) * quarter)[1].T
    sine = float(np.hypot(turned[0], turned[2]))
    radial = -np.array([turned[0], 0.0, turned[2]]) / sine if sine > 0 else np.array([0.0, 0.0, 1.0])
    axis = np.array([radial[2], 0.0, -radial[0]])
    return float(np.arctan2(sine, turned[1])) / quarter, np.stack([axis, radial, aside])


def _tabulate_meridian(surface: Surface) -> FloatArray:
    """Return spline coefficients (intervals, 4, 7), highest power first, each interval of unit length.

    Columns: position along the axis and away from it [m], the same of the unit tangent, metres per rectangle
    unit along x and y, arc length u [m].
    """
    x = np.linspace(0, surface.a, _INTERVALS + 1)
    y = np.full_like(x, surface.b / 2)
    axis, radial, _ = _sweep_frame(surface)[1]
    point, tangent = surface.point(x, y), surface.tangents(x, y)[0]
    columns = np.stack(
        [
            axis @ point,
            radial @ point,
            axis @ tangent,
            radial @ tangent,
            *surface.scales(x, y),
            surface.from_rectangle(x, y)[0],
        ],
        axis=1,
    )
    return np.asarray((spline_operator(_INTERVALS, 3) @ columns)[:, ::-1])
