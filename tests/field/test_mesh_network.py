"""Pads on triangulated surfaces beside boundary integrals, conformal maps and closed forms; STL files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from skfem import Basis, BilinearForm, ElementTriP3, MeshTri, condense, solve
from skfem.helpers import dot, grad

from handtouch.field import BoundaryElectrode, MeshNetwork, Outline, OutlineNetwork, read_stl

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
SHEET = 1000.0
STARTS = math.pi / 2 * np.arange(4)
WIDTH = math.pi / 3


def disc(rings: int) -> tuple[FloatArray, IntArray]:
    """Points (n, 2) and triangles of a disc of radius 1 about 0, 6 k points on ring k."""
    rounds = [2 * np.pi * np.arange(6 * k) / (6 * k) for k in range(1, rings + 1)]
    z = np.concatenate([[0], *(k / rings * np.exp(1j * q) for k, q in enumerate(rounds, 1))])

    def number(ring: int, place: int) -> int:
        return 1 + 3 * ring * (ring - 1) + place % (6 * ring) if ring else 0

    triangles = []
    for ring in range(1, rings + 1):
        for sector in range(6):
            for j in range(ring):
                outer, inner = sector * ring + j, sector * (ring - 1) + j
                triangles.append((number(ring, outer), number(ring, outer + 1), number(ring - 1, inner)))
                if j < ring - 1:
                    between = number(ring - 1, inner), number(ring, outer + 1), number(ring - 1, inner + 1)
                    triangles.append(between)
    return np.stack([z.real, z.imag], axis=1), np.array(triangles)


def lifted(flat: FloatArray, radius: float) -> FloatArray:
    """Return points (n, 3) of a sphere that touches the plane at 0, by inverse stereographic projection."""
    squared = (flat**2).sum(axis=1) / (2 * radius)
    scale = 1 / (1 + squared / (2 * radius))
    return np.column_stack([scale[:, None] * flat, -scale * squared])


def ends(radius: float) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    angles = np.stack([STARTS, STARTS + WIDTH], axis=1).ravel()
    points = lifted(np.stack([np.cos(angles), np.sin(angles)], axis=1), radius).reshape(-1, 2, 3)
    return [(as_point(start), as_point(stop)) for start, stop in points]


def as_point(at: FloatArray) -> tuple[float, float, float]:
    x, y, z = at.tolist()
    return x, y, z


@pytest.mark.parametrize("radius", [1e9, 1.0], ids=["disc", "cap"])
def test_a_disc_and_a_cap_have_the_fractions_of_the_disc_they_are_mapped_from(
    radius: float,
) -> None:
    """With errors below three times the square of the edges' length over the extent."""
    exact = OutlineNetwork(Outline.circle(1.0), [BoundaryElectrode(s, s + WIDTH) for s in STARTS], SHEET)
    rng = np.random.default_rng(1)
    z = 0.8 * np.sqrt(rng.uniform(size=100)) * np.exp(2j * np.pi * rng.uniform(size=100))
    expected = exact.fractions(z.real + 1, z.imag + 1)
    at = lifted(np.stack([z.real, z.imag], axis=1), radius)
    for rings in (8, 16):
        flat, triangles = disc(rings)
        points = lifted(flat, radius)
        pad = MeshNetwork(points, triangles, ends(radius), SHEET)
        x, y = at[:, 0] - points[:, 0].min(), at[:, 1] - points[:, 1].min()
        most = 3 / (2 * rings) ** 2
        assert pad.fractions(x, y) == pytest.approx(expected, abs=most)
        assert pad.conductance == pytest.approx(exact.conductance, abs=most)
        assert pad.fractions(x, y).sum(axis=0) == pytest.approx(np.ones(100), abs=1e-12)


def strip() -> tuple[FloatArray, IntArray]:
    """Points and triangles of a rectangle of 2 by 1."""
    x, y = np.meshgrid(np.linspace(0, 2, 33), np.linspace(0, 1, 17), indexing="ij")
    corner = (17 * np.arange(32)[:, None] + np.arange(16)).ravel()
    lower = np.stack([corner, corner + 17, corner + 18], axis=1)
    upper = np.stack([corner, corner + 18, corner + 1], axis=1)
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), np.concatenate([lower, upper])


SIDES = [((0.0, 1.0, 0.0), (0.0, 0.0, 0.0)), ((2.0, 0.0, 0.0), (2.0, 1.0, 0.0))]
"""Whole left and right sides."""


def test_the_potential_of_a_strip_is_the_integral_of_its_varying_resistance() -> None:
    points, triangles = strip()
    centres = points[triangles].mean(axis=1)
    pad = MeshNetwork(points, triangles, SIDES, SHEET, relative_resistance=np.exp(centres[:, 0]))
    x, y = np.random.default_rng(2).uniform(0, 1, (2, 50)) * [[2], [1]]
    fractions, jacobian = pad.fractions_with_jacobian(x, y)
    whole = math.expm1(2)
    assert fractions[1] == pytest.approx(np.expm1(x) / whole, abs=3e-4)
    assert jacobian[1, 0] == pytest.approx(np.exp(x) / whole, abs=0.03)
    assert pad.conductance == pytest.approx(np.array([[1, -1], [-1, 1]]) / whole, rel=1e-3)


def test_a_resistance_that_varies_along_and_across_equals_finite_elements_of_third_order() -> None:
    def resistance(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(np.exp(0.8 * x * y + 0.5 * np.sin(3 * y - x)))

    conduction = BilinearForm(lambda u, v, w: dot(grad(u), grad(v)) / resistance(*w.x))
    basis = Basis(MeshTri.init_tensor(np.linspace(0, 2, 17), np.linspace(0, 1, 9)), ElementTriP3())
    operator = conduction.assemble(basis)
    right = basis.get_dofs(lambda x: x[0] > 2 - 1e-9)
    held = np.concatenate([basis.get_dofs(lambda x: x[0] < 1e-9).flatten(), right.flatten()])
    values = np.zeros(basis.N)
    values[right.flatten()] = 1.0
    values = solve(*condense(operator, x=values, D=held))
    points, triangles = strip()
    centres = points[triangles].mean(axis=1)
    pad = MeshNetwork(points, triangles, SIDES, SHEET, relative_resistance=resistance(*centres[:, :2].T))
    x, y = np.random.default_rng(3).uniform(0.02, 0.98, (2, 50)) * [[2], [1]]
    assert pad.fractions(x, y)[1] == pytest.approx(basis.probes(np.stack([x, y])) @ values, abs=5e-4)
    assert pad.conductance[1, 1] == pytest.approx(values @ operator @ values, rel=1e-3)


def test_a_sloped_strip_is_a_longer_one() -> None:
    """The same triangles on a slope of 45 degrees have root 2 of the length."""
    points, triangles = strip()
    lift = [0.0, 0.0, 1.0] * points[:, :1]
    tilted = [((a[0], a[1], a[0]), (b[0], b[1], b[0])) for a, b in SIDES]
    pad = MeshNetwork(points + lift, triangles, tilted, SHEET)
    assert pad.conductance[0, 0] == pytest.approx(1 / (2 * math.sqrt(2)), rel=1e-9)
    assert pad.fractions(0.5, 0.3) == pytest.approx([0.75, 0.25], abs=1e-9)


def test_points_off_the_surface_and_nan_give_nan() -> None:
    points, triangles = strip()
    pad = MeshNetwork(points, triangles, SIDES, SHEET, series_ohm=(0.0, 500.0))
    fractions, jacobian = pad.fractions_with_jacobian([1.0, 2.1, np.nan], [0.5, 0.5, 0.5])
    assert np.isfinite(fractions[:, 0]).all()
    assert np.isnan(fractions[:, 1:]).all()
    assert np.isnan(jacobian[..., 1:]).all()


@pytest.mark.parametrize("binary", [True, False])
def test_an_stl_file_is_read_as_the_triangles_that_were_written(tmp_path: Path, binary: bool) -> None:
    points, triangles = strip()
    corners = points[triangles].astype("<f4")
    path = tmp_path / "pad.stl"
    if binary:
        records = np.zeros(len(corners), [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
        records["c"] = corners
        path.write_bytes(b"pad".ljust(80) + np.uint32(len(corners)).tobytes() + records.tobytes())
    else:
        facets = "".join(
            "facet normal 0 0 1\nouter loop\n"
            + "".join(f"vertex {x:.7g} {y:.7g} {z:.7g}\n" for x, y, z in corner)
            + "endloop\nendfacet\n"
            for corner in corners
        )
        path.write_text(f"solid pad\n{facets}endsolid pad\n")
    vertices, found = read_stl(path)
    assert len(vertices) == len(points)
    assert vertices[found] == pytest.approx(corners.astype(float), abs=1e-6)
    pad = MeshNetwork(vertices, found, SIDES, SHEET)
    assert pad.fractions(0.5, 0.3) == pytest.approx([0.75, 0.25], abs=1e-6)


def test_impossible_meshes_are_rejected(tmp_path: Path) -> None:
    points, triangles = strip()
    with pytest.raises(ValueError, match="touches another"):
        MeshNetwork(points, triangles, [SIDES[0], ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0))], SHEET)
    with pytest.raises(ValueError, match="at least two"):
        MeshNetwork(points, triangles, SIDES[:1], SHEET)
    with pytest.raises(ValueError, match="relative_resistance"):
        MeshNetwork(points, triangles, SIDES, SHEET, relative_resistance=np.zeros(len(triangles)))
    with pytest.raises(ValueError, match="several edges"):
        MeshNetwork(points, np.delete(triangles, 300, axis=0), SIDES, SHEET)
    with pytest.raises(ValueError, match="edge-on"):
        MeshNetwork(points[:, [0, 2, 1]], triangles, SIDES, SHEET)
    empty = tmp_path / "empty.stl"
    empty.write_text("solid\nendsolid\n")
    with pytest.raises(ValueError, match="no STL file"):
        read_stl(empty)
