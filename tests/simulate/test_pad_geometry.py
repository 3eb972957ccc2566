"""The simulator's geometry agrees with that of `handtouch.field`, which is computed independently."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.config import SurfaceTable
from handtouch.field.surface_base import SURFACES
from handtouch.simulate.coarse_sheet import cut_sheet_maps
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_solver import ElectrodeGaps, SheetMaps
from handtouch.simulate.surfaces import simulated_surface
from tests.simulate.surfaces import MESH_TABLE, OUTLINE_TABLES, SURFACE_TABLES

POSITIONS = [(0.0, 0.0), (0.5, 0.5), (0.02, 0.9), (0.7, 0.3), (1.0, 1.0)]
tables = pytest.mark.parametrize("table", SURFACE_TABLES.values(), ids=list(SURFACE_TABLES))


def test_every_surface_of_a_deployment_can_be_simulated() -> None:
    tables = *SURFACE_TABLES.values(), *OUTLINE_TABLES.values(), MESH_TABLE
    assert {table.kind for table in tables} == set(SURFACES)


@tables
def test_points_and_normals_agree_with_field(table: SurfaceTable) -> None:
    shape, surface = simulated_surface(table), table.build()
    assert shape.length_m == pytest.approx(surface.extent_m[0], rel=1e-12)
    for x, y in POSITIONS:
        s, phi = x * shape.length_m, y * shape.arc
        rectangle = surface.to_rectangle(s, phi * shape.radius(s))
        np.testing.assert_allclose(shape.point(s, phi), surface.point(*rectangle), rtol=0, atol=1e-12)
        np.testing.assert_allclose(shape.normal(s, phi), surface.normal(*rectangle), rtol=0, atol=1e-9)


@tables
def test_isothermal_map_is_conformal(table: SurfaceTable) -> None:
    metric = simulated_surface(table).metric
    s = np.linspace(0.1, 0.9, 9) * metric.length_m
    step = 1e-4 * metric.length_m
    slope = (metric.isothermal(s + step) - metric.isothermal(s - step)) / (2 * step)
    np.testing.assert_allclose(slope, 1 / metric.radius(s), rtol=1e-6)
    assert metric.isothermal(0.0) == 0.0


@pytest.mark.parametrize("kind", OUTLINE_TABLES)
def test_outlines_agree_with_field(kind: str) -> None:
    shape, surface = simulated_surface(OUTLINE_TABLES[kind]), OUTLINE_TABLES[kind].build()
    for x, y in ((0.5, 0.5), (0.02, 0.9), (0.7, 0.3)):
        s, phi = x * shape.length_m, y * shape.arc
        rectangle = surface.to_rectangle(*shape.arc_lengths(s, phi))
        np.testing.assert_allclose(shape.point(s, phi), surface.point(*rectangle), rtol=0, atol=1e-9)
        np.testing.assert_allclose(shape.normal(s, phi), surface.normal(*rectangle), rtol=0, atol=1e-9)


@pytest.mark.parametrize("at", [(0.02, 0.02), (0.98, 0.5), (0.5, 0.5)])
def test_places_beside_one_on_an_outline_are_as_far_or_beyond_its_edge(at: tuple[float, float]) -> None:
    outline = OUTLINE_TABLES["outline"].model_copy(
        update={
            "outline_x_mm": (0.0, 24.0, 24.0, 0.0),
            "outline_y_mm": (0.0, 0.0, 18.0, 18.0),
            "edge_turn_deg": (0.0,) * 4,
            "corners_mm": (0.0, 24.0, 42.0, 66.0),
        }
    )
    shape, angle = simulated_surface(outline), np.linspace(0.0, 2 * np.pi, 16)
    vector_m = 2e-3 * np.stack([np.cos(angle), np.sin(angle)])
    found = shape.fractions_beside(np.array([[at[0]], [at[1]]]), vector_m[None])[0]
    expected = np.array([[at[0]], [at[1]]]) + vector_m / [[24e-3], [18e-3]]
    np.testing.assert_allclose(np.clip(found, 0, 1), np.clip(expected, 0, 1), atol=1e-6)


@pytest.mark.parametrize("kind", OUTLINE_TABLES)
def test_resized_outlines_are_longer_and_wider_about_their_middle(kind: str) -> None:
    shape = simulated_surface(OUTLINE_TABLES[kind])
    resized = shape.resized(0.4e-3, -0.3e-3)

    def box(it: SimulatedSurface) -> list[float]:
        way = np.linspace(0, 1, 101)  # resized, the same points bound it
        ends = np.concatenate(
            [[way, 0 * way], [way, 0 * way + 1], [0 * way, way], [0 * way + 1, way]], axis=1
        )
        drawn = np.array([it.arc_lengths(p * it.length_m, q * it.arc) for p, q in ends.T])
        return [float(extent) for extent in np.ptp(drawn, axis=0)]

    growth = np.subtract(box(resized), box(shape))
    np.testing.assert_allclose(growth, [0.4e-3, -0.3e-3], rtol=1e-3)
    assert shape.resized(0.0, 0.0) == shape


@pytest.mark.parametrize(
    "table", (SURFACE_TABLES | OUTLINE_TABLES).values(), ids=list(SURFACE_TABLES | OUTLINE_TABLES)
)
def test_point_above_a_surface_projects_to_its_foot(table: SurfaceTable) -> None:
    shape = simulated_surface(table)
    for x, y in ((0.5, 0.5), (0.1, 0.9), (0.7, 0.3)):
        s, phi = x * shape.length_m, y * shape.arc
        above = shape.point(s, phi) + 1e-3 * shape.normal(s, phi)
        foot = shape.project(above[None])
        np.testing.assert_allclose(foot.fraction[0], (x, y), atol=1e-7)
        np.testing.assert_allclose(foot.height_m, 1e-3, atol=1e-8)
        np.testing.assert_allclose(foot.normal[0], shape.normal(s, phi), atol=1e-6)


@pytest.mark.parametrize("kind", SURFACE_TABLES)
def test_resized_pads_are_longer_and_wider_about_their_middle(kind: str) -> None:
    shape = simulated_surface(SURFACE_TABLES[kind])
    resized = shape.resized(0.4e-3, -0.3e-3)
    assert resized.length_m - shape.length_m == pytest.approx(0.4e-3, rel=1e-6)
    middles = [it.length_m / 2 for it in (shape, resized)]
    widths = [it.arc * float(it.radius(middle)) for it, middle in zip((shape, resized), middles, strict=True)]
    assert widths[1] - widths[0] == pytest.approx(-0.3e-3, rel=1e-6)
    for it, middle in zip((shape, resized), middles, strict=True):
        np.testing.assert_allclose(it.point(middle, it.arc / 2), 0, atol=1e-12)
        np.testing.assert_allclose(it.normal(middle, it.arc / 2), [0.0, 0.0, 1.0], atol=1e-9)
    for x in (0.1, 0.4, 0.8):  # points of equal distance from the middle stay where they are
        s = x * shape.length_m
        moved = resized.point(s + 0.2e-3, resized.arc / 2)
        tolerance = 1e-9 if kind != "revolution" else 3e-4  # similar to the old one, not the same
        np.testing.assert_allclose(moved, shape.point(s, shape.arc / 2), atol=tolerance)
    assert shape.resized(0.0, 0.0) == shape


def test_resized_profiles_keep_their_length_as_curves() -> None:
    resized = simulated_surface(SURFACE_TABLES["revolution"]).resized(0.5e-3, 0.0)
    s = np.linspace(0.0, resized.length_m, 4001)
    points = np.array([resized.point(at, resized.arc / 2) for at in s.tolist()])
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(resized.length_m, rel=1e-6)


def test_a_torn_outline_is_refused_instead_of_simulated_as_a_rectangle() -> None:
    shape = simulated_surface(OUTLINE_TABLES["outline"])
    gaps = ElectrodeGaps(*(4 * ((1e-3, 1e-3),)))
    maps = SheetMaps(np.zeros((4, 4)), np.zeros((5, 2, 2)))
    with pytest.raises(ValueError, match="give the fault to another pad"):
        cut_sheet_maps(shape, gaps, maps, ("x0y0", 1e-3, 1e-3))
