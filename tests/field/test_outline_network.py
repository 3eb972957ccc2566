"""Pads of any outline: closed forms, conformal invariance, finite elements, laws of potential theory."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from numpy.typing import NDArray

from handtouch.field import BoundaryElectrode, ElectrodeNetwork, Outline, OutlineNetwork
from handtouch.field._disc import DiscMap
from handtouch.field.model import ForwardModel

FloatArray = NDArray[np.float64]
SHEET = 1000.0
L_SHAPE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)]


def electrodes(*ends: tuple[float, float]) -> list[BoundaryElectrode]:
    return [BoundaryElectrode(*pair) for pair in ends]


def disc(count: int) -> OutlineNetwork:
    """Equal electrodes and gaps."""
    width = math.pi / count
    ends = [(2 * k * width + 0.1, (2 * k + 1) * width + 0.1) for k in range(count)]
    return OutlineNetwork(Outline.circle(1.0), electrodes(*ends), SHEET)


def rectangle(a: float, gap: float) -> OutlineNetwork:
    """Four electrodes in the order of `ElectrodeNetwork`, with equal gaps."""
    ends = [
        (2 * a + 1 + gap, 2 * a + 2 - gap),
        (a + gap, a + 1 - gap),
        (gap, a - gap),
        (a + 1 + gap, 2 * a + 1 - gap),
    ]
    outline = Outline([(0, 0), (a, 0), (a, 1), (0, 1)])
    return OutlineNetwork(outline, electrodes(*ends), SHEET)


@cache
def l_shape() -> OutlineNetwork:
    """One electrode ends at the re-entrant corner."""
    ends = ((0.1, 0.6), (2.1, 2.9), (3.5, 4.0), (5.2, 5.9), (6.3, 7.2))
    return OutlineNetwork(Outline(L_SHAPE), electrodes(*ends), SHEET)


def interior(
    network: OutlineNetwork, count: int, margin: float, seed: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Random points, `margin` from the boundary."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, network.a, 20 * count), rng.uniform(0, network.b, 20 * count)
    directions = margin * np.exp(2j * np.pi * np.arange(16) / 16)
    inside = network.outline.contains(x[:, None] + directions.real, y[:, None] + directions.imag).all(axis=1)
    return x[inside][:count], y[inside][:count]


@pytest.mark.parametrize("gap", [0.05, 0.2])
def test_a_rectangle_equals_its_exact_solution(gap: float) -> None:
    exact, pad = ElectrodeNetwork(1.3, 1.0, gap, SHEET), rectangle(1.3, gap)
    x, y = interior(pad, 60, 0.01)
    for resistors in ((0.0,) * 4, (0.0, 300.0, 50.0, math.inf)):
        first, second = exact.with_series_ohm(resistors), pad.with_series_ohm(resistors)
        for ours, theirs in zip(
            second.fractions_with_jacobian(x, y), first.fractions_with_jacobian(x, y), strict=True
        ):
            assert ours == pytest.approx(theirs, abs=2e-9)
        assert second.fractions(x, y) == pytest.approx(first.fractions(x, y), abs=1e-10)
        assert second.series_resistance(x, y) == pytest.approx(first.series_resistance(x, y), rel=1e-9)
    assert pad.conductance == pytest.approx(exact.conductance, abs=1e-10)
    assert pad.spreading_radius(x, y) == pytest.approx(exact.spreading_radius(x, y), rel=1e-6)


@pytest.mark.parametrize("count", [3, 4, 8])
def test_a_disc_with_equal_electrodes_and_gaps_has_the_conductance_of_its_dual(count: int) -> None:
    """Eigenvalues 2 sin(pi k / m): exchanging potential and stream function exchanges electrodes and gaps."""
    expected = np.sort(2 * np.sin(np.pi * np.arange(count) / count))
    assert np.sort(np.linalg.eigvalsh(disc(count).conductance)) == pytest.approx(expected, abs=1e-10)


def test_a_hexagon_with_electrodes_on_every_other_side_is_its_own_dual() -> None:
    """All six corners are ends of electrodes."""
    corners = 1 + np.exp(1j * np.pi / 3 * np.arange(6))
    outline = Outline([(z.real, z.imag) for z in corners]).at_origin()
    pad = OutlineNetwork(outline, electrodes((0, 1), (2, 3), (4, 5)), SHEET)
    expected = [0, math.sqrt(3), math.sqrt(3)]
    assert np.sort(np.linalg.eigvalsh(pad.conductance)) == pytest.approx(expected, abs=1e-9)


def test_fractions_are_invariant_under_the_map_of_a_rectangle_onto_the_disc() -> None:
    a, gap = 1.4, 0.15
    exact, mapped = ElectrodeNetwork(a, 1.0, gap, SHEET), DiscMap(a, 1.0)

    def onto_disc(x: npt.ArrayLike, y: npt.ArrayLike) -> NDArray[np.complex128]:
        return np.asarray(1 - mapped.defects(np.asarray(x, float), np.asarray(y, float))[0])

    ends = np.array(
        [
            [(0, 1 - gap), (0, gap)],
            [(a, gap), (a, 1 - gap)],
            [(gap, 0), (a - gap, 0)],
            [(a - gap, 1), (gap, 1)],
        ]
    )
    angles = np.angle(onto_disc(ends[..., 0], ends[..., 1])) % (2 * np.pi)
    pad = OutlineNetwork(Outline.circle(1.0), electrodes(*map(tuple, angles)), SHEET)
    x, y = np.random.default_rng(2).uniform(0.03, 0.97, (2, 50)) * [[a], [1.0]]
    zeta = onto_disc(x, y)
    at = zeta.real + 1, zeta.imag + 1
    assert pad.fractions(*at) == pytest.approx(exact.fractions(x, y), abs=1e-10)
    assert pad.conductance == pytest.approx(exact.conductance, abs=1e-10)
    growth = np.abs(mapped.derivative(mapped.defects(x, y)))
    assert pad.spreading_radius(*at) == pytest.approx(growth * exact.spreading_radius(x, y), rel=1e-7)


def test_fractions_of_an_l_shape_are_invariant_under_inversion() -> None:
    """A Moebius map sends its segments to arcs, and its corners to corners of the same angles."""
    straight = l_shape()
    pole = -3 - 2j

    def inverted(z: npt.ArrayLike) -> NDArray[np.complex128]:
        return np.asarray(10j / (np.asarray(z) - pole))

    corners = np.array([complex(*v) for v in L_SHAPE])
    images, middles = inverted(corners), inverted((corners + np.roll(corners, -1)) / 2)
    # half of each arc's angle, from the directions of its two half chords
    turn = np.angle((np.roll(images, -1) - middles) / (middles - images))
    arcs = Outline([(z.real, z.imag) for z in images], list(np.tan(turn / 2)))
    x0, y0, _, _ = arcs.bounds
    shift = complex(x0, y0)
    arcs = arcs.at_origin()
    ends = []
    for electrode in straight.electrodes:
        pair = []
        for position in (electrode.start, electrode.stop):
            end = complex(inverted(complex(*straight.outline.boundary_point(position)))) - shift
            pair.append(arcs.nearest_position(end.real, end.imag))
        ends.append((pair[0], pair[1]))
    curved = OutlineNetwork(arcs, electrodes(*ends), SHEET)
    assert curved.conductance == pytest.approx(straight.conductance, abs=1e-8)
    x, y = interior(straight, 60, 0.02)
    z = inverted(x + 1j * y) - shift
    assert curved.fractions(z.real, z.imag) == pytest.approx(straight.fractions(x, y), abs=1e-8)


def test_an_anisotropic_sheet_is_a_stretched_isotropic_one() -> None:
    ratio = 2.25
    exact = ElectrodeNetwork(1.5, 1.0, 0.1, SHEET)
    gap = 0.1 / 1.5  # along x
    ends = [(3.1, 3.9), (1.1, 1.9), (gap, 1 - gap), (2 + gap, 3 - gap)]
    outline = Outline([(0, 0), (1, 0), (1, 1), (0, 1)])
    pad = OutlineNetwork(outline, electrodes(*ends), SHEET, resistivity_ratio=ratio)
    x, y = interior(pad, 40, 0.02)
    fractions, jacobian = pad.fractions_with_jacobian(x, y)
    expected, slopes = exact.fractions_with_jacobian(1.5 * x, y)
    assert fractions == pytest.approx(expected, abs=1e-10)
    assert jacobian == pytest.approx(slopes * np.array([1.5, 1.0])[:, None], abs=1e-8)
    assert pad.spreading_radius(x, y) * 1.25 == pytest.approx(exact.spreading_radius(1.5 * x, y), rel=1e-7)


def test_a_small_hole_changes_the_conductance_as_a_dipole_does() -> None:
    """By -2 pi r^2 grad phi_i . grad phi_j, to the fourth power of r."""
    radius, at = 0.01, (0.7, 0.4)
    solid = rectangle(1.3, 0.1)
    hole = Outline.circle(radius).moved(at[0] - radius, at[1] - radius)
    outline = Outline([(0, 0), (1.3, 0), (1.3, 1), (0, 1)], holes=[hole])
    pad = OutlineNetwork(outline, solid.electrodes, SHEET)
    slopes = solid.fractions_with_jacobian(*at)[1]
    expected = -2 * math.pi * radius**2 * slopes @ slopes.T
    assert np.abs(expected).max() > 1e-4
    assert pad.conductance - solid.conductance == pytest.approx(expected, abs=3e-7)
    assert np.isnan(pad.fractions(*at)).all()


def test_laws_of_potentials_on_an_l_shape() -> None:
    pad = l_shape()
    x, y = interior(pad, 40, 0.05)
    fractions, jacobian = pad.fractions_with_jacobian(x, y)
    assert fractions.sum(axis=0) == pytest.approx(np.ones_like(x), abs=1e-12)
    assert jacobian.sum(axis=0) == pytest.approx(np.zeros((2, x.size)), abs=1e-10)
    assert (fractions > 0).all()
    assert (fractions < 1).all()
    circle = 0.04 * np.exp(2j * np.pi * np.arange(24) / 24)
    around = pad.fractions(x[:, None] + circle.real, y[:, None] + circle.imag)
    assert around.mean(axis=-1) == pytest.approx(fractions, abs=1e-9)
    step = 1e-5
    by_x = (pad.fractions(x + step, y) - pad.fractions(x - step, y)) / (2 * step)
    by_y = (pad.fractions(x, y + step) - pad.fractions(x, y - step)) / (2 * step)
    assert jacobian == pytest.approx(np.stack([by_x, by_y], axis=1), abs=1e-7)
    conductance = pad.conductance
    assert conductance == pytest.approx(conductance.T, abs=1e-9)
    assert conductance.sum(axis=1) == pytest.approx(np.zeros(5), abs=1e-9)
    assert (conductance[~np.eye(5, dtype=bool)] < 0).all()


def test_fractions_depend_on_shape_alone_not_on_size_direction_or_first_vertex() -> None:
    pad = l_shape()
    x, y = interior(pad, 20, 0.02)
    small = [(1e-3 * a, 1e-3 * b) for a, b in L_SHAPE]
    turned = [*small[2:], *small[:2]][::-1]  # another first vertex, and clockwise
    outline = Outline(turned)
    first, perimeter = Outline(small).nearest_position(*turned[0]), outline.perimeter()
    ends = [
        ((first - 1e-3 * e.stop) % perimeter, (first - 1e-3 * e.start) % perimeter) for e in pad.electrodes
    ]
    other = OutlineNetwork(outline, electrodes(*ends), SHEET)
    assert other.fractions(1e-3 * x, 1e-3 * y) == pytest.approx(pad.fractions(x, y), abs=1e-9)
    assert other.spreading_radius(1e-3 * x, 1e-3 * y) == pytest.approx(
        1e-3 * pad.spreading_radius(x, y), rel=1e-5
    )


def test_points_off_the_pad_and_nan_give_nan_in_their_own_element_only() -> None:
    pad = l_shape()
    assert isinstance(pad, ForwardModel)
    x, y = np.array([0.5, 1.5, np.nan, -0.1]), np.array([0.5, 1.5, 0.5, 0.5])
    fractions, jacobian = pad.fractions_with_jacobian(x, y)
    for values in (fractions, jacobian, pad.fractions(x, y), pad.spreading_radius(x, y)[None]):
        assert np.isfinite(values[..., 0]).all()
        assert np.isnan(values[..., 1:]).all()
    assert pad.fractions(0.5, 0.5).shape == (5,)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ([(0, 1)], "at least two"),
        ([(0, 1), (2, 9)], "off contour 0, of length 8"),
        ([(0, 1), (0.5, 2), (3, 4)], "overlap: 0 and 1"),
        ([(0, 1), (1, 2)], "have a gap of 0"),
        ([(0, 1), (2, 2.0001)], "electrode 1 is 0.0001 long"),
        ([(0, 3), (1, 2)], "overlap"),
    ],
)
def test_impossible_electrodes_are_rejected(ends: list[tuple[float, float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        OutlineNetwork(Outline(L_SHAPE), electrodes(*ends), SHEET)


def test_other_impossible_arguments_are_rejected() -> None:
    two = electrodes((0, 1), (2, 3))
    with pytest.raises(ValueError, match="at_origin"):
        OutlineNetwork(Outline(L_SHAPE).moved(1, 0), two, SHEET)
    with pytest.raises(ValueError, match="resistivity_ratio"):
        OutlineNetwork(Outline(L_SHAPE), two, SHEET, resistivity_ratio=0.0)
    with pytest.raises(ValueError, match="contour 1"):
        OutlineNetwork(Outline(L_SHAPE), [*two, BoundaryElectrode(0, 1, 1)], SHEET)
    with pytest.raises(ValueError, match="series_ohm must be 2"):
        OutlineNetwork(Outline(L_SHAPE), two, SHEET, (1.0,))
