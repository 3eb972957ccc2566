"""Surfaces of STL files beside closed forms: a disc on a sphere, whose conformal map is known, and planes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import SurfaceTable
from handtouch.field import ElectrodeNetwork, Surface
from handtouch.field.network import SIDES, Electrode
from handtouch.field.triangulation import Triangulation, parse_stl
from tests.meshes import BALL_MM, DISC_MM, disc, disc_on_ball, lifted, mesh_table, stl_bytes
from tests.simulate.surfaces import OUTLINE_TABLES

INSIDE = np.linspace(0.1, 0.9, 9)
PLANE_MM = (30.0, 20.0)


def grid(surface: Surface) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.meshgrid(surface.a * INSIDE, surface.b * INSIDE)
    return x, y


def network(surface: Surface, gap_m: float) -> ElectrodeNetwork:
    electrodes = [Electrode(side, *surface.electrode_span(side, gap_m, gap_m)) for side in SIDES]
    return ElectrodeNetwork.from_sides(surface.a, surface.b, electrodes, 1.0)


def plane(folder: Path, cells: int = 10) -> SurfaceTable:
    """A rectangle in the plane z = 3 mm, its corner at (5, 7) mm, of triangles with a diagonal."""
    way = np.linspace(0, 1, cells + 1)
    s, t = (axis.ravel() for axis in np.meshgrid(way, way, indexing="ij"))
    points = np.column_stack([5 + PLANE_MM[0] * s, 7 + PLANE_MM[1] * t, np.full(s.size, 3.0)])
    number = np.arange(s.size).reshape(cells + 1, -1)
    low, along, across, far = (
        part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:])
    )
    triangles = np.concatenate([np.stack([low, along, far], 1), np.stack([low, far, across], 1)])
    file = folder / "plane.stl"
    file.write_bytes(stl_bytes(points, triangles))
    return mesh_table(file, points[[number[0, 0], number[-1, 0], number[-1, -1], number[0, -1]]])


def test_a_disc_on_a_sphere_has_the_places_and_normals_of_the_closed_form(tmp_path: Path) -> None:
    mesh, exact = disc_on_ball(tmp_path / "disc.stl").build(), OUTLINE_TABLES["outline_on_sphere"].build()
    assert mesh.a / mesh.b == pytest.approx(exact.a / exact.b, rel=2e-5)
    places = mesh.point(*grid(mesh)) - exact.point(*grid(exact))
    away_m = np.linalg.norm(places, axis=0)
    assert np.median(away_m) < 4e-6
    assert away_m.max() < 2e-5
    cosine = (mesh.normal(*grid(mesh)) * exact.normal(*grid(exact))).sum(axis=0)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.3
    np.testing.assert_allclose(mesh.scales(*grid(mesh))[:, 4, 4] * mesh.a, exact.scales(*grid(exact))[:, 4, 4]
                               * exact.a, rtol=3e-3)  # fmt: skip


def test_shares_of_electrodes_with_gaps_are_those_of_the_closed_form(tmp_path: Path) -> None:
    mesh, exact = disc_on_ball(tmp_path / "disc.stl").build(), OUTLINE_TABLES["outline_on_sphere"].build()
    drawn_per_m = 1 + (DISC_MM / (2 * BALL_MM)) ** 2  # lengths of the drawing's edge
    found = network(mesh, 1.5e-3).fractions(*grid(mesh))
    expected = network(exact, 1.5e-3 * drawn_per_m).fractions(*grid(exact))
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_arcs_of_the_edge_are_the_sides_they_cover(tmp_path: Path) -> None:
    surface = disc_on_ball(tmp_path / "disc.stl").build()
    assert surface.perimeter_m is not None
    side, gap = surface.perimeter_m / 4, 1.5e-3
    ends = [(k * side + gap, (k + 1) * side - gap) for k in (3, 1, 0, 2)]  # x0, xa, y0, yb
    ring = ElectrodeNetwork.from_arcs(surface.a, surface.b, surface.perimeter_positions(sorted(ends)), 1.0)
    order = [3, 1, 0, 2]
    np.testing.assert_allclose(
        ring.fractions(*grid(surface))[order], network(surface, gap).fractions(*grid(surface)), atol=1e-5
    )


def test_a_plane_of_triangles_is_the_plane(tmp_path: Path) -> None:
    surface = plane(tmp_path).build()
    assert surface.a / surface.b == pytest.approx(PLANE_MM[0] / PLANE_MM[1], rel=1e-6)
    assert surface.extent_m == pytest.approx((0.03, 0.02), rel=1e-6)
    axes, origin = surface.frame
    x, y = grid(surface)
    points = np.einsum("ij,j...->i...", axes, surface.point(x, y)) + origin[:, None, None]
    expected = [5e-3 + 0.03 * x / surface.a, 7e-3 + 0.02 * y / surface.b, np.full_like(x, 3e-3)]
    np.testing.assert_allclose(points, expected, atol=1e-8)
    np.testing.assert_allclose(
        surface.electrode_span("xa", 1e-3, 2e-3), (surface.b / 20, surface.b * 0.9), rtol=1e-6
    )
    np.testing.assert_allclose(
        surface.electrode_span("yb", 3e-3, 6e-3), (surface.a / 10, surface.a * 0.8), rtol=1e-6
    )


def test_points_off_the_pad_are_nan(tmp_path: Path) -> None:
    surface = plane(tmp_path).build()
    assert np.isnan(surface.point([-0.1, np.nan], [0.0, 0.0])).all()
    assert np.isfinite(surface.point([0.0, surface.a], [0.0, surface.b])).all()


def test_division_keeps_the_surface_and_its_edge() -> None:
    flat, triangles = disc(5)
    surface = Triangulation(np.column_stack([flat, 0 * flat[:, 0]]), triangles)
    with_points, numbers = surface.with_edge_points([0.3, 1.9, 4.0])
    fine = with_points.refined(0.2, with_points.points[numbers], 0.3, 1e-3)
    whole = surface.ring_lengths[-1]
    np.testing.assert_allclose(fine.ring_lengths[-1], whole, rtol=1e-12)
    np.testing.assert_allclose(
        (fine.nearest_on_edge(fine.points[numbers]) - fine.nearest_on_edge(fine.points[numbers[:1]])) % whole,
        [0.0, 1.6, 3.7],
        atol=1e-9,
    )
    corners = fine.points[fine.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    away = np.linalg.norm(corners.mean(axis=1)[:, None] - fine.points[numbers], axis=2).min(axis=1)
    assert (longest <= np.minimum(0.2, np.maximum(0.3 * away, 1e-3))).all()
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(np.pi, rel=0.05)


def test_ascii_files_are_read_as_binary_ones() -> None:
    flat, triangles = disc(3)
    points = lifted(flat)
    text = "solid tip\n"
    for corners in points[triangles].astype(np.float32):
        rows = "\n".join("vertex " + " ".join(map(repr, map(float, corner))) for corner in corners)
        text += f"facet normal 0 0 1\nouter loop\n{rows}\nendloop\nendfacet\n"
    one, other = parse_stl(text.encode()), parse_stl(stl_bytes(points, triangles))
    np.testing.assert_allclose(one.points, other.points, rtol=0, atol=1e-7)
    assert one.triangles.tolist() == other.triangles.tolist()


def test_impossible_files_are_refused_with_a_reason(tmp_path: Path) -> None:
    flat, triangles = disc(4)
    points = lifted(DISC_MM * flat)
    good = disc_on_ball(tmp_path / "good.stl", 4)
    corners = np.stack([good.corner_x_mm, good.corner_y_mm, good.corner_z_mm], axis=1)

    def problem(data: bytes, at: NDArray[np.float64] = corners) -> tuple[str, str]:
        file = tmp_path / "bad.stl"
        file.write_bytes(data)
        return next(mesh_table(file, at).problems())

    assert not list(good.problems())
    assert problem(b"no file") == ("file", "no STL file with triangles")
    hole = np.delete(triangles, 0, axis=0)
    assert "several edges" in problem(stl_bytes(points, hole))[1]
    tetrahedron = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)])
    assert "closed" in problem(stl_bytes(points[[0, -1, -9, -17]], tetrahedron))[1]
    mixed = triangles.copy()
    mixed[3] = mixed[3, ::-1]
    assert "turn differently" in problem(stl_bytes(points, mixed))[1]
    assert problem(stl_bytes(points, triangles), corners[::-1])[0] == "corner_x_mm"
    assert "counter-clockwise" in problem(stl_bytes(points, triangles[:, ::-1]))[1]
    assert "from the edge" in problem(stl_bytes(points, triangles), corners * [1.5, 1.5, 1.0])[1]
    (tmp_path / "bad.stl").unlink()
    assert "No such file" in next(mesh_table(tmp_path / "bad.stl", corners).problems())[1]
