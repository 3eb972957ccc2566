"""Curved pads, gaps and spreading against finite elements that know nothing of conformal maps.

The elements (scikit-fem, bilinear) solve the current's continuity on the surface itself, in arc length u and
angle: radius(u) is their only knowledge of its shape. A current is injected at a node and the reactions of
grounded nodes are what the electrodes collect.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve
from skfem import Basis, BilinearForm, ElementQuad1, MeshQuad, asm
from skfem.helpers import grad

from handtouch.field import (
    ConeSurface,
    RevolutionSurface,
    SphereSurface,
    Surface,
)
from handtouch.field.network import SIDES, ElectrodeNetwork
from handtouch.field.rectangle import Rectangle

FloatArray = npt.NDArray[np.float64]


class Shape(NamedTuple):
    """A surface under test and, independently, its radius at arc length u."""

    surface: Surface
    radius: Callable[[FloatArray], FloatArray]
    arc: float


CONE = Shape(ConeSurface(0.006, 0.011, 0.02, 2.0), lambda u: 0.006 + 0.25 * u, 2.0)
SPHERE = Shape(SphereSurface(0.01, -0.2, 1.1, 2.0), lambda u: 0.01 * np.cos(u / 0.01 - 0.2), 2.0)
SHAPES = pytest.mark.parametrize("shape", [CONE, SPHERE], ids=["cone", "sphere"])
INSIDE = ((0.5, 0.5), (0.25, 0.625), (0.75, 0.875))  # of the length, of the arc; on every mesh


def collected(
    shape: Shape, cells: int, at: tuple[float, float], bare: dict[str, tuple[float, float]] | None = None
) -> FloatArray:
    """Fractions x0, xa, y0, yb of a current injected at `at`; `bare`: ends of the electrodes, u or angle."""
    length, arc = shape.surface.extent_m[0], shape.arc
    ends = bare or {}
    u = graded(length, cells, [at[0] * length, *ends.get("y0", ())])
    angle = graded(arc, cells, [at[1] * arc, *ends.get("x0", ())])
    mesh = MeshQuad.init_tensor(u, angle)
    stiffness = assemble(mesh, shape.radius)
    nodes = {
        "x0": (mesh.p[0] == 0, mesh.p[1]),
        "xa": (mesh.p[0] == u[-1], mesh.p[1]),
        "y0": (mesh.p[1] == 0, mesh.p[0]),
        "yb": (mesh.p[1] == angle[-1], mesh.p[0]),
    }
    share = np.zeros((4, mesh.p.shape[1]))
    for row, side in zip(share, SIDES, strict=True):
        on_side, along = nodes[side]
        low, high = ends.get(side, (0.0, np.inf))
        row[on_side & (along >= low) & (along <= high)] = 1.0
    held = share.sum(axis=0)
    share /= np.maximum(held, 1.0)  # a corner is shared by two sides
    free = np.flatnonzero(held == 0)
    source = int(np.argmin(np.hypot((mesh.p[0] - at[0] * length) / length, (mesh.p[1] - at[1] * arc) / arc)))
    load = np.zeros(mesh.p.shape[1])
    load[source] = 1.0
    potential = np.zeros_like(load)
    potential[free] = spsolve(stiffness[free][:, free].tocsc(), load[free])
    return np.asarray(share @ (load - stiffness @ potential))


def graded(length: float, cells: int, through: list[float]) -> FloatArray:
    """Nodes from 0 to length, at most length / cells apart, some at given places."""
    stops = np.unique(np.concatenate([[0.0, length], through]))
    pieces = [
        np.linspace(low, high, max(1, round(cells * (high - low) / length)), endpoint=False)
        for low, high in itertools.pairwise(stops)
    ]
    return np.append(np.concatenate(pieces), length)


def assemble(mesh: MeshQuad, radius: Callable[[FloatArray], FloatArray]) -> csr_matrix:
    @BilinearForm  # type: ignore[untyped-decorator, unused-ignore]
    def conduction(u, v, w):  # type: ignore[no-untyped-def]
        r = radius(w.x[0])
        return r * grad(u)[0] * grad(v)[0] + grad(u)[1] * grad(v)[1] / r

    return csr_matrix(asm(conduction, Basis(mesh, ElementQuad1())))


def mapped(shape: Shape, at: tuple[float, float]) -> tuple[float, float]:
    """The same place on the conformal rectangle."""
    u = at[0] * shape.surface.extent_m[0]
    x, y = shape.surface.to_rectangle(u, at[1] * shape.arc * shape.radius(np.array(u)))
    return float(x), float(y)


@SHAPES
def test_elements_converge_quadratically_to_the_conformal_solution(shape: Shape) -> None:
    rectangle = Rectangle(shape.surface.a, shape.surface.b)
    exact = np.stack([rectangle.side_fractions(*mapped(shape, at)) for at in INSIDE])
    errors = [
        np.abs(np.stack([collected(shape, cells, at) for at in INSIDE]) - exact).max()
        for cells in (16, 32, 64)
    ]
    assert errors[-1] < 2e-4
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.3)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.15)


@SHAPES
def test_rectangular_approximation_has_an_error_that_refinement_keeps(shape: Shape) -> None:
    """Its length by its mid-length arc: off by more than fifty times the error of a 64 x 64 mesh."""
    flat = Rectangle(*shape.surface.extent_m)
    shortcut = np.stack([flat.side_fractions(at[0] * flat.a, at[1] * flat.b) for at in INSIDE])
    elements = np.stack([collected(shape, 64, at) for at in INSIDE])
    assert np.abs(shortcut - elements).max() > 0.01


@SHAPES
def test_location_from_element_currents_is_the_injection_point(shape: Shape) -> None:
    rectangle = Rectangle(shape.surface.a, shape.surface.b)
    for at in INSIDE:
        where = rectangle.locate(collected(shape, 64, at))
        u, v = shape.surface.from_rectangle(where.x, where.y)
        length = shape.surface.extent_m[0]
        arc = shape.arc * float(shape.radius(np.array(at[0] * length)))
        assert np.hypot(u - at[0] * length, v - at[1] * arc) < 4e-4 * length


def test_spline_profile_reproduces_its_surface() -> None:
    latitude = np.linspace(-0.2, 1.1, 41)
    pad = RevolutionSurface(tuple(0.01 * np.sin(latitude)), tuple(0.01 * np.cos(latitude)), 2.0)
    shape = SPHERE._replace(surface=pad)
    exact = Rectangle(pad.a, pad.b).side_fractions(*mapped(shape, INSIDE[1]))
    assert collected(shape, 64, INSIDE[1]) == pytest.approx(exact, abs=2e-4)


@SHAPES
def test_gaps_on_a_curved_pad(shape: Shape) -> None:
    """Ends of electrodes leave a square root behind, so elements converge with their size: extrapolated."""
    surface = shape.surface
    gap = 0.15 * min(surface.a, surface.b)
    pad = ElectrodeNetwork(surface.a, surface.b, gap, 1000.0)
    along, _ = surface.from_rectangle(np.array([gap, surface.a - gap]), 0.0)
    around = np.array([gap, surface.b - gap]) / surface.b * shape.arc
    bare = {side: tuple(map(float, along if side[0] == "y" else around)) for side in SIDES}
    at = INSIDE[1]
    coarse, fine = (collected(shape, cells, at, bare) for cells in (48, 96))  # type: ignore[arg-type]
    exact = pad.currents(*mapped(shape, at))
    assert np.abs(fine - exact).max() < 3e-3
    assert 2 * fine - coarse == pytest.approx(exact, abs=3e-4)


@pytest.mark.parametrize("at", [(0.5, 0.5), (0.25, 0.125), (0.5, 0.0625), (0.125, 0.125)])
def test_spreading_radius_equals_that_of_an_injected_disc(at: tuple[float, float]) -> None:
    """A uniform disc of radius A has the mean potential (ln(R / A) + 1/4) / 2 pi."""
    pad = ElectrodeNetwork(1.0, 1.0, 0.2, 1000.0)
    nodes = np.linspace(0, 1, 161)
    mesh = MeshQuad.init_tensor(nodes, nodes)
    stiffness = assemble(mesh, np.ones_like)
    x, y = mesh.p
    on_x, on_y = np.isin(x, (0.0, 1.0)), np.isin(y, (0.0, 1.0))
    inner_x, inner_y = (x > 0.199) & (x < 0.801), (y > 0.199) & (y < 0.801)
    free = np.flatnonzero(~((on_x & inner_y) | (on_y & inner_x)))
    disc = (np.hypot(x - at[0], y - at[1]) < 0.0501).astype(float)
    load = disc / disc.sum()
    potential = np.zeros_like(load)
    potential[free] = spsolve(stiffness[free][:, free].tocsc(), load[free])
    radius = np.sqrt(disc.sum() / np.pi) / 160
    expected = (np.log(pad.spreading_radius(*at) / radius) + 0.25) / (2 * np.pi)
    assert load @ potential == pytest.approx(expected, rel=0.02)
