"""Outlines: positions, areas, and the errors of impossible ones."""

from __future__ import annotations

import math

import numpy as np
import pytest

from handtouch.field import Outline

L_SHAPE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)]


def test_perimeters_and_bounds() -> None:
    assert Outline.circle(2.0).perimeter() == pytest.approx(4 * math.pi, rel=1e-14)
    assert Outline.ellipse(2.0, 1.0).perimeter() == pytest.approx(9.688448220547675, rel=1e-13)
    assert Outline.ellipse(2.0, 1.0).bounds == pytest.approx((0, 0, 4, 2), abs=1e-14)
    stadium = Outline([(0, 0), (2, 0), (2, 1), (0, 1)], [0, 1, 0, 1])
    assert stadium.bounds == pytest.approx((-0.5, 0, 2.5, 1), abs=1e-14)
    assert stadium.at_origin().bounds == pytest.approx((0, 0, 3, 1), abs=1e-14)


@pytest.mark.parametrize("outline", [Outline(L_SHAPE), Outline.ellipse(2.0, 1.0), Outline(L_SHAPE[::-1])])
def test_the_nearest_position_of_a_boundary_point_is_its_own(outline: Outline) -> None:
    for position in np.linspace(0.05, 0.95, 19) * outline.perimeter():
        assert outline.nearest_position(*outline.boundary_point(position)) == pytest.approx(
            position, rel=1e-9
        )


@pytest.mark.parametrize(
    ("outline", "area"),
    [
        (Outline(L_SHAPE), 3.0),
        (Outline(L_SHAPE[::-1]), 3.0),
        (Outline.ellipse(1.0, 0.5), math.pi / 2),
        (Outline([(0, 0), (2, 0)], [1, -0.5]).at_origin(), None),
        (
            Outline([(0, 0), (2, 0), (2, 2), (0, 2)], holes=[Outline.circle(0.5).moved(0.5, 0.5)]),
            4 - math.pi / 4,
        ),
    ],
)
def test_the_points_inside_cover_the_area(outline: Outline, area: float | None) -> None:
    if area is None:  # half a disc less the segment cut off by the other arc
        sweep = 4 * math.atan(0.5)
        radius = 1 / math.sin(sweep / 2)
        area = math.pi / 2 - radius**2 * (sweep - math.sin(sweep)) / 2
    x0, y0, x1, y1 = outline.bounds
    steps = (np.arange(400) + 0.5) / 400
    x, y = np.meshgrid(x0 + (x1 - x0) * steps, y0 + (y1 - y0) * steps)
    assert outline.contains(x, y).mean() * (x1 - x0) * (y1 - y0) == pytest.approx(area, rel=3e-3)


@pytest.mark.parametrize(
    ("vertices", "bulges", "message"),
    [
        ([(0, 0), (1, 1), (1, 0), (0, 1)], None, "edge 0 and edge 2 cross"),
        ([(0, 0), (1, 0), (1, 1), (0.5, 1e-6), (0, 1)], None, "closer than 0.0001"),
        ([(0, 0), (1, 0), (1, 1), (0, 1)], [0, 0, -2, 0], "cross"),
        ([(0, 0), (1, 0), (1, 1), (0, 1)], [0, 0], "4 are needed"),
        ([(0, 0), (1, 0), (1, 0), (0, 1)], None, "two neighbours are equal"),
        ([(0, 0), (1, 0), (1, math.nan)], None, "finite"),
        ([(0, 0), (1, 0), (0.5, 0.01)], None, "corner at vertex 0"),
        ([(0, 0), (1, 0), (1, 5e-5), (0, 1)], None, "an edge is shorter"),
    ],
)
def test_an_impossible_outline_is_rejected(
    vertices: list[tuple[float, float]], bulges: list[float] | None, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Outline(vertices, bulges)


def test_a_hole_outside_is_rejected() -> None:
    square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    with pytest.raises(ValueError, match="not inside"):
        Outline(square, holes=[Outline.circle(0.2).moved(2, 2)])
    with pytest.raises(ValueError, match="cross"):
        Outline(square, holes=[Outline.circle(0.2).moved(0.8, 0.2)])
