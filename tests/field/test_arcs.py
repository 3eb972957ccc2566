"""Electrodes on arcs: the same pad as by electrodes on sides and by boundary integrals."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.field import (
    BoundaryElectrode,
    Electrode,
    ElectrodeNetwork,
    Outline,
    OutlineNetwork,
)

A, B = 0.03, 0.02
PERIMETER = 2 * (A + B)
X, Y = np.array([0.004, 0.015, 0.027]), np.array([0.016, 0.009, 0.003])


def test_arcs_on_sides_are_electrodes_on_sides() -> None:
    """Channels counter-clockwise from y0, where the other has x0, xa, y0, yb."""
    sides = [Electrode("x0", 1e-3, 17e-3), Electrode("xa", 2e-3, 19e-3)]
    sides += [Electrode("y0", 1e-3, 27e-3), Electrode("yb", 3e-3, 28e-3)]
    by_side = ElectrodeNetwork.from_sides(A, B, sides, 2400.0, (10.0, 20.0, 30.0, 40.0))
    spans = [(1e-3, 27e-3), (32e-3, 49e-3), (52e-3, 77e-3), (83e-3, 99e-3)]
    around = ElectrodeNetwork.from_arcs(A, B, spans, 2400.0, (30.0, 20.0, 40.0, 10.0))
    order = [2, 1, 3, 0]
    np.testing.assert_allclose(around.fractions(X, Y), by_side.fractions(X, Y)[order], rtol=1e-12)
    np.testing.assert_allclose(
        around.fractions_with_jacobian(X, Y)[1], by_side.fractions_with_jacobian(X, Y)[1][order], rtol=1e-10
    )
    np.testing.assert_allclose(around.spreading_radius(X, Y), by_side.spreading_radius(X, Y), rtol=1e-12)


def test_electrodes_across_corners_agree_with_boundary_integrals() -> None:
    spans = [(-5e-3, 12e-3), (15e-3, 35e-3), (40e-3, 60e-3), (62e-3, 70e-3), (75e-3, 90e-3)]
    around = ElectrodeNetwork.from_arcs(A, B, spans, 2400.0)
    outline = Outline([(0, 0), (A, 0), (A, B), (0, B)])
    electrodes = [BoundaryElectrode(start % PERIMETER, stop) for start, stop in spans]
    exact = OutlineNetwork(outline, electrodes, 2400.0)
    np.testing.assert_allclose(around.fractions(X, Y), exact.fractions(X, Y), atol=1e-9)
    np.testing.assert_allclose(around.conductance, exact.conductance, atol=1e-9)
    np.testing.assert_allclose(around.spreading_radius(X, Y), exact.spreading_radius(X, Y), rtol=1e-9)


@pytest.mark.parametrize("spans", [[(0, 1e-2), (1e-2, 2e-2)], [(0, 1e-2), (2e-2, 0.101)], [(0, 1e-2)]])
def test_electrodes_that_touch_overlap_or_are_alone_are_rejected(spans: list[tuple[float, float]]) -> None:
    with pytest.raises(ValueError, match=r"arcs|two"):
        ElectrodeNetwork.from_arcs(A, B, spans, 2400.0)
