"""Simulated pads on the facets of an STL file: geometry and potentials beside those of `handtouch.field`."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from handtouch.field import AnisotropicSurface, ElectrodeNetwork, Surface
from handtouch.field.network import SIDES, Electrode
from handtouch.simulate.mesh_geometry import SimulatedMesh
from handtouch.simulate.mesh_solver import mesh_mutual_resistance, solve_mesh
from handtouch.simulate.sheet_solver import TABLE_NODES, ArcEnds, ElectrodeGaps, SheetMapBank, SheetMaps
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.unevenness import Unevenness
from tests.simulate.surfaces import MESH_TABLE

GAP_M = 0.8e-3
INSIDE = (TABLE_NODES > 0.15) & (TABLE_NODES < 0.85)


@cache
def shape() -> SimulatedMesh:
    made = simulated_surface(MESH_TABLE)
    assert isinstance(made, SimulatedMesh)
    return made


def gaps_of(made: SimulatedMesh) -> ElectrodeGaps:
    return ElectrodeGaps(*((GAP_M / unit, GAP_M / unit) for unit in made.side_units()))


def network(surface: Surface) -> ElectrodeNetwork:
    electrodes = [Electrode(side, *surface.electrode_span(side, GAP_M, GAP_M)) for side in SIDES]
    return ElectrodeNetwork.from_sides(surface.a, surface.b, electrodes, 1.0)


def test_facets_lie_on_the_smooth_surface_of_the_estimator() -> None:
    made, surface = shape(), MESH_TABLE.build()
    assert (made.length_m, made.arc) == pytest.approx(surface.extent_m, rel=2e-3)
    for x, y in ((0.5, 0.5), (0.1, 0.3), (0.8, 0.9), (0.02, 0.5)):
        place = made.point(x * made.length_m, y * made.arc)
        on_rectangle = x * surface.a, y * surface.b
        assert np.linalg.norm(place - surface.point(*on_rectangle)) < 3e-5
        normal = made.normal(x * made.length_m, y * made.arc)
        assert normal @ surface.normal(*on_rectangle) > np.cos(np.radians(3))
        metres = np.diag(made.metres_per_fraction(x, y)) / (surface.a, surface.b)
        np.testing.assert_allclose(metres, surface.scales(*on_rectangle), rtol=0.05)


def test_points_above_and_beside_a_mesh_project_to_its_surface() -> None:
    made = shape()
    for x, y in ((0.5, 0.5), (0.2, 0.3), (0.8, 0.9)):
        at = x * made.length_m, y * made.arc
        foot = made.project((made.point(*at) + 0.3e-3 * made.normal(*at))[None])
        np.testing.assert_allclose(foot.fraction[0], (x, y), atol=2e-3)
        assert foot.height_m[0] == pytest.approx(0.3e-3, abs=1e-5)
    edge, inside = (made.point(x * made.length_m, made.arc / 2) for x in (0.0, 0.05))
    assert made.project((edge + 0.2 * (edge - inside))[None]).fraction[0, 0] < 0


def check_maps(maps: SheetMaps, surface: Surface, shares: float, log_radius: float) -> None:
    nodes = TABLE_NODES[INSIDE]
    x, y = np.meshgrid(surface.a * nodes, surface.b * nodes, indexing="ij")
    pad = network(surface)
    found = maps.table[:, INSIDE][:, :, INSIDE]
    np.testing.assert_allclose(found[:-1], pad.fractions(x, y), atol=shares)
    np.testing.assert_allclose(
        found[-1], np.log(pad.spreading_radius(x, y) * surface.scale(x, y)), atol=log_radius
    )
    np.testing.assert_allclose(maps.conductance, pad.conductance, rtol=3e-3)


def test_shares_radii_and_conductances_agree_with_the_estimator() -> None:
    check_maps(solve_mesh(shape(), gaps_of(shape()), Unevenness()), MESH_TABLE.build(), 6e-4, 0.03)


def test_anisotropic_meshes_agree_with_the_estimator() -> None:
    made = replace(shape(), resistivity_ratio=1.5)
    check_maps(
        solve_mesh(made, gaps_of(made), Unevenness()),
        AnisotropicSurface(MESH_TABLE.build(), 1.5),
        6e-4,
        0.03,
    )


def test_electrodes_on_arcs_of_the_edge_are_those_of_its_sides() -> None:
    made = shape()
    corners = made.elements.corners_m
    arcs: ArcEnds = tuple(
        (float(corners[side] + GAP_M), float(corners[side + 1] - GAP_M)) for side in (3, 1, 0, 2)
    )
    one, other = (solve_mesh(made, each, Unevenness()) for each in (arcs, gaps_of(made)))
    np.testing.assert_allclose(one.table[:4], other.table[:4], atol=1e-9)


def test_an_uneven_mesh_has_less_share_where_it_resists_more() -> None:
    """A sheet that resists more towards xa sends it less: exp(-c) of the field there to first order."""
    slope = 0.2
    uneven = solve_mesh(shape(), gaps_of(shape()), Unevenness(((1, 0),), (-slope,)))  # more at xa
    even = solve_mesh(shape(), gaps_of(shape()), Unevenness())
    middle = len(TABLE_NODES) // 2
    assert uneven.table[1, middle, middle] < even.table[1, middle, middle] - 0.01
    assert uneven.table[0, middle, middle] > even.table[0, middle, middle] + 0.01
    np.testing.assert_allclose(uneven.table[:4].sum(axis=0), 1, atol=1e-9)


def test_mutual_resistance_is_symmetrical_and_tends_to_the_contacts_own() -> None:
    made = shape()
    green, bank = (
        mesh_mutual_resistance(made, gaps_of(made)),
        SheetMapBank([solve_mesh(made, gaps_of(made), Unevenness())]),
    )
    one, other = np.array([[0.3, 0.5], [0.4, 0.5]]), np.array([[0.6, 0.4], [0.7, 0.6]])
    near = np.full(2, 1e-4)
    np.testing.assert_allclose(
        green.resistance_ohm(one, other, near), green.resistance_ohm(other, one, near), rtol=5e-3
    )
    log_radius = bank.look_up(np.zeros(2, np.intp), *one)[0][-1]
    own = (log_radius - np.log(near)) / (2 * np.pi)  # of a ring of that radius
    np.testing.assert_allclose(green.resistance_ohm(one, one, near), own, rtol=5e-3)


def test_resized_meshes_are_longer_and_wider_about_their_middle() -> None:
    resized = shape().resized(0.4e-3, -0.3e-3)
    assert resized.length_m - shape().length_m == pytest.approx(0.4e-3, rel=0.3)
    assert resized.arc - shape().arc == pytest.approx(-0.3e-3, rel=0.3)
    middles = [made.point(made.length_m / 2, made.arc / 2) for made in (shape(), resized)]
    np.testing.assert_allclose(middles[0], middles[1], atol=1e-5)
    assert shape().resized(0.0, 0.0) == shape()
