"""The vectorised pad geometry agrees with each surface's own functions."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handtouch.field import (
    AnisotropicSurface,
    ConeSurface,
    CylinderSurface,
    PlaneSurface,
    PrismSurface,
    RevolutionSurface,
    SphereSurface,
    Surface,
)
from handtouch.hand import PadGeometry

SURFACES: list[Surface] = [
    PlaneSurface(0.05, 0.03),
    CylinderSurface(0.012, 0.03, math.radians(150)),
    CylinderSurface(0.012, 0.03, 2 * math.pi),
    ConeSurface(0.012, 0.008, 0.025, math.radians(200)),
    ConeSurface(0.008, 0.012, 0.025, math.radians(30)),
    SphereSurface(0.011, math.radians(-30), math.radians(60), math.radians(170)),
    AnisotropicSurface(SphereSurface(0.011, math.radians(5), math.radians(70), math.radians(100)), 2.5),
    PrismSurface(0.04, (0.0, 0.006, 0.018, 0.024), (0.0, 0.005, 0.005, 0.0)),
    RevolutionSurface((0.0, 0.01, 0.02, 0.03), (0.012, 0.011, 0.011, 0.008), math.radians(140)),
    AnisotropicSurface(PrismSurface(0.04, (0.0, 0.01, 0.024), (0.0, 0.005, 0.0)), 0.7),
]
MOUNTS = [
    (Rotation.from_rotvec([0.3 * k, -0.2, 0.5]).as_matrix(), np.array([0.01 * k, 0.02, -0.03]))
    for k in range(len(SURFACES))
]
PLACEMENT = PadGeometry([(surface, r, t) for surface, (r, t) in zip(SURFACES, MOUNTS, strict=True)])
INDEX = np.arange(len(SURFACES))


@given(st.floats(0, 1), st.floats(0, 1))
def test_position_normal_and_arc_lengths_equal_the_surfaces_in_the_link_frame(
    along: float, around: float
) -> None:
    x = np.array([along * surface.a for surface in SURFACES])
    y = np.array([around * surface.b for surface in SURFACES])
    placed = PLACEMENT.to_link_frame(INDEX, x, y, np.zeros((len(SURFACES), 2, 2)))
    for k, (surface, (rotation, translation)) in enumerate(zip(SURFACES, MOUNTS, strict=True)):
        # a spline profile is smooth to second order only
        atol = 1e-8 if isinstance(surface, RevolutionSurface) else 1e-9
        np.testing.assert_allclose(
            placed.position_m[k], rotation @ surface.point(x[k], y[k]) + translation, atol=atol
        )
        np.testing.assert_allclose(placed.normal[k], rotation @ surface.normal(x[k], y[k]), atol=1e-6)
        np.testing.assert_allclose(placed.pad_m[k], surface.from_rectangle(x[k], y[k]), atol=atol)


def test_covariance_equals_that_of_finite_differences() -> None:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(len(SURFACES), 2, 2))
    covariance = root @ root.transpose(0, 2, 1)
    x = np.array([0.3 * surface.a for surface in SURFACES])
    y = np.array([0.8 * surface.b for surface in SURFACES])
    placed = PLACEMENT.to_link_frame(INDEX, x, y, covariance)
    step = 1e-7
    by_x = PLACEMENT.to_link_frame(INDEX, x + step, y, covariance).position_m - placed.position_m
    by_y = PLACEMENT.to_link_frame(INDEX, x, y + step, covariance).position_m - placed.position_m
    jacobian = np.stack([by_x, by_y], axis=2) / step
    expected = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    np.testing.assert_allclose(placed.covariance_m2, expected, rtol=2e-4, atol=1e-4)


def test_nan_stays_in_its_own_row() -> None:
    x = np.array([np.nan, *(surface.a / 2 for surface in SURFACES[1:])])
    y = np.array([surface.b / 2 for surface in SURFACES])
    placed = PLACEMENT.to_link_frame(INDEX, x, y, np.zeros((len(SURFACES), 2, 2)))
    assert np.isnan(placed.position_m[0]).all()
    assert np.isfinite(placed.position_m[1:]).all()
