"""Surfaces: conformal maps, exact inverses, common pad frames, errors by name."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

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

FloatArray = npt.NDArray[np.float64]

lengths = st.floats(1e-3, 0.3)
arcs = st.floats(0.05, 2 * math.pi)
unit = st.floats(0.02, 0.98)


@st.composite
def cones(draw: st.DrawFn) -> ConeSurface:
    near, far, slack = draw(lengths), draw(lengths), draw(st.floats(1.0, 5.0))
    return ConeSurface(near, far, max(abs(far - near) * slack, 1e-3), draw(arcs))


@st.composite
def spheres(draw: st.DrawFn) -> SphereSurface:
    start = draw(st.floats(-1.4, 1.3))
    return SphereSurface(draw(lengths), start, start + draw(st.floats(0.05, 1.45 - start)), draw(arcs))


@st.composite
def revolutions(draw: st.DrawFn) -> RevolutionSurface:
    step = draw(st.floats(2e-3, 1e-2))
    radii = draw(st.lists(st.floats(4e-3, 6e-3), min_size=2, max_size=6))
    return RevolutionSurface(tuple(step * i for i in range(len(radii))), tuple(radii), draw(arcs))


smooth: st.SearchStrategy[Surface] = st.one_of(
    st.builds(PlaneSurface, lengths, lengths),
    st.builds(CylinderSurface, lengths, lengths, arcs),
    cones(),
    spheres(),
    revolutions(),
)
prisms = st.builds(
    PrismSurface, lengths, st.just((0.0, 0.01, 0.02, 0.025)), st.just((0.0, 0.004, 0.0, -0.01))
)
anything: st.SearchStrategy[Surface] = st.one_of(
    smooth, prisms, st.builds(AnisotropicSurface, smooth, st.floats(0.1, 10.0))
)


def derivative(f: Callable[[FloatArray], FloatArray], at: float, scale: float) -> FloatArray:
    """Central difference of fourth order; `scale` is the length over which f changes."""
    h = 1e-3 * scale
    low2, low1, up1, up2 = (f(np.array(at + k * h)) for k in (-2, -1, 1, 2))
    return np.asarray((8 * (up1 - low1) - (up2 - low2)) / (12 * h))


@given(surface=anything, s=unit, t=unit)
def test_map_to_the_surface_and_back_is_the_identity(surface: Surface, s: float, t: float) -> None:
    x, y = s * surface.a, t * surface.b
    u, v = surface.from_rectangle(x, y)
    x_again, y_again = surface.to_rectangle(u, v)
    assert abs(x_again - x) < 1e-11 * surface.a
    assert abs(y_again - y) < 1e-11 * surface.b
    assert 0 <= u <= surface.extent_m[0]


@given(surface=smooth, s=unit, t=unit)
def test_the_map_is_conformal(surface: Surface, s: float, t: float) -> None:
    x, y = s * surface.a, t * surface.b
    length = 0.1 * min(surface.a, surface.b)
    along = derivative(lambda at: surface.point(at, y), x, length)
    around = derivative(lambda at: surface.point(x, at), y, length)
    scale = float(surface.scale(x, y))
    assert np.linalg.norm(along) == pytest.approx(scale, rel=1e-5)
    assert np.linalg.norm(around) == pytest.approx(scale, rel=1e-5)
    assert abs(along @ around) < 1e-5 * scale**2


@given(surface=st.one_of(smooth, st.builds(AnisotropicSurface, smooth, st.floats(0.1, 10.0))), s=unit, t=unit)
def test_tangents_and_scales_are_the_derivatives_of_the_point(surface: Surface, s: float, t: float) -> None:
    x, y = s * surface.a, t * surface.b
    tangents, scales = surface.tangents(x, y), surface.scales(x, y)
    steps = np.array([surface.a, surface.b]).min() * 0.1
    along = derivative(lambda at: surface.point(at, y), x, steps)
    around = derivative(lambda at: surface.point(x, at), y, steps)
    assert along == pytest.approx(tangents[0] * scales[0], rel=1e-4, abs=1e-5 * scales[0])
    assert around == pytest.approx(tangents[1] * scales[1], rel=1e-4, abs=1e-5 * scales[1])


@given(surface=anything, s=unit, t=unit)
def test_tangents_and_normal_are_a_right_handed_frame(surface: Surface, s: float, t: float) -> None:
    x, y = s * surface.a, t * surface.b
    frame = np.vstack([surface.tangents(x, y), surface.normal(x, y)[None]])
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-13)
    assert np.linalg.det(frame) == pytest.approx(1.0)


@given(surface=anything)
def test_all_shapes_share_the_pad_frame(surface: Surface) -> None:
    """The pad frame: origin on the surface at its centre, z outward, x towards electrode xa, y towards yb."""
    x, y = surface.to_rectangle(surface.extent_m[0] / 2, surface.extent_m[1] / 2)
    size = max(surface.extent_m)
    assert y == pytest.approx(surface.b / 2)
    assert surface.point(x, y) == pytest.approx(np.zeros(3), abs=1e-11 * size)
    assert surface.tangents(x, y) == pytest.approx(np.eye(3)[:2], abs=1e-9)
    assert surface.normal(x, y) == pytest.approx([0, 0, 1], abs=1e-9)


@given(surface=smooth)
def test_a_rectangle_unit_is_a_metre_at_the_centre(surface: Surface) -> None:
    x, y = surface.to_rectangle(surface.extent_m[0] / 2, surface.extent_m[1] / 2)
    assert surface.scale(x, y) == pytest.approx(1.0)
    assert surface.b == pytest.approx(surface.extent_m[1])


@given(radius=lengths, length=lengths, arc=arcs, s=unit, t=unit)
def test_points_of_a_cylinder_are_at_its_radius(
    radius: float, length: float, arc: float, s: float, t: float
) -> None:
    pad = CylinderSurface(radius, length, arc)
    px, py, pz = pad.point(s * pad.a, t * pad.b)
    assert math.hypot(py, pz + radius) == pytest.approx(radius)
    assert px == pytest.approx((s - 0.5) * length, abs=1e-12)


@given(pad=spheres(), s=unit, t=unit)
def test_points_of_a_sphere_are_at_its_radius_and_its_normal_is_radial(
    pad: SphereSurface, s: float, t: float
) -> None:
    x, y = s * pad.a, t * pad.b
    from_centre = pad.point(x, y) + np.array([0, 0, pad.radius_m])
    assert from_centre == pytest.approx(pad.radius_m * pad.normal(x, y), abs=1e-9 * pad.radius_m)


@given(pad=spheres(), s=unit, t=unit)
def test_sphere_may_point_to_either_pole(pad: SphereSurface, s: float, t: float) -> None:
    mirrored = SphereSurface(pad.radius_m, -pad.from_rad, -pad.to_rad, pad.arc_rad)
    x, y = s * pad.a, t * pad.b
    assert mirrored.a == pad.a
    assert mirrored.point(x, y) == pytest.approx(pad.point(x, y))


def test_nearly_straight_cone_approaches_a_cylinder() -> None:
    cone, cylinder = ConeSurface(0.01, 0.01 * (1 + 1e-13), 0.03, 2.0), CylinderSurface(0.01, 0.03, 2.0)
    x, y = np.meshgrid(np.linspace(0, 0.03, 7), np.linspace(0, 0.02, 5))
    assert cone.a == pytest.approx(cylinder.a, rel=1e-12)
    assert cone.point(x, y) == pytest.approx(cylinder.point(x, y), abs=1e-13)
    assert ConeSurface(0.01, 0.01, 0.03, 2.0).point(x, y) == pytest.approx(cylinder.point(x, y), abs=1e-15)


def test_the_rectangle_of_a_cone_is_the_logarithm_of_its_unrolled_sector() -> None:
    """Theory: log(radius) and the unrolled angle; unrolled radius = r / sin(half angle)."""
    cone = ConeSurface(0.006, 0.009, 0.02, 2.5)
    sine = (0.009 - 0.006) / 0.02
    assert cone.a / cone.b == pytest.approx(math.log(0.009 / 0.006) / (2.5 * sine), rel=1e-14)


def test_the_rectangle_of_a_sphere_is_mercators() -> None:
    pad = SphereSurface(0.01, 0.2, 1.1, 2.5)
    mercator = math.asinh(math.tan(1.1)) - math.asinh(math.tan(0.2))
    assert pad.a / pad.b == pytest.approx(mercator / 2.5, rel=1e-14)


def test_revolution_through_points_of_a_cone_equals_it() -> None:
    cone = ConeSurface(0.006, 0.009, 0.02, 2.5)
    height = math.sqrt(0.02**2 - 0.003**2)
    steps = (0.0, 0.3, 0.35, 1.0)
    pad = RevolutionSurface(tuple(height * s for s in steps), tuple(0.006 + 0.003 * s for s in steps), 2.5)
    x, y = np.meshgrid(np.linspace(0, cone.a, 9), np.linspace(0, cone.b, 5))
    assert pad.a == pytest.approx(cone.a, rel=1e-13)
    assert pad.point(x, y) == pytest.approx(cone.point(x, y), abs=0.02e-12)
    assert pad.normal(x, y) == pytest.approx(cone.normal(x, y), abs=1e-9)


def test_revolution_through_points_of_a_sphere_approaches_it() -> None:
    """A cubic spline through n points of a smooth profile is off by n^-4."""
    ball = SphereSurface(0.01, 0.1, 1.1, 2.0)

    def error(count: int) -> float:
        latitude = np.linspace(0.1, 1.1, count)
        pad = RevolutionSurface(tuple(0.01 * np.sin(latitude)), tuple(0.01 * np.cos(latitude)), 2.0)
        x, y = np.meshgrid(np.linspace(0.1, 0.9, 9) * ball.a, np.linspace(0, ball.b, 5))
        return float(np.abs(pad.point(x, y) - ball.point(x, y)).max())

    assert error(41) < 1e-9
    assert error(21) / error(41) > 10


def test_direction_of_a_profile_makes_no_difference() -> None:
    axial, radius = (0.0, 0.004, 0.009), (0.008, 0.007, 0.004)
    pad, flipped = (
        RevolutionSurface(axial, radius, 2.0),
        RevolutionSurface(tuple(-z for z in axial), radius, 2.0),
    )
    assert flipped.point(0.003, 0.002) == pytest.approx(pad.point(0.003, 0.002), abs=1e-15)


def test_prism_of_many_faces_approaches_a_cylinder() -> None:
    angle = np.linspace(-1.0, 1.0, 2000)
    prism = PrismSurface(0.03, tuple(0.01 * np.sin(angle)), tuple(0.01 * np.cos(angle)))
    cylinder = CylinderSurface(0.01, 0.03, 2.0)
    x, y = np.meshgrid(np.linspace(0, 0.03, 4), np.linspace(0.0003, 0.0197, 13))
    assert prism.b == pytest.approx(cylinder.b, rel=1e-6)
    assert prism.point(x, y) == pytest.approx(cylinder.point(x, y), abs=1e-8)
    assert prism.normal(x, y) == pytest.approx(cylinder.normal(x, y), abs=2e-3)


def test_an_anisotropic_sheet_makes_a_long_pad_electrically_square() -> None:
    pad = AnisotropicSurface(PlaneSurface(0.03, 0.01), 1 / 9)
    assert pad.a == pytest.approx(pad.b)
    assert pad.extent_m == (0.03, 0.01)
    assert np.array(pad.from_rectangle(pad.a, pad.b)) == pytest.approx([0.03, 0.01])


def test_a_round_contact_on_an_anisotropic_sheet_keeps_the_capacity_of_its_ellipse() -> None:
    pad = AnisotropicSurface(PlaneSurface(0.03, 0.01), 4.0)
    half_axes = 0.001 / pad.scales(0.0, 0.0)
    assert half_axes == pytest.approx([0.002, 0.001])
    assert 0.001 / pad.scale(0.0, 0.0) == pytest.approx(half_axes.mean())


@pytest.mark.parametrize(
    "pad",
    [
        PlaneSurface(0.03, 0.02),
        CylinderSurface(0.01, 0.03, 2.0),
        ConeSurface(0.006, 0.009, 0.02, 2.5),
        SphereSurface(0.01, 0.2, 1.1, 2.5),
        RevolutionSurface((0.0, 0.01, 0.02), (0.008, 0.007, 0.004), 2.0),
        PrismSurface(0.03, (0.0, 0.01, 0.02), (0.0, 0.002, 0.0)),
        AnisotropicSurface(PlaneSurface(0.03, 0.02), 2.0),
    ],
    ids=lambda pad: type(pad).__name__,
)
class TestArguments:
    def test_broadcast_and_keep_shape(self, pad: Surface) -> None:
        x, y = np.linspace(0, pad.a, 4)[:, None], np.linspace(0, pad.b, 3)
        assert pad.point(x, y).shape == (3, 4, 3)
        assert pad.tangents(x, y).shape == (2, 3, 4, 3)
        assert pad.normal(x, y).shape == (3, 4, 3)
        assert pad.scales(x, y).shape == (2, 4, 3)
        assert pad.scale(x, y).shape == (4, 3)
        assert pad.from_rectangle(x, y)[1].shape == (4, 3)
        assert pad.point([], []).shape == (3, 0)

    def test_nan_stays_in_its_own_element(self, pad: Surface) -> None:
        x = np.array([0.3, np.nan, 0.6]) * pad.a
        y = np.array([0.4, 0.4, 0.4]) * pad.b
        for values in (pad.point(x, y), np.array(pad.from_rectangle(x, y)), np.array(pad.to_rectangle(x, y))):
            assert np.isnan(values[..., 1]).any()
            assert np.isfinite(values[..., [0, 2]]).all()

    def test_arguments_are_not_modified(self, pad: Surface) -> None:
        x, y = np.full(2, pad.a / 3), np.full(2, pad.b / 3)
        x.setflags(write=False)
        y.setflags(write=False)
        u, v = pad.from_rectangle(x, y)
        pad.to_rectangle(u, v)
        pad.point(x, y)
        assert not np.shares_memory(u, x)


def test_points_beyond_apex_or_pole_are_nan() -> None:
    cone, ball = ConeSurface(0.01, 0.005, 0.02, 2.0), SphereSurface(0.01, 0.0, 1.0, 2.0)
    assert np.isnan(cone.to_rectangle(0.041, 0.0)[0])
    assert np.isnan(ball.to_rectangle(0.01 * 1.6, 0.0)[0])


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: PlaneSurface(0.0, 0.02), "width_m"),
        (lambda: PlaneSurface(0.01, math.inf), "height_m"),
        (lambda: CylinderSurface(-0.01, 0.02, 1.0), "radius_m"),
        (lambda: CylinderSurface(0.01, 0.02, 6.3), "arc_rad"),
        (lambda: ConeSurface(0.0, 0.02, 0.03, 1.0), "near_radius_m"),
        (lambda: ConeSurface(0.01, math.nan, 0.03, 1.0), "far_radius_m"),
        (lambda: ConeSurface(0.01, 0.05, 0.03, 1.0), "slant_m"),
        (lambda: ConeSurface(0.01, 0.02, 0.03, 0.0), "arc_rad"),
        (lambda: SphereSurface(0.01, -math.pi / 2, 0.0, 1.0), "from_rad"),
        (lambda: SphereSurface(0.01, 0.0, 1.6, 1.0), "to_rad"),
        (lambda: SphereSurface(0.01, 0.3, 0.3, 1.0), "to_rad"),
        (lambda: RevolutionSurface((0.0,), (0.01,), 1.0), "axial_m"),
        (lambda: RevolutionSurface((0.0, 0.01), (0.01,), 1.0), "radius_m"),
        (lambda: RevolutionSurface((0.0, 0.01), (0.01, -0.01), 1.0), "radius_m"),
        (lambda: RevolutionSurface((0.0, 0.0), (0.01, 0.01), 1.0), "axial_m"),
        (lambda: RevolutionSurface((0.0, 0.01, 0.02, 0.03), (0.02, 0.0001, 0.0001, 0.02), 1.0), "radius_m"),
        (lambda: PrismSurface(0.01, (0.0,), (0.0,)), "aside_m"),
        (lambda: PrismSurface(0.01, (0.0, 0.1), (0.0,)), "up_m"),
        (lambda: PrismSurface(0.01, (0.0, 0.0), (0.0, 0.0)), "aside_m"),
        (lambda: AnisotropicSurface(PlaneSurface(0.1, 0.1), 0.0), "resistivity_ratio"),
    ],
)
def test_invalid_parameters_are_rejected_by_name(make: Callable[[], Surface], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make()


def test_drawing_grid_of_a_prism_includes_its_folds() -> None:
    aside, up = (0.0, 0.006, 0.018, 0.024), (0.0, 0.005, 0.005, 0.0)
    prism = PrismSurface(0.04, aside, up)
    folds = np.cumsum(np.hypot(np.diff(aside), np.diff(up)))[:-1]
    for surface in (prism, AnisotropicSurface(prism, 1.44)):
        x, y = surface.grid_lines(8)
        assert np.isin(folds, y).all()
        assert (x[0], x[-1]) == (0.0, surface.a)


@pytest.mark.parametrize(
    ("surface", "x0", "xa", "y0"),
    [
        (PlaneSurface(0.05, 0.03), "the edge", "the edge", "the edge"),
        (CylinderSurface(0.012, 0.03, 2.0), "the end", "the end", "the side"),
        (ConeSurface(0.012, 0.008, 0.025, 2.0), "the wide end", "the narrow end", "the side"),
        (SphereSurface(0.011, -0.5, 1.0, 2.0), "the rim", "the tip", "the side"),
        (
            RevolutionSurface((0.0, 0.01, 0.02), (0.006, 0.008, 0.012), 2.0),
            "the narrow end",
            "the wide end",
            "the side",
        ),
    ],
)
def test_sides_are_described_for_operators(surface: Surface, x0: str, xa: str, y0: str) -> None:
    assert [surface.describe_side(side) for side in ("x0", "xa", "y0", "yb")] == [x0, xa, y0, y0]
