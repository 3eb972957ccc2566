"""Pads of any outline against finite elements: an L with a square hole."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem import Basis, ElementTriP3, MeshTri
from skfem.element import Element
from skfem.models.poisson import laplace

from handtouch.field import BoundaryElectrode, Outline, OutlineNetwork

FloatArray = NDArray[np.float64]

VERTICES = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)]
HOLE = [(0.3, 0.3), (0.6, 0.3), (0.6, 0.6), (0.3, 0.6)]
ENDS = [(0.1, 0.6), (2.1, 2.9), (3.5, 4.4), (5.2, 5.9), (6.3, 7.2)]
"""One electrode covers the re-entrant corner; all ends are nodes of a mesh of 0.1."""
POINTS = np.array([[0.15, 0.45, 0.9, 1.5, 0.73], [0.15, 1.4, 0.95, 0.52, 0.21]])
CELL = 0.1


class Elements(NamedTuple):
    """Conductance (m, m) and unit potentials (m, points) of a finite-element solution."""

    conductance: FloatArray
    fractions: FloatArray
    unknowns: int


def solve_elements(
    outline: Outline, ends: list[tuple[float, float]], levels: int, element: Element
) -> Elements:
    """Triangles, halved `levels` times towards corners and electrodes' ends."""
    mesh = MeshTri.init_tensor(*(np.linspace(0, 2, round(2 / CELL) + 1),) * 2)
    mesh = mesh.remove_elements(np.flatnonzero(~outline.contains(*mesh.p[:, mesh.t].mean(axis=1))))
    singular = [(e.start.real, e.start.imag) for edges in outline.contours for e in edges]
    singular += [outline.boundary_point(position) for pair in ends for position in pair]
    for level in range(levels):
        centre = mesh.p[:, mesh.t].mean(axis=1)
        distance = np.min([np.hypot(centre[0] - x, centre[1] - y) for x, y in singular], axis=0)
        mesh = mesh.refined(np.flatnonzero(distance < 1.5 * CELL * 0.5**level))
    basis = Basis(mesh, element)
    stiffness = laplace.assemble(basis).tocsr()
    values = np.zeros((basis.N, len(ends)))
    fixed = np.zeros(basis.N, bool)
    perimeter = outline.perimeter()
    for facet in mesh.boundary_facets():
        x, y = mesh.p[:, mesh.facets[:, facet]].mean(axis=1)
        position = outline.nearest_position(x, y)
        if np.hypot(*np.subtract(outline.boundary_point(position), (x, y))) > 1e-9:
            continue  # on the hole
        for index, (start, stop) in enumerate(ends):
            if (position - start) % perimeter < (stop - start) % perimeter:
                dofs = basis.get_dofs(np.array([facet])).flatten()
                values[dofs, index], fixed[dofs] = 1.0, True
    free = np.flatnonzero(~fixed)
    load = -(stiffness @ values)[free]
    values[free] = splu(stiffness[free][:, free].tocsc()).solve(load)
    at_points = basis.probes(POINTS) @ values
    return Elements(values.T @ (stiffness @ values), np.asarray(at_points.T), basis.N)


def pad_with_hole() -> tuple[Outline, OutlineNetwork]:
    outline = Outline(VERTICES, holes=[Outline(HOLE)])
    return outline, OutlineNetwork(outline, [BoundaryElectrode(*pair) for pair in ENDS], 1000.0)


def test_an_l_shape_with_a_hole_equals_finite_elements() -> None:
    outline, pad = pad_with_hole()
    elements = solve_elements(outline, ENDS, 5, ElementTriP3())
    assert pad.conductance == pytest.approx(elements.conductance, abs=2e-3)
    assert pad.fractions(*POINTS) == pytest.approx(elements.fractions, abs=4e-4)
