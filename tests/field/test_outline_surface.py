"""Pads of any outline as surfaces: conformal rectangle, electrodes, positions in space."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from handtouch.config import SurfaceTable, surface_table
from handtouch.core.stages.tables import PadSurface
from handtouch.field import BoundaryElectrode, Outline, OutlineNetwork
from handtouch.field.network import SIDES, Electrode, ElectrodeNetwork
from handtouch.field.surface_base import Surface
from tests.simulate.surfaces import OUTLINE_TABLES

GAP_M = 0.6e-3
kinds = pytest.mark.parametrize("kind", OUTLINE_TABLES)


def table(kind: str, **changes: Any) -> SurfaceTable:
    keys = OUTLINE_TABLES[kind].model_dump(exclude={"kind", "resistivity_ratio"})
    return surface_table(OUTLINE_TABLES[kind].kind, **(keys | changes))


def inner(surface: Surface, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    sides = np.random.default_rng(3).uniform(0.05, 0.95, (2, count))
    return surface.a * sides[0], surface.b * sides[1]


@kinds
def test_fractions_of_the_rectangle_are_those_of_the_outline_itself(kind: str) -> None:
    made = OUTLINE_TABLES[kind]
    surface = made.build()
    rectangle = ElectrodeNetwork.from_sides(
        surface.a,
        surface.b,
        [Electrode(side, *surface.electrode_span(side, GAP_M, GAP_M)) for side in SIDES],
        1.0,
    )
    bulges = [math.tan(math.radians(turn) / 4) for turn in made.edge_turn_deg]
    vertices = [(1e-3 * x, 1e-3 * y) for x, y in zip(made.outline_x_mm, made.outline_y_mm, strict=True)]
    outline = Outline(vertices, bulges).at_origin()
    corners = [1e-3 * corner for corner in made.corners_mm]
    whole = outline.perimeter()
    y0, xa, yb, x0 = (
        BoundaryElectrode((begin + GAP_M) % whole, (end - GAP_M) % whole)
        for begin, end in zip(corners, [*corners[1:], corners[0]], strict=True)
    )
    direct = OutlineNetwork(outline, (x0, xa, y0, yb), 1.0)
    x, y = inner(surface)
    u, v = surface.from_rectangle(x, y)
    np.testing.assert_allclose(rectangle.fractions(x, y), direct.fractions(u, v), rtol=0, atol=3e-6)
    np.testing.assert_allclose(rectangle.conductance, direct.conductance, rtol=1e-4)
    if kind != "outline_on_sphere":  # whose scale isn't that of the drawing
        radius = rectangle.spreading_radius(x, y) * surface.scale(x, y)
        np.testing.assert_allclose(radius, direct.spreading_radius(u, v), rtol=1e-4)


@kinds
def test_tangents_and_normals_are_derivatives_of_points(kind: str) -> None:
    surface = OUTLINE_TABLES[kind].build()
    (x, y), step = inner(surface), 1e-7
    along = (surface.point(x + step, y) - surface.point(x - step, y)) / (2 * step)
    around = (surface.point(x, y + step) - surface.point(x, y - step)) / (2 * step)
    for slope, tangent, scale in zip(
        (along, around), surface.tangents(x, y), surface.scales(x, y), strict=True
    ):
        np.testing.assert_allclose(slope, scale * tangent, rtol=0, atol=1e-6 * np.abs(slope).max())
    crossed = np.cross(along, around, axis=0)
    np.testing.assert_allclose(crossed / np.linalg.norm(crossed, axis=0), surface.normal(x, y), atol=1e-6)


@kinds
def test_drawing_and_rectangle_are_inverse_maps(kind: str) -> None:
    surface = OUTLINE_TABLES[kind].build()
    x, y = inner(surface)
    back = surface.to_rectangle(*surface.from_rectangle(x, y))
    np.testing.assert_allclose(back, [x, y], rtol=0, atol=1e-9 * surface.a)
    width, height = surface.extent_m
    off = surface.to_rectangle([-0.2 * width, 1.3 * width], [0.5 * height, 0.5 * height])
    assert np.isnan(off).all()


@kinds
def test_contacts_are_placed_to_a_thousandth_of_the_pad(kind: str) -> None:
    surface = OUTLINE_TABLES[kind].build()
    nodes = PadSurface(surface, np.eye(3), np.zeros(3)).nodes
    cells = nodes.shape[1] - 1
    at = (np.arange(cells) + 0.5) / cells
    x, y = np.meshgrid(surface.a * at, surface.b * at)
    value, by_x, by_y, by_both = np.moveaxis(nodes[0], -2, 0)

    def middle(low_high: Any, slopes: Any, axis: int) -> Any:
        low, high = (np.moveaxis(low_high, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        rise, fall = (np.moveaxis(slopes, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        return np.moveaxis((low + high) / 2 + (rise - fall) / 8, 0, axis)

    found = middle(middle(value, by_x, 1), middle(by_y, by_both, 1), 0)[..., :3]
    error = np.linalg.norm(found - np.moveaxis(surface.point(x, y), 0, -1), axis=-1)
    assert error.max() < 3e-3 * max(surface.extent_m)  # next to a vertex between electrodes' ends
    assert np.quantile(error, 0.98) < 1e-4 * max(surface.extent_m)


def test_a_disc_on_a_sphere_is_a_cap() -> None:
    made = OUTLINE_TABLES["outline_on_sphere"]
    surface = made.build()
    ball_m, drawn_m = 1e-3 * made.radius_mm, 1e-3 * made.outline_x_mm[0]
    edge = np.linspace(0.2, 0.8, 5)
    points = surface.point(surface.a * edge, np.zeros(5))
    np.testing.assert_allclose(
        np.linalg.norm(points + np.array([[0], [0], [ball_m]]), axis=0), ball_m, rtol=1e-12
    )
    height = -2 * ball_m * drawn_m**2 / (4 * ball_m**2 + drawn_m**2)
    np.testing.assert_allclose(points[2], height, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"edge_turn_deg": [180.0, 180.0, 0.0]}, "edge_turn_deg", "needs 2 values, has 3"),
        ({"corners_mm": [1.0, 2.0]}, "corners_mm", "needs 4 values"),
        ({"corners_mm": [10.0, 1.0, 20.0, 30.0]}, "corners_mm", "counter-clockwise"),
        ({"corners_mm": [1.0, 10.0, 20.0, 300.0]}, "corners_mm", "mm long; must be 0 to that"),
        ({"edge_turn_deg": [-180.0, -180.0]}, "outline_x_mm", "reverse them"),
        ({"resistivity_ratio": 1.5}, "resistivity_ratio", "must be 1"),
    ],
)
def test_impossible_outlines_are_refused_with_key_and_remedy(
    changes: dict[str, Any], key: str, text: str
) -> None:
    ((found, remedy),) = table("outline_on_sphere", **changes).problems()
    assert found == key
    assert text in remedy
