"""The simulator's geometry is that of `handtouch.field`, found on another way."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch import config
from handtouch.hand import surface_of
from handtouch.simulate.shape import shape_of

PLACES = [(0.0, 0.0), (0.5, 0.5), (0.02, 0.9), (0.7, 0.3), (1.0, 1.0)]


@pytest.mark.parametrize("row", range(4))
def test_points_and_normals_are_those_of_the_surface(deployment: config.Deployment, row: int) -> None:
    pad = deployment.hands[0].pads[row]
    shape, surface = shape_of(pad.surface), surface_of(pad)
    assert shape.length_m == pytest.approx(surface.extent_m[0], rel=1e-14)
    for x, y in PLACES:
        s, phi = x * shape.length_m, y * shape.arc
        at = surface.to_rectangle(s, phi * shape.radius(s))
        np.testing.assert_allclose(shape.point(s, phi), surface.point(*at), rtol=0, atol=1e-15)
        np.testing.assert_allclose(shape.normal(s, phi), surface.normal(*at), rtol=0, atol=1e-14)


@pytest.mark.parametrize("row", range(4))
def test_the_plane_map_keeps_angles(deployment: config.Deployment, row: int) -> None:
    shape = shape_of(deployment.hands[0].pads[row].surface)
    s = np.linspace(0.1, 0.9, 9) * shape.length_m
    step = 1e-4 * shape.length_m
    slope = (shape.isothermal(s + step) - shape.isothermal(s - step)) / (2 * step)
    np.testing.assert_allclose(slope, 1 / shape.radius(s), rtol=1e-6)
    assert shape.isothermal(0.0) == 0.0
